"""What `relmm-calibrate` measures, each from the robot's own sensors."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from relmm.errors import RobotError
from relmm.features import DRIVE_PULSE_S, FloatArray
from relmm.geometry import CameraGeometry, arm_inverse
from relmm.robot.body import MAX_OPENING
from relmm.robot.hardware import clock
from relmm.robot.hardware.body import LocobotBody
from relmm.robot.hardware.widowx import load_of
from relmm.robot.skills import REST_POSE

_DOWN = math.pi / 2
_TRIALS, _INLIER, _MIN_FLOOR = 200, 0.008, 0.5  # of fitting a plane: m, and the share that has to lie in it
_SPOTS = ((0.33, -0.05), (0.33, 0.05), (0.43, -0.05), (0.43, 0.05), (0.38, 0.0))  # m, where the gripper points
_ABOVE_Z, _TOUCH_Z = 0.10, 0.012
_WALL_PULSES = 6
_LOOKS, _LOOK_S = 40, 0.04
_SETTLE_S = 0.6
_CHANGED = 30  # of 255, by which a sticker changes the floor's colour


def floor_plane(depth: NDArray[np.uint16], lens: FloatArray, rng: np.random.Generator) -> tuple[float, float]:
    """Height (m) and pitch (degrees below the horizontal) of a camera that looks at the floor.

    The plane that most points lie in, by RANSAC, and then the least squares of those.

    Args:
        depth: mm, as the camera takes it, (height, width); 0 where nothing was measured.
        lens: fx, fy, cx, cy, pixels.
        rng: chooses the trials.

    Raises:
        RobotError: most of the picture is no floor.
    """
    rows, columns = np.nonzero(depth)
    z = depth[rows, columns] / 1000.0
    points = np.stack([(columns - lens[2]) / lens[0] * z, (rows - lens[3]) / lens[1] * z, z], axis=-1)
    points = points[:: max(len(points) // 5000, 1)]
    best = np.zeros(len(points), bool)
    for _ in range(_TRIALS):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length > 1e-6:
            inside = np.abs((points - a) @ normal) / length < _INLIER
            best = inside if inside.sum() > best.sum() else best
    if best.mean() < _MIN_FLOOR:
        raise RobotError(
            f"Only {best.mean():.0%} of what the camera sees is floor: clear the floor in front of the robot."
        )
    middle = points[best].mean(axis=0)
    normal = np.linalg.svd(points[best] - middle, full_matrices=False)[2][2]
    normal = normal if normal[1] > 0 else -normal  # down
    return float(middle @ normal), math.degrees(math.asin(min(max(normal[2], -1.0), 1.0)))


def measure_camera(body: LocobotBody, rng: np.random.Generator) -> dict[str, float]:
    """Height and tilt of the camera over an empty floor."""
    _, depth, lens = body.eye.raw()
    height, pitch = floor_plane(depth, lens, rng)
    return {"camera_height": round(height, 4), "camera_pitch": round(pitch, 2)}


def measure_gripper(body: LocobotBody, closed_before: float) -> dict[str, float]:
    """What the gripper tells when its pads touch: it closes on nothing."""
    body.set_gripper(-0.005)
    body.wait(1.5)
    opening = body.arm.state().opening
    body.set_gripper(MAX_OPENING)
    body.wait(1.0)
    return {"closed_opening": round(opening + closed_before, 4)}


def measure_sag(body: LocobotBody, sag_before: FloatArray) -> dict[str, tuple[float, ...]]:
    """How far each joint hangs down, from poses with more and less load; what is corrected already counts."""
    loads, errors = [], []
    for x, z in ((0.32, 0.12), (0.40, 0.12), (0.46, 0.12)):
        goal = arm_inverse(x, 0.0, z, _DOWN)
        body.move_arm(goal, 2.0)
        body.wait(2.0 + _SETTLE_S)
        loads.append(load_of(goal))
        errors.append(body.arm.state().joints - goal)
    body.move_arm(REST_POSE, 2.0)
    body.wait(2.0 + _SETTLE_S)
    load, error = np.array(loads), np.array(errors)
    square = (load**2).sum(axis=0)
    slope = np.divide((load * error).sum(axis=0), square, out=np.zeros(5), where=square > 1e-9)
    return {"sag": tuple(round(float(value), 4) for value in sag_before - slope)}


def measure_arm_delay(body: LocobotBody, delay_before: float) -> dict[str, float]:
    """How long the joints trail behind the motors' profiles: their distance by their speed, on a fast way."""
    body.move_arm(arm_inverse(0.45, 0.0, 0.12, _DOWN), 1.0)
    looks = []
    for _ in range(_LOOKS):
        body.wait(1.0 / _LOOKS)
        looks.append((clock.now(), body.arm.state()))
    body.move_arm(REST_POSE, 2.0)
    body.wait(2.0 + _SETTLE_S)
    times = np.array([time for time, _ in looks])
    goals, joints = (np.array([getattr(state, name) for _, state in looks]) for name in ("goal", "joints"))
    speed = np.gradient(goals, times, axis=0)
    trailing = float(((goals - joints) * speed).sum() / (speed**2).sum())
    # A look of the skills lasts 0.04 s, and joints may be anywhere between two of them: half of it is left to them.
    return {"arm_delay": round(max(trailing + delay_before - _LOOK_S / 2, 0.0), 3)}


def measure_wheels(body: LocobotBody, scale_before: float) -> dict[str, float]:
    """True distance by the one of the encoders: how much nearer a wall comes.

    Raises:
        RobotError: there is no wall straight ahead.
    """
    before, start = _wall(body), body.state().travelled
    for _ in range(_WALL_PULSES):
        body.drive(0.1, 0.0)
        body.wait(DRIVE_PULSE_S)
    body.drive(0.0, 0.0)
    body.wait(_SETTLE_S)
    driven = body.state().travelled - start
    scale = scale_before * (before - _wall(body)) / driven
    return {"wheel_scale": round(scale, 4)}


def _wall(body: LocobotBody) -> float:
    """Distance to what stands upright straight ahead, m from the camera; the median of the middle of the picture."""
    view = body.camera
    _, depth = body.capture()
    points = view.depth_to_points(depth.astype(float))
    middle = points[:, view.size[0] // 2 - 8 : view.size[0] // 2 + 8]
    upright = middle[(middle[..., 2] > 0.08) & (depth[:, view.size[0] // 2 - 8 : view.size[0] // 2 + 8] > 0)]
    if len(upright) < 20:
        raise RobotError("No wall is seen straight ahead: put the robot 0.6 m in front of one, square to it.")
    return float(np.median(upright[:, 0]))


def measure_grasp(
    body: LocobotBody, ask: Callable[[str], None], grasp_before: FloatArray
) -> dict[str, tuple[tuple[float, ...], ...]]:
    """Where the gripper goes for where the camera sees something: guided touches.

    The gripper points at a spot of the floor, a person puts a sticker there, and the camera looks where it is.

    Args:
        body: connected.
        ask: says what to do and waits until it is done.
        grasp_before: correction that the body applies already, (2, 3).
    """
    seen, pointed = [], []
    for spot in _SPOTS:
        before, _ = body.capture()
        _point(body, *spot)
        ask("Put a small sticker, of another colour than the floor, under the middle of the gripper")
        body.move_arm(REST_POSE, 2.0)
        body.wait(2.0 + _SETTLE_S)
        after, _ = body.capture()
        seen.append(_new_spot(before, after, body.camera))
        pointed.append(spot)
        ask("Take the sticker away")
    return {"grasp": _rows(fit_grasp(seen, pointed, grasp_before))}


def fit_grasp(
    seen: Sequence[tuple[float, float]], pointed: Sequence[tuple[float, float]], before: FloatArray
) -> FloatArray:
    """The affine map (2, 3) from where something is seen to where the gripper has to be sent, by least squares.

    Args:
        seen: m, robot frame, (n, 2).
        pointed: where the gripper was asked to point, under the correction `before`.
        before: (2, 3).
    """
    sent = np.column_stack([np.asarray(pointed), np.ones(len(pointed))]) @ before.T
    solution = np.linalg.lstsq(np.column_stack([np.asarray(seen), np.ones(len(seen))]), sent, rcond=None)[0]
    return np.asarray(solution.T)


def _point(body: LocobotBody, x: float, y: float) -> None:
    for z in (_ABOVE_Z, _TOUCH_Z):
        body.move_arm(arm_inverse(x, y, z, _DOWN), 2.0)
        body.wait(2.0 + _SETTLE_S)


def _new_spot(before: NDArray[np.uint8], after: NDArray[np.uint8], view: CameraGeometry) -> tuple[float, float]:
    """Where on the floor (m) two pictures differ.

    Raises:
        RobotError: nowhere, or everywhere.
    """
    change = np.abs(before.astype(int) - after.astype(int)).max(axis=-1)
    rows, columns = np.nonzero(change > _CHANGED)
    if not 1 <= len(rows) <= 400 or max(np.ptp(rows), np.ptp(columns)) > 40:
        raise RobotError(
            f"The camera sees no single new spot ({len(rows)} pixels have changed): use a bright sticker, keep the "
            "light steady, and keep your feet out of the picture."
        )
    weights = change[rows, columns]
    middle = np.array([np.average(columns, weights=weights), np.average(rows, weights=weights)])
    x, y = view.pixel_to_floor(middle)
    return float(x), float(y)


def _rows(matrix: FloatArray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(round(float(value), 5) for value in row) for row in matrix)
