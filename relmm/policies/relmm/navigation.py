"""The navigation policy (paper 4.2): soft actor-critic (Haarnoja et al. 2018) on pictures or maps of the floor."""

from __future__ import annotations

import copy
import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from relmm.features import MAX_THETA_VEL, MAX_X_VEL, action_dict
from relmm.policies.relmm.batch import NavigationBatch, n_step
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.policies.relmm.encoders import NOTICED, Encoder

ACTIONS = 2  # forward and turn, each -1..1
_LOG_STD_RANGE = (-5.0, 2.0)
_UNIFORM_ACTIONS = 10  # that conservative Q-learning compares the taken one with


class Actor(nn.Module):
    """A tanh-Gaussian over actions.

    Args:
        config: of the policy.
        features: length of what the encoder gives.
    """

    def __init__(self, config: ReLMMConfig, features: int) -> None:
        super().__init__()
        self.net = _dense_layers(config, features, 2 * ACTIONS)
        self._clamped = config.navigation_encoder == "floor"

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and logarithm of the standard deviation before the tanh, (batch, 2) each."""
        mean, log_std = self.net(features).chunk(2, dim=-1)
        return mean, log_std.clamp(*_LOG_STD_RANGE) if self._clamped else log_std  # unclamped in the authors' code

    def sample(self, features: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions -1..1, (batch, 2), and their log-densities, (batch,), for standard normal noise, (batch, 2)."""
        mean, log_std = self(features)
        raw = mean + log_std.exp() * noise
        log_density = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
        # log(1 - tanh(x)^2), in a form that does not overflow.
        correction = 2 * (math.log(2) - raw - functional.softplus(-2 * raw))
        return raw.tanh(), (log_density - correction).sum(dim=-1)


class Critics(nn.Module):
    """Two Q-functions, over one encoder or over one each.

    Args:
        config: of the policy.

    Attributes:
        features: length of what an encoder gives.
    """

    def __init__(self, config: ReLMMConfig) -> None:
        super().__init__()
        shared = config.navigation_encoder == "floor"
        self.encoders = nn.ModuleList([Encoder(config.navigation_encoder) for _ in range(1 if shared else 2)])
        first = self.encoders[0]
        assert isinstance(first, Encoder)
        self.features = first.features
        self.heads = nn.ModuleList([_dense_layers(config, self.features + ACTIONS, 1) for _ in range(2)])

    def encode(self, observations: Tensor) -> list[Tensor]:
        """Features for each head, two of (batch, features)."""
        encoded = [encoder(observations) for encoder in self.encoders]
        return encoded * 2 if len(encoded) == 1 else encoded

    def forward(self, features: list[Tensor], actions: Tensor) -> Tensor:
        """Values of actions, (2, batch)."""
        pairs = zip(self.heads, features, strict=True)
        return torch.stack([head(torch.cat([each, actions], dim=-1)).squeeze(-1) for head, each in pairs])


class Navigation(nn.Module):
    """Soft actor-critic with a tuned temperature, and one loss for all its parts.

    Args:
        config: of the policy.
    """

    def __init__(self, config: ReLMMConfig) -> None:
        super().__init__()
        self.config = config
        self.critics = Critics(config)
        self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        # The actor shares the critics' encoder, which only the critics train; in the paper it has its own.
        shared = config.navigation_encoder == "floor"
        self.actor_encoder = None if shared else Encoder(config.navigation_encoder)
        self.actor = Actor(config, self.critics.features)
        # Greedy actions come from a moving average of the actor, which varies less from one update to the next.
        self.mean_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.mean_encoder = copy.deepcopy(self._encoder).requires_grad_(False)
        self.log_temperature = nn.Parameter(torch.tensor(math.log(config.initial_temperature)))

    def act(self, observations: Tensor, sides: Tensor, rng: torch.Generator | None) -> Tensor:
        """Actions -1..1, (batch, 2): sampled, or the mean action without random numbers."""
        with torch.no_grad():
            if rng is None:
                mean = self.mean_actor(self.mean_encoder(observations))[0].tanh()
                return self._search(mean, observations, sides)
            noise = torch.randn(len(observations), ACTIONS, generator=rng).to(observations.device)
            return self._sample(observations, sides, noise)[0]

    def loss(self, batch: NavigationBatch, noise: Tensor, offline: bool = False) -> tuple[Tensor, dict[str, float]]:
        """The sum of the critics', the actor's and the temperature's loss; none has gradients in another's weights.

        Args:
            batch: navigation steps.
            noise: standard normal, (2, batch, 2): for the actions at this and at the next observation.
            offline: whether nobody will try out what the actor makes of it: see `conservative_weight`.

        Returns:
            The loss and its parts, for logs.
        """
        temperature = self.log_temperature.exp().detach()
        targets = self.bellman_targets(batch, noise[1], temperature)
        features = self.critics.encode(batch.observations)
        values = self.critics(features, batch.actions)
        critic_loss = functional.mse_loss(values, targets.expand_as(values))
        if offline:
            critic_loss = critic_loss + self.config.conservative_weight * self._overestimate(features, values)

        actions, log_density = self._sample(batch.observations, batch.sides, noise[0], features)
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
        }
        return critic_loss + actor_loss + temperature_loss, logs

    def _overestimate(self, features: list[Tensor], values: Tensor) -> Tensor:
        """How much better any action seems than the one that was taken (Kumar et al. 2020, CQL(H)), by uniform ones."""
        uniform = torch.rand(_UNIFORM_ACTIONS, len(features[0]), ACTIONS, device=values.device) * 2 - 1
        others = torch.stack([self.critics(features, actions) for actions in uniform])
        return (others.logsumexp(dim=0) - math.log(_UNIFORM_ACTIONS) - values).mean()

    @torch.no_grad()
    def bellman_targets(self, batch: NavigationBatch, noise: Tensor, temperature: Tensor) -> Tensor:
        """R + gamma * (1 - terminal) * (min Q'(o', a') - temperature * log pi(a'|o')), (batch,)."""
        actions, log_density = self._sample(batch.next_observations, batch.next_sides, noise)
        values = self.targets(self.targets.encode(batch.next_observations), actions).amin(dim=0)
        rewards, continues = n_step(batch.rewards, batch.continues, batch.lengths, self.config.gamma)
        targets = rewards + self.config.gamma * continues * (values - temperature * log_density)
        return targets.clamp(-1 / (1 - self.config.gamma), 0.0) if self.config.clip_targets else targets

    @torch.no_grad()
    def update_targets(self) -> None:
        """Move the targets by `tau` towards the critics, and the mean actor by `actor_tau` towards the actor."""
        _follow(self.targets, self.critics, self.config.tau)
        _follow(self.mean_actor, self.actor, self.config.actor_tau)
        _follow(self.mean_encoder, self._encoder, self.config.actor_tau)

    @property
    def is_orderly(self) -> bool:
        """Whether there are rules for where to turn while nothing is in view."""
        return self.config.orderly_search and self.config.navigation_encoder == "floor"

    def in_view(self, observations: Tensor) -> Tensor:
        """On which maps there is something to grasp, bool, (batch,)."""
        return observations[:, 0].flatten(1).amax(dim=1) >= NOTICED

    @property
    def _encoder(self) -> Encoder:
        """The actor's."""
        encoder = self.actor_encoder or self.critics.encoders[0]
        assert isinstance(encoder, Encoder)
        return encoder

    def _sample(
        self, observations: Tensor, sides: Tensor, noise: Tensor, encoded: list[Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Actions of the actor and the log-densities of what it chose, for observations that may be encoded already."""
        if self.actor_encoder is not None:
            features = self.actor_encoder(observations)
        else:
            features = (self.critics.encode(observations) if encoded is None else encoded)[0].detach()
        actions, log_density = self.actor.sample(features, noise)
        return self._search(actions, observations, sides), log_density

    def _search(self, actions: Tensor, observations: Tensor, sides: Tensor) -> Tensor:
        """Actions that, where the map shows nothing to grasp, turn only to one side.

        There left and right are worth nearly the same. A policy that follows the slightest difference turns to and fro
        before a bare wall for ever.
        """
        if not self.is_orderly:
            return actions
        forward, turn = actions.unbind(dim=1)
        return torch.stack([forward, torch.where(self.in_view(observations), turn, sides * (1 + turn) / 2)], dim=1)


def _follow(mean: nn.Module, module: nn.Module, rate: float) -> None:
    """Move the weights of a moving average."""
    for average, weight in zip(mean.parameters(), module.parameters(), strict=True):
        average.lerp_(weight, rate)


def _dense_layers(config: ReLMMConfig, inputs: int, outputs: int) -> nn.Sequential:
    """Two hidden layers; the fast preset normalises the first, which keeps small batches stable."""
    hidden = config.navigation_hidden
    normalise = [nn.LayerNorm(hidden)] if config.navigation_encoder == "floor" else []
    first = [nn.Linear(inputs, hidden), *normalise, nn.ReLU(inplace=True)]
    return nn.Sequential(*first, nn.Linear(hidden, hidden), nn.ReLU(inplace=True), nn.Linear(hidden, outputs))


def to_navigation_step(action: list[float]) -> dict[str, float]:
    """A navigation step for forward and turn in -1..1; -1 forward stands still, as in the authors' code."""
    return action_dict(x_vel=(action[0] + 1) / 2 * MAX_X_VEL, theta_vel=action[1] * MAX_THETA_VEL)


def from_navigation_steps(actions: Tensor) -> Tensor:
    """Forward and turn in -1..1, (batch, 2), of actions as datasets hold them, (batch, 5)."""
    return torch.stack([actions[:, 0] / MAX_X_VEL * 2 - 1, actions[:, 1] / MAX_THETA_VEL], dim=1).clamp(-1, 1)
