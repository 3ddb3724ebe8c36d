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
    STATE_KEY,
    STATE_NAMES,
    Skill,
    cell_to_xy,
    in_grasp_area,
    xy_to_cell,
)
from relmm.policies.controller import Row
from relmm.policies.relmm.grasping import FIRST_COLUMN, FIRST_ROW, Opinion
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy

CELLS = GRID**2
BODY = 0.19  # m, within which the base pushes a thing: their radii
STATE = np.zeros(len(STATE_NAMES), np.float32)
STATE[-41:] = 3.0
MakePolicy = Callable[..., ReLMMPolicy]
Believe = Callable[..., None]


@pytest.fixture
def believe(monkeypatch) -> Believe:
    """Makes a policy think this of the grasp cells, whatever it sees, and nothing of the rest."""

    def set_(policy: ReLMMPolicy, means: dict[int, float], stds: dict[int, float] | None = None) -> None:
        shape = policy.grasping.known.shape

        def layer(values: dict[int, float]) -> Tensor:
            whole = torch.zeros(1, *shape)
            for cell, value in values.items():
                whole[0, cell // GRID - FIRST_ROW, cell % GRID - FIRST_COLUMN] = value
            return whole

        opinion = Opinion(layer(means), layer(stds or {}))
        monkeypatch.setattr(policy.grasping, "look", lambda images: opinion)

    return set_


def observed(policy: ReLMMPolicy, image: np.ndarray, seed: int = 0) -> Row:
    row = Row(np.random.default_rng(seed))
    policy.observe(image, STATE, row)
    return row


def run(policy: ReLMMPolicy, batch: dict[str, Tensor], steps: int) -> Tensor:
    return torch.stack([policy.select_action(batch) for _ in range(steps)])


def cell_of(action: dict[str, float]) -> int:
    return xy_to_cell(action["skill_x.pos"], action["skill_y.pos"])


def live(policy: ReLMMPolicy, world: Any, steps: int) -> list[int]:
    """The skills of its actions until all things are gone: what it puts into the basket is."""
    row, skills = policy.row(0), []
    while len(skills) < steps and (len(world.things) or world.holding):
        action = policy._act(*world.observe(), row)
        skills.append(int(action["skill.pos"]))
        world.act(action)
        if skills[-1] == Skill.PLACE:
            world.things = world.things[:-1]
    return skills


# --- Gate ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("threshold", [0.3, 0.7])
def test_greedy_policy_grasps_the_best_cell_from_its_threshold_on(threshold, make_policy, believe, empty) -> None:
    for chance, skill in ((threshold - 0.01, Skill.NAVIGATE), (threshold + 0.01, Skill.GRASP)):
        policy = make_policy(grasp_threshold=threshold)
        believe(policy, {40: chance - 0.05, 97: chance, 98: 0.2})
        action = policy.decide(empty, STATE, observed(policy, empty))
        assert action["skill.pos"] == skill
        assert skill == Skill.NAVIGATE or cell_of(action) == 97


def test_greedy_policy_is_not_moved_by_uncertainty(make_policy, believe, empty) -> None:
    policy = make_policy()
    believe(policy, {50: 0.6, 90: 0.55}, {90: 0.4})
    assert cell_of(policy.decide(empty, STATE, observed(policy, empty))) == 50
    believe(policy, {50: 0.45, 90: 0.42}, {90: 0.4})
    row = observed(policy, empty)
    assert policy.decide(empty, STATE, row)["skill.pos"] == Skill.NAVIGATE
    assert row.belief["grasp_probability"] == pytest.approx(0.82)


@pytest.mark.parametrize(
    ("means", "stds", "weight", "probability"),
    [
        ({7: 0.3}, {7: 0.1}, 1.0, 0.4),
        ({7: 0.3}, {7: 0.1}, 0.0, 0.3),
        ({7: 0.3, 90: 0.1}, {90: 0.25}, 2.0, 0.6),  # the best by mean is another than the best by both
        ({7: 0.9}, {7: 0.3}, 1.0, 1.0),
    ],
)
def test_sampling_policy_grasps_with_its_probability(means, stds, weight, probability, make_policy, believe, empty):
    policy, count = make_policy(sample=True, gate_std_weight=weight), 300
    believe(policy, means, stds)
    row = observed(policy, empty)
    grasps = sum(policy._wants_to_grasp(row) for _ in range(count))
    assert row.belief["grasp_probability"] == pytest.approx(probability, abs=1e-5)
    assert grasps / count == pytest.approx(probability, abs=4 * math.sqrt(probability * (1 - probability) / count))


def test_once_decided_a_sampling_policy_attempts_as_often_as_it_may(make_policy, make_batch, believe, empty) -> None:
    """Algorithm 1: the gate is asked once, not before each of the N_grasp attempts."""
    policy = make_policy(sample=True, num_grasp=3, gate_std_weight=0.0)
    believe(policy, dict.fromkeys(range(CELLS), 0.4))
    taken = run(policy, make_batch(empty), 90)[:, 0, 2].int().tolist()
    runs = "".join(map(str, taken)).strip("1").split("0")
    assert set(runs) == {"", "111"}


@pytest.mark.parametrize("num_grasp", [1, 2])
def test_it_drives_after_so_many_attempts(num_grasp: int, make_policy, make_batch, believe, empty) -> None:
    policy = make_policy(num_grasp=num_grasp)
    believe(policy, dict.fromkeys(range(CELLS), 0.9))
    taken = run(policy, make_batch(empty), num_grasp + 1)[:, 0, 2].int().tolist()
    assert taken == [Skill.GRASP] * num_grasp + [Skill.NAVIGATE]


def test_sampling_policy_explores_cells(make_policy, believe, empty) -> None:
    policy = make_policy(sample=True)
    believe(policy, dict.fromkeys(range(CELLS), 0.5))
    row = observed(policy, empty)
    assert len({cell_of(policy.attempt(row)) for _ in range(40)}) > 20
    policy.sampling = False
    assert len({cell_of(policy.attempt(row)) for _ in range(5)}) == 1


# --- Belief --------------------------------------------------------------------------------------------------
def test_belief_is_that_of_the_picture_and_of_the_attempted_cell(make_policy, believe, empty) -> None:
    policy = make_policy(gate_std_weight=2.0)
    believe(policy, {50: 0.3, 60: 0.2}, {50: 0.1, 60: 0.35})
    row = observed(policy, empty)
    assert row.belief == pytest.approx({"grasp_probability": 0.9})
    policy.navigate(row)
    assert row.belief == pytest.approx({"grasp_probability": 0.9})
    row = observed(policy, empty)
    policy.attempt(row)
    assert row.belief == pytest.approx({"grasp_probability": 0.9, "grasp_mean": 0.3, "grasp_std": 0.1})
    assert set(row.belief) == set(BELIEF)
    policy.observe(empty, STATE, row)
    assert set(row.belief) == {"grasp_probability"}, "the attempt belonged to the frame before"


# --- What has failed -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("sample", [False, True])
def test_where_attempts_have_failed_neither_gate_nor_plan_expects_anything(sample: bool, make_green, make_world):
    """Something that looks like an object and cannot be picked up: the arm always misses it."""
    policy, world = make_green(seed=1, sample=sample), make_world((0.38, 0.0))
    row, place, wanted = policy.row(0), np.array([0.38, 0.0]), []
    for _ in range(30):
        image, state = world.observe()
        action = policy._act(image, state, row)
        wanted.append(action["skill.pos"] == Skill.GRASP)
        if action["skill.pos"] == Skill.NAVIGATE:
            world.act(action)
            mind = policy.mind(row)
            assert mind.floor.is_left_alone(place[None])[0]
            assert np.linalg.norm(mind.plan.target - place) > 0.05
        else:
            world.motion = np.zeros(3)
    assert wanted[:3] == [True, True, False]
    assert not any(wanted[2:])


def test_what_was_attempted_in_vain_is_not_driven_over(make_green, make_world) -> None:
    """It lies in the straight line to something else."""
    policy, world = make_green(seed=1), make_world((0.4, 0.0), (1.5, 0.0))
    row, stuck, gaps = policy.row(0), np.array([0.4, 0.0]), []
    for _ in range(30):
        image, state = world.observe()
        action = policy._act(image, state, row)
        if action["skill.pos"] == Skill.GRASP and np.linalg.norm(world.in_robot_frame(stuck) - (0.38, 0)) > 0.15:
            break  # at the other
        world.motion = np.zeros(3)
        if action["skill.pos"] == Skill.NAVIGATE:
            world.act(action)
            gaps.append(np.linalg.norm(world.pose[:2] - stuck))
    assert min(gaps) > BODY
    assert np.linalg.norm(world.pose[:2] - (1.5, 0.0)) < 0.55


def test_an_attempt_that_succeeds_marks_nothing(make_green, make_world) -> None:
    policy, world, row = make_green(), make_world((0.38, 0.0), (0.36, 0.07)), None
    row = policy.row(0)
    for _ in range(3):  # grasp, place, grasp the other
        image, state = world.observe()
        action = policy._act(image, state, row)
        world.act(action)
        if action["skill.pos"] == Skill.PLACE:
            world.things = world.things[:-1]
            assert not policy.mind(row).floor.left_alone.any()
    assert action["skill.pos"] == Skill.GRASP
    assert world.holding
    assert not len(world.things)


def test_what_is_in_reach_and_not_wanted_is_left_alone_by_the_plan(make_policy, believe, empty) -> None:
    policy = make_policy(sample=True)
    believe(policy, {112: 0.4}, {})
    row = observed(policy, empty)
    policy.navigate(row)
    mind = policy.mind(row)
    assert mind.floor.is_left_alone(mind.floor.to_map(cell_to_xy(np.array([112.0]))))[0]


def test_a_goal_is_given_up_by_a_robot_that_does_not_get_on(make_green, make_world) -> None:
    policy, world = make_green(), make_world((1.0, 0.3))
    row, targets = policy.row(0), []
    for _ in range(20):
        assert policy._act(*world.observe(), row)["skill.pos"] == Skill.NAVIGATE
        targets.append(policy.mind(row).plan.target)
    assert np.linalg.norm(targets[0] - (1.0, 0.3)) < 0.04
    assert policy.mind(row).floor.is_left_alone(np.array([[1.0, 0.3]]))[0]
    assert np.linalg.norm(targets[-1] - targets[0]) > 0.1


# --- A life --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("seed", range(3))
def test_it_finds_and_collects_all_there_is(seed: int, make_green, make_world) -> None:
    rng = np.random.default_rng(seed)
    things = [(d * math.cos(a), d * math.sin(a)) for d, a in zip((0.6, 1.0, 1.4), rng.uniform(-3, 3, 3), strict=True)]
    line = np.arange(-1.8, 1.81, 0.1)
    room = [(x, y, 0.06) for along in line for side in (-1.8, 1.8) for x, y in ((along, side), (side, along))]
    policy, world = make_green(seed=seed), make_world(*things, posts=room)
    skills = live(policy, world, 100)
    assert len(world.things) == 0
    assert skills.count(Skill.PLACE) == 3
    assert skills.count(Skill.GRASP) <= 5


def test_navigation_steps_are_such_as_the_robot_takes(make_policy, make_batch, empty) -> None:
    images = np.random.default_rng(0).integers(0, 256, (2, 100, 100, 3), np.uint8)
    actions = run(make_policy(sample=True, grasp_threshold=0.1), make_batch(empty, *images), 8)
    assert actions.shape == (8, 3, len(ACTION_NAMES))
    assert actions.dtype == torch.float32
    for x_vel, theta_vel, skill, x, y in actions.reshape(-1, 5).tolist():
        assert -1e-6 <= x_vel <= MAX_X_VEL + 1e-5
        assert abs(theta_vel) <= MAX_THETA_VEL + 1e-4
        assert skill == Skill.NAVIGATE or (skill == Skill.GRASP and in_grasp_area(x, y))


def test_what_is_held_goes_into_the_basket(make_policy, make_batch, believe, empty) -> None:
    policy = make_policy()
    believe(policy, {7: 0.9})
    actions = policy.select_action(make_batch(empty, empty, holding=(1,)))
    assert actions[0, 2] == Skill.GRASP
    assert actions[1].tolist() == pytest.approx([0, 0, Skill.PLACE, *BASKET_XY])


@pytest.mark.parametrize("sample", [False, True])
def test_rows_of_a_batch_decide_as_alone(sample: bool, make_policy, make_batch, empty) -> None:
    """Robots of a batch are episodes 0, 1 of a policy that meets them one after the other."""
    images = [empty, np.random.default_rng(1).integers(0, 256, (100, 100, 3), np.uint8)]
    policy, alone = (make_policy(seed=5, sample=sample, grasp_threshold=0.2) for _ in range(2))
    together = run(policy, make_batch(*images), 8)
    for index, image in enumerate(images):
        assert torch.equal(run(alone, make_batch(image), 8)[:, 0], together[:, index])
        alone.reset()


def test_each_observation_is_taken_in_once(make_policy, make_batch, monkeypatch, empty) -> None:
    policy, taken = make_policy(), []
    observe = policy.observe
    monkeypatch.setattr(policy, "observe", lambda *given: (taken.append(1), observe(*given)))
    batch, row = make_batch(empty), policy.row(0)
    policy.select_action(batch)
    policy.observe(empty, batch[STATE_KEY][0].numpy(), row)  # as `Actor.watch` does
    row.observed = True
    policy.select_action(batch)
    assert len(taken) == 2
    policy.select_action(batch)
    assert len(taken) == 3


def test_a_new_episode_begins_with_an_empty_memory(make_green, make_batch, thing_at, empty) -> None:
    policy = make_green(seed=2)
    run(policy, make_batch(thing_at(112)), 4)
    policy.reset()
    run(policy, make_batch(empty), 1)
    floor = policy.mind(policy.row(0)).floor
    assert floor.success(0.0).max() < 0.1
    assert floor.steps == 1


# --- Seeds, files and LeRobot --------------------------------------------------------------------------------
@pytest.mark.parametrize("sample", [False, True])
def test_equal_seeds_act_the_same(sample: bool, make_policy, make_batch) -> None:
    batch = make_batch(np.random.default_rng(1).integers(0, 256, (100, 100, 3), np.uint8))

    def actions(seed: int) -> Tensor:
        torch.manual_seed(seed + 1)  # which must not matter
        return run(make_policy(seed=seed, sample=sample, grasp_threshold=0.2), batch, 6)

    assert torch.equal(actions(3), actions(3))
    assert not torch.equal(actions(3), actions(4))


@pytest.mark.parametrize("sample", [False, True])
def test_saved_and_loaded_it_acts_the_same(sample: bool, make_policy, make_batch, tmp_path: Path) -> None:
    policy = make_policy(seed=6, sample=sample, grasp_threshold=0.3)
    with torch.no_grad():
        for weight in policy.parameters():
            weight += 0.01
    policy.save_pretrained(tmp_path)
    loaded = ReLMMPolicy.from_pretrained(tmp_path)
    batch = make_batch(np.random.default_rng(1).integers(0, 256, (100, 100, 3), np.uint8))
    assert loaded.config == policy.config
    pairs = zip(policy.state_dict().items(), loaded.state_dict().items(), strict=True)
    assert all(a == b and torch.equal(x, y) for (a, x), (b, y) in pairs)
    assert torch.equal(run(policy, batch, 6), run(loaded, batch, 6))


def test_lerobot_finds_policy_and_processors_by_name(make_batch, empty) -> None:
    config = make_policy_config("relmm", device="cpu", num_members=2, channels=4)
    assert get_policy_class("relmm") is ReLMMPolicy
    policy = ReLMMPolicy(config)
    before, after = make_pre_post_processors(config)
    batch = make_batch(empty)
    assert all(torch.equal(before(batch)[key], batch[key]) for key in batch)
    assert after(policy.select_action(before(batch))).shape == (1, len(ACTION_NAMES))


def test_optimiser_gets_what_learns_and_not_the_random_part(make_policy) -> None:
    policy = make_policy()
    given = {id(weight) for weight in policy.get_optim_params()}
    assert given == {id(weight) for weight in policy.parameters() if weight.requires_grad}
    assert 0 < len(given) < len([*policy.parameters()])


def test_thoughts_can_be_looked_at(make_green, make_batch, thing_at) -> None:
    policy = make_green()
    run(policy, make_batch(thing_at(112)), 3)
    picture = policy.picture(policy.row(0))
    assert picture.dtype == np.uint8
    assert picture.std() > 5
