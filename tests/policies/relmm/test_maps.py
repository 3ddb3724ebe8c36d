from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.policies.relmm.encoders import make_observer
from relmm.policies.relmm.grasping import GraspEnsemble
from relmm.policies.relmm.maps import Maps

CAPACITY = 12
COUNT = 70  # pictures


class World:
    """Numbered pictures, an ensemble that changes its mind, and the maps of what it thinks."""

    def __init__(self, config: ReLMMConfig, pictures: Tensor, capacity: int) -> None:
        self.observer, self.grasping = make_observer(config), GraspEnsemble(config)
        self.pictures = pictures
        self.maps = Maps(self.observer, self.grasping, capacity)

    def learn(self) -> None:
        with torch.no_grad():
            for weight in self.grasping.parameters():
                weight += 0.05 * torch.randn_like(weight)
        self.maps.version += 1

    def get(self, frames: list[int], refresh: int) -> tuple[Tensor, Tensor]:
        return self.maps.get(np.array(frames), self.find, refresh)

    def find(self, frames: np.ndarray) -> Tensor:
        return self.pictures[torch.from_numpy(frames)]

    def fresh(self, frames: list[int], refresh: int) -> list[bool]:
        """Which frames of an answer are what the ensemble makes of them now."""
        probabilities = self.grasping.grasp_probability(self.grasping.estimate(self.pictures[frames]))
        return same(self.get(frames, refresh), (self.observer(self.pictures[frames], self.grasping), probabilities))


def same(got: tuple[Tensor, Tensor], wanted: tuple[Tensor, Tensor]) -> list[bool]:
    pictures = (got[0].int() - wanted[0].int()).abs().flatten(1).amax(dim=1) <= 1  # rounding
    return (pictures & ((got[1] - wanted[1]).abs() < 1e-5)).tolist()


@pytest.fixture
def make_world(make_config, noise_pictures) -> Callable[..., World]:
    pictures = noise_pictures(COUNT)

    def make(backbone: str = "rectified", capacity: int = CAPACITY, **settings: str) -> World:
        torch.manual_seed(1)
        return World(make_config(backbone, **settings), pictures, capacity)

    return make


@pytest.fixture
def world(make_world) -> World:
    return make_world()


def test_first_answer_is_what_the_policy_makes_of_the_frames(world: World) -> None:
    for refresh in (2, 0):
        assert world.get([3, 0, 7, 3], refresh)[0].dtype == torch.uint8
        assert all(world.fresh([3, 0, 7, 3], refresh))


@pytest.mark.parametrize("kind", [{}, {"backbone": "dense", "navigation_encoder": "paper_small"}])
def test_everything_is_fresh_without_a_limit(kind, make_world) -> None:
    world = make_world(**kind)
    world.get([*range(10)], 0)
    world.learn()
    assert all(world.fresh([*range(10)], 0))


def test_answer_is_kept_while_the_ensemble_does_not_learn(world: World) -> None:
    before = world.get([*range(6)], 0)
    world.learn()
    world.maps.version -= 1  # nobody told
    assert all(same(world.get([*range(6)], 0), before))


def test_limit_refreshes_the_most_outdated_first(world: World) -> None:
    world.get([0, 1, 2, 3], 0)
    world.learn()
    world.get([0, 1], 0)
    world.learn()
    world.get([4], 0)
    frames = [*range(5)]
    assert world.fresh(frames, 2) == [False, False, True, True, True]
    assert sum(world.fresh(frames, 1)) == 4
    assert all(world.fresh(frames, 5))


def test_missing_frames_are_computed_beyond_the_limit(world: World) -> None:
    world.get([0, 1], 0)
    world.learn()
    assert world.fresh([*range(8)], 1) == [False, False, *[True] * 6]


def test_overwritten_frames_are_not_mistaken_for_new_ones(world: World) -> None:
    world.get([*range(10)], 0)
    assert all(world.fresh([*range(8, 20)], 1)), "12..19 took the places of 0..7"


def test_frames_that_share_a_place_are_not_mistaken_for_each_other(world: World) -> None:
    frames = [0, CAPACITY, 1, 2 * CAPACITY]
    for _ in range(2):
        assert all(world.fresh(frames, 1))


def test_more_frames_than_a_chunk_are_all_computed(make_world) -> None:
    world = make_world(capacity=COUNT)
    assert all(world.fresh(np.random.default_rng(0).permutation(COUNT).tolist(), 0))
