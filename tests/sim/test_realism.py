"""A simulated robot as bad as a real one: reproducible, as bad as it says, and never worse than it can work with."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from relmm.errors import ConfigError
from relmm.features import MAX_X_VEL, action_dict
from relmm.geometry import camera_geometry
from relmm.sim.body import SimBody
from relmm.sim.config_locobot_sim import LocobotSimConfig
from relmm.sim.locobot_sim import LocobotSim
from relmm.sim.realism import REALISM, Realism
from relmm.sim.rooms import make_room


def body(level: str, seed: int = 0) -> SimBody:
    made = SimBody(make_room("no_obstacles", num_objects=5), camera_geometry("d435"), REALISM[level])
    made.reset(np.random.default_rng(seed))
    return made


def look(level: str, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    made = body(level, seed)
    try:
        return made.capture()
    finally:
        made.close()


def test_levels_grow_in_everything():
    for field in fields(Realism):
        none, mild, harsh = (getattr(REALISM[level], field.name) for level in ("none", "mild", "harsh"))
        assert none == 0.0 < mild < harsh, field.name


def test_unknown_level_is_one_sentence():
    with pytest.raises(ConfigError, match=r"robot.realism is 'hars' \(did you mean harsh\?\), but must be one of none"):
        LocobotSimConfig(realism="hars")


@pytest.mark.parametrize("level", ["none", "mild", "harsh"])
def test_same_seed_gives_same_pictures(level):
    (rgb, depth), (again, depth_again) = look(level), look(level)
    assert np.array_equal(rgb, again)
    assert np.array_equal(depth, depth_again)


def test_pictures_differ_more_the_worse_they_are():
    clean, mild, harsh = (look(level)[0].astype(float) for level in ("none", "mild", "harsh"))
    assert 0.5 < np.abs(mild - clean).mean() < np.abs(harsh - clean).mean() < 100


def test_depth_has_holes_and_noise():
    clean, harsh = look("none")[1].astype(float), look("harsh")[1].astype(float)
    assert (clean == 0).mean() < 0.01
    assert 0.08 < (harsh == 0).mean() < 0.4
    both = (clean > 0) & (harsh > 0)
    assert 1.0 < np.median(np.abs(clean - harsh)[both]) < 60


def test_another_life_is_another_robot():
    made = body("harsh")
    try:
        first = made.model.cam_pos.copy(), made.model.body_mass.copy(), made._imperfections.travel_scale
        made.reset(np.random.default_rng(1))
        second = made.model.cam_pos, made.model.body_mass, made._imperfections.travel_scale
        assert all(not np.array_equal(a, b) for a, b in zip(first, second, strict=True))
    finally:
        made.close()


def test_commands_arrive_late_and_stop_at_once():
    made = body("harsh")
    try:
        made.drive(MAX_X_VEL, 0.0)
        made.wait(0.3)
        assert made.state().travelled > 0.01
        made.drive(MAX_X_VEL, 0.0)
        made.stop()
        made.wait(0.3)
        before = made.state().travelled
        made.wait(0.3)
        assert made.state().travelled == pytest.approx(before, abs=2e-3)
    finally:
        made.close()


def test_robot_lives_with_it():
    robot = LocobotSim(LocobotSimConfig(realism="harsh", camera="d435", num_objects=5))
    robot.connect()
    try:
        robot.send_action(action_dict(x_vel=MAX_X_VEL))
        observation = robot.get_observation()
    finally:
        robot.disconnect()
    assert 0.1 < observation["x.vel"] < 0.7  # its commands may take 0.1 s more or less to begin and to end
    assert observation["scan_20.pos"] > 0.3
