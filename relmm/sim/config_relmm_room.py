"""`--env.type=relmm_room`."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig

from relmm.errors import MANY, check_range
from relmm.features import ACTION_NAMES, FRONT, IMAGE_KEY, IMAGE_SIZE, STATE_KEY, STATE_NAMES
from relmm.sim import ENV_ID
from relmm.sim.config_locobot_sim import LocobotSimConfig


class OneEpisode(gym.Wrapper[Any, Any, Any, Any]):
    """A room that stands still when its episode has ended, until somebody asks for another one.

    `lerobot-eval` steps its rooms until the slowest has ended, and gymnasium meanwhile starts a next episode of the
    others, whose first reward would count for the last. Only gymnasium resets without arguments. (LeRobot has had
    `FreezeAfterEpisodeEnd` for this since 0.6.1.)
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self._end: tuple[Any, dict[str, Any]] | None = None

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """See gymnasium."""
        if self._end is not None and not kwargs:
            return self._end
        self._end = None
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """See gymnasium; a step after the end changes and earns nothing."""
        if self._end is not None:
            observation, info = self._end
            return observation, 0.0, False, True, info
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated or truncated:
            self._end = observation, info
        return observation, reward, terminated, truncated, info


def _make_room(gym_kwargs: dict[str, Any]) -> gym.Env[Any, Any]:
    """A room; a function of a module, which worker processes look up by name."""
    return OneEpisode(gym.make(ENV_ID, disable_env_checker=True, **gym_kwargs))


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
        check_range("env.navigation_steps", self.navigation_steps, 1, MANY)
        LocobotSimConfig(room=self.room, num_objects=self.num_objects, camera=self.camera)

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """As LeRobot's own, but of `OneEpisode`."""
        make = partial(_make_room, self.gym_kwargs)
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
