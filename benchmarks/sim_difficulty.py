"""How hard the simulated rooms are, beside the authors' simulator (the figures in `WANTED`).

Five kinds of trials in each room, with real physics and the robot's own skills throughout:

- random_grasp: one object at a uniform place of the grasp rectangle, one attempt in a uniform cell.
- own_cell_grasp: the same, but in the object's own cell.
- random_navigation: 250 uniform navigation steps with a perfect pick-up. Whatever lies in the grasp rectangle after a
  step is collected and taken out of the room, at most two things a step: the authors' robot has two grasp attempts
  after a step, so no policy could collect more.
- privileged_controller: `Controller` knows where everything is, plans its way in the gymnasium environment, grasps
  objects in their own cells and drops them into the basket; collected is what lies in the basket after 250 steps.
- lost_while_driving: pick one object up and drive 20 random navigation steps: is it gone?

Then judged_rightly: how often the robot's own judgement of a grasp was true, over the grasps of the first two kinds and
over random attempts with one to five objects in reach. Objects of one episode are not independent of each other: for
the two rows that count objects the interval is a little too narrow.

    python benchmarks/sim_difficulty.py --trials 300 --seed 0
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"  # read when numpy is imported

import argparse
import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from csv_table import write_table
from numpy.typing import NDArray
from privileged_controller import PICK_UPS_PER_STEP, Controller, graspable
from tqdm import tqdm

from relmm.features import (
    ACTION_NAMES,
    GRASP_X,
    GRASP_Y,
    GRID,
    MAX_THETA_VEL,
    MAX_X_VEL,
    cell_to_xy,
    xy_to_cell,
)
from relmm.geometry import camera_geometry
from relmm.robot.skills import Skills
from relmm.sim.body import SimBody
from relmm.sim.env import RelmmRoomEnv
from relmm.sim.objects import MAX_RADIUS
from relmm.sim.rooms import make_room

FloatArray = NDArray[np.floating]

OUTPUT = Path(__file__).parent / "results" / "sim_difficulty.csv"
ROOMS = ("no_obstacles", "obstacles", "diverse", "obstacles_rugs")
NAVIGATION_STEPS = 250
CARRIED_STEPS = 20
TRIALS_PER_EPISODE = 30  # an episode of 20 or 30 objects for so many trials of the other kinds
# The share that a room of the original's difficulty gives, in the paper's room; original_relmm.md 1.8 and 7.3.
WANTED = {
    "random_grasp": (0.02, 0.06),
    "own_cell_grasp": (0.95, 1.0),
    "random_navigation": (0.30, 0.50),
    "privileged_controller": (0.90, 1.0),
    "lost_while_driving": (0.0, 0.02),
    "judged_rightly": (0.98, 1.0),
}


@dataclass
class Count:
    """Successes among trials."""

    successes: int = 0
    trials: int = 0

    def add(self, success: bool, trials: int = 1) -> None:
        """Count one trial, or several with the same outcome."""
        self.successes += int(success) * trials
        self.trials += trials

    def interval(self) -> tuple[float, float]:
        """The 95 % Wilson score interval of the share of successes."""
        if not self.trials:
            return 0.0, 1.0
        z, n, share = 1.96, self.trials, self.successes / self.trials
        middle = (share + z * z / (2 * n)) / (1 + z * z / n)
        half = z / (1 + z * z / n) * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
        return middle - half, middle + half


# --- Single grasps -------------------------------------------------------------------------------------------
class Table:
    """A room whose robot stands still, with chosen objects in reach and all others far away."""

    def __init__(self, room: str) -> None:
        self.body = SimBody(make_room(room, robot_clearance=0.7), camera_geometry("paper"))
        self.judged = Count()

    def lay_out(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Start over with `count` random objects at uniform places of the grasp rectangle.

        Returns:
            Where they came to lie: m, robot frame, shape (count, 2).
        """
        self.body.reset(rng)
        self.skills = Skills(self.body, rng)
        chosen = rng.choice(self.body.room.num_objects, count, replace=False)
        for index, (x, y) in zip(chosen, to_world(self.body, separate_places(count, rng)), strict=True):
            move_object(self.body, index, x, y)
        self.body.wait(0.3)
        return self.body.truth.objects_in_robot_frame()[chosen, :2]

    def grasp(self, cell: int) -> bool:
        """Whether an attempt in a cell really picked something up; also counts whether it was judged rightly."""
        judged = self.skills.grasp(*cell_to_xy(cell))
        held = self.body.truth.held()
        self.judged.add(judged == held)
        return held


def to_world(body: SimBody, xy: FloatArray) -> FloatArray:
    """Points from the robot's frame to the room's, m, shape (n, 2)."""
    x, y, heading = body.truth.robot()
    cos, sin = math.cos(heading), math.sin(heading)
    return np.array([x, y]) + xy @ np.array([[cos, sin], [-sin, cos]])


def separate_places(count: int, rng: np.random.Generator) -> FloatArray:
    """Uniform places in the grasp rectangle (m, robot frame) that objects can take without touching; (count, 2)."""
    while True:
        xy = rng.uniform((GRASP_X[0], GRASP_Y[0]), (GRASP_X[1], GRASP_Y[1]), (count, 2))
        gaps = np.linalg.norm(xy[:, None] - xy, axis=-1) + np.eye(count)
        if gaps.min() >= 2 * MAX_RADIUS:
            return xy


def random_grasps(table: Table, trials: int, rng: np.random.Generator) -> Count:
    """One object in reach, a uniform cell."""
    count = Count()
    for _ in progress(trials, "random grasps"):
        table.lay_out(1, rng)
        count.add(table.grasp(int(rng.integers(GRID**2))))
    return count


def own_cell_grasps(table: Table, trials: int, rng: np.random.Generator) -> Count:
    """One object in reach, its own cell."""
    count = Count()
    for _ in progress(trials, "own-cell grasps"):
        count.add(table.grasp(xy_to_cell(*table.lay_out(1, rng)[0])))
    return count


def crowded_grasps(table: Table, trials: int, rng: np.random.Generator) -> None:
    """One to five objects in reach, a uniform cell; for the judgement only."""
    for _ in progress(trials, "crowded grasps"):
        table.lay_out(int(rng.integers(1, 6)), rng)
        table.grasp(int(rng.integers(GRID**2)))


def drives_with_object(table: Table, trials: int, rng: np.random.Generator) -> Count:
    """How many held objects are gone after driving about."""
    lost = Count()
    for _ in progress(trials, "carrying"):
        if table.grasp(xy_to_cell(*table.lay_out(1, rng)[0])):
            for _ in range(CARRIED_STEPS):
                table.skills.navigate(*random_drive(rng))
            lost.add(not table.body.truth.held())
    return lost


# --- Random navigation ---------------------------------------------------------------------------------------
def random_drive(rng: np.random.Generator) -> tuple[float, float]:
    """Speed (m/s) and turn rate (deg/s) of a uniform navigation step."""
    return rng.uniform(0, MAX_X_VEL), rng.uniform(-MAX_THETA_VEL, MAX_THETA_VEL)


def random_navigation(room: str, episodes: int, rng: np.random.Generator) -> Count:
    """Uniform navigation with a perfect pick-up."""
    body, collected = SimBody(make_room(room), camera_geometry("paper")), Count()
    for _ in progress(episodes, "random navigation"):
        body.reset(rng)
        skills, out = Skills(body, rng), set[int]()
        skills.rest()
        for _ in range(NAVIGATION_STEPS):
            skills.navigate(*random_drive(rng))
            for index in graspable(body, out)[:PICK_UPS_PER_STEP]:
                move_object(body, index, 10.0, index / 10)  # as the authors' simulator does
                out.add(index)
        collected.add(True, len(out))
        collected.add(False, body.room.num_objects - len(out))
    body.close()
    return collected


def move_object(body: SimBody, index: int, x: float, y: float) -> None:
    """Move one object (m, room) without physics, as it lies; the others may go on sleeping, which saves much time."""
    joint = body.model.body_jntadr[body.truth.object_ids[index]]
    start = body.model.jnt_qposadr[joint]
    body.data.qpos[start : start + 2] = x, y
    mujoco.mj_forward(body.model, body.data)


# --- The privileged controller -------------------------------------------------------------------------------
def privileged_controller(room: str, episodes: int, rng: np.random.Generator) -> Count:
    """What the controller brings into the basket."""
    env, collected = RelmmRoomEnv(room, navigation_steps=NAVIGATION_STEPS), Count()
    for _ in progress(episodes, "privileged controller"):
        _, info = env.reset(seed=int(rng.integers(2**31)))
        controller, over = Controller(env.robot.body), False
        while not over:
            action = controller.act(env.robot.skills.holding)
            values = np.array([action[name] for name in ACTION_NAMES], np.float32)
            _, _, terminated, truncated, info = env.step(values)
            over = terminated or truncated
        collected.add(True, info["objects_collected"])
        collected.add(False, info["objects_total"] - info["objects_collected"])
    env.close()
    return collected


# --- All of it -----------------------------------------------------------------------------------------------
def progress(count: int, what: str) -> Iterable[int]:
    """A range with a progress bar."""
    return tqdm(range(count), desc=what, leave=False)


def run(room: str, trials: int, seed: int) -> dict[str, Count]:
    """All trials in one room, each kind with random numbers of its own."""
    rngs = [np.random.default_rng([seed, kind]) for kind in range(6)]
    episodes = max(trials // TRIALS_PER_EPISODE, 1)
    table = Table(room)
    counts = {
        "random_grasp": random_grasps(table, trials, rngs[0]),
        "own_cell_grasp": own_cell_grasps(table, trials, rngs[1]),
    }
    crowded_grasps(table, trials, rngs[2])
    counts["judged_rightly"] = Count(table.judged.successes, table.judged.trials)
    counts["lost_while_driving"] = drives_with_object(table, trials, rngs[3])
    table.body.close()
    counts["random_navigation"] = random_navigation(room, 2 * episodes, rngs[4])
    counts["privileged_controller"] = privileged_controller(room, episodes, rngs[5])
    return counts


def to_row(room: str, kind: str, count: Count, seed: int) -> dict[str, str | int | float]:
    """One line of the table."""
    low, high = count.interval()
    return {
        "room": room,
        "kind": kind,
        "mean": round(count.successes / max(count.trials, 1), 4),
        "low": round(low, 4),
        "high": round(high, 4),
        "trials": count.trials,
        "wanted_low": WANTED[kind][0],
        "wanted_high": WANTED[kind][1],
        "seed": seed,
    }


def show(row: dict[str, str | int | float]) -> None:
    """Print one line of the table."""
    share = f"{row['mean']:>7.1%} ({row['low']:.1%} to {row['high']:.1%})"
    wanted = f"{row['wanted_low']:.0%} to {row['wanted_high']:.0%}"
    inside = float(row["wanted_low"]) <= float(row["mean"]) <= float(row["wanted_high"])
    print(f"{row['room']:<16}{row['kind']:<24}{share:<28}{row['trials']:>6}  {wanted:<12}{'' if inside else 'MISSED'}")


def main() -> None:
    """Run, print and save; rooms are saved as they finish."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=300)
    parser.add_argument("--room", action="append", help="may be repeated; all four without it")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    arguments = parser.parse_args()
    logging.disable(logging.WARNING)  # things discarded behind the wall are reported as lost
    print(f"{'room':<16}{'kind':<24}{'mean (95 % interval)':<28}{'trials':>6}  wanted", flush=True)
    rows: list[dict[str, str | int | float]] = []
    for room in arguments.room or ROOMS:
        counts = run(room, arguments.trials, arguments.seed)
        rows += [to_row(room, kind, counts[kind], arguments.seed) for kind in WANTED]
        for row in rows[-len(WANTED) :]:
            show(row)
        save(rows, arguments.output)


def save(rows: list[dict[str, str | int | float]], path: Path) -> None:
    """Write the table as CSV."""
    write_table(rows, path)


if __name__ == "__main__":
    main()
