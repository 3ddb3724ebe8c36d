"""What the policies that learn online share: settings of the curricula, and what a trainer asks of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from relmm.errors import MANY, ConfigError, check_range
from relmm.features import ACTION_NAMES, FRONT, STATE_NAMES, Phase, Skill
from relmm.geometry import camera_geometry
from relmm.policies.controller import ControllerConfig, ControllerPolicy, Row

_SKILL = ACTION_NAMES.index("skill.pos")


@dataclass
class LearningConfig(ControllerConfig):
    """Settings of every policy that learns online.

    Args:
        camera: geometry of the camera that takes the pictures.
        sample: act as while training (sampled cells, P[grasp] as a probability) instead of greedily.
        num_stationary: attempts of the stationary curriculum (N_st of the paper).
        min_attempts_to_update: attempts stored before the first update (N_bt).
        num_start: failures in a row that end a practice session of the autonomous curriculum without a success
            (N_start).
        num_stop: failures since the last success that end one with a success (N_stop).
        num_max: attempts, from the first success on, after which the autonomous curriculum ends (N_max).
    """

    camera: str = "paper"
    sample: bool = False
    num_stationary: int = 2000
    min_attempts_to_update: int = 50
    num_start: int = 2
    num_stop: int = 20
    num_max: int = 400

    # The range of each number, low and high, both allowed; subclasses add their own.
    ranges: ClassVar[dict[str, tuple[float, float]]] = {
        "num_stationary": (1, MANY),
        "min_attempts_to_update": (1, MANY),
        "num_start": (1, MANY),
        "num_stop": (1, MANY),
        "num_max": (1, MANY),
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        camera_geometry(self.camera)
        for name, (low, high) in self.ranges.items():
            check_range(f"policy.{name}", getattr(self, name), low, high)

    @abstractmethod
    def fingerprint(self) -> dict[str, Any]:
        """What a checkpoint must share with a run that goes on from it: the shapes of the networks."""


class RecordedEpisode(Protocol):
    """What `relmm.episodes` reads: a row a frame."""

    @property
    def images(self) -> NDArray[np.uint8]:
        """(n, 100, 100, 3)."""

    @property
    def states(self) -> NDArray[np.float32]:
        """By `relmm.features.STATE_NAMES`, (n, len(STATE_NAMES))."""

    @property
    def actions(self) -> NDArray[np.float32]:
        """(n, 5)."""

    @property
    def rewards(self) -> NDArray[np.float32]:
        """(n,)."""

    @property
    def phases(self) -> NDArray[np.int64]:
        """(n,)."""


class Learner(ABC):
    """Takes the frames of a robot's life, and trains a policy on them.

    It takes frames as the durable dataset does (`add_frame`, `save_episode`), and what it knows can be rebuilt from
    that dataset at any time, so a checkpoint holds optimisers and random states only.

    Attributes:
        optimizers: by module.
        rng: of the batches.
        noise: the same, for torch.
        logs: of the last updates, for the metrics.
        attempts_since_first_success: attempts from the first that succeeded on, 0 if none has.
    """

    optimizers: dict[str, torch.optim.Optimizer]
    rng: np.random.Generator
    noise: torch.Generator
    logs: dict[str, float]
    attempts_since_first_success: int = 0

    def count_attempt(self, success: bool) -> None:
        """Count an attempt; `add` calls this for each."""
        if success or self.attempts_since_first_success:
            self.attempts_since_first_success += 1

    @abstractmethod
    def add(
        self,
        picture: NDArray[np.uint8],
        state: NDArray[np.float32],
        action: NDArray[np.float32],
        success: bool,
        phase: int,
    ) -> None:
        """Take one frame.

        Args:
            picture: before the action, (100, 100, 3).
            state: likewise, by `relmm.features.STATE_NAMES`.
            action: what was done, by `relmm.features.ACTION_NAMES`.
            success: whether this frame's attempt picked something up.
            phase: a `relmm.features.Phase`.
        """

    @abstractmethod
    def save_episode(self) -> None:
        """End the episode: what comes next need not follow on."""

    def cut_episode(self) -> None:
        """End it before it is done."""
        self.save_episode()

    @abstractmethod
    def update_grasping(self, phase: int) -> None:
        """The updates that follow an attempt in a phase, if there are enough attempts to learn from."""

    @abstractmethod
    def update_navigation(self) -> None:
        """The updates that follow a navigation step of the policy, if there are enough of them to learn from."""

    def update_pseudo_reset(self) -> None:  # noqa: B027  (most learn nothing from it)
        """The updates that follow a navigation step of a pseudo-reset; none where these do not learn."""

    def add_frame(
        self, observation: dict[str, Any], action: dict[str, float], outcome: dict[str, Any], task: str
    ) -> None:
        """Take one frame, as `relmm.episodes.EpisodeRecorder.add_frame` does."""
        state = np.array([observation[name] for name in STATE_NAMES], np.float32)
        values = np.array([action[name] for name in ACTION_NAMES], np.float32)
        self.add(
            observation[FRONT], state, values, outcome["next.reward"] > 0, int(outcome["complementary_info.phase"])
        )

    def read(self, episode: RecordedEpisode, update: bool) -> None:
        """Take a recorded episode; with `update`, learn from each frame as if it had just happened."""
        columns = (episode.images, episode.states, episode.actions, episode.rewards, episode.phases)
        for picture, state, action, reward, phase in zip(*columns, strict=True):
            self.add(picture, state, action, bool(reward > 0), int(phase))
            match Skill(round(float(action[_SKILL]))) if update else None:
                case Skill.GRASP:
                    self.update_grasping(int(phase))
                case Skill.NAVIGATE if phase == Phase.LEARNING:
                    self.update_navigation()
                case Skill.NAVIGATE if phase == Phase.PSEUDO_RESET:
                    self.update_pseudo_reset()
        self.save_episode()


def no_rewards() -> ConfigError:
    """What to say of batches that tell nothing of how grasps ended."""
    return ConfigError(
        "The dataset has no column next.reward, nor observation.state and frame numbers to tell how grasps ended: "
        "record one with relmm-record, or with lerobot-record and --robot.type=locobot_sim."
    )


class LearningPolicy(ControllerPolicy):
    """A policy that a trainer can train.

    A trainer calls `observe` with every observation once, and then at most one of `decide`, `attempt` and `navigate`.

    Attributes:
        sampling: whether it acts as while training; `config.sample` at first.
    """

    config: LearningConfig
    sampling: bool

    @abstractmethod
    def attempt(self, row: Row) -> dict[str, float]:
        """A grasp where the robot stands, whether it promises success or not (a curriculum asks for it)."""

    @abstractmethod
    def navigate(self, row: Row) -> dict[str, float]:
        """A navigation step, whether a grasp here promises success or not."""

    @abstractmethod
    def make_learner(self, seed: int, capacity: int) -> Learner:
        """What trains this policy.

        Args:
            seed: of its batches.
            capacity: how much of each kind of thing to learn from is kept in memory.
        """
