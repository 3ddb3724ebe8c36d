"""What the perturbation policies of R3L learn from: the drives of pseudo-resets, before and after the placement."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from relmm.features import Phase, Skill
from relmm.policies.pseudo_reset import is_turn
from relmm.policies.relmm_paper.replay import VELOCITIES, Picture, Steps


class PerturbationReplay:
    """The newest steps of each of the two policies, `capacity` of each.

    A policy's steps end with the turn that comes after its last one, or with the pseudo-reset.

    Args:
        capacity: steps.

    Attributes:
        parts: before and after the object is put down.
        newest: the policy that made the last step, None after anything else.
    """

    def __init__(self, capacity: int) -> None:
        self.parts = Steps(capacity, *VELOCITIES), Steps(capacity, *VELOCITIES)
        self.newest: int | None = None
        self._part = 0  # of the running pseudo-reset

    def add(self, picture: Picture, action: NDArray[np.float32], phase: int) -> None:
        """Take one frame, as `relmm.policies.learning.Learner.add` does."""
        x_vel, theta_vel, skill = (float(value) for value in action[:3])
        resetting = phase == Phase.PSEUDO_RESET
        drives = resetting and round(skill) == Skill.NAVIGATE and not is_turn(x_vel, theta_vel)
        if self.newest is not None:
            self.parts[self.newest].end(picture, ended=not drives)
        if not resetting:
            self._part = 0
        elif not drives:
            self._part = 1
        self.newest = self._part if drives else None
        if drives:
            self.parts[self._part].begin(picture, x_vel=x_vel, theta_vel=theta_vel)

    def save_episode(self) -> None:
        """End the episode: what comes next need not follow on."""
        for part in self.parts:
            part.forget()
        self.newest, self._part = None, 0
