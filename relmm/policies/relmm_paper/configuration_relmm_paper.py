"""Settings of `relmm_paper`: every hyper-parameter of the paper."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from lerobot.configs.policies import PreTrainedConfig
from lerobot.optim.optimizers import AdamConfig

from relmm.errors import MANY, ConfigError
from relmm.policies.learning import LearningConfig

# What a setting may be, by its name.
CHOICES: dict[str, tuple[str, ...]] = {
    "grasping": ("discrete", "continuous"),
    "navigation": ("sac", "random"),
    "perturbation": ("random", "novelty"),
    "navigation_encoder": ("paper", "paper_small"),
}

_TINY = 1e-8


@PreTrainedConfig.register_subclass("relmm_paper")
@dataclass
class RelmmPaperConfig(LearningConfig):
    """The hierarchical policy of ReLMM (Sun, Orbik et al., CoRL 2021) as published.

    The defaults are the preset `paper`; `paper_small` has smaller networks and batches, for a CPU. Where the paper is
    silent, a value is that of the released code; where the two disagree, a comment says which is followed.

    Args:
        grasping: `discrete`, the ensemble over 225 cells, or `continuous`, what the paper compares it with: networks
            that judge any place, and a search for the best (preset `paper_continuous`).
        num_members: networks in the grasp ensemble (M).
        grasp_channels: width of their convolutions.
        grasp_input_gain: of the pixels that they see: 1 for -1..1, 255 for -1..509 as in the code. Without biases,
            fresh networks are as far apart as their inputs are large.
        mean_weight, std_weight: of the ensemble's mean and standard deviation in the choice of a cell (alpha, beta).
        gate_mean_weight, gate_std_weight: the same in P[grasp].
        grasp_threshold: mean success from which on the greedy policy grasps.
        grasp_learning_rate, grasp_batch_size: of the ensemble's optimiser.
        grasp_updates: per attempt.
        freeze_grasping: the ensemble learns in the curriculum only.

        navigation: `sac`, or `random` for the paper's baseline "Rand nav", which drives anywhere at every step.
        perturbation: pseudo-resets that drive at random, as in the paper, or its baseline R3L: two more policies that
            look for `novelty`. They learn online only, from the seed's first frame on; not by `lerobot-train`.
        navigation_encoder: `paper` or `paper_small`, the convolutions over the picture.
        navigation_hidden: width of the dense layers.
        relabel: reward steps without success with the current P[grasp] - 1 instead of -1.
        navigation_learning_rate, navigation_batch_size: of SAC's optimiser.
        navigation_updates: per navigation step.
        random_steps: navigation steps with uniform actions at first.
        min_steps_to_update: navigation steps stored before the first update.
        gamma: discount of a navigation step.
        tau: step of the target networks' moving average.
        target_entropy: of SAC's temperature.
        initial_temperature: of SAC.
    """

    # --- Grasping -------------------------------------------------------------------------------------------
    grasping: str = "discrete"
    num_members: int = 6  # M; the appendix calls it N
    grasp_channels: int = 64
    # The code forgets to divide pixels by 255. So its fresh members disagree (a spread of 0.43 instead of 0.01) and
    # P[grasp] is 1 at first; what the paper says of uncertainty was found with that, which is followed.
    grasp_input_gain: float = 255.0
    # Paper eq. 2. The code applies both to probabilities, inside the softmax only, which is followed.
    mean_weight: float = 10.0
    std_weight: float = 10.0
    # Paper eq. 3 would exceed 1 with the weights above; the code's gate has these, which are followed.
    gate_mean_weight: float = 1.0
    gate_std_weight: float = 1.0
    grasp_threshold: float = 0.5
    grasp_learning_rate: float = 3e-4  # the paper prints 3^-4; the code has this
    grasp_batch_size: int = 256
    grasp_updates: int = 1
    freeze_grasping: bool = False
    # Curricula: the paper's. By default the code waits for 500 attempts instead of 300 and has 100 for `num_stop`.
    num_stationary: int = 2000
    min_attempts_to_update: int = 300
    num_start: int = 10
    num_stop: int = 50
    num_max: int = 2000

    # --- Navigation -----------------------------------------------------------------------------------------
    navigation: str = "sac"
    perturbation: str = "random"
    navigation_encoder: str = "paper"
    navigation_hidden: int = 512
    # Paper 4.2, each step with its own P[grasp]: the code takes the highest of the batch. It keeps the 0 of a success,
    # which the paper's Algorithm 1 does not, and that is followed. The paper's stationary curves are without it.
    relabel: bool = False
    navigation_learning_rate: float = 3e-4
    navigation_batch_size: int = 128
    navigation_updates: int = 1
    random_steps: int = 500
    min_steps_to_update: int = 250
    gamma: float = 0.99
    tau: float = 0.005
    target_entropy: float = -2.0
    initial_temperature: float = 1.0

    ranges: ClassVar[dict[str, tuple[float, float]]] = {
        **LearningConfig.ranges,
        "num_members": (1, 100),
        "grasp_channels": (1, 1024),
        "grasp_input_gain": (_TINY, 255),
        "mean_weight": (0, MANY),
        "std_weight": (0, MANY),
        "gate_mean_weight": (0, MANY),
        "gate_std_weight": (0, MANY),
        "grasp_threshold": (0, 1),
        "grasp_learning_rate": (_TINY, 1),
        "grasp_batch_size": (1, 1 << 16),
        "grasp_updates": (0, MANY),
        "navigation_hidden": (1, 4096),
        "navigation_learning_rate": (_TINY, 1),
        "navigation_batch_size": (1, 1 << 16),
        "navigation_updates": (0, MANY),
        "random_steps": (0, MANY),
        "min_steps_to_update": (1, MANY),
        "gamma": (_TINY, 0.9999),
        "tau": (_TINY, 1),
        "target_entropy": (-100, 100),
        "initial_temperature": (_TINY, MANY),
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, allowed in CHOICES.items():
            if getattr(self, name) not in allowed:
                raise ConfigError(f"policy.{name} is {getattr(self, name)!r}: choose one of {', '.join(allowed)}.")

    # LeRobot's datasets then give a batch the present frame and as many after it as a navigation step may need.
    @property
    def observation_delta_indices(self) -> list[int]:
        """The present frame, those of the attempts that may follow a navigation step, and the one after them."""
        return list(range(self.num_grasp + 2))

    @property
    def action_delta_indices(self) -> list[int]:
        """As the observations."""
        return self.observation_delta_indices

    def get_optimizer_preset(self) -> AdamConfig:
        """For `lerobot-train`, which has one optimiser; the learning rates are in the policy's parameter groups."""
        return AdamConfig(lr=self.navigation_learning_rate, weight_decay=0.0, grad_clip_norm=math.inf)

    def fingerprint(self) -> dict[str, Any]:
        """See `LearningConfig.fingerprint`."""
        names = (
            "camera",
            "grasping",
            "num_members",
            "grasp_channels",
            "grasp_input_gain",
            "perturbation",
            "navigation_encoder",
            "navigation_hidden",
        )
        return {name: getattr(self, name) for name in names}
