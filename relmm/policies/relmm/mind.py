"""What the policy keeps about one robot from one observation to the next."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from relmm.features import DRIVE_PULSE_S, GRID, FloatArray, action_dict
from relmm.policies.relmm.memory import FloorMemory
from relmm.policies.relmm.planning import Plan, Planner

_OTHER_TURN, _OTHER_WAY = 0.5, 0.05  # rad and m from what was commanded, that mean that something was in the way


@dataclass
class Mind:
    """What the policy keeps about one robot.

    Attributes:
        floor: as remembered.
        planner: of its ways.
        rng: of the cells.
        mean, std: what the ensemble thinks of the grasp cells now, 0 where attempts have just failed, (1, 225).
        attempted: places of the map where attempts have failed since the last navigation step, m.
        plan: the last one.
        step: its navigation step, m forward and rad, until it is seen what came of it.
        carry_to: where what is held is to be put down, and the pose to do it from, m and rad, on the map.
    """

    floor: FloorMemory
    planner: Planner
    rng: torch.Generator
    mean: Tensor = field(default_factory=lambda: torch.zeros(1, GRID**2))
    std: Tensor = field(default_factory=lambda: torch.zeros(1, GRID**2))
    attempted: list[FloatArray] = field(default_factory=list)
    plan: Plan | None = None
    step: tuple[float, float] | None = None
    carry_to: tuple[FloatArray, FloatArray] | None = None

    def drive(self) -> dict[str, float]:
        """The navigation step of the plan, as an action."""
        assert self.plan is not None
        self.step = forward, turn = self.plan.step
        self.floor.steps += 1
        return action_dict(x_vel=forward / DRIVE_PULSE_S, theta_vel=float(np.degrees(turn)) / DRIVE_PULSE_S)

    def move(self, motion: FloatArray) -> None:
        """Go along with the robot; `motion` by the wheels, m forward, m left, rad."""
        if self.step is not None:
            if abs(motion[2] - self.step[1]) > _OTHER_TURN or self.step[0] - np.hypot(*motion[:2]) > _OTHER_WAY:
                self.planner.thwart()
            self.step = None
        shift = self.floor.move(motion)
        if shift.any():
            self.planner.shift(shift)
            self.attempted = [place - shift for place in self.attempted]
            if self.carry_to is not None:
                place, pose = self.carry_to
                self.carry_to = place - shift, pose - np.array([*shift, 0.0])
