"""Things that lie about: small free bodies of primitives, which a gripper that opens 44 mm can take at any yaw."""

from __future__ import annotations

import math
from collections.abc import Callable

import mujoco
import numpy as np

from relmm.errors import ConfigError

Color = tuple[float, float, float]
# Adds the geoms of one object to a body, positions relative to the body, and returns the resting height: how far the
# body's origin is above the floor (m).
Builder = Callable[[mujoco.MjsBody, np.random.Generator], float]

MAX_RADIUS = 0.020  # m; no object reaches further from its middle in any horizontal direction
BALL_RADIUS = 0.015  # m, as in the original
BALL_MASS = 0.010  # kg

# Sliding, spinning (m) and rolling (m) friction. A ball that rolls at 0.3 m/s stops after 12 cm; the original's
# balls, crossed boxes inside, did not roll at all.
FRICTION = (1.0, 0.005, 0.0008)
# Contacts 5 times stiffer than MuJoCo's defaults: 10 N of a gripper press a ball of 10 g in by about 1 mm, not 20.
SOLREF = (0.01, 1.0)  # s, damping ratio; MuJoCo needs at least two timesteps
SOLIMP = (0.99, 0.99, 0.001, 0.5, 2.0)

TOY_DENSITY = (800.0, 1300.0)  # kg/m^3, so that every object weighs 8 to 40 g
SMALL_TOY_DENSITY = (1000.0, 1300.0)
SOCK_DENSITY = (500.0, 700.0)

BALL_COLORS: dict[str, Color] = {
    "green": (0.2, 0.6, 0.2),
    "blue": (0.1, 0.1, 0.5),
    "yellow": (0.8, 0.8, 0.2),
    "orange": (0.8, 0.4, 0.1),
    "white": (0.9, 0.9, 0.9),
    "black": (0.05, 0.05, 0.05),
}
# The last two are as bright as a wooden floor, so that not everything stands out.
TOY_COLORS: tuple[Color, ...] = (
    (0.85, 0.15, 0.12),
    (0.95, 0.50, 0.10),
    (0.98, 0.83, 0.10),
    (0.20, 0.65, 0.25),
    (0.10, 0.45, 0.85),
    (0.45, 0.20, 0.65),
    (0.95, 0.45, 0.65),
    (0.10, 0.65, 0.68),
    (0.82, 0.74, 0.64),
    (0.72, 0.58, 0.44),
)
SOCK_COLORS: tuple[Color, ...] = (
    (0.93, 0.93, 0.92),
    (0.45, 0.45, 0.48),
    (0.13, 0.16, 0.32),
    (0.60, 0.15, 0.20),
    (0.80, 0.76, 0.70),
)
DARK: Color = (0.08, 0.08, 0.09)
BEAK: Color = (0.95, 0.45, 0.05)

_BUILDERS: dict[str, Builder] = {}


def register_object(name: str) -> Callable[[Builder], Builder]:
    """Decorator that makes a builder known under a name, for rooms to ask for.

    What it builds must stay within `MAX_RADIUS` of its middle, and be at least 14 mm wide and 18 to 36 mm high.
    """

    def register(builder: Builder) -> Builder:
        if name in _BUILDERS:
            raise ConfigError(f"There already is an object {name!r}; register yours under another name.")
        _BUILDERS[name] = builder
        return builder

    return register


def object_names() -> list[str]:
    """Names of all kinds of objects, sorted."""
    return sorted(_BUILDERS)


def check_object(kind: str) -> None:
    """Raise `ConfigError` unless `kind` is a known kind of object."""
    if kind not in _BUILDERS:
        raise ConfigError(f"There is no object {kind!r}; choose from {', '.join(object_names())}.")


def add_object(spec: mujoco.MjSpec, kind: str, name: str, rng: np.random.Generator) -> mujoco.MjsBody:
    """Add one free object at the origin, resting on the floor; the caller moves it.

    Args:
        spec: the world to add it to.
        kind: one of `object_names()`.
        name: name of the body and of its free joint.
        rng: varies colour and size.

    Raises:
        ConfigError: unknown kind.
    """
    check_object(kind)
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    body.pos = (0.0, 0.0, _BUILDERS[kind](body, rng))
    return body


def _geom(
    body: mujoco.MjsBody,
    shape: str,
    size: tuple[float, ...],
    color: Color,
    density: float,
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0),
    axis: str = "z",
) -> mujoco.MjsGeom:
    """Add a primitive; sizes in m as MuJoCo takes them, `axis` is where the axis of a capsule or cylinder points."""
    turn = math.sqrt(0.5)
    return body.add_geom(
        type=getattr(mujoco.mjtGeom, f"mjGEOM_{shape.upper()}"),
        size=[*size, 0.0, 0.0][:3],
        pos=pos,
        quat={"x": (turn, 0.0, turn, 0.0), "y": (turn, turn, 0.0, 0.0), "z": (1.0, 0.0, 0.0, 0.0)}[axis],
        rgba=(*color, 1.0),
        density=density,
        friction=FRICTION,
        # Boxes cannot roll, and without rolling friction each of their many contacts is cheaper.
        condim=4 if shape == "box" else 6,
        solref=SOLREF,
        solimp=SOLIMP,
    )


def _stripe(geom: mujoco.MjsGeom) -> None:
    """Make a geom decoration: seen, but without contact or weight."""
    geom.contype = geom.conaffinity = 0
    geom.density = 0.0


def _pick(rng: np.random.Generator, colors: tuple[Color, ...]) -> Color:
    return colors[rng.integers(len(colors))]


def _register_ball(name: str, color: Color) -> None:
    @register_object(f"{name}_ball")
    def ball(body: mujoco.MjsBody, rng: np.random.Generator) -> float:
        _geom(body, "sphere", (BALL_RADIUS,), color, BALL_MASS / (4 / 3 * math.pi * BALL_RADIUS**3))
        return BALL_RADIUS


for _name, _color in BALL_COLORS.items():
    _register_ball(_name, _color)


@register_object("block")
def _block(body: mujoco.MjsBody, rng: np.random.Generator) -> float:
    # Half sizes up to 14 mm: a diagonal of 40 mm, on whichever side it falls.
    x, y, z = rng.uniform((0.0115, 0.0115, 0.0105), 0.014)
    _geom(body, "box", (x, y, z), _pick(rng, TOY_COLORS), rng.uniform(*TOY_DENSITY))
    return float(z)


@register_object("capsule")
def _capsule(body: mujoco.MjsBody, rng: np.random.Generator) -> float:
    radius = rng.uniform(0.010, 0.0125)
    _geom(body, "capsule", (radius, MAX_RADIUS - radius), _pick(rng, TOY_COLORS), rng.uniform(*TOY_DENSITY), axis="x")
    return float(radius)


@register_object("egg")
def _egg(body: mujoco.MjsBody, rng: np.random.Generator) -> float:
    x, y, z = rng.uniform((0.016, 0.012, 0.011), (MAX_RADIUS, 0.015, 0.013))
    _geom(body, "ellipsoid", (x, y, z), _pick(rng, TOY_COLORS), rng.uniform(*SMALL_TOY_DENSITY))
    return float(z)


@register_object("cup")
def _cup(body: mujoco.MjsBody, rng: np.random.Generator) -> float:
    radius, half_height = rng.uniform((0.012, 0.010), (0.016, 0.012))
    _geom(body, "cylinder", (radius, half_height), _pick(rng, TOY_COLORS), rng.uniform(*SMALL_TOY_DENSITY))
    return float(half_height)


@register_object("sock")
def _sock(body: mujoco.MjsBody, rng: np.random.Generator) -> float:
    """A pair of socks rolled up: two capsules side by side, with stripes."""
    color, accent = _pick(rng, SOCK_COLORS), _pick(rng, TOY_COLORS)
    density, radius, half_length, apart = rng.uniform(*SOCK_DENSITY), 0.0115, 0.0065, 0.005
    for y in (-apart, apart):
        _geom(body, "capsule", (radius, half_length), color, density, (0.0, y, 0.0), axis="x")
        _stripe(_geom(body, "cylinder", (radius + 2e-4, 0.0022), accent, 0.0, (0.004, y, 0.0), axis="x"))
    return radius


@register_object("car")
def _car(body: mujoco.MjsBody, rng: np.random.Generator) -> float:
    density, color, axle_radius = rng.uniform(*TOY_DENSITY), _pick(rng, TOY_COLORS[:8]), 0.006
    _geom(body, "box", (0.0165, 0.0085, 0.0045), color, density, (0.0, 0.0, 0.003))
    _geom(body, "box", (0.0080, 0.0075, 0.0045), (0.75, 0.85, 0.9), density, (-0.002, 0.0, 0.012))
    for x in (-0.010, 0.010):
        # A pair of wheels is one wide cylinder.
        _geom(body, "cylinder", (axle_radius, 0.0110), DARK, density, (x, 0.0, 0.0), axis="y")
    return axle_radius


@register_object("duck")
def _duck(body: mujoco.MjsBody, rng: np.random.Generator) -> float:
    density, color, half_height = rng.uniform(*TOY_DENSITY), _pick(rng, TOY_COLORS[1:8]), 0.011
    _geom(body, "ellipsoid", (0.017, 0.014, half_height), color, density, (-0.002, 0.0, 0.0))
    _geom(body, "sphere", (0.008,), color, density, (0.006, 0.0, 0.015))
    _geom(body, "ellipsoid", (0.004, 0.004, 0.002), BEAK, density, (0.0145, 0.0, 0.014))
    return half_height


@register_object("dumbbell")
def _dumbbell(body: mujoco.MjsBody, rng: np.random.Generator) -> float:
    density, color, bar = rng.uniform(*SMALL_TOY_DENSITY), _pick(rng, TOY_COLORS), _pick(rng, TOY_COLORS)
    radius = 0.0098
    for x in (radius - MAX_RADIUS, MAX_RADIUS - radius):
        _geom(body, "sphere", (radius,), color, density, (x, 0.0, 0.0))
    _geom(body, "cylinder", (0.0075, 0.006), bar, density, axis="x")
    return radius


@register_object("cross")
def _cross(body: mujoco.MjsBody, rng: np.random.Generator) -> float:
    density, color, half_height = rng.uniform(*TOY_DENSITY), _pick(rng, TOY_COLORS), rng.uniform(0.009, 0.012)
    for x, y in ((0.018, 0.0075), (0.0075, 0.018)):
        _geom(body, "box", (x, y, half_height), color, density)
    return float(half_height)


@register_object("brick")
def _brick(body: mujoco.MjsBody, rng: np.random.Generator) -> float:
    """A building brick with two studs."""
    density, color, half_height = rng.uniform(*TOY_DENSITY), _pick(rng, TOY_COLORS), 0.010
    _geom(body, "box", (0.016, 0.0095, half_height), color, density)
    for x in (-0.008, 0.008):
        _geom(body, "cylinder", (0.005, 0.002), color, density, (x, 0.0, half_height + 0.002))
    return half_height
