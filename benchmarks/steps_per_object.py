"""How fast rooms are cleaned: navigation steps an object until 95 % are collected, beside the privileged controller.

    python benchmarks/steps_per_object.py --rooms no_obstacles obstacles --seeds 0 1 2
    python benchmarks/steps_per_object.py --policies outputs/run/checkpoints/last/pretrained_model --rooms obstacles

Also in rooms that a policy was not trained in. Its lines name the folder that holds `checkpoints`.
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"  # read when numpy is imported

import argparse
import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from csv_table import write_table
from lerobot.configs.policies import PreTrainedConfig
from privileged_controller import Controller

import relmm.plugin  # noqa: F401
from relmm.commands.evaluate import run_episode
from relmm.commands.policies import make_actor
from relmm.features import ACTION_NAMES, STATE_NAMES
from relmm.sim.env import RelmmRoomEnv

OUTPUT = Path(__file__).parent / "results" / "steps_per_object.csv"
ROOMS = ("no_obstacles", "obstacles", "diverse", "obstacles_rugs")
SHARE = 0.95  # of the objects
HOLDING = STATE_NAMES.index("holding.pos")
COLUMNS = ("policy", "room", "seed", "collected", "total", "steps_to_95", "collected_by_then", "steps_per_object")
Infos = list[dict[str, Any]]


def privileged(env: RelmmRoomEnv, seed: int) -> Infos:
    """An episode of the controller that knows where everything is: the room's `info` after each step."""
    infos: Infos = []
    observation, _ = env.reset(seed=seed)
    controller, over = Controller(env.robot.body), False
    while not over:
        action = controller.act(bool(observation["agent_pos"][HOLDING] > 0.5))
        observation, _, terminated, truncated, info = env.step(np.array([action[name] for name in ACTION_NAMES]))
        over = terminated or truncated
        infos.append(info)
    return infos


def policy(folder: Path) -> Callable[[RelmmRoomEnv, int], Infos]:
    """The same of a checkpoint."""
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path, config.device = folder, "cpu"
    actor = make_actor(config)

    def episode(env: RelmmRoomEnv, seed: int) -> Infos:
        infos: Infos = []
        run_episode(env, actor, seed, video=None, show=infos.append)
        return infos

    return episode


def row(who: str, room: str, seed: int, infos: Infos) -> dict[str, Any]:
    """A line of the table; of who does not get so far, all steps count."""
    total = infos[-1]["objects_total"]
    at = next((info for info in infos if info["objects_collected"] >= SHARE * total), infos[-1])
    steps, collected = at["navigation_steps"], at["objects_collected"]
    counts = (infos[-1]["objects_collected"], total, steps, collected, round(steps / max(collected, 1), 2))
    return dict(zip(COLUMNS, (who, room, seed, *counts), strict=True))


def main() -> None:
    """Print a line a room, and replace the rows of these policies, rooms and seeds in the CSV."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--policies", type=Path, nargs="*", default=[], help="the privileged controller if there is none"
    )
    parser.add_argument("--rooms", nargs="*", default=list(ROOMS))
    parser.add_argument("--seeds", nargs="*", type=int, default=list(range(10)))
    parser.add_argument("--output", type=Path, default=OUTPUT)
    arguments = parser.parse_args()
    folders = {f"{path.parents[3].name}/{path.parents[2].name}": path for path in arguments.policies}
    whos = {who: policy(path) for who, path in folders.items()} or {"privileged": privileged}
    rows = list(csv.DictReader(arguments.output.open(newline=""))) if arguments.output.exists() else []
    for room in arguments.rooms:
        env = RelmmRoomEnv(room=room)
        for who, episode in whos.items():
            new = [row(who, room, seed, episode(env, seed)) for seed in arguments.seeds]
            rows = [old for old in rows if (old["policy"], old["room"]) != (who, room)] + new
            share = np.mean([each["collected"] / each["total"] for each in new])
            pace = np.mean([each["steps_per_object"] for each in new])
            print(f"{who:28}{room:16}{share:7.1%} collected, {pace:5.2f} steps an object", flush=True)
        env.close()
        write_table(rows, arguments.output, COLUMNS)


if __name__ == "__main__":
    main()
