from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_policy, make_pre_post_processors
from torch import Tensor

import relmm.plugin  # noqa: F401
from relmm.features import (
    ACTION_NAMES,
    BASKET_XY,
    GRID,
    MAX_THETA_VEL,
    MAX_X_VEL,
    STATE_KEY,
    Skill,
    cell_to_xy,
    xy_to_cell,
)
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy
from relmm.policies.relmm.navigation import from_navigation_steps, to_navigation_step
from relmm.sim.config_relmm_room import RelmmRoomEnvConfig

CELLS = GRID**2
BACKBONES = ["rectified", "dense"]
MakePolicy = Callable[..., ReLMMPolicy]


@pytest.fixture
def certain(make_policy_of: MakePolicy, set_logits) -> MakePolicy:
    """A policy that expects success with a known probability in cell 7 and with 1 % elsewhere."""

    def make(probability: float, **settings: Any) -> ReLMMPolicy:
        policy = make_policy_of("dense", **settings)
        logits = torch.full((3, CELLS), math.log(0.01 / 0.99))
        logits[:, 7] = math.log(probability / (1 - probability))
        set_logits(policy.grasping, logits)
        return policy

    return make


@pytest.fixture
def green(make_green: MakePolicy) -> ReLMMPolicy:
    return make_green()


def skills(policy: ReLMMPolicy, batch: dict[str, Tensor], steps: int) -> list[int]:
    return [int(policy.select_action(batch)[0, 2]) for _ in range(steps)]


def same_weights(first: torch.nn.Module, second: torch.nn.Module) -> bool:
    pairs = zip(first.state_dict().items(), second.state_dict().items(), strict=True)
    return all(a == b and torch.equal(x, y) for (a, x), (b, y) in pairs)


# --- Deciding ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("probability", "skill"), [(0.49, Skill.NAVIGATE), (0.51, Skill.GRASP)])
def test_greedy_policy_grasps_where_it_expects_success_in_half_the_cases(
    probability: float, skill: Skill, certain: MakePolicy, act, empty
) -> None:
    action = act(certain(probability), empty)
    assert action["skill.pos"] == skill
    if skill == Skill.GRASP:
        assert (action["skill_x.pos"], action["skill_y.pos"]) == pytest.approx(tuple(cell_to_xy(7)))


def test_greedy_policy_is_not_moved_by_uncertainty(make_policy_of: MakePolicy, set_logits, act, empty) -> None:
    """The mean decides, as the paper's evaluation does: neither the gate nor the cell gets the bonus."""
    policy = make_policy_of("dense")
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
    assert policy.grasp_probability > 0.8


def test_greedy_policy_grasps_the_thing_it_sees(green: ReLMMPolicy, act, draw) -> None:
    for cell in (20, 112, 200):
        green.reset()
        action = act(green, draw(cell))
        found = np.array([action["skill_x.pos"], action["skill_y.pos"]]) - cell_to_xy(cell)
        assert action["skill.pos"] == Skill.GRASP
        assert np.abs(found).max() < 0.012


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


def test_greedy_rows_of_a_batch_decide_as_alone(green: ReLMMPolicy, make_batch, draw, empty) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (100, 100, 3), np.uint8)
    images = [empty, draw(112), noise, draw(30, 200)]
    together = torch.stack([green.select_action(make_batch(*images)) for _ in range(4)])
    for index, image in enumerate(images):
        green.reset()
        alone = torch.stack([green.select_action(make_batch(image)) for _ in range(4)])[:, 0]
        assert torch.allclose(alone, together[:, index], atol=1e-5)
    assert set(together[..., 2].flatten().tolist()) == {Skill.NAVIGATE, Skill.GRASP}


@pytest.mark.parametrize("backbone", BACKBONES)
def test_greedy_policy_is_deterministic(backbone: str, make_policy_of: MakePolicy, make_batch, empty) -> None:
    first, second = (make_policy_of(backbone, seed=seed_of_both) for seed_of_both in (2, 2))
    batch = make_batch(empty)
    torch.manual_seed(5)
    actions = first.select_action(batch)
    torch.manual_seed(6)
    first.reset()
    assert torch.equal(first.select_action(batch), actions)
    assert torch.equal(second.select_action(batch), actions)


@pytest.mark.parametrize("probability", [0.2, 0.7])
def test_sampling_policy_grasps_with_its_probability(probability: float, certain: MakePolicy, make_batch, empty):
    policy, batch, count = certain(probability, sample=True, num_grasp=1), make_batch(empty), 400
    grasps = 0
    for _ in range(count):
        policy.reset()
        grasps += skills(policy, batch, 1)[0] == Skill.GRASP
    assert policy.grasp_probability == pytest.approx(probability, abs=1e-4)
    assert grasps / count == pytest.approx(probability, abs=4 * math.sqrt(probability * (1 - probability) / count))


def test_once_decided_a_sampling_policy_attempts_again(certain: MakePolicy, make_batch, empty) -> None:
    """Algorithm 1: the gate is asked once, not before each of the N_grasp attempts."""
    taken = skills(certain(0.3, sample=True, num_grasp=3), make_batch(empty), 300)
    runs = "".join(map(str, taken)).strip("1").split("0")
    assert set(runs) == {"", "111"}


def test_success_ends_the_attempts_of_a_step(certain: MakePolicy, make_batch, set_logits, empty) -> None:
    """Algorithm 1 returns with the first success."""
    policy = certain(0.999999, sample=True, num_grasp=3)
    taken = [int(policy.select_action(make_batch(empty, holding=held))[0, 2]) for held in ((), (0,))]
    assert taken == [Skill.GRASP, Skill.PLACE]
    set_logits(policy.grasping, torch.full((3, CELLS), -20.0))
    assert skills(policy, make_batch(empty), 1) == [Skill.NAVIGATE]


def test_sampling_policy_explores_cells_and_drives(certain: MakePolicy, make_batch, empty) -> None:
    policy, batch = certain(0.5, sample=True), make_batch(empty)
    actions = torch.stack([policy.select_action(batch)[0] for _ in range(150)])
    grasps, drives = actions[actions[:, 2] == Skill.GRASP], actions[actions[:, 2] == Skill.NAVIGATE]
    assert len({tuple(place) for place in grasps[:, 3:].tolist()}) > 10
    assert len({tuple(drive) for drive in drives[:, :2].tolist()}) == len(drives)


def test_sampling_rows_of_a_batch_draw_their_own_streams(certain: MakePolicy, make_batch, empty) -> None:
    """As `ControllerConfig` says of `seed`."""
    policy = certain(0.5, sample=True)
    together = torch.stack([policy.select_action(make_batch(empty, empty)) for _ in range(5)])
    alone = certain(0.5, sample=True)
    assert torch.equal(torch.stack([alone.select_action(make_batch(empty))[0] for _ in range(5)]), together[:, 0])


def test_probability_is_unknown_before_the_first_picture(certain: MakePolicy) -> None:
    assert certain(0.5).grasp_probability == -1.0


# --- Actions -------------------------------------------------------------------------------------------------
def test_navigation_actions_convert_there_and_back() -> None:
    actions = torch.tensor([[-1.0, -1.0], [-1.0, 0.0], [0.0, 0.5], [1.0, 1.0], [0.3, -0.7]])
    steps = [list(to_navigation_step(action).values()) for action in actions.tolist()]
    assert torch.allclose(from_navigation_steps(torch.tensor(steps)), actions, atol=1e-6)
    assert steps[1] == [0.0, 0.0, Skill.NAVIGATE, 0.0, 0.0], "-1 forward stands still"
    assert steps[3][:2] == [MAX_X_VEL, MAX_THETA_VEL], "positive turns left"


def test_navigation_steps_beyond_the_range_are_clipped() -> None:
    """A robot that bumped drives backwards."""
    steps = torch.tensor([[-0.2, 200.0, 0, 0, 0], [0.9, -200.0, 0, 0, 0]])
    assert from_navigation_steps(steps).tolist() == [[-1.0, 1.0], [1.0, -1.0]]


@pytest.mark.parametrize("theta_vel", [40.0, -40.0])
def test_policy_knows_from_the_wheels_to_which_side_it_turned_last(
    theta_vel, make_policy_of, make_batch, empty
) -> None:
    """And turns on to that side, where nothing is in view."""
    policy, batch = (
        make_policy_of(seed=1, grasp_threshold=1.0, grasp_initial_spread=0.0, grasp_initial_logit=-9.0),
        make_batch(empty),
    )
    batch[STATE_KEY][0, :2] = torch.tensor([0.1, theta_vel])
    assert policy.select_action(batch)[0, 1].sign() == math.copysign(1, theta_vel)


@pytest.mark.parametrize(("orderly", "straight"), [(True, True), (False, False)])
def test_policy_goes_elsewhere_after_a_look_all_round(orderly, straight, make_policy_of, make_batch, empty) -> None:
    nothing = {"grasp_threshold": 1.0, "grasp_initial_spread": 0.0, "grasp_initial_logit": -9.0}
    policy, batch = make_policy_of(seed=1, orderly_search=orderly, **nothing), make_batch(empty)
    batch[STATE_KEY][0, 1] = MAX_THETA_VEL
    actions = [policy.select_action(batch)[0, :2].tolist() for _ in range(27)]
    assert any(action == pytest.approx([MAX_X_VEL, 0.0]) for action in actions) == straight
    policy.reset()
    assert [policy.select_action(batch)[0, :2].tolist() for _ in range(27)] == actions, "a new episode, a new search"


# --- Seeds, files and LeRobot --------------------------------------------------------------------------------
@pytest.mark.parametrize("backbone", BACKBONES)
def test_equal_seeds_give_equal_weights_and_leave_global_random_numbers_alone(backbone, make_policy_of) -> None:
    torch.manual_seed(1)
    state = torch.get_rng_state()
    first = make_policy_of(backbone, seed=4)
    assert torch.equal(torch.get_rng_state(), state)
    torch.manual_seed(2)
    assert same_weights(first, make_policy_of(backbone, seed=4))
    assert not same_weights(first, make_policy_of(backbone, seed=5))


@pytest.mark.parametrize("backbone", BACKBONES)
@pytest.mark.parametrize("sample", [False, True])
def test_saved_and_loaded_it_acts_the_same(backbone, sample, make_policy_of, make_batch, empty, tmp_path: Path) -> None:
    policy = make_policy_of(backbone, seed=6, sample=sample, grasp_threshold=0.3)
    with torch.no_grad():
        for weight in policy.parameters():
            weight += 0.01
    policy.save_pretrained(tmp_path)
    loaded = ReLMMPolicy.from_pretrained(tmp_path)
    batch = make_batch(empty)
    assert loaded.config == policy.config
    assert same_weights(loaded, policy)
    assert all(torch.equal(policy.select_action(batch), loaded.select_action(batch)) for _ in range(8))


def test_lerobot_makes_it_for_the_room(make_batch, empty) -> None:
    config = PreTrainedConfig.get_choice_class("relmm")(device="cpu", grasp_channels=4, navigation_hidden=8)
    policy = make_policy(config, env_cfg=RelmmRoomEnvConfig())
    assert type(policy) is get_policy_class("relmm") is ReLMMPolicy
    before, after = make_pre_post_processors(config)
    action = after(policy.select_action(before(make_batch(empty))))
    assert action.shape == (1, len(ACTION_NAMES))


def test_optimiser_gets_every_weight_but_those_of_averages_once(make_policy_of: MakePolicy) -> None:
    policy = make_policy_of(grasp_learning_rate=0.01, navigation_learning_rate=0.02)
    groups, navigation = policy.get_optim_params(), policy.navigation
    given = [weight for group in groups for weight in group["params"]]
    averages = [*navigation.targets.parameters(), *navigation.mean_actor.parameters()]
    averages += navigation.mean_encoder.parameters()
    assert (
        len({id(weight) for weight in [*given, *averages]}) == len(given) + len(averages) == len([*policy.parameters()])
    )
    assert [group["lr"] for group in groups] == [0.01, 0.02]


# --- Relabelling ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("relabel", "terminal", "failed", "rewards", "continues"),
    [
        (True, True, True, [-0.7, -1.0, 0.0, -0.6], [0.7, 1.0, 0.0, 0.6]),
        (True, True, False, [-0.7, -1.0, 0.0, -1.0], [0.7, 1.0, 0.0, 1.0]),
        (True, False, True, [-0.7, -1.0, 0.0, -0.6], [1.0, 1.0, 0.0, 1.0]),
        (False, True, True, [-1.0, -1.0, 0.0, -1.0], [1.0, 1.0, 0.0, 1.0]),
    ],
)
def test_steps_without_success_are_rewarded_with_the_grasp_probability(
    relabel: bool, terminal: bool, failed: bool, rewards, continues, make_policy_of: MakePolicy
) -> None:
    policy = make_policy_of("dense", relabel=relabel, relabel_terminal=terminal, relabel_failed=failed)
    success, attempted = torch.tensor([False, False, True, False]), torch.tensor([False, False, True, True])
    result = policy.rewards(torch.tensor([0.3, 0.0, 0.9, 0.4]), success, attempted)
    assert result[0].tolist() == pytest.approx(rewards)
    assert result[1].tolist() == pytest.approx(continues)
