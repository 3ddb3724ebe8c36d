"""What the benchmarks print is also kept: a table as CSV."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any


def write_table(rows: Iterable[Mapping[str, Any]], path: Path, columns: Sequence[str] = ()) -> None:
    """Replace a table.

    Args:
        rows: at least one.
        path: of the file; its folder is made.
        columns: their order; that of the first row without them.
    """
    rows = list(rows)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns or list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def append_row(row: Mapping[str, Any], path: Path) -> None:
    """Add a row to a table, which is begun with it if there is none."""
    new = not path.exists()
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(row))
        if new:
            writer.writeheader()
        writer.writerow(row)
