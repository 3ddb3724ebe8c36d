"""Planned navigation: the first step of the best way over the remembered floor.

The paper's objective for navigation is the sum of r_n(o) = P[grasp|o] - 1. On a map whose geometry is known it can be
maximised directly: a way of n steps to a place where a grasp promises success p is worth about -n - (1 - p) * F,
where F is what a failure costs, in steps. Floor that nobody has seen from near promises something too, so that
searching needs no rule of its own.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from relmm.features import DRIVE_PULSE_S, GRASP_X, GRASP_Y, MAX_THETA_VEL, MAX_X_VEL, FloatArray
from relmm.policies.relmm.memory import CELL, PLACES, SIDE, FloorMemory, cells

STEP_LENGTH = MAX_X_VEL * DRIVE_PULSE_S  # m
STEP_TURN = math.radians(MAX_THETA_VEL) * DRIVE_PULSE_S  # rad

# --- The robot on the floor, m from its centre ------------------------------------------------------------------
TIGHT, ROOMY = 0.24, 0.38  # to what stands beside it: least, and without being turned away by its own avoidance
_PUSH = 0.21  # within which the base pushes an object
_STANDING = (0.36, 0.42)  # to an object that it wants to grasp
_REACH_MARGIN = 0.012  # inside the grasp area to aim for
_FINGERS = 0.045  # beyond an object; what stands there stops the arm
# Where its own avoidance looks: rad to the left, m.
_LOOKS = np.array(list(itertools.product((-0.75, -0.4, 0.0, 0.4, 0.75), (0.27, 0.36))))
_MOST_TURNS = 8  # of its avoidance that are thought of

# --- Costs, in navigation steps ---------------------------------------------------------------------------------
_NARROW, _PUSHING, _BLOCKED = 2.0, 3.0, 50.0  # of a metre, beyond the 1 of a free one, as a multiple
_FACING, _ARM_STOPPED, _TOO_TIGHT = 8.0, 6.0, 30.0  # of a pose to grasp from
_TURNED_AWAY = 0.5  # of a step after which its own avoidance turns the robot
_TURN_SHARE = 0.7  # of a turn; the rest happens while driving
_PREFERENCE = 3.0  # by which another goal must be better than the last one
_SAME_GOAL = 0.15  # m
_PATIENCE = 7.0  # steps without getting nearer to a goal until it is given up ...
_THWARTED = 2.0  # ... and how many of them a step costs that goes otherwise than planned
_AS_GOOD = 0.1  # less promise than the target's, with which another thing on the way will do as well
_GIVEN_UP_RADIUS, _GIVEN_UP_STEPS = 0.1, 50  # m, and for how long

COARSE = 4  # cells of the memory a side of a cell of the ways, 10 cm
_WAYS = SIDE // COARSE
_NUM_THINGS, _NUM_HEADINGS = 40, 24
_APART = 5  # cells a side of the square in which a thing is the best
_FRONTIER = 0.5  # of not being known, from which on floor is worth looking at
_STEPS = np.array(list(itertools.product(np.linspace(0, STEP_LENGTH, 5), np.linspace(-0.999, 0.999, 9) * STEP_TURN)))
_STEPS = _STEPS[np.abs(_STEPS / (STEP_LENGTH, STEP_TURN)).max(axis=1) > 0.2]  # without standing still


@dataclass(frozen=True)
class Plan:
    """What the robot is up to.

    Attributes:
        step: the next navigation step, m forward and rad.
        goal: x, y (m) and heading (rad) on the map to go to.
        way: places of the map on the way there, m, (n, 2).
        target: what it wants there, m, (2,): something to grasp, or floor to look at.
        promise: success that is expected there, 0..1.
        searching: whether the target is floor that nobody has seen from near.
    """

    step: tuple[float, float]
    goal: FloatArray
    way: FloatArray
    target: FloatArray
    promise: float
    searching: bool


class Ways:
    """The cheapest ways from one place to all others.

    Args:
        start: m, (2,).
        clearance: of the memory, m.
        things: that had better not be pushed, m, (n, 2).
    """

    def __init__(self, start: FloatArray, clearance: NDArray[np.float32], things: FloatArray) -> None:
        free = clearance[COARSE // 2 :: COARSE, COARSE // 2 :: COARSE]
        pushed: NDArray[np.bool_] = np.zeros((_WAYS, _WAYS), bool)
        if len(things):
            near = np.zeros((SIDE, SIDE), np.uint8)
            near[tuple(np.moveaxis(cells(things), -1, 0))] = 1
            gaps = cv2.distanceTransform(1 - near, cv2.DIST_L2, 5) * CELL
            pushed = gaps[COARSE // 2 :: COARSE, COARSE // 2 :: COARSE] < _PUSH
        cost = 1.0 + _NARROW * (free < ROOMY) + _PUSHING * pushed
        self.costs = np.where(free < TIGHT, _BLOCKED, cost)
        graph = csr_matrix((_LENGTHS * self.costs.ravel()[_TO], _TO, _ROWS), shape=(_WAYS**2, _WAYS**2))
        self._start = int(self._index(start))
        self._lengths, self._before = dijkstra(graph, indices=self._start, return_predecessors=True)

    def cost(self, places: FloatArray) -> FloatArray:
        """Cost of a metre at places, (..., 2); 1 on free floor."""
        return np.asarray(self.costs.ravel()[self._index(places)])

    def length(self, places: FloatArray) -> FloatArray:
        """Cost of the way to places, (..., 2), in metres of free floor."""
        return np.asarray(self._lengths[self._index(places)])

    def lengths(self) -> FloatArray:
        """The same to all cells of the ways, (WAYS, WAYS)."""
        return np.asarray(self._lengths.reshape(_WAYS, _WAYS))

    def way(self, place: FloatArray) -> FloatArray:
        """Places on the way to one, from the start on, m, (n, 2)."""
        index, indices = int(self._index(place)), []
        while index >= 0 and index != self._start:
            indices.append(index)
            index = int(self._before[index])
        places = WAY_PLACES.reshape(-1, 2)[indices[::-1]]
        return np.vstack([places[:-1], place]) if len(places) else place[None]

    def _index(self, places: FloatArray) -> NDArray[np.intp]:
        row, column = np.moveaxis(cells(places) // COARSE, -1, 0)
        return np.asarray(row * _WAYS + column)


class Planner:
    """Plans for one robot, and keeps to its goal.

    Args:
        failure_steps: F, what a failed grasp costs.
        unseen_promise: what floor promises that nobody has seen from near.
    """

    def __init__(self, failure_steps: float, unseen_promise: float) -> None:
        self._failure_steps, self._unseen_promise = failure_steps, unseen_promise
        self._target: FloatArray | None = None
        self._left = math.inf  # steps to the target, the least that there were
        self._patience = 0.0  # steps without getting nearer, before it is given up

    def shift(self, by: FloatArray) -> None:
        """Tell that the map has moved, see `FloorMemory.move`."""
        self._target = None if self._target is None else self._target - by

    def thwart(self) -> None:
        """Tell that the last step went otherwise than planned: the robot was turned away, or did not get on."""
        self._patience -= _THWARTED

    def plan(self, memory: FloorMemory, success: NDArray[np.float32], least: float) -> Plan:
        """The best way.

        Args:
            memory: the remembered floor.
            success: that each of its cells promises.
            least: success below which nothing is worth a way.
        """
        if self._target is not None and self._patience < 0:
            memory.leave_alone(self._target, _GIVEN_UP_RADIUS, _GIVEN_UP_STEPS)
            self._target = None
        things, promises = find_things(success, least, memory.pose[:2])
        clearance = memory.clearance()
        ways = Ways(memory.pose[:2], clearance, things)
        wanted = ~memory.is_left_alone(things)  # what is left alone is not pushed either
        promises = promises[wanted]
        poses, targets, steps = _poses_to_grasp(memory.pose, things[wanted], clearance, ways)
        scores = steps + (1 - np.repeat(promises, len(_OFFSETS))) * self._failure_steps
        best, score = self._best(scores, targets)
        searched = self._search(memory, ways, clearance, score)
        if searched is not None:
            target = searched
            heading = math.atan2(*(target - memory.pose[:2])[::-1])
            goal, promise = np.array([*target, heading]), self._unseen_promise
        elif best is None:
            return self._turn(memory)
        else:
            goal, target, promise = poses[best], targets[best], float(np.repeat(promises, len(_OFFSETS))[best])
        way = ways.way(goal[:2])
        self._keep(target, float(scores[best]) if searched is None else float(ways.length(goal[:2])) / STEP_LENGTH)
        aims = things[wanted][promises >= promise - _AS_GOOD] if searched is None else None
        step = _best_step(memory.pose, goal, way, things, clearance, ways, aims)
        return Plan(step, goal, way, target, promise, searched is not None)

    def go(self, memory: FloorMemory, target: FloatArray, goal: FloatArray, things: FloatArray) -> Plan:
        """The way to a pose of the map, where something is to be done at a target, past things, m, (n, 2)."""
        clearance = memory.clearance()
        ways = Ways(memory.pose[:2], clearance, things)
        way = ways.way(goal[:2])
        step = _best_step(memory.pose, goal, way, things, clearance, ways, None)
        return Plan(step, goal, way, target, 0.0, False)

    def _best(self, scores: FloatArray, targets: FloatArray) -> tuple[int | None, float]:
        if not len(scores):
            return None, math.inf
        if self._target is not None:
            same = np.linalg.norm(targets - self._target, axis=1) < _SAME_GOAL
            scores = scores - _PREFERENCE * same
        best = int(scores.argmin())
        return best, float(scores[best])

    def _keep(self, target: FloatArray, steps: float) -> None:
        """Remember the target, and whether the robot gets nearer to it."""
        if self._target is None or np.linalg.norm(target - self._target) > _SAME_GOAL:
            self._left = math.inf
        if steps < self._left - 0.5:
            self._left, self._patience = steps, _PATIENCE
        self._target, self._patience = target, self._patience - 1

    def _search(
        self, memory: FloorMemory, ways: Ways, clearance: NDArray[np.float32], score: float
    ) -> FloatArray | None:
        """Floor that is better looked at first, if it is better than a score."""
        middle = slice(COARSE // 2, None, COARSE)
        unseen, free = memory.unseen()[middle, middle], clearance[middle, middle]
        offset = WAY_PLACES - memory.pose[:2]
        bearing = np.abs(_wrapped(np.arctan2(offset[..., 1], offset[..., 0]) - memory.pose[2]))
        steps = ways.lengths() / STEP_LENGTH + _TURN_SHARE * bearing / STEP_TURN
        steps = steps + (1 - self._unseen_promise * unseen) * self._failure_steps
        if self._target is not None:
            steps = steps - _PREFERENCE * (np.linalg.norm(WAY_PLACES - self._target, axis=-1) < 2 * _SAME_GOAL)
        worth = (unseen > _FRONTIER) & (free > TIGHT) & (np.hypot(*np.moveaxis(offset, -1, 0)) > 0.4)
        steps = np.where(worth, steps, math.inf)
        best = np.unravel_index(int(steps.argmin()), steps.shape)
        return WAY_PLACES[best] if steps[best] < score else None

    def _turn(self, memory: FloorMemory) -> Plan:
        """Nothing promises anything: look round."""
        self._target = None
        place = memory.pose[:2]
        return Plan((0.0, 0.999 * STEP_TURN), memory.pose.copy(), place[None], place, 0.0, True)


def find_things(success: NDArray[np.float32], least: float, near: FloatArray) -> tuple[FloatArray, NDArray[np.float32]]:
    """Where grasps promise the most.

    Args:
        success: of each cell of the memory.
        least: that counts.
        near: m, (2,); of too many, the nearest to it are taken.

    Returns:
        Places, m, (n, 2), and their promises, (n,).
    """
    smooth = cv2.GaussianBlur(success, (5, 5), 0) + _TIES
    peaks = (smooth >= cv2.dilate(smooth, np.ones((_APART, _APART)))) & (success >= least)
    places = PLACES[peaks]
    order = np.argsort(np.linalg.norm(places - near, axis=1), kind="stable")[:_NUM_THINGS]
    return places[order], success[peaks][order]


def _poses_to_grasp(
    pose: FloatArray, things: FloatArray, clearance: NDArray[np.float32], ways: Ways
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Poses from which things could be grasped, (n, 3), those things, (n, 2), and steps to be there, (n,)."""
    targets = np.repeat(things, len(_OFFSETS), axis=0)
    headings = np.tile(_OFFSETS[:, 2], len(things))
    places = targets + np.tile(_OFFSETS[:, :2], (len(things), 1))
    offset = places - pose[:2]
    far = np.linalg.norm(offset, axis=1) > STEP_LENGTH
    bearing = np.where(far, np.arctan2(offset[:, 1], offset[:, 0]), pose[2])
    turns = np.abs(_wrapped(bearing - pose[2])) + np.abs(_wrapped(headings - bearing))
    steps = ways.length(places) / STEP_LENGTH + _TURN_SHARE * turns / STEP_TURN
    beyond = targets - _FINGERS / np.hypot(*_OFFSETS[0, :2]) * np.tile(_OFFSETS[:, :2], (len(things), 1))
    steps = steps + _TOO_TIGHT * (_at(clearance, places) < TIGHT) + _ARM_STOPPED * (_at(clearance, beyond) <= CELL)
    steps = steps + _FACING * _faces(np.column_stack([places, headings]), clearance)
    return np.column_stack([places, headings]), targets, steps


def _best_step(
    pose: FloatArray,
    goal: FloatArray,
    way: FloatArray,
    things: FloatArray,
    clearance: NDArray[np.float32],
    ways: Ways,
    aims: FloatArray | None,
) -> tuple[float, float]:
    """The navigation step from which the rest looks shortest, one more step ahead."""
    waypoint = _waypoint(pose[:2], way, ways)
    heading = goal[2] if aims is not None and np.array_equal(waypoint, way[-1]) else None

    def least_rest(poses: FloatArray) -> FloatArray:
        """Steps that are left after each pose, (n,)."""
        second = _after(poses, _STEPS).reshape(-1, 3)
        rest = 1 + _steps_left(second, waypoint, heading)
        if aims is not None:
            rest = np.where(_reaches(second, aims), 0.0, rest)
        rest = rest + _roughness(second, things, clearance) + _TURNED_AWAY * _faces(second, clearance)
        return np.asarray(1 + rest.reshape(len(poses), len(_STEPS)).min(axis=1))

    first = _after(pose[None], _STEPS)[0]
    faces = _faces(first, clearance)
    # Its own avoidance turns the robot either way, as far as it must.
    ends = np.concatenate([first, *(_turned_away(first[faces], side, clearance) for side in (-1, 1))])
    rest = least_rest(ends)
    if aims is not None:
        rest = np.where(_reaches(ends, aims), 0.0, rest)
    count, turned = len(first), int(faces.sum())
    cost = rest[:count]
    cost[faces] = _TURNED_AWAY + (rest[count : count + turned] + rest[count + turned :]) / 2
    best = int(np.argmin(cost + _roughness(first, things, clearance)))
    return float(_STEPS[best, 0]), float(_STEPS[best, 1])


def _turned_away(poses: FloatArray, side: int, clearance: NDArray[np.float32]) -> FloatArray:
    """Poses, (n, 3), turned to one side until the robot does not see anything in its way any more."""
    turns = side * STEP_TURN * np.arange(1, _MOST_TURNS + 1)
    turned = np.repeat(poses[:, None], _MOST_TURNS, axis=1)
    turned[..., 2] += turns
    clear = ~_faces(turned.reshape(-1, 3), clearance).reshape(len(poses), _MOST_TURNS)
    clear[:, -1] = True
    return np.asarray(turned[np.arange(len(poses)), clear.argmax(axis=1)])


def _waypoint(start: FloatArray, way: FloatArray, ways: Ways) -> FloatArray:
    """The farthest place of a way that can be reached in a straight line, at least 20 cm ahead."""
    reached = way[0]
    for place in way:
        line = start + np.linspace(0.3, 1, 8)[:, None] * (place - start)
        if np.any(ways.cost(line) >= 1 + _PUSHING) and np.linalg.norm(reached - start) > 0.2:
            return reached
        reached = place
    return reached


def _steps_left(poses: FloatArray, waypoint: FloatArray, heading: float | None) -> FloatArray:
    offset = waypoint - poses[:, :2]
    distance = np.linalg.norm(offset, axis=1)
    near = distance < 0.6 * STEP_LENGTH
    bearing = np.where(near, poses[:, 2], np.arctan2(offset[:, 1], offset[:, 0]))
    turns = np.abs(_wrapped(bearing - poses[:, 2]))
    if heading is not None:
        turns = turns + np.abs(_wrapped(heading - bearing))
    return np.asarray(distance / STEP_LENGTH + 0.8 * turns / STEP_TURN)


def _reaches(poses: FloatArray, things: FloatArray) -> NDArray[np.bool_]:
    """From which poses, (n, 3), any of the things could be grasped."""
    offset = things - poses[:, None, :2]
    cos, sin = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x, y = cos * offset[..., 0] + sin * offset[..., 1], cos * offset[..., 1] - sin * offset[..., 0]
    inside = (x > GRASP_X[0] + _REACH_MARGIN) & (x < GRASP_X[1] - _REACH_MARGIN)
    return np.any(inside & (np.abs(y) < GRASP_Y[1] - _REACH_MARGIN), axis=1)


def _roughness(poses: FloatArray, things: FloatArray, clearance: NDArray[np.float32]) -> FloatArray:
    """Steps that being at each pose, (n, 3), is worth avoiding: too near a wall, or on a thing.

    Less than what a step gains, or standing still would look best.
    """
    pushed = np.sum(np.linalg.norm(things - poses[:, None, :2], axis=-1) < _PUSH, axis=1)
    tight = np.maximum(TIGHT - _at(clearance, poses[:, :2]), 0.0)
    return np.asarray(0.6 * pushed + 60.0 * tight)


def _faces(poses: FloatArray, clearance: NDArray[np.float32]) -> NDArray[np.bool_]:
    """From which poses, (n, 3), the robot would see an obstacle so near that it turned away of itself."""
    angles = poses[:, 2, None] + _LOOKS[:, 0]
    ahead = poses[:, None, :2] + _LOOKS[:, 1, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return np.asarray((_at(clearance, ahead) <= CELL).any(axis=1))


def _at(layer: NDArray[np.float32], places: FloatArray) -> NDArray[np.float32]:
    row, column = np.moveaxis(cells(places), -1, 0)
    return np.asarray(layer[row, column])


def _after(poses: FloatArray, steps: FloatArray) -> FloatArray:
    """Where navigation steps lead: poses (n, 3) and steps (m, 2; m and rad) give (n, m, 3)."""
    heading = poses[:, None, 2] + steps[:, 1] / 2
    moved = steps[:, 0, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return np.concatenate([poses[:, None, :2] + moved, (heading + steps[:, 1] / 2)[..., None]], axis=-1)


def _wrapped(angle: FloatArray | float) -> FloatArray:
    """Angles (rad) to -pi..pi."""
    return np.asarray((np.asarray(angle) + math.pi) % (2 * math.pi) - math.pi)


def _neighbours() -> tuple[NDArray[np.int32], NDArray[np.int32], FloatArray]:
    """The graph of the ways: for each cell the cells beside it, where its row begins, and how far they are, m."""
    numbers = np.arange(_WAYS**2).reshape(_WAYS, _WAYS)
    padded = np.pad(numbers, 1, constant_values=-1)
    moves = [move for move in itertools.product((0, 1, 2), repeat=2) if move != (1, 1)]
    beside = np.stack([padded[i : i + _WAYS, j : j + _WAYS].ravel() for i, j in moves], axis=1)
    lengths = np.array([CELL * COARSE * math.hypot(i - 1, j - 1) for i, j in moves])
    there = beside >= 0
    rows = np.concatenate([[0], there.sum(axis=1).cumsum()])
    return beside[there].astype(np.int32), rows.astype(np.int32), np.broadcast_to(lengths, beside.shape)[there]


# So that of equals beside each other one is the best.
_TIES = (1e-6 * ((_APART * np.arange(SIDE)[:, None] + np.arange(SIDE)) % _APART**2)).astype(np.float32)
WAY_PLACES = PLACES[COARSE // 2 :: COARSE, COARSE // 2 :: COARSE]  # m, near the middle of each cell of the ways
_TO, _ROWS, _LENGTHS = _neighbours()
_HEADINGS = np.linspace(-math.pi, math.pi, _NUM_HEADINGS, endpoint=False)
# From a thing to poses from which it can be grasped: x, y, heading.
_OFFSETS = np.array([(-d * math.cos(h), -d * math.sin(h), h) for d in _STANDING for h in _HEADINGS])
