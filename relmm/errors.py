"""The exceptions that relmm raises on purpose. The commands print their message and nothing else."""


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
