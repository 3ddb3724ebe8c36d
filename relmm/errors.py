"""The exceptions that relmm raises on purpose. The commands print their message and nothing else."""

from collections.abc import Iterable
from difflib import get_close_matches


def suggestion(word: str, known: Iterable[str]) -> str:
    """What a mistyped word may have meant, to put behind it in a message; nothing if nothing is like it."""
    likely = get_close_matches(word, list(known), n=1)
    return f" (did you mean {likely[0]}?)" if likely else ""


class RelmmError(Exception):
    """Base of all of them. The message says what was wrong, what is allowed and what to do next."""


class ConfigError(RelmmError, ValueError):
    """A setting that cannot work, found before anything moved or was written."""


class DatasetError(RelmmError):
    """A dataset that cannot be written, read, resumed or repaired."""


class HubError(RelmmError):
    """The Hub cannot be reached, refuses what was asked, or holds something else."""


class RobotError(RelmmError):
    """The robot cannot do what was asked."""


class PhysicsError(RelmmError):
    """The simulation has reached a state that no real room can reach."""


class RenderingError(RelmmError):
    """No usable OpenGL on this machine."""


class FleetError(RelmmError):
    """A room, a robot or the server of a fleet cannot do its part."""


class DiskError(RelmmError):
    """A file cannot be written."""


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Refuse a setting that is out of its range, or not a number.

    Args:
        name: of the setting, as on the command line.
        value: that it has.
        low: the least that is allowed.
        high: the most that is allowed.

    Raises:
        ConfigError: it is out of range.
    """
    if not low <= value <= high:
        raise ConfigError(f"{name} is {value}, but must be at least {low:,} and at most {high:,}.")


MAX_SEED = 2**32 - 1  # torch takes more, but runs add small numbers to it
MANY = 10**9  # of anything that is counted
