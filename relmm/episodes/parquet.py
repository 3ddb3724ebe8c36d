"""Reading parquet files that may come from anybody: a small one may unpack to more than there is memory."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from relmm.errors import DatasetError

# What is plausible in memory: pictures are PNGs and stay as they are, and little else is in a recording.
_PLAUSIBLE_BYTES, _PLAUSIBLE_RATIO = 64 << 20, 8
_ROWS_AT_ONCE = 256


def read_table(path: Path, columns: list[str] | None = None) -> pa.Table:
    """Columns of a parquet file.

    Args:
        path: of the file.
        columns: None for all; those that the file does not have are left out.

    Raises:
        OSError, pa.ArrowException: it is missing, cut off, or no parquet file.
        DatasetError: it unpacks to more than any recording does.
    """
    limit = _PLAUSIBLE_BYTES + _PLAUSIBLE_RATIO * path.stat().st_size
    with pq.ParquetFile(path) as file:
        everything = file.schema_arrow  # made anew each time it is asked for, which takes longer than the rest
        wanted = [name for name in everything.names if columns is None or name in columns]
        for name in wanted:
            _refuse_dictionaries(path, everything.field(name))
        size, batches = _claimed_bytes(file.metadata), []
        _refuse(path, size, limit)
        size = 0
        # A claim may be false, and a value that is stored once may be repeated: what really comes is counted, too.
        for batch in file.iter_batches(_ROWS_AT_ONCE, columns=wanted, use_threads=False):
            size += batch.nbytes
            _refuse(path, size, limit)
            batches.append(batch)
        schema = batches[0].schema if batches else everything.empty_table().select(wanted).schema
    return pa.Table.from_batches(batches, schema).combine_chunks()


def are_whole_numbers(table: pa.Table, columns: list[str]) -> bool:
    """Whether columns hold whole numbers throughout."""
    return all(pa.types.is_integer(table[name].type) and table[name].null_count == 0 for name in columns)


def _refuse_dictionaries(path: Path, field: pa.Field) -> None:
    """They are small in memory until somebody looks at them."""
    if pa.types.is_dictionary(field.type):
        raise DatasetError(f"{path} has values by number in {field.name!r}, which no recording has; do not use it.")
    for index in range(field.type.num_fields):
        _refuse_dictionaries(path, field.type.field(index))


def _claimed_bytes(metadata: pq.FileMetaData) -> int:
    """Of the file's own word, before anything is unpacked; to ask for its columns can end the process (pyarrow 26)."""
    groups = (metadata.row_group(index) for index in range(metadata.num_row_groups))
    return sum(max(group.total_byte_size, group.num_rows) for group in groups)


def _refuse(path: Path, size: int, limit: int) -> None:
    if size > limit:
        raise DatasetError(
            f"{path} has {path.stat().st_size / 1e6:.1f} MB and unpacks to {size / 1e6:.0f} MB or more, which no "
            "recording does; do not use it."
        )
