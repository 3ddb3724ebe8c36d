"""Columns of a dataset as arrays of numbers, whatever tool has stored them."""

from __future__ import annotations

import hashlib

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from relmm.features import BELIEF, IMAGE_KEY, FloatArray


def without_nulls(table: pa.Table) -> pa.Table:
    """Pictures aside, with NaN for what is missing."""
    for name in [name for name in table.column_names if table[name].null_count and name != IMAGE_KEY]:
        values = pa.array(table[name].to_pandas().astype(float)) if not _is_list(table[name].type) else None
        if values is not None:
            table = table.set_column(table.column_names.index(name), name, values)
    return table.drop_columns([IMAGE_KEY])


def _is_list(kind: pa.DataType) -> bool:
    return bool(pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind))


def matrix(table: pa.Table, name: str, width: int) -> FloatArray:
    """A column of lists, (n, width); NaN for rows of another length."""
    values = table[name].combine_chunks()
    flat = values.flatten().to_numpy(zero_copy_only=False)
    if len(flat) == width * len(table):
        return flat.astype(np.float64).reshape(-1, width)
    rows = [row if row is not None and len(row) == width else [np.nan] * width for row in values.to_pylist()]
    return np.array(rows, float)


def column(table: pa.Table, name: str) -> FloatArray:
    """A column of numbers, (n,)."""
    values = table[name].combine_chunks()
    if _is_list(values.type):  # LeRobot stores (1,) as a number, other tools as a list
        values = values.flatten()
    numbers: FloatArray = values.to_numpy(zero_copy_only=False).astype(np.float64)
    return numbers


def belief(table: pa.Table, name: str) -> FloatArray:
    """A column of `BELIEF` or `ODOMETRY`; NaN where it is missing, or the policy had no opinion."""
    key = f"complementary_info.{name}"
    if key not in table.column_names:
        return np.full(len(table), np.nan)
    values = column(table, key)
    return np.where(values < 0, np.nan, values) if name in BELIEF else values


def fingerprints(table: pa.Table, states: FloatArray, actions: FloatArray) -> NDArray[np.uint64]:
    """Of picture, state and action: two frames with the same one are copies."""
    pictures = table[IMAGE_KEY].combine_chunks().field("bytes").to_pylist()
    digests = (
        hashlib.blake2b((picture or b"") + state.tobytes() + action.tobytes(), digest_size=8).digest()
        for picture, state, action in zip(pictures, states, actions, strict=True)
    )
    return np.array([int.from_bytes(digest) for digest in digests], np.uint64)
