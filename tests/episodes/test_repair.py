"""Datasets that were damaged by hand."""

import json
import shutil

import numpy as np
import pytest
from episode_helpers import DATA, META, REPO_ID, TASK, arguments, check_dataset, length_of, load, new_dataset, record

from relmm.episodes import DurableDataset, FrameBuilder, verify_and_repair
from relmm.errors import DatasetError


def truncate(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def empty(path):
    path.write_bytes(b"")


def remove(path):
    path.unlink()


def snapshot(root):
    return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in root.rglob("*") if path.is_file()}


def stats(root):
    return json.loads((root / "meta/stats.json").read_text())


@pytest.fixture(scope="module")
def healthy(tmp_path_factory):
    root = tmp_path_factory.mktemp("healthy") / "d"
    new_dataset(root, 4)
    return root


@pytest.fixture
def root(healthy, tmp_path):
    return shutil.copytree(healthy, tmp_path / "d")


def test_a_whole_dataset_is_left_alone(root):
    before = snapshot(root)
    report = verify_and_repair(root)
    assert (report.episodes, report.problems, report.dropped_to) == (4, [], None)
    assert snapshot(root) == before


@pytest.mark.parametrize(
    ("damage", "file", "episode"),
    [
        *[(damage, file, 3) for damage in (truncate, empty, remove) for file in (DATA, META)],
        (remove, DATA, 1),
        (remove, META, 1),
    ],
)
def test_the_episodes_before_a_damaged_file_are_kept(root, damage, file, episode):
    damage(root / file.format(episode))
    report = verify_and_repair(root)
    assert report.episodes == episode
    assert f"episode {episode} " in str(report)
    if file == DATA:
        assert f"episode {episode} was cut off, {length_of(episode)} frames dropped" in report.problems
    if episode == 1 and file == META:
        frames = length_of(2) + length_of(3)
        assert f"2 episodes after it no longer follow on and were set aside, {frames} frames" in report.problems
    if episode == 1:
        assert (report.dropped_to / DATA.format(3)).exists()
    check_dataset(root, episode)
    assert stats(root)["index"]["count"] == [sum(length_of(e) for e in range(episode))]
    before = snapshot(root)
    assert verify_and_repair(root).problems == []
    assert snapshot(root) == before


def test_a_repaired_dataset_is_continued(root):
    truncate(root / DATA.format(2))
    with DurableDataset.open(root, REPO_ID) as dataset:
        assert dataset.episodes == 2
        assert "episode 2 was cut off" in str(dataset.repaired)
        record(dataset, range(2, 5))
    check_dataset(root, 5)


@pytest.mark.parametrize("damage", [truncate, remove])
@pytest.mark.parametrize("name", ["info.json", "stats.json", "tasks.parquet"])
def test_other_metadata_is_rebuilt(root, healthy, damage, name):
    damage(root / "meta" / name)
    report = verify_and_repair(root)
    assert report.episodes == 4
    assert report.problems == [f"meta/{name} was rebuilt"]
    check_dataset(root, 4)
    assert json.loads((root / "meta/info.json").read_text()) == json.loads((healthy / "meta/info.json").read_text())
    for key, values in stats(healthy).items():
        for statistic, value in values.items():
            np.testing.assert_allclose(stats(root)[key][statistic], value, rtol=1e-6, atol=1e-9)


def test_several_tasks_are_rebuilt_in_their_order(tmp_path):
    build = FrameBuilder(False).build
    with DurableDataset.create(REPO_ID, tmp_path / "d", False, "locobot_sim") as dataset:
        for task in ("c", "a", "b", "a"):
            dataset.add_frame(build(*arguments(0, 0)), task)
        dataset.save_episode()
    remove(tmp_path / "d/meta/tasks.parquet")
    assert verify_and_repair(tmp_path / "d").episodes == 1
    loaded = load(tmp_path / "d")
    assert [loaded[i]["task"] for i in range(4)] == ["c", "a", "b", "a"]


def test_without_any_description_nothing_is_changed(root):
    remove(root / "meta/info.json")
    remove(root / "meta/relmm.json")
    before = snapshot(root)
    with pytest.raises(DatasetError, match=r"no readable meta/info\.json"):
        verify_and_repair(root)
    assert snapshot(root) == before


def test_a_dataset_with_no_whole_episode_is_left_alone(root):
    truncate(root / DATA.format(0))
    before = snapshot(root)
    with pytest.raises(DatasetError, match="nothing was changed"):
        verify_and_repair(root)
    assert snapshot(root) == before


def stock_dataset(root):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from relmm.features import FPS, dataset_features

    dataset = LeRobotDataset.create(
        REPO_ID, FPS, dataset_features(), root=root, use_videos=False, video_backend="pyav", metadata_buffer_size=2
    )
    build = FrameBuilder(False).build
    for episode in range(5):
        for step in range(length_of(episode)):
            dataset.add_frame({**build(*arguments(episode, step)), "task": TASK})
        dataset.save_episode()
    return dataset


def test_a_killed_stock_recording_is_left_alone(tmp_path):
    dataset = stock_dataset(tmp_path / "d")
    killed = shutil.copytree(tmp_path / "d", tmp_path / "killed")  # what the disk has at this instant
    dataset.finalize()
    before = snapshot(killed)
    with pytest.raises(DatasetError, match="nothing was changed"):
        verify_and_repair(killed)
    assert snapshot(killed) == before
    assert verify_and_repair(tmp_path / "d").problems == []


def test_a_stock_recording_that_lost_its_last_metadata(tmp_path):
    dataset = stock_dataset(tmp_path / "d")
    dataset.meta._metadata_buffer.clear()  # what an uncaught exception does: info.json says 5, metadata has 4 rows
    dataset.finalize()
    (tmp_path / "d/images/observation.images.front/episode-000005").mkdir(parents=True)
    report = verify_and_repair(tmp_path / "d")
    assert report.episodes == 4
    assert "episode 4 was cut off" in str(report)
    check_dataset(tmp_path / "d", 4)
    assert not (tmp_path / "d/images").exists()
    assert verify_and_repair(tmp_path / "d").problems == []


def test_a_dataset_that_is_being_written_is_not_repaired(root):
    with DurableDataset.open(root, REPO_ID), pytest.raises(DatasetError, match="one writer at a time"):
        verify_and_repair(root)
