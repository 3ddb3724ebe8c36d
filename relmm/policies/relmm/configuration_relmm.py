"""Settings of `relmm`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from lerobot.configs.policies import PreTrainedConfig
from lerobot.optim.optimizers import AdamConfig

from relmm.errors import MANY
from relmm.policies.learning import LearningConfig

_TINY = 1e-8


@PreTrainedConfig.register_subclass("relmm")
@dataclass
class ReLMMConfig(LearningConfig):
    """ReLMM's grasp ensemble, and navigation planned over a remembered map of what it predicts.

    The curricula's numbers are smaller than the paper's (2,000, 50, 2, 20, 400), because one attempt teaches all cells.

    Args:
        num_members: networks in the grasp ensemble (M of the paper).
        channels: width of a network's convolutions.
        initial_logit: output bias of a fresh network; below 0 because most attempts fail.
        prior_scale: standard deviation, on noise, of the fixed random part of a network's logits, so that members
            disagree about what they have not tried.
        mean_weight, std_weight: of the ensemble's mean and standard deviation in the choice of a cell (alpha and beta).
        gate_std_weight: of the standard deviation in P[grasp] and in planned ways while training; the mean's is 1.
        grasp_threshold: mean success above which the greedy policy grasps.
        learning_rate, batch_size: of the ensemble's optimiser.
        updates: per attempt.
        smoothing: of the labels: a success counts as 1 - smoothing, a failure as smoothing. Surer networks would agree
            on everything, also on what they have never tried.
        recolor: how much stronger or weaker each colour of every second attempt of a batch is made, at most, after the
            three have changed places: what is learned of some things then holds for others. 0 for colours as they were.
        freeze_grasping: the ensemble learns in the curriculum only.
        failure_steps: what a failed grasp costs a plan, in navigation steps.
        unseen_promise: success that floor promises which was not seen from near.
    """

    num_stationary: int = 100
    min_attempts_to_update: int = 8
    num_max: int = 100

    num_members: int = 6
    channels: int = 16
    initial_logit: float = -2.0
    prior_scale: float = 6.0
    # Paper eq. 2; the authors' code applies both to probabilities, inside the softmax only.
    mean_weight: float = 10.0
    std_weight: float = 10.0
    gate_std_weight: float = 1.0  # as in the authors' code: with the weights above, paper eq. 3 would exceed 1
    grasp_threshold: float = 0.5
    learning_rate: float = 1e-3
    batch_size: int = 64
    updates: int = 4
    smoothing: float = 0.03
    recolor: float = 0.4
    freeze_grasping: bool = False

    failure_steps: float = 25.0
    unseen_promise: float = 0.2

    ranges: ClassVar[dict[str, tuple[float, float]]] = {
        **LearningConfig.ranges,
        "num_members": (1, 100),
        "channels": (1, 1024),
        "initial_logit": (-20, 20),
        "prior_scale": (0, 20),
        "mean_weight": (0, MANY),
        "std_weight": (0, MANY),
        "gate_std_weight": (0, MANY),
        "grasp_threshold": (0, 1),
        "learning_rate": (_TINY, 1),
        "batch_size": (1, 1 << 16),
        "updates": (0, MANY),
        "smoothing": (0, 0.5),
        "recolor": (0, 1),
        "failure_steps": (_TINY, MANY),
        "unseen_promise": (0, 1),
    }

    def get_optimizer_preset(self) -> AdamConfig:
        """For `lerobot-train`."""
        return AdamConfig(lr=self.learning_rate, weight_decay=0.0, grad_clip_norm=math.inf)

    def fingerprint(self) -> dict[str, Any]:
        """See `LearningConfig.fingerprint`."""
        return {name: getattr(self, name) for name in ("camera", "num_members", "channels")}
