"""ReLMM online: the paper's Algorithms 1 to 4 as loops over a robot's life."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from relmm.features import FRONT, GRID, Phase, Skill, action_dict
from relmm.learning.curriculum import AutonomousCurriculum, Practice
from relmm.learning.learner import Learner
from relmm.learning.life import Life
from relmm.learning.progress import Progress
from relmm.learning.pseudo_reset import pseudo_reset
from relmm.policies.controller import drive_anywhere, grasp_cell
from relmm.policies.relmm.grasping import Estimate
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy
from relmm.policies.relmm.searching import Search

# Where a curriculum puts an object down again: inside the grasp area by the width of an object.
_DROP_X, _DROP_Y = (0.315, 0.45), (-0.065, 0.065)  # m


class Trainer:
    """Trains a policy on a robot.

    Args:
        life: of the robot; its recorders must feed the learner's replay.
        policy: to train.
        learner: updates it.
        curriculum: `stationary`, `autonomous` or `none`.
        pseudo_reset_steps: random navigation steps before and after an object is put down.
        rng: of the gate, of uniform actions and of pseudo-resets.
        put_in_reach: the person of the stationary curriculum: makes sure that an object lies in the grasp area; returns
            whether something had to be done.
        progress: counts the frames of the run; also one of the life's recorders.
    """

    def __init__(
        self,
        life: Life,
        policy: ReLMMPolicy,
        learner: Learner,
        *,
        curriculum: str,
        pseudo_reset_steps: int,
        rng: np.random.Generator,
        put_in_reach: Callable[[], bool],
        progress: Progress,
    ) -> None:
        config = policy.config
        self.life, self.policy, self.learner, self.config = life, policy, learner, config
        self.progress = progress
        self._rng, self._put_in_reach, self._pseudo_reset_steps = rng, put_in_reach, pseudo_reset_steps
        self._stationary = curriculum == "stationary"
        num_max = config.num_max if curriculum == "autonomous" else 0
        self._autonomous = AutonomousCurriculum(config.num_start, config.num_stop, num_max)
        self._search = Search()
        policy.sampling = True

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
            self.life.look_again()
        self._attempt(Phase.CURRICULUM)
        if not self.in_stationary_curriculum and self.life.holding:
            self._pseudo_reset()

    # --- Algorithms 2 and 4 -------------------------------------------------------------------------------
    def navigation_step(self) -> None:
        """One turn of the loop: navigate, perhaps grasp, learn, and a pseudo-reset after a success."""
        if self.life.holding:  # what could not be put down
            self._pseudo_reset()
        self.life.step(self._navigation_action(), Phase.LEARNING, self._known_probability())
        practising = self._practising
        estimate = self._look()
        probability = 1.0 if practising else self.policy.grasp_probability
        succeeded = self._rng.random() <= probability and self._train_grasp(estimate, practising)
        self.learner.update_navigation()
        if succeeded:
            self._pseudo_reset()

    def _train_grasp(self, estimate: Estimate, practising: bool) -> bool:
        """TrainGrasp(N_grasp, False), or TrainGraspAutoCurr while the autonomous curriculum lasts; the reward r_g."""
        practice = self._autonomous.session() if practising else Practice(self.config.num_grasp)
        phase = Phase.CURRICULUM if practising else Phase.LEARNING
        while not practice.finished and not self.life.should_stop():
            if self.life.holding and not self._drop():
                break
            practice.attempted(self._attempt(phase))
            if practising and not self._practising:
                break
        return practice.succeeded

    def _attempt(self, phase: Phase) -> bool:
        """Look, choose a cell, grasp, learn; whether something was picked up."""
        estimate = self._look()
        self.life.step(grasp_cell(self._choose_cell(estimate)), phase, self.policy.grasp_probability)
        success = self.life.succeeded
        self.learner.update_grasping(phase)
        return success

    @property
    def _practising(self) -> bool:
        """Whether the autonomous curriculum is still on; it counts all attempts there are to learn from."""
        return self._autonomous.active(self.learner.replay.attempts_since_first_success)

    def _choose_cell(self, estimate: Estimate) -> int:
        if not self.learner.grasping_has_begun:
            return int(self._rng.integers(GRID**2))
        return int(self.policy.grasping.sample(estimate, self.policy.rng)[0])

    def _drop(self) -> bool:
        """Put the held object down at a random place of the grasp area; false if something was in the way."""
        x, y = self._rng.uniform((_DROP_X[0], _DROP_Y[0]), (_DROP_X[1], _DROP_Y[1]))
        self.life.step(action_dict(Skill.PLACE, x=float(x), y=float(y)), Phase.CURRICULUM)
        return not self.life.holding

    def _navigation_action(self) -> dict[str, float]:
        if self.progress.steps < self.config.random_steps:
            return drive_anywhere(self._rng)
        return self.policy.navigate(self._pictures(), self.life.observation["theta.vel"], self._search, self.policy.rng)

    def _pseudo_reset(self) -> None:
        for action in pseudo_reset(self._rng, self._pseudo_reset_steps, lambda: self.life.holding):
            self.life.step(action, Phase.PSEUDO_RESET)
            if self.life.should_stop():
                return

    def _pictures(self) -> torch.Tensor:
        return self.policy.to_pictures(self.life.observation[FRONT])

    def _look(self) -> Estimate:
        return self.policy.look(self._pictures())

    def _known_probability(self) -> float:
        """P[grasp] of the picture before a navigation step."""
        self._look()
        return self.policy.grasp_probability
