"""When a learner learns, and from what."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import relmm.plugin  # noqa: F401
from relmm.features import Phase
from relmm.learning.learner import Learner
from relmm.learning.replay import Replay, to_pictures
from relmm.policies.relmm.batch import last_sides

MakeLearner = Callable[..., Learner]


def weights(module: torch.nn.Module) -> list[torch.Tensor]:
    return [weight.detach().clone() for weight in module.parameters()]


def to_images(replay: Replay, frames: range) -> torch.Tensor:
    return to_pictures(replay.pictures(np.array(frames)), torch.device("cpu"))


def same(first: list[torch.Tensor], second: list[torch.Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


# --- When it learns ------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("attempts", "updates"), [(2, 0), (3, 5), (4, 5)])
def test_ensemble_waits_for_n_bt_attempts(attempts: int, updates: int, make_learner, count_steps) -> None:
    learner = make_learner("f" * attempts, grasp_updates=5)
    counts = count_steps(learner)
    learner.update_grasping(Phase.LEARNING)
    assert counts == {"grasping": updates, "navigation": 0}
    assert learner.grasping_has_begun == (updates > 0)
    assert learner.maps.version == (updates > 0)
    assert ("grasp_loss" in learner.logs) == (updates > 0)


def test_failures_alone_teach_the_ensemble_only_until_its_loss_is_small(make_learner, count_steps) -> None:
    learner = make_learner("f" * 20, min_failure_loss=0.1)
    before = learner.policy.grasping.estimate(to_images(learner.replay, range(20)))
    counts = count_steps(learner)
    for _ in range(200):
        learner.update_grasping(Phase.LEARNING)
    assert 0 < counts["grasping"] < 400, "it stops by itself"
    after = learner.policy.grasping.estimate(to_images(learner.replay, range(20)))
    assert after.std.mean() > before.std.mean() / 10, "the members still disagree"


def test_ensemble_learns_from_all_once_something_was_picked_up(make_learner, count_steps) -> None:
    learner = make_learner("f" * 19 + "s", min_failure_loss=100.0)
    counts = count_steps(learner)
    learner.update_grasping(Phase.LEARNING)
    assert counts["grasping"] == learner.config.grasp_updates


@pytest.mark.parametrize(("steps", "updates"), [(2, 0), (3, 4), (6, 4)])
def test_navigation_waits_for_enough_steps(steps: int, updates: int, make_learner, count_steps) -> None:
    learner = make_learner("d" * (steps + 1), navigation_updates=4)
    counts = count_steps(learner)
    learner.update_navigation()
    assert counts == {"grasping": 0, "navigation": updates}


def test_pseudo_resets_alone_teach_nothing(make_learner, count_steps) -> None:
    learner = make_learner("rrrrrrrr")
    counts = count_steps(learner)
    learner.update_navigation()
    assert counts["navigation"] == 0


@pytest.mark.parametrize(("life", "update"), [("rrr dddddddddddd", "navigation"), ("fff dddddddddddd", "grasping")])
def test_rows_that_are_all_overwritten_do_no_harm(life: str, update: str, make_learner, count_steps) -> None:
    """A long search without a pseudo-reset, or without an attempt."""
    learner = make_learner(life, capacity=8)
    counts = count_steps(learner)
    if update == "grasping":
        learner.update_grasping(Phase.LEARNING)
    else:
        learner.update_navigation()
    updates = learner.config.navigation_updates if update == "navigation" else 0
    assert counts == {"grasping": 0, "navigation": updates}


# --- What it changes -----------------------------------------------------------------------------------------
def test_each_update_trains_its_own_module(make_learner) -> None:
    learner = make_learner("dfdfs dfds rrddd")
    grasping, navigation = learner.policy.grasping, learner.policy.navigation
    before = weights(grasping), weights(navigation)
    learner.update_grasping(Phase.LEARNING)
    assert not same(weights(grasping), before[0])
    assert same(weights(navigation), before[1])
    before = weights(grasping), weights(navigation.critics), weights(navigation.actor), weights(navigation.targets)
    learner.update_navigation()
    assert same(weights(grasping), before[0])
    changed = [navigation.critics, navigation.actor, navigation.targets]
    assert not any(same(weights(part), old) for part, old in zip(changed, before[1:], strict=True))


def test_equal_seeds_learn_the_same(make_learner) -> None:
    def learned(seed: int) -> list[torch.Tensor]:
        learner = make_learner("dfdfs dfds rrddd", seed=seed)
        for _ in range(3):
            learner.update_grasping(Phase.LEARNING)
            learner.update_navigation()
        return weights(learner.policy)

    assert same(learned(1), learned(1))
    assert not same(learned(1), learned(2))


# --- Batches -------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("relabel", "failed"), [(False, True), (True, True), (True, False)])
def test_navigation_batch_is_that_of_its_frames(relabel: bool, failed: bool, make_learner, numbered) -> None:
    learner = make_learner("dfdfs dfdss rrddd", relabel=relabel, relabel_failed=failed, refreshed_maps=0)
    policy, steps = learner.policy, learner.replay.steps
    batch = learner.navigation_batch(learner.replay.chains(steps, np.arange(len(steps)), 1, 1))
    columns = (steps["frame"], steps["next"], steps["success"], steps["attempted"])
    for row, (frame, after, success, attempted) in enumerate(zip(*columns, strict=True)):
        pictures = to_pictures(np.stack([numbered(frame), numbered(after)]), torch.device("cpu"))
        observations = policy.observer(pictures, policy.grasping).int()
        chance = policy.grasping.grasp_probability(policy.grasping.estimate(pictures))[1].item()
        chance = 0.0 if success or not relabel or (attempted and not failed) else chance
        assert (batch.observations[row].int() - observations[0]).abs().max() <= 1
        assert (batch.next_observations[row].int() - observations[1]).abs().max() <= 1
        motions = torch.from_numpy(learner.replay.motions(np.array([frame, after])))
        assert torch.equal(torch.stack([batch.sides[row], batch.next_sides[row]]), last_sides(motions[:, 1]))
        assert torch.equal(batch.motions[row, 0], motions[1])
        assert batch.rewards[row].item() == pytest.approx(float(success) - 1 + chance, abs=1e-5)
        assert batch.continues[row].item() == pytest.approx(1 - float(success) - chance * (not success), abs=1e-5)
        assert batch.actions[row].tolist() == pytest.approx([2 * frame / 1000 - 1, frame / 1000], abs=1e-6)


def test_chain_of_steps_is_one_from_the_first_frame_to_the_last(make_learner, numbered) -> None:
    """With the rewards on the way, relabelled; after the end there is no motion."""
    learner = make_learner("dddds", refreshed_maps=0)
    policy = learner.policy
    batch = learner.navigation_batch(learner.replay.chains(learner.replay.steps, np.array([0, 2]), 3, 3))
    for row, frames in enumerate([[0, 1, 2, 3], [2, 3, 4]]):
        pictures = to_pictures(np.stack([numbered(frame) for frame in frames]), torch.device("cpu"))
        chances = policy.grasping.grasp_probability(policy.grasping.estimate(pictures))[1:].tolist()
        rewards, going_on = [chance - 1 for chance in chances], [1 - chance for chance in chances]
        if row == 1:
            rewards[-1], going_on[-1] = 0.0, 0.0
        assert batch.lengths[row] == len(rewards)
        assert batch.rewards[row, : len(rewards)].tolist() == pytest.approx(rewards, rel=1e-4)
        assert batch.continues[row, : len(rewards)].tolist() == pytest.approx(going_on, rel=1e-4)
        observations = policy.observer(pictures, policy.grasping).int()
        assert (batch.observations[row].int() - observations[0]).abs().max() <= 1
        assert (batch.next_observations[row].int() - observations[-1]).abs().max() <= 1
        motions = torch.from_numpy(learner.replay.motions(np.array(frames[1:])))
        assert torch.equal(batch.motions[row, : len(rewards)], motions)
        assert not batch.motions[row, len(rewards) :].any()


def test_critics_learn_from_chains_of_the_policy_but_not_of_pseudo_resets(make_learner, monkeypatch) -> None:
    learner = make_learner("dddddd rrrrrr", return_steps=3, navigation_updates=10)
    given: list[dict[str, NDArray[Any]]] = []
    original = learner.navigation_batch
    monkeypatch.setattr(learner, "navigation_batch", lambda chains: (given.append(chains), original(chains))[1])
    learner.update_navigation()
    lengths, resets = (np.concatenate([chains[name] for chains in given]) for name in ("lengths", "frames"))
    resets = resets[:, 0] >= 6
    assert set(lengths[resets].tolist()) == {1}
    assert set(lengths[~resets].tolist()) == {1, 2, 3}


@pytest.mark.parametrize(
    ("life", "share", "expected"),
    [("dddd rrrr", 0.25, 2), ("dddd rrrr", 0.0, 0), ("dddd rrrr", 0.5, 4), ("dddd", 0.5, 0)],
)
def test_pseudo_resets_have_their_share_of_a_batch(life, share, expected, make_learner, monkeypatch) -> None:
    learner = make_learner(life, pseudo_reset_share=share, navigation_updates=1)
    given: list[NDArray[np.int64]] = []
    original = learner.navigation_batch
    monkeypatch.setattr(
        learner, "navigation_batch", lambda chains: (given.append(chains["frames"][:, 0]), original(chains))[1]
    )
    learner.update_navigation()
    assert len(given[0]) == 8
    assert (given[0] >= 4).sum() == expected


@pytest.mark.parametrize(("mirror", "expected"), [(True, {False, True}), (False, {False})])
def test_batches_are_mirrored_now_and_then(mirror: bool, expected: set[bool], make_learner, monkeypatch) -> None:
    """The turns of the recorded actions are to the left, all of them."""
    learner = make_learner("dddddddd", mirror=mirror, navigation_updates=20)
    seen: list[bool] = []
    original = learner.policy.navigation.loss

    def loss(batch, noise):
        seen.append(bool((batch.actions[:, 1] < 0).any()))
        return original(batch, noise)

    monkeypatch.setattr(learner.policy.navigation, "loss", loss)
    learner.update_navigation()
    assert set(seen) == expected
