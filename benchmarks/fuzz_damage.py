"""Ways to damage a file or a command line."""

from __future__ import annotations

import io
import json
import math
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

Rng = np.random.Generator
HOSTILE: list[Any] = [
    None, True, False, 0, -1, 1, 10**6, 10**23, -(10**400), 0.5, 1e30, 1e308, -1e-320, math.nan, math.inf, "", "x",
    "x" * 5000, "1", "nan", "../../../etc/passwd", "/dev/zero", "~", "{0.__class__}", "{", "%s%n", "\x00", "\ud800",
    "\x1b[31m", "a\nb", "cuda:99", "os.system", [], {}, [[]], [None], {"": None}, {"type": "os.system"}, [1] * 1000,
    {"__class__": "x"}, [{"a": [{}]}],
]  # fmt: skip


def damaged(content: bytes, name: str, rng: Rng) -> bytes:
    """A file of that name with some damage.

    Args:
        content: of the healthy file.
        name: its suffix says what it is.
        rng: chooses the damage.
    """
    if name.endswith(".json") and rng.random() < 0.75:
        return _json_with(json.loads(content), rng)
    if name.endswith(".jsonl") and rng.random() < 0.75:
        lines = content.splitlines()
        index = int(rng.integers(len(lines)))
        lines[index] = _json_with(json.loads(lines[index]), rng)
        return b"\n".join(lines)
    if name.endswith(".parquet") and rng.random() < 0.6:
        return _table_with(pq.read_table(pa.BufferReader(content)), rng)
    return _bytes_with(content, rng)


def _table_with(table: pa.Table, rng: Rng) -> bytes:
    """The same with a column of other values or missing, or with rows missing or doubled."""
    index = int(rng.integers(table.num_columns))
    name = table.column_names[index]
    match int(rng.integers(6)):
        case 0:
            table = table.remove_column(index)
        case 1:
            table = table.slice(int(rng.integers(len(table) + 1)))
        case 2:
            table = pa.concat_tables([table, table])
        case _:
            values = [
                1,
                -1,
                2**62,
                0.5,
                math.nan,
                "x",
                "{0}",
                b"x",
                None,
                [],
                [1.0],
                [[1]],
                {"bytes": b"\x89PNG"},
                {"a": 1},
            ]
            value = values[rng.integers(len(values))]
            table = table.set_column(index, name, pa.array([value] * len(table)))
    file = io.BytesIO()
    pq.write_table(table, file)
    return file.getvalue()


def _json_with(data: Any, rng: Rng) -> bytes:
    for _ in range(int(rng.integers(1, 4))):
        data = _changed(data, rng)
    return json.dumps(data).encode()


def _changed(data: Any, rng: Rng) -> Any:
    """The same with one node replaced, removed, renamed or added."""
    if not isinstance(data, dict | list) or not data or rng.random() < 0.1:
        return HOSTILE[rng.integers(len(HOSTILE))]
    keys = list(data) if isinstance(data, dict) else list(range(len(data)))
    key = keys[rng.integers(len(keys))]
    copy = data.copy()
    match int(rng.integers(10)):
        case 0:
            del copy[key]
        case 1 if isinstance(copy, dict):
            copy[str(HOSTILE[rng.integers(len(HOSTILE))])] = copy.pop(key)
        case 2 if isinstance(copy, dict):
            copy["sudo"] = HOSTILE[rng.integers(len(HOSTILE))]
        case _:
            copy[key] = _changed(copy[key], rng)
    return copy


def _bytes_with(content: bytes, rng: Rng) -> bytes:
    data, size = bytearray(content), len(content)
    at = int(rng.integers(max(size, 1)))
    match int(rng.integers(9)):
        case 0:
            return bytes(data[:at])
        case 1:
            return b""
        case 2:
            return b"[" * 100_000
        case 3:
            return b'{"a":' * 100_000
        case 4:
            return bytes(rng.integers(0, 256, min(size, 1000), np.uint8))
        case 5:
            data[at : at + 1] = b"\xff\xfe\x00"
        case 6:
            data[at : at + 64] = bytes(len(data[at : at + 64]))
        case 7:
            data[at:at] = data[: int(rng.integers(1, 200))]
        case _:
            for index in rng.integers(size, size=int(rng.integers(1, 9))):
                data[index] ^= 1 << int(rng.integers(8))
    return bytes(data)


def damaged_arguments(arguments: list[str], rng: Rng) -> list[str]:
    """A command line with one to three arguments changed, doubled, cut or left out."""
    result = list(arguments)
    for _ in range(int(rng.integers(1, 4))):
        index = int(rng.integers(len(result)))
        option, _, value = result[index].partition("=")
        match int(rng.integers(12)):
            case 0 if len(result) > 1:
                del result[index]
            case 1:
                result[index] = option
            case 2:
                result[index] = f"{option[: int(rng.integers(1, len(option) + 1))]}={value}"
            case 3:
                result.append(result[index])
            case 4:
                result[index] = f"{option}.x={value}"
            case _:
                bad = HOSTILE[rng.integers(len(HOSTILE))]
                # What a shell cannot pass is no case.
                text = bad if isinstance(bad, str) else json.dumps(bad)
                result[index] = f"{option}={text.replace(chr(0), '').encode(errors='replace').decode()}"
    return result
