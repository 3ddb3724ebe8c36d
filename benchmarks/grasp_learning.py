"""How many attempts the grasp ensemble needs: the stationary curriculum alone, from scratch.

Every so many attempts the greedy choice (best cell of the ensemble's mean) is tried on held-out placements: rooms of
other seeds, a random one of their objects at a random place of the grasp area. Success is ground truth here.

    python benchmarks/grasp_learning.py --rooms no_obstacles diverse --attempts 200 --every 25 --seeds 0 1 2
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"  # read when numpy is imported

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from csv_table import write_table
from tqdm import tqdm

import relmm.plugin  # noqa: F401
from relmm.commands.policies import make_actor
from relmm.commands.presets import PRESETS, load_preset
from relmm.features import FRONT, GRASP_X, GRASP_Y
from relmm.learning.actor import state_vector
from relmm.learning.life import Life
from relmm.learning.progress import Progress
from relmm.learning.trainer import Trainer
from relmm.policies.controller import Row
from relmm.policies.learning import LearningConfig, LearningPolicy
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.sim.config_locobot_sim import LocobotSimConfig
from relmm.sim.locobot_sim import LocobotSim
from relmm.sim.person import Person

OUTPUT = Path(__file__).parent / "results" / "grasp_learning.csv"
HELD_OUT_SEED = 7000
_EDGE = 0.01  # m, of the grasp area that placements leave out
POLICIES = ("relmm", *PRESETS)


def make_policy(name: str, **settings: Any) -> LearningPolicy:
    """`relmm`, or `relmm_paper` with one of its presets, ready to learn."""
    config: LearningConfig = ReLMMConfig() if name == "relmm" else load_preset(name)
    for key, value in {"device": "cpu", **settings}.items():
        setattr(config, key, value)
    policy = make_actor(config).policy
    assert isinstance(policy, LearningPolicy)
    policy.train()
    return policy


class HeldOut:
    """Placements that training never sees."""

    def __init__(self, room: str, count: int) -> None:
        self.robot = LocobotSim(LocobotSimConfig(room=room, seed=HELD_OUT_SEED))
        self.robot.connect()
        self.count = count

    def success(self, policy: LearningPolicy) -> float:
        """Share of the placements at which the greedy grasp lifts something."""
        rng = np.random.default_rng(HELD_OUT_SEED)
        low, high = np.array([GRASP_X[0], GRASP_Y[0]]) + _EDGE, np.array([GRASP_X[1], GRASP_Y[1]]) - _EDGE
        lifted, policy.sampling = 0, False
        for index in range(self.count):
            self.robot.reset(HELD_OUT_SEED + index)
            self.robot.body.put_object(int(rng.integers(self.robot.body.room.num_objects)), rng.uniform(low, high))
            self.robot.skills.forget_picture()
            observation, row = self.robot.get_observation(), Row(rng)
            policy.observe(observation[FRONT], state_vector(observation), row)
            self.robot.send_action(policy.attempt(row))
            lifted += self.robot.body.truth.held()
        policy.sampling = True
        return lifted / self.count


def run(room: str, name: str, seed: int, attempts: int, every: int, held_out: HeldOut) -> list[dict[str, object]]:
    """Practise, and try the held-out placements every so often; a row each time."""
    robot = LocobotSim(LocobotSimConfig(room=room, seed=seed))
    robot.connect()
    policy, progress = make_policy(name, seed=seed, num_stationary=attempts), Progress()
    learner = policy.make_learner(seed, capacity=10_000)
    trainer = Trainer(
        Life(robot, [learner, progress], robot.seconds, 250, lambda: False),
        policy,
        learner,
        curriculum="stationary",
        pseudo_reset_steps=0,
        rng=np.random.default_rng(seed),
        put_in_reach=Person(robot, np.random.default_rng([seed, 1])).put_in_reach,
        progress=progress,
    )
    rows: list[dict[str, object]] = []
    for attempt in tqdm(range(1, attempts + 1), desc=f"{name} {room} {seed}", disable=None):
        trainer.stationary_attempt()
        if attempt % every == 0:
            row = {"policy": name, "room": room, "seed": seed, "attempts": attempt, "successes": progress.successes}
            rows.append(row | {"greedy": held_out.success(policy), "interventions": progress.interventions})
    robot.disconnect()
    return rows


def main() -> None:
    """Practise, print a table, write a CSV."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", nargs="*", default=["no_obstacles", "diverse"])
    parser.add_argument("--policies", nargs="*", default=["relmm"], choices=POLICIES)
    parser.add_argument("--seeds", nargs="*", type=int, default=[0, 1, 2])
    parser.add_argument("--attempts", type=int, default=200)
    parser.add_argument("--every", type=int, default=25)
    parser.add_argument("--placements", type=int, default=100)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    print(f"{'policy':14}{'room':16}{'seed':>5}{'attempts':>10}{'successes':>11}{'greedy':>9}{'interventions':>15}")
    for room in arguments.rooms:
        held_out = HeldOut(room, arguments.placements)
        for name in arguments.policies:
            for seed in arguments.seeds:
                new = run(room, name, seed, arguments.attempts, arguments.every, held_out)
                for row in new:
                    print(
                        f"{row['policy']:14}{row['room']:16}{row['seed']:5}{row['attempts']:10}{row['successes']:11}"
                        f"{row['greedy']:9.0%}{row['interventions']:15}",
                        flush=True,
                    )
                rows += new
    write_table(rows, arguments.output)


if __name__ == "__main__":
    main()
