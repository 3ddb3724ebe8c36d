"""The grasp ensemble (paper 4.1): M networks that predict the success of an attempt in each of the 225 cells."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from relmm.features import GRID
from relmm.geometry import camera_geometry
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.policies.relmm.floor import FloorView

# Four 3x3 convolutions see four cells either side of one.
_MARGIN = 4
_PATCH = 2 * _MARGIN + 1
_CROP = (38, 20, 60)  # first row, first column and side; the authors' "centre" crop lies 18 pixels lower


@dataclass
class Estimate:
    """What the ensemble thinks of the grasps in some pictures.

    Attributes:
        mean, std: of the members' success probabilities, (batch, 225); cells row by row from near right.
    """

    mean: Tensor
    std: Tensor

    def scores(self, mean_weight: float, std_weight: float) -> Tensor:
        """Alpha * mean + beta * std (paper eq. 2), (batch, 225)."""
        return mean_weight * self.mean + std_weight * self.std


class GraspEnsemble(nn.Module):
    """The ensemble, whatever its networks look like.

    Args:
        config: of the policy.
    """

    def __init__(self, config: ReLMMConfig) -> None:
        super().__init__()
        self.config = config
        backbone = RectifiedBackbone if config.grasp_backbone == "rectified" else DenseBackbone
        self.backbone: RectifiedBackbone | DenseBackbone = backbone(config)

    def logits(self, images: Tensor) -> Tensor:
        """Success logits of all cells: images 0..1 (batch, 3, 100, 100) -> (members, batch, 225)."""
        return self.backbone(images)

    def estimate(self, images: Tensor) -> Estimate:
        """Mean and standard deviation over the members, without gradients."""
        with torch.no_grad():
            probabilities = self.logits(images).sigmoid()
        return Estimate(probabilities.mean(dim=0), probabilities.std(dim=0, correction=0))

    def grasp_probability(self, estimate: Estimate) -> Tensor:
        """P[grasp] (paper eq. 3), at most 1, (batch,)."""
        config = self.config
        return estimate.scores(config.gate_mean_weight, config.gate_std_weight).amax(dim=1).clamp(max=1.0)

    def sample(self, estimate: Estimate, rng: torch.Generator) -> Tensor:
        """Cells in proportion to exp(alpha * mean + beta * std) (paper eq. 2), (batch,) int64."""
        scores = estimate.scores(self.config.mean_weight, self.config.std_weight)
        return torch.multinomial(scores.softmax(dim=1).cpu(), 1, generator=rng).squeeze(1)

    def loss(self, images: Tensor, cells: Tensor, successes: Tensor) -> Tensor:
        """Cross-entropy of the attempted cells (paper eq. 1): the mean over the batch, summed over the members.

        Args:
            images: before the attempts, 0..1, (batch, 3, 100, 100).
            cells: attempted, (batch,) int64.
            successes: 0 or 1, (batch,).
        """
        logits = self.backbone.attempted(images, cells)
        targets = successes.to(logits.dtype).expand_as(logits)
        return functional.binary_cross_entropy_with_logits(logits, targets, reduction="none").mean(dim=1).sum()


class RectifiedBackbone(nn.Module):
    """Fully convolutional networks over the map of the floor: what one cell teaches holds for all.

    Args:
        config: of the policy.
    """

    def __init__(self, config: ReLMMConfig) -> None:
        super().__init__()
        side = GRID + 2 * _MARGIN
        self.mirror = config.mirror
        self.view = FloorView(camera_geometry(config.camera), -_MARGIN, -_MARGIN, side, side)
        self.members = nn.ModuleList([_convolutions(config) for _ in range(config.num_members)])

    def forward(self, images: Tensor) -> Tensor:
        """Logits of all cells, (members, batch, 225)."""
        return self.on_map(self.view(images)).flatten(2)

    def on_map(self, floor: Tensor, members: int | None = None) -> Tensor:
        """Logits on any map of the floor, by the first `members` or all: (batch, 3, h, w) -> (n, batch, h-8, w-8)."""
        floor = floor.contiguous(memory_format=torch.channels_last)
        return torch.stack([member(floor).squeeze(1) for member in self.members[:members]])

    def first_on_map(self, floor: Tensor) -> Tensor:
        """The same by the first member alone, (batch, h - 8, w - 8): all six would take six times as long."""
        member = self.members[0]
        assert isinstance(member, nn.Sequential)
        last = member[-1]
        assert isinstance(last, nn.Conv2d)
        assert last.bias is not None
        features: Tensor = member[:-1](floor.contiguous(memory_format=torch.channels_last))
        # A convolution to one channel takes as long as one to sixteen, and one of each channel for itself a fifth.
        by_channel = functional.conv2d(features, last.weight.transpose(0, 1), groups=features.shape[1])
        return by_channel.sum(dim=1) + last.bias

    def attempted(self, images: Tensor, cells: Tensor) -> Tensor:
        """Logits of one cell a picture, from the floor round it alone, (members, batch)."""
        windows = self.view(images).unfold(2, _PATCH, 1).unfold(3, _PATCH, 1)  # (batch, 3, 15, 15, 9, 9)
        patches = windows[torch.arange(len(cells), device=cells.device), :, cells // GRID, cells % GRID]
        if self.mirror and self.training:
            # Left and right are alike; which half is mirrored does not matter, the batch is in random order.
            half = len(patches) // 2
            patches = torch.cat([patches[:half].flip(-1), patches[half:]])
        return self.on_map(patches).flatten(1)


class DenseBackbone(nn.Module):
    """The paper's networks: three convolutions of stride 2 over a crop of the picture, two dense layers, 225 logits.

    Args:
        config: of the policy.
    """

    def __init__(self, config: ReLMMConfig) -> None:
        super().__init__()
        self.members = nn.ModuleList([_dense(config) for _ in range(config.num_members)])

    def forward(self, images: Tensor) -> Tensor:
        """Logits of all cells, (members, batch, 225)."""
        row, column, side = _CROP
        crop = images[:, :, row : row + side, column : column + side] * 2 - 1
        crop = crop.contiguous(memory_format=torch.channels_last)
        return torch.stack([member(crop) for member in self.members])

    def attempted(self, images: Tensor, cells: Tensor) -> Tensor:
        """Logits of one cell a picture, (members, batch)."""
        logits = self(images)
        return logits.gather(2, cells.expand(len(logits), -1)[..., None]).squeeze(2)


def _convolutions(config: ReLMMConfig) -> nn.Sequential:
    width = config.grasp_channels
    net = nn.Sequential(
        nn.Conv2d(3, width, 3),
        nn.ReLU(inplace=True),
        nn.Conv2d(width, width, 3),
        nn.ReLU(inplace=True),
        nn.Conv2d(width, width, 3),
        nn.ReLU(inplace=True),
        nn.Conv2d(width, 1, 3),
    )
    for layer in net:
        if isinstance(layer, nn.Conv2d):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            assert layer.bias is not None
            nn.init.uniform_(layer.bias, -0.3, 0.3)
    last = net[-1]
    assert isinstance(last, nn.Conv2d)
    assert last.bias is not None
    with torch.no_grad():
        # Kaiming gives outputs about as large as the inputs; scaled, members disagree by this much where nothing is
        # known, which is what the uncertainty bonus explores by (the authors get it from unscaled pixels).
        last.weight *= config.grasp_initial_spread
        last.bias.fill_(config.grasp_initial_logit)
    return net


def _dense(config: ReLMMConfig) -> nn.Sequential:
    width, hidden, size = config.grasp_channels, 512, _CROP[2]
    layers: list[nn.Module] = []
    for inputs in (3, width, width):
        layers += [nn.Conv2d(inputs, width, 3, stride=2, padding=1), nn.ReLU()]
        size = (size + 1) // 2
    layers += [nn.Flatten(), nn.Linear(width * size**2, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU()]
    net = nn.Sequential(*layers, nn.Linear(hidden, GRID**2))
    for layer in net:
        if isinstance(layer, nn.Conv2d | nn.Linear):  # as Keras does by default
            nn.init.xavier_uniform_(layer.weight)
            assert layer.bias is not None
            nn.init.zeros_(layer.bias)
    return net
