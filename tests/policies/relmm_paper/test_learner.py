"""When a learner learns, from what, and that it does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from relmm.features import FRONT, MAX_THETA_VEL, STATE_NAMES, Phase, Skill, action_dict, cell_to_xy
from relmm.policies.controller import grasp_cell
from relmm.policies.relmm_paper.learner import RelmmPaperLearner
from relmm.policies.relmm_paper.replay import to_pictures

CPU = torch.device("cpu")
STATE = np.zeros(len(STATE_NAMES), np.float32)
MakeLearner = Callable[..., RelmmPaperLearner]


@dataclass
class Episode:
    images: NDArray[np.uint8]
    states: NDArray[np.float32]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float32]
    phases: NDArray[np.int64]


@pytest.fixture
def recorded(numbered, action_of) -> Callable[..., Episode]:
    def episode(kinds: str, phase: Phase = Phase.LEARNING) -> Episode:
        return Episode(
            np.stack([numbered(index) for index in range(len(kinds))]),
            np.tile(STATE, (len(kinds), 1)),
            np.stack([action_of(kind, index) for index, kind in enumerate(kinds)]),
            np.array([kind == "s" for kind in kinds], np.float32),
            np.array([Phase.PSEUDO_RESET if kind == "r" else phase for kind in kinds]),
        )

    return episode


def weights(module: torch.nn.Module) -> list[torch.Tensor]:
    return [weight.detach().clone() for weight in module.parameters()]


def same(first: list[torch.Tensor], second: list[torch.Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


# --- When it learns ------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("attempts", "updates"), [(2, 0), (3, 5), (4, 5)])
def test_ensemble_waits_for_n_bt_attempts(attempts: int, updates: int, make_learner, count_steps) -> None:
    learner = make_learner("f" * attempts, grasp_updates=5)
    counts = count_steps(learner)
    learner.update_grasping(Phase.LEARNING)
    assert counts == {"grasping": updates, "navigation": 0}
    assert set(learner.logs) == ({"grasp_loss"} if updates else set())


@pytest.mark.parametrize(("steps", "updates"), [(2, 0), (3, 4), (6, 4)])
def test_navigation_waits_for_enough_steps(steps: int, updates: int, make_learner, count_steps) -> None:
    learner = make_learner("d" * (steps + 1), navigation_updates=4)
    counts = count_steps(learner)
    learner.update_navigation()
    assert counts == {"grasping": 0, "navigation": updates}


def test_pseudo_resets_teach_nothing(make_learner, count_steps) -> None:
    learner = make_learner("rrrrrrrr")
    counts = count_steps(learner)
    learner.update_navigation()
    assert counts["navigation"] == 0


@pytest.mark.parametrize("life", ["dddd ffffffffffff", "ffff dddddddddddd"])
def test_much_of_one_kind_pushes_out_nothing_of_the_other(life: str, make_learner, count_steps) -> None:
    """A long curriculum without a drive, or a long search without an attempt."""
    learner = make_learner(life, capacity=8)
    counts = count_steps(learner)
    learner.update_grasping(Phase.LEARNING)
    learner.update_navigation()
    assert counts == {"grasping": 1, "navigation": 1}


@pytest.mark.parametrize(
    ("phase", "frozen", "updates"),
    [(Phase.LEARNING, True, 0), (Phase.CURRICULUM, True, 1), (Phase.LEARNING, False, 1)],
)
def test_frozen_ensemble_learns_in_the_curriculum_only(phase, frozen, updates, make_learner, count_steps) -> None:
    learner = make_learner("ffff", freeze_grasping=frozen)
    counts = count_steps(learner)
    learner.update_grasping(phase)
    assert counts["grasping"] == updates


@pytest.mark.parametrize(("update", "grasps", "drives"), [(True, 3 * 3, 1 * 2), (False, 0, 0)])
def test_recorded_frames_teach_as_if_they_had_just_happened(
    update: bool, grasps: int, drives: int, make_learner, recorded, count_steps
) -> None:
    """The last three of five attempts and the last of four drives find enough to learn from."""
    learner = make_learner(grasp_updates=3, navigation_updates=2)
    counts = count_steps(learner)
    learner.read(recorded("rrdfdfdfdfs"), update=update)
    assert len(learner.replay.attempts) == 5
    assert counts == {"grasping": grasps, "navigation": drives}


def test_random_navigation_has_nothing_to_learn(make_learner, count_steps) -> None:
    learner = make_learner("dddddf", navigation="random", min_attempts_to_update=1)
    counts = count_steps(learner)
    learner.update_grasping(Phase.LEARNING)
    learner.update_navigation()
    assert counts == {"grasping": 1, "navigation": 0}


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


def test_policy_is_told_what_there_was_to_learn_from(make_learner, live) -> None:
    learner = make_learner("rrdfdfs dd")
    seen = learner.policy.attempts_seen, learner.policy.steps_seen
    assert seen == (3, 4)
    seen[0].fill_(5)  # it had learned from others before
    live(learner, "df")
    assert seen == (5, 5)
    assert learner.attempts_since_first_success == 2


# --- Batches -------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("relabel", [False, True])
def test_navigation_batch_is_that_of_its_frames(relabel: bool, make_learner, numbered) -> None:
    policy = (learner := make_learner("dfdfs dfdss rrddd", relabel=relabel)).policy
    batch = learner.navigation_batch(np.arange(5))
    steps = [(0, 2, False), (2, 4, True), (5, 7, False), (7, 8, True), (12, 13, False)]
    assert len(learner.replay.steps) >= len(steps)
    for row, (frame, after, success) in enumerate(steps):
        pictures = to_pictures(np.stack([numbered(frame), numbered(after)]), CPU)
        chance = policy.grasping.grasp_probability(policy.grasping.estimate(pictures))[1].item()
        assert torch.equal(batch.pictures[row], pictures[0])
        assert torch.equal(batch.next_pictures[row], pictures[1])
        assert batch.rewards[row].item() == pytest.approx(0 if success else chance * relabel - 1, abs=1e-5)
        assert batch.continues[row] == (not success)
        assert batch.actions[row].tolist() == pytest.approx([2 * frame / 1000 - 1, frame / 1000], abs=1e-6)


def test_frames_are_taken_as_recorders_take_them(make_learner, numbered) -> None:
    learner = make_learner()
    drive = action_dict(x_vel=0.1, theta_vel=-MAX_THETA_VEL / 2)
    for number, (action, reward) in enumerate([(drive, 0.0), (grasp_cell(17), 1.0)]):
        outcome = {"next.reward": reward, "complementary_info.phase": int(Phase.LEARNING)}
        learner.add_frame({FRONT: numbered(number), **dict.fromkeys(STATE_NAMES, 0.0)}, action, outcome, "task")
    learner.save_episode()
    replay = learner.replay
    names = ("x_vel", "theta_vel", "ended")
    assert [replay.steps.table[name].item() for name in names] == pytest.approx([0.1, -MAX_THETA_VEL / 2, True])
    assert [replay.attempts[name].item() for name in "xy"] == pytest.approx(cell_to_xy(17).tolist())
    pictures = [replay.steps.pictures[replay.steps.table[name]] for name in ("picture", "next")]
    pictures.append(replay.attempt_pictures[replay.attempts["picture"]])
    assert all(np.array_equal(kept[0], numbered(n)) for kept, n in zip(pictures, (0, 1, 1), strict=True))


# --- It learns -----------------------------------------------------------------------------------------------
def test_ensemble_learns_to_grasp_what_is_coloured(make_policy) -> None:
    """A blob lies at one of nine cells; an attempt there succeeds. Chance hits 11 %."""
    settings = {"num_members": 2, "grasp_channels": 8, "grasp_learning_rate": 1e-3, "grasp_batch_size": 32}
    policy = make_policy(**settings, min_attempts_to_update=1, seed=0)
    rng, learner = np.random.default_rng(0), policy.make_learner(seed=0, capacity=400)
    cells = [15 * row + column for row in (2, 7, 12) for column in (2, 7, 12)]

    def scene(place: int) -> NDArray[np.uint8]:
        image = rng.integers(60, 110, (100, 100, 3), np.uint8)
        row, column = 88 - 8 * (place // 3), 58 - 8 * (place % 3)
        image[row - 2 : row + 3, column - 2 : column + 3] = (0, 255, 0)
        return image

    for _ in range(400):
        place, tried = rng.integers(9, size=2).tolist()
        tried = place if rng.random() < 0.3 else tried
        action = np.array(list(grasp_cell(cells[tried]).values()), np.float32)
        learner.add(scene(place), STATE, action, tried == place, Phase.LEARNING)
    for _ in range(150):
        learner.update_grasping(Phase.LEARNING)
    places = rng.integers(9, size=60).tolist()
    estimate = policy.grasping.estimate(to_pictures(np.stack([scene(place) for place in places]), CPU))
    chosen = [cells[index] for index in estimate.mean[:, cells].argmax(dim=1).tolist()]
    assert np.mean([cells[place] == cell for place, cell in zip(places, chosen, strict=True)]) > 0.8
    assert policy.grasping.grasp_probability(estimate).mean() > 0.6


def test_navigation_learns_to_which_side_to_turn(make_policy) -> None:
    """A step succeeds if it turns left where the picture is red, right where it is blue; chance turns by 0."""
    settings = {"navigation_hidden": 128, "navigation_learning_rate": 1e-3, "navigation_batch_size": 16, "gamma": 0.1}
    policy = make_policy(**settings, min_steps_to_update=1, initial_temperature=0.01, relabel=False, seed=0)
    rng, learner = np.random.default_rng(0), policy.make_learner(seed=0, capacity=600)

    def scene(side: int) -> NDArray[np.uint8]:
        image = rng.integers(0, 60, (100, 100, 3), np.uint8)
        image[..., 0 if side > 0 else 2] += np.uint8(180)
        return image

    for _ in range(300):
        side, turn = rng.choice([-1, 1]), rng.uniform(-1, 1)
        drive = action_dict(x_vel=rng.uniform(0, 0.4), theta_vel=turn * MAX_THETA_VEL)
        learner.add(scene(side), STATE, np.array(list(drive.values()), np.float32), False, Phase.LEARNING)
        grasp = np.array(list(action_dict(Skill.GRASP).values()), np.float32)
        learner.add(scene(side), STATE, grasp, side * turn > 0, Phase.LEARNING)
        learner.save_episode()
    for _ in range(50):
        learner.update_navigation()
    sides = np.array([1, -1] * 10)
    turns = policy.navigation.act(to_pictures(np.stack([scene(side) for side in sides]), CPU), None)[:, 1].numpy()
    assert np.mean(turns * sides) > 0.25
