"""What stands and lies in a room: obstacles, furniture made of them, and rugs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from relmm.errors import ConfigError
from relmm.features import FloatArray
from relmm.sim.objects import Color
from relmm.sim.textures import check_texture

# What hangs over the floor must clear the camera, 0.59 m up, with a margin; see `Obstacle.bottom`.
MIN_HEADROOM = 0.75  # m


def require(ok: bool, message: str) -> None:
    """Raise `ConfigError` with the message unless `ok`."""
    if not ok:
        raise ConfigError(message)


def check_positive(what: str, *values: float) -> None:
    """Raise `ConfigError` unless all lengths are positive and finite."""
    require(all(v > 0 and math.isfinite(v) for v in values), f"{what} is {values}; give positive numbers of metres.")


@dataclass(frozen=True, kw_only=True)
class Obstacle:
    """A static box or cylinder; furniture is composed of several.

    Args:
        shape: "box" or "cylinder".
        x: middle, m.
        y: middle, m.
        half_size: of a box, along its own x and y, m.
        radius: of a cylinder, m.
        height: from its lower to its upper face, m.
        bottom: height of its lower face, m: 0 on the floor, or at least 0.75. In between, the depth camera would look
            over it or under it while the robot's camera tower and arm run into it.
        yaw: turn of a box, rad.
        color: RGB, 0..1.
    """

    shape: Literal["box", "cylinder"]
    x: float
    y: float
    height: float
    half_size: tuple[float, float] = (0.1, 0.1)
    radius: float = 0.1
    bottom: float = 0.0
    yaw: float = 0.0
    color: Color = (0.5, 0.5, 0.5)

    def __post_init__(self) -> None:
        """Refuse what cannot exist or what the robot cannot see."""
        require(
            self.shape in ("box", "cylinder"), f"An obstacle cannot be a {self.shape!r}; choose 'box' or 'cylinder'."
        )
        check_positive("The size of an obstacle (half size x, half size y, radius, height)", *self._sizes())
        require(
            self.bottom == 0 or self.bottom >= MIN_HEADROOM,
            f"An obstacle begins {self.bottom} m above the floor, where the robot would run into it unseen; "
            f"choose 0 or at least {MIN_HEADROOM} m.",
        )

    def _sizes(self) -> tuple[float, float, float, float]:
        return (*self.half_size, self.radius, self.height)

    def distance(self, xy: FloatArray) -> FloatArray:
        """Distance in m from points on the floor, shape (n, 2), to this obstacle, 0 inside; infinite if it hangs."""
        if self.bottom > 0:
            return np.full(len(xy), np.inf)
        offset = xy - (self.x, self.y)
        if self.shape == "cylinder":
            return np.asarray(np.maximum(np.linalg.norm(offset, axis=1) - self.radius, 0.0))
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        own_frame = offset @ np.array([[cos, -sin], [sin, cos]])
        return np.asarray(np.linalg.norm(np.maximum(np.abs(own_frame) - self.half_size, 0.0), axis=1))


@dataclass(frozen=True, kw_only=True)
class Rug:
    """A rug, for the eyes only: middle (m), whole size (m), yaw (rad) and the name of its texture."""

    x: float
    y: float
    size: tuple[float, float]
    texture: str
    yaw: float = 0.0

    def __post_init__(self) -> None:
        """Refuse impossible sizes and unknown textures."""
        check_positive("The size of a rug", *self.size)
        check_texture(self.texture)


def table(x: float, y: float, half_size: tuple[float, float], color: Color = (0.55, 0.38, 0.24)) -> list[Obstacle]:
    """A table high enough for the robot to drive under, with legs of 6 cm."""
    leg, top_bottom = 0.03, 0.76
    corners = [(x + sx * (half_size[0] - leg), y + sy * (half_size[1] - leg)) for sx in (-1, 1) for sy in (-1, 1)]
    legs = [
        Obstacle(shape="box", x=cx, y=cy, half_size=(leg, leg), height=top_bottom, color=color) for cx, cy in corners
    ]
    return [*legs, Obstacle(shape="box", x=x, y=y, half_size=half_size, height=0.03, bottom=top_bottom, color=color)]


def sofa(x: float, y: float, half_width: float, color: Color = (0.36, 0.46, 0.52)) -> list[Obstacle]:
    """A sofa with its back to the left (+y) wall, 0.6 m deep: seat, back and two arms, all down to the floor."""
    dark: Color = (0.8 * color[0], 0.8 * color[1], 0.8 * color[2])
    seat = Obstacle(shape="box", x=x, y=y - 0.08, half_size=(half_width, 0.22), height=0.40, color=color)
    back = Obstacle(shape="box", x=x, y=y + 0.22, half_size=(half_width, 0.08), height=0.78, color=dark)
    arms = [
        Obstacle(shape="box", x=x + side * (half_width + 0.08), y=y, half_size=(0.08, 0.30), height=0.55, color=dark)
        for side in (-1, 1)
    ]
    return [seat, back, *arms]


def floor_lamp(x: float, y: float) -> list[Obstacle]:
    """A lamp on a pole of 6 cm; its foot is high enough for a depth camera to see."""
    return [
        Obstacle(shape="cylinder", x=x, y=y, radius=0.11, height=0.15, color=(0.2, 0.2, 0.22)),
        Obstacle(shape="cylinder", x=x, y=y, radius=0.03, height=0.95, color=(0.2, 0.2, 0.22)),
        Obstacle(shape="cylinder", x=x, y=y, radius=0.16, height=0.25, bottom=0.95, color=(0.97, 0.92, 0.78)),
    ]


def shelf(x: float, y: float, half_size: tuple[float, float], color: Color = (0.66, 0.50, 0.34)) -> list[Obstacle]:
    """A cupboard with a darker plinth and top."""
    dark: Color = (0.7 * color[0], 0.7 * color[1], 0.7 * color[2])
    inner = (half_size[0] - 0.01, half_size[1] - 0.01)
    return [
        Obstacle(shape="box", x=x, y=y, half_size=inner, height=1.1, color=color),
        Obstacle(shape="box", x=x, y=y, half_size=half_size, height=0.08, color=dark),
        Obstacle(shape="box", x=x, y=y, half_size=half_size, height=0.03, bottom=1.1, color=dark),
    ]
