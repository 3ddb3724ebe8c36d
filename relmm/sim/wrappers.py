"""A room as learners outside of LeRobot take it, Stable-Baselines3's for example."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from relmm.features import (
    ACTION_NAMES,
    BASKET_XY,
    FRONT,
    GRASP_X,
    GRASP_Y,
    MAX_THETA_VEL,
    MAX_X_VEL,
    Skill,
    action_dict,
)


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


class SkillActions(gym.ActionWrapper[Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Actions of -1..1, by `relmm.features.ACTION_NAMES`, of which every one does something sensible.

    Speeds are stretched to the robot's limits; the skill is the third of the range that its number lies in, navigate,
    grasp, place; a grasp's two numbers are stretched to where the arm can grasp; and a placement goes into the basket:
    all that the reward counts, and 0.2 % of the floor that a placement could otherwise be at.

    Args:
        env: a `RelmmRoomEnv`, or one wrapped.
    """

    def __init__(self, env: gym.Env[Any, NDArray[np.float32]]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.ActionWrapper.__init__(self, env)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (len(ACTION_NAMES),), np.float32)

    def action(self, action: NDArray[np.float32]) -> NDArray[np.float32]:
        """See the class."""
        drive, turn, skill, forward, left = ((np.clip(action, -1, 1) + 1) / 2).tolist()
        chosen = Skill(min(int(skill * len(Skill)), max(Skill)))
        place = (np.interp(forward, (0, 1), GRASP_X), np.interp(left, (0, 1), GRASP_Y))
        x, y = BASKET_XY if chosen == Skill.PLACE else place
        values = action_dict(chosen, drive * MAX_X_VEL, (2 * turn - 1) * MAX_THETA_VEL, float(x), float(y))
        return np.array(list(values.values()), np.float32)


def standard_spaces(env: gym.Env[dict[str, Any], NDArray[np.float32]]) -> gym.Env[Any, Any]:
    """A room with `FlatObservation` and `SkillActions`."""
    return SkillActions(FlatObservation(env))
