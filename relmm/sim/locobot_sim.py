"""The simulated LoCoBot as a LeRobot `Robot`."""

from __future__ import annotations

import numpy as np

from relmm.geometry import camera_geometry
from relmm.robot.locobot import LocobotRobot
from relmm.sim.body import SimBody
from relmm.sim.config_locobot_sim import LocobotSimConfig
from relmm.sim.realism import realism


class LocobotSim(LocobotRobot):
    """A LoCoBot in a MuJoCo room; `connect` puts it there, `reset` starts over with another seed."""

    config_class = LocobotSimConfig
    name = "locobot_sim"

    def __init__(self, config: LocobotSimConfig) -> None:
        super().__init__(config, depth=config.depth, seed=config.seed or 0)
        self.config = config

    def make_body(self) -> SimBody:
        """Build the room and put the robot into it."""
        body = SimBody(self.config.make_room(), camera_geometry(self.config.camera), realism(self.config.realism))
        body.reset(np.random.default_rng(self.config.seed or 0))
        return body

    @property
    def body(self) -> SimBody:
        """The simulated body, with the simulator's ground truth for evaluation and tests."""
        body = super().body
        assert isinstance(body, SimBody)
        return body

    def reset(self, seed: int) -> None:
        """Scatter the objects anew and put the robot back into the middle, without building the room again."""
        self.body.reset(np.random.default_rng(seed))
        self.start_skills(seed)
