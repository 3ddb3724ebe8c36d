from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from relmm.features import BASKET_XY, GRASP_X, GRASP_Y, MAX_THETA_VEL, MAX_X_VEL, STATE_NAMES, Skill
from relmm.sim import ENV_ID
from relmm.sim.wrappers import standard_spaces


@pytest.fixture
def env() -> Iterator[gym.Env[Any, Any]]:
    env = standard_spaces(gym.make(ENV_ID, num_objects=3, navigation_steps=5))
    yield env
    env.close()


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_gymnasium_finds_nothing_wrong(env: gym.Env[Any, Any]) -> None:
    check_env(env, skip_render_check=True)


def test_spaces_are_what_stable_baselines3_takes(env: gym.Env[Any, Any]) -> None:
    """Actions of -1..1 in a box, and observations of one level of boxes, pictures of uint8."""
    assert env.action_space == gym.spaces.Box(-1.0, 1.0, (5,), np.float32)
    assert isinstance(env.observation_space, gym.spaces.Dict)
    shapes = {name: (space.shape, space.dtype) for name, space in env.observation_space.items()}
    assert shapes == {"front": ((100, 100, 3), np.uint8), "state": ((len(STATE_NAMES),), np.float32)}
    assert all(isinstance(space, gym.spaces.Box) for space in env.observation_space.values())
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert env.observation_space.contains(env.step(env.action_space.sample())[0])


@pytest.mark.filterwarnings("ignore:.*The observations returned:UserWarning")  # of a robot that is kept from moving
def test_actions_are_stretched_to_what_the_robot_can_do(
    env: gym.Env[Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    env.reset(seed=0)
    robot, sent = env.unwrapped.robot, []  # type: ignore[attr-defined]
    monkeypatch.setattr(robot, "send_action", lambda action: sent.append(action) or action)
    ends = ([-1] * 5, [1, 1, -1, 1, 1], [0, 0, 0, -1, 1], [0, 0, 1, 0.3, -0.7], [9, -9, -0.4, 9, -9])
    for action in ends:
        env.step(np.array(action, np.float32))
    wanted = [
        [0, -MAX_THETA_VEL, Skill.NAVIGATE, GRASP_X[0], GRASP_Y[0]],
        [MAX_X_VEL, MAX_THETA_VEL, Skill.NAVIGATE, GRASP_X[1], GRASP_Y[1]],
        [MAX_X_VEL / 2, 0, Skill.GRASP, GRASP_X[0], GRASP_Y[1]],
        [MAX_X_VEL / 2, 0, Skill.PLACE, *BASKET_XY],
        [MAX_X_VEL, -MAX_THETA_VEL, Skill.NAVIGATE, GRASP_X[1], GRASP_Y[0]],
    ]
    np.testing.assert_allclose([list(action.values()) for action in sent], wanted, atol=1e-5)


def test_a_grasp_and_any_placement_after_it_are_rewarded(env: gym.Env[Any, Any]) -> None:
    """So that a learner which acts at random comes upon a reward now and then."""
    env.reset(seed=0)
    robot = env.unwrapped.robot  # type: ignore[attr-defined]
    robot.body.put_object(0, np.array([np.mean(GRASP_X), 0.0]))
    robot.skills.forget_picture()
    rewards = [env.step(np.array([0.2, 0.2, skill, 0, 0], np.float32))[1] for skill in (0.1, 0.9)]
    assert rewards == [0.0, 1.0]


def test_one_import_is_all_that_gymnasium_needs() -> None:
    code = (
        "import sys, gymnasium, relmm.sim; gymnasium.make('relmm/Room-v0', room='diverse', num_objects=3).close(); "
        "print(sorted({'torch', 'datasets'} & sys.modules.keys()))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
