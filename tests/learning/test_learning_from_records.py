"""What a learner makes of recorded episodes and of LeRobot's batches, and that it learns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_pre_post_processors
from numpy.typing import NDArray
from torch.utils.data import default_collate

import relmm.plugin  # noqa: F401
from relmm.features import FPS, GRID, IMAGE_KEY, STATE_KEY, Phase, cell_to_xy
from relmm.geometry import CAMERAS
from relmm.learning.learner import Learner
from relmm.learning.replay import Replay, to_pictures
from relmm.policies.controller import grasp_cell
from relmm.policies.relmm.floor import OBJECT_HEIGHT
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy

RECORDED = Path(__file__).parents[2] / "datasets" / "diverse_scripted"


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
            np.array([action_of(kind, index) for index, kind in enumerate(kinds)], np.float32),
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
