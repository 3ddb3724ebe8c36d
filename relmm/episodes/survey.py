"""Which episodes of a dataset are whole, read from the parquet files and nothing else."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from relmm.episodes.folder import DATA_FILES, EPISODE_FILES, DatasetFolder
from relmm.episodes.parquet import are_whole_numbers, read_table

# The columns of meta/episodes that say where an episode is.
PLACE_COLUMNS = [
    "episode_index",
    "length",
    "dataset_from_index",
    "dataset_to_index",
    "data/chunk_index",
    "data/file_index",
    "tasks",
]


@dataclass
class Survey:
    """What `survey` found.

    Attributes:
        episodes: rows of meta/episodes of the whole episodes, in order; `PLACE_COLUMNS` each.
        task_indices: of each whole episode, in the order in which they first occur.
        kept_rows: rows that belong to whole episodes, by parquet file.
        cut_files: files of which only the first rows are kept.
        stray_files: files of which no row is kept, unreadable ones among them.
        problems: sentences about what is not whole.
    """

    episodes: list[dict[str, Any]] = field(default_factory=list)
    task_indices: list[list[int]] = field(default_factory=list)
    kept_rows: dict[str, int] = field(default_factory=dict)
    cut_files: list[str] = field(default_factory=list)
    stray_files: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    @property
    def frames(self) -> int:
        """Frames of all whole episodes."""
        return self.episodes[-1]["dataset_to_index"] if self.episodes else 0


def read_columns(path: Path, columns: list[str]) -> pa.Table | None:
    """Columns of a parquet file; None when it is missing, cut off, or lacks one of them.

    Raises:
        DatasetError: it unpacks to more than any recording does.
    """
    try:
        table = read_table(path, columns)
    except (OSError, pa.ArrowException):
        return None
    return table if len(table.column_names) == len(columns) else None


def read_places(path: Path, more: Sequence[str] = ()) -> pa.Table | None:
    """`PLACE_COLUMNS`, and more, of a file of meta/episodes; None also where the first are not whole numbers."""
    table = read_columns(path, [*PLACE_COLUMNS, *more])
    return table if table is not None and are_places(table) else None


def are_places(table: pa.Table) -> bool:
    """Whether `PLACE_COLUMNS` are there, and what they must be."""
    if not set(PLACE_COLUMNS) <= set(table.column_names) or not are_whole_numbers(table, PLACE_COLUMNS[:-1]):
        return False
    return bool(pa.types.is_list(table["tasks"].type)) and table["tasks"].null_count == 0


def rows_of(episode: dict[str, Any], table: pa.Table) -> pa.Table | None:
    """The rows of an episode in a data file; None where they are not all there.

    Args:
        episode: a row of meta/episodes, with `PLACE_COLUMNS`.
        table: with `episode_index` and `index`.
    """
    start, length = episode["dataset_from_index"], episode["dataset_to_index"] - episode["dataset_from_index"]
    if not 0 < length <= len(table) or length != episode["length"]:
        return None
    part = table.slice(int(np.searchsorted(table["index"].to_numpy(), start)), length)
    whole = np.array_equal(part["index"].to_numpy(), np.arange(start, start + length))
    return part if whole and np.all(part["episode_index"].to_numpy() == episode["episode_index"]) else None


def survey(folder: DatasetFolder, data_path: str) -> Survey:
    """Find the longest run of whole episodes from the first one on; reads only.

    Args:
        folder: the dataset.
        data_path: LeRobot's template for data files, from info.json.
    """
    result = Survey()
    tables = {name: read_places(folder.root / name) for name in folder.files(EPISODE_FILES)}
    data = _DataFiles(folder, data_path)
    rows = [(name, row) for name, table in tables.items() if table is not None for row in table.to_pylist()]
    for number, (name, row) in enumerate(rows):
        task_indices = data.take(row) if _follows(result, row) else None
        if task_indices is None:
            result.problems += _describe_lost([row for _, row in rows[number:]], number)
            break
        result.episodes.append(row)
        result.task_indices.append(task_indices)
        result.kept_rows[name] = result.kept_rows.get(name, 0) + 1
    result.kept_rows |= data.taken
    lengths = {name: len(table) for name, table in tables.items() if table is not None} | data.lengths()
    for name in [*tables, *folder.files(DATA_FILES)]:
        kept = result.kept_rows.get(name, 0)
        if kept == 0:
            result.stray_files.append(name)
        elif kept < lengths[name]:
            result.cut_files.append(name)
    return result


def _follows(result: Survey, row: dict[str, Any]) -> bool:
    length = row["dataset_to_index"] - row["dataset_from_index"]
    return (
        row["episode_index"] == len(result.episodes)
        and row["dataset_from_index"] == result.frames
        and row["length"] == length > 0
    )


class _DataFiles:
    """Checks, episode by episode, that the data files hold the rows that meta/episodes promises."""

    def __init__(self, folder: DatasetFolder, data_path: str) -> None:
        self.taken: dict[str, int] = {}
        self._folder = folder
        self._data_path = data_path
        self._columns: dict[str, NDArray[np.int64] | None] = {}

    def take(self, row: dict[str, Any]) -> list[int] | None:
        """The task indices of the next episode of its file; None when that file does not hold it whole."""
        name = self._data_path.format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"])
        columns = self._read(name)
        # A row that promises more frames than there are is not worth the memory to compare them.
        if columns is None or row["length"] > columns.shape[1]:
            return None
        begin = self.taken.get(name, 0)
        episode, index, tasks = columns[:, begin : begin + row["length"]]
        expected = np.arange(row["dataset_from_index"], row["dataset_to_index"])
        if not (np.array_equal(index, expected) and np.all(episode == row["episode_index"])):
            return None
        self.taken[name] = begin + row["length"]
        return list(dict.fromkeys(tasks.tolist()))

    def lengths(self) -> dict[str, int]:
        """Rows of the readable files that were asked for."""
        return {name: columns.shape[1] for name, columns in self._columns.items() if columns is not None}

    def _read(self, name: str) -> NDArray[np.int64] | None:
        if name not in self._columns:
            wanted = ["episode_index", "index", "task_index"]
            table = read_columns(self._folder.root / name, wanted)
            self._columns[name] = None
            if table is not None and are_whole_numbers(table, wanted):
                self._columns[name] = np.stack([table[key].to_numpy() for key in wanted])
        return self._columns[name]


def _describe_lost(rows: list[dict[str, Any]], number: int) -> Iterator[str]:
    first, rest = rows[0], rows[1:]
    if first["episode_index"] != number:
        yield f"episode {number} is missing"
        rest = rows
    else:
        yield f"episode {number} was cut off, {first['length']} frames dropped"
    if rest:
        frames = sum(row["length"] for row in rest)
        yield f"{len(rest)} episodes after it no longer follow on and were set aside, {frames} frames"
