"""Broken and unusual input: one sentence, or a report that says what it could not show."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from relmm.analysis import collect, summarize_collection, write_report
from relmm.analysis.predictions import Predictor
from relmm.analysis.reading import Reader
from relmm.commands.policies import make_actor
from relmm.episodes import DurableDataset
from relmm.errors import ConfigError, DatasetError
from relmm.features import IMAGE_KEY, STATE_KEY
from relmm.policies.random.configuration_random import RelmmRandomConfig
from relmm.policies.relmm.configuration_relmm import ReLMMConfig


def report(root, output, predictor=None, learned=None):
    collection = collect(root, output, predictor, learned)
    summary = summarize_collection(collection, "tester/broken")
    write_report(output, collection, {**summary, "where": None, "policy_path": None, "comparison": None})
    return summary, (output / "report.html").read_text()


def change(root, change_table):
    """Rewrite the data file, and the list of columns with it."""
    path = root / "data/chunk-000/file-000.parquet"
    table = change_table(pq.read_table(path))
    pq.write_table(table.replace_schema_metadata(), path)
    info = json.loads((root / "meta/info.json").read_text())
    info["features"] = {key: value for key, value in info["features"].items() if key in table.column_names}
    (root / "meta/info.json").write_text(json.dumps(info))


@pytest.fixture
def small(made, tmp_path):
    frames = [made.attempt(i % 225, i % 3 == 0, 0.5, mean=0.4, std=0.1) for i in range(30)]
    with_steps = [frame for attempt in frames for frame in (attempt, made.step())]
    return made.write(tmp_path / "dataset", [with_steps[:30], with_steps[30:]])


@pytest.mark.parametrize("successes", [[], [True], [False], [True] * 25, [False] * 25])
def test_no_one_or_always_the_same_attempt(made, tmp_path, successes):
    frames = [made.step(), *(made.attempt(i, success, 0.7) for i, success in enumerate(successes)), made.step()]
    summary, page = report(made.write(tmp_path / "dataset", [frames]), tmp_path / "report")
    assert summary["success"]["overall"]["successes"] == sum(successes)
    assert "What is wrong with the data?" in page
    assert (len(successes) == 0) == any("no grasp attempt" in note for note in summary["not_shown"])


def test_missing_columns_are_named_not_made_up(small, tmp_path):
    gone = [name for name in pq.read_schema(small / "data/chunk-000/file-000.parquet").names if "info." in name]
    change(small, lambda table: table.drop_columns([*gone, "next.reward"]))
    summary, page = report(small, tmp_path / "report")
    assert summary["calibration"]["p_grasp"] is None
    assert summary["track"] == []
    assert "No P[grasp] was recorded" in page
    assert "No odometry was recorded" in page
    # The outcome of each attempt is read off the frame after it.
    assert summary["success"]["overall"]["successes"] == 10


def test_frames_with_nan_are_left_out_and_counted(small, tmp_path):
    def spoil(table):
        states = np.stack(table[STATE_KEY].to_numpy())
        states[4] = np.nan
        column = pa.FixedSizeListArray.from_arrays(pa.array(states.ravel()), states.shape[1])
        return table.set_column(table.column_names.index(STATE_KEY), STATE_KEY, column)

    change(small, spoil)
    summary, page = report(small, tmp_path / "report")
    assert summary["dataset"]["attempts"] == 29
    assert "1 frames have numbers that are missing or not finite" in page


def test_truncated_file_costs_its_episodes_only(small, tmp_path):
    path = sorted(small.glob("data/*/*.parquet"))[-1]
    whole = len(pq.read_table(path))
    path.write_bytes(path.read_bytes()[:-100])
    output = tmp_path / "report"
    summary, page = report(small, output)
    assert summary["dataset"]["frames"] == 60 - whole
    assert "cut off" in page


def test_pictures_that_cannot_be_decoded_are_counted(small, tmp_path):
    def spoil(table):
        pictures = table[IMAGE_KEY].to_pylist()
        pictures[0]["bytes"] = b"no picture"
        column = pa.array(pictures, table[IMAGE_KEY].type)
        return table.set_column(table.column_names.index(IMAGE_KEY), IMAGE_KEY, column)

    change(small, spoil)
    summary, page = report(small, tmp_path / "report")
    assert summary["dataset"]["attempts"] == 30
    assert "1 attempts have no picture" in page


def test_dataset_of_others_is_refused(tmp_path):
    (tmp_path / "meta").mkdir()
    features = {"action": {"dtype": "float32", "shape": [6], "names": None}}
    info = {"features": features, "fps": 30, "codebase_version": "v3.0", "data_path": "x"}
    (tmp_path / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(DatasetError, match="cannot be trained on"):
        Reader(tmp_path)
    with pytest.raises(DatasetError, match="no LeRobot dataset"):
        Reader(tmp_path / "nothing")


def test_policy_of_another_camera_is_refused(small, tmp_path):
    predictor = Predictor(make_actor(ReLMMConfig(camera="d435", device="cpu")).policy)
    with pytest.raises(DatasetError, match="d435"):
        collect(small, tmp_path / "report", predictor)
    assert not (tmp_path / "report").exists()


def test_policy_without_an_ensemble_is_refused():
    with pytest.raises(ConfigError, match="no grasp ensemble"):
        Predictor(make_actor(RelmmRandomConfig(device="cpu")).policy)


def test_recording_that_goes_on(small):
    """What is saved by then is read, also when the recorder ends and packs its files into others meanwhile."""
    reader = Reader(small)
    episodes = reader.episodes([STATE_KEY])
    first, _ = next(episodes)
    for path in small.glob("data/*/*.parquet"):
        path.rename(path.with_name(f"file-{int(path.stem[-3:]) + 100}.parquet"))
    for path in small.glob("meta/episodes/*/*.parquet"):
        table, name = pq.read_table(path), "data/file_index"
        column = pa.array([index + 100 for index in table[name].to_pylist()])
        pq.write_table(table.set_column(table.column_names.index(name), name, column), path)
    rest = [row["episode_index"] for row, _ in episodes]
    assert [first["episode_index"], *rest] == [0, 1]
    assert reader.notes == []


def test_open_writer_does_not_disturb(made, tmp_path):
    root = made.write(tmp_path / "dataset", [[made.attempt(3, True, 0.5), made.step()]])
    with DurableDataset.open(root, made.REPO_ID):
        assert summarize_collection(collect(root, tmp_path / "report"), "a/b")["dataset"]["frames"] == 2
