"""relmm-doctor: is everything here that relmm needs? What is missing is said in one sentence each."""

from __future__ import annotations

import argparse
import importlib.metadata
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

from relmm.errors import RelmmError

_PACKAGES = ("lerobot", "torch", "mujoco", "gymnasium", "numpy", "opencv-python-headless", "huggingface-hub")
_MIN_FREE_GB = 1.0


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


def main() -> None:
    """Entry point of `relmm-doctor`; exits with 1 if something is missing."""
    argparse.ArgumentParser(prog="relmm-doctor", description=__doc__).parse_args()
    failed = 0
    for name, check in CHECKS.items():
        try:
            print(f"  ok    {name:10} {check()}")
        except RelmmError as error:
            failed += 1
            print(f"  FAIL  {name:10} {error}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
