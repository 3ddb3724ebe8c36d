"""Whether a robot's life of days grows in memory or slows down: 100,000 frames on a simulated clock.

    python benchmarks/long_run.py --frames 100000

What runs is what runs on a robot: the skills, the robot, its life, the recorder with its writing process, and the
learner that takes each attempt; a random policy acts, and pictures come from the sample dataset. Only the body is none:
it rolls as it is told, closes its fingers on nothing, and its time passes at once.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from csv_table import write_table
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from numpy.typing import NDArray

from relmm.commands.policies import make_actor
from relmm.episodes import EpisodeRecorder
from relmm.features import IMAGE_KEY, FloatArray, Phase
from relmm.geometry import CAMERAS, CameraGeometry
from relmm.learning.life import Life
from relmm.policies.random.configuration_random import RelmmRandomConfig
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy
from relmm.robot.body import BodyState
from relmm.robot.hardware.config_locobot import LocobotConfig
from relmm.robot.locobot import LocobotRobot
from relmm.robot.skills import REST_POSE

SAMPLE = Path(__file__).parents[1] / "datasets" / "diverse_scripted"
RESULTS = Path(__file__).parent / "results" / "long_run.csv"
CAMERA, EPISODE_STEPS, PARTS, CAPACITY = "paper", 13, 10, 100_000


class NoBody:
    """A `relmm.robot.body.Body` without one, see above."""

    def __init__(self, pictures: list[NDArray[np.uint8]], camera: CameraGeometry) -> None:
        self.camera, self._pictures, self._taken = camera, pictures, 0
        self._depth = _floor_depth(camera)
        self._time = self._travelled = self._heading = self._gripper = 0.0
        self._velocity, self._joints = (0.0, 0.0), REST_POSE

    def drive(self, x_vel: float, theta_vel: float) -> None:
        """Roll from the next moment on."""
        self._velocity = x_vel, theta_vel

    def move_arm(self, joints: FloatArray, seconds: float) -> None:
        """Be there."""
        self._joints = joints

    def set_gripper(self, opening: float) -> None:
        """Be so wide."""
        self._gripper = max(opening, 0.0)

    def state(self) -> BodyState:
        """As it is."""
        joints = self._joints
        return BodyState(self._time, self._travelled, self._heading, joints, joints, self._gripper, 0)

    def capture(self) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """The next picture, and an empty floor."""
        self._taken += 1
        return self._pictures[self._taken % len(self._pictures)], self._depth

    def wait(self, seconds: float) -> None:
        """No time of ours."""
        self._time += seconds
        self._travelled += self._velocity[0] * seconds
        self._heading += self._velocity[1] * seconds

    def stop(self) -> None:
        """Stand."""
        self._velocity = (0.0, 0.0)

    def close(self) -> None:
        """Nothing to let go of."""


def _floor_depth(camera: CameraGeometry) -> NDArray[np.uint16]:
    columns, rows = np.meshgrid(np.arange(camera.size[0]), np.arange(camera.size[1]))
    down = -camera.rays(np.stack([columns, rows], axis=-1))[..., 2]  # of rays that go 1 m along the optical axis
    return np.where(down > 0, 1000 * camera.position[2] / np.maximum(down, 1e-6), 0).clip(0, 9999).astype(np.uint16)


class NoRobot(LocobotRobot):
    """A LoCoBot over `NoBody`."""

    config_class = LocobotConfig
    name = "locobot"

    def make_body(self) -> NoBody:
        """See `LocobotRobot`."""
        sample = LeRobotDataset("local/sample", root=SAMPLE)
        pictures = [(sample[i][IMAGE_KEY].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8) for i in range(200)]
        return NoBody(pictures, CAMERAS[CAMERA])


def megabytes() -> float:
    """Of this process and its children."""
    numbers = ["self", *(str(child.pid) for child in multiprocessing.active_children())]
    pages = sum(int(Path(f"/proc/{number}/statm").read_text().split()[1]) for number in numbers)
    return pages * 4096 / 1e6


def live(frames: int, root: Path) -> list[dict[str, Any]]:
    """A row for each tenth of the life."""
    actor = make_actor(RelmmRandomConfig(device="cpu"))
    learner = ReLMMPolicy(ReLMMConfig(device="cpu", camera=CAMERA)).make_learner(0, CAPACITY)
    robot = NoRobot(LocobotConfig(), depth=False, seed=0)
    rows = []
    with (
        robot,
        EpisodeRecorder(
            root, "local/long_run", resume=False, depth=False, robot_type="locobot", info={"camera": CAMERA}
        ) as recorder,
    ):
        life = Life(robot, [recorder, learner], robot.seconds, EPISODE_STEPS, lambda: False)
        for part in range(PARTS):
            times, start = [], time.process_time()
            for _ in range(frames // PARTS):
                began = time.perf_counter()
                life.step(actor.act(life.observation), Phase.LEARNING)
                times.append(time.perf_counter() - began)
            rows.append(
                {
                    "frames": (part + 1) * (frames // PARTS),
                    "robot_hours": round(robot.seconds() / 3600, 1),
                    "episodes": recorder.saved_episodes,
                    "memory_mb": round(megabytes(), 1),
                    "median_ms": round(float(np.median(times)) * 1e3, 2),
                    "p99_ms": round(float(np.quantile(times, 0.99)) * 1e3, 2),
                    "processor_ms": round((time.process_time() - start) / len(times) * 1e3, 2),
                }
            )
            print(", ".join(f"{key} {value}" for key, value in rows[-1].items()), flush=True)
    return rows


def main() -> None:
    """Live, print the table, write the CSV."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=100_000)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = live(arguments.frames, Path(folder) / "life")
    write_table(rows, RESULTS)


if __name__ == "__main__":
    main()
