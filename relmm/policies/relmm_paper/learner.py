"""Updates of the policy from the replay: sample, relabel, loss, step."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from relmm.features import ACTION_NAMES, Phase, Skill
from relmm.policies.learning import Learner
from relmm.policies.relmm_paper.navigation import ACTIONS, NavigationBatch, from_navigation_steps
from relmm.policies.relmm_paper.perturbation import Perturbation
from relmm.policies.relmm_paper.perturbation_learning import PerturbationReplay
from relmm.policies.relmm_paper.replay import VELOCITIES, Replay, Steps, to_pictures

PERTURBATIONS = "perturbation_before", "perturbation_after"
MIN_PERTURBATION_STEPS = 300  # before the first update, as in the authors' code

if TYPE_CHECKING:
    from relmm.policies.relmm_paper.modeling_relmm_paper import RelmmPaperPolicy

_SKILL = ACTION_NAMES.index("skill.pos")


class RelmmPaperLearner(Learner):
    """Trains a policy's two modules, each with its own optimiser.

    Args:
        policy: to train; its config says how.
        seed: of the batches.
        capacity: attempts, and navigation steps, that are kept in memory.

    Attributes:
        replay: what has been added.
        perturbations: likewise, of pseudo-resets that are learned.
    """

    def __init__(self, policy: RelmmPaperPolicy, seed: int, capacity: int) -> None:
        self.policy, self.config, self.replay = policy, policy.config, Replay(capacity)
        self.perturbations = PerturbationReplay(capacity)
        self.rng = np.random.default_rng(seed)
        self.noise = torch.Generator().manual_seed(seed)
        grasping, navigation = policy.get_optim_params()
        self.optimizers = {
            "grasping": torch.optim.Adam(grasping["params"], lr=grasping["lr"], fused=True),
            "navigation": torch.optim.Adam(navigation["params"], lr=navigation["lr"], fused=True),
        }
        for name, perturbation in zip(PERTURBATIONS, policy.perturbations, strict=False):
            assert isinstance(perturbation, Perturbation)
            rate = self.config.navigation_learning_rate
            self.optimizers[name] = torch.optim.Adam(perturbation.weights(), lr=rate, fused=True)
        self.logs = {}

    # --- Filling ------------------------------------------------------------------------------------------
    def add(
        self,
        picture: NDArray[np.uint8],
        state: NDArray[np.float32],
        action: NDArray[np.float32],
        success: bool,
        phase: int,
    ) -> None:
        """See `Learner.add`; the paper's policy has no use for the state."""
        if round(float(action[_SKILL])) == Skill.GRASP:
            self.count_attempt(success)
        self.replay.add(picture, action, success, phase)
        if self.policy.perturbations:
            self.perturbations.add(picture, action, phase)
        # A policy that had learned before knows of more than there is in the replay.
        self.policy.attempts_seen.clamp_(min=len(self.replay.attempts))
        self.policy.steps_seen.clamp_(min=self.replay.navigation_steps)

    def save_episode(self) -> None:
        """See `Learner.save_episode`."""
        self.replay.save_episode()
        self.perturbations.save_episode()

    # --- Grasping -----------------------------------------------------------------------------------------
    def update_grasping(self, phase: int) -> None:
        """See `Learner.update_grasping`."""
        attempts = self.replay.attempts
        begun = len(attempts) >= self.config.min_attempts_to_update
        frozen = self.config.freeze_grasping and phase != Phase.CURRICULUM
        if begun and not frozen:
            for _ in range(self.config.grasp_updates):
                self._step("grasping", *self._grasp_loss())

    def _grasp_loss(self) -> tuple[Tensor, dict[str, float]]:
        attempts = self.replay.attempts
        rows = self.replay.sample_attempts(self.config.grasp_batch_size, self.rng)
        places = self._on_device(np.stack([attempts["x"][rows], attempts["y"][rows]], axis=1))
        successes = self._on_device(attempts["success"][rows])
        pictures = to_pictures(self.replay.attempt_pictures[attempts["picture"][rows]], self.policy.weights_device)
        return self.policy.grasping.loss(pictures, places, successes)

    # --- Navigation ---------------------------------------------------------------------------------------
    def update_navigation(self) -> None:
        """See `Learner.update_navigation`."""
        steps, size = self.replay.steps, self.config.navigation_batch_size
        if len(steps) >= self.config.min_steps_to_update and self.config.navigation == "sac":
            for _ in range(self.config.navigation_updates):
                batch = self.navigation_batch(steps.sample(size, self.rng))
                self._step("navigation", *self.policy.navigation.loss(batch, self._noise(size)))
                self.policy.update()

    def navigation_batch(self, rows: NDArray[np.int64]) -> NavigationBatch:
        """Some of the replay's navigation steps, rewarded by the current ensemble."""
        return self.policy.navigation_batch(*self._rows(self.replay.steps, rows))

    # --- Pseudo-resets ------------------------------------------------------------------------------------
    def update_pseudo_reset(self) -> None:
        """See `Learner.update_pseudo_reset`: of the policy that made the last step."""
        part = self.perturbations.newest
        if part is None or not self.policy.perturbations:
            return
        steps, size = self.perturbations.parts[part], self.config.navigation_batch_size
        perturbation = self.policy.perturbations[part]
        assert isinstance(perturbation, Perturbation)
        if len(steps) >= MIN_PERTURBATION_STEPS:
            batch = self._rows(steps, steps.sample(size, self.rng))
            loss, logs = perturbation.loss(*batch, self._noise(size))
            name = PERTURBATIONS[part]
            self._step(name, loss, {f"{name}_{key}": value for key, value in logs.items()})
            perturbation.drives.update_targets()

    # --- Batches ------------------------------------------------------------------------------------------
    def _rows(self, steps: Steps, rows: NDArray[np.int64]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Pictures before some steps, their actions, the pictures after them, and which ended something."""
        table, device = steps.table, self.policy.weights_device
        velocities = np.stack([table[name][rows] for name in VELOCITIES], axis=1)
        before, after = (to_pictures(steps.pictures[table[name][rows]], device) for name in ("picture", "next"))
        return before, from_navigation_steps(self._on_device(velocities)), after, self._on_device(table["ended"][rows])

    def _noise(self, size: int) -> Tensor:
        return torch.randn(2, size, ACTIONS, generator=self.noise).to(self.policy.weights_device)

    def _on_device(self, values: NDArray[np.generic]) -> Tensor:
        return torch.from_numpy(values).to(self.policy.weights_device)

    def _step(self, module: str, loss: Tensor, logs: dict[str, float]) -> None:
        optimizer = self.optimizers[module]
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        self.logs |= logs
