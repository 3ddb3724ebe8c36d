"""`--robot.type=locobot_sim`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from lerobot.robots.config import RobotConfig

from relmm.errors import MANY, MAX_SEED, check_range
from relmm.geometry import camera_geometry
from relmm.sim.realism import realism
from relmm.sim.rooms import Room, make_room


@RobotConfig.register_subclass("locobot_sim")
@dataclass(kw_only=True)
class LocobotSimConfig(RobotConfig):
    """A LoCoBot in a MuJoCo room.

    Args:
        room: name of a registered room.
        num_objects: how many objects lie in it; None for the room's own number.
        seed: where the objects lie and which way the robot looks at first; None for that of the command, or 0.
        camera: `paper` (the authors' simulated camera) or `d435` (a RealSense D435 on the LoCoBot's tower).
        depth: whether observations hold the depth picture too.
        tidy_every: navigation steps of a training after which a person lays what lies stuck at walls and obstacles
            elsewhere; each object counts as an intervention. 0 for never.
        realism: `none`, or `mild` or `harsh`: noise, light, wheels and delays as of a real robot, drawn anew by seed.
    """

    room: str = "no_obstacles"
    num_objects: int | None = None
    seed: int | None = None
    camera: str = "paper"
    depth: bool = False
    tidy_every: int = 0
    realism: str = "none"

    def __post_init__(self) -> None:
        super().__post_init__()
        camera_geometry(self.camera)
        realism(self.realism)
        check_range("robot.seed", self.seed or 0, 0, MAX_SEED)
        check_range("robot.tidy_every", self.tidy_every, 0, MANY)
        self.make_room().scatter(np.random.default_rng(0))  # says now if the objects do not fit

    def make_room(self) -> Room:
        """The room these settings describe.

        Raises:
            ConfigError: there is no such room, or its objects do not fit.
        """
        overrides = {} if self.num_objects is None else {"num_objects": self.num_objects}
        return make_room(self.room, **overrides)
