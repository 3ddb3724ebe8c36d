"""Updates of the single policy from its replay: after each drive and each attempt."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from relmm.features import Phase, Skill
from relmm.policies.learning import Learner
from relmm.policies.relmm_paper.replay import Steps, to_pictures
from relmm.policies.relmm_single.mixed import Batch

if TYPE_CHECKING:
    from relmm.policies.relmm_single.modeling_relmm_single import RelmmSinglePolicy

COLUMNS = ("x_vel", "theta_vel", "skill", "x", "y")  # of an action, in its order


class RelmmSingleLearner(Learner):
    """Trains the policy.

    Args:
        policy: to train; its config says how.
        seed: of the batches.
        capacity: steps that are kept in memory.

    Attributes:
        steps: that have been added: drives and attempts, but for those of pseudo-resets.
    """

    def __init__(self, policy: RelmmSinglePolicy, seed: int, capacity: int) -> None:
        self.policy, self.config, self.steps = policy, policy.config, Steps(capacity, *COLUMNS)
        self.rng = np.random.default_rng(seed)
        self.noise = torch.Generator().manual_seed(seed)
        weights = policy.get_optim_params()
        self.optimizers = {"policy": torch.optim.Adam(weights, lr=self.config.learning_rate, fused=True)}
        self.logs = {}

    def add(
        self,
        picture: NDArray[np.uint8],
        state: NDArray[np.float32],
        action: NDArray[np.float32],
        success: bool,
        phase: int,
    ) -> None:
        """See `Learner.add`."""
        skill = round(float(action[COLUMNS.index("skill")]))
        self.steps.end(picture)
        if skill == Skill.GRASP:
            self.count_attempt(success)
        if phase != Phase.PSEUDO_RESET and skill != Skill.PLACE:
            self.steps.begin(picture, **dict(zip(COLUMNS, map(float, action), strict=True)))
            if success:
                self.steps.end(picture, ended=True)  # nothing follows, whatever the next picture shows
        self.policy.steps_seen.clamp_(min=len(self.steps))

    def save_episode(self) -> None:
        """See `Learner.save_episode`."""
        self.steps.forget()

    def update_grasping(self, phase: int) -> None:
        """See `Learner.update_grasping`: an attempt is a step like others."""
        self.update_navigation()

    def update_navigation(self) -> None:
        """See `Learner.update_navigation`."""
        if len(self.steps) < self.config.min_steps_to_update:
            return
        for _ in range(self.config.updates):
            size = self.config.batch_size
            noise = torch.randn(2, size, 4, generator=self.noise).to(self.policy.weights_device)
            loss, self.logs = self.policy.sac.loss(self.batch(self.steps.sample(size, self.rng)), noise)
            self.optimizers["policy"].zero_grad(set_to_none=True)
            loss.backward()
            self.optimizers["policy"].step()
            self.policy.update()

    def batch(self, rows: NDArray[np.int64]) -> Batch:
        """Some of the replay's steps."""
        table, device = self.steps.table, self.policy.weights_device
        before, after = (to_pictures(self.steps.pictures[table[name][rows]], device) for name in ("picture", "next"))
        actions = torch.from_numpy(np.stack([table[name][rows] for name in COLUMNS], axis=1)).to(device)
        successes: Tensor = torch.from_numpy(table["ended"][rows]).to(device)
        return self.policy.batch(before, actions, after, successes)
