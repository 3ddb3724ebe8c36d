"""The paper's single policy: at every step, it drives or grasps, as one soft actor-critic decides."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from relmm.features import (
    BELIEF,
    GRASP_X,
    GRASP_Y,
    IMAGE_KEY,
    STATE_KEY,
    STATE_NAMES,
    Skill,
    action_dict,
)
from relmm.policies.controller import Row
from relmm.policies.learning import LearningPolicy, no_rewards
from relmm.policies.pseudo_reset import drive_anywhere
from relmm.policies.relmm_paper.navigation import from_navigation_steps, to_navigation_step
from relmm.policies.relmm_paper.replay import to_pictures
from relmm.policies.relmm_single.configuration_relmm_single import RelmmSingleConfig
from relmm.policies.relmm_single.learner import COLUMNS, RelmmSingleLearner
from relmm.policies.relmm_single.mixed import Batch, Decision, MixedSac

_DECISION = "decision"  # of the last observation, in `Row.memory`
_LOW, _HIGH = np.array([GRASP_X[0], GRASP_Y[0]]), np.array([GRASP_X[1], GRASP_Y[1]])  # m
_SKILL = COLUMNS.index("skill")
_HOLDING = STATE_NAMES.index("holding.pos")


class RelmmSinglePolicy(LearningPolicy):
    """Drives or grasps.

    Attributes:
        sac: the networks.
        steps_seen: that it could learn from; while there are few, actions are uniform.
    """

    config_class = RelmmSingleConfig
    name = "relmm_single"
    config: RelmmSingleConfig

    def __init__(self, config: RelmmSingleConfig, **kwargs: Any) -> None:
        super().__init__(config, **kwargs)
        with torch.random.fork_rng():  # the same seed gives the same weights, whatever was drawn before
            torch.manual_seed(config.seed or 0)
            self.sac = MixedSac(config)
        self.sampling = config.sample
        self.steps_seen: Tensor
        self.register_buffer("steps_seen", torch.tensor(0))

    # --- Acting -------------------------------------------------------------------------------------------
    @torch.no_grad()
    def observe(self, image: NDArray[np.uint8], state: NDArray[np.float32], row: Row) -> None:
        """See `ControllerPolicy.observe`."""
        noise = torch.from_numpy(row.rng.standard_normal((1, 4), np.float32)) * float(self.sampling)
        decision = self.sac.decide(to_pictures(image[None], self.weights_device), noise.to(self.weights_device))
        row.memory[_DECISION] = decision
        chance = float(decision.log_chances[0, 1].exp())
        row.belief = {**dict.fromkeys(BELIEF, -1.0), "grasp_probability": chance}

    def decide(self, image: NDArray[np.uint8], state: NDArray[np.float32], row: Row) -> dict[str, float]:
        """See `ControllerPolicy.decide`: the likelier of the two, or one by its chance if `sampling`."""
        chance = 0.5 if self._begins else row.belief["grasp_probability"]
        wants = row.rng.random() < chance if self.sampling else chance > 0.5
        return self.attempt(row) if wants and row.attempts < self.config.max_attempts else self.navigate(row)

    def attempt(self, row: Row) -> dict[str, float]:
        """A grasp at the place that goes with it."""
        decision: Decision = row.memory[_DECISION]
        unit = row.rng.uniform(-1, 1, 2) if self._begins else decision.actions[0, 2:].cpu().numpy()
        x, y = _LOW + (unit + 1) / 2 * (_HIGH - _LOW)
        return action_dict(Skill.GRASP, x=float(x), y=float(y))

    def navigate(self, row: Row) -> dict[str, float]:
        """A navigation step."""
        decision: Decision = row.memory[_DECISION]
        return drive_anywhere(row.rng) if self._begins else to_navigation_step(decision.actions[0, :2].tolist())

    @property
    def _begins(self) -> bool:
        return self.sampling and bool(self.steps_seen < self.config.random_steps)

    # --- Learning -----------------------------------------------------------------------------------------
    def make_learner(self, seed: int, capacity: int) -> RelmmSingleLearner:
        """See `LearningPolicy.make_learner`."""
        return RelmmSingleLearner(self, seed, capacity)

    def batch(self, pictures: Tensor, actions: Tensor, next_pictures: Tensor, successes: Tensor) -> Batch:
        """Steps as the networks take them.

        Args:
            pictures: before them, uint8 (batch, 3, 100, 100).
            actions: by `relmm.features.ACTION_NAMES`, (batch, 5).
            next_pictures: after them.
            successes: (batch,) bool.
        """
        low, high = (torch.as_tensor(edge, dtype=actions.dtype, device=actions.device) for edge in (_LOW, _HIGH))
        places = ((actions[:, _SKILL + 1 :] - low) / (high - low) * 2 - 1).clamp(-1, 1)
        choices = (actions[:, _SKILL].round() == Skill.GRASP).long()
        values = torch.cat([from_navigation_steps(actions), places], dim=1)
        return Batch(pictures, choices, values, next_pictures, successes)

    def forward(self, batch: dict[str, Any], **kwargs: Any) -> tuple[Tensor, dict[str, Any] | None]:
        """The loss of the drives and attempts of a LeRobot batch.

        Args:
            batch: pictures (batch, 2, 3, 100, 100) 0..1, and which of them are padding; `action` (batch, 5); and
                `next.reward`, (batch,), or else `observation.state`, (batch, 2, 52).
            **kwargs: LeRobot's, not used.

        Raises:
            ConfigError: the dataset has no rewards, nor states that tell them.
        """
        pictures = (batch[IMAGE_KEY].clamp(0, 1) * 255).round().to(torch.uint8)
        rewards = batch.get("next.reward")
        if not isinstance(rewards, Tensor):
            if STATE_KEY not in batch:
                raise no_rewards()
            rewards = (batch[STATE_KEY][:, 1, _HOLDING] > 0.5) & (batch["action"][:, _SKILL].round() == Skill.GRASP)
        successes = rewards.flatten() > 0
        kept = (batch["action"][:, _SKILL].round() != Skill.PLACE) & (
            successes | ~batch[f"{IMAGE_KEY}_is_pad"][:, 1].to(successes.device)
        )
        if not kept.any():
            return self.sac.log_temperatures.sum() * 0.0, {}
        if self.training:
            self.steps_seen += int(kept.sum())
        steps = self.batch(pictures[kept, 0], batch["action"][kept], pictures[kept, 1], successes[kept])
        return self.sac.loss(steps, torch.randn(2, int(kept.sum()), 4, device=self.weights_device))

    def update(self) -> None:
        """Called after each step of the optimiser."""
        self.sac.update_targets()

    def get_optim_params(self) -> list[nn.Parameter]:
        """Those that learn."""
        return [weight for weight in self.sac.parameters() if weight.requires_grad]

    @property
    def weights_device(self) -> torch.device:
        """Where the weights are."""
        return self.sac.log_temperatures.device
