"""What the robot concludes from its own sensors: is something in the gripper, is something in the way."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from relmm.features import FloatArray
from relmm.geometry import CameraGeometry, arm_forward

Depth = NDArray[np.unsignedinteger[Any]]

# --- Grasp judgement -----------------------------------------------------------------------------------------
MIN_HELD_OPENING = 0.005  # m; empty pads close to 0, objects are at least 14 mm thick but may be held by an edge
_SEEN_FRACTION = 0.3  # of the points between the pads that must be covered by something
_SEEN_BEYOND = 0.03  # m behind the pads' plane that still counts as in the gripper
_PAD_MARGIN = 0.003  # m beside each pad that is left out

# --- Collision avoidance -------------------------------------------------------------------------------------
OBSTACLE_HEIGHT = (0.08, 0.70)  # m; lower things are objects, higher ones pass over the camera
OBSTACLE_RADIUS = 0.37  # m from the robot's centre: the near half of the graspable area and the way there
OWN_RADIUS = 0.23  # m; nearer points are the robot's own arm at rest and what it carries
_MIN_POINTS = 6  # pixels; fewer are noise


def grips_something(opening: float) -> bool:
    """Whether closed fingers are kept apart; `opening` in m."""
    return opening > MIN_HELD_OPENING


def sees_held_object(depth: Depth, camera: CameraGeometry, joints: FloatArray, opening: float) -> bool:
    """Whether the camera sees something between the finger pads of the lifted, level gripper.

    The arm is presented so that an empty gap shows the floor well behind the gripper. The paper's robot compares two
    pictures instead; knowing where the gripper is makes one enough.

    Args:
        depth: mm along the optical axis, (height, width).
        camera: where the picture was taken from.
        joints: rad, shape (5,).
        opening: m, between the pads.
    """
    tool = arm_forward(joints)[3]
    half = max(opening / 2 - _PAD_MARGIN, 0.001)
    forward, left = np.meshgrid(np.linspace(-0.012, 0.012, 5), np.linspace(-half, half, 5))
    points = tool + np.stack([forward, left, np.zeros_like(forward)], axis=-1).reshape(-1, 3)
    column, row = np.rint(camera.project(points)).astype(int).T
    expected = (points - np.array(camera.position)) @ camera.axes[2]
    measured = depth[np.clip(row, 0, depth.shape[0] - 1), np.clip(column, 0, depth.shape[1] - 1)] / 1000.0
    return bool(np.mean((measured > 0) & (measured < expected + _SEEN_BEYOND)) >= _SEEN_FRACTION)


class ObstacleDetector:
    """Says from one depth picture whether something stands in the graspable area (paper, App. "Collision Avoidance").

    Each pixel's ray is fixed to the robot, so the interval of depths that would put its point inside the zone is
    computed once; a picture then costs two comparisons a pixel.
    """

    def __init__(self, camera: CameraGeometry) -> None:
        width, height = camera.size
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
        rays, origin = camera.rays(pixels), np.array(camera.position)
        depths = np.arange(0.02, 1.2, 0.005)
        points = origin + rays[..., None, :] * depths[:, None]
        radius = np.hypot(points[..., 0], points[..., 1])
        inside = (points[..., 2] > OBSTACLE_HEIGHT[0]) & (points[..., 2] < OBSTACLE_HEIGHT[1])
        inside &= (radius > OWN_RADIUS) & (radius < OBSTACLE_RADIUS) & (points[..., 0] > 0)
        # The zone is convex along nearly every ray: the first and the last sample inside bound it.
        self._near = np.where(inside, depths, np.inf).min(axis=-1) * 1000
        self._far = np.where(inside, depths, -np.inf).max(axis=-1) * 1000

    def obstructed(self, depth: Depth) -> bool:
        """Whether a depth picture (mm, (height, width)) shows something in the way."""
        return int(np.count_nonzero((depth >= self._near) & (depth <= self._far))) >= _MIN_POINTS
