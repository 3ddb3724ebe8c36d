"""relmm-doctor: is everything here that relmm needs? What is missing is said in one sentence each.

With --robot.type=locobot also the robot: its devices, every motor, the camera; nothing moves.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import logging
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from relmm.errors import RelmmError

_PACKAGES = ("lerobot", "torch", "mujoco", "gymnasium", "numpy", "opencv-python-headless", "huggingface-hub")
_MIN_FREE_GB = 1.0
_TRIAL_MB, _MIN_MB_PER_S = 20, 5.0


def check_python() -> str:
    """The interpreter's version."""
    return sys.version.split()[0]


def check_packages() -> str:
    """Versions of what relmm stands on."""
    return ", ".join(f"{name} {importlib.metadata.version(name)}" for name in _PACKAGES)


def check_plugin() -> str:
    """Whether LeRobot's own commands will find relmm."""
    try:
        name = importlib.metadata.metadata("lerobot_policy_relmm")["Name"]
    except importlib.metadata.PackageNotFoundError:
        raise RelmmError("relmm is not installed, so LeRobot's commands cannot find it: pip install -e .") from None
    return f"LeRobot finds {name}"


def check_rendering() -> str:
    """One picture from the robot's camera."""
    from relmm.geometry import camera_geometry
    from relmm.sim.body import SimBody
    from relmm.sim.gl import choose_backend
    from relmm.sim.rooms import make_room

    body = SimBody(make_room("no_obstacles", num_objects=1), camera_geometry("paper"))
    try:
        rgb, _ = body.capture()
    finally:
        body.close()
    if rgb.std() < 1.0:
        raise RelmmError("OpenGL draws empty pictures here: install or update the driver (libgl1-mesa-dri).")
    return f"OpenGL through {choose_backend()}"


def check_disk() -> str:
    """Free space where recordings go by default."""
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    if free < _MIN_FREE_GB:
        raise RelmmError(f"Only {free:.1f} GB are free in {Path.cwd()}: an hour of recording takes about 0.2 GB.")
    return f"{free:.0f} GB free here"


def check_torch() -> str:
    """Where policies will run."""
    import torch

    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"
    return f"policies run on {device}, {torch.get_num_threads()} threads"


CHECKS: dict[str, Callable[[], str]] = {
    "python": check_python,
    "packages": check_packages,
    "plugin": check_plugin,
    "rendering": check_rendering,
    "disk": check_disk,
    "torch": check_torch,
}


def check_disk_speed() -> str:
    """Whether a recording can be written while the robot lives."""
    block = bytes(1_000_000)
    with tempfile.TemporaryFile(dir=Path.cwd()) as file:
        began = time.perf_counter()
        for _ in range(_TRIAL_MB):
            file.write(block)
        file.flush()
        os.fsync(file.fileno())
        speed = _TRIAL_MB / (time.perf_counter() - began)
    if speed < _MIN_MB_PER_S:
        raise RelmmError(f"This disk takes {speed:.1f} MB/s: record to a faster one, not to a memory card.")
    return f"{speed:.0f} MB/s can be written here"


def checks_of(arguments: argparse.Namespace) -> Iterator[tuple[str, Callable[[], str]]]:
    """All checks, those of the robot included if one was named."""
    yield from CHECKS.items()
    if arguments.type == "locobot":
        from relmm.robot.hardware.config_locobot import LocobotConfig
        from relmm.robot.hardware.diagnosis import hardware_checks

        logging.getLogger("lerobot").setLevel(logging.ERROR)
        yield "disk speed", check_disk_speed
        yield from hardware_checks(
            LocobotConfig(
                base_port=arguments.base_port, arm_port=arguments.arm_port, camera_serial=arguments.camera_serial
            )
        )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="relmm-doctor", description=__doc__, allow_abbrev=False)
    parser.add_argument("--robot.type", dest="type", choices=("locobot", "locobot_sim"), help="also look at this robot")
    for name in ("base_port", "arm_port", "camera_serial"):
        parser.add_argument(f"--robot.{name}", dest=name, default="auto", help="as of relmm-train")
    return parser


def main() -> None:
    """Entry point of `relmm-doctor`; exits with 1 if something is missing."""
    failed = 0
    for name, check in checks_of(_parser().parse_args()):
        try:
            print(f"  ok    {name:15} {check()}")
        except RelmmError as error:
            failed += 1
            print(f"  FAIL  {name:15} {error}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
