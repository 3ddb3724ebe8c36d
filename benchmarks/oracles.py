"""Which part of a learned policy holds it back: each in turn is replaced by one that knows where the objects are.

    python benchmarks/oracles.py --room obstacles \\
        --policies outputs/learning_curves/obstacles/seed_*/checkpoints/last/pretrained_model

Seeds 50000 and up are for tuning, and so for finding out. How much of what then remains is physics, the privileged
controller of sim_difficulty.py says.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from baselines import rates
from lerobot.configs.policies import PreTrainedConfig
from numpy.typing import NDArray
from privileged_controller import Controller, graspable

import relmm.plugin  # noqa: F401
from relmm.commands.evaluate import EpisodeScore, run_episode
from relmm.commands.policies import make_actor
from relmm.features import xy_to_cell
from relmm.policies.controller import Row
from relmm.policies.relmm.memory import PLACES, FloorMemory
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy
from relmm.sim.env import RelmmRoomEnv

RADIUS = 0.05  # m, of an object on the true map


def know_grasps(policy: ReLMMPolicy, env: RelmmRoomEnv) -> None:
    """The gate, and where to grasp: it grasps what is in reach, and nothing else."""

    def look(row: Row) -> None:
        mind, body = policy.mind(row), env.robot.body
        mind.mean, mind.std = torch.zeros_like(mind.mean), torch.zeros_like(mind.std)
        for number in graspable(body):
            mind.mean[0, xy_to_cell(*body.truth.objects_in_robot_frame()[number, :2])] = 1

    _after_each_look(policy, look)


def know_map(policy: ReLMMPolicy, env: RelmmRoomEnv) -> None:
    """The remembered floor promises success where things are, also behind obstacles, and nowhere else."""

    def look(row: Row) -> None:
        floor = policy.mind(row).floor
        floor.success = lambda std_weight: _true_success(floor, env)  # type: ignore[method-assign]

    _after_each_look(policy, look)


def _true_success(floor: FloorMemory, env: RelmmRoomEnv) -> NDArray[np.float32]:
    truth = env.robot.body.truth
    left = np.delete(truth.objects_in_robot_frame()[:, :2], truth.in_basket(), axis=0)
    gaps = np.full(PLACES.shape[:2], np.inf)
    for place in floor.to_map(left):
        gaps = np.minimum(gaps, np.linalg.norm(PLACES - place, axis=-1))
    discs = np.where(gaps < RADIUS, 1 - 0.2 * gaps / RADIUS, 0)  # a little less at the edge: one peak each
    return np.where(floor.left_alone, 0, discs).astype(np.float32)


def drive_by_truth(policy: ReLMMPolicy, env: RelmmRoomEnv) -> None:
    """The privileged controller drives."""

    def navigate(row: Row) -> dict[str, float]:
        controller: Controller = row.memory.setdefault("controller", Controller(env.robot.body))
        return controller.drive()

    policy.navigate = navigate  # type: ignore[method-assign]


def _after_each_look(policy: ReLMMPolicy, look: Callable[[Row], None]) -> None:
    observe = policy.observe

    def knowing(image: NDArray[np.uint8], state: NDArray[np.float32], row: Row) -> None:
        observe(image, state, row)
        look(row)

    policy.observe = knowing  # type: ignore[method-assign]


Part = Callable[[ReLMMPolicy, RelmmRoomEnv], None]
SWAPS: dict[str, tuple[Part, ...]] = {
    "nothing": (),
    "gate": (know_grasps,),
    "map": (know_map,),
    "driving": (drive_by_truth,),
    "gate, map": (know_grasps, know_map),
    "gate, driving": (know_grasps, drive_by_truth),
}


def evaluate(folder: Path, room: str, swap: str, seeds: range) -> list[EpisodeScore]:
    """One policy with some of its parts replaced."""
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path, config.device = folder, "cpu"
    actor, env = make_actor(config), RelmmRoomEnv(room=room)
    for replace in SWAPS[swap]:
        replace(actor.policy, env)
    scores = [run_episode(env, actor, seed, video=None) for seed in seeds]
    env.close()
    return scores


def main() -> None:
    """Print a table and replace the room's rows in a CSV with a row an episode."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policies", type=Path, nargs="+", required=True, help="folders of `relmm` policies")
    parser.add_argument("--room", required=True)
    parser.add_argument("--swaps", nargs="+", choices=list(SWAPS), default=list(SWAPS), help="of the parts")
    parser.add_argument("--episodes", type=int, default=5, help="of each policy")
    parser.add_argument("--seed", type=int, default=50000, help="of the first episode")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/oracles.csv"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    seeds = range(arguments.seed, arguments.seed + arguments.episodes)
    rows: list[tuple[object, ...]] = [("room", "replaced", "policy", *EpisodeScore.__dataclass_fields__)]
    if arguments.output.exists():
        kept = list(csv.reader(arguments.output.open(newline="")))[1:]
        rows += [tuple(row) for row in kept if row[0] != arguments.room]
    print(f"{'room':16}{'replaced':20}{'collected':>18}{'successful':>12}{'judged right':>14}")
    for swap in arguments.swaps:
        by_policy = [evaluate(folder, arguments.room, swap, seeds) for folder in arguments.policies]
        scores = [score for scores in by_policy for score in scores]
        share, success, judged = rates(scores)
        print(
            f"{arguments.room:16}{swap:20}{share.mean():8.1f} ± {share.std() / len(share) ** 0.5:3.1f} s.e."
            f"{success:11.0f}%{judged:13.1f}%",
            flush=True,
        )
        rows += [
            (arguments.room, swap, number, *score.__dict__.values())
            for number, its_scores in enumerate(by_policy)
            for score in its_scores
        ]
    with arguments.output.open("w", newline="") as file:
        csv.writer(file).writerows(rows)


if __name__ == "__main__":
    main()
