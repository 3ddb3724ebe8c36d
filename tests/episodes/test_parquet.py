"""Small parquet files that unpack to more than there is memory are refused before they do."""

import contextlib
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from episode_helpers import new_dataset

from relmm.episodes import follow, parquet, read_episodes, summarize, verify_and_repair
from relmm.episodes.parquet import read_table
from relmm.errors import DatasetError

ROWS = 200_000
PICTURE = np.random.default_rng(0).bytes(100_000)
BOMBS = {
    "zeros": ({"a": pa.array(np.zeros(10_000_000))}, {"use_dictionary": False, "compression": "zstd"}),
    "one picture again and again": ({"a": pa.DictionaryArray.from_arrays([0] * ROWS, [PICTURE])}, {}),
    "long lists": ({"a": pa.array([np.zeros(80_000_000, np.int8)])}, {}),
}


@pytest.mark.parametrize(("columns", "options"), BOMBS.values(), ids=BOMBS)
def test_bombs(tmp_path, columns, options):
    path = tmp_path / "bomb.parquet"
    table = pa.table({"index": np.zeros(len(columns["a"]), np.int8), **columns})
    pq.write_table(table, path, store_schema=False, **options)
    assert path.stat().st_size < 2_000_000
    with pytest.raises(DatasetError, match="MB or more, which no recording does; do not use it") as caught:
        read_table(path)
    assert "\n" not in str(caught.value)


def test_values_by_number_are_no_way_around(tmp_path):
    values = pa.DictionaryArray.from_arrays([0] * ROWS, [PICTURE])
    for name, column in (("plain", values), ("nested", pa.StructArray.from_arrays([values], ["bytes"]))):
        pq.write_table(pa.table({"a": column}), tmp_path / name)
        with pytest.raises(DatasetError, match=r"values by number|MB or more, which no recording does"):
            read_table(tmp_path / name)


def test_columns_are_read_as_they_are(tmp_path):
    table = pa.table({"a": np.arange(1000), "b.c": [{"d": str(n)} for n in range(1000)], "e": np.zeros(1000)})
    for name, rows in (("full", table), ("empty", table.slice(0, 0))):
        pq.write_table(rows, tmp_path / name)
        assert read_table(tmp_path / name).equals(rows)
        assert read_table(tmp_path / name, ["b.c", "a", "none"]).equals(rows.select(["a", "b.c"]))


def test_whoever_reads_a_dataset_refuses_them(tmp_path, monkeypatch):
    new_dataset(tmp_path / "run", 2)
    monkeypatch.setattr(parquet, "_PLAUSIBLE_BYTES", 0)
    monkeypatch.setattr(parquet, "_PLAUSIBLE_RATIO", 0)
    for read in (lambda root: list(read_episodes(root)), summarize, verify_and_repair):
        with pytest.raises(DatasetError, match="which no recording does"):
            read(tmp_path / "run")


@pytest.mark.parametrize("column", ["index", "action", "next.reward", "observation.images.front", "episode_index"])
@pytest.mark.parametrize(
    "value", [None, "x", 2.5, [1.0], [[1.0]], {"bytes": 1}, {"bytes": "x"}, {"path": "x"}, b"x"], ids=repr
)
def test_columns_of_other_types(tmp_path, column, value):
    new_dataset(tmp_path / "run", 2)
    (path,) = sorted((tmp_path / "run").glob("data/*/file-001.parquet"))
    table = pq.read_table(path, partitioning=None)
    other = pa.array([value] * len(table))
    pq.write_table(table.set_column(table.column_names.index(column), column, other), path)
    for read in (lambda root: list(read_episodes(root)), summarize):
        with contextlib.suppress(DatasetError):  # what can be taken for a number may be read
            read(tmp_path / "run")


@pytest.mark.parametrize("tasks", [1, "x", None])
def test_tasks_that_are_no_list(tmp_path, tasks):
    new_dataset(tmp_path / "run", 2)
    path = sorted((tmp_path / "run").glob("meta/episodes/*/*.parquet"))[-1]
    table = pq.read_table(path, partitioning=None)
    other = pa.array([tasks] * len(table))
    pq.write_table(table.set_column(table.column_names.index("tasks"), "tasks", other), path)
    with pytest.raises(DatasetError, match="missing or cut off"):
        list(read_episodes(tmp_path / "run"))
    assert verify_and_repair(tmp_path / "run").episodes == 1


DAMAGED = """
import sys
from pathlib import Path
import numpy as np
from relmm.episodes import read_episodes, summarize
from relmm.errors import DatasetError
path, rng = Path(sys.argv[1]), np.random.default_rng(0)
healthy = path.read_bytes()
for _ in range(300):
    data = bytearray(healthy)
    for index in rng.integers(len(data) - 4000, len(data), 3):  # of what the file says about itself
        data[index] ^= 1 << rng.integers(8)
    path.write_bytes(data)
    for read in (lambda root: list(read_episodes(root)), summarize):
        try:
            read(path.parents[2])
        except DatasetError:
            pass
"""


def test_damaged_metadata_do_not_end_the_process(tmp_path):
    """Pyarrow aborts where it is asked for some of them."""
    new_dataset(tmp_path / "run", 1)
    (path,) = (tmp_path / "run").glob("data/*/*.parquet")
    result = subprocess.run([sys.executable, "-c", DAMAGED, path], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_an_episode_of_more_frames_than_memory_is_refused(tmp_path, monkeypatch):
    new_dataset(tmp_path / "run", 2)
    monkeypatch.setattr(follow, "_MAX_FRAMES", 2)
    with pytest.raises(DatasetError, match="frames, and at most 2 are plausible"):
        list(read_episodes(tmp_path / "run"))
