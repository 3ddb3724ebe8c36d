"""Runs experiments of the paper, one after the other, and keeps what they score in `results/`, a CSV for each figure.

    python benchmarks/paper/run.py --list                              # all, with the hours that they take
    python benchmarks/paper/run.py rand_nav n_st/500 --seeds 0 1 2     # a whole figure, or one curve of another
    python benchmarks/paper/run.py length --read                       # only read what runs have scored so far

A run that was cut off goes on; a finished one is not run again. Runs lie in `--output`.
"""

from __future__ import annotations

import argparse
import csv
import os
import shlex
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from experiments import EXPERIMENTS, Experiment

from relmm.learning.progress import read_metrics

RESULTS = Path(__file__).parent / "results"
COLUMNS = (
    "experiment", "seed", "step", "attempts", "objects", "collected", "collected_std", "grasp_success",
    "interventions", "robot_minutes", "seconds", "command",
)  # fmt: skip


def chosen(names: Iterable[str]) -> list[Experiment]:
    """The experiments that are named, alone or by their figure."""
    wanted = set(names)
    unknown = wanted - set(EXPERIMENTS) - {name.split("/")[0] for name in EXPERIMENTS}
    if unknown:
        raise SystemExit(f"There is no {', '.join(sorted(unknown))}: --list names all experiments.")
    return [each for name, each in EXPERIMENTS.items() if {name, name.split("/")[0]} & wanted]


def train(experiment: Experiment, seed: int, folder: Path) -> None:
    """Train, or go on with it, until it is done."""
    if (folder / "finished").exists():
        return
    command = [sys.executable, "-m", "relmm.commands.train", *shlex.split(experiment.train)]
    command += [f"--seed={seed}", f"--output_dir={folder}"]
    if folder.exists():
        command.append("--resume=true")
    folder.parent.mkdir(parents=True, exist_ok=True)
    subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    (folder / "finished").touch()


def scores(experiment: Experiment, seed: int, folder: Path) -> list[dict[str, Any]]:
    """Rows of the CSV: one for each evaluation so far."""
    path = folder / "metrics.jsonl"
    return [
        {
            "experiment": experiment.name,
            "seed": seed,
            "step": line["steps"],
            "collected": line["eval_collected"],
            "collected_std": line["eval_collected_std"],
            "grasp_success": round(line["eval_grasp_success"], 4),
            "command": f"relmm-train {experiment.train} --seed={seed}",
            **{name: line[name] for name in ("attempts", "objects", "interventions", "robot_minutes", "seconds")},
        }
        for line in (read_metrics(path) if path.exists() else [])
        if "eval_collected" in line
    ]


def read(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV, none if it is not there."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def keep(rows: list[dict[str, Any]]) -> None:
    """Replace what the CSVs say of these experiments and seeds."""
    for figure in {row["experiment"].split("/")[0] for row in rows}:
        path = RESULTS / f"{figure}.csv"
        new = [row for row in rows if row["experiment"].split("/")[0] == figure]
        named = {(row["experiment"], str(row["seed"])) for row in new}
        kept = [row for row in read(path) if (row["experiment"], row["seed"]) not in named]
        everything = sorted([*kept, *new], key=lambda row: (row["experiment"], int(row["seed"]), int(row["step"])))
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(".tmp")
        with temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(everything)
        temporary.replace(path)


def show() -> None:
    """Print all experiments."""
    print(f"{'experiment':44}{'hours a seed':>13}  command")
    for name, each in EXPERIMENTS.items():
        print(f"{name:44}{each.hours:13.1f}  relmm-train {each.train}")
    total = sum(each.hours * len(each.seeds) for each in EXPERIMENTS.values())
    print(f"all, with all seeds: about {total:.0f} hours on one core (estimated)")


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="experiments or figures")
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--read", action="store_true", help="train nothing")
    parser.add_argument("--seeds", nargs="*", type=int)
    parser.add_argument("--output", type=Path, default=Path("outputs/paper"))
    arguments = parser.parse_args()
    if arguments.list or not arguments.names:
        show()
        return
    for experiment in chosen(arguments.names):
        for seed in experiment.seeds if arguments.seeds is None else arguments.seeds:
            folder = arguments.output / experiment.name / f"seed_{seed}"
            if not arguments.read:
                train(experiment, seed, folder)
            keep(scores(experiment, seed, folder))


if __name__ == "__main__":
    main()
