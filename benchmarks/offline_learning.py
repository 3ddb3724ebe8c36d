"""What `lerobot-train` makes of a recorded dataset: ReLMM learns offline, and is compared with who recorded it.

    python benchmarks/offline_learning.py

`relmm_scripted` records (seed 100 and up), LeRobot trains, each checkpoint cleans rooms that nobody has seen (seeds 0
to 9), and so do the recorder and `relmm_random`. What is in --output already is not made again. All was tuned with
training seed 1001 and rooms from seed 50000 on.
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
from csv_table import write_table
from lerobot.configs.policies import PreTrainedConfig

import relmm.plugin  # noqa: F401
from relmm.commands.evaluate import EpisodeScore
from relmm.policies.random.configuration_random import RelmmRandomConfig
from relmm.policies.scripted.configuration_scripted import RelmmScriptedConfig

RESULTS = Path(__file__).parent / "results" / "offline_learning.csv"
PICTURE = Path(__file__).parents[1] / "docs" / "offline_learning.png"
SEEDS = range(10)
DATASET = "--dataset.repo_id=me/scripted --dataset.root=dataset"
RECORD = (
    f"relmm-record --robot.type=locobot_sim --policy.type=relmm_scripted {DATASET} --pseudo_reset_steps=5 --seed=100"
)
TRAIN = (
    f"lerobot-train --policy.type=relmm --policy.device=cpu --policy.push_to_hub=false {DATASET} --batch_size=16 "
    "--num_workers=1 --save_freq=500 --env_eval_freq=0"
)
# What recording and training need besides, at most 3,000 frames each.
ROOMS = {
    # Few objects, so that the recorder drives far, as it has to when a room is nearly clean.
    "no_obstacles": ("--robot.num_objects=5 --dataset.num_episodes=100", "--steps=2000"),
    "obstacles_rugs": ("--dataset.num_episodes=70", "--steps=2000"),
}
COLUMNS = ("room", "policy", "training_seed", "updates", *EpisodeScore.__dataclass_fields__)


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


def learn(room: str, seeds: list[int], folder: Path) -> list[dict[str, str]]:
    """Record, train and evaluate in a room: rows of the CSV, one an episode."""
    folder.mkdir(parents=True, exist_ok=True)
    record, train = ROOMS[room]
    if not (folder / "dataset").exists():
        run(f"{RECORD} --robot.room={room} {record}", folder)
    policies: list[tuple[str, int, int, PreTrainedConfig]] = [
        ("relmm_scripted", 0, 0, RelmmScriptedConfig(device="cpu")),
        ("relmm_random", 0, 0, RelmmRandomConfig(device="cpu")),
    ]
    for seed in seeds:
        trained = folder / f"seed_{seed}"
        if not trained.exists():
            run(f"{TRAIN} {train} --seed={seed} --output_dir={trained.name}", folder)
        policies += [("relmm", seed, at, config) for at, config in checkpoints(trained).items()]
    return [
        dict(zip(COLUMNS, map(str, (room, name, seed, at, *score.__dict__.values())), strict=True))
        for name, seed, at, config in policies
        for score in evaluate(config, room, SEEDS)
    ]


def save(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """Replace the rows of these rooms in the CSV; all that it holds then."""
    new = {row["room"] for row in rows}
    if RESULTS.exists():
        with RESULTS.open(newline="") as file:
            rows = [*(row for row in csv.DictReader(file) if row["room"] not in new), *rows]
    rows.sort(key=lambda row: list(ROOMS).index(row["room"]))
    write_table(rows, RESULTS, COLUMNS)
    return rows


def curves(rows: list[dict[str, str]]) -> dict[tuple[str, str, str], dict[int, list[EpisodeScore]]]:
    """Episodes by room, policy and training seed, and by update."""
    found: dict[tuple[str, str, str], dict[int, list[EpisodeScore]]] = {}
    for row in rows:
        curve = found.setdefault((row["room"], row["policy"], row["training_seed"]), {})
        values = [float(row[name]) for name in EpisodeScore.__dataclass_fields__]
        curve.setdefault(int(row["updates"]), []).append(EpisodeScore(*values))  # type: ignore[arg-type]
    return found


def collected(scores: list[EpisodeScore]) -> np.ndarray:
    """Share of the objects, %, by episode."""
    return np.array([100 * score.collected / score.total for score in scores])


def show(rows: list[dict[str, str]]) -> None:
    """Print a line for each policy."""
    print(f"{'room':16}{'policy':16}{'seed':>5}{'updates':>9}{'collected':>16}{'worst':>8}{'grasps':>8}{'grasped':>9}")
    for (room, name, seed), curve in curves(rows).items():
        for at, scores in curve.items():
            share, grasps = collected(scores), sum(score.grasps for score in scores)
            grasped = sum(score.picked_up for score in scores) / grasps
            print(
                f"{room:16}{name:16}{seed:>5}{at:9}{share.mean():9.1f} ± {share.std():4.1f}{share.min():8.1f}"
                f"{grasps / len(scores):8.1f}{grasped:9.1%}"
            )


def plot(rows: list[dict[str, str]]) -> None:
    """What was collected, by update, beside who recorded and who does anything."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, len(ROOMS), figsize=(10, 4), sharey=True, layout="constrained")
    for axes, room in zip(panels, ROOMS, strict=True):
        for (where, name, seed), curve in curves(rows).items():
            if where != room:
                continue
            share = [collected(scores).mean() for scores in curve.values()]
            if name == "relmm":
                axes.plot(list(curve), share, marker="o", label=f"relmm, seed {seed}")
            else:
                axes.axhline(share[0], color="grey", linestyle=":" if name == "relmm_random" else "--", label=name)
        axes.set(title=room, xlabel="updates", ylim=(0, 102))
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("objects collected, %")
    panels[0].legend(loc="center right")
    figure.savefig(PICTURE, dpi=100)


def main() -> None:
    """Record, train, evaluate; print a table, write a CSV with a row an episode, and draw the curve."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", nargs="*", default=list(ROOMS), choices=list(ROOMS))
    parser.add_argument("--seeds", nargs="*", type=int, default=[0], help="of trainings")
    parser.add_argument("--output", type=Path, default=Path("outputs/offline_learning"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[dict[str, str]] = []
    for room in arguments.rooms:
        rows = save(learn(room, arguments.seeds, arguments.output / room))
    show(rows)
    plot(rows)


if __name__ == "__main__":
    main()
