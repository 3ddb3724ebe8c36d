"""The basket's contents ride along without rolling about.

A heap of twenty loose balls on a moving robot costs forty times the time of everything else. So an object that was
dropped into the basket by real physics, and lies there, is from then on carried rigidly where it lies. It still stops
what is dropped onto it, but no longer meets the robot or what is carried already.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from relmm.features import FloatArray
from relmm.sim.model import ROBOT


class Basket:
    """Carries objects along with the robot's base.

    Args:
        model, data: of the room with the robot in it.
        objects: body ids of the room's objects.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, objects: NDArray[np.intp]) -> None:
        self._model, self._data, self._objects = model, data, objects
        self._base = model.body(ROBOT + "base").id
        joints = model.body_jntadr[objects]
        self._qpos, self._qvel = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self._free_contype = model.geom_contype.copy()
        self.empty()

    def empty(self) -> None:
        """Carry nothing."""
        self._model.geom_contype[:] = self._free_contype
        self._stowed = np.array([], np.intp)
        self._offsets: FloatArray = np.zeros((0, 3))
        self._rotations: FloatArray = np.zeros((0, 4))

    def stow(self, indices: NDArray[np.intp]) -> None:
        """Carry these objects (their numbers in the room), too, from where they are now."""
        for index in sorted(set(indices.tolist()).difference(self._stowed.tolist())):
            body = self._objects[index]
            offset, rotation, inverse = np.zeros(3), np.zeros(4), np.zeros(4)
            mujoco.mju_negQuat(inverse, self._data.xquat[self._base])
            mujoco.mju_rotVecQuat(offset, self._data.xpos[body] - self._data.xpos[self._base], inverse)
            mujoco.mju_mulQuat(rotation, inverse, self._data.xquat[body])
            self._stowed = np.append(self._stowed, index)
            self._offsets = np.vstack([self._offsets, offset])
            self._rotations = np.vstack([self._rotations, rotation])
            start = self._model.body_geomadr[body]
            self._model.geom_contype[start : start + self._model.body_geomnum[body]] = 0

    def carry(self) -> None:
        """Put what is carried to where the base has moved to; call at every control period."""
        if not self._stowed.size:
            return
        rotation = self._data.xmat[self._base].reshape(3, 3)
        arms = self._offsets @ rotation.T
        velocity = np.zeros(6)  # angular, then linear, in the world's axes
        mujoco.mj_objectVelocity(self._model, self._data, mujoco.mjtObj.mjOBJ_BODY, self._base, velocity, 0)
        qpos, qvel = self._qpos[self._stowed, None], self._qvel[self._stowed, None]
        self._data.qpos[qpos + np.arange(3)] = self._data.xpos[self._base] + arms
        self._data.qpos[qpos + np.arange(3, 7)] = _multiply(self._data.xquat[self._base], self._rotations)
        self._data.qvel[qvel + np.arange(3)] = velocity[3:] + np.cross(velocity[:3], arms)
        self._data.qvel[qvel + np.arange(3, 6)] = 0.0


def _multiply(left: FloatArray, right: FloatArray) -> FloatArray:
    """Quaternion products of one left factor (4,) with many right ones (n, 4)."""
    w, x, y, z = left
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return right @ matrix.T
