"""Settings of `locobot_scripted`."""

from dataclasses import dataclass

from lerobot.teleoperators.config import TeleoperatorConfig

from relmm.geometry import camera_geometry


@TeleoperatorConfig.register_subclass("locobot_scripted")
@dataclass
class LocobotScriptedConfig(TeleoperatorConfig):
    """The scripted controller in the place of a person.

    Args:
        camera: geometry of the robot's camera.
        seed: of the controller's random choices.
    """

    camera: str = "paper"
    seed: int = 0

    def __post_init__(self) -> None:
        camera_geometry(self.camera)
