"""A robot, a policy and a learner whose answers are scripted, so that what the trainer asks of them can be compared."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from relmm.features import FRONT, STATE_NAMES, Phase, Skill, action_dict
from relmm.learning.life import Life
from relmm.policies.controller import Row, grasp_cell
from relmm.policies.learning import LearningConfig

CELL = 99  # that the policy always chooses
DRIVE_BEFORE, DRIVE_AFTER = 2, 3  # of a pseudo-reset, around the placement

Event = tuple[str, Phase | None]
LEARN_GRASP, LEARN_DRIVE = ("learn to grasp", None), ("learn to drive", None)


@dataclass
class World:
    """A robot whose grasps succeed, and whose pictures ask for a grasp, by chance; and what happened to it.

    `grasp_wanted` is what the gate says of the next pictures: it changes with every drive.
    """

    seed: int
    success: float = 0.3
    wanted: float = 0.5
    events: list[Event] = field(default_factory=list)
    actions: list[dict[str, float]] = field(default_factory=list)
    grasps: list[bool] = field(default_factory=list)  # whether each succeeded
    holding: bool = False
    stuck: bool = False  # whether nothing can be put down: something is in the way
    looks: int = 0  # observations so far
    resets_learned: int = 0  # times that it was asked to learn after a step of a pseudo-reset

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
        """Its picture tells its number, and whether a grasp is wanted."""
        self.looks += 1
        picture = np.array([*divmod(self.looks, 256), self.grasp_wanted], np.uint8).reshape(1, 1, 3)
        return {**dict.fromkeys(STATE_NAMES, 0.0), "holding.pos": float(self.holding), FRONT: picture}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        self.actions.append(action)
        skill = Skill(int(action["skill.pos"]))
        {Skill.NAVIGATE: self.drive, Skill.GRASP: self.grasp, Skill.PLACE: self.place}[skill](self.phase)
        return action


class PhaseLife(Life):
    """A life that tells the world the phase of each frame."""

    def step(self, action: dict[str, float], phase: Phase, belief: Any = None) -> bool:
        self._robot.phase = phase
        return super().step(action, phase, belief)


def number_of(picture: np.ndarray) -> int:
    """Of an observation."""
    return 256 * int(picture[0, 0, 0]) + int(picture[0, 0, 1])


class ScriptedPolicy:
    """Wants to grasp where the picture says so, `num_grasp` times at most; its belief tells which picture it saw."""

    sampling = False

    def __init__(self, config: LearningConfig) -> None:
        self.config = config
        self.observed: list[int] = []  # numbers of the pictures, in order
        self._wanted = False

    def observe(self, image: np.ndarray, state: np.ndarray, row: Row) -> None:
        self.observed.append(number_of(image))
        self._wanted = bool(image[0, 0, 2])
        row.belief = {"grasp_probability": number_of(image) / 1024}

    def decide(self, image: np.ndarray, state: np.ndarray, row: Row) -> dict[str, float]:
        assert number_of(image) == self.observed[-1], "it decides on what it has observed last"
        wants = row.attempts < self.config.num_grasp and self._wanted
        return self.attempt(row) if wants else self.navigate(row)

    def attempt(self, row: Row) -> dict[str, float]:
        row.belief |= {"grasp_mean": 0.75}
        return grasp_cell(CELL)

    def navigate(self, row: Row) -> dict[str, float]:
        return action_dict(x_vel=0.125, theta_vel=45.0)

    def pseudo_reset(self, row: Row, steps: int, holding: Callable[[], bool]) -> Iterator[dict[str, float]]:
        for _ in range(DRIVE_BEFORE * steps):
            yield action_dict(x_vel=0.25)
        if holding():
            yield action_dict(Skill.PLACE, x=0.33)
        for _ in range(DRIVE_AFTER * steps):
            yield action_dict(x_vel=0.25)


class ScriptedLearner:
    """Notes when it is asked to learn, and what frames it was given."""

    def __init__(self, world: World) -> None:
        self._world = world
        self.phases: list[int] = []  # of the attempts that it was asked to learn from
        self.outcomes: list[dict[str, Any]] = []

    @property
    def attempts_since_first_success(self) -> int:
        return self._world.attempts_since_first_success

    def update_grasping(self, phase: int) -> None:
        self.phases.append(phase)
        self._world.events.append(LEARN_GRASP)

    def update_navigation(self) -> None:
        self._world.events.append(LEARN_DRIVE)

    def update_pseudo_reset(self) -> None:
        self._world.resets_learned += 1

    # --- As a recorder --------------------------------------------------------------------------------------
    def add_frame(self, observation: Any, action: dict[str, float], outcome: dict[str, Any], task: str) -> None:
        self.outcomes.append({**outcome, "number": number_of(observation[FRONT])})

    def save_episode(self) -> None:
        pass

    def cut_episode(self) -> None:
        pass
