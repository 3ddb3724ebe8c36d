"""The paper's baseline R3L (Zhu et al. 2020): pseudo-resets that look for what is new, instead of driving at random.

Two more policies, one that carries an object away and one that drives on without it, each rewarded with random network
distillation (Burda et al. 2019). Both see the whole picture; in the authors' code the first sees the grasp networks'
crop.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from relmm.policies.relmm_paper.configuration_relmm_paper import RelmmPaperConfig
from relmm.policies.relmm_paper.navigation import Encoder, Navigation, NavigationBatch
from relmm.policies.relmm_paper.networks import dense_layers

_FEATURES = 512
_INITIAL_STD = 0.1  # of weights and biases, as in the authors' code


class Novelty(nn.Module):
    """How badly a network predicts what a fixed random one makes of a picture: the worse, the newer it is.

    Args:
        config: of the policy.

    Attributes:
        count, mean, square: of the errors seen so far: how many, their mean, and the mean of their squares.
    """

    def __init__(self, config: RelmmPaperConfig) -> None:
        super().__init__()
        self.target, self.prediction = _features(config), _features(config)
        self.target.requires_grad_(False)
        self.count: Tensor
        self.mean: Tensor
        self.square: Tensor
        for name in ("count", "mean", "square"):
            self.register_buffer(name, torch.tensor(0.0, dtype=torch.float64))

    def errors(self, pictures: Tensor) -> Tensor:
        """Mean squared errors of the prediction, (batch,); they are counted."""
        errors: Tensor = (self.prediction(pictures) - self.target(pictures)).square().mean(dim=1)
        with torch.no_grad():
            self.count += len(errors)
            share = len(errors) / self.count
            self.mean += share * (errors.double().mean() - self.mean)
            self.square += share * (errors.double().square().mean() - self.square)
        return errors

    def rewards(self, errors: Tensor) -> Tensor:
        """(error - mean) / standard deviation, of all errors so far, (batch,)."""
        deviation = (self.square - self.mean**2).clamp(min=1e-12).sqrt()
        return ((errors.detach().double() - self.mean) / deviation).float()


class Perturbation(nn.Module):
    """One of the two policies.

    Args:
        config: of the policy.

    Attributes:
        drives: soft actor-critic, as in navigation.
        novelty: its reward.
    """

    def __init__(self, config: RelmmPaperConfig) -> None:
        super().__init__()
        self.drives, self.novelty = Navigation(config), Novelty(config)

    def loss(
        self, pictures: Tensor, actions: Tensor, next_pictures: Tensor, last: Tensor, noise: Tensor
    ) -> tuple[Tensor, dict[str, float]]:
        """The losses of SAC and of the prediction.

        Args:
            pictures: before the steps, uint8 (batch, 3, 100, 100).
            actions: -1..1, (batch, 2).
            next_pictures: after them.
            last: which were the last ones of their part of a pseudo-reset, (batch,) bool; nothing follows on them.
            noise: standard normal, (2, batch, 2).

        Returns:
            The loss, and parts of it for logs.
        """
        errors = self.novelty.errors(next_pictures)
        batch = NavigationBatch(pictures, actions, self.novelty.rewards(errors), next_pictures, 1 - last.float())
        loss, logs = self.drives.loss(batch, noise)
        return loss + errors.mean(), {"novelty": errors.mean().item(), "actor_spread": logs["actor_spread"]}

    def weights(self) -> list[nn.Parameter]:
        """Those that learn."""
        return [weight for weight in self.parameters() if weight.requires_grad]


def _features(config: RelmmPaperConfig) -> nn.Sequential:
    encoder = Encoder(config.navigation_encoder)
    layers = nn.Sequential(encoder, *dense_layers(encoder.features, config.navigation_hidden, _FEATURES))
    for weight in layers.parameters():
        nn.init.normal_(weight, std=_INITIAL_STD)
    return layers
