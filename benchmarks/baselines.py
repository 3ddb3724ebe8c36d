"""How much of each room the controllers without learning collect.

    python benchmarks/baselines.py --episodes 10 --seed 0

Seeds 0..99 are for reporting; the scripted controller was tuned on no_obstacles with seeds from 1000 on.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from numpy.typing import NDArray

import relmm.plugin  # noqa: F401
from relmm.commands.evaluate import EpisodeScore, run_episode
from relmm.commands.policies import make_actor
from relmm.policies.controller import ControllerConfig
from relmm.policies.random.configuration_random import RelmmRandomConfig
from relmm.policies.scripted.configuration_scripted import RelmmScriptedConfig
from relmm.sim.env import RelmmRoomEnv

ROOMS = ("no_obstacles", "obstacles", "diverse", "obstacles_rugs")
POLICIES: dict[str, type[ControllerConfig]] = {"relmm_random": RelmmRandomConfig, "relmm_scripted": RelmmScriptedConfig}


def evaluate(config: PreTrainedConfig, room: str, seeds: range) -> list[EpisodeScore]:
    """One policy in one room, an episode a seed, as `relmm-eval` does it."""
    actor, env = make_actor(config), RelmmRoomEnv(room=room)
    scores = [run_episode(env, actor, seed, video=None) for seed in seeds]
    env.close()
    return scores


def rates(scores: list[EpisodeScore]) -> tuple[NDArray[np.floating], float, float]:
    """What each episode collected, how many attempts were successful, and judged rightly by the robot, all in %."""
    grasps = sum(score.grasps for score in scores) or np.nan
    lifted = sum(score.picked_up for score in scores)
    wrong = sum(abs(score.picked_up - score.picked_up_judged) for score in scores)
    share = 100 * np.array([score.collected / score.total for score in scores])
    return share, 100 * lifted / grasps, 100 * (1 - wrong / grasps)


def main() -> None:
    """Print a table and write a CSV with a row an episode."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0, help="of the first episode")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/baselines.csv"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    seeds = range(arguments.seed, arguments.seed + arguments.episodes)
    rows = []
    print(f"{'policy':16}{'room':16}{'collected':>16}{'grasp success':>16}{'judged right':>14}")
    for policy in POLICIES:
        for room in ROOMS:
            scores = evaluate(POLICIES[policy](device="cpu"), room, seeds)
            share, success, judged = rates(scores)
            print(
                f"{policy:16}{room:16}{share.mean():9.1f} ± {share.std():4.1f}{success:15.1f}%{judged:13.1f}%",
                flush=True,
            )
            rows += [(policy, room, *score.__dict__.values()) for score in scores]
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    with arguments.output.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("policy", "room", *EpisodeScore.__dataclass_fields__))
        writer.writerows(rows)


if __name__ == "__main__":
    main()
