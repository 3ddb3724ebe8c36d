"""The grasp ensemble (paper 4.1): networks over a map of the floor that predict where an attempt would succeed.

They are fully convolutional, so what one attempt teaches holds for all 225 cells, and for floor beyond the arm's reach.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from relmm.features import GRID
from relmm.geometry import camera_geometry
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.policies.relmm.floor import FloorView

MARGIN = 4  # cells that four 3x3 convolutions see either side of one
PATCH = 2 * MARGIN + 1
AREA = GRID + 2 * MARGIN  # cells a side of the floor that the grasp cells are judged by
# The map reaches 2.4 m ahead and 1.2 m to either side, in grasp cells: farther, a picture shows things too small.
_ROWS, _COLUMNS = 210, 217
FIRST_ROW, FIRST_COLUMN = -7, -101  # of the map, counted from the grasp area's
_STRIPS = 3  # across the map, each as wide as the camera sees the floor there
_PRIOR_CHANNELS = 8
_FAR_MEMBERS = 2  # that judge the strips beyond the nearest, 1 m: all would take twice as long, and no grasp is near


@dataclass
class Opinion:
    """What the ensemble thinks of the floor in some pictures.

    Attributes:
        mean, std: of the members' success probabilities on the map, 0 where it does not see, (batch, 210, 217).
    """

    mean: Tensor
    std: Tensor

    @property
    def cells(self) -> tuple[Tensor, Tensor]:
        """Mean and std of the grasp cells, (batch, 225) each, row by row from near right."""
        rows, columns = slice(-FIRST_ROW, GRID - FIRST_ROW), slice(-FIRST_COLUMN, GRID - FIRST_COLUMN)
        return self.mean[:, rows, columns].flatten(1), self.std[:, rows, columns].flatten(1)


class GraspEnsemble(nn.Module):
    """The ensemble.

    Args:
        config: of the policy.

    Attributes:
        known: of which pixels of the map it has an opinion, bool, (210, 217).
    """

    known: Tensor

    def __init__(self, config: ReLMMConfig) -> None:
        super().__init__()
        self.config = config
        camera = camera_geometry(config.camera)
        self.members = nn.ModuleList([_Member(config) for _ in range(config.num_members)])
        self.area = FloorView(camera, -MARGIN, -MARGIN, AREA, AREA)
        self.view = FloorView(
            camera, FIRST_ROW - MARGIN, FIRST_COLUMN - MARGIN, _ROWS + 2 * MARGIN, _COLUMNS + 2 * MARGIN
        )
        # A cell is judged by the floor round it; the picture's edge looks like an object where no grasp has taught
        # otherwise, that is, outside the grasp area.
        outside = (self.view.grid.abs() > 1).any(dim=-1)
        known = functional.max_pool2d(outside.float()[None], PATCH, stride=1)[0] == 0
        reach = slice(-FIRST_ROW, GRID - FIRST_ROW), slice(-FIRST_COLUMN, GRID - FIRST_COLUMN)
        known[reach] = ~outside[MARGIN:-MARGIN, MARGIN:-MARGIN][reach]
        self.register_buffer("known", known, persistent=False)
        strips = [(first, first + _ROWS // _STRIPS) for first in range(0, _ROWS, _ROWS // _STRIPS)]
        self._strips = [_rectangle(known, *strip) for strip in strips if known[slice(*strip)].any()]

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return next(self.parameters()).device

    def learned(self) -> list[nn.Parameter]:
        """The weights that learn."""
        return [weight for weight in self.parameters() if weight.requires_grad]

    def to_pictures(self, image: NDArray[np.uint8]) -> Tensor:
        """One picture, (100, 100, 3), as the ensemble takes it: 0..1, (1, 3, 100, 100)."""
        return torch.from_numpy(image).to(self.device).permute(2, 0, 1)[None] / 255

    @torch.no_grad()
    def look(self, images: Tensor) -> Opinion:
        """The ensemble's opinion of all floor in view, of images 0..1, (batch, 3, 100, 100)."""
        floor = self.view(images)
        mean, std = floor.new_zeros(2, len(images), _ROWS, _COLUMNS)
        for strip, (rows, columns) in enumerate(self._strips):
            part = floor[:, :, rows.start : rows.stop + 2 * MARGIN, columns.start : columns.stop + 2 * MARGIN]
            chances = self.logits(part, None if strip == 0 else _FAR_MEMBERS).sigmoid()
            middle = mean[:, rows, columns] = chances.mean(dim=0)
            std[:, rows, columns] = (chances - middle).square_().mean(dim=0).sqrt_()
        return Opinion(mean * self.known, std * self.known)

    @torch.no_grad()
    def look_at_cells(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """`look(images).cells` without the floor beyond the arm's reach, a tenth of the work."""
        chances = self.logits(self.area(images)).sigmoid().flatten(2)
        reach = self.known[-FIRST_ROW : GRID - FIRST_ROW, -FIRST_COLUMN : GRID - FIRST_COLUMN].flatten()
        return chances.mean(dim=0) * reach, chances.std(dim=0, correction=0) * reach

    def logits(self, floor: Tensor, members: int | None = None) -> Tensor:
        """Success logits of all or the first members: any map of the floor (batch, 3, h, w) -> (n, batch, h-8, w-8)."""
        floor = floor.contiguous(memory_format=torch.channels_last)
        return torch.stack([member(floor) for member in self.members[:members]])

    def _patch_logits(self, patches: Tensor) -> Tensor:
        """`logits` of single cells, (batch, 3, 9, 9) -> (n, batch): all members at once, twice as fast on so little."""
        logits = torch.zeros(())
        for part in ("learned", "prior"):
            hidden = patches
            for layers in zip(*(getattr(member, part) for member in self.members), strict=True):
                if isinstance(layers[0], nn.Conv2d):
                    weight, bias = (torch.cat([getattr(each, name) for each in layers]) for name in ("weight", "bias"))
                    hidden = functional.conv2d(hidden, weight, bias, groups=1 if hidden is patches else len(layers))
                else:
                    hidden = layers[0](hidden)
            logits = logits + hidden.flatten(1).T
        return logits

    def sample(self, mean: Tensor, std: Tensor, rng: torch.Generator) -> Tensor:
        """Cells in proportion to exp(alpha * mean + beta * std) (paper eq. 2): (batch, 225) twice -> (batch,) int64."""
        scores = self.config.mean_weight * mean + self.config.std_weight * std
        return torch.multinomial(scores.softmax(dim=1).cpu(), 1, generator=rng).squeeze(1)

    def loss(
        self, areas: Tensor, cells: Tensor, successes: Tensor, noise: torch.Generator | None = None
    ) -> tuple[Tensor, dict[str, float]]:
        """Cross-entropy of the attempted cells (paper eq. 1): the mean over the batch, summed over the members.

        Args:
            areas: the floor before the attempts, as `area` draws it, (batch, 3, 23, 23).
            cells: attempted, (batch,) int64.
            successes: 0 or 1, (batch,).
            noise: for mirrored and recoloured floor, None for floor as it was.

        Returns:
            The loss, and the mean of the members' losses for logs.
        """
        windows = areas.unfold(2, PATCH, 1).unfold(3, PATCH, 1)  # (batch, 3, 15, 15, 9, 9)
        patches = windows[torch.arange(len(cells), device=cells.device), :, cells // GRID, cells % GRID]
        if noise is not None:
            # Left and right are alike; which half is mirrored does not matter, the batch is in random order.
            half = len(patches) // 2
            patches = torch.cat([patches[:half].flip(-1), patches[half:]])
            if self.config.recolor > 0:  # every second one: where colours matter, that must be learned as well
                patches[::2] = _recolored(patches[::2], self.config.recolor, noise)
        logits = self._patch_logits(patches)
        smoothing = self.config.smoothing
        targets = torch.where(successes > 0.5, 1 - smoothing, smoothing).to(logits.dtype).expand_as(logits)
        loss = functional.binary_cross_entropy_with_logits(logits, targets, reduction="none").mean(dim=1).sum()
        return loss, {"grasp_loss": loss.item() / len(logits)}


def _recolored(patches: Tensor, most: float, noise: torch.Generator) -> Tensor:
    """Floor whose colours have changed places and strength: what it shows can be grasped in any colour."""
    count = len(patches)
    order = torch.rand(count, 3, generator=noise).argsort(dim=1).to(patches.device)
    shuffled = patches[torch.arange(count, device=patches.device)[:, None], order]
    strength, shift = (2 * torch.rand(2, count, 3, 1, 1, generator=noise) - 1).to(patches.device) * most
    lit = (shuffled + 1) / 2 * (1 + strength) + shift / 4
    return lit.clamp(0, 1) * 2 - 1


def _rectangle(known: Tensor, first: int, last: int) -> tuple[slice, slice]:
    """Rows and columns of what is known in a strip of the map."""
    columns = known[first:last].any(dim=0).nonzero()
    return slice(first, last), slice(int(columns.min()), int(columns.max()) + 1)


class _Member(nn.Module):
    """One network of the ensemble: what is learned, plus a fixed random function of the floor (Osband et al. 2018).

    Where nothing like it was tried, what is learned does not make up for the random part, so members disagree there
    for as long as it takes; that is what the uncertainty bonus explores by.
    """

    def __init__(self, config: ReLMMConfig) -> None:
        super().__init__()
        width = config.channels
        self.learned = nn.Sequential(
            _convolution(3, width, 3),
            nn.ReLU(inplace=True),
            _convolution(width, width, 3),
            nn.ReLU(inplace=True),
            _convolution(width, width, 3),
            nn.ReLU(inplace=True),
            _convolution(width, 1, 3, bias=config.initial_logit),
        )
        self.prior = nn.Sequential(
            _convolution(3, _PRIOR_CHANNELS, 5),
            nn.ReLU(inplace=True),
            _convolution(_PRIOR_CHANNELS, 1, 5, scale=config.prior_scale, bias=0.0),
        ).requires_grad_(False)

    def forward(self, floor: Tensor) -> Tensor:
        """Logits, (batch, 3, h, w) -> (batch, h - 8, w - 8)."""
        logits: Tensor = self.learned(floor) + self.prior(floor)
        return logits.squeeze(1)


def _convolution(inputs: int, outputs: int, size: int, scale: float = 1.0, bias: float | None = None) -> nn.Conv2d:
    """A layer that gives outputs about as large as its inputs, times `scale`; with random biases, or all the same."""
    layer = nn.Conv2d(inputs, outputs, size)
    nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
    assert layer.bias is not None
    with torch.no_grad():
        layer.weight *= scale
        if bias is None:
            layer.bias.uniform_(-0.3, 0.3)
        else:
            layer.bias.fill_(bias)
    return layer
