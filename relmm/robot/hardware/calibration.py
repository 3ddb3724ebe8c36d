"""What is particular to one robot, in the calibration file that LeRobot keeps for it."""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from relmm.errors import ConfigError
from relmm.features import FloatArray
from relmm.geometry import CAMERAS

_NOMINAL = CAMERAS["d435"]
_LIMITS = {
    "camera_height": (0.3, 0.8),
    "camera_pitch": (20.0, 70.0),
    "wheel_scale": (0.8, 1.25),
    "closed_opening": (-0.01, 0.01),
    "latency": (0.0, 0.5),
    "arm_delay": (0.0, 0.3),
}


@dataclass(frozen=True)
class Calibration:
    """Measured on one robot by `relmm-calibrate`; the defaults are those of the drawings.

    Args:
        camera_height: m above the floor.
        camera_pitch: degrees below the horizontal.
        wheel_scale: true distance by the one that the wheels' encoders tell.
        closed_opening: m that the gripper tells when its pads touch.
        arm_delay: s that the joints trail behind the motors' profiles.
        sag: rad that each joint has to be lifted with the arm stretched out level, waist to wrist rotation.
        grasp: x, y of where the gripper goes = `grasp` times (x, y, 1) of where it is to go: two rows, m.
        latency: s between what happens and the picture that shows it.
    """

    camera_height: float = _NOMINAL.position[2]
    camera_pitch: float = _NOMINAL.pitch
    wheel_scale: float = 1.0
    closed_opening: float = 0.0
    arm_delay: float = 0.04
    sag: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    grasp: tuple[tuple[float, float, float], tuple[float, float, float]] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    latency: float = 0.08

    def corrected(self, x: float, y: float) -> tuple[float, float]:
        """Where to send the gripper so that it arrives at a point of the floor (m, robot frame)."""
        new_x, new_y = np.array(self.grasp) @ (x, y, 1.0)
        return float(new_x), float(new_y)

    def sag_array(self) -> FloatArray:
        """`sag`, shape (5,)."""
        return np.array(self.sag)


def load_calibration(path: Path) -> Calibration:
    """Read a calibration file.

    Raises:
        ConfigError: it is damaged; says which value.
    """
    try:
        values = json.loads(path.read_text())
        known = {field.name for field in fields(Calibration)}
        if not isinstance(values, dict) or set(values) - known:
            raise ValueError(f"it holds {', '.join(sorted(set(values) - known)) or 'no settings'}")
        values |= {name: _tupled(values[name]) for name in ("sag", "grasp") if name in values}
        calibration = Calibration(**values)
        _check(calibration)
    except (OSError, TypeError, ValueError) as error:
        raise ConfigError(
            f"The calibration {path} cannot be used ({error}): measure again with relmm-calibrate, or delete it."
        ) from error
    return calibration


def save_calibration(calibration: Calibration, path: Path) -> None:
    """Write a calibration file, or leave the old one as it is if that fails."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(asdict(calibration), indent=4) + "\n")
    os.replace(temporary, path)


def _check(calibration: Calibration) -> None:
    for name, (low, high) in _LIMITS.items():
        value = getattr(calibration, name)
        if not low <= value <= high:
            raise ValueError(f"{name} is {value}, but must be {low} to {high}")
    shapes = np.shape(calibration.sag), np.shape(calibration.grasp)
    numbers = [*calibration.sag, *np.ravel(calibration.grasp)]
    if shapes != ((5,), (2, 3)) or not all(math.isfinite(number) for number in numbers):
        raise ValueError("sag must be 5 numbers, and grasp 2 rows of 3")
    if np.abs(np.array(calibration.grasp) - Calibration().grasp).max() > 0.3 or max(np.abs(calibration.sag)) > 0.3:
        raise ValueError("sag or grasp is far from any real robot's")


def _tupled(value: object) -> object:
    return tuple(map(_tupled, value)) if isinstance(value, list) else value
