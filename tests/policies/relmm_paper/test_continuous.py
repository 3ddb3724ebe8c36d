from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from relmm.features import GRASP_X, GRASP_Y, GRID, STATE_NAMES, Phase, Skill, action_dict, cell_to_xy, in_grasp_area
from relmm.policies.controller import Row
from relmm.policies.relmm_paper.continuous import ContinuousGrasping
from relmm.policies.relmm_paper.modeling_relmm_paper import RelmmPaperPolicy
from relmm.policies.relmm_paper.replay import to_pictures

STATE = np.zeros(len(STATE_NAMES), np.float32)
SIZE = np.array([GRASP_X[1] - GRASP_X[0], GRASP_Y[1] - GRASP_Y[0]])
MakeConfig = Callable[..., object]


@pytest.fixture
def grasping(make_config) -> ContinuousGrasping:
    torch.manual_seed(0)
    return ContinuousGrasping(make_config(grasping="continuous", num_members=2))


@pytest.fixture
def peaked(grasping: ContinuousGrasping, monkeypatch) -> tuple[ContinuousGrasping, NDArray]:
    """Networks that expect success at one place, the less the farther away; the second one is surer."""
    best = np.array([0.412, -0.031])
    low = np.array([GRASP_X[0], GRASP_Y[0]])
    unit = torch.from_numpy((best - low) / SIZE * 2 - 1).float()

    def logits(pictures: Tensor, places: Tensor) -> Tensor:
        distance = (places - unit).square().sum(dim=-1)
        return torch.stack([2 - 40 * distance, 3 - 40 * distance])

    monkeypatch.setattr(grasping, "logits", logits)
    return grasping, best


def choices(grasping: ContinuousGrasping, pictures: Tensor, greedy: bool, count: int) -> NDArray:
    rng, estimate = np.random.default_rng(0), grasping.estimate(pictures)
    return np.array([grasping.choose(pictures, estimate, rng, greedy) for _ in range(count)])


def test_networks_begin_as_in_the_authors_code(grasping: ContinuousGrasping) -> None:
    """Normal weights of 0.01, no bias."""
    for name, weight in grasping.members.named_parameters():
        if name.endswith("bias"):
            assert not weight.any()
        elif weight.numel() > 1000:
            assert weight.std().item() == pytest.approx(0.01, rel=0.1)


def test_each_picture_and_place_is_judged_alone(grasping: ContinuousGrasping, noise_pictures) -> None:
    pictures, places = noise_pictures(2), torch.rand(2, 5, 2) * 2 - 1
    together = grasping.logits(pictures, places)
    assert together.shape == (2, 2, 5)
    alone = grasping.logits(pictures[1:], places[1:, 3:4])
    assert torch.allclose(alone[:, 0, 0], together[:, 1, 3], atol=1e-5)


def test_estimate_is_the_lower_chance_at_the_centres_of_the_cells(peaked, noise_pictures) -> None:
    grasping, best = peaked
    estimate = grasping.estimate(noise_pictures(1))
    assert estimate.mean.shape == (1, GRID**2)
    nearest = np.hypot(*((cell_to_xy(np.arange(GRID**2)) - best) / SIZE).T).argmin()
    assert estimate.mean[0].argmax() == nearest
    assert estimate.mean.max() <= 1 / (1 + math.exp(-2))
    assert not estimate.std.any()
    assert grasping.grasp_probability(estimate).item() == pytest.approx(estimate.mean.max().item())


def test_cross_entropy_method_finds_the_best_place(peaked, noise_pictures) -> None:
    """Cells are 11 mm wide; it comes within a millimetre or two."""
    grasping, best = peaked
    found = choices(grasping, noise_pictures(1), greedy=True, count=20)
    assert np.abs(found - best).max() < 0.002


def test_best_place_may_lie_in_a_corner(grasping: ContinuousGrasping, noise_pictures, monkeypatch) -> None:
    monkeypatch.setattr(grasping, "logits", lambda pictures, places: places.sum(dim=-1).expand(2, -1, -1))
    found = choices(grasping, noise_pictures(1), greedy=True, count=5)
    assert found == pytest.approx(np.tile([GRASP_X[1], GRASP_Y[1]], (5, 1)), abs=0.004)
    assert all(in_grasp_area(x, y) for x, y in found)


def test_two_attempts_of_five_go_anywhere_while_training(peaked, noise_pictures) -> None:
    grasping, best = peaked
    found = choices(grasping, noise_pictures(1), greedy=False, count=300)
    away = np.hypot(*(found - best).T) > 0.005
    assert away.mean() == pytest.approx(0.4, abs=4 * math.sqrt(0.24 / 300))


def test_loss_is_the_cross_entropy_at_the_attempted_places(peaked, noise_pictures) -> None:
    grasping, best = peaked
    tried = np.array([best, best + np.array([0.0, 0.04])])
    loss, logs = grasping.loss(noise_pictures(2), torch.from_numpy(tried).float(), torch.tensor([True, False]))
    expected = 0.0
    for peak in (2.0, 3.0):
        chance = [1 / (1 + math.exp(-logit)) for logit in (peak, peak - 40 * 0.25)]
        expected -= (math.log(chance[0]) + math.log(1 - chance[1])) / 2
    assert loss.item() == pytest.approx(expected, rel=1e-3)
    assert logs["grasp_loss"] == pytest.approx(expected / 2, rel=1e-3)


def test_policy_grasps_between_the_centres_of_cells_and_believes_what_it_expects_there(make_policy, empty) -> None:
    policy = make_policy(grasping="continuous", num_members=2, sample=True, min_attempts_to_update=2)
    row = Row(np.random.default_rng(0))
    policy.observe(empty, STATE, row)
    centres = cell_to_xy(np.arange(GRID**2))
    for seen in (0, 5):
        policy.attempts_seen.fill_(seen)
        action = policy.attempt(row)
        place = np.array([action["skill_x.pos"], action["skill_y.pos"]])
        assert in_grasp_area(*place)
        assert np.hypot(*(centres - place).T).min() > 1e-5
        expected, _ = policy.grasping.opinion(row.memory["pictures"], row.memory["estimate"], place)
        assert row.belief["grasp_mean"] == expected


def test_saved_and_loaded_it_grasps_the_same(make_policy, noise_pictures, tmp_path) -> None:
    policy = make_policy(grasping="continuous", num_members=2, seed=3)
    policy.save_pretrained(tmp_path)
    loaded = RelmmPaperPolicy.from_pretrained(tmp_path)
    assert isinstance(loaded.grasping, ContinuousGrasping)
    for one, two in zip(policy.grasping.parameters(), loaded.grasping.parameters(), strict=True):
        assert torch.equal(one, two)
    found = [choices(each.grasping, noise_pictures(1), True, 3) for each in (policy, loaded)]
    assert np.array_equal(*found)


def test_it_learns_where_the_blob_is(make_policy) -> None:
    """A blob lies in one quarter of the grasp area, an attempt in the same quarter succeeds; chance is 25 %.

    With the authors' small weights it would take hundreds of updates until anything is learned: begin with larger ones.
    """
    settings = {"grasp_channels": 8, "grasp_learning_rate": 1e-3, "grasp_batch_size": 32, "grasp_input_gain": 1.0}
    policy = make_policy(grasping="continuous", num_members=2, min_attempts_to_update=1, seed=0, **settings)
    torch.manual_seed(0)
    for weight in policy.grasping.members.parameters():
        if weight.dim() > 1:
            torch.nn.init.xavier_uniform_(weight)
    rng, learner = np.random.default_rng(0), policy.make_learner(seed=0, capacity=600)
    low = np.array([GRASP_X[0], GRASP_Y[0]])

    def scene(quarter: NDArray) -> NDArray[np.uint8]:
        image = rng.integers(60, 110, (100, 100, 3), np.uint8)
        row, column = 84 - 24 * quarter[0], 58 - 24 * quarter[1]
        image[row - 4 : row + 5, column - 4 : column + 5] = (0, 255, 0)
        return image

    def inside(place: NDArray, quarter: NDArray) -> bool:
        return bool((((place - low) / SIZE > 0.5) == quarter).all())

    for _ in range(600):
        quarter, place = rng.integers(2, size=2), low + rng.random(2) * SIZE
        action = np.array(list(action_dict(Skill.GRASP, x=place[0], y=place[1]).values()), np.float32)
        learner.add(scene(quarter), STATE, action, inside(place, quarter), Phase.LEARNING)
    for _ in range(60):
        learner.update_grasping(Phase.LEARNING)
    quarters = rng.integers(2, size=(40, 2))
    pictures = [to_pictures(scene(quarter)[None], torch.device("cpu")) for quarter in quarters]
    found = [choices(policy.grasping, picture, True, 1)[0] for picture in pictures]
    assert np.mean([inside(place, quarter) for place, quarter in zip(found, quarters, strict=True)]) > 0.75
