"""Pictures of the remembered floor, for people."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from relmm.features import FloatArray
from relmm.policies.relmm.memory import CELL, SIDE, FloorMemory
from relmm.policies.relmm.planning import Plan

_SCALE = 2  # pixels a cell
_HALF = 96  # cells from the robot to the edge of the picture, 2.4 m
_ROBOT = 0.177  # m, radius of the base
# RGB
_UNSEEN, _SEEN, _STANDING = (58, 62, 70), (176, 180, 186), (24, 24, 28)
_PROMISE, _WAY, _TARGET, _BODY = (30, 160, 60), (255, 190, 40), (230, 60, 60), (40, 90, 220)
_LEAST = 0.05  # success that shows


def draw_floor(memory: FloorMemory, success: NDArray[np.float32], plan: Plan | None) -> NDArray[np.uint8]:
    """The remembered floor round the robot, which looks up the picture: dark where nothing was seen from near.

    Args:
        memory: to draw.
        success: that its cells promise: the greener, the more.
        plan: its way (dots) and target (ring); None for none.

    Returns:
        uint8 (384, 384, 3); the robot is the blue disc in the middle.
    """
    unseen = memory.unseen()[..., None]
    colours = unseen * _UNSEEN + (1 - unseen) * _SEEN
    colours = np.where(memory.standing[..., None], _STANDING, colours)
    shown = cv2.dilate(np.where(success > _LEAST, success, 0).astype(np.float32), np.ones((5, 5)))[..., None]
    colours = (1 - shown) * colours + shown * _PROMISE
    picture = cv2.resize(colours.astype(np.uint8), None, fx=_SCALE, fy=_SCALE, interpolation=cv2.INTER_NEAREST)
    if plan is not None:
        for place in plan.way:
            cv2.circle(picture, _pixel(place), 2, _WAY, -1, cv2.LINE_AA)
        cv2.circle(picture, _pixel(plan.target), 7, _TARGET, 2, cv2.LINE_AA)
    here, ahead = memory.pose[:2], memory.to_map(np.array([_ROBOT * 1.8, 0.0]))
    cv2.circle(picture, _pixel(here), round(_ROBOT / CELL * _SCALE), _BODY, 2, cv2.LINE_AA)
    cv2.line(picture, _pixel(here), _pixel(ahead), _BODY, 2, cv2.LINE_AA)
    # Columns of the map run to the left and rows forward; the robot is to look up.
    centre, half = _pixel(here), _HALF * _SCALE
    turn = np.degrees(memory.pose[2])
    to_centre = cv2.getRotationMatrix2D((float(centre[0]), float(centre[1])), -turn, 1.0)
    moved = to_centre + np.array([[0, 0, half - centre[0]], [0, 0, half - centre[1]]])
    turned = cv2.warpAffine(picture, moved, (2 * half, 2 * half), borderValue=_UNSEEN)
    return np.ascontiguousarray(turned[::-1, ::-1])


def _pixel(place: FloatArray) -> tuple[int, int]:
    """Column and row of a place of the map."""
    row, column = np.floor((place / CELL + SIDE / 2) * _SCALE).astype(int)
    return int(column), int(row)
