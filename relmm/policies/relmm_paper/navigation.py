"""The navigation policy (paper 4.2): soft actor-critic (Haarnoja et al. 2018) on pictures."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from relmm.features import IMAGE_SIZE, MAX_THETA_VEL, MAX_X_VEL, action_dict
from relmm.policies.relmm_paper.configuration_relmm_paper import RelmmPaperConfig
from relmm.policies.relmm_paper.networks import (
    dense_layers,
    initialised,
    pooled_convolutions,
    scaled,
    strided_convolutions,
)

ACTIONS = 2  # forward and turn, each -1..1


@dataclass
class NavigationBatch:
    """Navigation steps to learn from.

    Attributes:
        pictures, next_pictures: uint8, (batch, 3, 100, 100).
        actions: -1..1, (batch, 2).
        rewards: -1..0, (batch,).
        continues: 0 after a success, which ends the search, else 1, (batch,). The code also ends it at its step limit,
            which is not followed: nothing ends there.
    """

    pictures: Tensor
    actions: Tensor
    rewards: Tensor
    next_pictures: Tensor
    continues: Tensor


class Encoder(nn.Module):
    """Features of pictures; each network has its own.

    Args:
        kind: as in `RelmmPaperConfig.navigation_encoder`; `paper_small` does a hundredth of the arithmetic of `paper`.

    Attributes:
        features: how many.
    """

    def __init__(self, kind: str) -> None:
        super().__init__()
        self.layers = initialised(pooled_convolutions(64) if kind == "paper" else strided_convolutions(32))
        with torch.no_grad():
            self.features: int = self(torch.zeros(1, 3, IMAGE_SIZE, IMAGE_SIZE)).shape[1]

    def forward(self, pictures: Tensor) -> Tensor:
        """Uint8 (batch, 3, 100, 100) -> (batch, features)."""
        features: Tensor = self.layers(scaled(pictures))
        return features


class Actor(nn.Module):
    """A tanh-Gaussian over actions.

    Args:
        config: of the policy.
    """

    def __init__(self, config: RelmmPaperConfig) -> None:
        super().__init__()
        self.encoder = Encoder(config.navigation_encoder)
        self.head = initialised(dense_layers(self.encoder.features, config.navigation_hidden, 2 * ACTIONS))

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and logarithm of the standard deviation before the tanh, unbounded as in the code, (batch, 2) each."""
        mean, log_std = self.head(self.encoder(pictures)).chunk(2, dim=-1)
        return mean, log_std

    def sample(self, pictures: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions -1..1, (batch, 2), and their log-densities, (batch,), for standard normal noise, (batch, 2)."""
        mean, log_std = self(pictures)
        return draw(mean, log_std, noise)


def draw(mean: Tensor, log_std: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Actions of a tanh-Gaussian, -1..1, (batch, n), and their log-densities, (batch,), for standard normal noise."""
    raw = mean + log_std.exp() * noise
    log_density = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
    # log(1 - tanh(x)^2), in a form that does not overflow.
    correction = 2 * (math.log(2) - raw - functional.softplus(-2 * raw))
    return raw.tanh(), (log_density - correction).sum(dim=-1)


class Critics(nn.Module):
    """Two Q-functions.

    Args:
        config: of the policy.
    """

    def __init__(self, config: RelmmPaperConfig) -> None:
        super().__init__()
        encoders = [Encoder(config.navigation_encoder) for _ in range(2)]
        inputs = encoders[0].features + ACTIONS
        self.encoders = nn.ModuleList(encoders)
        self.heads = nn.ModuleList([initialised(dense_layers(inputs, config.navigation_hidden, 1)) for _ in range(2)])

    def encode(self, pictures: Tensor) -> list[Tensor]:
        """Features for each head, two of (batch, features)."""
        return [encoder(pictures) for encoder in self.encoders]

    def forward(self, features: list[Tensor], actions: Tensor) -> Tensor:
        """Values of actions, (2, batch)."""
        pairs = zip(self.heads, features, strict=True)
        return torch.stack([head(torch.cat([each, actions], dim=-1)).squeeze(-1) for head, each in pairs])


class Navigation(nn.Module):
    """Soft actor-critic with a tuned temperature, and one loss for all its parts.

    Args:
        config: of the policy.
    """

    def __init__(self, config: RelmmPaperConfig) -> None:
        super().__init__()
        self.config = config
        self.actor, self.critics = Actor(config), Critics(config)
        self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        self.log_temperature = nn.Parameter(torch.tensor(math.log(config.initial_temperature)))

    @torch.no_grad()
    def act(self, pictures: Tensor, rng: np.random.Generator | None) -> Tensor:
        """Actions -1..1, (batch, 2): sampled, or the mean action without random numbers.

        The paper's greedy policy takes the mean action, which is followed; the code always samples.
        """
        if rng is None:
            mean: Tensor = self.actor(pictures)[0]
            return mean.tanh()
        noise = torch.from_numpy(rng.standard_normal((len(pictures), ACTIONS), np.float32)).to(pictures.device)
        return self.actor.sample(pictures, noise)[0]

    def loss(self, batch: NavigationBatch, noise: Tensor) -> tuple[Tensor, dict[str, float]]:
        """The sum of the critics', the actor's and the temperature's loss; none has gradients in another's weights.

        Args:
            batch: navigation steps.
            noise: standard normal, (2, batch, 2): for the actions at this and at the next picture.

        Returns:
            The loss and, for logs, its parts, and whether it can be seen that pictures matter: `value_spread` and
            `actor_spread` are standard deviations over the batch's pictures, of values and of greedy actions;
            `actor_std` is what the actor adds to its mean.
        """
        temperature = self.log_temperature.exp().detach()
        targets = self.bellman_targets(batch, noise[1], temperature)
        features = self.critics.encode(batch.pictures)
        values = self.critics(features, batch.actions)
        critic_loss = functional.mse_loss(values, targets.expand_as(values))

        mean, log_std = self.actor(batch.pictures)
        actions, log_density = draw(mean, log_std, noise[0])
        # Through the critics to the actions, but not into the critics.
        self.critics.requires_grad_(False)
        reached = self.critics([each.detach() for each in features], actions).amin(dim=0)
        self.critics.requires_grad_(True)
        actor_loss = (temperature * log_density - reached).mean()

        entropy_gap = (log_density.detach() + self.config.target_entropy).mean()
        temperature_loss = -self.log_temperature.exp() * entropy_gap
        logs = {
            "critic_loss": critic_loss.item(),
            "actor_loss": actor_loss.item(),
            "temperature": temperature.item(),
            "entropy": -log_density.detach().mean().item(),
            "value": values.detach().mean().item(),
            "value_spread": values.detach().std(dim=1, correction=0).mean().item(),
            "actor_spread": mean.detach().tanh().std(dim=0, correction=0).mean().item(),
            "actor_std": log_std.detach().exp().mean().item(),
        }
        return critic_loss + actor_loss + temperature_loss, logs

    @torch.no_grad()
    def bellman_targets(self, batch: NavigationBatch, noise: Tensor, temperature: Tensor) -> Tensor:
        """R + gamma * continues * (min Q'(o', a') - temperature * log pi(a'|o')), (batch,)."""
        actions, log_density = self.actor.sample(batch.next_pictures, noise)
        values = self.targets(self.targets.encode(batch.next_pictures), actions).amin(dim=0)
        return batch.rewards + self.config.gamma * batch.continues * (values - temperature * log_density)

    @torch.no_grad()
    def update_targets(self) -> None:
        """Move the targets by `tau` towards the critics."""
        for target, weight in zip(self.targets.parameters(), self.critics.parameters(), strict=True):
            target.lerp_(weight, self.config.tau)


def to_navigation_step(action: list[float]) -> dict[str, float]:
    """A navigation step for forward and turn in -1..1; -1 forward stands still, as in the code."""
    return action_dict(x_vel=(action[0] + 1) / 2 * MAX_X_VEL, theta_vel=action[1] * MAX_THETA_VEL)


def from_navigation_steps(actions: Tensor) -> Tensor:
    """Forward and turn in -1..1, (batch, 2), of actions as datasets hold them, velocities first, (batch, 2 or more)."""
    return torch.stack([actions[:, 0] / MAX_X_VEL * 2 - 1, actions[:, 1] / MAX_THETA_VEL], dim=1).clamp(-1, 1)
