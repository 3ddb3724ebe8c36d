"""The hierarchical policy of ReLMM: a gate, then a grasp or a navigation step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from relmm.features import BELIEF, Skill, action_dict
from relmm.policies.controller import Row
from relmm.policies.learning import LearningPolicy
from relmm.policies.pseudo_reset import drive_anywhere, driven_pseudo_reset
from relmm.policies.relmm_paper.configuration_relmm_paper import RelmmPaperConfig
from relmm.policies.relmm_paper.continuous import ContinuousGrasping
from relmm.policies.relmm_paper.grasping import Estimate, GraspEnsemble
from relmm.policies.relmm_paper.learner import RelmmPaperLearner
from relmm.policies.relmm_paper.navigation import ACTIONS, Navigation, NavigationBatch, to_navigation_step
from relmm.policies.relmm_paper.offline import Attempt, Outcomes, Step, read_batch
from relmm.policies.relmm_paper.perturbation import Perturbation
from relmm.policies.relmm_paper.replay import to_pictures

_PICTURES, _ESTIMATE = "pictures", "estimate"  # of the last observation, in `Row.memory`


class RelmmPaperPolicy(LearningPolicy):
    """Drives with `navigation`; grasps with `grasping` where that expects success.

    Attributes:
        grasping: the ensemble, or what takes its place.
        navigation: soft actor-critic.
        perturbations: of pseudo-resets, before and after the object is put down; none where these drive at random.
        attempts_seen: that the ensemble could learn from; while there are few, cells are sampled uniformly.
        steps_seen: navigation steps that SAC could learn from; while there are few, they are sampled uniformly.
    """

    config_class = RelmmPaperConfig
    name = "relmm_paper"
    config: RelmmPaperConfig

    def __init__(self, config: RelmmPaperConfig, **kwargs: Any) -> None:
        super().__init__(config, **kwargs)
        with torch.random.fork_rng():  # the same seed gives the same weights, whatever was drawn before
            torch.manual_seed(config.seed or 0)
            self.grasping = ContinuousGrasping(config) if config.grasping == "continuous" else GraspEnsemble(config)
            self.navigation = Navigation(config)
            learned = config.perturbation == "novelty"
            self.perturbations = nn.ModuleList([Perturbation(config) for _ in range(2 * learned)])
        self.sampling = config.sample
        # Saved with the weights, so that who acts with these elsewhere explores as the trainer does.
        self.attempts_seen: Tensor
        self.steps_seen: Tensor
        self.register_buffer("attempts_seen", torch.tensor(0))
        self.register_buffer("steps_seen", torch.tensor(0))
        self._outcomes = Outcomes()  # of the frames that `forward` has seen

    # --- Acting -------------------------------------------------------------------------------------------
    def observe(self, image: NDArray[np.uint8], state: NDArray[np.float32], row: Row) -> None:
        """See `ControllerPolicy.observe`."""
        pictures = to_pictures(image[None], self.weights_device)
        estimate = self.grasping.estimate(pictures)
        row.memory |= {_PICTURES: pictures, _ESTIMATE: estimate}
        chance = float(self.grasping.grasp_probability(estimate)[0])
        row.belief = {**dict.fromkeys(BELIEF, -1.0), "grasp_probability": chance}

    def decide(self, image: NDArray[np.uint8], state: NDArray[np.float32], row: Row) -> dict[str, float]:
        """See `ControllerPolicy.decide`: greedily, or as while training if `sampling`."""
        wants = row.attempts < self.config.num_grasp and self._wants_to_grasp(row)
        return self.attempt(row) if wants else self.navigate(row)

    def attempt(self, row: Row) -> dict[str, float]:
        """A sampled place (paper eq. 2), or the best one of the ensemble's mean."""
        seen = row.memory[_PICTURES], row.memory[_ESTIMATE]
        if self.sampling and self.attempts_seen < self.config.min_attempts_to_update:
            place = self.grasping.anywhere(row.rng)
        else:
            place = self.grasping.choose(*seen, row.rng, greedy=not self.sampling)
        mean, std = self.grasping.opinion(*seen, place)
        row.belief = {**row.belief, "grasp_mean": mean, "grasp_std": std}
        return action_dict(Skill.GRASP, x=float(place[0]), y=float(place[1]))

    def navigate(self, row: Row) -> dict[str, float]:
        """A sampled navigation step, or the mean action; any at all while there is nothing to choose it by."""
        begins = self.sampling and self.steps_seen < self.config.random_steps
        if begins or self.config.navigation == "random":
            return drive_anywhere(row.rng)
        action = self.navigation.act(row.memory[_PICTURES], row.rng if self.sampling else None)[0]
        return to_navigation_step(action.tolist())

    def pseudo_reset(self, row: Row, steps: int, holding: Callable[[], bool]) -> Iterator[dict[str, float]]:
        """See `ControllerPolicy.pseudo_reset`."""
        if not self.perturbations:
            return super().pseudo_reset(row, steps, holding)
        carry, leave = (partial(self._perturb, each, row) for each in self.perturbations)
        return driven_pseudo_reset(row.rng, steps, holding, carry, leave)

    def _perturb(self, perturbation: nn.Module, row: Row) -> dict[str, float]:
        assert isinstance(perturbation, Perturbation)
        return to_navigation_step(perturbation.drives.act(row.memory[_PICTURES], row.rng)[0].tolist())

    def _wants_to_grasp(self, row: Row) -> bool:
        estimate: Estimate = row.memory[_ESTIMATE]
        if not self.sampling:
            return float(estimate.mean.amax()) >= self.config.grasp_threshold
        # Once decided, up to N_grasp attempts follow (paper Algorithm 1).
        return row.attempts > 0 or row.rng.random() <= float(self.grasping.grasp_probability(estimate))

    # --- Learning -----------------------------------------------------------------------------------------
    def make_learner(self, seed: int, capacity: int) -> RelmmPaperLearner:
        """See `LearningPolicy.make_learner`."""
        return RelmmPaperLearner(self, seed, capacity)

    def forward(self, batch: dict[str, Any], **kwargs: Any) -> tuple[Tensor, dict[str, Any] | None]:
        """The losses of the frames of a LeRobot batch: attempts teach the ensemble, navigation steps the navigation.

        A step that came before attempts is learned from when they have been shown as well, in this batch or in a later
        one; while the policy does not train, in this one.

        Args:
            batch: pictures (batch, time, 3, 100, 100) 0..1, and which of them are padding; `action` (batch, time, 5),
                where time is `config.observation_delta_indices`; `index`, and `next.reward`, (batch,), or else
                `observation.state`, (batch, time, 52).
            **kwargs: LeRobot's, not used.
        """
        attempts, new_steps = read_batch(batch)
        steps = (self._outcomes if self.training else Outcomes()).add(attempts, new_steps)
        if self.training:
            self.attempts_seen += len(attempts)
            self.steps_seen += len(steps)
        losses = [self.navigation.log_temperature * 0.0]
        logs: dict[str, Any] = {}
        if attempts:
            grasp_loss, logs = self._loss_of_attempts(attempts)
            losses.append(grasp_loss)
        if steps:
            navigation_loss, navigation_logs = self._loss_of_steps(steps)
            losses.append(navigation_loss)
            logs |= navigation_logs
        return torch.stack(losses).sum(), logs

    def _loss_of_attempts(self, attempts: list[Attempt]) -> tuple[Tensor, dict[str, float]]:
        return self.grasping.loss(
            torch.stack([attempt.picture for attempt in attempts]),
            torch.stack([attempt.place for attempt in attempts]).to(self.weights_device),
            torch.tensor([attempt.success for attempt in attempts], device=self.weights_device),
        )

    def _loss_of_steps(self, steps: list[tuple[Step, bool]]) -> tuple[Tensor, dict[str, float]]:
        batch = self.navigation_batch(
            torch.stack([step.picture for step, _ in steps]),
            torch.stack([step.action for step, _ in steps]).to(self.weights_device),
            torch.stack([step.next_picture for step, _ in steps]),
            torch.tensor([success for _, success in steps], device=self.weights_device),
        )
        return self.navigation.loss(batch, torch.randn(2, len(steps), ACTIONS, device=self.weights_device))

    def navigation_batch(
        self, pictures: Tensor, actions: Tensor, next_pictures: Tensor, successes: Tensor
    ) -> NavigationBatch:
        """Navigation steps with their rewards, by the current ensemble if they are relabelled (paper 4.2).

        Args:
            pictures: before them, uint8 (batch, 3, 100, 100).
            actions: -1..1, (batch, 2).
            next_pictures: after them.
            successes: which led to one, (batch,) bool.
        """
        continues = 1 - successes.float()
        rewards = -continues
        if self.config.relabel:
            rewards = rewards + continues * self.grasping.grasp_probability(self.grasping.estimate(next_pictures))
        return NavigationBatch(pictures, actions, rewards, next_pictures, continues)

    def update(self) -> None:
        """Called after each step of the optimiser."""
        self.navigation.update_targets()

    def get_optim_params(self) -> Any:
        """One group for the ensemble and one for the navigation, with their learning rates."""
        navigation = [weight for weight in self.navigation.parameters() if weight.requires_grad]
        return [
            {"params": list(self.grasping.parameters()), "lr": self.config.grasp_learning_rate},
            {"params": navigation, "lr": self.config.navigation_learning_rate},
        ]

    @property
    def weights_device(self) -> torch.device:
        """Where the weights are."""
        return self.navigation.log_temperature.device
