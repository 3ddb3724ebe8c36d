"""Which part of a learned policy holds it back: each in turn is replaced by one that knows where the objects are.

    python benchmarks/oracles.py --room obstacles \\
        --policies outputs/learning_curves/fast_obstacles/seed_*/checkpoints/last/pretrained_model

Seeds 50000 and up are for tuning, and so for finding out. How much of what then remains is physics, the privileged
controller of sim_difficulty.py says.
"""

from __future__ import annotations

import argparse
import csv
import math
from collections.abc import Callable
from pathlib import Path

import torch
from baselines import rates
from lerobot.configs.policies import PreTrainedConfig
from privileged_controller import graspable
from torch import Tensor, nn
from torch.nn import functional

import relmm.plugin  # noqa: F401
from relmm.commands.evaluate import EpisodeScore, run_episode
from relmm.commands.policies import make_actor
from relmm.features import DRIVE_PULSE_S, GRASP_X, GRID, MAX_THETA_VEL, MAX_X_VEL, xy_to_cell
from relmm.policies.relmm.encoders import NOTICED, FloorObserver, map_places
from relmm.policies.relmm.grasping import Estimate, GraspEnsemble
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy
from relmm.sim.env import RelmmRoomEnv

RADIUS = 0.055  # m, of an object on the true map
STRAIGHT = 35.0  # deg: to what lies further to the side it turns first


class TrueMap(nn.Module):
    """The policy's observation with the objects where they are, also behind obstacles."""

    def __init__(self, observer: FloorObserver, env: RelmmRoomEnv) -> None:
        super().__init__()
        self._observer, self._env, self._places = observer, env, map_places()
        self._known = functional.adaptive_max_pool2d(observer.known.float()[None], observer.shape[1:])[0] > 0

    def forward(self, images: Tensor, grasping: GraspEnsemble) -> Tensor:
        """As `FloorObserver.forward`, for the one picture of now."""
        observation = self._observer(images, grasping)
        truth = self._env.robot.body.truth
        gone, objects = set(truth.in_basket().tolist()), truth.objects_in_robot_frame()[:, :2]
        left = torch.tensor([xy for number, xy in enumerate(objects.tolist()) if number not in gone]).reshape(-1, 2)
        gaps = (self._places[None] - left[:, :, None, None]).norm(dim=1)
        observation[0, 0] = 255 * (self._known & (gaps < RADIUS).any(dim=0))
        return observation


def know_map(policy: ReLMMPolicy, env: RelmmRoomEnv) -> None:
    """Navigation sees where things are."""
    assert isinstance(policy.observer, FloorObserver)
    policy.observer = TrueMap(policy.observer, env)  # type: ignore[assignment]


def know_grasps(policy: ReLMMPolicy, env: RelmmRoomEnv) -> None:
    """The gate, and where to grasp: it grasps what is in reach, and nothing else."""

    def look(pictures: Tensor) -> Estimate:
        mean = torch.zeros(len(pictures), GRID * GRID)
        body = env.robot.body
        for number in graspable(body):
            mean[0, xy_to_cell(*body.truth.objects_in_robot_frame()[number, :2])] = 1
        return Estimate(mean, torch.zeros_like(mean))

    policy.look = look  # type: ignore[method-assign]


def drive_by_hand(policy: ReLMMPolicy, env: RelmmRoomEnv) -> None:
    """It turns to what is nearest on the map, and goes there; where the map is empty, it turns as the policy would."""
    places, reach = map_places().flatten(1), sum(GRASP_X) / 2

    def act(observations: Tensor, sides: Tensor, rng: torch.Generator | None) -> Tensor:
        seen = places[:, observations[0, 0].flatten() >= NOTICED]
        if seen.shape[1] == 0:
            return torch.tensor([[0.0, float(sides[0])]])
        x, y = seen[:, (seen - torch.tensor([[reach], [0.0]])).norm(dim=0).argmin()].tolist()
        bearing = math.degrees(math.atan2(y, x))
        speed = max(math.hypot(x, y) - reach, 0.0) / DRIVE_PULSE_S if abs(bearing) < STRAIGHT else 0.0
        action = [2 * min(speed / MAX_X_VEL, 1) - 1, bearing / DRIVE_PULSE_S / MAX_THETA_VEL]
        return torch.tensor([action]).clamp(-1, 1)

    policy.navigation.act = act  # type: ignore[method-assign]


Part = Callable[[ReLMMPolicy, RelmmRoomEnv], None]
SWAPS: dict[str, tuple[Part, ...]] = {
    "nothing": (),
    "gate": (know_grasps,),
    "map": (know_map,),
    "driving": (drive_by_hand,),
    "gate, map": (know_grasps, know_map),
    "gate, map, driving": (know_grasps, know_map, drive_by_hand),
}


def evaluate(folder: Path, room: str, swap: str, seeds: range) -> list[EpisodeScore]:
    """One policy with some of its parts replaced."""
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path, config.device = folder, "cpu"
    actor, env = make_actor(config), RelmmRoomEnv(room=room)
    for replace in SWAPS[swap]:
        replace(actor.policy, env)
    scores = [run_episode(env, actor, seed, f"{room} {swap} {seed}", video=None) for seed in seeds]
    env.close()
    return scores


def main() -> None:
    """Print a table and replace the room's rows in a CSV with a row an episode."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policies", type=Path, nargs="+", required=True, help="folders of `fast` policies")
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
