"""Batches of navigation steps: mirrored, and several steps as one."""

from dataclasses import fields

import pytest
import torch

from relmm.policies.relmm.batch import NavigationBatch, last_sides, n_step
from relmm.policies.relmm.encoders import FloorObserver

SIZE = 5
GAMMA = 0.9


def make_batch() -> NavigationBatch:
    rng = torch.Generator().manual_seed(1)
    observations, following = torch.randint(0, 256, (2, SIZE, *FloorObserver.shape), dtype=torch.uint8, generator=rng)
    sides, next_sides = torch.tensor([[1.0, -1, 1, -1, 1], [-1, -1, 1, 1, 1]])
    actions, (rewards, continues) = torch.rand(SIZE, 2, generator=rng) * 2 - 1, torch.rand(2, SIZE, 3, generator=rng)
    motions = torch.rand(SIZE, 3, 2, generator=rng) - 0.5
    lengths = torch.tensor([1, 2, 3, 3, 1])
    return NavigationBatch(
        observations, sides, actions, rewards - 1, following, next_sides, continues, lengths, motions
    )


def test_mirrored_batch_exchanges_left_and_right_and_nothing_else() -> None:
    batch = make_batch()
    mirrored = batch.mirrored()
    assert torch.equal(mirrored.observations[..., 0], batch.observations[..., -1])
    assert torch.equal(mirrored.next_observations.flip(-1), batch.next_observations)
    for turned, straight in ((mirrored.actions, batch.actions), (mirrored.motions, batch.motions)):
        assert torch.equal(turned[..., 0], straight[..., 0])
        assert torch.equal(turned[..., 1], -straight[..., 1])
    assert torch.equal(mirrored.sides, -batch.sides)
    assert torch.equal(mirrored.next_sides, -batch.next_sides)
    assert mirrored.rewards is batch.rewards
    assert mirrored.continues is batch.continues


def test_batch_mirrored_twice_is_the_batch() -> None:
    batch = make_batch()
    twice = batch.mirrored().mirrored()
    assert all(torch.equal(getattr(twice, each.name), getattr(batch, each.name)) for each in fields(batch))


def test_recoloured_batch_shows_the_same_in_another_light() -> None:
    """Each step in its own, before and after alike; what is graspable stays, and what is brighter stays brighter."""
    batch = make_batch()
    batch.observations[:, 1:], batch.next_observations[:, 1:] = 100, 100
    batch.observations[:, 1:, :15] = 200
    other = batch.recoloured(torch.Generator().manual_seed(0))
    for each, was in ((other.observations, batch.observations), (other.next_observations, batch.next_observations)):
        assert torch.equal(each[:, 0], was[:, 0])
        assert not torch.equal(each[:, 1:], was[:, 1:])
    light = other.observations[:, 1:, 15:].float().mean(dim=(2, 3))
    assert torch.allclose(light, other.next_observations[:, 1:].float().mean(dim=(2, 3)), atol=2)
    assert light.std(dim=0).min() > 5
    assert (other.observations[:, 1:, :15].float().mean(dim=(2, 3)) > light + 30).all()
    assert other.actions is batch.actions
    assert other.motions is batch.motions


def test_positive_velocities_turn_left() -> None:
    assert last_sides(torch.tensor([30.0, -30.0, 0.0, -0.1])).tolist() == [1, -1, 1, -1]


@pytest.mark.parametrize("length", [1, 2, 3])
def test_several_steps_are_worth_what_the_rewards_on_the_way_are(length: int) -> None:
    """Against the sum over all ways in which the search may end; what lies behind the end does not count."""
    rewards, continues = torch.tensor([[-0.3, -0.9, -0.5]]), torch.tensor([[0.6, 0.8, 0.7]])
    value = -4.0
    reward, going_on = n_step(rewards, continues, torch.tensor([length]), GAMMA)
    expected, chance = 0.0, 1.0
    for step in range(length):
        expected += GAMMA**step * chance * rewards[0, step].item()
        chance *= continues[0, step].item()
    expected += GAMMA**length * chance * value
    assert reward.item() + GAMMA * going_on.item() * value == pytest.approx(expected, rel=1e-5)


def test_nothing_counts_after_a_success() -> None:
    rewards, continues = torch.tensor([[-1.0, 0.0, -1.0]]), torch.tensor([[1.0, 0.0, 1.0]])
    for length in (2, 3):
        reward, going_on = n_step(rewards, continues, torch.tensor([length]), GAMMA)
        assert (reward.item(), going_on.item()) == (-1.0, 0.0)


def test_one_step_is_itself() -> None:
    rewards, continues = torch.tensor([[-0.3], [-1.0]]), torch.tensor([[0.7], [1.0]])
    reward, going_on = n_step(rewards, continues, torch.tensor([1, 1]), GAMMA)
    assert torch.allclose(reward, rewards[:, 0])
    assert torch.allclose(going_on, continues[:, 0])
