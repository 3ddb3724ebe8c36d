"""Settings of `locobot_keyboard`."""

from dataclasses import dataclass

from lerobot.teleoperators.config import TeleoperatorConfig


@TeleoperatorConfig.register_subclass("locobot_keyboard")
@dataclass
class LocobotKeyboardConfig(TeleoperatorConfig):
    """A person at a keyboard: one key, one skill."""
