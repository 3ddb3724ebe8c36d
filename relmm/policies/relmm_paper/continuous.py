"""The paper's continuous grasps: networks that judge any place, and the cross-entropy method that looks for the best.

After QT-Opt (Kalashnikov et al. 2018), as in the authors' code; the paper compares its discrete ensemble with it.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from relmm.features import GRASP_X, GRASP_Y, GRID, FloatArray, cell_to_xy
from relmm.policies.relmm_paper.configuration_relmm_paper import RelmmPaperConfig
from relmm.policies.relmm_paper.grasping import CROP, HIDDEN, SIDE, Estimate
from relmm.policies.relmm_paper.networks import scaled, strided_convolutions

_LOW, _HIGH = np.array([GRASP_X[0], GRASP_Y[0]]), np.array([GRASP_X[1], GRASP_Y[1]])  # m, of the grasp area
# Of the cross-entropy method, as in the code: places judged in each of its rounds, and how many of them say where to
# draw the next ones from.
_ROUNDS, _ELITES = (1024, 64, 64), 6
_EPSILON = 0.4  # of attempts that go anywhere while training, as in the code
_INITIAL_STD = 0.01  # of the weights, as in the code


class ContinuousGrasping(nn.Module):
    """The success of a grasp at any place: the lower one of what `num_members` networks say, as in the code.

    The gate and relabelling look at the centres of the discrete ensemble's 225 cells.

    Args:
        config: of the policy.
    """

    def __init__(self, config: RelmmPaperConfig) -> None:
        super().__init__()
        self.config = config
        self.members = nn.ModuleList([_Judge(config.grasp_channels) for _ in range(config.num_members)])
        centres = torch.from_numpy(_to_unit(cell_to_xy(np.arange(GRID**2, dtype=float)))).float()
        self.centres: Tensor
        self.register_buffer("centres", centres, persistent=False)

    def estimate(self, pictures: Tensor) -> Estimate:
        """Success at the 225 centres; there is no uncertainty."""
        with torch.no_grad():
            mean = self._chances(pictures, self.centres.expand(len(pictures), -1, -1))
        return Estimate(mean, torch.zeros_like(mean))

    def grasp_probability(self, estimate: Estimate) -> Tensor:
        """P[grasp] (paper eq. 3) without the bonus, (batch,)."""
        return estimate.scores(self.config.gate_mean_weight, 0.0).amax(dim=1).clamp(max=1.0)

    def anywhere(self, rng: np.random.Generator) -> FloatArray:
        """A place drawn uniformly from the grasp area, m, (2,)."""
        return rng.uniform(_LOW, _HIGH)

    def choose(self, pictures: Tensor, estimate: Estimate, rng: np.random.Generator, greedy: bool) -> FloatArray:
        """The best place that the cross-entropy method finds, m, (2,); while training, often any at all."""
        if not greedy and rng.random() < _EPSILON:
            return self.anywhere(rng)
        mean, std = np.zeros(2), None
        for count in _ROUNDS:
            # Uniform at first; then from a normal distribution that is fitted to the best.
            drawn = rng.uniform(-1, 1, (count, 2)) if std is None else rng.normal(mean, std, (count, 2))
            places = drawn.clip(-1, 1)
            order = np.argsort(self._judge(pictures, places), kind="stable")[::-1]
            elites = places[order[:_ELITES]]
            mean, std = elites.mean(axis=0), elites.std(axis=0)
        return np.asarray(_to_metres(places[order[0]]))

    def opinion(self, pictures: Tensor, estimate: Estimate, place: FloatArray) -> tuple[float, float]:
        """Mean and standard deviation of success at a place, m."""
        return float(self._judge(pictures, _to_unit(place)[None])[0]), 0.0

    def loss(self, pictures: Tensor, places: Tensor, successes: Tensor) -> tuple[Tensor, dict[str, float]]:
        """Cross-entropy of the attempts, as `GraspEnsemble.loss`."""
        low, high = (torch.as_tensor(edge, dtype=places.dtype, device=places.device) for edge in (_LOW, _HIGH))
        logits = self.logits(pictures, ((places - low) / (high - low) * 2 - 1)[:, None])[..., 0]
        targets = successes.to(logits.dtype).expand_as(logits)
        loss = functional.binary_cross_entropy_with_logits(logits, targets, reduction="none").mean(dim=1).sum()
        return loss, {"grasp_loss": loss.item() / len(logits)}

    def logits(self, pictures: Tensor, places: Tensor) -> Tensor:
        """Uint8 (batch, 3, 100, 100) and places -1..1, (batch, n, 2) -> (members, batch, n)."""
        crop = scaled(pictures[CROP], self.config.grasp_input_gain)
        return torch.stack([member(crop, places) for member in self.members])

    def _judge(self, pictures: Tensor, places: FloatArray) -> NDArray[np.floating]:
        given = torch.from_numpy(places).float().to(self.centres.device)
        with torch.no_grad():
            return np.asarray(self._chances(pictures, given[None])[0].cpu().numpy())

    def _chances(self, pictures: Tensor, places: Tensor) -> Tensor:
        return self.logits(pictures, places).sigmoid().amin(dim=0)


class _Judge(nn.Module):
    """Convolutions over the crop and a place -> a logit; the picture is looked at once for all its places."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.convolutions = nn.Sequential(*strided_convolutions(width))
        pixels = (SIDE + 7) // 8  # a side, after three strides
        # Two parts of the layer that the picture's features and the place go into together.
        self.of_picture, self.of_place = nn.Linear(width * pixels**2, HIDDEN), nn.Linear(2, HIDDEN, bias=False)
        self.head = nn.Sequential(nn.ReLU(), nn.Linear(HIDDEN, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 1))
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d | nn.Linear):
                nn.init.normal_(layer.weight, std=_INITIAL_STD)
                if layer.bias is not None:
                    nn.init.zeros_(layer.bias)

    def forward(self, crop: Tensor, places: Tensor) -> Tensor:
        features = self.of_picture(self.convolutions(crop))
        logits: Tensor = self.head(features[:, None] + self.of_place(places))
        return logits.squeeze(-1)


def _to_unit(places: FloatArray) -> FloatArray:
    """Metres, (..., 2), as -1..1 in the grasp area."""
    return np.asarray((places - _LOW) / (_HIGH - _LOW) * 2 - 1)


def _to_metres(places: FloatArray) -> FloatArray:
    return np.asarray(_LOW + (places + 1) / 2 * (_HIGH - _LOW))
