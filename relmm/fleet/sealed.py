"""A saved episode of a dataset as bytes, to be sent: its frames and its row of meta/episodes, both as parquet."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from relmm.episodes.folder import DatasetFolder
from relmm.episodes.follow import RowFollower
from relmm.episodes.info import DATA_PATH
from relmm.episodes.parquet import read_table
from relmm.episodes.survey import rows_of
from relmm.fleet.wire import pack


@dataclass(frozen=True)
class SealedEpisode:
    """An episode that will not change any more.

    Attributes:
        index: its number in the dataset.
        content: `pack({"data": bytes of the first}, frames + row)`.
    """

    index: int
    content: bytes


class SealedReader:
    """Reads the saved episodes of a growing dataset as they are, each once and in order.

    Args:
        root: the dataset, which exists.
        first: number of the first episode to read.
    """

    def __init__(self, root: Path, first: int) -> None:
        self._folder, self._rows = DatasetFolder(root), RowFollower(root, first)

    @property
    def next(self) -> int:
        """Number of the next episode."""
        return self._rows.next

    def read_new(self) -> Iterator[SealedEpisode]:
        """The episodes that were saved since; ends early where files were just being replaced."""
        files = _Files(self._folder.root)
        for list_name, row in self._rows.new_rows():
            content = files.read(list_name, row) if row["episode_index"] == self._rows.next else None
            if content is None:
                return
            self._rows.next += 1
            yield SealedEpisode(row["episode_index"], content)


class _Files:
    """The last file of frames and the last one of the list: after an upload or a long life each holds many episodes."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._tables: dict[str, tuple[str, pa.Table]] = {}  # name and content of each kind

    def read(self, list_name: str, row: dict[str, Any]) -> bytes | None:
        """The content of the episode of a row; None where its files are just being replaced."""
        name = DATA_PATH.format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"])
        try:
            frames = rows_of(row, self._table("data", name))
            numbers = self._table("list", list_name)["episode_index"].to_pylist()
            if frames is None or row["episode_index"] not in numbers:
                return None
            at = numbers.index(row["episode_index"])
            data = self._part("data", frames)
            return pack({"data": len(data)}, data + self._part("list", self._tables["list"][1].slice(at, 1)))
        except (OSError, pa.ArrowException):
            return None

    def _part(self, kind: str, rows: pa.Table) -> bytes:
        """Some rows of the last file of a kind as parquet: the file itself where there are no others in it."""
        name, table = self._tables[kind]
        return (self._root / name).read_bytes() if len(rows) == len(table) else _parquet(rows)

    def _table(self, kind: str, name: str) -> pa.Table:
        if kind not in self._tables or self._tables[kind][0] != name:
            self._tables[kind] = name, read_table(self._root / name)
        return self._tables[kind][1]


def _parquet(table: pa.Table) -> bytes:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="snappy", use_dictionary=True)
    return bytes(sink.getvalue())
