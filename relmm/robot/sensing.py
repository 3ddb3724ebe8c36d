"""What the robot concludes from its own sensors: is something in the gripper, in the way, or against the arm."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relmm.features import SCAN_BEARINGS, SCAN_RANGE, FloatArray
from relmm.geometry import ARM_BASE, FINGERTIP, TOOL_LENGTH, CameraGeometry, arm_forward
from relmm.robot.body import BodyState

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
_SCAN_POINTS = 3  # the same in one sector of a scan
_SECTOR = SCAN_BEARINGS[1] - SCAN_BEARINGS[0]  # degrees
_ARM_REACH = 0.65  # m from the robot's centre; no part of the arm gets farther
_ARM_HALF_WIDTH, _ARM_HALF_THICKNESS = 0.045, 0.025  # m, of the open gripper, with 7 mm to spare

# --- Stopping on contact -------------------------------------------------------------------------------------
# Over 46,000 looks at normal grasps and placements in the four rooms: 0.032 rad, 0.4 mm and 0.4 degrees at most.
_MAX_LAG = 0.06  # rad between the joints and where they were to be a look earlier; the servos trail by about that time
# m back and degrees that the base seems to move by its wheels while the arm does; pushed, it slides ten times as far.
# Never forward: the arm reaches ahead, and a base that creeps over an object under it may go either way.
_MAX_SHOVE, _MAX_SWIVEL = 0.0015, 1.5


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

    Also whether something stands in the arm's way, and how far away something stands in each direction: always things
    that are higher than the objects.

    Each pixel's ray is fixed to the robot, so the interval of depths that would put its point inside the zone is
    computed once; a picture then costs two comparisons a pixel.
    """

    def __init__(self, camera: CameraGeometry) -> None:
        width, height = camera.size
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
        self._rays, self._origin = camera.rays(pixels), np.array(camera.position)
        depths = np.arange(0.02, 1.2, 0.005)
        points = self._origin + self._rays[..., None, :] * depths[:, None]
        radius = np.hypot(points[..., 0], points[..., 1])
        inside = (points[..., 2] > OBSTACLE_HEIGHT[0]) & (points[..., 2] < OBSTACLE_HEIGHT[1])
        inside &= (radius > OWN_RADIUS) & (radius < OBSTACLE_RADIUS) & (points[..., 0] > 0)
        # The zone is convex along nearly every ray: the first and the last sample inside bound it.
        self._near = np.where(inside, depths, np.inf).min(axis=-1) * 1000
        self._far = np.where(inside, depths, -np.inf).max(axis=-1) * 1000
        down = np.maximum(-self._rays[..., 2], 1e-9)
        self._over_objects = (self._origin[2] - OBSTACLE_HEIGHT[0]) / down * 1000  # mm; nearer is higher

    def obstructed(self, depth: Depth) -> bool:
        """Whether a depth picture (mm, (height, width)) shows something in the way."""
        return int(np.count_nonzero((depth >= self._near) & (depth <= self._far))) >= _MIN_POINTS

    def obstructs_arm(self, depth: Depth, poses: Iterable[FloatArray]) -> bool:
        """Whether a depth picture shows something higher than the objects where the arm is going to be.

        Args:
            depth: mm, (height, width), with the arm at rest.
            poses: of the arm on its way, rad, each of shape (5,).
        """
        points, distances = self._points(depth)
        points = points[distances < _ARM_REACH]
        return len(points) >= _MIN_POINTS and any(_points_in_arm(points, pose) >= _MIN_POINTS for pose in poses)

    def scan(self, depth: Depth) -> FloatArray:
        """How far the nearest thing higher than the objects is in each direction, m, by `relmm.features.SCAN_NAMES`.

        As ROS's depthimage_to_laserscan does for one row, but for all heights that would stop the robot, and measured
        from the robot's centre.

        Args:
            depth: mm, (height, width), with the arm at rest.
        """
        points, distances = self._points(depth)
        sectors = np.rint((np.degrees(np.arctan2(points[:, 1], points[:, 0])) - SCAN_BEARINGS[0]) / _SECTOR).astype(int)
        inside = (points[:, 2] < OBSTACLE_HEIGHT[1]) & (sectors >= 0) & (sectors < len(SCAN_BEARINGS))
        sectors, distances = sectors[inside], distances[inside]
        order = np.lexsort((distances, sectors))
        seen, first, count = np.unique(sectors[order], return_index=True, return_counts=True)
        enough = count >= _SCAN_POINTS
        scan = np.full(len(SCAN_BEARINGS), SCAN_RANGE)
        scan[seen[enough]] = distances[order][first[enough] + _SCAN_POINTS - 1]
        return np.minimum(scan, SCAN_RANGE)

    def _points(self, depth: Depth) -> tuple[FloatArray, FloatArray]:
        """Points that are higher than the objects and not the robot's own: m, (n, 3), and their distances."""
        high = (depth > 0) & (depth < self._over_objects)
        points = self._origin + self._rays[high] * (depth[high, None] / 1000.0)
        distances = np.hypot(points[:, 0], points[:, 1])
        beside = distances > OWN_RADIUS
        return points[beside], distances[beside]


def _points_in_arm(points: FloatArray, joints: FloatArray) -> int:
    """How many points (m, robot frame, (n, 3)) the arm would touch: it moves in the vertical plane of its waist."""
    forward = np.array([np.cos(joints[0]), np.sin(joints[0])])
    offset = points[:, :2] - ARM_BASE[:2]
    beside = np.abs(offset @ (-forward[1], forward[0])) < _ARM_HALF_WIDTH
    plane = np.column_stack([offset @ forward, points[:, 2]])[beside]
    corners = arm_forward(joints)
    corners = np.vstack([corners, corners[3] + (corners[3] - corners[2]) * FINGERTIP / TOOL_LENGTH])
    links = np.column_stack([(corners[:, :2] - ARM_BASE[:2]) @ forward, corners[:, 2]])
    distances = [_distance(plane, start, end) for start, end in pairwise(links)]
    return int(np.count_nonzero(np.min(distances, axis=0) < _ARM_HALF_THICKNESS))


def _distance(points: FloatArray, start: FloatArray, end: FloatArray) -> FloatArray:
    """From points (n, 2) to the line between two."""
    line = end - start
    along = np.clip((points - start) @ line / (line @ line), 0.0, 1.0)
    return np.hypot(*(points - start - along[:, None] * line).T)


class ContactDetector:
    """Says whether a moving arm meets resistance: it lags behind its goal, or pushes the standing base away.

    A servo trails its moving goal by some hundredths of a second, so the plain difference of the two says more about
    its speed than about what stops it. A joint that nothing stops is where its goal was at the last look, or on its way
    to where it is now: looks at a real robot are not evenly spaced. Made for one motion; ask it at every look.

    Args:
        start: the sensors before the motion.
    """

    def __init__(self, start: BodyState) -> None:
        self._start, self._goal = start, start.joint_goal

    def touches(self, state: BodyState) -> bool:
        """Whether something stops the arm; `state` is the sensors now."""
        goals = self._goal, state.joint_goal
        lag = float(np.abs(state.joints - np.clip(state.joints, np.minimum(*goals), np.maximum(*goals))).max())
        self._goal = state.joint_goal
        shove, swivel = self._start.travelled - state.travelled, state.heading - self._start.heading
        return lag > _MAX_LAG or shove > _MAX_SHOVE or abs(swivel) > _MAX_SWIVEL
