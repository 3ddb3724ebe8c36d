"""What relmm-calibrate measures: against planes and maps that are known, and on an emulated robot."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace

import numpy as np
import pytest

from relmm.errors import ConfigError, RobotError
from relmm.geometry import CAMERAS, CameraGeometry
from relmm.robot.hardware.calibration import Calibration, load_calibration, save_calibration
from relmm.robot.hardware.config_locobot import LocobotConfig
from relmm.robot.hardware.locobot import Locobot
from relmm.robot.hardware.measuring import (
    _point,
    fit_grasp,
    floor_plane,
    measure_camera,
    measure_grasp,
    measure_wheels,
)
from relmm.robot.skills import REST_POSE

LENS = np.array([615.0, 615.3, 322.5, 238.5])


def floor_depth(height: float, pitch: float, rng: np.random.Generator) -> np.ndarray:
    """What a D435 measures of a floor, with noise, holes, and a thing on it."""
    columns, rows = np.meshgrid(np.arange(640), np.arange(480))
    axes = CameraGeometry((0, 0, height), pitch, (60.0, 60.0)).axes
    rays = np.stack([(columns - LENS[2]) / LENS[0], (rows - LENS[3]) / LENS[1], np.ones_like(rows)], -1) @ axes
    depth = height / -rays[..., 2] * 1000
    depth += rng.normal(0, 2, depth.shape)
    depth[200:300, 100:220] = 400
    depth[rng.random(depth.shape) < 0.1] = 0
    return np.rint(depth).astype(np.uint16)


@pytest.mark.parametrize(("height", "pitch"), [(0.4626, 47.27), (0.455, 45.5), (0.48, 50.0)])
def test_camera_is_found_over_a_real_floor(height, pitch):
    rng = np.random.default_rng(0)
    got = floor_plane(floor_depth(height, pitch, rng), LENS, rng)
    assert got[0] == pytest.approx(height, abs=0.002)
    assert got[1] == pytest.approx(pitch, abs=0.2)


def test_camera_that_sees_no_floor_is_one_sentence():
    rng = np.random.default_rng(0)
    depth = rng.integers(300, 1500, (480, 640)).astype(np.uint16)
    with pytest.raises(RobotError, match="of what the camera sees is floor: clear the floor"):
        floor_plane(depth, LENS, rng)


def test_touches_give_the_map_from_what_is_seen_to_where_to_go():
    truth = np.array([[1.02, 0.01, -0.006], [-0.015, 0.98, 0.004]])
    spots = np.array([(0.33, -0.05), (0.33, 0.05), (0.43, -0.05), (0.43, 0.05), (0.38, 0.0)])
    before = np.array([[1.0, 0.0, 0.001], [0.0, 1.0, 0.0]])
    sent = np.column_stack([spots, np.ones(5)]) @ before.T
    seen = (sent - truth[:, 2]) @ np.linalg.inv(truth[:, :2]).T
    assert fit_grasp(seen, spots, before) == pytest.approx(truth, abs=1e-9)


# --- The file ------------------------------------------------------------------------------------------------
def test_calibration_survives_its_file(tmp_path):
    calibration = replace(Calibration(), camera_height=0.47, sag=(0.0, -0.02, -0.01, 0.0, 0.0), wheel_scale=1.013)
    path = tmp_path / "robots" / "me.json"
    save_calibration(calibration, path)
    assert load_calibration(path) == calibration
    robot = Locobot(LocobotConfig(id="me", calibration_dir=tmp_path / "robots"))
    assert robot.is_calibrated
    assert robot.measured == calibration


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"camera_height": 4.0}, "camera_height is 4.0, but must be 0.3 to 0.8"),
        ({"camera_height": float("nan")}, "camera_height is nan"),
        ({"wheel_scale": "1"}, "measure again"),
        ({"sag": [0.0]}, "sag must be 5 numbers"),
        ({"grasp": [[2.0, 0, 0], [0, 1, 0]]}, "far from any real robot's"),
        ({"nonsense": 1}, "it holds nonsense"),
    ],
)
def test_damaged_calibration_is_one_sentence(tmp_path, change, words):
    path = tmp_path / "me.json"
    path.write_text(json.dumps(asdict(Calibration()) | change))
    with pytest.raises(ConfigError, match=words) as error:
        Locobot(LocobotConfig(id="me", calibration_dir=tmp_path))
    assert "measure again with relmm-calibrate, or delete it" in str(error.value)


# --- The command ---------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_command_measures_camera_gripper_and_sag(emulate):
    pytest.importorskip("serial", reason="pyserial is not installed (the extra `hardware`)")
    pytest.importorskip("dynamixel_sdk", reason="dynamixel-sdk is not installed (the extra `hardware`)")
    emulated = emulate(num_objects=1)
    done = emulated.run("relmm.commands.calibrate", "--robot.id=me", "--steps=[camera,gripper,arm]", said="\n\n\n")
    assert done.returncode == 0, done.stderr
    measured = load_calibration(emulated.folder / "calibration" / "me.json")
    assert measured.camera_height == pytest.approx(CAMERAS["d435"].position[2], abs=0.004)
    assert measured.camera_pitch == pytest.approx(CAMERAS["d435"].pitch, abs=0.3)
    assert measured.closed_opening == pytest.approx(0.0, abs=0.002)
    assert 0.01 < measured.arm_delay < 0.1
    assert np.abs(measured.sag).max() < 0.03, "the simulated arm hardly hangs"


# --- Errors that are known -----------------------------------------------------------------------------------
SPOTS = np.array([(0.33, -0.05), (0.33, 0.05), (0.43, -0.05), (0.43, 0.05), (0.38, 0.0)])


@pytest.fixture
def faulty(emulate, live_in_emulator):
    """Starts an emulated robot with faults; it, and the robot that drives it."""

    def start(**faults: float):
        emulated = emulate(num_objects=1, **faults)
        emulated.order("put", -0.6, 0.0)  # out of the way
        return emulated, live_in_emulator(emulated)

    return start


@pytest.mark.slow
@pytest.mark.parametrize(("height", "pitch"), [(0.012, 1.5), (-0.01, -2.0)])
def test_camera_that_hangs_elsewhere_is_found(faulty, height, pitch):
    _, robot = faulty(camera_height=height, camera_pitch=pitch)
    found = measure_camera(robot.body, np.random.default_rng(0))
    assert found["camera_height"] == pytest.approx(CAMERAS["d435"].position[2] + height, abs=0.002)
    assert found["camera_pitch"] == pytest.approx(CAMERAS["d435"].pitch + pitch, abs=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.95, 1.04])
def test_wheels_of_another_size_are_found(faulty, scale):
    emulated, robot = faulty(wheel_scale=scale)
    emulated.order("carry", 0.9, 0.0, 0.0)  # 0.6 m in front of a wall
    assert measure_wheels(robot.body, 1.0)["wheel_scale"] == pytest.approx(scale, abs=0.01)


@pytest.mark.slow
def test_waist_that_is_mounted_askew_is_found(faulty):
    """Three degrees, that is 2 cm aside at the grasp area."""
    emulated, robot = faulty(waist=3.0)

    def person(what: str) -> None:
        emulated.order("stick") if what.startswith("Put") else emulated.order("put", -0.6, 0.0)

    def errors() -> list[float]:
        """How far from a place of the floor the gripper is that was sent there, m."""
        for x, y in SPOTS:
            _point(robot.body, x, y)
            yield math.dist(emulated.order("gripper"), (x, y))
            robot.body.move_arm(REST_POSE, 2.0)
            robot.body.wait(2.6)

    before = list(errors())
    found = measure_grasp(robot.body, person, np.array(Calibration().grasp))
    robot.body._calibration = replace(Calibration(), **found)
    after = list(errors())
    print(f"the gripper was {np.round(before, 4)} m off, and is {np.round(after, 4)} m off")
    assert max(before) > 0.015
    assert max(after) < 0.004
