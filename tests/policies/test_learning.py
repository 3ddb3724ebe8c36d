"""What the policies that learn online share: settings, and learners that take a life live or from its dataset."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lerobot.configs.policies import PreTrainedConfig

from relmm.errors import ConfigError
from relmm.features import ACTION_NAMES, FRONT, STATE_NAMES, Phase, Skill
from relmm.policies.controller import grasp_cell
from relmm.policies.learning import Learner, LearningConfig, LearningPolicy

SMALL: dict[str, dict[str, Any]] = {
    "relmm": {"num_members": 2, "channels": 4, "batch_size": 8, "min_attempts_to_update": 3},
    "relmm_paper": {
        "num_members": 2,
        "grasp_channels": 4,
        "navigation_encoder": "paper_small",
        "navigation_hidden": 8,
        "grasp_batch_size": 8,
        "navigation_batch_size": 8,
        "min_attempts_to_update": 3,
        "min_steps_to_update": 3,
    },
}
# Episodes of drives (d), drives of pseudo-resets (r), attempts that fail (f) or do not (s), likewise of a curriculum (F
# and S), and placements (p).
LIFE = ("FFS", "pdfdds", "rrprddff", "dfs")
SKILLS = {"d": Skill.NAVIGATE, "r": Skill.NAVIGATE, "p": Skill.PLACE}

kinds = pytest.mark.parametrize("kind", SMALL)


def config_class(kind: str) -> type[LearningConfig]:
    return PreTrainedConfig.get_choice_class(kind)


def phase_of(letter: str) -> Phase:
    if letter in "FS":
        return Phase.CURRICULUM
    return Phase.PSEUDO_RESET if letter in "rp" else Phase.LEARNING


def frames(episode: str, seed: int) -> SimpleNamespace:
    """The columns of a recorded episode."""
    rng = np.random.default_rng(seed)
    actions = np.zeros((len(episode), len(ACTION_NAMES)), np.float32)
    actions[:, 0], actions[:, 1] = rng.uniform(0, 0.4, len(episode)), rng.uniform(-100, 100, len(episode))
    for action, letter in zip(actions, episode, strict=True):
        action[2] = SKILLS.get(letter, Skill.GRASP)
        action[3:] = list(grasp_cell(int(rng.integers(225))).values())[3:]
    return SimpleNamespace(
        images=rng.integers(0, 256, (len(episode), 100, 100, 3), np.uint8),
        states=rng.uniform(0, 1, (len(episode), len(STATE_NAMES))).astype(np.float32),
        actions=actions,
        rewards=np.array([letter in "sS" for letter in episode], np.float32),
        phases=np.array([phase_of(letter) for letter in episode]),
    )


def live(learner: Learner, episode: SimpleNamespace) -> None:
    """Take an episode frame by frame, and learn as a trainer does."""
    for image, state, action, reward, phase in zip(*vars(episode).values(), strict=True):
        observation = {**dict(zip(STATE_NAMES, state.tolist(), strict=True)), FRONT: image}
        outcome = {"next.reward": float(reward), "complementary_info.phase": int(phase)}
        learner.add_frame(observation, dict(zip(ACTION_NAMES, action.tolist(), strict=True)), outcome, "task")
        if action[2] == Skill.GRASP:
            learner.update_grasping(int(phase))
        elif action[2] == Skill.NAVIGATE and phase == Phase.LEARNING:
            learner.update_navigation()
    learner.save_episode()


@pytest.fixture
def make_policy(make_controller: Any) -> Any:
    def make(kind: str, **settings: Any) -> LearningPolicy:
        policy = make_controller(kind, **{**SMALL[kind], **settings})
        policy.train()
        return policy

    return make


# --- Settings ------------------------------------------------------------------------------------------------
@kinds
def test_all_numbers_have_a_range_and_nothing_beyond_it_is_taken(kind: str) -> None:
    config = config_class(kind)
    assert set(LearningConfig.ranges) <= set(config.ranges)
    for name, (low, high) in config.ranges.items():
        for good in {low, high} - {math.inf}:
            assert getattr(config(device="cpu", **{name: good}), name) == good
        for bad in (low - 1, high + 1, math.inf, math.nan):
            with pytest.raises(ConfigError, match=f"policy.{name} is {bad}, but must be at least"):
                config(device="cpu", **{name: bad})


@kinds
def test_a_camera_that_nobody_has_is_refused(kind: str) -> None:
    with pytest.raises(ConfigError, match="choose one of paper, d435"):
        config_class(kind)(device="cpu", camera="fisheye")


@kinds
def test_the_fingerprint_tells_the_networks_of_one_config_from_those_of_another(kind: str, make_policy: Any) -> None:
    def shapes(policy: LearningPolicy) -> dict[str, Any]:
        return {name: weight.shape for name, weight in policy.state_dict().items()}

    first, members = make_policy(kind), make_policy(kind, num_members=3)
    assert make_policy(kind, num_max=7).config.fingerprint() == first.config.fingerprint()
    assert members.config.fingerprint() != first.config.fingerprint()
    assert shapes(members) != shapes(first)
    other_camera = config_class(kind)(device="cpu", camera="d435", **SMALL[kind])
    assert other_camera.fingerprint() != first.config.fingerprint()


# --- Learners ------------------------------------------------------------------------------------------------
@kinds
@pytest.mark.parametrize(("life", "count"), [("dff", 0), ("fsf", 2), ("sffs", 4), ("", 0)])
def test_attempts_are_counted_from_the_first_success_on(life: str, count: int, kind: str, make_policy: Any) -> None:
    learner = make_policy(kind, seed=1).make_learner(seed=2, capacity=100)
    live(learner, frames(life, 0))
    assert learner.attempts_since_first_success == count


@kinds
def test_reading_a_recorded_life_teaches_what_living_it_did(kind: str, make_policy: Any) -> None:
    lived, read, unlearned = (make_policy(kind, seed=1) for _ in range(3))
    learners = [policy.make_learner(seed=2, capacity=100) for policy in (lived, read, unlearned)]
    for number, letters in enumerate(LIFE):
        episode = frames(letters, number)
        live(learners[0], episode)
        learners[1].read(episode, update=True)
        learners[2].read(episode, update=False)
    for name, weight in lived.state_dict().items():
        assert np.array_equal(weight, read.state_dict()[name]), name
    weights = dict(lived.named_parameters())
    fresh = dict(unlearned.named_parameters())
    assert any(not np.array_equal(weights[name].detach(), fresh[name].detach()) for name in weights)
    assert [learner.attempts_since_first_success for learner in learners] == [7, 7, 7]
    # What was only read is there to learn from later.
    for learner in learners:
        learner.rng = np.random.default_rng(5)
    unlearned.load_state_dict(lived.state_dict())
    losses = []
    for learner in learners:
        learner.logs = {}
        learner.update_grasping(Phase.LEARNING)
        losses.append(learner.logs["grasp_loss"])
    assert losses[0] == losses[1]
    assert losses[2] > 0


class Notes(Learner):
    """A learner that notes what it is asked."""

    def __init__(self) -> None:
        self.notes: list[Any] = []

    def add(self, picture: Any, state: Any, action: Any, success: bool, phase: int) -> None:
        self.notes.append(("add", int(picture[0, 0, 0]), float(state[0]), float(action[0]), success, phase))

    def save_episode(self) -> None:
        self.notes.append("save")

    def update_grasping(self, phase: int) -> None:
        self.notes.append(("grasping", phase))

    def update_navigation(self) -> None:
        self.notes.append("navigation")


@pytest.mark.parametrize("letters", LIFE)
@pytest.mark.parametrize("update", [True, False])
def test_what_is_read_is_learned_as_if_it_had_just_happened(letters: str, update: bool) -> None:
    episode, learner, wanted = frames(letters, 0), Notes(), []
    for number, letter in enumerate(letters):
        values = (episode.images[number, 0, 0, 0], float(episode.states[number, 0]), float(episode.actions[number, 0]))
        wanted.append(("add", *values, letter in "sS", phase_of(letter)))
        if update and letter in "fsFS":
            wanted.append(("grasping", phase_of(letter)))
        elif update and letter == "d":
            wanted.append("navigation")
    learner.read(episode, update)
    assert learner.notes == [*wanted, "save"]


def test_a_frame_of_the_robot_is_taken_as_the_dataset_keeps_it() -> None:
    read, lived = Notes(), Notes()
    for letters in LIFE:
        episode = frames(letters, 1)
        read.read(episode, update=True)
        live(lived, episode)
    assert lived.notes == read.notes
