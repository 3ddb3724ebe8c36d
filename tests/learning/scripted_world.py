"""A robot, a policy and a learner whose answers are scripted, so that what the trainer asks of them can be compared."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from relmm.features import FRONT, STATE_NAMES, Phase, Skill, action_dict
from relmm.learning.life import Life
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.policies.relmm.searching import Search

SAMPLED_CELL = 99  # that the ensemble would choose
POLICY_DRIVE = action_dict(x_vel=0.123, theta_vel=45.6)  # that the navigation would choose

Event = tuple[str, Phase | None]
LEARN_GRASP, LEARN_DRIVE = ("learn to grasp", None), ("learn to drive", None)


@dataclass
class World:
    """A robot whose grasps succeed, and whose pictures ask for a grasp, by chance; and what happened to it.

    `grasp_wanted` is what P[grasp] of the next pictures is: it changes with every drive.
    """

    seed: int
    success: float = 0.3
    wanted: float = 0.5
    events: list[Event] = field(default_factory=list)
    actions: list[dict[str, float]] = field(default_factory=list)
    grasps: list[bool] = field(default_factory=list)  # whether each succeeded
    holding: bool = False
    stuck: bool = False  # whether nothing can be put down: something is in the way

    def __post_init__(self) -> None:
        self._successes, self._wishes = (np.random.default_rng([self.seed, which]) for which in (0, 1))
        self.grasp_wanted = False

    def drive(self, phase: Phase) -> None:
        self.events.append(("drive", phase))
        self.grasp_wanted = bool(self._wishes.random() < self.wanted)

    def grasp(self, phase: Phase) -> bool:
        self.events.append(("grasp", phase))
        self.holding = bool(self._successes.random() < self.success)
        self.grasps.append(self.holding)
        return self.holding

    @property
    def attempts_since_first_success(self) -> int:
        return len(self.grasps[self.grasps.index(True) :]) if True in self.grasps else 0

    def place(self, phase: Phase) -> None:
        self.events.append(("place", phase))
        self.holding = self.holding and self.stuck

    # --- As a robot -----------------------------------------------------------------------------------------
    phase = Phase.LEARNING  # of the action to come

    def get_observation(self) -> dict[str, Any]:
        picture = np.full((2, 2, 3), 255 * self.grasp_wanted, np.uint8)
        return {**dict.fromkeys(STATE_NAMES, 0.5), "holding.pos": float(self.holding), FRONT: picture}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        self.actions.append(action)
        skill = Skill(int(action["skill.pos"]))
        {Skill.NAVIGATE: self.drive, Skill.GRASP: self.grasp, Skill.PLACE: self.place}[skill](self.phase)
        return action


class PhaseLife(Life):
    """A life that tells the world the phase of each frame."""

    def step(self, action: dict[str, float], phase: Phase, grasp_probability: float = -1.0) -> bool:
        self._robot.phase = phase
        return super().step(action, phase, grasp_probability)


class FakePolicy:
    """Its P[grasp] is what the picture says: 1 if it is white, `floor_probability` if black."""

    sampling = False
    rng = None
    floor_probability = 0.0

    def __init__(self, config: ReLMMConfig) -> None:
        self.config = config
        self.grasp_probability = -1.0
        self.grasping = SimpleNamespace(sample=lambda estimate, rng: torch.tensor([SAMPLED_CELL]))

    def to_pictures(self, image: np.ndarray) -> np.ndarray:
        return image

    def look(self, image: np.ndarray) -> None:
        self.grasp_probability = 1.0 if image.max() else self.floor_probability

    def navigate(self, image: np.ndarray, theta_vel: float, search: Search, rng: object) -> dict[str, float]:
        return POLICY_DRIVE


class FakeReplay:
    """Holds the world's attempts."""

    def __init__(self, world: World) -> None:
        self._world = world
        self.attempts = world.grasps

    @property
    def attempts_since_first_success(self) -> int:
        return self._world.attempts_since_first_success


class FakeLearner:
    """Notes when it is asked to learn."""

    def __init__(self, world: World, min_attempts: int) -> None:
        self._world, self._min_attempts = world, min_attempts
        self.phases: list[int] = []  # of the attempts that it was asked to learn from
        self.replay = FakeReplay(world)

    @property
    def grasping_has_begun(self) -> bool:
        return len(self.replay.attempts) >= self._min_attempts

    def update_grasping(self, phase: int) -> None:
        self.phases.append(phase)
        self._world.events.append(LEARN_GRASP)

    def update_navigation(self) -> None:
        self._world.events.append(LEARN_DRIVE)

    # --- As a recorder --------------------------------------------------------------------------------------
    def add_frame(self, observation: Any, action: dict[str, float], outcome: Any, task: str) -> None:
        pass

    def save_episode(self) -> None:
        pass
