"""The ways to record: practice without resets, where what is picked up is carried elsewhere, and cleaning rooms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relmm.features import ACTION_NAMES, Phase, Skill
from relmm.learning.actor import Actor
from relmm.learning.life import EpisodeResult, Life
from relmm.learning.progress import Progress
from relmm.learning.trainer import Trainer
from relmm.policies.learning import Learner, LearningPolicy


class Collector:
    """Runs a policy on a robot.

    Args:
        life: of the robot.
        actor: the policy.
        rng: of the pseudo-resets.
        pseudo_reset_steps: random navigation steps before and after the object is put down (20 in the authors' code).
    """

    def __init__(self, life: Life, actor: Actor, rng: np.random.Generator, pseudo_reset_steps: int) -> None:
        self._life, self._actor, self._rng, self._pseudo_reset_steps = life, actor, rng, pseudo_reset_steps

    def episode(self) -> EpisodeResult:
        """Run one episode; what a recorder raises comes through. The policy remembers what it saw in earlier ones."""
        ended = self._life.holding and self._pseudo_reset()
        while not ended:
            action = self._actor.act(self._life.observation)
            ended = self._life.step(action, Phase.LEARNING, self._actor.belief)
        return self._life.last_episode

    def _pseudo_reset(self) -> bool:
        """Whether the episode was cut off."""
        self._actor.watch(self._life.observation)
        for action in self._actor.pseudo_reset(self._rng, self._pseudo_reset_steps, lambda: self._life.holding):
            if self._life.step(action, Phase.PSEUDO_RESET, self._actor.belief):
                return True
            self._actor.watch(self._life.observation)
        return False


class Practice:
    """The paper's algorithms, with their curricula, where the learner is elsewhere: as `Trainer`, but for the updates.

    Args:
        life: of the robot.
        policy: to act by; others renew its weights.
        watcher: one of the life's recorders; counts what the autonomous curriculum depends on.
        progress: another; counts what the stationary curriculum depends on.
        options: more of them for `Trainer`.
    """

    def __init__(
        self, life: Life, policy: LearningPolicy, watcher: Watcher, progress: Progress, **options: Any
    ) -> None:
        self._life = life
        self._trainer = Trainer(life, policy, watcher, progress=progress, **options)

    def episode(self) -> EpisodeResult:
        """Go on until an episode has ended, or it is time to stop; what a recorder raises comes through."""
        ended = self._life.episodes_ended
        while self._life.episodes_ended == ended and not self._life.should_stop():
            if self._trainer.in_stationary_curriculum:
                self._trainer.stationary_attempt()
            else:
                self._trainer.navigation_step()
        return self._life.last_episode if self._life.episodes_ended > ended else EpisodeResult()


class Watcher(Learner):
    """Counts attempts as a learner does, and learns nothing."""

    def add(
        self,
        picture: NDArray[np.uint8],
        state: NDArray[np.float32],
        action: NDArray[np.float32],
        success: bool,
        phase: int,
    ) -> None:
        """See `Learner`."""
        if round(float(action[ACTION_NAMES.index("skill.pos")])) == Skill.GRASP:
            self.count_attempt(success)

    def save_episode(self) -> None:
        """See `Learner`."""

    def update_grasping(self, phase: int) -> None:
        """See `Learner`."""

    def update_navigation(self) -> None:
        """See `Learner`."""


class Cleaner:
    """Lets a policy clean one room after another: no pseudo-resets, and what is picked up goes where the policy says.

    Args:
        life: of the robot, with the number of objects that are to be collected.
        actor: the policy; it remembers nothing of the last room.
        set_up: makes the next room ready.
    """

    def __init__(self, life: Life, actor: Actor, set_up: Callable[[], None]) -> None:
        self._life, self._actor, self._set_up = life, actor, set_up

    def episode(self) -> EpisodeResult:
        """Clean one room; what a recorder raises comes through."""
        self._set_up()
        self._life.begin_anew()
        self._actor.reset()
        while not self._life.step(self._actor.act(self._life.observation), Phase.LEARNING, self._actor.belief):
            pass
        return self._life.last_episode
