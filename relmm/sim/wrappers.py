"""A room as learners outside of LeRobot take it, Stable-Baselines3's for example."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import RescaleAction
from numpy.typing import NDArray

from relmm.features import FRONT


class FlatObservation(gym.ObservationWrapper[Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Observations of one level: `front` (uint8 (100, 100, 3)) and `state` (float32, `relmm.features.STATE_NAMES`).

    Args:
        env: a `RelmmRoomEnv`, or one wrapped.
    """

    def __init__(self, env: gym.Env[dict[str, Any], Any]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)  # `gymnasium.make` can make it again from its spec
        gym.ObservationWrapper.__init__(self, env)
        spaces = env.observation_space
        assert isinstance(spaces, gym.spaces.Dict)
        self.observation_space = gym.spaces.Dict(
            {FRONT: spaces["pixels"][FRONT], "state": spaces["agent_pos"]}  # type: ignore[index]
        )

    def observation(self, observation: dict[str, Any]) -> dict[str, NDArray[Any]]:
        """See the class."""
        return {FRONT: observation["pixels"][FRONT], "state": observation["agent_pos"]}


def standard_spaces(env: gym.Env[dict[str, Any], NDArray[np.float32]]) -> gym.Env[Any, Any]:
    """A room with `FlatObservation` and with actions of -1..1, which are stretched to the ranges of the robot's."""
    return RescaleAction(FlatObservation(env), np.float32(-1), np.float32(1))
