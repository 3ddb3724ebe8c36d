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

import importlib
import importlib.metadata
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from relmm.errors import ConfigError, suggestion
from relmm.features import FloatArray
from relmm.sim.furniture import Obstacle, Rug, check_positive, require
from relmm.sim.objects import Color, add_object, check_object
from relmm.sim.scenery import (
    TEXTURE_SEED,
    add_obstacle,
    add_rug,
    add_static,
    set_options,
    set_visuals,
    yaw_quaternion,
)
from relmm.sim.textures import add_material, check_texture

OBJECT_PREFIX = "object_"  # bodies and free joints are object_00, object_01, ...
FLOOR = "floor"
WALL_PREFIX = "wall_"
ENTRY_POINT_GROUP = "relmm.rooms"

WALL_HEIGHT = 1.0  # m
WALL_THICKNESS = 0.1  # m
ROBOT_RADIUS = 0.25  # m round the robot's start that obstacles leave free
FLOOR_TILE = 1.0  # m that one floor texture covers
CANDIDATES_PER_OBJECT = 200  # random places to try before a room counts as full

logger = logging.getLogger(__name__)


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
        check_positive("The size of the room", *self.size)
        require(
            min(self.size) >= 2 * ROBOT_RADIUS,
            f"A room of {self.size} m has no space for the robot; choose at least {2 * ROBOT_RADIUS} m a side.",
        )
        require(1 <= self.num_objects <= 100, f"num_objects is {self.num_objects}; choose 1 to 100.")
        require(bool(self.objects), "The room has no kinds of objects; name at least one in `objects`.")
        for kind in self.objects:
            check_object(kind)
        check_texture(self.floor)
        for field in ("robot_clearance", "wall_clearance", "obstacle_clearance", "object_spacing"):
            require(getattr(self, field) >= 0, f"{field} is {getattr(self, field)} m; choose 0 or more.")
        for obstacle in self.obstacles:
            require(
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
        xy = rng.uniform(-self._limit, self._limit, (count, 2))
        free = self.is_clear(xy) & (np.linalg.norm(xy, axis=1) >= self.robot_clearance)
        return np.asarray(xy[free])

    def is_clear(self, xy: FloatArray) -> NDArray[np.bool_]:
        """Whether objects at these places, m, (n, 2), keep their distance from walls and obstacles; (n,)."""
        clear = (np.abs(xy) <= self._limit).all(axis=1)
        for obstacle in self.obstacles:
            clear &= obstacle.distance(xy) >= self.obstacle_clearance
        return np.asarray(clear)

    @property
    def _limit(self) -> FloatArray:
        return np.maximum(np.asarray(self.size) / 2 - self.wall_clearance, 0.0)

    def build(self, rng: np.random.Generator) -> mujoco.MjSpec:
        """The room as a MuJoCo spec, objects scattered as `scatter(rng)` would, to attach a robot to and to compile.

        Raises:
            ConfigError: the objects do not fit.
        """
        poses = self.scatter(rng)
        spec = mujoco.MjSpec()
        spec.modelname = self.name
        set_options(spec)
        set_visuals(spec, max(self.size))
        self._add_floor_and_walls(spec)
        for index, rug in enumerate(self.rugs):
            add_rug(spec, rug, index)
        for index, obstacle in enumerate(self.obstacles):
            add_obstacle(spec, obstacle, index)
        for index, (x, y, yaw) in enumerate(poses):
            kind = self.objects[index % len(self.objects)]
            body = add_object(spec, kind, f"{OBJECT_PREFIX}{index:02d}", rng)
            body.pos[:2] = x, y
            body.quat = yaw_quaternion(yaw)
        return spec

    def _add_floor_and_walls(self, spec: mujoco.MjSpec) -> None:
        half_x, half_y = self.size[0] / 2, self.size[1] / 2
        material = add_material(spec, FLOOR, self.floor, np.random.default_rng(TEXTURE_SEED))
        material.texrepeat = (1 / FLOOR_TILE, 1 / FLOOR_TILE)
        material.texuniform = True  # repeats per metre instead of per geom
        # Under the walls, too, or the sky shows through the seam.
        size = (half_x + WALL_THICKNESS, half_y + WALL_THICKNESS, 0.1)
        floor = add_static(spec, FLOOR, mujoco.mjtGeom.mjGEOM_PLANE, size)
        floor.material = FLOOR

        half_t, half_h = WALL_THICKNESS / 2, WALL_HEIGHT / 2
        walls = {
            "front": ((half_x + half_t, 0.0), (half_t, half_y + WALL_THICKNESS)),
            "back": ((-half_x - half_t, 0.0), (half_t, half_y + WALL_THICKNESS)),
            "left": ((0.0, half_y + half_t), (half_x, half_t)),
            "right": ((0.0, -half_y - half_t), (half_x, half_t)),
        }
        for side, (xy, half_size) in walls.items():
            wall = add_static(spec, WALL_PREFIX + side, mujoco.mjtGeom.mjGEOM_BOX, (*half_size, half_h))
            wall.pos = (*xy, half_h)
            wall.rgba = (*self.wall_color, 1.0)


def set_objects(model: mujoco.MjModel, data: mujoco.MjData, poses: FloatArray) -> None:
    """Put every object of a compiled room somewhere else, at rest on the floor; sleeping ones wake up.

    Args:
        model: compiled from `Room.build`.
        data: changed in place; positions only, so call `mj_forward` before looking.
        poses: m and rad, shape (number of objects, 3): x, y, yaw, as from `Room.scatter`.
    """
    for index, pose in enumerate(poses):
        set_object(model, data, index, pose)


def set_object(model: mujoco.MjModel, data: mujoco.MjData, index: int, pose: Sequence[float] | FloatArray) -> None:
    """Put one object of a compiled room somewhere else, at rest; as `set_objects`."""
    x, y, yaw = pose
    joint = model.joint(f"{OBJECT_PREFIX}{index:02d}")
    start, velocity = joint.qposadr[0], joint.dofadr[0]
    resting_height = model.qpos0[start + 2]
    data.qpos[start : start + 7] = (x, y, resting_height, *yaw_quaternion(yaw))
    data.qvel[velocity : velocity + 6] = 0.0


# --- Registry ------------------------------------------------------------------------------------------------
_ROOMS: dict[str, type[Room]] = {}


def register_room(name: str) -> Callable[[type[Room]], type[Room]]:
    """Class decorator that makes a dataclass derived from `Room` known under a name."""

    def register(room: type[Room]) -> type[Room]:
        known = _ROOMS.get(name)
        require(known in (None, room), f"There already is a room {name!r}; register yours under another name.")
        room.name = name
        _ROOMS[name] = room
        return room

    return register


def _load_rooms() -> None:
    """Import the paper's rooms and those that other packages name in `relmm.rooms`; `register_room` does the rest."""
    importlib.import_module("relmm.sim.paper_rooms")
    for entry_point in importlib.metadata.entry_points(group=ENTRY_POINT_GROUP):
        try:
            entry_point.load()
        except Exception as error:  # whatever a foreign package does wrong, the other rooms stay usable
            logger.warning("The rooms of %s cannot be imported: %r", entry_point.value, error)


def room_names() -> list[str]:
    """Names of all rooms, sorted, those of other installed packages included."""
    _load_rooms()
    return sorted(_ROOMS)


def make_room(name: str, **overrides: Any) -> Room:
    """A room by name, with any of its fields overridden.

    Raises:
        ConfigError: unknown room or field, or a value that cannot work.
    """
    if name not in _ROOMS and name not in (names := room_names()):
        raise ConfigError(f"There is no room {name!r}{suggestion(name, names)}; choose one of {', '.join(names)}.")
    room = _ROOMS[name]
    known = [field.name for field in fields(room)]
    unknown = [key for key in overrides if key not in known]
    require(not unknown, f"Room {name!r} has no {', '.join(unknown)}; choose from {', '.join(known)}.")
    return room(**overrides)
