from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from relmm.features import Phase, Skill
from relmm.learning.maps import Maps, to_pictures
from relmm.learning.replay import Replay
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy

CAPACITY = 12


@pytest.fixture
def policy(make_policy) -> ReLMMPolicy:
    return make_policy(seed=1).train()


@pytest.fixture
def replay(numbered, action_of) -> Replay:
    replay = Replay(CAPACITY)
    add(replay, 10, numbered, action_of)
    return replay


@pytest.fixture
def maps(policy: ReLMMPolicy, replay: Replay) -> Maps:
    return Maps(policy, replay)


def add(replay: Replay, count: int, numbered, action_of) -> None:
    for _ in range(count):
        replay.add(numbered(replay.frames), (0.0, 0.0), action_of(Skill.NAVIGATE, 0), False, Phase.LEARNING)


def fresh(policy: ReLMMPolicy, replay: Replay, frames: np.ndarray) -> tuple[Tensor, Tensor]:
    pictures = to_pictures(replay.pictures(frames), torch.device("cpu"))
    probabilities = policy.grasping.grasp_probability(policy.grasping.estimate(pictures))
    return policy.observer(pictures, policy.grasping), probabilities


def learn(policy: ReLMMPolicy, maps: Maps) -> None:
    """Change what the ensemble thinks."""
    with torch.no_grad():
        for weight in policy.grasping.parameters():
            weight += 0.05 * torch.randn_like(weight)
    maps.version += 1


def same(got: tuple[Tensor, Tensor], wanted: tuple[Tensor, Tensor]) -> np.ndarray:
    """Which frames have the wanted observation and probability."""
    pictures = (got[0].int() - wanted[0].int()).abs().flatten(1).amax(dim=1) <= 1  # rounding
    return (pictures & ((got[1] - wanted[1]).abs() < 1e-5)).numpy()


def test_first_answer_is_what_the_policy_makes_of_the_frames(policy, replay, maps) -> None:
    frames = np.array([3, 0, 7, 3])
    for refresh in (2, 0):
        observations, probabilities = maps.get(frames, refresh)
        assert observations.dtype == torch.uint8
        assert same((observations, probabilities), fresh(policy, replay, frames)).all()


@pytest.mark.parametrize("encoder", [{}, {"grasp_backbone": "dense", "navigation_encoder": "paper_small"}])
def test_everything_is_fresh_without_a_limit(encoder, make_policy, replay) -> None:
    policy = make_policy(**encoder)
    maps, frames = Maps(policy, replay), np.arange(10)
    maps.get(frames, 0)
    learn(policy, maps)
    assert same(maps.get(frames, 0), fresh(policy, replay, frames)).all()


def test_answer_is_kept_while_the_ensemble_does_not_learn(policy, maps) -> None:
    frames = np.arange(6)
    before = maps.get(frames, 0)
    learn(policy, maps)
    maps.version -= 1  # nobody told
    assert same(maps.get(frames, 0), before).all()


def test_limit_refreshes_the_most_outdated_first(policy, replay, maps) -> None:
    maps.get(np.array([0, 1, 2, 3]), 0)
    learn(policy, maps)
    maps.get(np.array([0, 1]), 0)
    learn(policy, maps)
    maps.get(np.array([4]), 0)
    frames = np.arange(5)
    assert same(maps.get(frames, 2), fresh(policy, replay, frames)).tolist() == [False, False, True, True, True]
    assert same(maps.get(frames, 1), fresh(policy, replay, frames)).sum() == 4
    assert same(maps.get(frames, 5), fresh(policy, replay, frames)).all()


def test_missing_frames_are_computed_beyond_the_limit(policy, replay, maps) -> None:
    maps.get(np.array([0, 1]), 0)
    learn(policy, maps)
    frames = np.arange(8)
    assert same(maps.get(frames, 1), fresh(policy, replay, frames)).tolist() == [False, False, *[True] * 6]


def test_overwritten_frames_are_not_mistaken_for_new_ones(policy, replay, maps, numbered, action_of) -> None:
    maps.get(np.arange(10), 0)
    add(replay, 10, numbered, action_of)
    frames = np.arange(8, 20)  # 12..19 took the places of 0..7
    assert same(maps.get(frames, 1), fresh(policy, replay, frames)).all()


def test_more_frames_than_a_chunk_are_all_computed(policy, numbered, action_of) -> None:
    replay = Replay(70)
    add(replay, 70, numbered, action_of)
    frames = np.random.default_rng(0).permutation(70)
    assert same(Maps(policy, replay).get(frames, 0), fresh(policy, replay, frames)).all()


def test_pictures_are_what_the_networks_take(numbered: Callable[[int], np.ndarray]) -> None:
    pictures = to_pictures(numbered(5)[None], torch.device("cpu"))
    assert pictures.shape == (1, 3, 100, 100)
    assert pictures[0, 1, 3, 4] == pytest.approx(numbered(5)[3, 4, 1] / 255)
