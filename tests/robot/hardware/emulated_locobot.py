"""A LoCoBot of emulators that move the simulated one: a base and an arm at the level of bytes, and a fake D435.

    python emulated_locobot.py FOLDER ROOM NUM_OBJECTS SEED SPEED FAULTS

FOLDER then holds `kobuki`, `dxl`, `camera` and `time`. With SPEED 0 time passes only while the program that drives it
sleeps, see `emulated_time.py`. FAULTS are those of `Faults`, as JSON. It lives until its standard input ends, which
tells what a person does: the methods of `Person`.
"""

from __future__ import annotations

import json
import math
import queue
import struct
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection, Listener
from pathlib import Path

import mujoco
import numpy as np
from dynamixel_emulator import GOAL_PWM, DynamixelEmulator, angle_of, locobot_motors
from emulated_time import SharedTime
from kobuki_emulator import TRACK, KobukiEmulator

from relmm.geometry import CAMERAS, CameraGeometry, arm_forward
from relmm.robot.body import MAX_OPENING
from relmm.sim.body import SimBody
from relmm.sim.rooms import OBJECT_PREFIX, make_room, set_object

sys.path.insert(0, str(Path(__file__).parent / "fakes"))
from pyrealsense2 import INTRINSICS

PERIOD_S = 0.02
WHEEL_RADIUS = 0.035
_PATIENCE_S = 5.0
_STUCK = 1e6  # N s/m: a sticker does not move
ARM_IDS = (1, 2, 4, 5, 6)


@dataclass(frozen=True)
class Faults:
    """How this robot differs from the drawing.

    Args:
        wheel_scale: true distance by the one that the encoders tell.
        waist: degrees that the waist stands further left than its motor tells.
        camera_height, camera_pitch: m and degrees more than the drawing says.
    """

    wheel_scale: float = 1.0
    waist: float = 0.0
    camera_height: float = 0.0
    camera_pitch: float = 0.0


def real_camera(faults: Faults) -> CameraGeometry:
    """The camera on the tower, with a D435's own lens."""
    fov = [
        math.degrees(2 * math.atan(size / 2 / focal))
        for size, focal in ((INTRINSICS.width, INTRINSICS.fx), (INTRINSICS.height, INTRINSICS.fy))
    ]
    (x, y, z), pitch = CAMERAS["d435"].position, CAMERAS["d435"].pitch + faults.camera_pitch
    size = (INTRINSICS.width, INTRINSICS.height)
    return CameraGeometry((x, y, z + faults.camera_height), pitch, (fov[0], fov[1]), size)


class EmulatedLocobot:
    """Runs in the thread that makes it.

    Args:
        folder: where the links to its devices go.
        room: name of the simulated room.
        num_objects: in it.
        seed: of it.
        speed: of its time against ours; 0 to let it pass while the program that drives it sleeps.
        faults: of this robot.
    """

    def __init__(self, folder: Path, room: str, num_objects: int, seed: int, speed: float, faults: Faults) -> None:
        self.faults, self._waist = faults, np.array([math.radians(faults.waist), 0, 0, 0, 0])
        self.body = SimBody(make_room(room, num_objects=num_objects), real_camera(faults))
        self.body.reset(np.random.default_rng(seed))
        self.speed = speed
        self._heading = self.body.truth.robot()[2]
        self._turned = 0.0
        self._gripper_pwm = 0
        self._driven = False  # whether a command came in the last period
        self._lies = self.body.state().joints - self._waist
        self.orders: queue.SimpleQueue[Callable[[], Sequence[float] | None]] = queue.SimpleQueue()
        self.time = SharedTime(folder / "time")
        motors = locobot_motors()
        self.base = KobukiEmulator(folder / "kobuki", plant=self, threaded=False)
        self.chain = DynamixelEmulator(folder / "dxl", motors, now=self.time.now, moves=False)
        self._publish()
        self._wanted: queue.SimpleQueue[Connection] = queue.SimpleQueue()
        self._listener = Listener(str(folder / "camera"), "AF_UNIX")
        threading.Thread(target=self._listen, daemon=True).start()

    def run(self, stopped: threading.Event) -> None:
        due = time.monotonic()
        while not stopped.is_set():
            while not self.orders.empty():
                seen = self.orders.get()()
                mujoco.mj_forward(self.body.model, self.body.data)
                print("done", *(seen or ()), flush=True)
            self._show_pictures()
            if self.speed:
                self._tick()
                due = max(due + PERIOD_S / self.speed, time.monotonic() - 0.2)
                time.sleep(max(due - time.monotonic(), 0.0))
            elif self.time.now() + 1e-9 < self.time.allowed():
                self._tick()
            else:
                time.sleep(0.0002)

    def _tick(self) -> None:
        self.time.advance(PERIOD_S)
        heard = len(self.base.commands)
        self.base.tick()
        if not self.speed:
            self._wait_for_command(heard)

    def _wait_for_command(self, heard: int) -> None:
        """A driver answers long before the next 20 ms are over. This one may be kept waiting by the machine."""
        until = time.monotonic() + (_PATIENCE_S if self._driven else 0.0)
        while len(self.base.commands) == heard and time.monotonic() < until:
            time.sleep(0.0002)
            self.base.receive()
        self._driven = len(self.base.commands) > heard

    # --- What the base moves -----------------------------------------------------------------------------
    def step(self, seconds: float, x_vel: float, theta_vel: float) -> None:
        x_vel *= self.faults.wheel_scale
        # Past the simulated body's own limits of acceleration, which are the driver's business here.
        self.body._velocity = self.body._velocity_goal = (x_vel, math.degrees(theta_vel))
        turn = theta_vel * TRACK / 2
        self.body.data.ctrl[self.body._wheel_ctrl] = (x_vel - turn) / WHEEL_RADIUS, (x_vel + turn) / WHEEL_RADIUS
        self._obey()
        self.body.wait(seconds)
        self._publish()

    def sensors(self) -> tuple[float, float, float, int]:
        left, right = self.body.data.qpos[self.body._wheel_qpos] * WHEEL_RADIUS / self.faults.wheel_scale
        heading = self.body.truth.robot()[2]
        self._turned += (heading - self._heading + math.pi) % math.tau - math.pi
        self._heading = heading
        return left, right, math.degrees(self._turned), self.body.state().bumper

    # --- What the motors move ----------------------------------------------------------------------------
    def _obey(self) -> None:
        with self.chain.lock:
            now, motors = self.chain.now(), self.chain.motors
            goal = np.array(
                [
                    motors[i].to_angle(motors[i].trajectory(now)) if motors[i].torque else lies
                    for i, lies in zip(ARM_IDS, self._lies, strict=True)
                ]
            )
            self._lies = goal  # a limp arm lies on the robot, and stays there
            for head in (10, 11):
                motors[head].step(now, PERIOD_S)
            pwm = motors[7].get(GOAL_PWM, signed=True) if motors[7].torque else 0
        self.body.move_arm(goal + self._waist, PERIOD_S)
        if pwm:
            self.body.set_gripper(MAX_OPENING if pwm > 0 else -0.005)
        elif self._gripper_pwm:
            self.body.set_gripper(self.body.state().gripper)
        self._gripper_pwm = pwm

    def _publish(self) -> None:
        state = self.body.state()
        with self.chain.lock:
            for identifier, angle in zip(ARM_IDS, state.joints - self._waist, strict=True):
                self.chain.motors[identifier].angle = float(angle)
            self.chain.motors[3].angle = self.chain.motors[2].angle
            self.chain.motors[7].angle = angle_of(state.gripper)

    # --- What the camera sees ----------------------------------------------------------------------------
    def _listen(self) -> None:
        while True:
            connection = self._listener.accept()
            threading.Thread(target=self._ask, args=(connection,), daemon=True).start()

    def _ask(self, connection: Connection) -> None:
        try:
            while True:
                connection.recv()
                self._wanted.put(connection)
        except (EOFError, OSError):
            return

    def _show_pictures(self) -> None:
        if self._wanted.empty():
            return
        rgb, depth = self.body.capture()
        taken = struct.pack("d", self.time.now())
        while not self._wanted.empty():
            connection = self._wanted.get()
            try:
                connection.send_bytes(taken)
                connection.send_bytes(rgb.tobytes())
                connection.send_bytes(depth.tobytes())
            except OSError:
                pass

    def close(self) -> None:
        self._listener.close()
        self.chain.close()
        self.base.close()
        self.body.close()


class Person:
    """What a person may do to the robot and its room; lengths in m, in the robot's frame.

    Args:
        robot: it.
    """

    def __init__(self, robot: EmulatedLocobot) -> None:
        self._body = robot.body

    def put(self, x: float, y: float) -> None:
        """Lay the first object down."""
        robot_x, robot_y, heading = self._body.truth.robot()
        cos, sin = math.cos(heading), math.sin(heading)
        place = (robot_x + cos * x - sin * y, robot_y + sin * x + cos * y, heading)
        set_object(self._body.model, self._body.data, 0, place)

    def stick(self) -> None:
        """Put a sticker onto the floor under the middle of the gripper: the first object, pressed flat."""
        model = self._body.model
        (geom,) = np.flatnonzero(model.geom_bodyid == model.body(f"{OBJECT_PREFIX}00").id)
        model.geom_type[geom], model.geom_size[geom] = mujoco.mjtGeom.mjGEOM_CYLINDER, (0.008, 0.0005, 0.0)
        model.geom_contype[geom] = model.geom_conaffinity[geom] = 0
        joint = model.joint(f"{OBJECT_PREFIX}00")
        model.qpos0[joint.qposadr[0] + 2] = 0.001  # where `put` lays it
        model.dof_damping[joint.dofadr[0] : joint.dofadr[0] + 6] = _STUCK
        self.put(*self.gripper())

    def gripper(self) -> tuple[float, float]:
        """Look where the middle of the gripper is above the floor."""
        x, y, _ = arm_forward(self._body.state().joints)[3]
        return float(x), float(y)

    def stands(self) -> tuple[float, float, float]:
        """Look where the robot stands in the room: x, y and its heading in rad."""
        x, y, heading = self._body.truth.robot()
        return float(x), float(y), float(heading)

    def carry(self, x: float, y: float, degrees: float) -> None:
        """Carry the robot to a place of the room, heading there."""
        half = math.radians(degrees) / 2
        start = self._body._base_qpos
        self._body.data.qpos[start : start + 7] = (x, y, 0.0, math.cos(half), 0.0, 0.0, math.sin(half))


def main() -> None:
    folder, room, num_objects, seed, speed, faults = sys.argv[1:]
    settings = Faults(**json.loads(faults))
    robot = EmulatedLocobot(Path(folder), room, int(num_objects), int(seed), float(speed), settings)
    stopped, person = threading.Event(), Person(robot)

    def listen() -> None:
        for line in sys.stdin:
            order, *numbers = line.split()
            robot.orders.put(partial(getattr(person, order), *map(float, numbers)))
        stopped.set()

    threading.Thread(target=listen, daemon=True).start()
    print("ready", flush=True)
    robot.run(stopped)
    robot.close()


if __name__ == "__main__":
    main()
