"""Frames whose number can be read back from their picture, and policies with small networks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from relmm.features import MAX_THETA_VEL, MAX_X_VEL, Skill
from relmm.policies.controller import grasp_cell
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy

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
def action_of() -> Callable[[Skill, int], list[float]]:
    """An action that tells the number of its frame: cell number % 225, forward and turn of number % 1000."""

    def action(skill: Skill, number: int) -> list[float]:
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
