"""Datasets as LeRobot reads them."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from episode_helpers import (
    INFO,
    REPO_ID,
    TASK,
    arguments,
    check_dataset,
    check_frame,
    length_of,
    load,
    new_dataset,
    picture,
    record,
)

from relmm.episodes import DurableDataset, FrameBuilder
from relmm.errors import ConfigError, DatasetError
from relmm.features import DEPTH_KEY, FPS, IMAGE_KEY, dataset_features
from relmm.geometry import camera_info


def record_with_stock_lerobot(root, episodes, depth=False):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    features = dataset_features(depth, camera_info("paper"))
    dataset = LeRobotDataset.create(
        REPO_ID, FPS, features, root=root, robot_type="locobot_sim", use_videos=False, video_backend="pyav"
    )
    build = FrameBuilder(depth).build
    for episode in range(episodes):
        for step in range(length_of(episode)):
            dataset.add_frame({**build(*arguments(episode, step, depth)), "task": TASK})
        dataset.save_episode()
    dataset.finalize()


def load_info(root):
    return json.loads((root / "meta/info.json").read_text())


def test_every_frame_comes_back_through_lerobot(tmp_path):
    new_dataset(tmp_path / "d", 4)
    check_dataset(tmp_path / "d", 4)


def test_every_frame_comes_back_with_depth(tmp_path):
    new_dataset(tmp_path / "d", 2, depth=True)
    check_dataset(tmp_path / "d", 2, depth=True)


def test_every_frame_comes_back_by_streaming(tmp_path):
    from lerobot.datasets.streaming_dataset import StreamingLeRobotDataset

    new_dataset(tmp_path / "d", 3)
    stream = StreamingLeRobotDataset(REPO_ID, root=tmp_path / "d", shuffle=False)
    items = sorted(stream, key=lambda item: int(item["index"]))
    expected = [(e, s) for e in range(3) for s in range(length_of(e))]
    assert len(items) == len(expected)
    for index, (episode, step) in enumerate(expected):
        check_frame(items[index], episode, step, index)


@pytest.mark.parametrize("depth", [False, True])
def test_the_files_are_what_lerobot_writes(tmp_path, depth):
    new_dataset(tmp_path / "ours", 3, depth)
    record_with_stock_lerobot(tmp_path / "stock", 3, depth)
    ours, stock = (json.loads((tmp_path / d / "meta/info.json").read_text()) for d in ("ours", "stock"))
    assert ours == stock
    ours, stock = (pq.read_schema(tmp_path / d / "data/chunk-000/file-000.parquet") for d in ("ours", "stock"))
    assert ours == stock
    # The stock metadata also has a fingerprint, the key of a cache of `datasets`.
    ours, stock = (json.loads(schema.metadata[b"huggingface"])["info"] for schema in (ours, stock))
    assert ours == stock
    ours, stock = (pq.read_schema(tmp_path / d / "meta/episodes/chunk-000/file-000.parquet") for d in ("ours", "stock"))
    assert ours == stock
    table = pq.read_table(tmp_path / "stock/data/chunk-000/file-000.parquet")
    first = pq.read_table(tmp_path / "ours/data/chunk-000/file-000.parquet")
    columns = [key for key in table.column_names if not key.startswith("observation.images")]
    assert first.select(columns).equals(table.slice(0, length_of(0)).select(columns))
    paths = [row["path"] for row in first[IMAGE_KEY].to_pylist()]
    assert paths == [row["path"] for row in table[IMAGE_KEY].to_pylist()[: length_of(0)]]


@pytest.mark.parametrize("depth", [False, True])
def test_the_statistics_are_those_of_lerobot(tmp_path, depth):
    new_dataset(tmp_path / "ours", 3, depth)
    record_with_stock_lerobot(tmp_path / "stock", 3, depth)
    ours, stock = load(tmp_path / "ours").meta.stats, load(tmp_path / "stock").meta.stats
    assert ours.keys() == stock.keys()
    for key, stats in stock.items():
        assert ours[key].keys() == stats.keys()
        for name, values in stats.items():
            assert ours[key][name].shape == values.shape
            # LeRobot sums pixels in single precision.
            np.testing.assert_allclose(ours[key][name], values, rtol=1e-3, atol=1e-4, err_msg=f"{key} {name}")


def test_resuming_continues_the_indices(tmp_path):
    new_dataset(tmp_path / "d", 2)
    for episodes in (range(2, 4), range(4, 5)):
        with DurableDataset.open(tmp_path / "d", REPO_ID, robot_type="locobot_sim", depth=False, info=INFO) as dataset:
            assert dataset.episodes == episodes.start
            record(dataset, episodes)
    check_dataset(tmp_path / "d", 5)
    runs = json.loads((tmp_path / "d/meta/relmm.json").read_text())["runs"]
    assert [run["first_episode"] for run in runs] == [0, 2, 4]
    assert runs[0] == {"first_episode": 0, **INFO}


def test_a_new_task_gets_the_next_index(tmp_path):
    new_dataset(tmp_path / "d", 1)
    build = FrameBuilder(False).build
    with DurableDataset.open(tmp_path / "d", REPO_ID) as dataset:
        for task in ("pick up", TASK, "pick up"):
            dataset.add_frame(build(*arguments(1, 0)), task)
        dataset.save_episode()
    loaded = load(tmp_path / "d")
    assert [loaded[i]["task"] for i in range(length_of(0), length_of(0) + 3)] == ["pick up", TASK, "pick up"]
    assert loaded.meta.total_tasks == 2


def test_an_unfinished_episode_leaves_nothing(tmp_path):
    build = FrameBuilder(False).build
    with DurableDataset.create(REPO_ID, tmp_path / "d", False, "locobot_sim", INFO) as dataset:
        record(dataset, range(2))
        dataset.add_frame(build(*arguments(7, 0)), TASK)
    check_dataset(tmp_path / "d", 2)
    assert sorted(path.name for path in (tmp_path / "d").iterdir()) == ["data", "meta"]


def test_a_dataset_without_episodes_can_be_continued(tmp_path):
    new_dataset(tmp_path / "d", 0)
    began = load_info(tmp_path / "d")["features"]
    with DurableDataset.open(tmp_path / "d", REPO_ID) as dataset:
        record(dataset, range(2))
    check_dataset(tmp_path / "d", 2)
    assert load_info(tmp_path / "d")["features"] == began


@pytest.mark.parametrize("camera", ["paper", "d435"])
def test_pictures_know_their_camera(tmp_path, camera):
    DurableDataset.create(REPO_ID, tmp_path / "d", True, "locobot_sim", {"camera": camera}).close()
    features = load_info(tmp_path / "d")["features"]
    assert features[IMAGE_KEY]["info"] == {"is_depth_map": False, "camera": camera_info(camera)}
    assert features[DEPTH_KEY]["info"] == {"is_depth_map": True, "depth_unit": "mm", "camera": camera_info(camera)}


def test_a_camera_nobody_knows_is_refused_and_none_is_written_where_none_is_known(tmp_path):
    with pytest.raises(ConfigError, match="Unknown camera 'fisheye'"):
        DurableDataset.create(REPO_ID, tmp_path / "d", False, "locobot_sim", {"camera": "fisheye"})
    assert not (tmp_path / "d").exists()
    DurableDataset.create(REPO_ID, tmp_path / "d", False, "locobot_sim").close()
    assert load_info(tmp_path / "d")["features"][IMAGE_KEY]["info"] == {"is_depth_map": False}
    with DurableDataset.open(tmp_path / "d", REPO_ID, info={"camera": "d435"}) as dataset:
        record(dataset, range(1))
    check_dataset(tmp_path / "d", 1)


def test_resuming_and_repairing_keep_the_camera(tmp_path):
    new_dataset(tmp_path / "d", 1, depth=True)
    before = load_info(tmp_path / "d")["features"]
    for damage in (False, True):
        if damage:
            (tmp_path / "d/meta/info.json").unlink()
        with pytest.raises(DatasetError, match="camera: have paper"):
            DurableDataset.open(tmp_path / "d", REPO_ID, info={"camera": "d435"})
        DurableDataset.open(tmp_path / "d", REPO_ID, info=INFO).close()
        assert load_info(tmp_path / "d")["features"] == before


def test_files_go_on_in_the_next_chunk(tmp_path):
    new_dataset(tmp_path / "d", 1)
    info = json.loads((tmp_path / "d/meta/info.json").read_text())
    (tmp_path / "d/meta/info.json").write_text(json.dumps(info | {"chunks_size": 2}))
    with DurableDataset.open(tmp_path / "d", REPO_ID) as dataset:
        record(dataset, range(1, 5))
    assert (tmp_path / "d/data/chunk-002/file-000.parquet").exists()
    check_dataset(tmp_path / "d", 5)


def test_lerobot_can_delete_episodes(tmp_path):
    from lerobot.datasets.dataset_tools import delete_episodes

    new_dataset(tmp_path / "d", 4)
    smaller = delete_episodes(load(tmp_path / "d"), [1], output_dir=tmp_path / "smaller", repo_id="tester/smaller")
    assert smaller.num_episodes == 3
    pixels = (np.asarray(smaller[length_of(0)][IMAGE_KEY]).transpose(1, 2, 0) * 255).round()
    np.testing.assert_array_equal(pixels, picture(2, 0))
    with DurableDataset.open(tmp_path / "smaller", REPO_ID) as dataset:
        assert dataset.episodes == 3
        record(dataset, range(3, 4))
    assert load(tmp_path / "smaller").num_episodes == 4


@pytest.mark.parametrize("repo_id", ["clean_room", "a/b/c", "me/bad name", "me/-x", "", "me/x.git"])
def test_names_that_the_hub_refuses(tmp_path, repo_id):
    with pytest.raises(ConfigError, match="user/name"):
        DurableDataset.create(repo_id, tmp_path / "d", False, "locobot_sim")
    assert not (tmp_path / "d").exists()


def test_an_existing_folder_is_never_overwritten(tmp_path):
    (tmp_path / "file").write_text("x")
    for root in (tmp_path, tmp_path / "file"):
        with pytest.raises(DatasetError, match="exists already"):
            DurableDataset.create(REPO_ID, root, False, "locobot_sim")


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(DatasetError, match="cannot be written"):
        DurableDataset.create(REPO_ID, tmp_path / "file" / "d", False, "locobot_sim")


def snapshot(root):
    return {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"robot_type": "locobot"}, "robot type: have locobot_sim, want locobot"),
        ({"info": {"camera": "d435"}}, r"camera: have paper \(.*\), want d435 \("),
        ({"depth": True}, "front_depth: have no such column, want image"),
    ],
)
def test_other_settings_are_refused(tmp_path, settings, words):
    new_dataset(tmp_path / "d", 1)
    before = snapshot(tmp_path)
    with pytest.raises(DatasetError, match=words):
        DurableDataset.open(tmp_path / "d", REPO_ID, **settings)
    assert snapshot(tmp_path) == before


def test_a_dataset_with_other_columns_is_refused(tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    features = {"action": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]}}
    LeRobotDataset.create(REPO_ID, 30, features, root=tmp_path / "d", use_videos=False, video_backend="pyav")
    before = snapshot(tmp_path)
    with pytest.raises(DatasetError, match=r"fps: have 30, want 2; column action: have float32 \(2,\) of a, b, want"):
        DurableDataset.open(tmp_path / "d", REPO_ID)
    assert snapshot(tmp_path) == before


def test_folders_that_are_no_dataset_are_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "garbage" / "meta").mkdir(parents=True)
    (tmp_path / "garbage" / "meta" / "info.json").write_text("{ not json")
    (tmp_path / "list" / "meta").mkdir(parents=True)
    (tmp_path / "list" / "meta" / "info.json").write_text("[1]")
    before = snapshot(tmp_path)
    for name in ("empty", "garbage", "list"):
        with pytest.raises(DatasetError, match="no LeRobot dataset"):
            DurableDataset.open(tmp_path / name, REPO_ID)
    with pytest.raises(DatasetError, match="there is no dataset"):
        DurableDataset.open(tmp_path / "nothing", REPO_ID)
    assert snapshot(tmp_path) == before


def test_two_writers_are_refused(tmp_path):
    new_dataset(tmp_path / "d", 1)
    with DurableDataset.open(tmp_path / "d", REPO_ID), pytest.raises(DatasetError, match="one writer at a time"):
        DurableDataset.open(tmp_path / "d", REPO_ID)
    DurableDataset.open(tmp_path / "d", REPO_ID).close()


def test_frames_that_do_not_fit(tmp_path):
    build = FrameBuilder(False).build
    with DurableDataset.create(REPO_ID, tmp_path / "d", False, "locobot_sim") as dataset:
        frame = build(*arguments(0, 0))
        with pytest.raises(DatasetError, match="does not fit"):
            dataset.add_frame({**frame, "action": np.zeros(4, np.float32)}, TASK)
        with pytest.raises(DatasetError, match="without frames"):
            dataset.save_episode()
    with pytest.raises(DatasetError, match="closed"):
        dataset.save_episode()


def test_what_a_frame_is_built_from_is_checked():
    build = FrameBuilder(True).build
    observation, action, outcome = arguments(0, 0, depth=True)
    build(observation, action, outcome)
    without = {key: value for key, value in observation.items() if key != "waist.pos"}
    with pytest.raises(DatasetError, match=r"no 'waist\.pos'"):
        build(without, action, outcome)
    with pytest.raises(DatasetError, match="not finite"):
        build({**observation, "x.vel": float("nan")}, action, outcome)
    with pytest.raises(DatasetError, match=r"uint8 \(50, 50, 3\)"):
        build({**observation, "front": np.zeros((50, 50, 3), np.uint8)}, action, outcome)
    with pytest.raises(DatasetError, match=r"missing or unknown columns: next\.reward"):
        build(observation, action, {key: value for key, value in outcome.items() if key != "next.reward"})
