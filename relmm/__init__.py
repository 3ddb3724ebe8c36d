"""relmm: a mobile robot that learns to clean a room, as a LeRobot package.

The method is ReLMM (Sun, Orbik et al., "Fully Autonomous Real-World Reinforcement Learning with Applications to
Mobile Manipulation", CoRL 2021).
"""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("lerobot_policy_relmm")
except PackageNotFoundError:  # a source tree that was not installed
    __version__ = "0.0.0"
