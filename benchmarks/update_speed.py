"""What decisions and updates cost on one core, by part, without physics.

    python benchmarks/update_speed.py --policies relmm paper_small

`ensemble`, `memory` and `planning` are the parts of a decision to drive on; `navigation step` and `attempt` are what a
training step of either kind takes: look, decide, store, learn.
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"  # read when numpy is imported

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from csv_table import write_table
from grasp_learning import POLICIES, make_policy
from numpy.typing import NDArray

from relmm.features import ACTION_NAMES, FRONT, Phase
from relmm.learning.actor import state_vector
from relmm.policies.controller import Row
from relmm.policies.learning import Learner, LearningPolicy
from relmm.policies.pseudo_reset import drive_anywhere
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy
from relmm.sim.config_locobot_sim import LocobotSimConfig
from relmm.sim.locobot_sim import LocobotSim

OUTPUT = Path(__file__).parent / "results" / "update_speed.csv"
ROOM = "diverse"
WARM_UP = 300  # steps of either kind before the clock runs; the paper's policy learns from so many on

Senses = tuple[NDArray[np.uint8], NDArray[np.float32]]
Decide = Callable[[Row], dict[str, float]]


def drive_about(count: int) -> list[Senses]:
    """What a robot sees on a random drive."""
    robot, rng = LocobotSim(LocobotSimConfig(room=ROOM, seed=0)), np.random.default_rng(0)
    robot.connect()
    seen = []
    for _ in range(count):
        robot.send_action(drive_anywhere(rng))
        observation = robot.get_observation()
        seen.append((observation[FRONT], state_vector(observation)))
    robot.disconnect()
    return seen


class Drive:
    """A policy that learns as it goes along a recorded drive; all times in ms."""

    def __init__(self, policy: LearningPolicy, learner: Learner) -> None:
        self.policy, self.learner, self.row = policy, learner, Row(np.random.default_rng(0))
        self.times: dict[str, list[float]] = {}

    def fill(self, image: NDArray[np.uint8], state: NDArray[np.float32]) -> None:
        """Something to learn from."""
        self.policy.observe(image, state, self.row)
        self._act(self.policy.attempt, image, state)
        self._act(self.policy.navigate, image, state)

    def go(self, seen: list[Senses]) -> None:
        """Both kinds of training steps at each place."""
        for image, state in seen:
            looking = self._time("observe", self.policy.observe, image, state, self.row)
            if isinstance(self.policy, ReLMMPolicy):
                ensemble = self.policy.grasping
                self._time("ensemble", ensemble.look, ensemble.to_pictures(image))
            deciding = self._time("attempt decision", self._act, self.policy.attempt, image, state)
            learning = self._time("attempt update", self.learner.update_grasping, Phase.LEARNING)
            self.times.setdefault("attempt", []).append(looking + deciding + learning)
            deciding = self._time("navigate decision", self._act, self.policy.navigate, image, state)
            learning = self._time("navigate update", self.learner.update_navigation)
            self.times.setdefault("navigate", []).append(looking + deciding + learning)

    def _act(self, act: Decide, image: NDArray[np.uint8], state: NDArray[np.float32]) -> None:
        action = act(self.row)
        values = np.array([action[name] for name in ACTION_NAMES], np.float32)
        self.learner.add(image, state, values, bool(self.row.rng.random() < 0.3), Phase.LEARNING)

    def _time(self, name: str, action: Callable[..., object], *arguments: object) -> float:
        start = time.perf_counter()
        action(*arguments)
        self.times.setdefault(name, []).append(1000 * (time.perf_counter() - start))
        return self.times[name][-1]

    def mean(self, name: str) -> float:
        """Of what took place so far; some clocks tick every 4 ms only, so a median would not do."""
        return float(np.mean(self.times[name])) if name in self.times else float("nan")


def measure(name: str, seen: list[Senses]) -> dict[str, object]:
    """A row of the table."""
    policy = make_policy(name, min_attempts_to_update=1)
    policy.sampling = True
    drive = Drive(policy, policy.make_learner(seed=0, capacity=10_000))
    for number in range(WARM_UP):
        drive.fill(*seen[number % len(seen)])
    drive.go(seen)
    ensemble, looking, planning = drive.mean("ensemble"), drive.mean("observe"), drive.mean("navigate decision")
    row = {
        "ensemble_ms": ensemble if np.isfinite(ensemble) else looking,
        "memory_ms": looking - ensemble if np.isfinite(ensemble) else 0.0,
        "planning_ms": planning,
        "decision_ms": looking + planning,
        "grasp_updates_ms": drive.mean("attempt update"),
        "navigation_updates_ms": drive.mean("navigate update"),
        "navigation_step_ms": drive.mean("navigate"),
        "attempt_ms": drive.mean("attempt"),
    }
    parameters = sum(weight.numel() for weight in policy.parameters() if weight.requires_grad)
    return {"policy": name, **{key: round(value, 1) for key, value in row.items()}, "parameters": parameters}


def main() -> None:
    """Measure, print and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policies", nargs="*", default=["relmm", "paper_small"], choices=POLICIES)
    parser.add_argument("--places", type=int, default=60, help="to measure at")
    parser.add_argument("--output", type=Path, default=OUTPUT)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    seen = drive_about(arguments.places)
    rows = [measure(name, seen) for name in arguments.policies]
    for row in rows:
        print(", ".join(f"{key} {value}" for key, value in row.items()))
    write_table(rows, arguments.output)


if __name__ == "__main__":
    main()
