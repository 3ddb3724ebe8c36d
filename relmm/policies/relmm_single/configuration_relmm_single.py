"""Settings of `relmm_single`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from lerobot.configs.policies import PreTrainedConfig
from lerobot.optim.optimizers import AdamConfig

from relmm.errors import MANY, ConfigError
from relmm.policies.learning import LearningConfig
from relmm.policies.relmm_paper.configuration_relmm_paper import CHOICES

_TINY = 1e-8


@PreTrainedConfig.register_subclass("relmm_single")
@dataclass
class RelmmSingleConfig(LearningConfig):
    """The paper's "single policy": soft actor-critic that either drives or grasps; each attempt is a step.

    The paper tells no more than that; the values are those of `SACMixed` in the authors' code. Train it with
    `--curriculum.type=none`.

    Args:
        encoder: `paper` or `paper_small`, the convolutions over the picture.
        hidden: width of the dense layers.
        learning_rate, batch_size: of the optimiser.
        updates: per step.
        random_steps: steps with uniform actions at first.
        min_steps_to_update: steps stored before the first update.
        gamma: discount of a step.
        tau: step of the target networks' moving average.
        target_entropy: of a drive, and of a grasp's place.
        choice_entropy: the same of the choice between the two, as a share of the highest possible one.
        initial_temperature: of both temperatures.
        max_attempts: in a row, after which it drives; a training that only grasps would never end.
    """

    encoder: str = "paper"
    hidden: int = 512
    learning_rate: float = 3e-4
    batch_size: int = 128
    updates: int = 1
    random_steps: int = 500
    min_steps_to_update: int = 250
    gamma: float = 0.99
    tau: float = 0.005
    target_entropy: float = -2.0
    choice_entropy: float = 0.5
    initial_temperature: float = 1.0
    max_attempts: int = 20

    ranges: ClassVar[dict[str, tuple[float, float]]] = {
        **LearningConfig.ranges,
        "hidden": (1, 4096),
        "learning_rate": (_TINY, 1),
        "batch_size": (1, 1 << 16),
        "updates": (0, MANY),
        "random_steps": (0, MANY),
        "min_steps_to_update": (1, MANY),
        "gamma": (_TINY, 0.9999),
        "tau": (_TINY, 1),
        "target_entropy": (-100, 100),
        "choice_entropy": (0, 1),
        "initial_temperature": (_TINY, MANY),
        "max_attempts": (1, MANY),
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        allowed = CHOICES["navigation_encoder"]
        if self.encoder not in allowed:
            raise ConfigError(f"policy.encoder is {self.encoder!r}: choose one of {', '.join(allowed)}.")

    @property
    def observation_delta_indices(self) -> list[int]:
        """The present frame and the next one."""
        return [0, 1]

    def get_optimizer_preset(self) -> AdamConfig:
        """For `lerobot-train`."""
        return AdamConfig(lr=self.learning_rate, weight_decay=0.0, grad_clip_norm=math.inf)

    def fingerprint(self) -> dict[str, Any]:
        """See `LearningConfig.fingerprint`."""
        return {name: getattr(self, name) for name in ("camera", "encoder", "hidden")}
