from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_pre_post_processors
from numpy.typing import NDArray
from torch.utils.data import default_collate

import relmm.plugin  # noqa: F401
from relmm.features import FPS, GRID, IMAGE_KEY, STATE_KEY, Phase, Skill, cell_to_xy
from relmm.geometry import CAMERAS
from relmm.learning.learner import Learner
from relmm.learning.replay import Replay, to_pictures
from relmm.policies.controller import grasp_cell
from relmm.policies.relmm.batch import last_sides
from relmm.policies.relmm.floor import OBJECT_HEIGHT
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy

SKILLS = {"d": Skill.NAVIGATE, "r": Skill.NAVIGATE, "f": Skill.GRASP, "s": Skill.GRASP, "p": Skill.PLACE}
SMALL = {"grasp_batch_size": 8, "navigation_batch_size": 8, "min_attempts_to_update": 3, "min_steps_to_update": 3}

RECORDED = Path(__file__).parents[2] / "datasets" / "diverse_scripted"

MakeLearner = Callable[..., Learner]


@pytest.fixture
def make_learner(make_policy, numbered, motion_of, action_of) -> MakeLearner:
    """A learner of a life: episodes of drives (d, r in pseudo-resets), attempts (f, s) and placements (p)."""

    def make(life: str = "", capacity: int = 200, seed: int = 0, **settings: Any) -> Learner:
        replay = Replay(capacity)
        for episode in life.split():
            for kind in episode:
                phase = Phase.PSEUDO_RESET if kind == "r" else Phase.LEARNING
                number = replay.frames
                replay.add(numbered(number), motion_of(number), action_of(SKILLS[kind], number), kind == "s", phase)
            replay.save_episode()
        return Learner(make_policy(**{**SMALL, **settings}), replay, seed)

    return make


@pytest.fixture
def count_steps() -> Callable[[Learner], dict[str, int]]:
    """Counts the steps of a learner's optimisers from now on."""

    def counted(learner: Learner) -> dict[str, int]:
        counts = dict.fromkeys(learner.optimizers, 0)

        def count(name: str) -> Callable[..., None]:
            def hook(*_: Any) -> None:
                counts[name] += 1

            return hook

        for name, optimizer in learner.optimizers.items():
            optimizer.register_step_post_hook(count(name))
        return counts

    return counted


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


# --- Recorded episodes ---------------------------------------------------------------------------------------
@dataclass
class Episode:
    images: NDArray[np.uint8]
    states: NDArray[np.float32]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float32]
    phases: NDArray[np.int64]


@pytest.fixture
def recorded(numbered, motion_of, action_of) -> Callable[[str], Episode]:
    def episode(kinds: str, phase: Phase = Phase.LEARNING) -> Episode:
        phases = [Phase.PSEUDO_RESET if kind == "r" else phase for kind in kinds]
        return Episode(
            np.stack([numbered(index) for index in range(len(kinds))]),
            np.array([[*motion_of(index), *[0.0] * 8] for index in range(len(kinds))], np.float32),
            np.array([action_of(SKILLS[kind], index) for index, kind in enumerate(kinds)], np.float32),
            np.array([kind == "s" for kind in kinds], np.float32),
            np.array(phases),
        )

    return episode


def test_recorded_episode_fills_the_replay_as_living_it_does(make_learner, recorded) -> None:
    learner, lived = make_learner(), make_learner("rrdfdfs")
    learner.read(recorded("rrdfdfs"), update=False)
    for table in ("attempts", "steps", "pseudo_reset_steps"):
        read, wanted = (getattr(each.replay, table) for each in (learner, lived))
        assert len(read) == len(wanted) > 0
        rows = np.arange(len(read))
        for name, column in read.rows(rows).items():
            assert column == pytest.approx(wanted.rows(rows)[name], abs=1e-6)
    frames = np.arange(7)
    assert learner.replay.motions(frames) == pytest.approx(lived.replay.motions(frames), abs=1e-6)
    assert (learner.replay.frames, learner.replay.episodes) == (7, 1)
    assert learner.logs == {}


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


def test_frozen_ensemble_learns_from_recorded_curricula_only(make_learner, recorded, count_steps) -> None:
    """As the trainer does."""
    learner = make_learner(freeze_grasping=True, grasp_updates=1)
    counts = count_steps(learner)
    learner.read(recorded("dfffd", Phase.LEARNING), update=True)
    assert counts["grasping"] == 0


def test_stock_training_computes_the_losses_of_learning_online(make_policy) -> None:
    """LeRobot's dataset, batches and preprocessor against the replay."""
    alone = {
        "return_steps": 1,
        "background_weight": 0.0,
        "conservative_weight": 0.0,
        "mirror": False,
        "recolour": False,
        "tidied_share": 0.0,
    }
    policy = make_policy(refreshed_maps=0, **alone, seed=2)
    deltas = [delta / FPS for delta in policy.config.observation_delta_indices]
    columns = {IMAGE_KEY: deltas, STATE_KEY: deltas}
    columns["action"] = [delta / FPS for delta in policy.config.action_delta_indices]
    frames = list(LeRobotDataset("local/diverse", root=RECORDED, delta_timestamps=columns, episodes=[0, 1, 2]))
    learner, episode = Learner(policy, Replay(len(frames)), seed=0), 0
    for frame in frames:
        if frame["episode_index"] != episode:
            learner.replay.save_episode()
        episode = frame["episode_index"]
        picture = (frame[IMAGE_KEY][0] * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()
        success = bool(frame["next.reward"] > 0)
        motion = frame[STATE_KEY][0, :2].tolist()
        learner.replay.add(picture, motion, frame["action"][0], success, Phase.LEARNING)
    learner.replay.save_episode()
    policy.eval()

    batch = make_pre_post_processors(policy.config)[0](default_collate(frames))
    torch.manual_seed(3)
    loss, logs = policy.forward(batch)

    replay = learner.replay
    steps = learner.navigation_batch(replay.chains(replay.steps, np.arange(len(replay.steps)), 1, 1))
    assert set(steps.sides.tolist()) == {-1, 1}
    torch.manual_seed(3)
    navigation_loss, wanted = policy.navigation.loss(steps, torch.randn(2, len(replay.steps), 2))
    pictures = to_pictures(replay.pictures(replay.attempts["frame"]), torch.device("cpu"))
    cells, successes = (torch.from_numpy(replay.attempts[name]) for name in ("cell", "success"))
    grasp_loss = policy.grasping.loss(pictures, cells, successes)
    assert successes.any()
    assert len(replay.steps) > 20
    assert logs == pytest.approx({"grasp_loss": grasp_loss.item() / policy.config.num_members, **wanted}, rel=1e-3)
    assert loss.item() == pytest.approx((grasp_loss + navigation_loss).item(), rel=1e-3)


# --- It learns -----------------------------------------------------------------------------------------------
def scene(rng: np.random.Generator, cell: int) -> NDArray[np.uint8]:
    """A noisy floor with a bright thing in a grasp cell."""
    image = rng.integers(60, 110, (100, 100, 3), np.uint8)
    column, row = CAMERAS["paper"].project(np.array([*cell_to_xy(cell), OBJECT_HEIGHT])).round().astype(int)
    image[row - 1 : row + 2, column - 1 : column + 2] = 255
    return image


def distance(first: int, second: int) -> int:
    """Between two cells, in cells."""
    return max(abs(first // GRID - second // GRID), abs(first % GRID - second % GRID))


def test_ensemble_learns_to_grasp_what_is_bright(make_policy) -> None:
    """Attempts within a cell of the thing succeed; chance hits 4 %."""
    policy: ReLMMPolicy = make_policy(grasp_channels=8, grasp_updates=1, grasp_learning_rate=3e-3, seed=0)
    rng, learner = np.random.default_rng(0), Learner(policy, Replay(300), seed=0)
    for _ in range(300):
        cell = int(rng.integers(GRID**2))
        attempt = int(rng.integers(GRID**2)) if rng.random() < 0.7 else cell
        action = list(grasp_cell(attempt).values())
        learner.replay.add(scene(rng, cell), (0.0, 0.0), action, distance(cell, attempt) <= 1, Phase.LEARNING)
    losses = []
    for _ in range(150):
        learner.update_grasping(Phase.LEARNING)
        losses.append(learner.logs["grasp_loss"])
    policy.eval()
    cells = rng.integers(GRID**2, size=60).tolist()
    pictures = to_pictures(np.stack([scene(rng, cell) for cell in cells]), torch.device("cpu"))
    estimate = policy.grasping.estimate(pictures)
    chosen = estimate.mean.argmax(dim=1).tolist()
    assert np.mean(losses[-20:]) < 0.5 * np.mean(losses[:5])
    assert np.mean([distance(*pair) <= 1 for pair in zip(cells, chosen, strict=True)]) > 0.8
    assert policy.grasping.grasp_probability(estimate).mean() > 0.7
