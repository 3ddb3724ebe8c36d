"""Puts the LoCoBot and its camera into a room."""

from __future__ import annotations

from importlib.resources import files

import mujoco
import numpy as np

from relmm.geometry import CameraGeometry
from relmm.sim.rooms import Room

ROBOT = "locobot/"  # before the names of everything that belongs to the robot
CAMERA_NAME = "front"
_LOOKS_SEED = 0  # of the objects' shapes and colours: a room always holds the same things, `scatter` moves them


def build_model(room: Room, camera: CameraGeometry) -> mujoco.MjModel:
    """Compile a room with the robot in it."""
    spec = room.build(np.random.default_rng(_LOOKS_SEED))
    robot = mujoco.MjSpec.from_string(files("relmm.sim").joinpath("locobot.xml").read_text())
    _add_camera(robot.body("base"), camera)
    spec.attach(robot, frame=spec.worldbody.add_frame(), prefix=ROBOT)
    return spec.compile()


def _add_camera(base: mujoco.MjsBody, geometry: CameraGeometry) -> None:
    right, down, forward = geometry.axes
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.stack([right, -down, -forward], axis=1).ravel())  # MuJoCo looks along -z
    camera = base.add_camera(name=CAMERA_NAME, pos=geometry.position, quat=quaternion)
    # A sensor of 1 mm a pixel: focal lengths in mm then equal those in pixels, which need not be square.
    camera.resolution = geometry.size
    camera.sensor_size = np.array(geometry.size) / 1000
    camera.focal_length = geometry.focal / 1000
