"""Settings of `relmm_random`."""

from dataclasses import dataclass

from lerobot.configs.policies import PreTrainedConfig

from relmm.errors import ConfigError
from relmm.policies.controller import ControllerConfig


@PreTrainedConfig.register_subclass("relmm_random")
@dataclass
class RelmmRandomConfig(ControllerConfig):
    """The paper's "Rand all": drive anywhere, and grasp anywhere after half of the navigation steps.

    Args:
        grasp_probability: of trying to grasp after a navigation step.
    """

    grasp_probability: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.grasp_probability <= 1:
            raise ConfigError(f"policy.grasp_probability is {self.grasp_probability}, but must lie in 0..1.")
