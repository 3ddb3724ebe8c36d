"""The grasp ensemble (paper 4.1): M networks that predict the success of an attempt in each of the 225 cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from relmm.features import GRASP_X, GRASP_Y, GRID, FloatArray, cell_to_xy, xy_to_cell
from relmm.policies.relmm_paper.configuration_relmm_paper import RelmmPaperConfig
from relmm.policies.relmm_paper.networks import dense_layers, initialised, scaled, strided_convolutions

# First row, first column and side of what the networks see: the paper's centre; in the code it lies 18 pixels lower,
# where the grasp area is, which is followed.
_ROW, _COLUMN, SIDE = 38, 20, 60
CROP = (..., slice(_ROW, _ROW + SIDE), slice(_COLUMN, _COLUMN + SIDE))
HIDDEN = 512


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
    """The paper's networks: three convolutions of stride 2 over a crop of the picture, two dense layers, 225 logits.

    All members learn from the same batches, as in the code; they differ by their first weights.

    Args:
        config: of the policy.
    """

    def __init__(self, config: RelmmPaperConfig) -> None:
        super().__init__()
        self.config = config
        self.members = nn.ModuleList([_network(config.grasp_channels) for _ in range(config.num_members)])

    def logits(self, pictures: Tensor) -> Tensor:
        """Success logits of all cells: uint8 (batch, 3, 100, 100) -> (members, batch, 225)."""
        crop = scaled(pictures[CROP], self.config.grasp_input_gain)
        return torch.stack([member(crop) for member in self.members])

    def estimate(self, pictures: Tensor) -> Estimate:
        """Mean and standard deviation over the members, without gradients."""
        with torch.no_grad():
            probabilities = self.logits(pictures).sigmoid()
        return Estimate(probabilities.mean(dim=0), probabilities.std(dim=0, correction=0))

    def grasp_probability(self, estimate: Estimate) -> Tensor:
        """P[grasp] (paper eq. 3), at most 1, (batch,)."""
        config = self.config
        return estimate.scores(config.gate_mean_weight, config.gate_std_weight).amax(dim=1).clamp(max=1.0)

    def sample(self, estimate: Estimate, rng: np.random.Generator) -> NDArray[np.int64]:
        """Cells in proportion to exp(alpha * mean + beta * std) (paper eq. 2), (batch,)."""
        scores = estimate.scores(self.config.mean_weight, self.config.std_weight).cpu().numpy()
        # The highest of scores with Gumbel noise is a draw from their softmax.
        return (scores + rng.gumbel(size=scores.shape)).argmax(axis=1)

    def anywhere(self, rng: np.random.Generator) -> FloatArray:
        """The centre of any cell, m, (2,)."""
        return cell_to_xy(int(rng.integers(GRID**2)))

    def choose(self, pictures: Tensor, estimate: Estimate, rng: np.random.Generator, greedy: bool) -> FloatArray:
        """The centre of the cell with the best mean, or of a sampled one, m, (2,); for one picture."""
        return cell_to_xy(int(estimate.mean[0].argmax() if greedy else self.sample(estimate, rng)[0]))

    def opinion(self, pictures: Tensor, estimate: Estimate, place: FloatArray) -> tuple[float, float]:
        """Mean and standard deviation of success in the cell of a place, m; for one picture."""
        cell = xy_to_cell(*place.tolist())
        return float(estimate.mean[0, cell]), float(estimate.std[0, cell])

    def loss(self, pictures: Tensor, places: Tensor, successes: Tensor) -> tuple[Tensor, dict[str, float]]:
        """Cross-entropy of the attempted cells (paper eq. 1): the mean over the batch, summed over the members.

        Args:
            pictures: before the attempts, uint8 (batch, 3, 100, 100).
            places: where, m, (batch, 2).
            successes: (batch,) bool.

        Returns:
            The loss, and its mean over the members for logs.
        """
        logits = self.logits(pictures)
        logits = logits.gather(2, to_cells(places).expand(len(logits), -1)[..., None]).squeeze(2)
        targets = successes.to(logits.dtype).expand_as(logits)
        loss = functional.binary_cross_entropy_with_logits(logits, targets, reduction="none").mean(dim=1).sum()
        return loss, {"grasp_loss": loss.item() / len(logits)}


def to_cells(places: Tensor) -> Tensor:
    """As `relmm.features.xy_to_cell`, of (batch, 2) -> (batch,) int64."""
    rows, columns = (
        ((places[:, axis] - low) / (high - low) * GRID).long().clamp(0, GRID - 1)
        for axis, (low, high) in enumerate((GRASP_X, GRASP_Y))
    )
    return rows * GRID + columns


def _network(width: int) -> nn.Sequential:
    pixels = (SIDE + 7) // 8  # a side, after three strides
    return initialised([*strided_convolutions(width), *dense_layers(width * pixels**2, HIDDEN, GRID**2)])
