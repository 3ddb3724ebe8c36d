"""A LoCoBot of emulators that move the simulated one: a base and an arm at the level of bytes, and a fake D435.

    python emulated_locobot.py FOLDER ROOM NUM_OBJECTS SEED SPEED

FOLDER then holds `kobuki`, `dxl`, `camera` and `time`. With SPEED 0 time passes only while the program that drives it
sleeps, see `emulated_time.py`. It lives until its standard input ends.
"""

from __future__ import annotations

import math
import queue
import struct
import sys
import threading
import time
from multiprocessing.connection import Connection, Listener
from pathlib import Path

import mujoco
import numpy as np
from dynamixel_emulator import GOAL_PWM, DynamixelEmulator, angle_of, locobot_motors
from emulated_time import SharedTime
from kobuki_emulator import TRACK, KobukiEmulator

from relmm.geometry import CAMERAS, CameraGeometry
from relmm.robot.body import MAX_OPENING
from relmm.sim.body import SimBody
from relmm.sim.rooms import make_room, set_object

sys.path.insert(0, str(Path(__file__).parent / "fakes"))
from pyrealsense2 import INTRINSICS

PERIOD_S = 0.02
WHEEL_RADIUS = 0.035
_PATIENCE_S = 5.0
ARM_IDS = (1, 2, 4, 5, 6)


def real_camera() -> CameraGeometry:
    """The camera on the tower: where the drawing says, with a D435's own lens."""
    fov = [
        math.degrees(2 * math.atan(size / 2 / focal))
        for size, focal in ((INTRINSICS.width, INTRINSICS.fx), (INTRINSICS.height, INTRINSICS.fy))
    ]
    place = CAMERAS["d435"]
    return CameraGeometry(place.position, place.pitch, (fov[0], fov[1]), (INTRINSICS.width, INTRINSICS.height))


class EmulatedLocobot:
    """Runs in the thread that makes it.

    Args:
        folder: where the links to its devices go.
        room: name of the simulated room.
        num_objects: in it.
        seed: of it.
        speed: of its time against ours; 0 to let it pass while the program that drives it sleeps.
    """

    def __init__(self, folder: Path, room: str, num_objects: int, seed: int, speed: float) -> None:
        self.body = SimBody(make_room(room, num_objects=num_objects), real_camera())
        self.body.reset(np.random.default_rng(seed))
        self.speed = speed
        self._heading = self.body.truth.robot()[2]
        self._turned = 0.0
        self._gripper_pwm = 0
        self._driven = False  # whether a command came in the last period
        self._lies = self.body.state().joints
        self.person: queue.SimpleQueue[tuple[float, float]] = queue.SimpleQueue()
        self.time = SharedTime(folder / "time")
        motors = locobot_motors()
        self.base = KobukiEmulator(folder / "kobuki", plant=self, threaded=False)
        self.chain = DynamixelEmulator(folder / "dxl", motors, now=self.time.now, moves=False)
        self._publish()
        self._wanted: queue.SimpleQueue[Connection] = queue.SimpleQueue()
        self._listener = Listener(str(folder / "camera"), "AF_UNIX")
        threading.Thread(target=self._listen, daemon=True).start()

    def _let_person_act(self) -> None:
        while not self.person.empty():
            x, y = self.person.get()
            robot_x, robot_y, heading = self.body.truth.robot()
            cos, sin = math.cos(heading), math.sin(heading)
            place = (robot_x + cos * x - sin * y, robot_y + sin * x + cos * y, heading)
            set_object(self.body.model, self.body.data, 0, place)
            mujoco.mj_forward(self.body.model, self.body.data)
            print("put", flush=True)

    def run(self, stopped: threading.Event) -> None:
        due = time.monotonic()
        while not stopped.is_set():
            self._let_person_act()
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
        # Past the simulated body's own limits of acceleration, which are the driver's business here.
        self.body._velocity = self.body._velocity_goal = (x_vel, math.degrees(theta_vel))
        turn = theta_vel * TRACK / 2
        self.body.data.ctrl[self.body._wheel_ctrl] = (x_vel - turn) / WHEEL_RADIUS, (x_vel + turn) / WHEEL_RADIUS
        self._obey()
        self.body.wait(seconds)
        self._publish()

    def sensors(self) -> tuple[float, float, float, int]:
        left, right = self.body.data.qpos[self.body._wheel_qpos] * WHEEL_RADIUS
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
        self.body.move_arm(goal, PERIOD_S)
        if pwm:
            self.body.set_gripper(MAX_OPENING if pwm > 0 else -0.005)
        elif self._gripper_pwm:
            self.body.set_gripper(self.body.state().gripper)
        self._gripper_pwm = pwm

    def _publish(self) -> None:
        state = self.body.state()
        with self.chain.lock:
            for identifier, angle in zip(ARM_IDS, state.joints, strict=True):
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


def main() -> None:
    folder, room, num_objects, seed, speed = sys.argv[1:]
    robot = EmulatedLocobot(Path(folder), room, int(num_objects), int(seed), float(speed))
    stopped = threading.Event()
    asked: queue.SimpleQueue[tuple[float, float]] = queue.SimpleQueue()
    robot.person = asked

    def wait_for_end() -> None:
        for line in sys.stdin:
            order, *numbers = line.split()
            if order == "put":  # as a person: object 0 at x, y in the robot's frame, or out of the way
                asked.put(tuple(map(float, numbers)))
        stopped.set()

    threading.Thread(target=wait_for_end, daemon=True).start()
    print("ready", flush=True)
    robot.run(stopped)
    robot.close()


if __name__ == "__main__":
    main()
