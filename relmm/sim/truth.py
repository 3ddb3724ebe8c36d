"""What only the simulator knows. For evaluation, tests and error detection; nothing that acts or learns reads it."""

from __future__ import annotations

import logging
import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from relmm.errors import PhysicsError
from relmm.features import BASKET_XY, FloatArray
from relmm.sim.model import ROBOT
from relmm.sim.rooms import OBJECT_PREFIX, Room

logger = logging.getLogger(__name__)

_HELD_DISTANCE = 0.045  # m between an object's centre and the point between the pads
_HELD_HEIGHT = 0.04  # m, as in the authors' simulator
_BASKET_SIZE = (0.060, 0.045)  # m, half the basket's inner length and width
_BASKET_HEIGHT = (0.11, 0.24)  # m
_MAX_TILT = 0.94  # cosine; 20 degrees
_FALLEN_BELOW = -0.02  # m
_NONE = np.array([], np.intp)


class Truth:
    """Reads where things really are."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, room: Room) -> None:
        self._data, self._room = data, room
        names = [model.body(i).name for i in range(model.nbody)]
        self.object_ids = np.array([i for i, name in enumerate(names) if name.startswith(OBJECT_PREFIX)])
        self._base = model.body(ROBOT + "base").id
        self._tool = model.site(ROBOT + "tool").id
        self._limits = np.array([room.size[0] / 2, room.size[1] / 2])
        self._reported: set[int] = set()

    def objects(self) -> FloatArray:
        """Centres of the objects, m, world frame, shape (n, 3)."""
        return self._data.xpos[self.object_ids].copy()

    def objects_in_robot_frame(self) -> FloatArray:
        """Centres of the objects, m, robot frame, shape (n, 3)."""
        rotation = self._data.xmat[self._base].reshape(3, 3)
        return (self.objects() - self._data.xpos[self._base]) @ rotation

    def robot(self) -> tuple[float, float, float]:
        """The robot's x, y (m) and heading (rad) in the room."""
        rotation = self._data.xmat[self._base].reshape(3, 3)
        x, y = self._data.xpos[self._base][:2]
        return float(x), float(y), float(np.arctan2(rotation[1, 0], rotation[0, 0]))

    def held(self) -> bool:
        """Whether an object is off the floor between the finger pads."""
        objects = self.objects()
        near = np.linalg.norm(objects - self._data.site_xpos[self._tool], axis=1) < _HELD_DISTANCE
        return bool(np.any(near & (objects[:, 2] > _HELD_HEIGHT)))

    def in_robot_frame(self, xy: FloatArray) -> FloatArray:
        """A place of the room, m, (2,), as the robot would name it."""
        x, y, heading = self.robot()
        cos, sin = math.cos(heading), math.sin(heading)
        return np.array([[cos, sin], [-sin, cos]]) @ (xy - (x, y))

    def carried(self) -> NDArray[np.intp]:
        """Numbers of the objects that lie off the floor: in the gripper or the basket."""
        return np.flatnonzero(self.objects()[:, 2] > _HELD_HEIGHT)

    def in_basket(self) -> NDArray[np.intp]:
        """Numbers of the objects that lie in the robot's basket."""
        x, y, z = self.objects_in_robot_frame().T
        inside = (np.abs(x - BASKET_XY[0]) < _BASKET_SIZE[0]) & (np.abs(y - BASKET_XY[1]) < _BASKET_SIZE[1])
        return np.flatnonzero(inside & (z > _BASKET_HEIGHT[0]) & (z < _BASKET_HEIGHT[1]))

    def lost(self) -> NDArray[np.intp]:
        """Numbers of the objects that physics has let through a wall or the floor."""
        objects = self._data.xpos[self.object_ids]
        outside = np.abs(objects[:, :2]) > self._limits
        fallen = objects[:, 2] < _FALLEN_BELOW
        if not outside.any() and not fallen.any():  # nearly always, and this is asked at every wait
            return _NONE
        return np.flatnonzero(outside.any(axis=1) | fallen)

    def check(self) -> None:
        """Report what cannot be.

        Raises:
            PhysicsError: numbers are no longer finite, or the robot has fallen over or left the room.
        """
        qpos, qvel = self._data.qpos, self._data.qvel
        if not math.isfinite(qpos @ qpos + qvel @ qvel):  # the cheapest way to look at every number
            raise PhysicsError(f"The simulation became unstable at {self._data.time:.2f} s; please report the seed.")
        x, y = self._data.xpos[self._base, :2].tolist()
        if abs(x) > self._room.size[0] / 2 or abs(y) > self._room.size[1] / 2:
            raise PhysicsError(f"The robot left the room at ({x:.2f}, {y:.2f}) m, {self._data.time:.2f} s.")
        if self._data.xmat[self._base, 8] < _MAX_TILT:
            raise PhysicsError(f"The robot tipped over at {self._data.time:.2f} s.")
        for index in set(self.lost().tolist()) - self._reported:
            self._reported.add(index)
            logger.warning("Object %d left the room through a wall or the floor at %.2f s.", index, self._data.time)
