"""`--env.type=relmm_room`."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end

from relmm.errors import ConfigError
from relmm.features import ACTION_NAMES, FRONT, IMAGE_KEY, IMAGE_SIZE, STATE_KEY, STATE_NAMES
from relmm.sim.config_locobot_sim import LocobotSimConfig

ENV_ID = "gym_relmm_room/Room-v0"
if ENV_ID not in gym.registry:
    gym.register(ENV_ID, entry_point="relmm.sim.env:RelmmRoomEnv")


def _make_room(gym_kwargs: dict[str, Any]) -> gym.Env[Any, Any]:
    """A room; defined here so that worker processes, which look it up by name, register the environment first."""
    return gym.make(ENV_ID, disable_env_checker=True, **gym_kwargs)


@EnvConfig.register_subclass("relmm_room")
@dataclass
class RelmmRoomEnvConfig(EnvConfig):
    """The paper's evaluation: a room with scattered objects, 250 navigation steps, no pseudo-reset.

    Args:
        room, num_objects, camera: as in `LocobotSimConfig`.
        navigation_steps: length of an episode.
    """

    task: str | None = "Room-v0"
    fps: int = 8
    room: str = "no_obstacles"
    num_objects: int | None = None
    camera: str = "paper"
    navigation_steps: int = 250
    render_mode: str = "rgb_array"
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            "action": PolicyFeature(type=FeatureType.ACTION, shape=(len(ACTION_NAMES),)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(len(STATE_NAMES),)),
            f"pixels/{FRONT}": PolicyFeature(type=FeatureType.VISUAL, shape=(IMAGE_SIZE, IMAGE_SIZE, 3)),
        }
    )
    features_map: dict[str, str] = field(
        default_factory=lambda: {"action": "action", "agent_pos": STATE_KEY, f"pixels/{FRONT}": IMAGE_KEY}
    )

    def __post_init__(self) -> None:
        if self.navigation_steps < 1:
            raise ConfigError(f"env.navigation_steps is {self.navigation_steps}, but must be at least 1.")
        LocobotSimConfig(room=self.room, num_objects=self.num_objects, camera=self.camera)

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """As LeRobot's own, but a room whose episode has ended stands still until the slowest one has.

        Otherwise gymnasium starts its next episode at once, and the first reward of that one counts for the last.
        """
        make = freeze_after_episode_end(partial(_make_room, self.gym_kwargs))
        mode = gym.vector.AutoresetMode.SAME_STEP
        rooms: gym.vector.VectorEnv
        if use_async_envs and n_envs > 1:
            # An OpenGL context does not survive a fork.
            rooms = gym.vector.AsyncVectorEnv([make] * n_envs, autoreset_mode=mode, context="forkserver")
        else:
            rooms = gym.vector.SyncVectorEnv([make] * n_envs, autoreset_mode=mode)
        return {self.type: {0: rooms}}

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `RelmmRoomEnv`."""
        return {
            "room": self.room,
            "num_objects": self.num_objects,
            "camera": self.camera,
            "navigation_steps": self.navigation_steps,
            "render_mode": self.render_mode,
        }
