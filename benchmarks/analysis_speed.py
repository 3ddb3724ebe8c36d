"""How long relmm-analyze takes, and how much memory, on a dataset of many frames.

    python benchmarks/analysis_speed.py --frames 100000 [--policy FOLDER]

The frames are those of a recorded dataset, over and over. Prints a row and appends it to
benchmarks/results/analysis_speed.csv.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from csv_table import append_row

from relmm.episodes.folder import DATA_FILES, EPISODE_FILES, INFO, DatasetFolder
from relmm.episodes.info import DATA_PATH

ROOT = Path(__file__).parents[1]
_FRAMES_A_FILE = 9000  # about as many as LeRobot puts into a file of 100 MB
COLUMNS = ("source", "frames", "attempts", "policy", "wall_s", "cpu_s", "peak_mb", "report_mb")


def repeated(source: Path, target: Path, frames: int) -> None:
    """Write a dataset of at least so many frames that repeats the episodes of another."""
    folder, target = DatasetFolder(source), target.resolve()
    data = pa.concat_tables(pq.read_table(source / name) for name in folder.files(DATA_FILES))
    rows = pa.concat_tables(pq.read_table(source / name) for name in folder.files(EPISODE_FILES))
    for name in ("data/chunk-000", "meta/episodes/chunk-000"):
        (target / name).mkdir(parents=True)
    for name in ("meta/tasks.parquet", "meta/stats.json", "meta/relmm.json", INFO):
        (target / name).write_bytes((source / name).read_bytes())
    copies = -(-frames // len(data))
    in_a_file = max(_FRAMES_A_FILE // len(data), 1)
    for file, first in enumerate(range(0, copies, in_a_file)):
        numbers = range(first, min(first + in_a_file, copies))
        parts = [_moved(data, ("index",), number * len(data)) for number in numbers]
        parts = [_moved(part, ("episode_index",), n * len(rows)) for part, n in zip(parts, numbers, strict=True)]
        pq.write_table(pa.concat_tables(parts), target / DATA_PATH.format(chunk_index=0, file_index=file))
        listed = [_moved(rows, ("dataset_from_index", "dataset_to_index"), n * len(data)) for n in numbers]
        listed = [_moved(part, ("episode_index",), n * len(rows)) for part, n in zip(listed, numbers, strict=True)]
        table = pa.concat_tables(listed)
        table = table.set_column(
            table.column_names.index("data/file_index"), "data/file_index", pa.array(np.full(len(table), file))
        )
        pq.write_table(table, target / f"meta/episodes/chunk-000/file-{file:03d}.parquet")


def _moved(table: pa.Table, names: tuple[str, ...], by: int) -> pa.Table:
    for name in names:
        column = pa.array(table[name].to_numpy() + by)
        table = table.set_column(table.column_names.index(name), name, column)
    return table


def measure(root: Path, output: Path, policy: str | None) -> dict[str, float]:
    """Run relmm-analyze as a process of its own; seconds and the most memory it had."""
    command = [sys.executable, "-m", "relmm.commands.analyze", f"--dataset.root={root}", f"--output_dir={output}"]
    begin = time.perf_counter()
    subprocess.run(command + [f"--policy.path={policy}"] * (policy is not None), check=True, env=os.environ)
    wall, used = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "wall_s": round(wall, 1),
        "cpu_s": round(used.ru_utime + used.ru_stime, 1),
        "peak_mb": used.ru_maxrss // 1024,
    }


def main() -> None:
    """Measure, print and append."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--source", type=Path, default=ROOT / "datasets/first_attempts")
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--policy", help="a checkpoint's pretrained_model")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root, output = Path(folder) / "dataset", Path(folder) / "report"
        repeated(arguments.source, root, arguments.frames)
        result = measure(root, output, arguments.policy)
        dataset = json.loads((output / "summary.json").read_text())["dataset"]
        size = (output / "report.html").stat().st_size / 1e6
    row = {"source": arguments.source.name, "frames": dataset["frames"], "attempts": dataset["attempts"]}
    row |= {"policy": bool(arguments.policy), **result, "report_mb": round(size, 2)}
    print(row)
    path = ROOT / "benchmarks/results/analysis_speed.csv"
    append_row(row, path)


if __name__ == "__main__":
    main()
