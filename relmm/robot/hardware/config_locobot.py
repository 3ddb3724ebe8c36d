"""`--robot.type=locobot`."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.robots.config import RobotConfig

from relmm.errors import MAX_SEED, ConfigError, check_range

CAMERA = "d435"


@RobotConfig.register_subclass("locobot")
@dataclass(kw_only=True)
class LocobotConfig(RobotConfig):
    """A real LoCoBot: Kobuki base, WidowX-200 arm, RealSense D435.

    Args:
        base_port: device of the base; auto for the Kobuki in /dev/serial/by-id.
        arm_port: device of the arm's motors; auto for the U2D2 in /dev/serial/by-id.
        camera_serial: serial number of the camera, with several of them; auto for the only one.
        camera: how pictures look: `d435`, whatever small differences the real camera has.
        depth: whether observations hold the depth picture too.
        seed: of the robot's own choices; None for that of the command, or 0.
        dry_run: nothing moves; says what it would do.
    """

    base_port: str = "auto"
    arm_port: str = "auto"
    camera_serial: str = "auto"
    camera: str = CAMERA
    depth: bool = False
    seed: int | None = None
    dry_run: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.camera != CAMERA:
            raise ConfigError(f"robot.camera is {self.camera!r}, but the camera of a LoCoBot is {CAMERA!r}.")
        check_range("robot.seed", self.seed or 0, 0, MAX_SEED)
