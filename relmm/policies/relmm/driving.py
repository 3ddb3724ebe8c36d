"""Driving along a way: the navigation step from which the rest looks shortest.

The robot turns away by itself from what stands in its way (see `relmm.robot.skills`); that is thought of, too.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from relmm.features import DRIVE_PULSE_S, GRASP_X, GRASP_Y, MAX_THETA_VEL, MAX_X_VEL, FloatArray
from relmm.policies.relmm.memory import CELL, cells
from relmm.policies.relmm.ways import PUSH, PUSHING, TIGHT, Ways

STEP_LENGTH = MAX_X_VEL * DRIVE_PULSE_S  # m
STEP_TURN = math.radians(MAX_THETA_VEL) * DRIVE_PULSE_S  # rad
TURN_SHARE = 0.7  # of a turn that costs steps; the rest happens while driving
_REACH_MARGIN = 0.012  # m inside the grasp area to aim for
# Where its own avoidance looks: rad to the left, m.
_LOOKS = np.array(list(itertools.product((-0.75, -0.4, 0.0, 0.4, 0.75), (0.27, 0.36))))
_MOST_TURNS = 8  # of its avoidance that are thought of
_TURNED_AWAY = 0.5  # of a step after which its own avoidance turns the robot, in steps
_STEPS = np.array(list(itertools.product(np.linspace(0, STEP_LENGTH, 5), np.linspace(-0.999, 0.999, 9) * STEP_TURN)))
_STEPS = _STEPS[np.abs(_STEPS / (STEP_LENGTH, STEP_TURN)).max(axis=1) > 0.2]  # without standing still


def best_step(
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
        rest = rest + _roughness(second, things, clearance) + _TURNED_AWAY * faces(second, clearance)
        return np.asarray(1 + rest.reshape(len(poses), len(_STEPS)).min(axis=1))

    first = _after(pose[None], _STEPS)[0]
    facing = faces(first, clearance)
    # Its own avoidance turns the robot either way, as far as it must.
    ends = np.concatenate([first, *(_turned_away(first[facing], side, clearance) for side in (-1, 1))])
    rest = least_rest(ends)
    if aims is not None:
        rest = np.where(_reaches(ends, aims), 0.0, rest)
    count, turned = len(first), int(facing.sum())
    cost = rest[:count]
    cost[facing] = _TURNED_AWAY + (rest[count : count + turned] + rest[count + turned :]) / 2
    best = int(np.argmin(cost + _roughness(first, things, clearance)))
    return float(_STEPS[best, 0]), float(_STEPS[best, 1])


def _turned_away(poses: FloatArray, side: int, clearance: NDArray[np.float32]) -> FloatArray:
    """Poses, (n, 3), turned to one side until the robot does not see anything in its way any more."""
    turns = side * STEP_TURN * np.arange(1, _MOST_TURNS + 1)
    turned = np.repeat(poses[:, None], _MOST_TURNS, axis=1)
    turned[..., 2] += turns
    clear = ~faces(turned.reshape(-1, 3), clearance).reshape(len(poses), _MOST_TURNS)
    clear[:, -1] = True
    return np.asarray(turned[np.arange(len(poses)), clear.argmax(axis=1)])


def _waypoint(start: FloatArray, way: FloatArray, ways: Ways) -> FloatArray:
    """The farthest place of a way that can be reached in a straight line, at least 20 cm ahead."""
    reached = way[0]
    for place in way:
        line = start + np.linspace(0.3, 1, 8)[:, None] * (place - start)
        if np.any(ways.cost(line) >= 1 + PUSHING) and np.linalg.norm(reached - start) > 0.2:
            return reached
        reached = place
    return reached


def _steps_left(poses: FloatArray, waypoint: FloatArray, heading: float | None) -> FloatArray:
    offset = waypoint - poses[:, :2]
    distance = np.linalg.norm(offset, axis=1)
    near = distance < 0.6 * STEP_LENGTH
    bearing = np.where(near, poses[:, 2], np.arctan2(offset[:, 1], offset[:, 0]))
    turns = np.abs(wrapped(bearing - poses[:, 2]))
    if heading is not None:
        turns = turns + np.abs(wrapped(heading - bearing))
    return np.asarray(distance / STEP_LENGTH + TURN_SHARE * turns / STEP_TURN)


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
    pushed = np.sum(np.linalg.norm(things - poses[:, None, :2], axis=-1) < PUSH, axis=1)
    tight = np.maximum(TIGHT - at(clearance, poses[:, :2]), 0.0)
    return np.asarray(0.6 * pushed + 60.0 * tight)


def faces(poses: FloatArray, clearance: NDArray[np.float32]) -> NDArray[np.bool_]:
    """From which poses, (n, 3), the robot would see an obstacle so near that it turned away of itself."""
    angles = poses[:, 2, None] + _LOOKS[:, 0]
    ahead = poses[:, None, :2] + _LOOKS[:, 1, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return np.asarray((at(clearance, ahead) <= CELL).any(axis=1))


def at(layer: NDArray[np.float32], places: FloatArray) -> NDArray[np.float32]:
    """A layer of the memory at places, m, (..., 2) -> (...)."""
    row, column = np.moveaxis(cells(places), -1, 0)
    return np.asarray(layer[row, column])


def _after(poses: FloatArray, steps: FloatArray) -> FloatArray:
    """Where navigation steps lead: poses (n, 3) and steps (m, 2; m and rad) give (n, m, 3)."""
    heading = poses[:, None, 2] + steps[:, 1] / 2
    moved = steps[:, 0, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return np.concatenate([poses[:, None, :2] + moved, (heading + steps[:, 1] / 2)[..., None]], axis=-1)


def wrapped(angle: FloatArray | float) -> FloatArray:
    """Angles (rad) to -pi..pi."""
    return np.asarray((np.asarray(angle) + math.pi) % (2 * math.pi) - math.pi)
