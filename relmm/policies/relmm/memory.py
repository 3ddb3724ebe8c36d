"""The remembered floor: what the ensemble thinks of the floor around the robot, what stands there, what was tried.

A square of floor in the frame of the wheels' odometry. When the robot nears its edge, the square moves along by whole
cells, and what leaves it is forgotten. Wheels drift, so what is out of view fades with time, and what is in view wins.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from relmm.features import GRASP_X, GRASP_Y, GRID, SCAN_BEARINGS, SCAN_RANGE, FloatArray
from relmm.geometry import moved

CELL = 0.025  # m
SIDE = 256  # cells, 6.4 m
_MARGIN = 56  # cells between the robot and the edge, at least

_UNDER = 0.3  # m round the robot, where floor is no goal of a search
_NEAR = 1.3  # m; floor that was looked at from nearer counts as seen
_TRUST_NEAR, _TRUST_FAR = 0.8, 0.4  # weight of a new look against the older ones
_HIT, _MISS, _SURE = 2.0, 1.0, 4.0  # evidence that something stands in a cell: of a look, and the most there can be
_THERE = 1.0  # evidence from which on something does
_INSIDE = 0.012  # m within the grasp area, where a grasp would be tried
# Navigation steps in which the memory of what is out of view fades to a third: of the floor, and of what stands there.
# Wheels drift, and walls in two places leave no way between them.
_FADE_STEPS, _FADE_STANDING_STEPS = 150.0, 75.0


class FloorGrid:
    """Where the pixels of the ensemble's map lie: one a grasp cell, in the robot's frame.

    Args:
        first_row, first_column: grid index of the nearest and rightmost cell; the grasp area is 0..14.
        known: of which cells the ensemble has an opinion, bool, (rows, columns).
    """

    def __init__(self, first_row: int, first_column: int, known: NDArray[np.bool_]) -> None:
        self.known = known
        self.pitch = np.array([(high - low) / GRID for low, high in (GRASP_X, GRASP_Y)])  # m a pixel
        self.origin = np.array([GRASP_X[0], GRASP_Y[0]]) + (np.array([first_row, first_column]) + 0.5) * self.pitch
        rows, columns = np.indices(known.shape)
        x, y = self.origin[0] + rows * self.pitch[0], self.origin[1] + columns * self.pitch[1]
        self.distance = np.hypot(x, y)
        step = SCAN_BEARINGS[1] - SCAN_BEARINGS[0]
        sector = np.rint((np.degrees(np.arctan2(y, x)) - SCAN_BEARINGS[0]) / step).astype(int)
        self._sector = sector.clip(0, len(SCAN_BEARINGS) - 1)

    def visible(self, scan: FloatArray) -> NDArray[np.bool_]:
        """Which pixels show floor, and not what stands on or before it; `scan` as in `relmm.features.SCAN_NAMES`."""
        # What is only just beside an obstacle may be its edge.
        padded = np.pad(scan, 1, mode="edge")
        nearest = np.minimum(np.minimum(padded[:-2], padded[1:-1]), padded[2:])
        return np.asarray(self.known & (self.distance < nearest[self._sector]))


class FloorMemory:
    """What one robot remembers.

    Args:
        grid: of the maps it is shown.

    Attributes:
        pose: x, y (m, from the middle of the square) and heading (rad) of the robot.
        steps: navigation steps so far.
        mean, std: of the members' success probabilities, 0 where nothing was seen, (SIDE, SIDE), first index along x.
    """

    def __init__(self, grid: FloorGrid) -> None:
        self._grid = grid
        self.pose: FloatArray = np.zeros(3)
        self.steps = 0
        self.mean, self.std = (np.zeros((SIDE, SIDE), np.float32) for _ in range(2))
        self._standing = np.zeros((SIDE, SIDE), np.float32)  # evidence that something does
        self._standing_seen = np.full((SIDE, SIDE), -np.inf, np.float32)
        self._seen = np.full((SIDE, SIDE), -np.inf, np.float32)  # step of the last look
        self._seen_near = np.full((SIDE, SIDE), -np.inf, np.float32)
        self._left_alone = np.full((SIDE, SIDE), -np.inf, np.float32)  # until this step

    # --- Filling ------------------------------------------------------------------------------------------
    def move(self, motion: FloatArray) -> FloatArray:
        """Go along with the robot.

        Args:
            motion: by the wheels, m forward, m left, rad.

        Returns:
            How far the square has moved, m, (2,): places of the map are nearer to 0 by that much now.
        """
        self.pose = moved(self.pose, motion)
        half = SIDE // 2 - _MARGIN
        shift = np.trunc(self.pose[:2] / (half * CELL)).astype(int) * half
        if shift.any():
            self.pose[:2] -= shift * CELL
            for name, empty in _LAYERS.items():
                setattr(self, name, _shifted(getattr(self, name), shift, empty))
        return np.asarray(shift * CELL)

    def look(self, mean: NDArray[np.float32], std: NDArray[np.float32], scan: FloatArray) -> None:
        """Lay what is in view into the map.

        Args:
            mean: of the ensemble on the pixels of the grid.
            std: likewise.
            scan: by `relmm.features.SCAN_NAMES`, m.
        """
        visible = self._grid.visible(scan)
        near = visible & (self._grid.distance < _NEAR)
        trust = np.where(self._grid.distance < _NEAR, _TRUST_NEAR, _TRUST_FAR)
        shown = np.stack([cv2.dilate(each, np.ones((3, 3))) for each in (mean, std)], axis=-1)
        here = self._warp(np.dstack([shown, trust * visible, near]).astype(np.float32))
        weight = here[..., 2]
        new = (self._seen == -np.inf) & (weight > 0.3)
        weight = np.where(new, 1.0, np.where(weight > 0.3, weight, 0.0))
        self.mean += weight * (here[..., 0] - self.mean)
        self.std += weight * (here[..., 1] - self.std)
        self._seen[weight > 0] = self.steps
        self._seen_near[here[..., 3] > 0.5] = self.steps
        # What is too near to be looked at is not worth coming back for.
        _circle(self._seen_near, self.pose[:2], _UNDER, self.steps)
        self._mark_standing(scan, weight > 0)

    def leave_alone(self, place: FloatArray, radius: float, steps: int) -> None:
        """Expect nothing round a place of the map, m, (2,), for a while, whatever it looks like."""
        _circle(self._left_alone, place, radius, self.steps + steps)

    def leave_area_alone(self, steps: int) -> None:
        """Likewise for all that lies well inside the grasp area."""
        around = _around(self.pose[:2], GRASP_X[1] + GRASP_Y[1])
        x, y = np.moveaxis(self.to_robot(PLACES[around]), -1, 0)
        inside = (x > GRASP_X[0] + _INSIDE) & (x < GRASP_X[1] - _INSIDE) & (np.abs(y) < GRASP_Y[1] - _INSIDE)
        self._left_alone[around][inside] = self.steps + steps

    # --- Reading ------------------------------------------------------------------------------------------
    def success(self, std_weight: float) -> NDArray[np.float32]:
        """What a grasp at each cell promises: mean + weight * std, faded where it has long been out of view, 0..1.

        Also where it is left alone: what lies there is not wanted now, but not to be pushed about either.
        """
        fading = np.exp((self._seen - self.steps) / _FADE_STEPS)
        promise = (self.mean + std_weight * self.std).clip(0, 1) * fading
        beside = cv2.dilate(self.standing.astype(np.uint8), np.ones((3, 3))) > 0
        return np.where(beside, 0, promise).astype(np.float32)

    @property
    def left_alone(self) -> NDArray[np.bool_]:
        """Where nothing is expected for now, bool, (SIDE, SIDE)."""
        return np.asarray(self._left_alone > self.steps)

    def is_left_alone(self, places: FloatArray) -> NDArray[np.bool_]:
        """The same for places of the map, m, (n, 2) -> (n,)."""
        row, column = np.moveaxis(cells(places), -1, 0)
        return np.asarray(self._left_alone[row, column] > self.steps)

    @property
    def standing(self) -> NDArray[np.bool_]:
        """Where something stands, bool, (SIDE, SIDE)."""
        return np.asarray(self._standing * np.exp((self._standing_seen - self.steps) / _FADE_STANDING_STEPS) >= _THERE)

    def clearance(self) -> NDArray[np.float32]:
        """Distance to what stands next to each cell, m, (SIDE, SIDE)."""
        free = (~self.standing).astype(np.uint8)
        distance: NDArray[np.float32] = cv2.distanceTransform(free, cv2.DIST_L2, 5) * CELL
        return distance

    def unseen(self) -> NDArray[np.float32]:
        """How little is known of each cell: 1 where nothing was seen from near, 0 where it is in view, (SIDE, SIDE)."""
        unseen = 1 - np.exp((self._seen_near - self.steps) / _FADE_STEPS)
        return np.where(self.left_alone, 0, unseen).astype(np.float32)

    def to_map(self, points: FloatArray) -> FloatArray:
        """Points in the robot's frame, (..., 2), as places of the map, m."""
        cos, sin = math.cos(self.pose[2]), math.sin(self.pose[2])
        return np.asarray(points @ np.array([[cos, sin], [-sin, cos]]) + self.pose[:2])

    def to_robot(self, places: FloatArray) -> FloatArray:
        """Places of the map, (..., 2), as points in the robot's frame, m."""
        cos, sin = math.cos(self.pose[2]), math.sin(self.pose[2])
        return np.asarray((places - self.pose[:2]) @ np.array([[cos, -sin], [sin, cos]]))

    # --- Inside -------------------------------------------------------------------------------------------
    def _warp(self, picture: NDArray[np.float32]) -> NDArray[np.float32]:
        """A picture on the pixels of the grid as it lies on the map, 0 outside."""
        grid, (cos, sin) = self._grid, (math.cos(self.pose[2]), math.sin(self.pose[2]))
        # From the picture's (column, row) to the robot's (x, y), and on to the map's (column, row) = (y, x).
        to_robot = np.array([[0, grid.pitch[0], grid.origin[0]], [grid.pitch[1], 0, grid.origin[1]], [0, 0, 1]])
        to_map = np.array([[cos, -sin, self.pose[0]], [sin, cos, self.pose[1]], [0, 0, 1]])
        to_cell = np.array([[0, 1 / CELL, SIDE / 2 - 0.5], [1 / CELL, 0, SIDE / 2 - 0.5]])
        return np.asarray(cv2.warpAffine(picture, to_cell @ to_map @ to_robot, (SIDE, SIDE), flags=cv2.INTER_LINEAR))

    def _mark_standing(self, scan: FloatArray, free: NDArray[np.bool_]) -> None:
        half = (SCAN_BEARINGS[1] - SCAN_BEARINGS[0]) / 2
        hit = np.flatnonzero(scan < SCAN_RANGE)
        bearings = np.radians(np.array(SCAN_BEARINGS)[hit, None] + np.array([-half, half]))
        ends = self.to_map(scan[hit, None, None] * np.stack([np.cos(bearings), np.sin(bearings)], axis=-1))
        lines = np.zeros((SIDE, SIDE), np.uint8)
        cv2.polylines(lines, list(cells(ends)[..., ::-1].astype(np.int32)), False, 1)
        struck = lines > 0
        self._standing[free & ~struck] -= _MISS
        self._standing[struck] += _HIT
        self._standing.clip(0, _SURE, out=self._standing)
        self._standing_seen[struck | free] = self.steps


_LAYERS = {
    "mean": 0.0,
    "std": 0.0,
    "_standing": 0.0,
    "_standing_seen": -np.inf,
    "_seen": -np.inf,
    "_seen_near": -np.inf,
    "_left_alone": -np.inf,
}


def _shifted(layer: NDArray[np.float32], shift: NDArray[np.intp], empty: float) -> NDArray[np.float32]:
    """A layer after the square has moved by so many cells; what has come in is empty."""
    new = np.full_like(layer, empty)
    to = tuple(slice(max(-s, 0), SIDE - max(s, 0)) for s in shift)
    source = tuple(slice(max(s, 0), SIDE - max(-s, 0)) for s in shift)
    new[to] = layer[source]
    return new


def cells(places: FloatArray) -> NDArray[np.intp]:
    """Indices of the cells that hold places of the map, (..., 2), those outside at its edge."""
    return np.clip(np.floor(places / CELL).astype(np.intp) + SIDE // 2, 0, SIDE - 1)


def _around(place: FloatArray, radius: float) -> tuple[slice, slice]:
    """The cells of a square round a place; all of them would take ten times as long."""
    first, last = cells(place - radius), cells(place + radius) + 1
    return slice(first[0], last[0]), slice(first[1], last[1])


def _circle(layer: NDArray[np.float32], place: FloatArray, radius: float, value: float) -> None:
    """Set the cells of a layer round a place."""
    around = _around(place, radius)
    layer[around][((PLACES[around] - place) ** 2).sum(axis=-1) < radius**2] = value


_AXIS = (np.arange(SIDE) - SIDE / 2 + 0.5) * CELL
PLACES = np.stack(np.meshgrid(_AXIS, _AXIS, indexing="ij"), axis=-1)  # m, the middle of each cell
