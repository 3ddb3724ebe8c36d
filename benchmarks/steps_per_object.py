"""How fast a room can be cleaned at best: navigation steps an object, until the privileged controller has 95 %.

python benchmarks/steps_per_object.py --rooms no_obstacles obstacles --seeds 0 1 2
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"  # read when numpy is imported

import argparse
import csv
from pathlib import Path

import numpy as np
from privileged_controller import Controller

from relmm.features import ACTION_NAMES, STATE_NAMES
from relmm.sim.env import RelmmRoomEnv

OUTPUT = Path(__file__).parent / "results" / "steps_per_object.csv"
ROOMS = ("no_obstacles", "obstacles", "diverse", "obstacles_rugs")
SHARE, LIMIT = 0.95, 1000  # of the objects, and navigation steps after which it gives up
HOLDING = STATE_NAMES.index("holding.pos")


def clean(env: RelmmRoomEnv, room: str, seed: int) -> dict[str, object]:
    """One room, until enough is in the basket: a row of the table."""
    observation, info = env.reset(seed=seed)
    controller, over = Controller(env.robot.body), False
    while not over and info["objects_collected"] < SHARE * info["objects_total"]:
        action = controller.act(bool(observation["agent_pos"][HOLDING] > 0.5))
        observation, _, terminated, truncated, info = env.step(np.array([action[name] for name in ACTION_NAMES]))
        over = terminated or truncated
    steps, collected = info["navigation_steps"], info["objects_collected"]
    counts = {"collected": collected, "total": info["objects_total"], "navigation_steps": steps}
    pace = {"steps_per_object": round(steps / max(collected, 1), 2)}
    return {"room": room, "seed": seed, **counts, **pace, "robot_minutes": round(info["robot_seconds"] / 60, 1)}


def main() -> None:
    """Print a line a room and seed, and the mean of each room; write the CSV."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", nargs="*", default=list(ROOMS))
    parser.add_argument("--seeds", nargs="*", type=int, default=list(range(10)))
    parser.add_argument("--output", type=Path, default=OUTPUT)
    arguments = parser.parse_args()
    rows = []
    for room in arguments.rooms:
        env = RelmmRoomEnv(room=room, navigation_steps=LIMIT)
        for seed in arguments.seeds:
            rows.append(clean(env, room, seed))
            print("  ".join(f"{key} {value}" for key, value in rows[-1].items()), flush=True)
        env.close()
        pace = [float(str(row["steps_per_object"])) for row in rows if row["room"] == room]
        print(f"{room}: {np.mean(pace):.1f} ± {np.std(pace):.1f} steps an object", flush=True)
    with arguments.output.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
