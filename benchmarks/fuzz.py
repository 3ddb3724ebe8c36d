"""Damaged files and command lines, thrown at everything that reads or parses them: none may end in a traceback.

    python benchmarks/fuzz.py          # about half an hour; writes benchmarks/results/fuzz.csv

All in one process. A case is refused when it ends in an error of relmm, whose message a command prints as its one
sentence, and accepted when it is read; what is accepted must then work. Anything else is a traceback, and is shown.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import logging
import math
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from csv_table import write_table
from fuzz_damage import damaged, damaged_arguments
from fuzz_targets import COMMANDS, FILES, SLOWNESS, Healthy, parse, prepare

import relmm.plugin  # noqa: F401
from relmm.errors import RelmmError

Case = Callable[[], object]
_COLUMNS = ("kind", "cases", "refused", "accepted", "tracebacks", "slowest_s")


def main() -> None:
    """Print and write the table."""
    flags = argparse.ArgumentParser(description=__doc__)
    flags.add_argument("--cases", type=int, default=10_000)
    flags.add_argument("--seed", type=int, default=0)
    flags.add_argument("--only", default="", help="a part of the names of kinds, whose rows are replaced")
    flags.add_argument("--csv", default=str(Path(__file__).parent / "results" / "fuzz.csv"), help="nothing for none")
    options = flags.parse_args()
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    rows = _rows(Path(options.csv)) if options.csv and options.only else {}
    with tempfile.TemporaryDirectory(prefix="relmm-fuzz-") as temporary:
        healthy = prepare(Path(temporary) / "healthy")
        share = options.cases / sum(1 / slowness for slowness in SLOWNESS.values())
        for number, (kind, slowness) in enumerate(SLOWNESS.items()):
            if options.only in kind:
                rng = np.random.default_rng([options.seed, number])
                rows[kind] = row_of(kind, math.ceil(share / slowness), rng, healthy)
    total = {"kind": "all", **{name: sum(row[name] for row in rows.values()) for name in _COLUMNS[1:-1]}}
    rows["all"] = {**total, "slowest_s": max(row["slowest_s"] for row in rows.values())}
    print(" | ".join(str(value) for value in rows["all"].values()))
    if options.csv:
        write_table(rows.values(), Path(options.csv), _COLUMNS)
    sys.exit(rows["all"]["tracebacks"] > 0)


def _rows(file: Path) -> dict[str, dict[str, Any]]:
    """Those of an earlier run, without their sum."""
    with file.open(newline="", encoding="utf-8") as lines:
        rows = {row["kind"]: row for row in csv.DictReader(lines)}
    rows.pop("all")
    counts = {kind: {name: int(row[name]) for name in _COLUMNS[1:-1]} for kind, row in rows.items()}
    return {kind: {"kind": kind, **counts[kind], "slowest_s": float(rows[kind]["slowest_s"])} for kind in rows}


def row_of(kind: str, cases: int, rng: np.random.Generator, healthy: Healthy) -> dict[str, Any]:
    """All cases of a kind, the first of them undamaged."""
    counts, slowest, seen = {"refused": 0, "accepted": 0, "tracebacks": 0}, 0.0, set()
    for number in range(cases):
        started = time.perf_counter()
        error = attempt(kind, rng, healthy, number > 0)
        slowest = max(slowest, time.perf_counter() - started)
        if error is None:
            counts["accepted"] += 1
        elif isinstance(error, RelmmError | SystemExit):
            counts["refused"] += 1
            if number == 0:
                raise RuntimeError(f"{kind}: the healthy case is refused") from error
        else:
            counts["tracebacks"] += 1
            lines = traceback.format_exception(error)
            if (place := (type(error), lines[-2])) not in seen:
                seen.add(place)
                print("".join(lines[-3:])[-800:])
    row = {"kind": kind, "cases": cases, **counts, "slowest_s": round(slowest, 2)}
    print(" | ".join(str(value) for value in row.values()), flush=True)
    return row


def attempt(kind: str, rng: np.random.Generator, healthy: Healthy, damage: bool) -> BaseException | None:
    """One case: what it ends in, None if it is read."""
    quiet = io.StringIO()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(quiet), contextlib.redirect_stdout(quiet):
        if kind in COMMANDS:
            arguments = COMMANDS[kind][1]
            case = _parsing(kind, damaged_arguments(arguments, rng) if damage else arguments)
        else:
            source, name, read = FILES[kind]
            copy = Path(folder) / "copy"
            shutil.copytree(healthy[source], copy, symlinks=True)
            if damage:
                (copy / name).write_bytes(damaged((copy / name).read_bytes(), name, rng))
            case = _reading(read, copy)
        try:
            case()
        except (Exception, SystemExit) as error:
            return error
    return None


def _parsing(kind: str, arguments: list[str]) -> Case:
    return lambda: parse(COMMANDS[kind][0], arguments)


def _reading(read: Callable[[Path], object], copy: Path) -> Case:
    return lambda: read(copy)


if __name__ == "__main__":
    main()
