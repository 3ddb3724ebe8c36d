"""The rooms of the paper."""

from __future__ import annotations

from dataclasses import dataclass

from relmm.sim.furniture import Obstacle, Rug, floor_lamp, shelf, sofa, table
from relmm.sim.rooms import Room, register_room


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
