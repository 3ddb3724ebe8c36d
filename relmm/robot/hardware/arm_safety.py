"""Which ways of the arm are allowed: inside its limits, above the floor, and not through the robot itself."""

from __future__ import annotations

from itertools import pairwise, permutations

import numpy as np

from relmm.errors import RobotError
from relmm.features import FloatArray
from relmm.geometry import FINGERTIP, JOINT_LIMITS, TOOL_LENGTH, arm_forward

_STEPS = 20  # poses of a way that are looked at
_POINTS = 6  # of each link
_FLOOR = 0.0  # m; the fingers come as near as 2 mm to it when they grasp
# Parts of the robot that the arm could meet, as upright cylinders with a margin for its own thickness, as in the
# simulation's `locobot.xml`: (x, y), radius, and heights, m. The arm folds between the tower's posts.
_BODY = (
    ((0.0, 0.0), 0.178, (-1.0, 0.118)),  # the base
    ((-0.06, 0.062), 0.03, (0.115, 0.545)),
    ((-0.06, -0.062), 0.03, (0.115, 0.545)),
    ((-0.06, 0.0), 0.08, (0.525, 0.62)),  # what joins the posts, and the camera
)
_TOLERANCE = 0.01  # rad; what rounding to ticks may add


def check_way(start: FloatArray, goal: FloatArray) -> None:
    """Refuse a way of the arm that would hurt it.

    A way that begins in a forbidden place may lead out of it: a person may have put the arm there.

    Args:
        start: joints, rad, shape (5,).
        goal: likewise.

    Raises:
        RobotError: says what would happen. Nothing has moved then.
    """
    if np.any(goal < JOINT_LIMITS[:, 0] - _TOLERANCE) or np.any(goal > JOINT_LIMITS[:, 1] + _TOLERANCE):
        raise RobotError(f"The arm was asked to go to {_degrees(goal)} degrees, beyond its limits: nothing has moved.")
    depth, what = _intrusion(start)
    for part in np.linspace(0.0, 1.0, _STEPS):
        deeper, what = _intrusion(start + part * (goal - start))
        if deeper > max(depth, 0.0) + 1e-6:
            raise RobotError(
                f"On its way from {_degrees(start)} to {_degrees(goal)} degrees the arm would meet {what}: nothing has "
                "moved."
            )


def find_way(start: FloatArray, goal: FloatArray) -> list[FloatArray]:
    """Poses that lead from one to another past the robot itself: straight, or else one joint after the other.

    Raises:
        RobotError: there is no such way.
    """
    straight: RobotError | None = None
    for order in ((), *permutations((1, 2, 3))):
        poses = [start.copy()]
        for joint in order:
            poses.append(poses[-1].copy())
            poses[-1][joint] = goal[joint]
        poses.append(goal)
        try:
            for before, after in pairwise(poses):
                check_way(before, after)
        except RobotError as error:
            straight = straight or error
        else:
            return poses[1:]
    assert straight is not None
    raise straight


def _intrusion(joints: FloatArray) -> tuple[float, str]:
    """How deep the arm is in the floor or in the robot, m, and in which; negative or 0 where it is free."""
    points = _points(joints)
    intrusions = [(float(_FLOOR - points[:, 2].min()), "the floor")]
    for (x, y), radius, (low, high) in _BODY:
        inside = (points[:, 2] > low) & (points[:, 2] < high)
        if inside.any():
            distance = np.hypot(points[inside, 0] - x, points[inside, 1] - y)
            intrusions.append((float(radius - distance.min()), "the robot itself"))
    return max(intrusions)


def _points(joints: FloatArray) -> FloatArray:
    """Points of the links beyond the shoulder, m, robot frame, (n, 3)."""
    corners = arm_forward(joints)
    tip = corners[3] + (corners[3] - corners[2]) * FINGERTIP / TOOL_LENGTH
    corners = np.vstack([corners[1:], tip])
    return np.vstack([np.linspace(start, end, _POINTS) for start, end in pairwise(corners)])


def _degrees(joints: FloatArray) -> str:
    return "(" + ", ".join(f"{angle:.0f}" for angle in np.degrees(joints)) + ")"
