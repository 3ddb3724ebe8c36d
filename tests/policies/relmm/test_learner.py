from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from relmm.features import ACTION_NAMES, GRID, STATE_NAMES, Phase, Skill, action_dict, cell_to_xy, xy_to_cell
from relmm.policies.controller import grasp_cell
from relmm.policies.relmm.grasping import AREA
from relmm.policies.relmm.learner import Attempts, ReLMMLearner

CELLS = GRID**2
CPU = torch.device("cpu")
STATE = np.zeros(len(STATE_NAMES), np.float32)
SMALL = {"batch_size": 8, "min_attempts_to_update": 3}


def as_array(action: dict[str, float]) -> NDArray[np.float32]:
    return np.array([action[name] for name in ACTION_NAMES], np.float32)


def grasp(cell: int) -> NDArray[np.float32]:
    return as_array(grasp_cell(cell))


def numbered(number: int) -> torch.Tensor:
    """Floor that tells a number, within what its storage keeps."""
    return torch.full((3, AREA, AREA), number / 127)


def picture(number: int) -> NDArray[np.uint8]:
    return np.random.default_rng(number).integers(0, 256, (100, 100, 3), np.uint8)


@pytest.fixture
def make_learner(make_policy) -> Any:
    def make(capacity: int = 100, seed: int = 0, attempts: int = 0, **settings: Any) -> ReLMMLearner:
        policy = make_policy(**{**SMALL, "seed": 1, **settings}).train()
        learner = policy.make_learner(seed, capacity)
        for number in range(attempts):
            learner.add(picture(number), STATE, grasp(number * 7 % CELLS), number % 3 == 0, Phase.LEARNING)
        return learner

    return make


def weights(learner: ReLMMLearner) -> torch.Tensor:
    return torch.cat([weight.detach().flatten() for weight in learner._grasping.parameters()])


# --- Attempts ------------------------------------------------------------------------------------------------
def test_attempts_are_kept_with_their_floor_cell_and_outcome() -> None:
    attempts, floor = Attempts(10), torch.rand(3, 3, AREA, AREA) * 2 - 1
    for index, (cell, success) in enumerate(((0, True), (112, False), (224, True))):
        attempts.add(floor[index], grasp(cell), success)
    areas, cells, successes = attempts.all(CPU)
    assert torch.allclose(areas, floor, atol=0.5 / 127 + 1e-6)
    assert cells.tolist() == [0, 112, 224]
    assert successes.tolist() == [True, False, True]


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize("count", [3, 4, 11])
def test_beyond_its_capacity_the_newest_attempts_are_kept(count: int, named: bool) -> None:
    attempts = Attempts(4)
    for number in range(count):
        attempts.add(numbered(number), grasp(number), number % 2 == 0, number if named else None)
    areas, cells, successes = attempts.all(CPU)
    newest = list(range(max(count - 4, 0), count))
    assert len(attempts) == len(newest)
    assert attempts.added == count
    assert sorted(cells.tolist()) == newest
    assert torch.allclose(areas[:, 0, 0, 0] * 127, cells.float())
    assert successes.tolist() == [cell % 2 == 0 for cell in cells.tolist()]


def test_another_picture_of_the_same_frame_takes_the_place_of_the_first() -> None:
    attempts = Attempts(4)
    for number, name in enumerate((5, 6, 5, 7, 5)):
        attempts.add(numbered(number), grasp(name), name == 5, name)
    areas, cells, successes = attempts.all(CPU)
    assert attempts.added == 3
    assert (areas[:, 0, 0, 0] * 127).round().tolist() == [4, 1, 3]
    assert cells.tolist() == [5, 6, 7]
    assert successes.tolist() == [True, False, False]


def test_a_frame_that_comes_again_after_it_was_forgotten_overwrites_no_other() -> None:
    """Its old place holds another frame by then."""
    attempts = Attempts(2)
    for name in (0, 1, 2, 0):
        attempts.add(numbered(name), grasp(name), False, name)
    assert sorted(attempts.all(CPU)[1].tolist()) == [0, 2], "the two newest"


def test_samples_are_uniform_over_what_there_is() -> None:
    attempts, rng = Attempts(50), np.random.default_rng(0)
    for number in range(5):
        attempts.add(numbered(number), grasp(number), False)
    counts = np.bincount(attempts.sample(2000, rng, CPU)[1].numpy(), minlength=5)
    assert counts.sum() == counts[:5].sum() == 2000
    assert counts == pytest.approx(np.full(5, 400), abs=4 * np.sqrt(2000 * 0.2 * 0.8))


# --- Taking a life -------------------------------------------------------------------------------------------
def test_only_attempts_are_kept_with_the_floor_before_them(make_learner) -> None:
    learner = make_learner()
    for number, skill in enumerate((Skill.NAVIGATE, Skill.GRASP, Skill.PLACE, Skill.GRASP)):
        x, y = cell_to_xy(30 * number)
        action = as_array(action_dict(skill, x=float(x), y=float(y)))
        learner.add(picture(number), STATE, action, number == 3, Phase.LEARNING)
    areas, cells, successes = learner.attempts.all(CPU)
    assert cells.tolist() == [30, 90]
    assert successes.tolist() == [False, True]
    for area, number in zip(areas, (1, 3), strict=True):
        shown = learner._grasping.area(learner._grasping.to_pictures(picture(number)))[0]
        assert torch.allclose(area, shown, atol=1 / 127)


def test_attempts_count_from_the_first_success_on(make_learner) -> None:
    learner, counts = make_learner(capacity=3), []
    for success in (False, False, True, False, False, True):
        learner.add(picture(0), STATE, grasp(1), success, Phase.LEARNING)
        counts.append(learner.attempts_since_first_success)
    assert counts == [0, 0, 1, 2, 3, 4], "also when the first is no longer remembered"


# --- Updates -------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("attempts", "learns"), [(2, False), (3, True)])
def test_it_learns_once_there_are_enough_attempts(attempts: int, learns: bool, make_learner) -> None:
    learner = make_learner(attempts=attempts)
    before = weights(learner)
    learner.update_grasping(Phase.LEARNING)
    assert torch.equal(before, weights(learner)) != learns
    assert bool(learner.logs) == learns


@pytest.mark.parametrize(
    ("frozen", "phase", "learns"),
    [
        (False, Phase.LEARNING, True),
        (False, Phase.CURRICULUM, True),
        (True, Phase.LEARNING, False),
        (True, Phase.CURRICULUM, True),
    ],
)
def test_a_frozen_ensemble_learns_in_the_curriculum_only(frozen, phase, learns, make_learner) -> None:
    learner = make_learner(attempts=5, freeze_grasping=frozen)
    before = weights(learner)
    learner.update_grasping(phase)
    assert torch.equal(before, weights(learner)) != learns


@pytest.mark.parametrize("updates", [0, 1, 5])
def test_as_many_updates_follow_an_attempt_as_are_set(updates: int, make_learner) -> None:
    learner, counted = make_learner(attempts=5, updates=updates), []
    learner.optimizers["grasping"].register_step_post_hook(lambda *_: counted.append(1))
    learner.update_grasping(Phase.LEARNING)
    learner.update_navigation()
    assert len(counted) == updates


def test_an_update_is_a_step_down_the_loss_of_its_batch(make_learner) -> None:
    learner = make_learner(attempts=6, updates=1, learning_rate=1e-4)
    batch = *learner.attempts.sample(8, np.random.default_rng(0), CPU), torch.Generator().manual_seed(0)
    with torch.no_grad():
        before = learner._grasping.loss(*batch)[0].item()
    batch[-1].manual_seed(0)
    learner.update_grasping(Phase.LEARNING)
    with torch.no_grad():
        after = learner._grasping.loss(*batch)[0].item()
    assert learner.logs["grasp_loss"] == pytest.approx(before / 3, rel=1e-5)
    assert after < before


def test_equal_seeds_learn_the_same(make_learner) -> None:
    def learned(seed: int) -> torch.Tensor:
        learner = make_learner(attempts=10, seed=seed)
        for _ in range(2):
            learner.update_grasping(Phase.LEARNING)
        return weights(learner)

    assert torch.equal(learned(3), learned(3))
    assert not torch.equal(learned(3), learned(4))


# --- A toy world ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("seed", range(3))
def test_from_some_attempts_it_learns_what_can_be_picked_up(seed: int, make_learner, draw) -> None:
    """Something green can; floor and something blue cannot."""
    rng = np.random.default_rng(seed)
    learner = make_learner(seed=seed, channels=8, batch_size=32, learning_rate=3e-3, min_attempts_to_update=8)

    def scene(color: tuple[int, int, int]) -> tuple[NDArray[np.uint8], int]:
        cell = int(rng.integers(2, 13) * GRID + rng.integers(2, 13))
        return draw(cell_to_xy(cell), color=color), cell

    for number in range(40):
        image, cell = scene(((40, 220, 60), (60, 60, 230))[number % 2])
        tried = int(rng.integers(CELLS)) if number % 4 > 1 else cell
        near = np.linalg.norm(cell_to_xy(tried) - cell_to_xy(cell)) < 0.015
        learner.add(image, STATE, grasp(tried), bool(near and number % 2 == 0), Phase.LEARNING)
        learner.update_grasping(Phase.LEARNING)
    for _ in range(25):
        learner.update_grasping(Phase.LEARNING)
    ensemble = learner._grasping.eval()
    at_things, elsewhere = {"green": [], "blue": []}, []
    for _ in range(6):
        for name, color in (("green", (40, 220, 60)), ("blue", (60, 60, 230))):
            image, cell = scene(color)
            mean = ensemble.look(ensemble.to_pictures(image)).cells[0][0].numpy()
            at_things[name].append(mean[cell])
            away = np.linalg.norm(cell_to_xy(np.arange(CELLS)) - cell_to_xy(cell), axis=1) > 0.06
            elsewhere.append(mean[away].mean())
    assert np.mean(at_things["green"]) > 0.8
    assert np.mean(at_things["blue"]) < 0.2
    assert np.mean(elsewhere) < 0.2


def test_cells_of_actions_are_those_of_the_grid() -> None:
    assert [xy_to_cell(*grasp(cell)[3:].tolist()) for cell in range(CELLS)] == list(range(CELLS))
