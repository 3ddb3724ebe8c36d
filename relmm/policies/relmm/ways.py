"""The cheapest ways over the remembered floor, to everywhere at once, by Dijkstra's algorithm."""

from __future__ import annotations

import itertools
import math

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from relmm.features import FloatArray
from relmm.policies.relmm.memory import CELL, PLACES, SIDE, cells

TIGHT, ROOMY = 0.24, 0.38  # m to what stands beside the robot: least, and without being turned away by its avoidance
PUSH = 0.21  # m within which the base pushes an object
PUSHING = 3.0  # cost of a metre on which it does, beyond the 1 of a free one
_NARROW, _BLOCKED = 2.0, 50.0  # of one beside something, beyond that 1, and of one that is no way at all
COARSE = 4  # cells of the memory a side of a cell of the ways, 10 cm
MIDDLE = slice(COARSE // 2, None, COARSE)  # of the cells of the memory, those near the middle of a cell of the ways
_WAYS = SIDE // COARSE


class Ways:
    """The cheapest ways from one place to all others.

    Args:
        start: m, (2,).
        clearance: of the memory, m.
        things: that had better not be pushed, m, (n, 2).
    """

    def __init__(self, start: FloatArray, clearance: NDArray[np.float32], things: FloatArray) -> None:
        free = clearance[MIDDLE, MIDDLE]
        pushed: NDArray[np.bool_] = np.zeros((_WAYS, _WAYS), bool)
        if len(things):
            near = np.zeros((SIDE, SIDE), np.uint8)
            near[tuple(np.moveaxis(cells(things), -1, 0))] = 1
            gaps = cv2.distanceTransform(1 - near, cv2.DIST_L2, 5) * CELL
            pushed = gaps[MIDDLE, MIDDLE] < PUSH
        cost = 1.0 + _NARROW * (free < ROOMY) + PUSHING * pushed
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


WAY_PLACES = PLACES[MIDDLE, MIDDLE]  # m, near the middle of each cell of the ways
_TO, _ROWS, _LENGTHS = _neighbours()
