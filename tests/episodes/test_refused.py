"""What cannot be trained on is refused in a sentence: other datasets, and damaged ones."""

import json
import subprocess
import sys

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from episode_helpers import DATA, INFO, REPO_ID, check_episode, check_episodes, new_dataset

from relmm.episodes import DurableDataset, EpisodeFollower, check_trainable, read_episodes
from relmm.errors import DatasetError
from relmm.features import IMAGE_KEY, STATE_KEY


def edit_info(root, change):
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda info: info["features"][IMAGE_KEY].update(dtype="uint8"), "have uint8 .*want image"),
        (lambda info: info["features"][IMAGE_KEY].update(shape=[64, 64, 3]), r"have image \(64, 64, 3\).*want image"),
        (lambda info: info["features"].pop(IMAGE_KEY), f"column {IMAGE_KEY}: have no such column"),
        (
            lambda info: info["features"]["next.reward"].update(dtype="bool"),
            "column next.reward: have bool .*want float32",
        ),
        (
            lambda info: info["features"]["action"]["names"].reverse(),
            r"column action: have .* of skill_y\.pos, skill_x",
        ),
        (lambda info: info["features"]["observation.state"]["names"].reverse(), "column observation.state: have"),
        (lambda info: info.update(codebase_version="v2.1"), r"format: have v2\.1, want v3\.0"),
        (lambda info: info.pop("features"), "no LeRobot dataset"),
    ],
)
def test_other_datasets_are_refused_before_anything_is_read(tmp_path, change, words):
    new_dataset(tmp_path / "d", 1)
    check_trainable(tmp_path / "d")
    edit_info(tmp_path / "d", change)
    for read in (check_trainable, read_episodes, EpisodeFollower):
        with pytest.raises(DatasetError, match=words) as caught:
            read(tmp_path / "d")
        assert str(caught.value).startswith(str(tmp_path / "d"))
        assert "; choose " in str(caught.value)


def as_recorded_by_0_1_0(info):
    joints = ["waist.pos", "shoulder.pos", "elbow.pos", "wrist_angle.pos", "wrist_rotate.pos"]
    names = ["x.vel", "theta.vel", *joints, "gripper.pos", "holding.pos", "bumper.pos"]
    info["features"][STATE_KEY].update(shape=[10], names=names)
    for name in ("grasp_mean", "grasp_std", "odom_x", "odom_y", "odom_heading"):
        del info["features"][f"complementary_info.{name}"]


def test_datasets_of_the_old_schema_are_refused_with_what_reads_them(tmp_path):
    new_dataset(tmp_path / "d", 1)
    edit_info(tmp_path / "d", as_recorded_by_0_1_0)
    resume = lambda root: DurableDataset.open(root, REPO_ID, info=INFO)  # noqa: E731
    for read in (check_trainable, read_episodes, EpisodeFollower, resume):
        with pytest.raises(DatasetError) as caught:
            read(tmp_path / "d")
        assert str(caught.value) == (
            f"{tmp_path / 'd'} was recorded by relmm 0.1.0, its observation.state has no y.vel and no scan_00.pos to "
            "scan_40.pos; choose a newer dataset, or read it with relmm 0.1.0."
        )


# --- Cameras -------------------------------------------------------------------------------------------------
READERS = (
    check_trainable,
    lambda root, camera: read_episodes(root, camera=camera),
    lambda root, camera: EpisodeFollower(root, camera=camera),
)


@pytest.mark.parametrize("read", READERS)
def test_a_dataset_of_another_camera_is_refused_with_both(tmp_path, read):
    new_dataset(tmp_path / "d", 1)
    for camera in ("paper", None):
        read(tmp_path / "d", camera)
    with pytest.raises(DatasetError) as caught:
        read(tmp_path / "d", "d435")
    assert str(caught.value) == (
        f"{tmp_path / 'd'} was recorded with the camera paper (position [0.067, 0.0, 0.591], pitch 42.1, fov "
        "[60.0, 60.0]), but the policy's is d435 (position [0.0844, 0.0175, 0.4626], pitch 47.27, fov [57.0, 44.3]); "
        "choose another dataset, or set --policy.camera to the dataset's."
    )


def test_a_camera_of_the_same_name_that_looks_elsewhere_is_refused(tmp_path):
    new_dataset(tmp_path / "d", 1)
    edit_info(tmp_path / "d", lambda info: info["features"][IMAGE_KEY]["info"]["camera"].update(pitch=40.0))
    with pytest.raises(DatasetError, match=r"paper \(.*pitch 40\.0.*paper \(.*pitch 42\.1"):
        check_trainable(tmp_path / "d", "paper")


@pytest.mark.parametrize("info", [None, {}, {"is_depth_map": False}, {"camera": None}, [1], "?"])
def test_a_dataset_that_does_not_tell_its_camera_may_have_any(tmp_path, info):
    new_dataset(tmp_path / "d", 1)
    edit_info(tmp_path / "d", lambda whole: whole["features"][IMAGE_KEY].update(info=info))
    for camera in ("paper", "d435"):
        check_episodes(read_episodes(tmp_path / "d", camera=camera), [0])


def test_a_description_of_a_camera_that_is_none_is_no_crash(tmp_path):
    new_dataset(tmp_path / "d", 1)
    edit_info(tmp_path / "d", lambda info: info["features"][IMAGE_KEY]["info"].update(camera="webcam"))
    with pytest.raises(DatasetError, match="recorded with the camera 'webcam', but the policy's is paper"):
        check_trainable(tmp_path / "d", "paper")


def test_another_dataset_is_refused_when_it_comes(tmp_path):
    followers = [EpisodeFollower(tmp_path / "d", camera=camera) for camera in (None, "d435")]
    new_dataset(tmp_path / "d", 1)
    with pytest.raises(DatasetError, match="recorded with the camera paper"):
        followers[1].poll()
    edit_info(tmp_path / "d", lambda info: info.update(codebase_version="v2.1"))
    with pytest.raises(DatasetError, match=r"format: have v2\.1"):
        followers[0].poll()


def test_more_columns_are_welcome(tmp_path):
    new_dataset(tmp_path / "d", 1, depth=True)
    edit_info(tmp_path / "d", lambda info: info["features"].pop("next.success"))
    check_episodes(read_episodes(tmp_path / "d"), [0])


def test_folders_that_are_no_dataset(tmp_path):
    for name in ("nothing", "."):
        with pytest.raises(DatasetError, match=r"no readable meta/info\.json; choose"):
            read_episodes(tmp_path / name)
        assert EpisodeFollower(tmp_path / name).poll() == []  # it may come


def rewrite(path, change):
    table = pq.read_table(path, partitioning=None)
    pq.write_table(change(table), path)


def with_column(key, values):
    return lambda table: table.set_column(table.column_names.index(key), key, values(table[key]))


@pytest.mark.parametrize("key", ["index", "episode_index"])
def test_rows_of_another_episode_are_never_taken(tmp_path, key):
    new_dataset(tmp_path / "d", 2)
    rewrite(tmp_path / "d" / DATA.format(1), with_column(key, lambda old: pa.array([*old.to_pylist()[:-1], 99])))
    follower = EpisodeFollower(tmp_path / "d")
    check_episodes(follower.poll(), [0])
    assert "episode 1 of" in follower.problem
    episodes = read_episodes(tmp_path / "d")
    check_episode(next(episodes), 0)
    with pytest.raises(DatasetError, match="episode 1 of"):
        next(episodes)


@pytest.mark.parametrize(
    ("file", "words"),
    [
        (None, "only its name"),
        (b"no picture", "no PNG"),
        (cv2.imencode(".png", np.zeros((50, 60, 3), np.uint8))[1].tobytes(), r"shape \(50, 60\)"),
    ],
)
def test_pictures_that_cannot_be_read(tmp_path, file, words):
    new_dataset(tmp_path / "d", 1)

    def damaged(old):
        rows = old.to_pylist()
        return pa.array([*rows[:-1], rows[-1] | {"bytes": file}], old.type)

    rewrite(tmp_path / "d" / DATA.format(0), with_column(IMAGE_KEY, damaged))
    with pytest.raises(DatasetError, match=f"a picture of episode 0 in .*file-000.parquet cannot be read: .*{words}"):
        next(read_episodes(tmp_path / "d"))


def test_reading_needs_no_lerobot(tmp_path):
    new_dataset(tmp_path / "d", 2)
    code = (
        "import sys; from relmm.episodes import read_episodes; episodes = list(read_episodes(sys.argv[1])); "
        "print(len(episodes), sorted({'lerobot', 'torch', 'datasets'} & sys.modules.keys()))"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "d")]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "2 []\n"


def test_numbers_that_nothing_can_learn_from(tmp_path):
    new_dataset(tmp_path / "d", 1)

    def damaged(old):
        rows = old.to_pylist()
        return pa.array([*rows[:-1], float("nan")], old.type)

    rewrite(tmp_path / "d" / DATA.format(0), with_column("next.reward", damaged))
    with pytest.raises(DatasetError, match=r"episode 0 in .* numbers that are missing or not finite"):
        list(read_episodes(tmp_path / "d"))


def test_a_data_path_that_leads_elsewhere(tmp_path):
    new_dataset(tmp_path / "d", 1)
    info = json.loads((tmp_path / "d/meta/info.json").read_text())
    (tmp_path / "d/meta/info.json").write_text(json.dumps(info | {"data_path": "../secret/{file_index}.parquet"}))
    with pytest.raises(DatasetError, match=r"data_path: have \.\./secret/"):
        read_episodes(tmp_path / "d")


@pytest.mark.parametrize("damage", [("dataset_to_index", 10**17), ("length", None), ("data/file_index", "../../etc")])
def test_places_that_cannot_be(tmp_path, damage):
    new_dataset(tmp_path / "d", 1)
    path = tmp_path / "d/meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(path, partitioning=None)
    column, value = damage
    pq.write_table(table.set_column(table.schema.get_field_index(column), column, pa.array([value])), path)
    with pytest.raises(DatasetError, match="missing or cut off"):
        list(read_episodes(tmp_path / "d"))
