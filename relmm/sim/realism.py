"""A simulated LoCoBot as bad as a real one: its camera, its wheels, its delays, and the room's light and things.

What differs from robot to robot and from day to day is drawn anew with each life; noise is new in each picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from relmm.errors import ConfigError, suggestion
from relmm.features import FloatArray


@dataclass(frozen=True)
class Realism:
    """Half widths of uniform intervals, or standard deviations where it says noise.

    Attributes:
        exposure: factor on brightness, 1 +- this; `white_balance` the same for red and for blue.
        picture_noise: of each pixel, of 255.
        depth_noise: mm at 1 m; it grows with the square of the distance, as of a stereo camera.
        depth_holes: share of the picture in which nothing is measured; at edges always.
        camera_shift: m; `camera_tilt` degrees.
        wheel_scale: of what the encoders tell, 1 +- this; `wheel_slip` of what each drive does.
        delay: s until a command to drive is obeyed, 0 to this, new for each.
        friction, mass: of the things, as factors 1 +- this.
        light: of the room's lamps, as a factor 1 +- this.
    """

    exposure: float = 0.0
    white_balance: float = 0.0
    picture_noise: float = 0.0
    depth_noise: float = 0.0
    depth_holes: float = 0.0
    camera_shift: float = 0.0
    camera_tilt: float = 0.0
    wheel_scale: float = 0.0
    wheel_slip: float = 0.0
    delay: float = 0.0
    friction: float = 0.0
    mass: float = 0.0
    light: float = 0.0


REALISM = {
    "none": Realism(),
    "mild": Realism(
        **{"exposure": 0.1, "white_balance": 0.05, "picture_noise": 2.0, "light": 0.15},
        **{"depth_noise": 2.0, "depth_holes": 0.02, "camera_shift": 0.003, "camera_tilt": 0.5},
        **{"wheel_scale": 0.01, "wheel_slip": 0.03, "delay": 0.04, "friction": 0.2, "mass": 0.2},
    ),
    "harsh": Realism(
        **{"exposure": 0.3, "white_balance": 0.15, "picture_noise": 6.0, "light": 0.4},
        **{"depth_noise": 6.0, "depth_holes": 0.10, "camera_shift": 0.01, "camera_tilt": 1.5},
        **{"wheel_scale": 0.04, "wheel_slip": 0.10, "delay": 0.10, "friction": 0.5, "mass": 0.5},
    ),
}
_EDGE = 30.0  # mm between neighbours, at which a stereo camera measures nothing
_HOLE = 5  # pixels across


def realism(name: str) -> Realism:
    """The realism called `name`.

    Raises:
        ConfigError: there is none.
    """
    if name not in REALISM:
        raise ConfigError(
            f"robot.realism is {name!r}{suggestion(name, REALISM)}, but must be one of {', '.join(REALISM)}."
        )
    return REALISM[name]


class Imperfections:
    """One robot on one day, and what it does to pictures, wheels and a room.

    Args:
        settings: how bad.
        model: of the room with the robot in it; changed.
        camera: name of the robot's camera in it.
        things: ids of the bodies that lie about.
    """

    def __init__(self, settings: Realism, model: mujoco.MjModel, camera: str, things: NDArray[np.integer]) -> None:
        self._settings, self._model, self._things = settings, model, things
        self._camera = model.camera(camera).id
        geoms = np.isin(model.geom_bodyid, things)
        self._geoms = np.flatnonzero(geoms)
        # As built, to draw anew from.
        self._built = (
            model.cam_pos[self._camera].copy(),
            model.cam_quat[self._camera].copy(),
            model.geom_friction[self._geoms].copy(),
            model.body_mass[things].copy(),
            model.body_inertia[things].copy(),
            model.light_diffuse.copy(),
            np.array(model.vis.headlight.ambient),
        )
        self.begin(np.random.default_rng(0))

    def begin(self, rng: np.random.Generator) -> None:
        """Another robot, on another day."""
        settings, model = self._settings, self._model
        self._rng = rng
        position, quaternion, friction, mass, inertia, light, ambient = self._built
        model.cam_pos[self._camera] = position + rng.uniform(-1, 1, 3) * settings.camera_shift
        axis = rng.normal(size=3)
        tilt = np.zeros(4)
        mujoco.mju_axisAngle2Quat(
            tilt, axis / np.linalg.norm(axis), np.radians(settings.camera_tilt * rng.uniform(-1, 1))
        )
        mujoco.mju_mulQuat(model.cam_quat[self._camera], quaternion, tilt)
        model.geom_friction[self._geoms] = friction * self._factor(settings.friction)
        heavier = self._factor(settings.mass)
        model.body_mass[self._things], model.body_inertia[self._things] = mass * heavier, inertia * heavier
        brighter = self._factor(settings.light)
        model.light_diffuse[:] = light * brighter
        model.vis.headlight.ambient[:] = ambient * brighter
        self.travel_scale, self.turn_scale = self._factor(settings.wheel_scale), self._factor(settings.wheel_scale)
        red, blue = self._factor(settings.white_balance), self._factor(settings.white_balance)
        self._gain = np.array([red, 1.0, blue]) * self._factor(settings.exposure)

    def _factor(self, width: float) -> float:
        return float(1 + self._rng.uniform(-1, 1) * width)

    def slip(self, x_vel: float, theta_vel: float) -> tuple[float, float]:
        """What the wheels make of a command."""
        return x_vel * self._factor(self._settings.wheel_slip), theta_vel * self._factor(self._settings.wheel_slip)

    def delay(self) -> float:
        """How long a command is under way, s."""
        return float(self._rng.uniform(0, 1) * self._settings.delay)

    def color(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """As the camera takes it, uint8 (height, width, 3)."""
        noise = self._rng.normal(0, 1, picture.shape) * self._settings.picture_noise
        return np.clip(picture * self._gain + noise, 0, 255).astype(np.uint8)

    def depth(self, metres: FloatArray) -> FloatArray:
        """As a stereo camera measures it: m, (height, width); infinite where it measures nothing."""
        settings = self._settings
        measured = metres + self._rng.normal(0, 1, metres.shape) * settings.depth_noise / 1000 * metres**2
        if settings.depth_holes:
            near: Any = cv2.erode(metres, np.ones((3, 3)))
            far: Any = cv2.dilate(metres, np.ones((3, 3)))
            blobs: Any = cv2.blur(self._rng.random(metres.shape), (_HOLE, _HOLE))
            holes = blobs < np.quantile(blobs, settings.depth_holes)
            measured = np.where(holes | (far - near > _EDGE / 1000), np.inf, measured)
        return np.asarray(measured)
