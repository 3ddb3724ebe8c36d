"""Planned navigation: the first step of the best way over the remembered floor.

The paper's objective for navigation is the sum of r_n(o) = P[grasp|o] - 1. On a map whose geometry is known it can be
maximised directly: a way of n steps to a place where a grasp promises success p is worth about -n - (1 - p) * F,
where F is what a failure costs, in steps. Floor that nobody has seen from near promises something too, so that
searching needs no rule of its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from relmm.features import FloatArray
from relmm.policies.relmm.driving import STEP_LENGTH, STEP_TURN, TURN_SHARE, at, best_step, faces, wrapped
from relmm.policies.relmm.memory import CELL, PLACES, SIDE, FloorMemory
from relmm.policies.relmm.ways import MIDDLE, TIGHT, WAY_PLACES, Ways

_STANDING = (0.36, 0.42)  # m to an object that the robot wants to grasp
_FINGERS = 0.045  # m beyond an object; what stands there stops the arm
_FACING, _ARM_STOPPED, _TOO_TIGHT = 8.0, 6.0, 30.0  # what is wrong with a pose to grasp from, in steps
_PREFERENCE = 3.0  # steps by which another goal must be better than the last one
_SAME_GOAL = 0.15  # m
_PATIENCE = 7.0  # steps without getting nearer to a goal until it is given up ...
_THWARTED = 2.0  # ... and how many of them a step costs that goes otherwise than planned
_AS_GOOD = 0.1  # less promise than the target's, with which another thing on the way will do as well
_GIVEN_UP_RADIUS, _GIVEN_UP_STEPS = 0.1, 50  # m, and for how long
_NUM_THINGS, _NUM_HEADINGS = 40, 24
_APART = 5  # cells a side of the square in which a thing is the best
_FRONTIER = 0.5  # of not being known, from which on floor is worth looking at ...
_AWAY = 0.4  # ... if it is so many m away; nearer floor was seen on the way here


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
        step = best_step(memory.pose, goal, way, things, clearance, ways, aims)
        return Plan(step, goal, way, target, promise, searched is not None)

    def go(self, memory: FloorMemory, target: FloatArray, goal: FloatArray, things: FloatArray) -> Plan:
        """The way to a pose of the map, where something is to be done at a target, past things, m, (n, 2)."""
        clearance = memory.clearance()
        ways = Ways(memory.pose[:2], clearance, things)
        way = ways.way(goal[:2])
        step = best_step(memory.pose, goal, way, things, clearance, ways, None)
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
        unseen, free = memory.unseen()[MIDDLE, MIDDLE], clearance[MIDDLE, MIDDLE]
        offset = WAY_PLACES - memory.pose[:2]
        bearing = np.abs(wrapped(np.arctan2(offset[..., 1], offset[..., 0]) - memory.pose[2]))
        steps = ways.lengths() / STEP_LENGTH + TURN_SHARE * bearing / STEP_TURN
        steps = steps + (1 - self._unseen_promise * unseen) * self._failure_steps
        if self._target is not None:
            steps = steps - _PREFERENCE * (np.linalg.norm(WAY_PLACES - self._target, axis=-1) < 2 * _SAME_GOAL)
        worth = (unseen > _FRONTIER) & (free > TIGHT) & (np.hypot(*np.moveaxis(offset, -1, 0)) > _AWAY)
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
    turns = np.abs(wrapped(bearing - pose[2])) + np.abs(wrapped(headings - bearing))
    steps = ways.length(places) / STEP_LENGTH + TURN_SHARE * turns / STEP_TURN
    beyond = targets - _FINGERS / np.hypot(*_OFFSETS[0, :2]) * np.tile(_OFFSETS[:, :2], (len(things), 1))
    steps = steps + _TOO_TIGHT * (at(clearance, places) < TIGHT) + _ARM_STOPPED * (at(clearance, beyond) <= CELL)
    steps = steps + _FACING * faces(np.column_stack([places, headings]), clearance)
    return np.column_stack([places, headings]), targets, steps


# So that of equals beside each other one is the best.
_TIES = (1e-6 * ((_APART * np.arange(SIDE)[:, None] + np.arange(SIDE)) % _APART**2)).astype(np.float32)
_HEADINGS = np.linspace(-math.pi, math.pi, _NUM_HEADINGS, endpoint=False)
# From a thing to poses from which it can be grasped: x, y, heading.
_OFFSETS = np.array([(-d * math.cos(h), -d * math.sin(h), h) for d in _STANDING for h in _HEADINGS])
