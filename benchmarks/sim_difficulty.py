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
import csv
import itertools
import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from relmm.features import (
    ACTION_NAMES,
    BASKET_XY,
    DRIVE_PULSE_S,
    GRASP_X,
    GRASP_Y,
    GRID,
    MAX_THETA_VEL,
    MAX_X_VEL,
    Skill,
    action_dict,
    cell_to_xy,
    in_grasp_area,
    xy_to_cell,
)
from relmm.geometry import camera_geometry
from relmm.robot.skills import Skills
from relmm.sim.body import SimBody
from relmm.sim.env import RelmmRoomEnv
from relmm.sim.objects import MAX_RADIUS
from relmm.sim.rooms import Room, make_room

FloatArray = NDArray[np.floating]

OUTPUT = Path(__file__).parent / "results" / "sim_difficulty.csv"
ROOMS = ("no_obstacles", "obstacles", "diverse", "obstacles_rugs")
NAVIGATION_STEPS = 250
PICK_UPS_PER_STEP = 2
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


def graspable(body: SimBody, without: Iterable[int] = ()) -> list[int]:
    """Numbers of the objects on the floor of the grasp rectangle, nearest first."""
    xyz = body.truth.objects_in_robot_frame()
    order = np.argsort(xyz[:, 0]).tolist()
    return [i for i in order if i not in without and in_grasp_area(*xyz[i, :2]) and xyz[i, 2] < 0.05]


def move_object(body: SimBody, index: int, x: float, y: float) -> None:
    """Move one object (m, room) without physics, as it lies; the others may go on sleeping, which saves much time."""
    joint = body.model.body_jntadr[body.truth.object_ids[index]]
    start = body.model.jnt_qposadr[joint]
    body.data.qpos[start : start + 2] = x, y
    mujoco.mj_forward(body.model, body.data)


# --- The privileged controller -------------------------------------------------------------------------------
STEP_LENGTH = MAX_X_VEL * DRIVE_PULSE_S  # m
STEP_TURN = math.radians(MAX_THETA_VEL) * DRIVE_PULSE_S  # rad
MAP_CELL = 0.05  # m
TIGHT, ROOMY = 0.24, 0.38  # m from the robot's centre to walls and obstacles: least, and free of avoidance turns
PUSH_RADIUS = 0.21  # m from the robot's centre, within which the base pushes an object
STANDING_DISTANCES = (0.36, 0.42)  # m from the robot's centre to the object it wants to grasp
PATIENCE = 4  # failed attempts at an object before others are tried
MAX_STEPS = 30  # towards one object before others are tried
STUCK_STEPS, ESCAPE_STEPS = 8, 4  # without getting anywhere, then straight on wherever it looks
PREFERENCE = 3.0  # steps by which another object must be cheaper to be preferred to the present one
LOOK_AHEAD = 0.2  # m of the way ahead that the controller steers for at least
REACH_MARGIN = 0.012  # m inside the grasp rectangle to aim for


class Map:
    """What the floor looks like to the robot's centre: free space, and ways through it."""

    def __init__(self, room: Room) -> None:
        self._room = room
        self._half = np.array(room.size) / 2
        axes = [np.arange(-half + MAP_CELL / 2, half, MAP_CELL) for half in self._half]
        self.points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        self._clearance = self.clearance(self.points.reshape(-1, 2)).reshape(self.points.shape[:2])

    def clearance(self, xy: FloatArray) -> FloatArray:
        """Distance in m from points, shape (n, 2), to the nearest wall or obstacle."""
        distances = [np.min(self._half - np.abs(xy), axis=1)]
        return np.min(distances + [obstacle.distance(xy) for obstacle in self._room.obstacles], axis=0)

    def cell(self, xy: FloatArray) -> tuple[NDArray[np.intp], ...]:
        """Indices of the map's cells that hold points, shape (..., 2)."""
        index = ((xy + self._half) / MAP_CELL).astype(int)
        return tuple(np.moveaxis(np.clip(index, 0, np.array(self.points.shape[:2]) - 1), -1, 0))

    def costs(self, objects: FloatArray) -> FloatArray:
        """Cost of driving a metre through each cell: more in narrow places and where objects would be pushed."""
        gaps = np.linalg.norm(self.points[:, :, None] - objects, axis=-1).min(axis=-1, initial=np.inf)
        cost = 1.0 + 2.0 * (self._clearance < ROOMY) + 3.0 * (gaps < PUSH_RADIUS)
        return np.where(self._clearance < TIGHT, 50.0, cost)

    def distances(self, start: FloatArray, costs: FloatArray) -> FloatArray:
        """Cost of the cheapest way from a point (m) to every cell."""
        field = np.full(costs.shape, np.inf)
        field[self.cell(start)] = 0.0
        while True:
            padded = np.pad(field, 1, constant_values=np.inf)
            best = field
            for i, j in itertools.product((0, 1, 2), repeat=2):
                length = MAP_CELL * math.hypot(i - 1, j - 1)
                neighbour = padded[i : i + field.shape[0], j : j + field.shape[1]]
                best = np.minimum(best, neighbour + length * costs)
            if np.array_equal(best, field):
                return field
            field = best

    def waypoint(self, start: FloatArray, goal: FloatArray, costs: FloatArray) -> FloatArray:
        """The farthest point of the cheapest way from `start` to `goal` that can be reached in a straight line."""
        field = self.distances(goal, costs)
        cell = tuple(int(i) for i in self.cell(start))
        reached = start
        for _ in range(200):
            around = [(cell[0] + i, cell[1] + j) for i, j in itertools.product((-1, 0, 1), repeat=2)]
            inside = [c for c in around if 0 <= c[0] < field.shape[0] and 0 <= c[1] < field.shape[1]]
            cell = min(inside, key=lambda c: field[c])
            far = np.linalg.norm(reached - start) > LOOK_AHEAD
            if not self._straight(start, self.points[cell], costs) and far:
                return reached
            reached = self.points[cell]
            if field[cell] == 0:
                return goal
        return goal

    def _straight(self, start: FloatArray, end: FloatArray, costs: FloatArray) -> bool:
        line = start + np.linspace(0.3, 1, 8)[:, None] * (end - start)
        return bool(np.all(costs[self.cell(line)] < 3.5))  # narrow places will do, pushing will not


def wrap(angle: FloatArray | float) -> FloatArray:
    """Angles (rad) to -pi..pi."""
    return np.asarray((np.asarray(angle) + math.pi) % (2 * math.pi) - math.pi)


def after_step(poses: FloatArray, actions: FloatArray) -> FloatArray:
    """Where navigation steps lead: poses (n, 3) and actions (m, 2; m and rad) give (n, m, 3)."""
    heading = poses[:, None, 2] + actions[:, 1] / 2
    moved = actions[:, 0, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return np.concatenate([poses[:, None, :2] + moved, (heading + actions[:, 1] / 2)[..., None]], axis=-1)


class Controller:
    """Collects objects by knowing everything: the nearest by path cost, then steps found by looking two ahead."""

    _ACTIONS = np.array(
        list(itertools.product(np.linspace(0, STEP_LENGTH, 5), np.linspace(-0.999, 0.999, 9) * STEP_TURN))
    )

    def __init__(self, body: SimBody) -> None:
        self._body = body
        self._map = Map(body.room)
        self._target = -1
        self._attempts = 0
        self._steps = 0  # with this target
        self._places: list[FloatArray] = []  # where it was after each navigation step since the last escape
        self._escape = 0
        self._failures = np.zeros(body.room.num_objects)

    def act(self, holding: bool) -> dict[str, float]:
        """The next action."""
        if holding:
            self._failures[self._target] = 0
            return action_dict(Skill.PLACE, x=BASKET_XY[0], y=BASKET_XY[1])
        in_reach = [i for i in graspable(self._body) if self._failures[i] < PATIENCE]
        if in_reach and self._attempts < PICK_UPS_PER_STEP:
            return self._grasp(min(in_reach, key=lambda i: self._failures[i]))
        self._attempts = 0
        self._steps += 1
        if self._steps % MAX_STEPS == 0:
            self._failures[self._target] += PATIENCE
        self._failures -= np.minimum(self._failures, 0.1)  # after a while an object deserves another chance
        return self._drive(np.array([STEP_LENGTH, 0.0])) if self._is_stuck() else self._navigate()

    def _is_stuck(self) -> bool:
        """Whether to drive straight on: near obstacles the robot's own avoidance may undo every turn that it makes."""
        self._escape -= 1
        self._places.append(np.array(self._body.truth.robot()[:2]))
        recent = np.array(self._places[-STUCK_STEPS:])
        if len(recent) == STUCK_STEPS and np.ptp(recent, axis=0).max() < STEP_LENGTH / 2:
            self._places, self._escape = [], ESCAPE_STEPS
            self._failures[self._target] += PATIENCE
        return self._escape > 0

    def _grasp(self, index: int) -> dict[str, float]:
        self._attempts += 1
        self._failures[index] += 1
        self._target = index
        x, y = cell_to_xy(xy_to_cell(*self._body.truth.objects_in_robot_frame()[index, :2]))
        return action_dict(Skill.GRASP, x=float(x), y=float(y))

    def _navigate(self) -> dict[str, float]:
        truth = self._body.truth
        gone = {*truth.in_basket().tolist(), *truth.lost().tolist()}
        left = np.array([i for i in range(len(self._failures)) if i not in gone])
        pose, objects = np.array(truth.robot()), truth.objects()[:, :2]
        costs = self._map.costs(objects[left])
        goal = self._choose(pose, objects, left, costs)
        waypoint = self._map.waypoint(pose[:2], goal[:2], costs)
        return self._drive(self._best_step(pose, goal, waypoint, objects, left))

    def _choose(self, pose: FloatArray, objects: FloatArray, left: NDArray[np.intp], costs: FloatArray) -> FloatArray:
        """The pose (x, y, heading) from which an object is cheapest to grasp; remembers which."""
        field = self._map.distances(pose[:2], costs)
        headings = np.linspace(-math.pi, math.pi, 24, endpoint=False)
        directions = np.stack([np.cos(headings), np.sin(headings)], axis=1)
        best, best_steps, target = pose, math.inf, self._target
        for index in left:
            for distance in STANDING_DISTANCES:
                places = objects[index] - distance * directions
                steps = self._steps_to(pose, places, headings, field)
                # The fingers reach 3 cm beyond the object; a wall there stops the arm.
                steps = steps + 6.0 * (self._map.clearance(objects[index] + 0.045 * directions) <= 0)
                steps = (
                    steps
                    + 8.0 * self._facing(places, headings)
                    + 8.0 * self._failures[index]
                    - PREFERENCE * (index == self._target)
                )
                k = int(np.argmin(steps))
                if steps[k] < best_steps:
                    best, best_steps, target = np.array([*places[k], headings[k]]), steps[k], index
        if target != self._target:
            self._target, self._steps = int(target), 0
        return best

    def _steps_to(self, pose: FloatArray, places: FloatArray, headings: FloatArray, field: FloatArray) -> FloatArray:
        offset = places - pose[:2]
        far = np.linalg.norm(offset, axis=1) > STEP_LENGTH
        way = np.where(far, np.arctan2(offset[:, 1], offset[:, 0]), pose[2])
        turns = np.abs(wrap(way - pose[2])) + np.abs(wrap(headings - way))
        # A third of the turning happens while driving.
        steps = field[self._map.cell(places)] / STEP_LENGTH + 0.7 * turns / STEP_TURN
        return steps + 30.0 * (self._map.clearance(places) < TIGHT)

    def _best_step(
        self, pose: FloatArray, goal: FloatArray, waypoint: FloatArray, objects: FloatArray, left: NDArray[np.intp]
    ) -> FloatArray:
        first = after_step(pose[None], self._ACTIONS)[0]
        second = after_step(first, self._ACTIONS)
        wanted = objects[[i for i in left if self._failures[i] < PATIENCE]]
        near, far = self._in_reach(first, wanted), self._in_reach(second.reshape(-1, 3), wanted)
        rest = np.where(far, 0.0, 1 + self._steps_left(second.reshape(-1, 3), goal, waypoint))
        rest += self._roughness(second.reshape(-1, 3), objects[left])
        later = 1 + rest.reshape(second.shape[:2]).min(axis=1)
        return np.asarray(self._ACTIONS[np.argmin(self._roughness(first, objects[left]) + np.where(near, 0.0, later))])

    def _in_reach(self, poses: FloatArray, objects: FloatArray) -> NDArray[np.bool_]:
        """From which poses (n, 3) any of the objects could be grasped."""
        offset = objects - poses[:, None, :2]
        cos, sin = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
        x, y = cos * offset[..., 0] + sin * offset[..., 1], cos * offset[..., 1] - sin * offset[..., 0]
        inside = (x > GRASP_X[0] + REACH_MARGIN) & (x < GRASP_X[1] - REACH_MARGIN)
        return np.any(inside & (np.abs(y) < GRASP_Y[1] - REACH_MARGIN), axis=1)

    def _steps_left(self, poses: FloatArray, goal: FloatArray, waypoint: FloatArray) -> FloatArray:
        offset = waypoint - poses[:, :2]
        distance = np.linalg.norm(offset, axis=1)
        near = distance < 0.6 * STEP_LENGTH
        bearing = np.where(near, poses[:, 2], np.arctan2(offset[:, 1], offset[:, 0]))
        turns = np.abs(wrap(bearing - poses[:, 2]))
        if np.array_equal(waypoint, goal[:2]):
            turns = turns + np.abs(wrap(goal[2] - bearing))
        return distance / STEP_LENGTH + 0.8 * turns / STEP_TURN

    def _roughness(self, poses: FloatArray, objects: FloatArray) -> FloatArray:
        """Steps that being at each pose (n, 3) is worth avoiding: too near a wall, on an object, facing an obstacle."""
        pushed = np.sum(np.linalg.norm(objects - poses[:, None, :2], axis=-1) < PUSH_RADIUS, axis=1)
        tight = np.maximum(TIGHT - self._map.clearance(poses[:, :2]), 0.0)
        # Less than what a step gains, or standing still would look best.
        return 0.6 * pushed + 60.0 * tight + 0.4 * self._facing(poses[:, :2], poses[:, 2])

    def _facing(self, places: FloatArray, headings: FloatArray) -> NDArray[np.bool_]:
        """Where the robot would see an obstacle so near that it turned away of itself."""
        seen = np.zeros(len(places), bool)
        for angle, distance in itertools.product((-0.75, -0.4, 0.0, 0.4, 0.75), (0.27, 0.36)):
            ahead = np.stack([np.cos(headings + angle), np.sin(headings + angle)], axis=1)
            seen |= self._map.clearance(places + distance * ahead) <= 0
        return seen

    def _drive(self, step: FloatArray) -> dict[str, float]:
        return action_dict(x_vel=step[0] / DRIVE_PULSE_S, theta_vel=math.degrees(step[1]) / DRIVE_PULSE_S)


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
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
