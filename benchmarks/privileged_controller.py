"""What a robot that knows everything would do: go to the object with the cheapest way, grasp it, and keep it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from relmm.features import (
    BASKET_XY,
    DRIVE_PULSE_S,
    GRASP_X,
    GRASP_Y,
    MAX_THETA_VEL,
    MAX_X_VEL,
    Skill,
    action_dict,
    cell_to_xy,
    in_grasp_area,
    xy_to_cell,
)
from relmm.sim.body import SimBody
from relmm.sim.rooms import Room

FloatArray = NDArray[np.floating]

STEP_LENGTH = MAX_X_VEL * DRIVE_PULSE_S  # m
STEP_TURN = math.radians(MAX_THETA_VEL) * DRIVE_PULSE_S  # rad
MAP_CELL = 0.05  # m
PICK_UPS_PER_STEP = 2  # grasps after a navigation step
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
        return self.drive()

    def drive(self) -> dict[str, float]:
        """The next navigation step."""
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


def graspable(body: SimBody, without: Iterable[int] = ()) -> list[int]:
    """Numbers of the objects on the floor of the grasp rectangle, nearest first."""
    xyz = body.truth.objects_in_robot_frame()
    order = np.argsort(xyz[:, 0]).tolist()
    return [i for i in order if i not in without and in_grasp_area(*xyz[i, :2]) and xyz[i, 2] < 0.05]
