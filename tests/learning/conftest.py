"""Frames whose number can be read back from their picture, and policies with small networks."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from relmm.features import MAX_THETA_VEL, MAX_X_VEL, Phase, Skill
from relmm.learning.learner import Learner
from relmm.learning.replay import Replay
from relmm.policies.controller import grasp_cell
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy

sys.path.insert(0, str(Path(__file__).parent))  # for scripted_world

# Episodes of drives (d), drives of pseudo-resets (r), attempts that fail (f) or do not (s), and placements (p).
SKILLS = {"d": Skill.NAVIGATE, "r": Skill.NAVIGATE, "f": Skill.GRASP, "s": Skill.GRASP, "p": Skill.PLACE}
SMALL = {"grasp_batch_size": 8, "navigation_batch_size": 8, "min_attempts_to_update": 3, "min_steps_to_update": 3}

Picture = NDArray[np.uint8]


@pytest.fixture(scope="session")
def numbered() -> Callable[[int], Picture]:
    """A picture that tells a number below 65536."""

    def picture(number: int) -> Picture:
        image = np.random.default_rng(number).integers(0, 256, (100, 100, 3), np.uint8)
        image[0, 0, :2] = divmod(number, 256)
        return image

    return picture


@pytest.fixture(scope="session")
def number_of() -> Callable[[Picture], int]:
    """The number of a numbered picture."""
    return lambda image: 256 * int(image[0, 0, 0]) + int(image[0, 0, 1])


@pytest.fixture(scope="session")
def action_of() -> Callable[[str, int], list[float]]:
    """An action, by its letter, that tells its frame's number: cell number % 225, forward and turn number % 1000."""

    def action(kind: str, number: int) -> list[float]:
        skill = SKILLS[kind]
        if skill == Skill.NAVIGATE:
            share = number % 1000 / 1000
            return [share * MAX_X_VEL, share * MAX_THETA_VEL, float(skill), 0.0, 0.0]
        grasp = list(grasp_cell(number % 225).values())
        return [0.0, 0.0, float(skill), *grasp[3:]]

    return action


@pytest.fixture(scope="session")
def motion_of() -> Callable[[int], tuple[float, float]]:
    """A motion, m/s and deg/s, that tells the number of its frame."""
    return lambda number: (number % 500 / 500 * MAX_X_VEL, -number % 500 / 500 * MAX_THETA_VEL)


@pytest.fixture(scope="session")
def make_policy() -> Callable[..., ReLMMPolicy]:
    """Builds a policy with small networks."""

    def make(**settings: Any) -> ReLMMPolicy:
        small = {"num_members": 2, "grasp_channels": 4, "navigation_hidden": 8}
        return ReLMMPolicy(ReLMMConfig(**{"device": "cpu", **small, **settings}))

    return make


@pytest.fixture(scope="session")
def fill(numbered, motion_of, action_of) -> Callable[..., Replay]:
    """A replay of a life, frame by frame."""

    def replay_of(life: list[str], capacity: int = 500) -> Replay:
        replay = Replay(capacity)
        for episode in life:
            for kind in episode:
                phase = Phase.PSEUDO_RESET if kind == "r" else Phase.LEARNING
                number = replay.frames
                replay.add(numbered(number), motion_of(number), action_of(kind, number), kind == "s", phase)
            replay.save_episode()
        return replay

    return replay_of


@pytest.fixture(scope="session")
def make_learner(make_policy, fill) -> Callable[..., Learner]:
    """A learner of a life."""

    def make(life: str = "", capacity: int = 200, seed: int = 0, **settings: Any) -> Learner:
        return Learner(make_policy(**{**SMALL, **settings}), fill(life.split(), capacity), seed)

    return make


@pytest.fixture(scope="session")
def count_steps() -> Callable[[Learner], dict[str, int]]:
    """Counts the steps of a learner's optimisers from now on."""

    def counted(learner: Learner) -> dict[str, int]:
        counts = dict.fromkeys(learner.optimizers, 0)

        def count(name: str) -> Callable[..., None]:
            def hook(*_: Any) -> None:
                counts[name] += 1

            return hook

        for name, optimizer in learner.optimizers.items():
            optimizer.register_step_post_hook(count(name))
        return counts

    return counted
