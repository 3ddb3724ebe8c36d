"""relmm from Python: a policy, a room, a robot, and the grasps of a dataset, in one line each.

`import relmm` offers these functions, and loads what they need when one of them is first used.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd
from lerobot.robots.config import RobotConfig

import relmm.plugin  # noqa: F401  (LeRobot then knows relmm's robots and policies)
from relmm.analysis.collection import GRASPS, collect
from relmm.analysis.predictions import Predictor
from relmm.commands.policies import load_config, make_actor
from relmm.commands.robots import make_locobot
from relmm.episodes import local_root
from relmm.errors import ConfigError
from relmm.learning.actor import Actor
from relmm.robot.locobot import LocobotRobot
from relmm.sim import ENV_ID
from relmm.sim.wrappers import standard_spaces


def load_policy(path_or_repo: str | Path, **settings: Any) -> Actor:
    """A policy with its processors, ready to act.

    Args:
        path_or_repo: a checkpoint's `pretrained_model`, or `user/repo[@revision]` on the Hub.
        settings: of its config, to be changed: `device="cuda"`.

    Returns:
        `act(observation)` is the next action, by name, for what a robot's `get_observation()` returns; `reset()`
        begins a new episode.

    Raises:
        ConfigError: there is no such policy, or it cannot be used.
    """
    return make_actor(load_config(str(path_or_repo), [f"--{name}={value}" for name, value in settings.items()]))


def make_env(room: str = "no_obstacles", *, standard: bool = False, **settings: Any) -> gym.Env[Any, Any]:
    """A simulated room as a gymnasium environment.

    Args:
        room: a registered room.
        standard: actions of -1..1 and observations of one level, as Stable-Baselines3 takes them.
        settings: of `relmm.sim.env.RelmmRoomEnv`, for instance `navigation_steps=50`.

    Raises:
        ConfigError: settings that cannot work.
    """
    env: gym.Env[Any, Any] = gym.make(ENV_ID, room=room, **settings)
    return standard_spaces(env) if standard else env


def make_robot(type: str = "locobot_sim", *, seed: int = 0, **settings: Any) -> LocobotRobot:
    """A LoCoBot, real or simulated, which a `with` statement connects and disconnects.

    Args:
        type: `locobot_sim` or `locobot`.
        seed: of what is random about it.
        settings: of its config, for instance `room="diverse"`.

    Raises:
        ConfigError: no such robot, or settings that cannot work.
    """
    if type not in RobotConfig.get_known_choices():
        raise ConfigError(f"There is no robot {type!r}: make_robot takes locobot_sim or locobot.")
    return make_locobot(RobotConfig.get_choice_class(type)(**settings), seed, "make_robot")


def load_grasps(path_or_repo: str | Path, policy: str | Path | None = None) -> pd.DataFrame:
    """The grasp attempts of a dataset, a row each; `docs/analysis.md` explains the columns.

    Args:
        path_or_repo: a dataset's folder, or `user/repo[@revision]` on the Hub.
        policy: as in `load_policy`; adds what it expects of each attempt.

    Raises:
        DatasetError: it is no relmm dataset, or of another camera than the policy's.
        ConfigError: there is no such policy.
    """
    predictor = None if policy is None else Predictor(load_policy(policy).policy)
    with tempfile.TemporaryDirectory(prefix="relmm-grasps-") as folder:
        collect(local_root(str(path_or_repo)), Path(folder), predictor)
        return pd.read_parquet(Path(folder) / GRASPS)
