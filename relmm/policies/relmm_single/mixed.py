"""Soft actor-critic over a choice and what goes with it: drive (forward, turn), or grasp (x, y)."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from relmm.policies.relmm_paper.navigation import Encoder, draw
from relmm.policies.relmm_paper.networks import dense_layers, initialised
from relmm.policies.relmm_single.configuration_relmm_single import RelmmSingleConfig

CHOICES = 2  # drive, grasp
DIMENSIONS = 2  # of a drive, and of a place


@dataclass
class Batch:
    """Steps to learn from.

    Attributes:
        pictures, next_pictures: uint8, (batch, 3, 100, 100).
        choices: 0 for a drive, 1 for a grasp, (batch,) int64.
        actions: -1..1, (batch, 4): the drive, then the place; what was not chosen counts for nothing.
        successes: (batch,) bool; they end the search.
    """

    pictures: Tensor
    choices: Tensor
    actions: Tensor
    next_pictures: Tensor
    successes: Tensor


@dataclass
class Decision:
    """What an actor would do at some pictures.

    Attributes:
        log_chances: of driving and of grasping, (batch, 2).
        actions: -1..1, (batch, 4): a drive and a place.
        log_densities: of the two, (batch, 2).
    """

    log_chances: Tensor
    actions: Tensor
    log_densities: Tensor

    def expected(self, values: Tensor) -> Tensor:
        """The mean of (batch, 2) over the choice, (batch,)."""
        return (self.log_chances.exp() * values).sum(dim=1)


class MixedSac(nn.Module):
    """The networks and their loss.

    Args:
        config: of the policy.
    """

    def __init__(self, config: RelmmSingleConfig) -> None:
        super().__init__()
        self.config = config
        self.actor = _Network(config, 0, CHOICES + CHOICES * DIMENSIONS * 2)
        self.critics = nn.ModuleList([_Network(config, CHOICES * DIMENSIONS, CHOICES) for _ in range(2)])
        self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        # Of the drive or place, and of the choice.
        self.log_temperatures = nn.Parameter(torch.full((2,), math.log(config.initial_temperature)))

    def decide(self, pictures: Tensor, noise: Tensor) -> Decision:
        """For standard normal noise, (batch, 4); zeros give the greedy drive and place."""
        logits, mean, log_std = self.actor(pictures).split([CHOICES, 4, 4], dim=1)
        drawn = [draw(mean[:, part], log_std[:, part], noise[:, part]) for part in (slice(2), slice(2, 4))]
        actions, densities = (torch.cat([one[0] for one in drawn], dim=1), torch.stack([one[1] for one in drawn], 1))
        return Decision(logits.log_softmax(dim=1), actions, densities)

    def loss(self, batch: Batch, noise: Tensor) -> tuple[Tensor, dict[str, float]]:
        """The sum of the critics', the actor's and the temperatures' losses; none moves another's weights.

        Args:
            batch: steps.
            noise: standard normal, (2, batch, 4): for the actions at this and at the next picture.

        Returns:
            The loss and its parts, for logs.
        """
        alpha, alpha_choice = self.log_temperatures.exp().detach()
        targets = self.bellman_targets(batch, noise[1])
        values = torch.stack([critic(batch.pictures, batch.actions) for critic in self.critics])
        chosen = values.gather(2, batch.choices.expand(2, -1)[..., None]).squeeze(2)
        critic_loss = functional.mse_loss(chosen, targets.expand_as(chosen))

        decision = self.decide(batch.pictures, noise[0])
        self.critics.requires_grad_(False)  # through them to the actions, but not into them
        reached = torch.stack([critic(batch.pictures, decision.actions) for critic in self.critics]).amin(dim=0)
        self.critics.requires_grad_(True)
        costs = alpha * decision.log_densities + alpha_choice * decision.log_chances - reached
        actor_loss = decision.expected(costs).mean()

        entropies = self._entropies(decision)
        wanted = torch.stack([entropies.new_tensor(self.config.target_entropy), self._choice_entropy(entropies)])
        temperature_loss = (self.log_temperatures.exp() * (entropies - wanted)).sum()
        logs = {
            "critic_loss": critic_loss.item(),
            "actor_loss": actor_loss.item(),
            "temperature": alpha.item(),
            "choice_temperature": alpha_choice.item(),
            "grasps": decision.log_chances.detach().exp()[:, 1].mean().item(),
            "value": chosen.detach().mean().item(),
        }
        return critic_loss + actor_loss + temperature_loss, logs

    @torch.no_grad()
    def bellman_targets(self, batch: Batch, noise: Tensor) -> Tensor:
        """R + gamma * V(o'), where r is -1 and a success 0 and the end, (batch,)."""
        alpha, alpha_choice = self.log_temperatures.exp()
        decision = self.decide(batch.next_pictures, noise)
        values = torch.stack([target(batch.next_pictures, decision.actions) for target in self.targets]).amin(dim=0)
        soft = decision.expected(values - alpha * decision.log_densities - alpha_choice * decision.log_chances)
        return (1 - batch.successes.float()) * (self.config.gamma * soft - 1)

    @torch.no_grad()
    def update_targets(self) -> None:
        """Move the targets by `tau` towards the critics."""
        for target, weight in zip(self.targets.parameters(), self.critics.parameters(), strict=True):
            target.lerp_(weight, self.config.tau)

    @torch.no_grad()
    def _entropies(self, decision: Decision) -> Tensor:
        """Of the drive or place, and of the choice, means over the batch, (2,)."""
        return torch.stack(
            [-decision.expected(decision.log_densities).mean(), -decision.expected(decision.log_chances).mean()]
        )

    def _choice_entropy(self, like: Tensor) -> Tensor:
        return like.new_tensor(self.config.choice_entropy * math.log(CHOICES))


class _Network(nn.Module):
    def __init__(self, config: RelmmSingleConfig, inputs: int, outputs: int) -> None:
        super().__init__()
        self.encoder = Encoder(config.encoder)
        self.head = initialised(dense_layers(self.encoder.features + inputs, config.hidden, outputs))

    def forward(self, pictures: Tensor, actions: Tensor | None = None) -> Tensor:
        features = self.encoder(pictures)
        outputs: Tensor = self.head(features if actions is None else torch.cat([features, actions], dim=1))
        return outputs
