from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from relmm.errors import ConfigError
from relmm.features import (
    ACTION_NAMES,
    BASKET_XY,
    GRASP_X,
    MAX_THETA_VEL,
    MAX_X_VEL,
    Skill,
    action_dict,
    in_grasp_area,
)
from relmm.sim import ENV_ID, rooms
from relmm.sim.config_relmm_room import RelmmRoomEnvConfig
from relmm.sim.env import RelmmRoomEnv
from relmm.sim.rooms import Room, register_room, set_objects


@pytest.fixture
def env() -> Iterator[RelmmRoomEnv]:
    env = RelmmRoomEnv(num_objects=5, navigation_steps=6)
    env.reset(seed=0)
    yield env
    env.close()


def to_array(action: dict[str, float]) -> np.ndarray:
    return np.array([action[name] for name in ACTION_NAMES], np.float32)


def act(env: RelmmRoomEnv, skill: Skill = Skill.NAVIGATE, **values: float) -> tuple[Any, float, bool, bool, Any]:
    return env.step(to_array(action_dict(skill, **values)))


def drives(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [
        to_array(action_dict(x_vel=rng.uniform(0, MAX_X_VEL), theta_vel=rng.uniform(-MAX_THETA_VEL, MAX_THETA_VEL)))
        for _ in range(count)
    ]


def object_in_front(env: RelmmRoomEnv) -> tuple[float, float]:
    """Put object 0 in reach, and say where (m, robot frame)."""
    body = env.robot.body
    x, y, heading = body.truth.robot()
    poses = np.column_stack([body.truth.objects()[:, :2], np.zeros(body.room.num_objects)])
    poses[0, :2] = x + 0.4 * np.cos(heading), y + 0.4 * np.sin(heading)
    set_objects(body.model, body.data, poses)
    body.wait(0.3)
    xy = body.truth.objects_in_robot_frame()[0, :2]
    assert in_grasp_area(*xy)
    return float(xy[0]), float(xy[1])


# --- Gymnasium's rules ---------------------------------------------------------------------------------------
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_gymnasium_finds_nothing_wrong() -> None:
    env = gym.make(ENV_ID, num_objects=3, navigation_steps=3, render_mode="rgb_array")
    check_env(env.unwrapped)
    env.close()


def test_gymnasium_has_no_warnings_about_the_spaces() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        RelmmRoomEnv(num_objects=3).close()


def test_observations_are_in_their_space(env: RelmmRoomEnv) -> None:
    observation, _ = env.reset(seed=1)
    assert env.observation_space.contains(observation)
    for action in drives(3):
        assert env.observation_space.contains(env.step(action)[0])


def test_pictures_are_rendered_only_on_request() -> None:
    env = RelmmRoomEnv(num_objects=3)
    env.reset(seed=0)
    assert env.render() is None
    env.close()


def test_a_window_is_refused_in_a_sentence() -> None:
    with pytest.raises(ConfigError, match="render_mode is 'human', but must be rgb_array or None: show what render"):
        RelmmRoomEnv(render_mode="human")


def test_closing_twice_does_nothing(env: RelmmRoomEnv) -> None:
    env.close()
    env.close()


# --- Episodes ------------------------------------------------------------------------------------------------
def test_250_navigation_steps_end_an_episode() -> None:
    env = RelmmRoomEnv()
    env.reset(seed=0)
    ends = [env.step(action)[2:4] for action in drives(250)]
    assert ends == [(False, False)] * 249 + [(False, True)]
    env.close()


def test_two_grasps_after_a_navigation_step_are_free_and_further_ones_are_not(env: RelmmRoomEnv) -> None:
    counted = []
    for skill in [Skill.GRASP] * 4 + [Skill.NAVIGATE] + [Skill.GRASP] * 3:
        counted.append(act(env, skill, x=GRASP_X[0], y=0.08)[4]["navigation_steps"])
    assert counted == [0, 0, 1, 2, 3, 3, 3, 4]


def test_charged_grasps_end_an_episode_too(env: RelmmRoomEnv) -> None:
    truncated = [act(env, Skill.GRASP, x=GRASP_X[0], y=0.08)[3] for _ in range(8)]
    assert truncated == [False] * 7 + [True]


def test_collecting_everything_is_success_and_ends_the_episode() -> None:
    env = RelmmRoomEnv(num_objects=1)
    env.reset(seed=0)
    x, y = object_in_front(env)
    _, reward, terminated, truncated, info = act(env, Skill.GRASP, x=x, y=y)
    assert (reward, terminated, truncated, info["objects_collected"]) == (0.0, False, False, 0)
    assert (info["grasp_attempts"], info["grasp_successes"], info["grasp_successes_judged"]) == (1, 1, 1)
    _, reward, terminated, truncated, info = act(env, Skill.PLACE, x=BASKET_XY[0], y=BASKET_XY[1])
    assert (reward, terminated, truncated) == (1.0, True, False)
    assert (info["is_success"], info["objects_collected"], info["objects_total"]) == (True, 1, 1)
    env.close()


def test_putting_down_and_grasping_again_earns_nothing(env: RelmmRoomEnv) -> None:
    x, y = object_in_front(env)
    rewards, judged = [], 0
    for _ in range(3):
        _, reward, _, _, info = act(env, Skill.GRASP, x=x, y=y)
        _, another, _, _, _ = act(env, Skill.PLACE, x=x, y=y)
        x, y = env.robot.body.truth.objects_in_robot_frame()[0, :2].tolist()
        rewards += [reward, another]
        judged = info["grasp_successes_judged"]
    assert judged >= 2
    assert rewards == [0.0] * 6


def test_lerobot_steps_long_enough_for_the_busiest_episode(env: RelmmRoomEnv) -> None:
    """After each of 6 navigation steps two grasps that succeed, and both things are put into the basket."""
    assert env._max_episode_steps == 6 * (1 + 2 + 2)


def test_an_empty_grasp_counts_as_an_attempt_and_earns_nothing(env: RelmmRoomEnv) -> None:
    _, reward, _, _, info = act(env, Skill.GRASP, x=GRASP_X[0], y=0.0)
    assert reward == 0.0
    assert (info["grasp_attempts"], info["grasp_successes"], info["grasp_successes_judged"]) == (1, 0, 0)


def test_a_new_episode_counts_from_zero(env: RelmmRoomEnv) -> None:
    act(env, Skill.GRASP, x=0.4)
    act(env, x_vel=0.3)
    _, info = env.reset(seed=1)
    counts = ("navigation_steps", "grasp_attempts", "grasp_successes", "grasp_successes_judged", "objects_collected")
    assert [info[name] for name in counts] == [0] * 5
    assert info["metres_driven"] == pytest.approx(0.0, abs=1e-3)


# --- Seeds ---------------------------------------------------------------------------------------------------
def test_the_same_seed_gives_the_same_episode(env: RelmmRoomEnv) -> None:
    episodes = []
    for _ in range(2):
        first, _ = env.reset(seed=7)
        episodes.append([first, *(env.step(action)[0] for action in drives(5))])
    for one, other in zip(*episodes, strict=True):
        np.testing.assert_array_equal(one["pixels"]["front"], other["pixels"]["front"])
        np.testing.assert_array_equal(one["agent_pos"], other["agent_pos"])


def test_resets_without_a_seed_differ_but_repeat_after_a_seeded_one(env: RelmmRoomEnv) -> None:
    lives = []
    for _ in range(2):
        env.reset(seed=7)
        lives.append([env.reset()[0]["pixels"]["front"] for _ in range(2)])
    np.testing.assert_array_equal(lives[0], lives[1])
    assert np.any(lives[0][0] != lives[0][1])


def test_vectorised_rooms_give_what_single_ones_give() -> None:
    make = RelmmRoomEnvConfig(num_objects=5).gym_kwargs
    rooms_ = gym.vector.SyncVectorEnv([lambda: RelmmRoomEnv(**make)] * 2)
    batches = [rooms_.reset(seed=[3, 4])[0]]
    actions = drives(10)
    for i in range(5):
        batches.append(rooms_.step(np.stack([actions[i], actions[5 + i]]))[0])
    rooms_.close()
    for row, seed in enumerate((3, 4)):
        env = RelmmRoomEnv(**make)
        single = [env.reset(seed=seed)[0], *(env.step(action)[0] for action in actions[5 * row : 5 * row + 5])]
        for one, batch in zip(single, batches, strict=True):
            np.testing.assert_array_equal(one["pixels"]["front"], batch["pixels"]["front"][row])
            np.testing.assert_array_equal(one["agent_pos"], batch["agent_pos"][row])
        env.close()


def test_room_stands_still_after_its_episode_until_another_is_asked_for() -> None:
    """As lerobot-eval steps it until the slowest room has ended, and gymnasium resets it meanwhile."""
    rooms_ = RelmmRoomEnvConfig(num_objects=5, navigation_steps=3).create_envs(2)["relmm_room"][0]
    first = rooms_.reset(seed=[3, 4])[0]
    drive = np.stack([drives(1)[0]] * 2)
    ends = [bool(rooms_.step(drive)[3].all()) for _ in range(3)]
    assert ends == [False, False, True]
    seen, rewards, _, truncated, info = rooms_.step(drive)
    again = rooms_.step(drive)[0]
    assert rewards.tolist() == [0.0, 0.0]
    assert truncated.all()
    assert info["final_info"]["navigation_steps"].tolist() == [3, 3]
    np.testing.assert_array_equal(seen["pixels"]["front"], again["pixels"]["front"])
    np.testing.assert_array_equal(rooms_.reset(seed=[3, 4])[0]["pixels"]["front"], first["pixels"]["front"])
    assert not rooms_.step(drive)[3].any()
    rooms_.close()


# --- Configuration -------------------------------------------------------------------------------------------
def test_a_room_of_another_package_works(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rooms, "_ROOMS", dict(rooms._ROOMS))

    @register_room("hall")
    @dataclass(frozen=True, kw_only=True)
    class Hall(Room):
        size: tuple[float, float] = (5.0, 2.0)
        num_objects: int = 4

    env = RelmmRoomEnv(**RelmmRoomEnvConfig(room="hall").gym_kwargs)
    _, info = env.reset(seed=0)
    assert info["objects_total"] == 4
    env.step(drives(1)[0])
    assert env.render().shape[2] == 3
    env.close()


@pytest.mark.parametrize(
    "setting", [{"navigation_steps": 0}, {"num_objects": 0}, {"room": "no_such_room"}, {"camera": "fisheye"}], ids=str
)
def test_settings_that_cannot_work_are_refused_in_one_sentence(setting: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as error:
        RelmmRoomEnvConfig(**setting)
    assert "\n" not in str(error.value)
    assert str(error.value).endswith(".")
