"""The paper's evaluation as a gymnasium environment: how much of a room does a policy clean in 250 navigation steps?"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from relmm.errors import ConfigError
from relmm.features import (
    ACTION_NAMES,
    FREE_GRASPS,
    FRONT,
    IMAGE_SIZE,
    MAX_THETA_VEL,
    MAX_X_VEL,
    STATE_NAMES,
    TASK,
    Skill,
)
from relmm.sim.config_locobot_sim import LocobotSimConfig
from relmm.sim.film import Scene
from relmm.sim.locobot_sim import LocobotSim

SUCCESS_SHARE = 0.9  # of the objects must be in the basket
_REACH = 1.0  # m; skill_x and skill_y lie within +-this


class RelmmRoomEnv(gym.Env[dict[str, Any], NDArray[np.float32]]):
    """One LoCoBot in one room; an episode scatters the objects anew and lasts a number of navigation steps.

    Observations: `pixels` (`front`: uint8 (100, 100, 3)) and `agent_pos` (float32, `relmm.features.STATE_NAMES`).
    Actions: float32, `relmm.features.ACTION_NAMES`. What is picked up counts as collected once it lies in the robot's
    basket (a placement at `BASKET_XY`). Reward: how many objects more than before lie there, so that an episode's
    rewards add up to what was collected. `info` tells how many grasps the robot itself judged to be successes.

    Args:
        room, num_objects, camera: as in `LocobotSimConfig`.
        navigation_steps: length of an episode. Up to two grasp attempts after a navigation step are free, further ones
            count as a step.
        render_mode: `rgb_array` or None.

    Raises:
        ConfigError: settings that cannot work.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 8}  # noqa: RUF012 (gymnasium reads it from the class)
    task = "Room-v0"
    task_description = TASK

    def __init__(
        self,
        room: str = "no_obstacles",
        num_objects: int | None = None,
        camera: str = "paper",
        navigation_steps: int = 250,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError(
                f"render_mode is {render_mode!r}, but must be rgb_array or None: show what render() returns, or make "
                "the room by gymnasium.make, which shows it itself if pygame is installed."
            )
        self.render_mode = render_mode
        self.navigation_steps = navigation_steps
        # An upper bound on calls of `step`, which LeRobot asks for: each navigation step, and its free grasps, each
        # with the placement of what it picked up.
        self._max_episode_steps = navigation_steps * (1 + 2 * FREE_GRASPS)
        self.robot = LocobotSim(LocobotSimConfig(room=room, num_objects=num_objects, camera=camera))
        self._scene: Scene | None = None
        limit = np.array([MAX_X_VEL, MAX_THETA_VEL, max(Skill), _REACH, _REACH], np.float32)
        self.action_space = gym.spaces.Box(limit * np.array([0, -1, 0, -1, -1], np.float32), limit, dtype=np.float32)
        image = gym.spaces.Box(0, 255, (IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
        self.observation_space = gym.spaces.Dict(
            {
                "pixels": gym.spaces.Dict({FRONT: image}),
                "agent_pos": gym.spaces.Box(-np.inf, np.inf, (len(STATE_NAMES),), np.float32),
            }
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Scatter the objects by `seed`, or by the environment's own random numbers without one."""
        super().reset(seed=seed)
        if not self.robot.is_connected:
            self.robot.connect()
        self.robot.reset(int(self.np_random.integers(2**31)) if seed is None else seed)
        self._steps = self._free_grasps_used = self._judged = self._attempts = self._true_successes = 0
        info = self._info()
        self._collected = info["objects_collected"]
        return self._observe(), info

    def step(self, action: NDArray[np.float32]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Run one skill; see the class."""
        done = self.robot.send_action(dict(zip(ACTION_NAMES, action.tolist(), strict=True)))
        match Skill(int(done["skill.pos"])):
            case Skill.NAVIGATE:
                self._steps, self._free_grasps_used = self._steps + 1, 0
            case Skill.GRASP:
                self._steps += self._free_grasps_used >= FREE_GRASPS
                self._free_grasps_used += 1
                self._attempts += 1
                self._true_successes += self.robot.body.truth.held()
                self._judged += self.robot.skills.holding
        info = self._info()
        reward = float(info["objects_collected"] - self._collected)
        self._collected = info["objects_collected"]
        terminated = info["objects_collected"] == info["objects_total"]
        return self._observe(), reward, terminated, self._steps >= self.navigation_steps and not terminated, info

    def render(self) -> NDArray[np.uint8] | None:
        """The robot's view beside the room from above, uint8 (480, 880, 3)."""
        if self.render_mode != "rgb_array":
            return None
        if self._scene is None:
            self._scene = Scene(self.robot.body)
        return self._scene.picture()

    def close(self) -> None:
        """Stop the robot and free the renderers."""
        if self._scene is not None:
            self._scene.close()
            self._scene = None
        self.robot.disconnect()

    def _observe(self) -> dict[str, Any]:
        observation = self.robot.get_observation()
        state = np.array([observation[name] for name in STATE_NAMES], np.float32)
        return {"pixels": {FRONT: observation[FRONT]}, "agent_pos": state}

    def _info(self) -> dict[str, Any]:
        truth, total, state = self.robot.body.truth, self.robot.body.room.num_objects, self.robot.body.state()
        collected = len(truth.in_basket())
        return {
            "is_success": collected >= SUCCESS_SHARE * total,
            "objects_collected": collected,
            "objects_total": total,
            "objects_lost": len(truth.lost()),
            "navigation_steps": self._steps,
            "grasp_attempts": self._attempts,
            "grasp_successes": self._true_successes,
            "grasp_successes_judged": self._judged,
            "robot_seconds": state.time,
            "metres_driven": state.travelled,
        }
