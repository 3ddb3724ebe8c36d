from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors
from torch import Tensor

from relmm.features import (
    ACTION_NAMES,
    BASKET_XY,
    BELIEF,
    GRID,
    MAX_THETA_VEL,
    MAX_X_VEL,
    STATE_NAMES,
    Skill,
    cell_to_xy,
    xy_to_cell,
)
from relmm.policies.controller import Row
from relmm.policies.relmm_paper.modeling_relmm_paper import RelmmPaperPolicy

CELLS = GRID**2
STATE = np.zeros(len(STATE_NAMES), np.float32)
BEGUN = {"min_attempts_to_update": 1, "random_steps": 0, "sample": True}
MakePolicy = Callable[..., RelmmPaperPolicy]


@pytest.fixture
def certain(make_policy: MakePolicy, set_logits) -> MakePolicy:
    """A policy that expects success with a known probability in cell 7 and with 1 % elsewhere."""

    def make(probability: float, **settings: Any) -> RelmmPaperPolicy:
        policy = make_policy(**settings)
        policy.attempts_seen.fill_(10)
        logits = torch.full((3, CELLS), math.log(0.01 / 0.99))
        logits[:, 7] = math.log(probability / (1 - probability))
        set_logits(policy.grasping, logits)
        return policy

    return make


def skills(policy: RelmmPaperPolicy, batch: dict[str, Tensor], steps: int) -> list[int]:
    return [int(policy.select_action(batch)[0, 2]) for _ in range(steps)]


def same_weights(first: torch.nn.Module, second: torch.nn.Module) -> bool:
    pairs = zip(first.state_dict().items(), second.state_dict().items(), strict=True)
    return all(a == b and torch.equal(x, y) for (a, x), (b, y) in pairs)


def observed(policy: RelmmPaperPolicy, image: np.ndarray, seed: int = 0) -> Row:
    row = Row(np.random.default_rng(seed))
    policy.observe(image, STATE, row)
    return row


# --- Greedy --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("probability", "skill"), [(0.49, Skill.NAVIGATE), (0.51, Skill.GRASP)])
def test_greedy_policy_grasps_where_it_expects_success_in_half_the_cases(
    probability: float, skill: Skill, certain: MakePolicy, act, empty
) -> None:
    action = act(certain(probability), empty)
    assert action["skill.pos"] == skill
    if skill == Skill.GRASP:
        assert (action["skill_x.pos"], action["skill_y.pos"]) == pytest.approx(tuple(cell_to_xy(7)))


def test_greedy_policy_is_not_moved_by_uncertainty(make_policy: MakePolicy, set_logits, act, empty) -> None:
    """The mean decides, as the paper's evaluation does: neither the gate nor the cell gets the bonus."""
    policy = make_policy()
    logits = torch.full((3, CELLS), -4.0)
    logits[:, 50] = 0.5  # mean 0.62, no deviation
    logits[:, 90] = torch.tensor([20.0, -20.0, 0.0])  # mean 0.5, deviation 0.41
    set_logits(policy.grasping, logits)
    action = act(policy, empty)
    assert xy_to_cell(action["skill_x.pos"], action["skill_y.pos"]) == 50
    logits[:, 50] = -0.2  # mean 0.45
    logits[:, 90] = torch.tensor([20.0, -20.0, -1.0])  # mean 0.42, deviation 0.42: P[grasp] is 0.84
    set_logits(policy.grasping, logits)
    assert act(policy, empty)["skill.pos"] == Skill.NAVIGATE
    assert policy.row(0).belief["grasp_probability"] > 0.8


@pytest.mark.parametrize("num_grasp", [1, 2, 4])
@pytest.mark.parametrize("sample", [False, True])
def test_drives_after_so_many_attempts(num_grasp: int, sample: bool, certain: MakePolicy, make_batch, empty) -> None:
    policy = certain(0.999999, num_grasp=num_grasp, sample=sample)
    turn = [Skill.GRASP] * num_grasp + [Skill.NAVIGATE]
    assert skills(policy, make_batch(empty), 2 * len(turn)) == turn * 2


def test_what_is_held_goes_into_the_basket(certain: MakePolicy, make_batch, empty) -> None:
    actions = certain(0.9).select_action(make_batch(empty, empty, holding=(1,)))
    assert actions[0, 2] == Skill.GRASP
    assert actions[1].tolist() == pytest.approx([0, 0, Skill.PLACE, *BASKET_XY])


def test_greedy_policy_is_deterministic(make_policy: MakePolicy, make_batch, empty) -> None:
    first, second = (make_policy(seed=seed) for seed in (2, 2))
    batch = make_batch(empty)
    torch.manual_seed(5)
    actions = first.select_action(batch)
    torch.manual_seed(6)
    first.reset()
    assert torch.equal(first.select_action(batch), actions)
    assert torch.equal(second.select_action(batch), actions)


def test_random_navigation_drives_anywhere_and_grasps_as_ever(certain: MakePolicy, make_batch, empty) -> None:
    """The paper's "Rand nav": the ensemble as it is, and uniform drives, also when nothing is sampled."""
    drives = certain(0.3, navigation="random")
    actions = torch.cat([drives.select_action(make_batch(empty)) for _ in range(400)])
    assert not actions[:, 2].any()
    for column, (low, high) in enumerate([(0, MAX_X_VEL), (-MAX_THETA_VEL, MAX_THETA_VEL)]):
        share = np.sort((actions[:, column].numpy() - low) / (high - low))
        assert np.abs(share - np.linspace(0, 1, 400)).max() < 0.1, "Kolmogorov and Smirnov: p < 0.001"
    taken = skills(certain(0.7, navigation="random"), make_batch(empty), 6)
    assert taken == [Skill.GRASP, Skill.GRASP, Skill.NAVIGATE] * 2


# --- Sampling ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("probability", [0.2, 0.7])
def test_sampling_policy_grasps_with_its_probability(probability: float, certain: MakePolicy, make_batch, empty):
    policy, batch, count = certain(probability, sample=True, num_grasp=1), make_batch(empty), 200
    grasps = 0
    for _ in range(count):
        policy.reset()
        grasps += skills(policy, batch, 1)[0] == Skill.GRASP
    assert policy.row(0).belief["grasp_probability"] == pytest.approx(probability, abs=1e-4)
    assert grasps / count == pytest.approx(probability, abs=4 * math.sqrt(probability * (1 - probability) / count))


def test_once_decided_a_sampling_policy_attempts_again(certain: MakePolicy, make_batch, empty) -> None:
    """Algorithm 1: the gate is asked once, not before each of the N_grasp attempts."""
    taken = skills(certain(0.3, sample=True, num_grasp=3), make_batch(empty), 150)
    runs = "".join(map(str, taken)).strip("1").split("0")
    assert set(runs) == {"", "111"}


def test_success_ends_the_attempts_of_a_step(certain: MakePolicy, make_batch, set_logits, empty) -> None:
    """Algorithm 1 returns with the first success."""
    policy = certain(0.999999, sample=True, num_grasp=3)
    taken = [int(policy.select_action(make_batch(empty, holding=held))[0, 2]) for held in ((), (0,))]
    assert taken == [Skill.GRASP, Skill.PLACE]
    set_logits(policy.grasping, torch.full((3, CELLS), -20.0))
    assert skills(policy, make_batch(empty), 1) == [Skill.NAVIGATE]


@pytest.mark.parametrize(("seen", "drawn"), [(9, "uniformly"), (10, "by eq. 2")])
def test_cells_are_uniform_until_the_ensemble_learns(seen: int, drawn: str, certain: MakePolicy, empty) -> None:
    """At eq. 2, cell 7 has exp(10 * 0.98) times the weight of another; the uniform P is 1 / 225."""
    policy = certain(0.99, sample=True, min_attempts_to_update=10)
    policy.attempts_seen.fill_(seen)
    row, counts = observed(policy, empty), np.zeros(CELLS)
    for _ in range(4 * CELLS):
        grasp = policy.attempt(row)
        counts[xy_to_cell(grasp["skill_x.pos"], grasp["skill_y.pos"])] += 1
    if drawn == "uniformly":
        assert ((counts - 4) ** 2 / 4).sum() < 224 + 4 * math.sqrt(2 * 224)
    else:
        assert counts[7] / counts.sum() == pytest.approx(1 / (1 + 224 * math.exp(-9.8)), abs=0.02)


@pytest.mark.parametrize(("seen", "uniform"), [(9, True), (10, False)])
def test_drives_are_uniform_at_first(seen: int, uniform: bool, make_policy: MakePolicy, empty) -> None:
    """The policy itself would turn left as fast as it can."""
    policy = make_policy(sample=True, random_steps=10)
    policy.steps_seen.fill_(seen)
    torch.nn.init.zeros_(policy.navigation.actor.head[-1].weight)
    policy.navigation.actor.head[-1].bias.data = torch.tensor([0.0, 20.0, 0.0, -5.0])
    row = observed(policy, empty)
    turns = [policy.navigate(row)["theta.vel"] for _ in range(50)]
    assert (min(turns) < 0) == uniform
    policy.sampling = False
    assert policy.navigate(row)["theta.vel"] > 112, "who acts greedily does not explore"


def test_sampling_policy_explores_cells_and_drives(certain: MakePolicy, make_batch, empty) -> None:
    policy, batch = certain(0.5, **BEGUN), make_batch(empty)
    actions = torch.stack([policy.select_action(batch)[0] for _ in range(150)])
    grasps, drives = actions[actions[:, 2] == Skill.GRASP], actions[actions[:, 2] == Skill.NAVIGATE]
    assert len({tuple(place) for place in grasps[:, 3:].tolist()}) > 10
    assert len({tuple(drive) for drive in drives[:, :2].tolist()}) == len(drives)


@pytest.mark.parametrize("settings", [BEGUN, {"sample": True}, {"sample": False}])
def test_rows_of_a_batch_decide_as_alone(settings, certain: MakePolicy, make_batch, numbered, empty) -> None:
    """Robots of a batch are episodes 0, 1, 2 of a policy that meets them one after the other."""
    images = [empty, numbered(1), numbered(2)]
    policy, alone = (certain(0.6, **settings) for _ in range(2))
    together = torch.stack([policy.select_action(make_batch(*images)) for _ in range(6)])
    for index, image in enumerate(images):
        actions = torch.stack([alone.select_action(make_batch(image))[0] for _ in range(6)])
        assert torch.equal(actions, together[:, index])
        alone.reset()


# --- Belief --------------------------------------------------------------------------------------------------
def test_belief_is_that_of_the_picture_and_of_the_attempted_cell(make_policy, set_logits, empty) -> None:
    policy = make_policy()
    assert policy.row(0).belief == {}
    logits = torch.full((3, CELLS), -4.0)
    logits[:, 50] = torch.tensor([1.0, 2.0, 3.0])
    set_logits(policy.grasping, logits)
    chances = [1 / (1 + math.exp(-logit)) for logit in (1, 2, 3)]
    row = observed(policy, empty)
    seen = {"grasp_probability": min(np.mean(chances) + np.std(chances), 1.0), "grasp_mean": -1.0, "grasp_std": -1.0}
    assert row.belief == pytest.approx(seen)
    policy.navigate(row)
    assert row.belief == pytest.approx(seen)
    policy.attempt(row)
    assert row.belief == pytest.approx({**seen, "grasp_mean": np.mean(chances), "grasp_std": np.std(chances)})
    assert set(row.belief) == set(BELIEF)


def test_gate_asks_for_the_robot_that_decides(certain: MakePolicy, set_logits, empty) -> None:
    """Whoever was observed last."""
    policy = certain(0.9)
    row = observed(policy, empty)
    set_logits(policy.grasping, torch.full((3, CELLS), -9.0))
    observed(policy, empty)
    assert policy.decide(empty, STATE, row)["skill.pos"] == Skill.GRASP


# --- Seeds, files and LeRobot --------------------------------------------------------------------------------
def test_equal_seeds_give_equal_weights_and_leave_global_random_numbers_alone(make_policy) -> None:
    torch.manual_seed(1)
    state = torch.get_rng_state()
    first = make_policy(seed=4)
    assert torch.equal(torch.get_rng_state(), state)
    torch.manual_seed(2)
    assert same_weights(first, make_policy(seed=4))
    assert not same_weights(first, make_policy(seed=5))


@pytest.mark.parametrize("sample", [False, True])
def test_saved_and_loaded_it_acts_the_same(sample, make_policy, make_batch, empty, tmp_path: Path) -> None:
    """Also if it still explores, or does so no more."""
    policy = make_policy(seed=6, sample=sample, grasp_threshold=0.3, min_attempts_to_update=2, random_steps=2)
    policy.attempts_seen.fill_(2)
    with torch.no_grad():
        for weight in policy.parameters():
            weight += 0.01
    policy.save_pretrained(tmp_path)
    loaded = RelmmPaperPolicy.from_pretrained(tmp_path)
    batch = make_batch(empty)
    assert loaded.config == policy.config
    assert same_weights(loaded, policy)
    assert (loaded.attempts_seen, loaded.steps_seen) == (2, 0)
    assert all(torch.equal(policy.select_action(batch), loaded.select_action(batch)) for _ in range(8))


def test_lerobot_finds_policy_and_processors_by_name(make_batch, empty) -> None:
    config = make_policy_config("relmm_paper", device="cpu", grasp_channels=4, navigation_encoder="paper_small")
    assert get_policy_class("relmm_paper") is RelmmPaperPolicy
    policy = RelmmPaperPolicy(config)
    before, after = make_pre_post_processors(config)
    batch = make_batch(empty)
    assert all(torch.equal(before(batch)[key], batch[key]) for key in batch)
    assert after(policy.select_action(before(batch))).shape == (1, len(ACTION_NAMES))


def test_optimiser_gets_every_weight_but_those_of_the_targets_once(make_policy: MakePolicy) -> None:
    policy = make_policy(grasp_learning_rate=0.01, navigation_learning_rate=0.02)
    groups = policy.get_optim_params()
    given = [weight for group in groups for weight in group["params"]]
    targets = list(policy.navigation.targets.parameters())
    assert (
        len({id(weight) for weight in [*given, *targets]}) == len(given) + len(targets) == len([*policy.parameters()])
    )
    assert [group["lr"] for group in groups] == [0.01, 0.02]


# --- Relabelling ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("relabel", "rewards"), [(True, [-0.7, 0.0, -0.7]), (False, [-1.0, 0.0, -1.0])])
def test_steps_without_success_are_rewarded_with_the_grasp_probability(
    relabel: bool, rewards: list[float], certain: MakePolicy, noise_pictures
) -> None:
    policy, (before, after) = certain(0.3, relabel=relabel), (noise_pictures(3), noise_pictures(4)[:3])
    batch = policy.navigation_batch(before, torch.zeros(3, 2), after, torch.tensor([False, True, False]))
    assert batch.rewards.tolist() == pytest.approx(rewards, abs=1e-5)
    assert batch.continues.tolist() == [1.0, 0.0, 1.0], "the search goes on, whatever the ensemble makes of it"
    assert not batch.rewards.requires_grad
