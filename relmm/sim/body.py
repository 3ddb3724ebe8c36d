"""The LoCoBot's body in MuJoCo: its time is the simulation's, its sensors are all it tells."""

from __future__ import annotations

import math
from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from relmm.features import FloatArray
from relmm.geometry import JOINT_LIMITS, CameraGeometry
from relmm.robot.body import BUMPER_CENTRE, BUMPER_LEFT, BUMPER_RIGHT, MAX_OPENING, BodyState
from relmm.robot.skills import REST_POSE
from relmm.sim.basket import Basket
from relmm.sim.model import CAMERA_NAME, ROBOT, build_model
from relmm.sim.realism import REALISM, Imperfections, Realism
from relmm.sim.renderer import Renderer
from relmm.sim.rooms import Room, set_object, set_objects
from relmm.sim.truth import Truth

_CONTROL_S = 0.02  # s between commands to the servos
_WHEEL_RADIUS, _TRACK = 0.035, 0.230  # m
_MAX_VELOCITY_CHANGE = (2.2 * _CONTROL_S, 600.0 * _CONTROL_S)  # of 2.2 m/s^2 and 600 deg/s^2
_BUMPER_FORCE = 2.0  # N; below that the Kobuki's bumper does not switch
_JOINTS = ("waist", "shoulder", "elbow", "wrist_angle", "wrist_rotate")
_WHEELS = ("wheel_left", "wheel_right")
_MAX_DEPTH = 10.0  # m, the D435's range
_SETTLE_S = 0.3
_STILL = (0.0, 0.0)
PERFECT = REALISM["none"]


class SimBody:
    """A `relmm.robot.body.Body` whose time passes only in `wait`.

    Args:
        room: where the robot is put.
        camera: its camera.
        imperfect: how bad its sensors and wheels are, see `relmm.sim.realism`.
    """

    def __init__(self, room: Room, camera: CameraGeometry, imperfect: Realism = PERFECT) -> None:
        self.camera = camera
        self.room = room
        self.model = build_model(room, camera)
        self.data = mujoco.MjData(self.model)
        self.truth = Truth(self.model, self.data, room)
        self._imperfections = (
            None
            if imperfect == PERFECT
            else Imperfections(imperfect, self.model, ROBOT + CAMERA_NAME, self.truth.object_ids)
        )
        self._basket = Basket(self.model, self.data, self.truth.object_ids)
        self._substeps = round(_CONTROL_S / self.model.opt.timestep)
        self._renderer: Renderer | None = None
        self.watcher: Callable[[], None] | None = None  # called after every control period, to film what happens
        self._base_qpos = self._qpos("base").start
        self._arm_qpos, self._arm_ctrl = self._qpos(*_JOINTS), self._ctrl(*_JOINTS)
        self._wheel_qpos, self._wheel_ctrl = self._qpos(*_WHEELS), self._ctrl(*_WHEELS)
        self._fingers_qpos, self._gripper_ctrl = self._qpos("finger_left", "finger_right"), self._ctrl("gripper")
        self._shell, self._base = self.model.geom(ROBOT + "shell").id, self.model.body(ROBOT + "base").id
        self._forget_commands()

    def _qpos(self, *joints: str) -> slice:
        return _contiguous([int(self.model.joint(ROBOT + name).qposadr[0]) for name in joints])

    def _ctrl(self, *actuators: str) -> slice:
        return _contiguous([self.model.actuator(ROBOT + name).id for name in actuators])

    # --- The room ----------------------------------------------------------------------------------------
    def reset(self, rng: np.random.Generator) -> None:
        """Put the robot into the middle of the room, looking anywhere, and scatter the objects.

        This is the only thing that ever moves something without physics: it starts a new life in a new room.
        """
        mujoco.mj_resetData(self.model, self.data)
        self._basket.empty()
        heading = rng.uniform(-np.pi, np.pi)
        self.data.qpos[self._base_qpos : self._base_qpos + 7] = [
            *(0.0, 0.0, 0.0),
            *(np.cos(heading / 2), 0.0, 0.0, np.sin(heading / 2)),
        ]
        set_objects(self.model, self.data, self.room.scatter(rng))
        if self._imperfections is not None:
            self._imperfections.begin(rng)
        self.data.qpos[self._arm_qpos] = REST_POSE
        self.data.qpos[self._fingers_qpos] = MAX_OPENING / 2
        self._forget_commands()
        self.truth = Truth(self.model, self.data, self.room)
        self.data.ctrl[self._gripper_ctrl] = MAX_OPENING / 2
        self._command_arm()
        self.wait(_SETTLE_S)

    def put_object(self, index: int, place: FloatArray) -> None:
        """Lay one object on the floor at a place in the robot's frame, as a person would; (x, y) in m."""
        x, y, heading = self.truth.robot()
        rotation = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        set_object(self.model, self.data, index, (*(rotation @ place + (x, y)), heading))
        self.wait(_SETTLE_S)

    def _forget_commands(self) -> None:
        self._arm_start = self._arm_goal = REST_POSE
        self._arm_times = (0.0, _CONTROL_S)
        # m/s and deg/s, as plain numbers: arrays of two would cost ten times as much, fifty times a second
        self._velocity = self._velocity_goal = _STILL
        self._commands: list[tuple[float, tuple[float, float]]] = []  # to drive, that are still under way
        self._bumper = 0

    # --- Body --------------------------------------------------------------------------------------------
    def drive(self, x_vel: float, theta_vel: float) -> None:
        """See `Body.drive`."""
        self._basket.stow(self.truth.in_basket())
        if self._imperfections is None:
            self._velocity_goal = (x_vel, theta_vel)
            return
        if (x_vel, theta_vel) != _STILL:
            x_vel, theta_vel = self._imperfections.slip(x_vel, theta_vel)
        self._commands.append((self.data.time + self._imperfections.delay(), (x_vel, theta_vel)))

    def move_arm(self, joints: FloatArray, seconds: float) -> None:
        """See `Body.move_arm`."""
        self._arm_start = self.data.ctrl[self._arm_ctrl].copy()
        self._arm_goal = np.clip(joints, JOINT_LIMITS[:, 0], JOINT_LIMITS[:, 1])
        self._arm_times = (self.data.time, max(seconds, _CONTROL_S))

    def set_gripper(self, opening: float) -> None:
        """See `Body.set_gripper`."""
        self.data.ctrl[self._gripper_ctrl] = min(opening, MAX_OPENING) / 2

    def state(self) -> BodyState:
        """See `Body.state`."""
        qpos = self.data.qpos
        left, right = (angle * _WHEEL_RADIUS for angle in qpos[self._wheel_qpos].tolist())
        tells = self._imperfections
        travel_scale, turn_scale = (1.0, 1.0) if tells is None else (tells.travel_scale, tells.turn_scale)
        return BodyState(
            time=self.data.time,
            travelled=(left + right) / 2 * travel_scale,
            heading=math.degrees((right - left) / _TRACK) * turn_scale,
            joints=qpos[self._arm_qpos].copy(),
            joint_goal=self.data.ctrl[self._arm_ctrl].copy(),
            gripper=sum(qpos[self._fingers_qpos].tolist()),
            bumper=self._bumper,
        )

    def capture(self) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """See `Body.capture`."""
        if self._renderer is None:
            self._renderer = Renderer(self.model, ROBOT + CAMERA_NAME, self.camera.size)
        rgb, depth = self._renderer.render(self.data)
        if self._imperfections is not None:
            rgb, depth = self._imperfections.color(rgb), self._imperfections.depth(depth)
        return rgb, np.where(depth < _MAX_DEPTH, depth * 1000, 0).astype(np.uint16)

    def wait(self, seconds: float) -> None:
        """Advance the simulation, in whole control periods of 20 ms.

        Raises:
            PhysicsError: the simulation has left what is physically possible.
        """
        self._bumper = 0
        for _ in range(max(round(seconds / _CONTROL_S), 1)):
            self._command_wheels()
            self._command_arm()
            self._basket.carry()
            mujoco.mj_step(self.model, self.data, nstep=self._substeps)
            if self._velocity != _STILL:
                self._bumper |= self._read_bumper()
            if self.watcher is not None:
                self.watcher()
        self.truth.check()

    def stop(self) -> None:
        """See `Body.stop`."""
        self._commands.clear()
        self._velocity = self._velocity_goal = _STILL
        self.data.ctrl[self._wheel_ctrl] = 0.0
        self.move_arm(self.data.qpos[self._arm_qpos].copy(), _CONTROL_S)

    def close(self) -> None:
        """See `Body.close`."""
        self.stop()
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    # --- Servos ------------------------------------------------------------------------------------------
    def _command_wheels(self) -> None:
        while self._commands and self._commands[0][0] <= self.data.time:
            self._velocity_goal = self._commands.pop(0)[1]
        if self._velocity == self._velocity_goal:
            return
        forward, turn_rate = map(_approach, self._velocity, self._velocity_goal, _MAX_VELOCITY_CHANGE)
        self._velocity = forward, turn_rate
        turn = math.radians(turn_rate) * _TRACK / 2
        self.data.ctrl[self._wheel_ctrl] = (forward - turn) / _WHEEL_RADIUS, (forward + turn) / _WHEEL_RADIUS

    def _command_arm(self) -> None:
        start, seconds = self._arm_times
        if self.data.time > start + seconds:
            return
        progress = min((self.data.time - start + _CONTROL_S) / seconds, 1.0)
        smooth = progress * progress * (3 - 2 * progress)
        self.data.ctrl[self._arm_ctrl] = self._arm_start + (self._arm_goal - self._arm_start) * smooth

    def _read_bumper(self) -> int:
        contact = self.data.contact
        touching = contact.geom == self._shell
        if not touching.any():
            return 0
        pressed = 0
        force = np.zeros(6)
        for index in np.flatnonzero(touching.any(axis=1)):
            mujoco.mj_contactForce(self.model, self.data, index, force)
            if force[0] > _BUMPER_FORCE:
                pressed |= self._bumper_bit(contact.pos[index])
        return pressed

    def _bumper_bit(self, point: FloatArray) -> int:
        """Which third of the front half a contact point (m, world) touches; nothing at the back."""
        local = self.data.xmat[self._base].reshape(3, 3).T @ (point - self.data.xpos[self._base])
        angle = np.degrees(np.arctan2(local[1], local[0]))
        if abs(angle) > 90:
            return 0
        return BUMPER_CENTRE if abs(angle) < 30 else BUMPER_LEFT if angle > 0 else BUMPER_RIGHT


def _contiguous(indices: list[int]) -> slice:
    """The same as a slice: what it selects is a view, five times cheaper than a selection by numbers."""
    assert indices == list(range(indices[0], indices[0] + len(indices)))
    return slice(indices[0], indices[0] + len(indices))


def _approach(value: float, goal: float, most: float) -> float:
    return value + min(max(goal - value, -most), most)
