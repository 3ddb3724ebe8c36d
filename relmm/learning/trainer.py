"""ReLMM online: the paper's Algorithms 1 to 4 as loops over a robot's life."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from relmm.features import FRONT, Phase, Skill, action_dict
from relmm.learning.actor import state_vector
from relmm.learning.curriculum import AutonomousCurriculum
from relmm.learning.life import Life
from relmm.learning.progress import Progress
from relmm.policies.controller import Row
from relmm.policies.learning import Learner, LearningPolicy

# Where a curriculum puts an object down again: inside the grasp area by the width of an object.
_DROP_X, _DROP_Y = (0.315, 0.45), (-0.065, 0.065)  # m


class Trainer:
    """Trains a policy on a robot.

    Args:
        life: of the robot; its recorders must feed the learner.
        policy: to train.
        learner: updates it.
        curriculum: `stationary`, `autonomous` or `none`.
        pseudo_reset_steps: navigation steps of a pseudo-reset before and after an object is put down.
        rng: of the policy's choices, and of where a curriculum drops what it holds.
        put_in_reach: the person of the stationary curriculum: makes sure that an object lies in the grasp area; returns
            whether something had to be done.
        progress: counts the frames of the run; also one of the life's recorders.
        tidy: lays what is stuck elsewhere; returns how many objects.
        tidy_every: navigation steps after which that is done; 0 for never.
        person: what a person who has taken over wants to do next; None if nobody has. Asked after every frame, it waits
            for them.
    """

    def __init__(
        self,
        life: Life,
        policy: LearningPolicy,
        learner: Learner,
        *,
        curriculum: str,
        pseudo_reset_steps: int,
        rng: np.random.Generator,
        put_in_reach: Callable[[], bool],
        progress: Progress,
        tidy: Callable[[], int] = lambda: 0,
        tidy_every: int = 0,
        person: Callable[[], dict[str, float] | None] = lambda: None,
    ) -> None:
        config = policy.config
        self.life, self.policy, self.learner, self.config = life, policy, learner, config
        self.progress, self._row = progress, Row(rng)
        self._put_in_reach, self._pseudo_reset_steps = put_in_reach, pseudo_reset_steps
        self._tidy, self._tidy_every, self._person = tidy, tidy_every, person
        self._stationary = curriculum == "stationary"
        num_max = config.num_max if curriculum == "autonomous" else 0
        self._autonomous = AutonomousCurriculum(config.num_start, config.num_stop, num_max)
        policy.sampling = True
        self._observe()

    # --- Algorithm 1, stationary --------------------------------------------------------------------------
    @property
    def in_stationary_curriculum(self) -> bool:
        """Whether stationary attempts are still to be made."""
        return self._stationary and self.progress.practice_attempts < self.config.num_stationary

    def stationary_attempt(self) -> None:
        """One turn of TrainGrasp(N_st, True): drop what is held, attempt, learn."""
        if self.life.holding and not self._drop():
            return  # another place, the next time
        if self._put_in_reach():
            self.progress.interventions += 1
            self._look_again()
        self._attempt(self.policy.attempt(self._row), Phase.CURRICULUM)
        if not self.in_stationary_curriculum and self.life.holding:
            self._pseudo_reset()

    # --- Algorithms 2 and 4 -------------------------------------------------------------------------------
    def navigation_step(self) -> None:
        """One turn of the loop: perhaps grasp, with a pseudo-reset after a success; else navigate, and learn."""
        if self.life.holding:  # what could not be put down
            self._pseudo_reset()
        if self._practising:
            self._practise()
            action = self.policy.navigate(self._row)
        else:
            action = self._grasp_or_navigate()
        self._row.attempts = 0
        if not self.life.should_stop():
            self._step(action, Phase.LEARNING)
            self.learner.update_navigation()
            self._let_tidy()

    def _let_tidy(self) -> None:
        """Now and then, a person frees what is stuck; what the robot saw before does not hold after that."""
        if self._tidy_every and self.progress.steps % self._tidy_every == 0 and (moved := self._tidy()):
            self.progress.interventions += moved
            self.life.cut_episode()
            self._look_again()

    def _grasp_or_navigate(self) -> dict[str, float]:
        """TrainGrasp(N_grasp, False), as often as the gate wants it; then the navigation step that follows."""
        while not self.life.should_stop():
            action = self._decide()
            if action["skill.pos"] == Skill.NAVIGATE:
                return action
            if self._attempt(action, Phase.LEARNING):
                self._pseudo_reset()
                break
        return self.policy.navigate(self._row)

    def _practise(self) -> None:
        """TrainGraspAutoCurr, while the autonomous curriculum lasts."""
        practice = self._autonomous.session()
        while not practice.finished and self._practising and not self.life.should_stop():
            if self.life.holding and (not self._drop() or self.life.should_stop()):
                break
            practice.attempted(self._attempt(self.policy.attempt(self._row), Phase.CURRICULUM))
        if practice.succeeded:
            self._pseudo_reset()

    @property
    def _practising(self) -> bool:
        """Whether the autonomous curriculum is still on; it counts all attempts there are to learn from."""
        return self._autonomous.active(self.learner.attempts_since_first_success)

    def _decide(self) -> dict[str, float]:
        action = self.policy.decide(*self._senses(), self._row)
        self._row.attempts += action["skill.pos"] == Skill.GRASP
        return action

    def _attempt(self, action: dict[str, float], phase: Phase) -> bool:
        """Grasp, learn; whether something was picked up."""
        success = self._step(action, phase)
        self.learner.update_grasping(phase)
        return success

    def _drop(self) -> bool:
        """Put the held object down at a random place of the grasp area; false if something was in the way."""
        x, y = self._row.rng.uniform((_DROP_X[0], _DROP_Y[0]), (_DROP_X[1], _DROP_Y[1]))
        self._step(action_dict(Skill.PLACE, x=float(x), y=float(y)), Phase.CURRICULUM)
        return not self.life.holding

    def _pseudo_reset(self) -> None:
        for action in self.policy.pseudo_reset(self._row, self._pseudo_reset_steps, lambda: self.life.holding):
            if self.life.should_stop():
                break
            self._step(action, Phase.PSEUDO_RESET)
            if action["skill.pos"] == Skill.NAVIGATE:
                self.learner.update_pseudo_reset()
        self._row.attempts = 0

    # --- The robot ----------------------------------------------------------------------------------------
    def _step(self, action: dict[str, float], phase: Phase) -> bool:
        """Act and look; whether something was picked up. Afterwards a person may take over."""
        self.life.step(action, phase, self._row.belief)
        self._observe()
        success = self.life.succeeded
        self._let_person_act()
        return success

    def _let_person_act(self) -> None:
        """As long as a person wants to; what they do is recorded, and their attempts are learned from."""
        action = self._person()
        if action is None:
            return
        self.progress.interventions += 1
        while action is not None:
            self._look_again()
            self.life.step(action, Phase.TELEOPERATION)
            self._observe()
            if action["skill.pos"] == Skill.GRASP:
                self.learner.update_grasping(Phase.TELEOPERATION)
            action = self._person()
        self._look_again()
        self._row.attempts = 0

    def _look_again(self) -> None:
        """After someone else has changed the room."""
        self.life.look_again()
        self._observe()

    def _observe(self) -> None:
        self.policy.observe(*self._senses(), self._row)

    def _senses(self) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        return self.life.observation[FRONT], state_vector(self.life.observation)
