"""How fast ReLMM learns to clean a room: `relmm-train` from scratch, evaluated on fixed seeds as it goes.

Each run is a `relmm-train` command with three seeds. Everything was tuned with training seeds from 1000 on and
evaluation seeds from 50000 on; the runs here train with seeds 0, 1 and 2 and are evaluated on seeds 0 to 9.

    python benchmarks/learning_curves.py --runs stationary --seeds 0 1 2 --jobs 2
    python benchmarks/learning_curves.py --plot          # draws docs/learning_curves.png from the CSV

Finished runs are kept in --output and not run again.
"""

from __future__ import annotations

import argparse
import csv
import os
import shlex
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from csv_table import write_table

from relmm.learning.progress import read_metrics

RESULTS = Path(__file__).parent / "results" / "learning_curves.csv"
PICTURE = Path(__file__).parents[1] / "docs" / "learning_curves.png"
EVALUATION = "--eval.n_episodes=10 --eval.seed=0"
COLUMNS = (
    "run",
    "seed",
    "step",
    "collected",
    "collected_std",
    "grasp_success",
    "attempts",
    "pseudo_reset_steps",
    "interventions",
    "robot_minutes",
    "seconds",
    "command",
)


def room(name: str, steps: int, every: int, *options: str) -> str:
    """Arguments of one run."""
    fixed = f"--robot.type=locobot_sim --robot.room={name} --steps={steps} --env_eval_freq={every} {EVALUATION}"
    return " ".join([fixed, *options])


RUNS = {
    "stationary": room("no_obstacles", 1, 1),  # the curriculum alone: 100 attempts
    "autonomous": room("no_obstacles", 300, 100, "--curriculum.type=autonomous"),
    "d435": room("no_obstacles", 1, 1, "--robot.camera=d435 --policy.camera=d435 --policy.num_stationary=200"),
    "obstacles": room("obstacles", 500, 500),
    "diverse": room("diverse", 1000, 500),
    "obstacles_rugs": room("obstacles_rugs", 4000, 1000),
    "paper_small": room("no_obstacles", 5000, 1000, "--config_path=paper_small"),
}


def train(run: str, seed: int, output: Path) -> Path:
    """Run one training, unless it has been finished before; the folder it wrote."""
    folder = output / run / f"seed_{seed}"
    if (folder / "finished").exists():
        return folder
    command = [sys.executable, "-m", "relmm.commands.train", *shlex.split(RUNS[run])]
    command += [f"--seed={seed}", f"--output_dir={folder}"]
    if folder.exists():
        command.append("--resume=true")
    folder.parent.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with (folder.parent / f"seed_{seed}.log").open("a") as log:
        subprocess.run(command, check=True, stdout=log, stderr=subprocess.STDOUT, env=environment)
    (folder / "finished").touch()
    return folder


def read(run: str, seed: int, folder: Path) -> list[dict[str, Any]]:
    """Rows of the CSV of one training."""
    command = f"relmm-train {RUNS[run]} --seed={seed}"
    return [
        {
            "run": run,
            "seed": seed,
            "step": line["steps"],
            "collected": line["eval_collected"],
            "collected_std": line["eval_collected_std"],
            "grasp_success": round(line["eval_grasp_success"], 4),
            "attempts": line["attempts"],
            "pseudo_reset_steps": line["pseudo_reset_steps"],
            "interventions": line["interventions"],
            "robot_minutes": round(line["robot_minutes"], 1),
            "seconds": line["seconds"],
            "command": command,
        }
        for line in read_metrics(folder / "metrics.jsonl")
        if "eval_collected" in line
    ]


def save(rows: list[dict[str, Any]], path: Path) -> None:
    """Replace the rows of these runs and seeds in the CSV."""
    new = {(row["run"], str(row["seed"])) for row in rows}
    kept = [row for row in load(path) if (row["run"], row["seed"]) not in new]
    everything = [*kept, *rows]
    everything.sort(key=lambda row: (list(RUNS).index(row["run"]), int(row["seed"]), int(row["step"])))
    write_table(everything, path, COLUMNS)


def load(path: Path) -> list[dict[str, str]]:
    """The rows of the CSV of runs that there still are, none if there is no such file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [row for row in csv.DictReader(file) if row["run"] in RUNS and row.get("robot_minutes")]


def show(rows: list[dict[str, str]]) -> None:
    """Print a table: a line a run and step, with the mean over seeds and the worst one."""
    print(
        f"{'run':22}{'step':>7}{'seeds':>7}{'collected':>11}{'worst':>8}{'grasps':>8}{'interventions':>15}"
        f"{'robot min':>11}{'s':>7}"
    )
    for run in RUNS:
        for step in sorted({int(row["step"]) for row in rows if row["run"] == run}):
            some = [row for row in rows if row["run"] == run and int(row["step"]) == step]
            share = np.array([float(row["collected"]) for row in some])
            counts = ("attempts", "interventions", "robot_minutes", "seconds")
            mean = {key: np.mean([float(row[key]) for row in some]) for key in counts}
            print(
                f"{run:22}{step:7}{len(some):7}{share.mean():11.1%}{share.min():8.1%}{mean['attempts']:8.0f}"
                f"{mean['interventions']:15.1f}{mean['robot_minutes']:11.0f}{mean['seconds']:7.0f}"
            )


def plot(rows: list[dict[str, str]], path: Path) -> None:
    """One curve a run, the mean over seeds, every seed faintly; the first room left, the others right."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(13, 5), layout="constrained", sharey=True)
    for run in [run for run in RUNS if any(row["run"] == run for row in rows)]:
        axes = panels[0 if "room=no_obstacles" in RUNS[run] else 1]
        mine = [row for row in rows if row["run"] == run]
        seeds = sorted({row["seed"] for row in mine})
        curves = np.array(
            [[(float(r["robot_minutes"]), 100 * float(r["collected"])) for r in mine if r["seed"] == s] for s in seeds]
        )
        means = curves.mean(axis=0).T
        (line,) = axes.plot(*means, marker="o", label=f"{run}, {len(seeds)} seed{'s' * (len(seeds) > 1)}")
        for curve in curves:
            axes.plot(*curve.T, color=line.get_color(), alpha=0.25, linewidth=1, marker=".")
    panels[0].axhline(90, color="grey", linestyle=":", label="the paper's, after 30,000 steps")
    panels[0].set(title="no_obstacles", ylabel="objects collected, %", ylim=(0, 102))
    panels[1].set(title="the other rooms")
    for axes in panels:
        axes.set(xlabel="minutes of the robot's time", xscale="log")
        axes.legend(loc="center right", fontsize=8)
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Train, write the CSV, print the table, draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", nargs="*", default=[], choices=list(RUNS))
    parser.add_argument("--seeds", nargs="*", type=int, default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=1, help="trainings at the same time")
    parser.add_argument("--output", type=Path, default=Path("outputs/learning_curves"))
    parser.add_argument("--plot", action="store_true", help="draw docs/learning_curves.png")
    arguments = parser.parse_args()
    jobs = [(run, seed) for run in arguments.runs for seed in arguments.seeds]
    with ThreadPoolExecutor(arguments.jobs) as pool:
        folders = pool.map(lambda job: train(job[0], job[1], arguments.output), jobs)
        for (run, seed), folder in zip(jobs, folders, strict=True):
            save(read(run, seed, folder), RESULTS)
    rows = load(RESULTS)
    show(rows)
    if arguments.plot:
        plot(rows, PICTURE)


if __name__ == "__main__":
    main()
