"""Policies with small networks, ensembles whose outputs are known, and lives whose frames can be read back."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from relmm.features import MAX_THETA_VEL, MAX_X_VEL, STATE_NAMES, Phase, Skill
from relmm.policies.controller import grasp_cell
from relmm.policies.relmm_paper.configuration_relmm_paper import RelmmPaperConfig
from relmm.policies.relmm_paper.grasping import GraspEnsemble
from relmm.policies.relmm_paper.learner import RelmmPaperLearner
from relmm.policies.relmm_paper.modeling_relmm_paper import RelmmPaperPolicy
from relmm.policies.relmm_paper.replay import Replay

NETWORKS = {"num_members": 3, "grasp_channels": 4, "navigation_encoder": "paper_small", "navigation_hidden": 8}
LEARNING = {"grasp_batch_size": 8, "navigation_batch_size": 8, "min_attempts_to_update": 3, "min_steps_to_update": 3}
# Episodes of drives (d), drives of pseudo-resets (r), attempts that fail (f) or do not (s), and placements (p).
SKILLS = {"d": Skill.NAVIGATE, "r": Skill.NAVIGATE, "f": Skill.GRASP, "s": Skill.GRASP, "p": Skill.PLACE}

Picture = NDArray[np.uint8]


@pytest.fixture(scope="session")
def make_config() -> Callable[..., RelmmPaperConfig]:
    """Builds a config with small networks."""
    return lambda **settings: RelmmPaperConfig(**{"device": "cpu", **NETWORKS, **settings})


@pytest.fixture(scope="session")
def make_policy(make_config) -> Callable[..., RelmmPaperPolicy]:
    """Builds a policy with small networks."""
    return lambda **settings: RelmmPaperPolicy(make_config(**settings)).eval()


@pytest.fixture(scope="session")
def set_logits() -> Callable[[GraspEnsemble, Tensor], None]:
    """Makes an ensemble give these logits, (members, 225), whatever it sees."""

    def set_(ensemble: GraspEnsemble, logits: Tensor) -> None:
        for member, row in zip(ensemble.members, logits, strict=True):
            nn.init.zeros_(member[-1].weight)
            member[-1].bias.data.copy_(row)

    return set_


@pytest.fixture(scope="session")
def noise_pictures() -> Callable[[int], Tensor]:
    """Pictures of nothing, uint8 (count, 3, 100, 100)."""

    def pictures(count: int) -> Tensor:
        rng = torch.Generator().manual_seed(count)
        return torch.randint(0, 256, (count, 3, 100, 100), dtype=torch.uint8, generator=rng)

    return pictures


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
def action_of() -> Callable[[str, int], NDArray[np.float32]]:
    """An action, by its letter, that tells its frame's number: cell number % 225, velocities number % 1000 / 1000."""

    def action(kind: str, number: int) -> NDArray[np.float32]:
        skill, share = SKILLS[kind], number % 1000 / 1000
        if skill == Skill.NAVIGATE:
            return np.array([share * MAX_X_VEL, share * MAX_THETA_VEL, skill, 0, 0], np.float32)
        return np.array([0, 0, skill, *list(grasp_cell(number % 225).values())[3:]], np.float32)

    return action


@pytest.fixture(scope="session")
def fill(numbered, action_of) -> Callable[..., Replay]:
    """A replay of a life, frame by frame."""

    def replay_of(life: list[str], capacity: int = 500) -> Replay:
        replay, frames = Replay(capacity), itertools.count()
        for episode in life:
            for kind in episode:
                frame = next(frames)
                phase = Phase.PSEUDO_RESET if kind == "r" else Phase.LEARNING
                replay.add(numbered(frame), action_of(kind, frame), kind == "s", phase)
            replay.save_episode()
        return replay

    return replay_of


@pytest.fixture(scope="session")
def live(numbered, action_of) -> Callable[..., None]:
    """Makes a learner take a life, frame by frame."""

    def take(learner: RelmmPaperLearner, life: str) -> None:
        state, frames = np.zeros(len(STATE_NAMES), np.float32), itertools.count()
        for episode in life.split():
            for kind in episode:
                number = next(frames)
                phase = Phase.PSEUDO_RESET if kind == "r" else Phase.LEARNING
                learner.add(numbered(number), state, action_of(kind, number), kind == "s", phase)
            learner.save_episode()

    return take


@pytest.fixture(scope="session")
def make_learner(make_policy, live) -> Callable[..., RelmmPaperLearner]:
    """A learner of a life."""

    def make(life: str = "", capacity: int = 200, seed: int = 0, **settings: Any) -> RelmmPaperLearner:
        learner = make_policy(**{**LEARNING, **settings}).make_learner(seed, capacity)
        live(learner, life)
        return learner

    return make


@pytest.fixture(scope="session")
def count_steps() -> Callable[[RelmmPaperLearner], dict[str, int]]:
    """Counts the steps of a learner's optimisers from now on."""

    def counted(learner: RelmmPaperLearner) -> dict[str, int]:
        counts = dict.fromkeys(learner.optimizers, 0)

        def count(name: str) -> Callable[..., None]:
            def hook(*_: Any) -> None:
                counts[name] += 1

            return hook

        for name, optimizer in learner.optimizers.items():
            optimizer.register_step_post_hook(count(name))
        return counts

    return counted
