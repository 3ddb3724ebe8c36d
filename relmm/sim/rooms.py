"""Rooms: a floor, four walls, obstacles, rugs and scattered objects, as a dataclass that builds an `MjSpec`.

To add a room, register a dataclass. In a package of its own:

    @register_room("kitchen")
    @dataclass(frozen=True, kw_only=True)
    class Kitchen(Room):
        size: tuple[float, float] = (4.0, 3.0)

and in its pyproject.toml, for a module that registers one or more rooms when it is imported:

    [project.entry-points."relmm.rooms"]
    kitchen = "my_package.rooms"
"""

from __future__ import annotations

import importlib.metadata
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from relmm.errors import ConfigError
from relmm.sim.objects import SOLIMP, SOLREF, Color, add_object, check_object
from relmm.sim.textures import add_material, check_texture

OBJECT_PREFIX = "object_"  # bodies and free joints are object_00, object_01, ...
FLOOR = "floor"
WALL_PREFIX = "wall_"
OBSTACLE_PREFIX = "obstacle_"
ENTRY_POINT_GROUP = "relmm.rooms"

TIMESTEP = 0.005  # s
WALL_HEIGHT = 1.0  # m
WALL_THICKNESS = 0.1  # m
ROBOT_RADIUS = 0.25  # m round the robot's start that obstacles leave free
# What hangs over the floor must clear the camera, 0.59 m up, with a margin; see `Obstacle.bottom`.
MIN_HEADROOM = 0.75  # m
SKY: Color = (0.86, 0.89, 0.92)
RUG_THICKNESS, RUG_STEP = 0.002, 0.0005  # m
FLOOR_TILE = 1.0  # m that one floor texture covers
TEXTURE_SEED = 7  # a room keeps its floor and rugs, whatever the seed that scatters the objects
RUG_TEXTURE_SIZE = 256  # pixels a side
CANDIDATES_PER_OBJECT = 200  # random places to try before a room counts as full
NEAR_PLANE, FAR_PLANE = 0.02, 20.0  # m

FloatArray = NDArray[np.float64]

logger = logging.getLogger(__name__)


def _require(ok: bool, message: str) -> None:
    if not ok:
        raise ConfigError(message)


def _check_positive(what: str, *values: float) -> None:
    _require(all(v > 0 and math.isfinite(v) for v in values), f"{what} is {values}; give positive numbers of metres.")


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
        _require(
            self.shape in ("box", "cylinder"), f"An obstacle cannot be a {self.shape!r}; choose 'box' or 'cylinder'."
        )
        _check_positive("The size of an obstacle (half size x, half size y, radius, height)", *self._sizes())
        _require(
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
        _check_positive("The size of a rug", *self.size)
        check_texture(self.texture)


@dataclass(frozen=True, kw_only=True)
class Room:
    """A rectangular room with the robot's start in the middle, at (0, 0).

    Args:
        size: inner length along x and y, m.
        num_objects: how many objects lie about.
        objects: their kinds (`relmm.sim.objects.object_names()`), dealt in turn.
        obstacles: what stands in the way.
        rugs: what lies on the floor; later ones on top.
        floor: name of the floor's texture.
        wall_color: RGB, 0..1.
        robot_clearance: least distance from the robot's start to the middle of an object, m.
        wall_clearance: the same from the walls.
        obstacle_clearance: the same from the obstacles; 3 cm and the radius of the largest object.
        object_spacing: least distance between the middles of two objects, m.

    Raises:
        ConfigError: a value that cannot work.
    """

    name: ClassVar[str] = "room"

    size: tuple[float, float] = (3.0, 3.0)
    num_objects: int = 20
    objects: tuple[str, ...] = ("green_ball",)
    obstacles: tuple[Obstacle, ...] = ()
    rugs: tuple[Rug, ...] = ()
    floor: str = "wood"
    wall_color: Color = (0.95, 0.84, 0.83)
    robot_clearance: float = 0.5
    wall_clearance: float = 0.10
    obstacle_clearance: float = 0.05
    object_spacing: float = 0.06

    def __post_init__(self) -> None:
        """Find every mistake before anything is built."""
        _check_positive("The size of the room", *self.size)
        _require(
            min(self.size) >= 2 * ROBOT_RADIUS,
            f"A room of {self.size} m has no space for the robot; choose at least {2 * ROBOT_RADIUS} m a side.",
        )
        _require(1 <= self.num_objects <= 100, f"num_objects is {self.num_objects}; choose 1 to 100.")
        _require(bool(self.objects), "The room has no kinds of objects; name at least one in `objects`.")
        for kind in self.objects:
            check_object(kind)
        check_texture(self.floor)
        for field in ("robot_clearance", "wall_clearance", "obstacle_clearance", "object_spacing"):
            _require(getattr(self, field) >= 0, f"{field} is {getattr(self, field)} m; choose 0 or more.")
        for obstacle in self.obstacles:
            _require(
                obstacle.distance(np.zeros((1, 2)))[0] >= ROBOT_RADIUS,
                f"The obstacle at ({obstacle.x}, {obstacle.y}) stands where the robot starts; "
                f"keep {ROBOT_RADIUS} m round (0, 0) free.",
            )

    def scatter(self, rng: np.random.Generator) -> FloatArray:
        """Places for the objects: uniform over the floor, honouring the clearances.

        Returns:
            Metres and radians, shape (num_objects, 3): x, y, yaw.

        Raises:
            ConfigError: the objects do not fit.
        """
        placed = np.empty((0, 2))
        for xy in self._free_places(rng, CANDIDATES_PER_OBJECT * self.num_objects):
            if np.all(np.linalg.norm(placed - xy, axis=1) >= self.object_spacing):
                placed = np.vstack([placed, xy])
            if len(placed) == self.num_objects:
                return np.column_stack([placed, rng.uniform(-math.pi, math.pi, self.num_objects)])
        raise ConfigError(
            f"Room {self.name!r} has no space for {self.num_objects} objects; at most about {len(placed)} fit: "
            "lower num_objects or the clearances, or enlarge the room."
        )

    def _free_places(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Those of `count` random places that keep their distance from walls, obstacles and the robot; (n, 2)."""
        limit = np.maximum(np.asarray(self.size) / 2 - self.wall_clearance, 0.0)
        xy = rng.uniform(-limit, limit, (count, 2))
        free = np.linalg.norm(xy, axis=1) >= self.robot_clearance
        for obstacle in self.obstacles:
            free &= obstacle.distance(xy) >= self.obstacle_clearance
        return np.asarray(xy[free])

    def build(self, rng: np.random.Generator) -> mujoco.MjSpec:
        """The room as a MuJoCo spec, objects scattered as `scatter(rng)` would, to attach a robot to and to compile.

        Raises:
            ConfigError: the objects do not fit.
        """
        poses = self.scatter(rng)
        spec = mujoco.MjSpec()
        spec.modelname = self.name
        _set_options(spec)
        _set_visuals(spec, max(self.size))
        self._add_floor_and_walls(spec)
        for index, rug in enumerate(self.rugs):
            _add_rug(spec, rug, index)
        for index, obstacle in enumerate(self.obstacles):
            _add_obstacle(spec, obstacle, index)
        for index, (x, y, yaw) in enumerate(poses):
            kind = self.objects[index % len(self.objects)]
            body = add_object(spec, kind, f"{OBJECT_PREFIX}{index:02d}", rng)
            body.pos[:2] = x, y
            body.quat = _yaw_quaternion(yaw)
        return spec

    def _add_floor_and_walls(self, spec: mujoco.MjSpec) -> None:
        half_x, half_y = self.size[0] / 2, self.size[1] / 2
        material = add_material(spec, FLOOR, self.floor, np.random.default_rng(TEXTURE_SEED))
        material.texrepeat = (1 / FLOOR_TILE, 1 / FLOOR_TILE)
        material.texuniform = True  # repeats per metre instead of per geom
        floor = _add_static(spec, FLOOR, mujoco.mjtGeom.mjGEOM_PLANE, (half_x, half_y, 0.1))
        floor.material = FLOOR

        half_t, half_h = WALL_THICKNESS / 2, WALL_HEIGHT / 2
        walls = {
            "front": ((half_x + half_t, 0.0), (half_t, half_y + WALL_THICKNESS)),
            "back": ((-half_x - half_t, 0.0), (half_t, half_y + WALL_THICKNESS)),
            "left": ((0.0, half_y + half_t), (half_x, half_t)),
            "right": ((0.0, -half_y - half_t), (half_x, half_t)),
        }
        for side, (xy, half_size) in walls.items():
            wall = _add_static(spec, WALL_PREFIX + side, mujoco.mjtGeom.mjGEOM_BOX, (*half_size, half_h))
            wall.pos = (*xy, half_h)
            wall.rgba = (*self.wall_color, 1.0)


def _yaw_quaternion(yaw: float) -> tuple[float, float, float, float]:
    return (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))


def _set_options(spec: mujoco.MjSpec) -> None:
    option = spec.option
    option.timestep = TIMESTEP
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # A gripper's hold is friction alone: the exact cone and stiff friction keep things from creeping out of it.
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10.0
    # What lies still costs nothing until something touches it.
    option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
    # A state gone bad shall be found, not silently replaced by the initial one.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET


def _set_visuals(spec: mujoco.MjSpec, extent: float) -> None:
    """Plain daylight. No shadows, antialiasing or reflections: on a CPU they cost ten times the rest of a picture."""
    spec.stat.extent = extent
    spec.stat.center = (0.0, 0.0, 0.0)
    visual = spec.visual
    visual.map.znear, visual.map.zfar = NEAR_PLANE / extent, FAR_PLANE / extent  # MuJoCo wants multiples of the extent
    visual.quality.shadowsize = visual.quality.offsamples = 0
    visual.quality.numslices, visual.quality.numstacks, visual.quality.numquads = 14, 8, 1
    visual.global_.offwidth, visual.global_.offheight = 960, 720
    visual.headlight.ambient = (0.52, 0.52, 0.52)
    visual.headlight.diffuse = (0.24, 0.24, 0.24)
    visual.headlight.specular = (0.0, 0.0, 0.0)
    # What is seen over the walls; without it, black.
    sky = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=32, height=32)
    sky.builtin, sky.rgb1, sky.rgb2 = mujoco.mjtBuiltin.mjBUILTIN_FLAT, SKY, SKY
    spec.worldbody.add_light(
        name="ceiling",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=(0.0, 0.0, 3.0),
        dir=(0.35, 0.20, -1.0),
        diffuse=(0.28, 0.28, 0.27),
        specular=(0.1, 0.1, 0.1),
        castshadow=False,
    )


def _add_static(
    spec: mujoco.MjSpec, name: str, shape: mujoco.mjtGeom, size: tuple[float, float, float]
) -> mujoco.MjsGeom:
    # The same contact stiffness as the objects', because MuJoCo averages that of the two sides.
    return spec.worldbody.add_geom(
        name=name, type=shape, size=size, friction=(1.0, 0.005, 0.0001), solref=SOLREF, solimp=SOLIMP
    )


def _add_rug(spec: mujoco.MjSpec, rug: Rug, index: int) -> None:
    name = f"rug_{index}"
    add_material(spec, name, rug.texture, np.random.default_rng(TEXTURE_SEED), RUG_TEXTURE_SIZE)
    geom = _add_static(spec, name, mujoco.mjtGeom.mjGEOM_BOX, (rug.size[0] / 2, rug.size[1] / 2, RUG_THICKNESS / 2))
    # Without contact: a real rug gives way under wheels and balls, a rigid plate of 2 mm would be a kerb to both.
    geom.contype = geom.conaffinity = 0
    # Each a little higher than the one before, so that where they overlap neither flickers through the other.
    geom.pos = (rug.x, rug.y, RUG_THICKNESS / 2 + index * RUG_STEP)
    geom.quat = _yaw_quaternion(rug.yaw)
    geom.material = name


def _add_obstacle(spec: mujoco.MjSpec, obstacle: Obstacle, index: int) -> None:
    half_height = obstacle.height / 2
    if obstacle.shape == "box":
        shape, size = mujoco.mjtGeom.mjGEOM_BOX, (*obstacle.half_size, half_height)
    else:
        shape, size = mujoco.mjtGeom.mjGEOM_CYLINDER, (obstacle.radius, half_height, 0.0)
    geom = _add_static(spec, f"{OBSTACLE_PREFIX}{index:02d}", shape, size)
    geom.pos = (obstacle.x, obstacle.y, obstacle.bottom + half_height)
    geom.quat = _yaw_quaternion(obstacle.yaw)
    geom.rgba = (*obstacle.color, 1.0)


def set_objects(model: mujoco.MjModel, data: mujoco.MjData, poses: FloatArray) -> None:
    """Put every object of a compiled room somewhere else, at rest on the floor; sleeping ones wake up.

    Args:
        model: compiled from `Room.build`.
        data: changed in place; positions only, so call `mj_forward` before looking.
        poses: m and rad, shape (number of objects, 3): x, y, yaw, as from `Room.scatter`.
    """
    for index, (x, y, yaw) in enumerate(poses):
        joint = model.joint(f"{OBJECT_PREFIX}{index:02d}")
        start, velocity = joint.qposadr[0], joint.dofadr[0]
        resting_height = model.qpos0[start + 2]
        data.qpos[start : start + 7] = (x, y, resting_height, *_yaw_quaternion(yaw))
        data.qvel[velocity : velocity + 6] = 0.0


# --- Registry ------------------------------------------------------------------------------------------------
_ROOMS: dict[str, type[Room]] = {}


def register_room(name: str) -> Callable[[type[Room]], type[Room]]:
    """Class decorator that makes a dataclass derived from `Room` known under a name."""

    def register(room: type[Room]) -> type[Room]:
        known = _ROOMS.get(name)
        _require(known in (None, room), f"There already is a room {name!r}; register yours under another name.")
        room.name = name
        _ROOMS[name] = room
        return room

    return register


def _load_entry_points() -> None:
    """Import the modules that other packages name in `relmm.rooms`; their `register_room` does the rest."""
    for entry_point in importlib.metadata.entry_points(group=ENTRY_POINT_GROUP):
        try:
            entry_point.load()
        except Exception as error:  # whatever a foreign package does wrong, the other rooms stay usable
            logger.warning("The rooms of %s cannot be imported: %r", entry_point.value, error)


def room_names() -> list[str]:
    """Names of all rooms, sorted, those of other installed packages included."""
    _load_entry_points()
    return sorted(_ROOMS)


def make_room(name: str, **overrides: Any) -> Room:
    """A room by name, with any of its fields overridden.

    Raises:
        ConfigError: unknown room or field, or a value that cannot work.
    """
    if name not in _ROOMS:
        _require(name in room_names(), f"There is no room {name!r}; choose one of {', '.join(sorted(_ROOMS))}.")
    room = _ROOMS[name]
    known = [field.name for field in fields(room)]
    unknown = [key for key in overrides if key not in known]
    _require(not unknown, f"Room {name!r} has no {', '.join(unknown)}; choose from {', '.join(known)}.")
    return room(**overrides)


# --- The paper's rooms ---------------------------------------------------------------------------------------
@register_room("no_obstacles")
@dataclass(frozen=True, kw_only=True)
class NoObstacles(Room):
    """3 x 3 m with a wooden floor and 20 green balls."""


@register_room("obstacles")
@dataclass(frozen=True, kw_only=True)
class Obstacles(Room):
    """The same with 30 balls, two boxes and two cylinders, placed as in the authors' simulator."""

    num_objects: int = 30
    obstacles: tuple[Obstacle, ...] = (
        Obstacle(shape="box", x=-0.5, y=0.5, half_size=(0.15, 0.15), height=0.6, color=(0.5, 0.5, 0.5)),
        Obstacle(shape="cylinder", x=0.7, y=0.5, radius=0.15, height=0.6, color=(0.7, 0.7, 0.7)),
        Obstacle(shape="box", x=0.75, y=-0.75, half_size=(0.1, 0.1), height=0.4, color=(0.7, 0.5, 0.7)),
        Obstacle(shape="cylinder", x=-0.75, y=-0.75, radius=0.1, height=0.4, color=(0.1, 0.1, 0.1)),
    )


DIVERSE_OBJECTS = ("block", "capsule", "egg", "cup", "sock", "car", "duck", "dumbbell", "cross", "brick")


@register_room("diverse")
@dataclass(frozen=True, kw_only=True)
class Diverse(Room):
    """3 x 3 m with 20 different things: blocks, capsules, eggs, socks, toys."""

    objects: tuple[str, ...] = DIVERSE_OBJECTS


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


@register_room("obstacles_rugs")
@dataclass(frozen=True, kw_only=True)
class ObstaclesRugs(Room):
    """A living room of 3 x 3.5 m: a sofa, a table, a cupboard and a lamp, four rugs and 20 different things."""

    size: tuple[float, float] = (3.0, 3.5)
    objects: tuple[str, ...] = DIVERSE_OBJECTS
    obstacles: tuple[Obstacle, ...] = (
        *sofa(-0.78, 1.44, 0.55),
        *table(0.85, -1.05, (0.45, 0.35)),
        *shelf(-1.33, -1.29, (0.17, 0.45)),
        *floor_lamp(1.34, 1.59),
    )
    rugs: tuple[Rug, ...] = (
        Rug(x=0.1, y=0.15, size=(1.5, 1.1), texture="rug_medallion"),
        Rug(x=0.85, y=-1.05, size=(1.1, 1.0), texture="rug_checks"),
        Rug(x=-0.7, y=-1.2, size=(0.6, 0.9), texture="rug_stripes", yaw=0.1),
        Rug(x=0.6, y=1.15, size=(0.8, 0.6), texture="rug_shaggy", yaw=0.4),
    )
