"""What `lerobot-train` makes of a recorded dataset: ReLMM learns offline, and is compared with who recorded it.

    python benchmarks/offline_learning.py

`relmm_scripted` records (seed 100 and up), LeRobot trains, each checkpoint cleans rooms that nobody has seen (seeds 0
to 9), and so do the recorder and `relmm_random`. What is in --output already is not made again.
"""

from __future__ import annotations

import argparse
import csv
import os
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch
from baselines import evaluate
from lerobot.configs.policies import PreTrainedConfig

import relmm.plugin  # noqa: F401
from relmm.commands.evaluate import EpisodeScore
from relmm.policies.random.configuration_random import RelmmRandomConfig
from relmm.policies.scripted.configuration_scripted import RelmmScriptedConfig

RESULTS = Path(__file__).parent / "results" / "offline_learning.csv"
PICTURE = Path(__file__).parents[1] / "docs" / "offline_learning.png"
ROOM = "no_obstacles"
SEEDS = range(10)
DATASET = "--dataset.repo_id=me/scripted --dataset.root=dataset"
RECORD = (
    f"relmm-record --robot.type=locobot_sim --robot.room={ROOM} --policy.type=relmm_scripted {DATASET} "
    "--dataset.num_episodes=100 --pseudo_reset_steps=5 --seed=100"
)
TRAIN = (
    f"lerobot-train --policy.type=relmm --policy.device=cpu --policy.push_to_hub=false {DATASET} --batch_size=16 "
    "--num_workers=1 --steps=2000 --save_freq=500 --env_eval_freq=0"
)


def run(command: str, folder: Path) -> None:
    """A command with this environment's programs, in a folder."""
    print(command, flush=True)
    program, *arguments = shlex.split(command)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}
    subprocess.run([Path(sys.executable).parent / program, *arguments], check=True, cwd=folder, env=environment)


def checkpoints(folder: Path) -> dict[int, PreTrainedConfig]:
    """The policies that a training saved, by update."""
    found = {}
    for saved in sorted(folder.glob("checkpoints/[0-9]*/pretrained_model")):
        config = PreTrainedConfig.from_pretrained(saved)
        config.pretrained_path = saved
        found[int(saved.parent.name)] = config
    return found


def plot(rows: list[tuple[str, int, int, list[EpisodeScore]]], path: Path) -> None:
    """What was collected and how many steps an object took, by update, beside who recorded and who does anything."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for axes, (column, factor, label) in zip(
        panels, ((0, 100, "objects collected, %"), (4, 1, "navigation steps per object")), strict=True
    ):
        for seed in sorted({seed for name, seed, _, _ in rows if name == "relmm"}):
            curve = [
                (at, factor * mean(scores, column)) for name, s, at, scores in rows if (name, s) == ("relmm", seed)
            ]
            axes.plot(*zip(*curve, strict=True), marker="o", label=f"relmm, seed {seed}")
        for (name, _, _, scores), style in zip(rows, ("--", ":"), strict=False):
            axes.axhline(factor * mean(scores, column), color="grey", linestyle=style, label=name)
        axes.set(xlabel="updates", ylabel=label, ylim=(0, None))
        axes.grid(alpha=0.3)
    panels[1].set_yscale("log")
    panels[1].set_ylim(5, None)
    panels[0].legend(loc="center right")
    figure.savefig(path, dpi=100)


def mean(scores: list[EpisodeScore], column: int) -> float:
    """Of one column of what an episode gives."""
    return float(np.mean([score.row()[column] for score in scores]))


def main() -> None:
    """Record, train, evaluate; print a table, write a CSV with a row an episode, and draw the curve."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="*", type=int, default=[0], help="of trainings")
    parser.add_argument("--output", type=Path, default=Path("outputs/offline_learning"))
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    if not (arguments.output / "dataset").exists():
        run(RECORD, arguments.output)
    policies: list[tuple[str, int, int, PreTrainedConfig]] = [
        ("relmm_scripted", 0, 0, RelmmScriptedConfig(device="cpu")),
        ("relmm_random", 0, 0, RelmmRandomConfig(device="cpu")),
    ]
    for seed in arguments.seeds:
        trained = arguments.output / f"seed_{seed}"
        if not trained.exists():
            run(f"{TRAIN} --seed={seed} --output_dir={trained.name}", arguments.output)
        policies += [("relmm", seed, at, config) for at, config in checkpoints(trained).items()]
    torch.set_num_threads(1)
    rows = [(name, seed, at, evaluate(config, ROOM, SEEDS)) for name, seed, at, config in policies]

    print(f"{'policy':16}{'seed':>5}{'updates':>9}{'collected':>16}{'worst':>8}{'steps/object':>14}{'grasped':>9}")
    for name, seed, at, scores in rows:
        share = 100 * np.array([score.collected / score.total for score in scores])
        grasped = sum(score.picked_up for score in scores) / sum(score.grasps for score in scores)
        print(
            f"{name:16}{seed:5}{at:9}{share.mean():9.1f} ± {share.std():4.1f}{share.min():8.1f}{mean(scores, 4):14.1f}"
            f"{grasped:9.1%}"
        )
    with RESULTS.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("policy", "training_seed", "updates", *EpisodeScore.__dataclass_fields__))
        writer.writerows((n, s, at, *score.__dict__.values()) for n, s, at, scores in rows for score in scores)
    plot(rows, PICTURE)


if __name__ == "__main__":
    main()
