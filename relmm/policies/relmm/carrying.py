"""The planned pseudo-reset (paper 4.3): things are put down on free floor, away from walls and from each other.

The paper drives at random, and what it puts down at a wall stays there: its rooms silt up in some thousand steps.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from relmm.features import FloatArray
from relmm.policies.pseudo_reset import PLACE_XY
from relmm.policies.relmm.driving import STEP_LENGTH
from relmm.policies.relmm.memory import CELL, SIDE, FloorMemory, cells
from relmm.policies.relmm.ways import MIDDLE, WAY_PLACES, Ways

_FREE = 0.4  # m to walls, obstacles and other things, where there is such a place
_LEAST_WAY, _MOST_WAY = 0.5, 0.6  # m, and share of the steps there are
_CHOICES = 20  # of the freest places, where none is free enough
_SEEN = 0.5  # of what is known about a place, at least


def choose_place(
    memory: FloorMemory, things: FloatArray, steps: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray] | None:
    """Where to put down what is held.

    Args:
        memory: the remembered floor.
        things: that lie on it, m, (n, 2).
        steps: navigation steps that it may take to get there.
        rng: chooses among the good places.

    Returns:
        The place, m, (2,), and the pose to put it down from, (3,); None where no floor is known.
    """
    clearance = memory.clearance()
    ways = Ways(memory.pose[:2], clearance, things)
    free = np.minimum(clearance, _gaps(things))[MIDDLE, MIDDLE]
    lengths = ways.lengths()
    reachable = (lengths > _LEAST_WAY) & (lengths < max(_MOST_WAY * steps * STEP_LENGTH, 2 * _LEAST_WAY))
    good = reachable & (memory.unseen()[MIDDLE, MIDDLE] < _SEEN)
    if not good.any():
        return None
    enough = good & (free >= _FREE)
    if not enough.any():
        enough = good & (free >= np.sort(free[good])[-_CHOICES:][0])
    places = WAY_PLACES[enough]
    place = places[rng.integers(len(places))]
    offset = place - memory.pose[:2]
    heading = math.atan2(offset[1], offset[0])
    before = place - PLACE_XY[0] * np.array([math.cos(heading), math.sin(heading)])
    return place, np.array([*before, heading])


def is_there(memory: FloorMemory, place: FloatArray, within: float) -> bool:
    """Whether what is put down now would lie within so many m of a place."""
    return float(np.linalg.norm(memory.to_map(np.array(PLACE_XY)) - place)) < within


def _gaps(things: FloatArray) -> NDArray[np.float32]:
    """Distance to the nearest thing, m, (SIDE, SIDE)."""
    empty = np.ones((SIDE, SIDE), np.uint8)
    if not len(things):
        return np.full((SIDE, SIDE), np.inf, np.float32)
    empty[tuple(np.moveaxis(cells(things), -1, 0))] = 0
    gaps: NDArray[np.float32] = cv2.distanceTransform(empty, cv2.DIST_L2, 5) * CELL
    return gaps
