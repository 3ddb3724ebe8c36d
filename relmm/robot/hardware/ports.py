"""Which device is the base, and which the arm."""

from __future__ import annotations

from pathlib import Path

from relmm.errors import RobotError

BY_ID = Path("/dev/serial/by-id")
# Parts of the names that udev gives them, in small letters. The Kobuki's serial adapter is an FTDI chip that calls
# itself iClebo Kobuki; the arm's is a U2D2, an FTDI chip of Robotis that keeps FTDI's own name.
_NAMES = {"base": ("kobuki",), "arm": ("u2d2", "usb__-__serial_converter", "dynamixel", "robotis")}


def find_port(what: str, port: str) -> str:
    """The device of `base` or `arm`.

    Args:
        what: `base` or `arm`.
        port: as configured; `auto` to look for it.

    Raises:
        RobotError: there is none, or several.
    """
    if port != "auto":
        return port
    found = candidates(what)
    if len(found) == 1:
        return str(found[0])
    here = ", ".join(path.name for path in serial_devices()) or "nothing"
    raise RobotError(
        f"{'No' if not found else 'More than one'} {what} was found in {BY_ID} (there is {here}): plug it in, or say "
        f"--robot.{what}_port=DEVICE."
    )


def candidates(what: str) -> list[Path]:
    """Devices whose names say that they are `base` or `arm`."""
    return [path for path in serial_devices() if any(part in path.name.lower() for part in _NAMES[what])]


def serial_devices() -> list[Path]:
    """All serial devices with a name of their own, sorted."""
    return sorted(BY_ID.iterdir()) if BY_ID.is_dir() else []
