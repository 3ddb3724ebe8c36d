"""relmm: a mobile robot that learns to clean a room, as a LeRobot package.

The method is ReLMM (Sun, Orbik et al., "Fully Autonomous Real-World Reinforcement Learning with Applications to
Mobile Manipulation", CoRL 2021).
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from relmm.api import load_grasps, load_policy, make_env, make_robot

__all__ = ["load_grasps", "load_policy", "make_env", "make_robot"]

try:
    __version__ = version("lerobot_policy_relmm")
except PackageNotFoundError:  # a source tree that was not installed
    __version__ = "0.0.0"


def __getattr__(name: str) -> Any:
    if name in __all__:  # loaded when it is used: LeRobot and MuJoCo take seconds
        return getattr(import_module("relmm.api"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
