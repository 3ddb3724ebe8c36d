"""Ensembles whose outputs are known, and pictures with things at known grasp cells."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from relmm.features import cell_to_xy
from relmm.geometry import camera_geometry
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.policies.relmm.floor import OBJECT_HEIGHT
from relmm.policies.relmm.grasping import DenseBackbone, GraspEnsemble, RectifiedBackbone
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy

DENSE = {"grasp_backbone": "dense", "navigation_encoder": "paper_small"}

MakeConfig = Callable[..., ReLMMConfig]
MakePolicy = Callable[..., ReLMMPolicy]


@pytest.fixture(scope="session")
def make_config() -> MakeConfig:
    """Builds a config with small networks: `rectified` or `dense`, with other settings."""

    def make(backbone: str = "rectified", **settings: object) -> ReLMMConfig:
        small = {"num_members": 3, "grasp_channels": 4, "navigation_hidden": 8}
        return ReLMMConfig(**{"device": "cpu", **small, **(DENSE if backbone == "dense" else {}), **settings})

    return make


@pytest.fixture(scope="session")
def set_logits() -> Callable[[GraspEnsemble, Tensor], None]:
    """Makes a dense ensemble give these logits, (members, 225), whatever it sees."""

    def set_(ensemble: GraspEnsemble, logits: Tensor) -> None:
        assert isinstance(ensemble.backbone, DenseBackbone)
        for member, row in zip(ensemble.backbone.members, logits, strict=True):
            nn.init.zeros_(member[-1].weight)
            member[-1].bias.data.copy_(row)

    return set_


@pytest.fixture(scope="session")
def see_green() -> Callable[..., None]:
    """Makes each member of a rectified ensemble give scale * max(green - red, 0) + bias at each cell, seen -1..1."""

    def set_(ensemble: GraspEnsemble, scales: Sequence[float], bias: float = -4.0) -> None:
        assert isinstance(ensemble.backbone, RectifiedBackbone)
        for member, scale in zip(ensemble.backbone.members, scales, strict=True):
            convolutions = [layer for layer in member if isinstance(layer, nn.Conv2d)]
            for layer in convolutions:
                nn.init.zeros_(layer.weight)
                nn.init.zeros_(layer.bias)
                layer.weight.data[0, 0, 1, 1] = 1.0
            convolutions[0].weight.data[0, :, 1, 1] = torch.tensor([-1.0, 1.0, 0.0])
            convolutions[-1].weight.data *= scale
            convolutions[-1].bias.data.fill_(bias)

    return set_


@pytest.fixture(scope="session")
def draw() -> Callable[..., NDArray[np.uint8]]:
    """Draws a picture of an even floor with a square of colour at each of some grasp cells."""

    def picture(
        *cells: int, color: Sequence[int] = (0, 255, 0), floor: int = 128, radius: int = 1, camera: str = "paper"
    ) -> NDArray[np.uint8]:
        image = np.full((100, 100, 3), floor, np.uint8)
        for cell in cells:
            column, row = camera_geometry(camera).project(np.array([*cell_to_xy(cell), OBJECT_HEIGHT])).round()
            rows, columns = (slice(int(middle) - radius, int(middle) + radius + 1) for middle in (row, column))
            image[rows, columns] = color
        return image

    return picture


@pytest.fixture(scope="session")
def noise_pictures() -> Callable[[int], Tensor]:
    """Pictures of nothing, 0..1, (count, 3, 100, 100)."""
    return lambda count: torch.rand(count, 3, 100, 100, generator=torch.Generator().manual_seed(count))


@pytest.fixture
def make_policy_of(make_config) -> MakePolicy:
    return lambda *backbone, **settings: ReLMMPolicy(make_config(*backbone, **settings)).eval()


@pytest.fixture
def make_green(make_policy_of: MakePolicy, see_green) -> MakePolicy:
    """Builds a policy that wants to grasp what is green."""

    def make(**settings: object) -> ReLMMPolicy:
        policy = make_policy_of(seed=3, **settings)
        see_green(policy.grasping, [15.0, 20.0, 25.0])
        return policy

    return make
