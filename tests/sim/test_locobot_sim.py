from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from relmm.errors import ConfigError, RelmmError
from relmm.features import BASKET_XY, GRID, MAX_THETA_VEL, MAX_X_VEL, STATE_NAMES, Skill, action_dict, cell_to_xy
from relmm.sim import rooms
from relmm.sim.config_locobot_sim import LocobotSimConfig
from relmm.sim.locobot_sim import LocobotSim
from relmm.sim.rooms import Room, register_room, room_names


@pytest.fixture
def registry(monkeypatch: pytest.MonkeyPatch) -> None:
    """A copy, so that a test's rooms end with it."""
    monkeypatch.setattr(rooms, "_ROOMS", dict(rooms._ROOMS))


def random_action(rng: np.random.Generator) -> dict[str, float]:
    skill = Skill(int(rng.choice(3, p=[0.6, 0.2, 0.2])))
    x, y = BASKET_XY if rng.random() < 0.2 else cell_to_xy(int(rng.integers(GRID**2)))
    return action_dict(skill, rng.uniform(0, MAX_X_VEL), rng.uniform(-MAX_THETA_VEL, MAX_THETA_VEL), x, y)


# --- Every room ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("camera", ["paper", "d435"])
@pytest.mark.parametrize("room", room_names())
def test_every_room_can_be_lived_in(room: str, camera: str) -> None:
    robot = LocobotSim(LocobotSimConfig(room=room, camera=camera, seed=3, depth=True))
    robot.connect()
    rng = np.random.default_rng(0)
    for _ in range(10):
        sent = robot.send_action(random_action(rng))
        assert np.isfinite(list(sent.values())).all()
        observation = robot.get_observation()
        assert observation.keys() == robot.observation_features.keys()
        assert all(type(observation[name]) is float and np.isfinite(observation[name]) for name in STATE_NAMES)
        assert (observation["front"].shape, observation["front"].dtype) == ((100, 100, 3), np.uint8)
        assert (observation["front_depth"].shape, observation["front_depth"].dtype) == ((100, 100, 1), np.uint16)
        assert observation["front"].std() > 2, "a picture of one colour shows nothing"
    assert robot.body.truth.lost().size == 0
    robot.disconnect()


@pytest.mark.parametrize("room", room_names())
def test_every_room_holds_what_it_promises(room: str) -> None:
    robot = LocobotSim(LocobotSimConfig(room=room))
    robot.connect()
    assert len(robot.body.truth.objects()) == robot.body.room.num_objects
    robot.disconnect()


# --- Seeds ---------------------------------------------------------------------------------------------------
def test_connecting_with_a_seed_and_resetting_to_it_begin_the_same_life() -> None:
    connected, reset = (LocobotSim(LocobotSimConfig(seed=seed)) for seed in (11, 12))
    connected.connect()
    reset.connect()
    reset.send_action(action_dict(x_vel=0.4))
    reset.reset(11)
    rng = np.random.default_rng(0)
    for action in [random_action(rng) for _ in range(10)]:
        assert connected.send_action(action) == reset.send_action(action)
    np.testing.assert_array_equal(connected.body.data.qpos, reset.body.data.qpos)
    np.testing.assert_array_equal(connected.get_observation()["front"], reset.get_observation()["front"])
    connected.disconnect()
    reset.disconnect()


def test_another_seed_shows_another_picture() -> None:
    robot = LocobotSim(LocobotSimConfig(seed=0))
    robot.connect()
    before = robot.get_observation()["front"]
    robot.reset(1)
    assert np.abs(robot.get_observation()["front"].astype(int) - before).mean() > 1
    robot.disconnect()


# --- Configuration -------------------------------------------------------------------------------------------
def test_a_room_of_another_package_works(registry: None) -> None:
    @register_room("corridor")
    @dataclass(frozen=True, kw_only=True)
    class Corridor(Room):
        size: tuple[float, float] = (4.0, 1.2)
        num_objects: int = 5
        objects: tuple[str, ...] = ("duck", "sock")

    robot = LocobotSim(LocobotSimConfig(room="corridor"))
    robot.connect()
    robot.send_action(action_dict(x_vel=0.4))
    assert len(robot.body.truth.objects()) == 5
    assert robot.get_observation()["front"].shape == (100, 100, 3)
    robot.disconnect()


def test_an_unknown_room_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError) as error:
        LocobotSimConfig(room="no_such_room")
    assert "'no_such_room'" in str(error.value)
    assert all(name in str(error.value) for name in ("no_obstacles", "obstacles", "diverse", "obstacles_rugs"))


@pytest.mark.parametrize(
    "setting",
    [{"num_objects": 0}, {"num_objects": -3}, {"num_objects": 101}, {"camera": "fisheye"}, {"room": ""}],
    ids=str,
)
def test_settings_that_cannot_work_are_refused_in_one_sentence(setting: dict[str, object]) -> None:
    with pytest.raises(ConfigError) as error:
        LocobotSimConfig(**setting)
    message = str(error.value)
    assert "\n" not in message
    assert message.endswith(".")
    assert len(message) < 300


def test_more_objects_than_fit_are_refused_before_anything_moves(registry: None) -> None:
    @register_room("closet")
    @dataclass(frozen=True, kw_only=True)
    class Closet(Room):
        size: tuple[float, float] = (1.1, 1.1)

    with pytest.raises(ConfigError, match="no space for 80 objects"):
        LocobotSim(LocobotSimConfig(room="closet", num_objects=80)).connect()


def test_config_errors_are_value_errors_of_the_family() -> None:
    assert issubclass(ConfigError, ValueError)
    assert issubclass(ConfigError, RelmmError)
