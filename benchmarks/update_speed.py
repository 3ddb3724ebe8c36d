"""What one update and one decision of each preset cost, on one core.

python benchmarks/update_speed.py --presets fast paper_small
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"  # read when numpy is imported

import argparse
import csv
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

import relmm.plugin  # noqa: F401
from relmm.commands.presets import PRESETS, load_preset
from relmm.features import Phase, Skill, cell_to_xy
from relmm.learning.learner import Learner
from relmm.learning.replay import Replay
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy
from relmm.policies.relmm.searching import Search

OUTPUT = Path(__file__).parent / "results" / "update_speed.csv"
FRAMES = 600


def filled_replay(rng: np.random.Generator) -> Replay:
    """Random pictures, every third frame an attempt."""
    replay = Replay(1000)
    for number in range(FRAMES):
        skill = Skill.GRASP if number % 3 == 2 else Skill.NAVIGATE
        x, y = cell_to_xy(int(rng.integers(225)))
        picture = rng.integers(0, 256, (100, 100, 3), np.uint8)
        replay.add(picture, (0.1, 10.0), [0.2, 10.0, skill, x, y], bool(rng.random() < 0.3), Phase.LEARNING)
    return replay


def milliseconds(action: Callable[[], object], repeats: int) -> float:
    """Median time of a call."""
    action()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return 1000 * float(np.median(times))


def measure(preset: str, repeats: int) -> dict[str, object]:
    """A row of the table."""
    config = load_preset(preset)
    config.device = "cpu"
    config.grasp_updates = config.navigation_updates = 1
    config.min_attempts_to_update = config.min_steps_to_update = 1
    rng = np.random.default_rng(0)
    policy, replay = ReLMMPolicy(config), filled_replay(rng)
    learner = Learner(policy, replay, seed=0)
    pictures = policy.to_pictures(replay.pictures(np.array([0]))[0])
    learner.update_navigation()  # fills the maps

    def update_navigation() -> None:
        learner.maps.version += 1  # as after an attempt: all maps are outdated
        learner.update_navigation()

    row = {
        "navigation_update_ms": milliseconds(update_navigation, repeats),
        "grasp_update_ms": milliseconds(lambda: learner.update_grasping(Phase.LEARNING), repeats),
        "decision_ms": milliseconds(
            lambda: (policy.look(pictures), policy.navigate(pictures, 0.0, Search(), None)), repeats
        ),
    }
    batches = {"navigation_batch": config.navigation_batch_size, "grasp_batch": config.grasp_batch_size}
    parameters = sum(weight.numel() for weight in policy.parameters() if weight.requires_grad)
    return {"preset": preset, **batches, **{k: round(v, 1) for k, v in row.items()}, "parameters": parameters}


def main() -> None:
    """Measure, print and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", nargs="*", default=["fast", "paper_small"], choices=PRESETS)
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = [measure(preset, arguments.repeats) for preset in arguments.presets]
    for row in rows:
        print(", ".join(f"{key} {value}" for key, value in row.items()))
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    with arguments.output.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
