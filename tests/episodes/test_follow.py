"""Reading whole episodes, also of a dataset that is being recorded."""

import json
import signal
import time

import numpy as np
import pyarrow.parquet as pq
import pytest
from episode_children import die_after_renames, record_without_end
from episode_helpers import (
    DATA,
    INFO,
    META,
    REPO_ID,
    TASK,
    arguments,
    check_episode,
    check_episodes,
    length_of,
    load,
    new_dataset,
    record,
)

from relmm.episodes import (
    DurableDataset,
    EpisodeFollower,
    EpisodeRecorder,
    FrameBuilder,
    read_episodes,
    summarize,
)
from relmm.episodes.folder import DatasetFolder
from relmm.errors import DatasetError
from relmm.features import FPS, dataset_features


def test_what_was_recorded_comes_back(tmp_path):
    settings = {"depth": True, "robot_type": "locobot_sim", "info": INFO}
    with EpisodeRecorder(tmp_path / "d", REPO_ID, resume=False, **settings) as recorder:
        for number in range(6):
            for step in range(length_of(number)):
                recorder.add_frame(*arguments(number, step, depth=True), TASK)
            recorder.save_episode()
    check_episodes(read_episodes(tmp_path / "d"), range(6))
    for first in (1, 5, 6, 9):
        check_episodes(read_episodes(tmp_path / "d", first), range(first, 6))
    check_episodes(EpisodeFollower(tmp_path / "d", first=4).poll(), [4, 5])
    new_dataset(tmp_path / "empty", 0)
    assert list(read_episodes(tmp_path / "empty")) == []


def test_reading_is_one_episode_at_a_time(tmp_path):
    new_dataset(tmp_path / "d", 3)
    episodes = read_episodes(tmp_path / "d")
    check_episode(next(episodes), 0)
    (tmp_path / "d" / DATA.format(2)).unlink()  # not looked at yet
    check_episode(next(episodes), 1)
    with pytest.raises(DatasetError, match=r"episode 2 of .* is missing or cut off; .*repairs it"):
        next(episodes)


def test_arrays_are_their_own(tmp_path):
    """Views of the file that they are from would keep it in memory, and are read-only."""
    new_dataset(tmp_path / "d", 1)
    episode = next(read_episodes(tmp_path / "d"))
    for array in (episode.images, episode.states, episode.rewards, episode.dones, episode.phases):
        assert array.flags.writeable


# --- Following -----------------------------------------------------------------------------------------------
def test_each_episode_comes_once(tmp_path):
    follower = EpisodeFollower(tmp_path / "d")
    assert follower.poll() == []
    with DurableDataset.create(REPO_ID, tmp_path / "d", False, "locobot_sim", INFO) as dataset:
        assert follower.poll() == []
        record(dataset, range(2))
        check_episodes(follower.poll(), [0, 1])
        assert follower.poll() == []
        dataset.add_frame(*built_frame(2, 0))
        assert follower.poll() == []
        for step in range(1, length_of(2)):
            dataset.add_frame(*built_frame(2, step))
        dataset.save_episode()
        check_episodes(follower.poll(), [2])
    with DurableDataset.open(tmp_path / "d", REPO_ID) as dataset:
        record(dataset, range(3, 8))
    check_episodes(follower.poll(), range(3, 8))
    assert (follower.poll(), follower.next, follower.problem) == ([], 8, "")


def built_frame(episode, step):
    return FrameBuilder(False).build(*arguments(episode, step)), TASK


def test_a_poll_that_finds_nothing_new_opens_no_parquet_file(tmp_path, monkeypatch):
    new_dataset(tmp_path / "d", 5)
    follower = EpisodeFollower(tmp_path / "d")
    assert len(follower.poll()) == 5
    monkeypatch.setattr(pq, "ParquetFile", None)
    assert follower.poll() == []


def test_chunks_are_read_in_order(tmp_path):
    new_dataset(tmp_path / "d", 1)
    info = json.loads((tmp_path / "d/meta/info.json").read_text())
    (tmp_path / "d/meta/info.json").write_text(json.dumps(info | {"chunks_size": 2}))
    follower = EpisodeFollower(tmp_path / "d")
    check_episodes(follower.poll(), [0])
    with DurableDataset.open(tmp_path / "d", REPO_ID) as dataset:
        record(dataset, range(1, 7))
    assert (tmp_path / "d/meta/episodes/chunk-002").exists()
    check_episodes(follower.poll(), range(1, 7))
    check_episodes(read_episodes(tmp_path / "d", 4), [4, 5, 6])


def test_files_that_appear_one_by_one_and_half_written(tmp_path):
    """A slow copy of a dataset: worse than any order in which the writer publishes."""
    whole, root = tmp_path / "whole", tmp_path / "copy"
    new_dataset(whole, 3)
    follower = EpisodeFollower(root)
    seen = []

    def copy(name, until=None):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes((whole / name).read_bytes()[:until])
        seen.extend(follower.poll())
        return len(seen)

    assert copy("meta/info.json", 200) == 0
    assert copy("meta/info.json") == 0
    assert follower.problem == ""
    assert copy(DATA.format(0)) == 0
    assert copy(DATA.format(1)) == 0
    assert copy(META.format(1)) == 0  # whole, but the one before is not listed yet
    assert "episode 0 of" in follower.problem
    assert copy(META.format(0), 3000) == 0
    assert "file-000.parquet is missing or cut off" in follower.problem
    assert copy(META.format(0)) == 2
    assert copy(META.format(2)) == 2
    assert "episode 2 of" in follower.problem
    assert copy(DATA.format(2), 20_000) == 2
    assert copy(DATA.format(2)) == 3
    assert follower.problem == ""
    check_episodes(seen, range(3))


@pytest.mark.parametrize("missed", [0, 1])
def test_a_listing_may_miss_a_file_that_was_just_published(tmp_path, monkeypatch, missed):
    """The order in which a folder lists what is being added to it is undefined."""
    new_dataset(tmp_path / "d", 3)
    files, calls = DatasetFolder.files, []

    def listed(folder, pattern):
        calls.append(pattern)
        names = files(folder, pattern)
        return [name for name in names if len(calls) > 1 or name != META.format(missed)]

    monkeypatch.setattr(DatasetFolder, "files", listed)
    check_episodes(read_episodes(tmp_path / "d"), range(3))
    assert len(calls) == 2


@pytest.mark.parametrize("done", range(5))  # data, meta/episodes, stats, info
def test_a_kill_between_the_renames_of_a_save(tmp_path, forkserver, done):
    root = tmp_path / "d"
    new_dataset(root, 1)
    follower = EpisodeFollower(root)
    seen = follower.poll()
    process = forkserver.Process(target=die_after_renames, args=(root, 1, done))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    seen += follower.poll()
    assert len(seen) == (3 if done >= 2 else 2)
    check_episodes(read_episodes(root), range(len(seen)))
    with DurableDataset.open(root, REPO_ID) as dataset:
        assert dataset.episodes == len(seen)  # what was read is never taken back
        record(dataset, range(dataset.episodes, 5))
    check_episodes(seen + follower.poll(), range(5))


def test_following_a_recorder_that_is_killed_and_resumed(tmp_path, forkserver):
    root, random = tmp_path / "d", np.random.default_rng(4)
    follower, seen = EpisodeFollower(root), []
    for resume in (False, True):
        process = forkserver.Process(target=record_without_end, args=(root, resume))
        process.start()
        enough = len(seen) + 8
        while len(seen) < enough:
            assert process.is_alive()
            seen += follower.poll()
        time.sleep(random.uniform(0.0, 0.05))
        process.kill()
        process.join()
    seen += follower.poll()
    with DurableDataset.open(root, REPO_ID) as dataset:
        assert dataset.episodes == len(seen)
        record(dataset, range(dataset.episodes, dataset.episodes + 2))
    seen += follower.poll()
    assert len(seen) == summarize(root).episodes
    check_episodes(seen, range(len(seen)))
    check_episodes(read_episodes(root), range(len(seen)))


def test_an_episode_that_is_recorded_again_after_damage(tmp_path):
    """Its files get the names of those that a repair has set aside."""
    root = tmp_path / "d"
    new_dataset(root, 2)
    follower = EpisodeFollower(root)
    follower.poll()
    with DurableDataset.open(root, REPO_ID) as dataset:
        record(dataset, range(3, 4))  # as episode 2
    (root / DATA.format(2)).write_bytes(b"")
    assert follower.poll() == []
    assert "episode 2 of" in follower.problem
    with DurableDataset.open(root, REPO_ID) as dataset:
        assert dataset.episodes == 2
        record(dataset, range(2, 4))
    check_episodes(follower.poll(), [2, 3])


# --- Datasets that LeRobot has edited ------------------------------------------------------------------------
def test_deleted_episodes(tmp_path):
    from lerobot.datasets.dataset_tools import delete_episodes

    new_dataset(tmp_path / "d", 5)
    delete_episodes(load(tmp_path / "d"), [1, 3], output_dir=tmp_path / "less", repo_id="tester/less")
    episodes = list(read_episodes(tmp_path / "less"))
    assert len(episodes) == 3
    for number, source in enumerate((0, 2, 4)):
        check_episode(episodes[number], number, source)


def test_every_edit_keeps_the_camera(tmp_path):
    """LeRobot leaves `meta/relmm.json` behind."""
    from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets, remove_feature, split_dataset

    new_dataset(tmp_path / "d", 4, depth=True)
    whole = load(tmp_path / "d")
    delete_episodes(whole, [1], output_dir=tmp_path / "deleted", repo_id="tester/deleted")
    remove_feature(whole, "next.success", output_dir=tmp_path / "removed", repo_id="tester/removed")
    parts = split_dataset(whole, {"train": 0.5, "test": 0.5}, output_dir=tmp_path)
    merge_datasets(list(parts.values()), REPO_ID, output_dir=tmp_path / "merged")
    for name in ("deleted", "removed", "train", "test", "merged"):
        assert not (tmp_path / name / "meta/relmm.json").exists()
        assert len(list(read_episodes(tmp_path / name, camera="paper"))) == load(tmp_path / name).num_episodes
        with pytest.raises(DatasetError, match=r"the camera paper \(.*the policy's is d435 \("):
            read_episodes(tmp_path / name, camera="d435")
    with pytest.raises(DatasetError, match=r"camera: have paper \(.*, want d435 \("):
        DurableDataset.open(tmp_path / "merged", REPO_ID, info={"camera": "d435"})


def test_lerobot_merges_no_two_cameras(tmp_path):
    from lerobot.datasets.dataset_tools import merge_datasets

    for camera in ("paper", "d435"):
        with DurableDataset.create(REPO_ID, tmp_path / camera, False, "locobot_sim", {"camera": camera}) as dataset:
            record(dataset, range(1))
    with pytest.raises(ValueError, match="Same features"):
        merge_datasets([load(tmp_path / name) for name in ("paper", "d435")], REPO_ID, output_dir=tmp_path / "both")


def test_several_episodes_in_a_file_and_then_more(tmp_path):
    from lerobot.datasets.dataset_tools import merge_datasets

    root = tmp_path / "merged"
    new_dataset(tmp_path / "a", 3)
    with DurableDataset.create(REPO_ID, tmp_path / "b", False, "locobot_sim", INFO) as dataset:
        record(dataset, range(6, 9))
    merge_datasets([load(tmp_path / name) for name in "ab"], REPO_ID, output_dir=root)
    assert len(list(root.glob("data/*/*.parquet"))) == 1
    sources = [0, 1, 2, 6, 7, 8]
    follower = EpisodeFollower(root, first=1)
    for number, episode in enumerate(follower.poll(), start=1):
        check_episode(episode, number, sources[number])
    assert follower.next == 6
    with DurableDataset.open(root, REPO_ID) as dataset:
        record(dataset, range(6, 8))
    check_episodes(follower.poll(), [6, 7])
    for number, episode in enumerate(read_episodes(root)):
        check_episode(episode, number, [*sources, 6, 7][number])


def test_lerobots_own_recording(tmp_path):
    """Nothing of it can be read until it ends; it has all episodes in one file, from which some are then deleted."""
    from lerobot.datasets.dataset_tools import delete_episodes
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = tmp_path / "d"
    stock = LeRobotDataset.create(
        REPO_ID, FPS, dataset_features(), root, use_videos=False, video_backend="pyav", metadata_buffer_size=2
    )
    follower = EpisodeFollower(root)
    for number in range(5):
        for step in range(length_of(number)):
            frame, task = built_frame(number, step)
            stock.add_frame({**frame, "task": task})
        stock.save_episode()
        assert follower.poll() == []
    assert "cut off" in follower.problem
    stock.finalize()
    check_episodes(follower.poll(), range(5))
    assert len(list(root.glob("data/*/*.parquet"))) == 1
    check_episodes(read_episodes(root, 3), [3, 4])
    delete_episodes(load(root), [1, 3], output_dir=tmp_path / "less", repo_id="tester/less")
    less = list(read_episodes(tmp_path / "less"))
    assert len(less) == 3
    for number, source in enumerate((0, 2, 4)):
        check_episode(less[number], number, source)
