"""Files of LeRobot's usual sizes, instead of two for each episode: in a copy of a dataset, or in the dataset itself.

LeRobot's `merge_datasets` would do it in a time that grows with the square of the number of files, and leave
`meta/episodes/file_index` wrong.
"""

from __future__ import annotations

import logging
import shutil
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from relmm.episodes.exchange import exchange_folder, exchange_folders
from relmm.episodes.folder import DATA_FILES, INFO, RELMM, TASKS, DatasetFolder, refuse_links
from relmm.episodes.info import DATA_PATH, read_info
from relmm.episodes.parquet import read_table
from relmm.episodes.repair import verify_and_repair
from relmm.episodes.survey import Survey, survey
from relmm.errors import DatasetError

logger = logging.getLogger(__name__)

_MANY_FILES = 100  # of data; opening them takes LeRobot about a second
_EPISODES = "meta/episodes/chunk-000/file-000.parquet"


def compact(root: Path | str, target: Path) -> int:
    """Copy what is durable of a dataset, which may be being recorded and is not changed.

    Args:
        root: a LeRobot dataset (v3.0) of pictures.
        target: a folder that does not exist yet.

    Returns:
        How many episodes the copy holds.

    Raises:
        DatasetError: there is no dataset, it has links, or no whole episode in it.
        OSError: the copy cannot be written.
    """
    folder = DatasetFolder(root)
    info = read_info(folder)
    if info is None:
        raise DatasetError(f"{root} is no LeRobot dataset, it has no readable {INFO}; check the folder.")
    refuse_links(folder.root)
    found = survey(folder, info["data_path"])
    if not found.episodes:
        raise DatasetError(f"{root} has no whole episode yet; record one first.")
    target.mkdir(parents=True)
    places = _copy_data(folder, found, info, target)
    _copy_episodes(folder, found, places, target)
    for name in (TASKS, RELMM):
        if (folder.root / name).is_file():
            shutil.copyfile(folder.root / name, target / name)
    copy = DatasetFolder(target)
    copy.scratch.mkdir()
    copy.write_json(INFO, info | {"total_episodes": len(found.episodes)})
    # Counters and statistics may be ahead of the episodes that were there when we looked: made from them again.
    report = verify_and_repair(target)
    assert report.episodes == len(found.episodes)
    return report.episodes


def pack(folder: DatasetFolder) -> None:
    """Give a dataset fewer and larger files, if it has many; for whoever holds its lock.

    LeRobot opens each file, so a long life in one of each episode takes it minutes.
    """
    if len(folder.files(DATA_FILES)) <= _MANY_FILES:
        return
    target = exchange_folder(folder)
    shutil.rmtree(target, ignore_errors=True)
    try:
        compact(folder.root, target)
        exchange_folders(folder, ["data", "meta/episodes"])
    except OSError as error:  # it stays as it was
        logger.warning("%s keeps its many small files (%s)", folder.root, error.strerror or error)
    shutil.rmtree(target, ignore_errors=True)


def _copy_data(folder: DatasetFolder, found: Survey, info: dict[str, Any], target: Path) -> dict[int, tuple[int, int]]:
    """Write the frames, a row group an episode; returns chunk and file of each episode."""
    from lerobot.datasets.utils import update_chunk_file_indices

    place, places = (0, 0), {}
    with _Files(target, info["data_files_size_in_mb"] << 20) as files:
        for name, episodes in _by_file(found, info["data_path"]).items():
            table = read_table(folder.root / name)
            if files.is_full_with(folder.root / name):
                place = update_chunk_file_indices(*place, info["chunks_size"])
            files.open(place, table.schema)
            start = 0
            for episode in episodes:
                files.write(table.slice(start, episode["length"]))
                start += episode["length"]
                places[episode["episode_index"]] = place
    return places


class _Files:
    """Data files, one open at a time."""

    def __init__(self, target: Path, limit: int) -> None:
        self._target, self._limit = target, limit
        self._writer: pq.ParquetWriter | None = None
        self._path = Path()
        self._schema: pa.Schema | None = None
        self._bytes = 0

    def __enter__(self) -> _Files:
        return self

    def __exit__(self, *_: object) -> None:
        if self._writer is not None:
            self._writer.close()

    def is_full_with(self, source: Path) -> bool:
        """Whether a file of this size no longer fits into the open one."""
        size = source.stat().st_size
        full = self._bytes > 0 and self._bytes + size >= self._limit
        self._bytes = size if full else self._bytes + size
        return full

    def open(self, place: tuple[int, int], schema: pa.Schema) -> None:
        """Go on in the file of this place."""
        path = self._target / DATA_PATH.format(chunk_index=place[0], file_index=place[1])
        if path == self._path:
            return
        if self._writer is not None:
            self._writer.close()
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path, self._schema = path, self._schema or schema
        self._writer = pq.ParquetWriter(path, self._schema, compression="snappy", use_dictionary=True)

    def write(self, episode: pa.Table) -> None:
        """Add the frames of an episode."""
        assert self._writer is not None
        assert self._schema is not None
        self._writer.write_table(episode.replace_schema_metadata(self._schema.metadata), row_group_size=len(episode))


def _by_file(found: Survey, data_path: str) -> dict[str, list[dict[str, Any]]]:
    files: dict[str, list[dict[str, Any]]] = {}
    for episode in found.episodes:
        name = data_path.format(chunk_index=episode["data/chunk_index"], file_index=episode["data/file_index"])
        files.setdefault(name, []).append(episode)
    return files


def _copy_episodes(folder: DatasetFolder, found: Survey, places: dict[int, tuple[int, int]], target: Path) -> None:
    names = [name for name in found.kept_rows if name.startswith("meta/")]
    tables = [read_table(folder.root / name).slice(0, found.kept_rows[name]) for name in names]
    table = _concat(tables)
    numbers = table["episode_index"].to_pylist()
    columns = {
        "data/chunk_index": [places[number][0] for number in numbers],
        "data/file_index": [places[number][1] for number in numbers],
        "meta/episodes/chunk_index": [0] * len(numbers),
        "meta/episodes/file_index": [0] * len(numbers),
    }
    for key, values in columns.items():
        table = table.set_column(table.schema.get_field_index(key), key, pa.array(values, pa.int64()))
    (target / _EPISODES).parent.mkdir(parents=True)
    pq.write_table(table, target / _EPISODES)


def _concat(tables: list[pa.Table]) -> pa.Table:
    """LeRobot writes a minimum of truth values as a number in one session, and as a truth value in another."""
    fields = []
    for field in tables[0].schema:
        types = {table.schema.field(field.name).type for table in tables}
        fields.append(field if len(types) == 1 else pa.field(field.name, pa.list_(pa.float64())))
    schema = pa.schema(fields, tables[0].schema.metadata)
    return pa.concat_tables([table.select(schema.names).cast(schema) for table in tables])
