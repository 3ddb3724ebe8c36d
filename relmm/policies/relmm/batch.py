"""A batch of navigation steps, what it might have been as well, and what n steps are worth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from relmm.policies.relmm.tidying import tidy

_GAIN, _OFFSET, _NOISE = 0.4, 30.0, 20.0  # colours may be brighter or darker by, of 1, and of 255
_NOT_ALL = 0.8  # share of the steps with a tidied floor in which something is left


@dataclass
class NavigationBatch:
    """Navigation steps to learn from, or several in a row: from an action to where the last one led.

    Attributes:
        observations, next_observations: uint8, (batch, channels, height, width).
        sides, next_sides: to which the robot turns where it sees nothing, 1 for the left and -1 for the right,
            (batch,). That of its last turn is taken for it.
        actions: -1..1, (batch, 2).
        rewards: of each step, -1..0, (batch, steps).
        continues: whether the search goes on after it, 0 after a success, or the probability of that, (batch, steps).
        lengths: how many steps there are, the others repeat the last one, (batch,).
        motions: of each step by the wheels, m/s and deg/s, 0 where there is none, (batch, steps, 2).
    """

    observations: Tensor
    sides: Tensor
    actions: Tensor
    rewards: Tensor
    next_observations: Tensor
    next_sides: Tensor
    continues: Tensor
    lengths: Tensor
    motions: Tensor

    def mirrored(self) -> NavigationBatch:
        """The same with left and right exchanged; for maps of the floor, whose columns are symmetric."""
        sign = torch.tensor([1.0, -1.0], device=self.actions.device)
        return replace(
            self,
            observations=self.observations.flip(-1),
            sides=-self.sides,
            actions=self.actions * sign,
            next_observations=self.next_observations.flip(-1),
            next_sides=-self.next_sides,
            motions=self.motions * sign,
        )

    def tidied(self, share: float, rng: torch.Generator) -> NavigationBatch:
        """The same, but in a share of the steps part of what lay about is gone; for maps of the floor.

        How much, is uniform, as it is over the time in which a room is tidied; in a fifth of them it is everything.
        """
        count = len(self.rewards)
        empty = torch.rand(count, generator=rng) / _NOT_ALL
        empty[torch.rand(count, generator=rng) >= share] = 0.0
        empty = empty.to(self.rewards.device)
        before, after, nothing = tidy(self.observations, self.next_observations, self.motions, empty, rng)
        return replace(
            self,
            observations=before,
            next_observations=after,
            rewards=self.rewards.masked_fill(nothing, -1.0),
            continues=self.continues.masked_fill(nothing, 1.0),
        )

    def recoloured(self, rng: torch.Generator) -> NavigationBatch:
        """The same in another light, both maps in the same; for maps of the floor.

        There are few pictures, and each is learned from a hundred times. A network that knows them again by their
        colours remembers what came of them, instead of learning what lies where.
        """
        device, count = self.rewards.device, len(self.rewards)
        gain = 1 + _GAIN * _plus_minus_1((count, 3, 1, 1), rng)
        offset = _OFFSET * _plus_minus_1((count, 3, 1, 1), rng)

        def other(maps: Tensor) -> Tensor:
            noise = _NOISE * _plus_minus_1((count, 3, *maps.shape[2:]), rng)
            colours = maps[:, 1:] * gain.to(device) + (offset + noise).to(device)
            return torch.cat([maps[:, :1], colours.clamp(0, 255).to(torch.uint8)], dim=1)

        return replace(self, observations=other(self.observations), next_observations=other(self.next_observations))


def _plus_minus_1(shape: tuple[int, ...], rng: torch.Generator) -> Tensor:
    return torch.rand(shape, generator=rng) * 2 - 1


def last_sides(theta_vels: Tensor) -> Tensor:
    """To which side turns at these velocities go, 1 for the left and -1 for the right."""
    return torch.where(theta_vels >= 0, 1.0, -1.0)


def n_step(rewards: Tensor, continues: Tensor, lengths: Tensor, gamma: float) -> tuple[Tensor, Tensor]:
    """Several steps as one: far rewards are learned from in fewer updates (Sutton & Barto 2018, 7.1).

    Args:
        rewards: of each step, (batch, n).
        continues: probability that the search goes on after it, (batch, n).
        lengths: how many steps there are, 1 to n, (batch,).
        gamma: discount of a step.

    Returns:
        `NavigationBatch.rewards` and `NavigationBatch.continues`.
    """
    there = torch.arange(rewards.shape[1], device=rewards.device) < lengths[:, None]
    discounts = torch.where(there, gamma * continues, 1.0).cumprod(dim=1)
    before = torch.cat([torch.ones_like(discounts[:, :1]), discounts[:, :-1]], dim=1)
    return (before * torch.where(there, rewards, 0.0)).sum(dim=1), discounts[:, -1] / gamma
