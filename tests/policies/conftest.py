from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class
from numpy.typing import NDArray

import relmm.plugin  # noqa: F401
from relmm.features import ACTION_NAMES, IMAGE_KEY, IMAGE_SIZE, STATE_KEY, STATE_NAMES
from relmm.policies.controller import ControllerPolicy

Image = NDArray[np.uint8]
MakeController = Callable[..., ControllerPolicy]
MakeBatch = Callable[..., dict[str, torch.Tensor]]
Act = Callable[..., dict[str, float]]


@pytest.fixture(scope="session")
def make_controller() -> MakeController:
    """Builds a controller by its type; the other arguments are settings."""

    def make(kind: str, **settings: Any) -> ControllerPolicy:
        config = PreTrainedConfig.get_choice_class(kind)(
            device="cpu",
            input_features={
                IMAGE_KEY: PolicyFeature(FeatureType.VISUAL, (3, IMAGE_SIZE, IMAGE_SIZE)),
                STATE_KEY: PolicyFeature(FeatureType.STATE, (len(STATE_NAMES),)),
            },
            output_features={"action": PolicyFeature(FeatureType.ACTION, (len(ACTION_NAMES),))},
            **settings,
        )
        return get_policy_class(kind)(config)

    return make


@pytest.fixture(scope="session")
def make_batch() -> MakeBatch:
    """Builds a batch as LeRobot's preprocessor gives it, from pictures; `holding` are the rows that hold something."""

    def make(*images: Image, holding: tuple[int, ...] = ()) -> dict[str, torch.Tensor]:
        state = torch.zeros(len(images), len(STATE_NAMES))
        state[list(holding), STATE_NAMES.index("holding.pos")] = 1.0
        return {IMAGE_KEY: torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2) / 255, STATE_KEY: state}

    return make


@pytest.fixture(scope="session")
def act(make_batch: MakeBatch) -> Act:
    """Asks a controller for one robot's action, by name."""

    def one(policy: ControllerPolicy, image: Image, **state: Any) -> dict[str, float]:
        return dict(zip(ACTION_NAMES, policy.select_action(make_batch(image, **state))[0].tolist(), strict=True))

    return one


@pytest.fixture(scope="session")
def empty() -> Image:
    """A picture of an evenly coloured floor."""
    return np.full((IMAGE_SIZE, IMAGE_SIZE, 3), (221, 204, 187), np.uint8)
