"""Closed-form geometry of the LoCoBot: its camera over the floor, and its 5-joint arm.

Robot frame (`base_footprint`): origin on the floor under the wheel axle, x forward, y left, z up; metres.
Dimensions: Interbotix `mobile_wx200.urdf.xacro` on a Kobuki.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from relmm.errors import ConfigError, RobotError, suggestion
from relmm.features import IMAGE_KEY, IMAGE_SIZE, FloatArray


def moved(pose: FloatArray, motion: FloatArray) -> FloatArray:
    """Where a motion leads that is given in the robot's own frame.

    Args:
        pose: x, y (m) and heading (rad), shape (3,).
        motion: forward, left (m) and turn (rad), shape (3,).
    """
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    forward, left, turn = motion
    return pose + np.array([cos * forward - sin * left, sin * forward + cos * left, turn])


# --- Arm (WidowX-200) ----------------------------------------------------------------------------------------
ARM_BASE = np.array([0.097277, 0.0, 0.10795])  # m, robot frame
WAIST_HEIGHT = 0.066175  # m, above the arm base
SHOULDER_HEIGHT = 0.104825  # m, above the arm base
ELBOW_OFFSET = (0.05, 0.2)  # m, forward and up from the shoulder
FOREARM = 0.2  # m
WRIST_LENGTH = 0.065  # m, from the wrist joint to the rotating part
TOOL_LENGTH = 0.158575  # m, from the wrist joint to the point between the finger pads
FINGERTIP = 0.012  # m beyond that point
UPPER_ARM = float(np.hypot(*ELBOW_OFFSET))
ELBOW_ANGLE = float(np.arctan2(*ELBOW_OFFSET))  # rad, of the upper arm's line against the vertical
# rad: waist, shoulder, elbow, wrist angle, wrist rotation (servo limits of `locobot_wx200.yaml`, rounded inwards)
JOINT_LIMITS = np.array([[-3.14, 3.14], [-1.88, 1.97], [-1.88, 1.62], [-1.74, 2.14], [-3.14, 3.14]])


def arm_inverse(x: float, y: float, z: float, pitch: float, roll: float = 0.0) -> FloatArray:
    """Joint angles that bring the point between the finger pads to a place.

    Args:
        x: m, robot frame, forward.
        y: m, left.
        z: m, above the floor.
        pitch: rad, of the tool against the horizontal; pi/2 points straight down.
        roll: rad, of the wrist.

    Returns:
        Angles of the five joints, rad, shape (5,).

    Raises:
        RobotError: the arm does not reach there.
    """
    dx, dy, dz = np.array([x, y, z]) - ARM_BASE
    reach = np.hypot(dx, dy) - TOOL_LENGTH * np.cos(pitch)
    height = dz + TOOL_LENGTH * np.sin(pitch) - SHOULDER_HEIGHT
    distance = np.hypot(reach, height)
    cos_inner = (UPPER_ARM**2 + FOREARM**2 - distance**2) / (2 * UPPER_ARM * FOREARM)
    if abs(cos_inner) > 1:
        raise RobotError(f"The arm does not reach ({x:.3f}, {y:.3f}, {z:.3f}) m at pitch {np.degrees(pitch):.0f} deg.")
    cos_shoulder = (UPPER_ARM**2 + distance**2 - FOREARM**2) / (2 * UPPER_ARM * distance)
    waist = np.arctan2(dy, dx)
    shoulder = np.pi / 2 - ELBOW_ANGLE - np.arctan2(height, reach) - np.arccos(cos_shoulder)
    elbow = np.pi / 2 + ELBOW_ANGLE - np.arccos(cos_inner)
    joints = np.array([waist, shoulder, elbow, pitch - shoulder - elbow, roll])
    if np.any(joints < JOINT_LIMITS[:, 0]) or np.any(joints > JOINT_LIMITS[:, 1]):
        raise RobotError(f"A joint limit keeps the arm from ({x:.3f}, {y:.3f}, {z:.3f}) m.")
    return joints


def arm_forward(joints: FloatArray) -> FloatArray:
    """Shoulder, elbow, wrist and the point between the finger pads, for joint angles in rad.

    Returns:
        m, robot frame, shape (4, 3).
    """
    waist, shoulder, elbow, wrist, _ = joints
    radius, height = [0.0], [SHOULDER_HEIGHT]
    pitch = 0.0
    for angle, (forward, up) in zip(
        (shoulder, elbow, wrist), (ELBOW_OFFSET, (FOREARM, 0.0), (TOOL_LENGTH, 0.0)), strict=True
    ):
        pitch += angle  # positive pitches down, about +y
        radius.append(radius[-1] + forward * np.cos(pitch) + up * np.sin(pitch))
        height.append(height[-1] - forward * np.sin(pitch) + up * np.cos(pitch))
    r = np.array(radius)
    return ARM_BASE + np.stack([r * np.cos(waist), r * np.sin(waist), np.array(height)], axis=1)


# --- Camera --------------------------------------------------------------------------------------------------
OBJECT_HEIGHT = 0.012  # m; objects are looked at half-way up, or a far one would seem to lie behind its place


@dataclass(frozen=True)
class CameraGeometry:
    """A pinhole camera fixed to the robot, looking forward and down.

    Attributes:
        position: m, robot frame.
        pitch: degrees below the horizontal.
        fov: horizontal and vertical field of view, degrees.
        size: width and height of the picture, pixels. Pixels need not be square.
    """

    position: tuple[float, float, float]
    pitch: float
    fov: tuple[float, float]
    size: tuple[int, int] = (IMAGE_SIZE, IMAGE_SIZE)

    @property
    def focal(self) -> FloatArray:
        """Focal lengths in pixels, (horizontal, vertical)."""
        return np.array(self.size) / 2 / np.tan(np.radians(self.fov) / 2)

    @property
    def axes(self) -> FloatArray:
        """Unit vectors right, down and forward of the camera in the robot frame, as rows, shape (3, 3)."""
        c, s = np.cos(np.radians(self.pitch)), np.sin(np.radians(self.pitch))
        return np.array([[0.0, -1.0, 0.0], [-s, 0.0, -c], [c, 0.0, -s]])

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Directions through pixels, of unit length along the optical axis.

        Args:
            pixels: (column, row), shape (..., 2); the middle of the first pixel is (0, 0).

        Returns:
            Robot frame, shape (..., 3).
        """
        offset = (np.asarray(pixels) + 0.5 - np.array(self.size) / 2) / self.focal
        return offset @ self.axes[:2] + self.axes[2]

    def pixel_to_floor(self, pixels: FloatArray, height: float = 0.0) -> FloatArray:
        """Where pixels see a plane `height` m above the floor: (x, y) in m, shape (..., 2); NaN above the horizon."""
        rays = self.rays(pixels)
        down = np.where(rays[..., 2] < 0, rays[..., 2], np.nan)
        scale = (height - self.position[2]) / down
        return np.array(self.position[:2]) + rays[..., :2] * scale[..., None]

    def project(self, points: FloatArray) -> FloatArray:
        """Pixels (column, row) of points in the robot frame, (..., 3) m -> (..., 2); NaN behind the camera."""
        right, down, forward = np.moveaxis((np.asarray(points) - np.array(self.position)) @ self.axes.T, -1, 0)
        forward = np.where(forward > 0, forward, np.nan)
        return np.stack([right, down], -1) / forward[..., None] * self.focal + np.array(self.size) / 2 - 0.5

    def depth_to_points(self, depth: FloatArray) -> FloatArray:
        """Points in the robot frame of a depth picture.

        Args:
            depth: distance along the optical axis, mm, shape (height, width); 0 where nothing was measured.

        Returns:
            m, shape (height, width, 3).
        """
        width, height = self.size
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
        return np.array(self.position) + self.rays(pixels) * (depth[..., None] / 1000.0)


# `paper`: the authors' simulated camera. `d435`: a RealSense D435 at the authors' tilt of 0.825 rad on the LoCoBot's
# small tower; 640x480, squeezed to a square picture as they did.
CAMERAS = {
    "paper": CameraGeometry(position=(0.067, 0.0, 0.591), pitch=42.1, fov=(60.0, 60.0)),
    "d435": CameraGeometry(position=(0.0844, 0.0175, 0.4626), pitch=47.27, fov=(57.0, 44.3)),
}


def camera_geometry(name: str) -> CameraGeometry:
    """The camera called `name`.

    Raises:
        ConfigError: there is no such camera.
    """
    if name not in CAMERAS:
        raise ConfigError(f"Unknown camera {name!r}{suggestion(name, CAMERAS)}: choose one of {', '.join(CAMERAS)}.")
    return CAMERAS[name]


def camera_info(name: str) -> dict[str, Any]:
    """What a dataset says about the camera that took its pictures, plain JSON values.

    Raises:
        ConfigError: there is no such camera.
    """
    camera = camera_geometry(name)
    return {"name": name, "position": list(camera.position), "pitch": camera.pitch, "fov": list(camera.fov)}


def other_camera(features: dict[str, Any], wanted: str | None) -> tuple[str, str] | None:
    """The camera of a dataset and the wanted one, in words, if both are known and differ.

    Args:
        features: of the dataset, as LeRobot stores them.
        wanted: its name, None for any.
    """
    feature = features.get(IMAGE_KEY)
    info = feature.get("info") if isinstance(feature, dict) else None
    have = info.get("camera") if isinstance(info, dict) else None
    want = None if wanted is None else camera_info(wanted)
    return None if None in (have, want) or have == want else (describe_camera(have), describe_camera(want))


def describe_camera(camera: Any) -> str:
    """The camera of a picture's `info` in words."""
    if not isinstance(camera, dict):
        return repr(camera)
    details = ", ".join(f"{key} {value}" for key, value in camera.items() if key != "name")
    return f"{camera.get('name')} ({details})"
