"""A kitchen with an island, for `--robot.room=kitchen` and `--env.room=kitchen`."""

from dataclasses import dataclass

from relmm.sim.furniture import Obstacle
from relmm.sim.rooms import Room, register_room


@register_room("kitchen")
@dataclass(frozen=True, kw_only=True)
class Kitchen(Room):
    """Four by three metres."""

    size: tuple[float, float] = (4.0, 3.0)
    objects: tuple[str, ...] = ("car", "sock", "egg")
    obstacles: tuple[Obstacle, ...] = (Obstacle(shape="box", x=1.2, y=1.0, half_size=(0.3, 0.3), height=0.8),)
