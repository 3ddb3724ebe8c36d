"""Settings of `relmm_scripted`."""

from dataclasses import dataclass

from lerobot.configs.policies import PreTrainedConfig

from relmm.geometry import camera_geometry
from relmm.policies.controller import ControllerConfig


@PreTrainedConfig.register_subclass("relmm_scripted")
@dataclass
class RelmmScriptedConfig(ControllerConfig):
    """The paper's scripted controller (App. "Scripted Controller").

    Args:
        camera: geometry of the camera that takes the pictures, to project them to the floor.
    """

    camera: str = "paper"

    def __post_init__(self) -> None:
        super().__post_init__()
        camera_geometry(self.camera)
