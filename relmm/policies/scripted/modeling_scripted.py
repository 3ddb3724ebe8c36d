"""The paper's scripted controller."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from relmm.features import DRIVE_PULSE_S, MAX_THETA_VEL, MAX_X_VEL, FloatArray, Skill, action_dict, xy_to_cell
from relmm.geometry import camera_geometry
from relmm.policies.controller import ControllerPolicy, Row, grasp_cell
from relmm.policies.scripted.configuration_scripted import RelmmScriptedConfig
from relmm.policies.scripted.vision import detect_objects

_AREA = ((0.305, 0.460), (-0.075, 0.075))  # m; a little inside the graspable area, because centroids err
_AIM = 0.40  # m in front of the robot, where an object shall be after the approach
_NEAREST = 0.31  # m; the robot cannot drive backwards, so nearer objects are out of reach
_TURN_FIRST = 30.0  # degrees; beyond that, driving forward would lead past the object
_SAME = 0.12  # m between an object and where it should be after a step
_TRIED = 0.03  # m round a place that was grasped in vain
_FORGET = 20  # steps until such a place is tried again
_ROUND = 12  # steps that turn the robot far enough to have seen everything round it
_LEG = (4, 12)  # steps of a straight leg


class RelmmScriptedPolicy(ControllerPolicy):
    """Drives to the closest object it sees and grasps it."""

    config_class = RelmmScriptedConfig
    name = "relmm_scripted"
    config: RelmmScriptedConfig

    def __init__(self, config: RelmmScriptedConfig, **kwargs: Any) -> None:
        super().__init__(config, **kwargs)
        self._camera = camera_geometry(config.camera)

    def decide(self, image: NDArray[np.uint8], row: Row) -> dict[str, float]:
        """See `ControllerPolicy.decide`."""
        objects = _worth_trying(detect_objects(image, self._camera), row)
        graspable = [point for point in objects if _in_area(point)]
        if graspable and row.attempts < self.config.num_grasp:
            return _grasp(graspable[0], row)
        action = _approach(_choose(objects, row)) if len(objects) else _explore(row)
        _move_memory(row, action)
        return action


def _in_area(point: FloatArray) -> bool:
    return all(low <= value <= high for value, (low, high) in zip(point, _AREA, strict=True))


def _worth_trying(objects: FloatArray, row: Row) -> FloatArray:
    objects = objects[np.hypot(*objects.T) >= _NEAREST]
    for place, _ in row.memory.get("tried", []):
        objects = objects[np.hypot(*(objects - place).T) > _TRIED]
    return objects


def _grasp(point: FloatArray, row: Row) -> dict[str, float]:
    row.memory["tried"] = [*row.memory.get("tried", []), (point, 0)]
    return grasp_cell(xy_to_cell(*point))


def _choose(objects: FloatArray, row: Row) -> FloatArray:
    expected = row.memory.get("target")
    chosen: FloatArray = objects[0]
    if expected is not None:
        distance = np.hypot(*(objects - expected).T)
        if distance.min() < _SAME:
            chosen = objects[distance.argmin()]
    row.memory["target"] = chosen
    row.memory["searched"] = 0
    return chosen


def _approach(point: FloatArray) -> dict[str, float]:
    distance, angle = float(np.hypot(*point)), float(np.degrees(np.arctan2(point[1], point[0])))
    theta_vel = float(np.clip(angle / DRIVE_PULSE_S, -MAX_THETA_VEL, MAX_THETA_VEL))
    x_vel = float(np.clip((distance - _AIM) / DRIVE_PULSE_S, 0, MAX_X_VEL))
    return action_dict(x_vel=x_vel if abs(angle) < _TURN_FIRST else 0.0, theta_vel=theta_vel)


def _explore(row: Row) -> dict[str, float]:
    row.memory["target"] = None
    searched = row.memory.get("searched", 0)
    row.memory["searched"] = searched + 1
    if searched == 0:
        row.memory["side"] = row.rng.choice((-1.0, 1.0))
        row.memory["end"] = _ROUND + int(row.rng.integers(*_LEG)) + int(row.rng.integers(0, 12))
        row.memory["turns"] = _ROUND + int(row.rng.integers(0, 12))
    if searched >= row.memory["end"]:
        row.memory["searched"] = 0
    if searched < row.memory["turns"]:
        return action_dict(theta_vel=row.memory["side"] * MAX_THETA_VEL)
    return action_dict(x_vel=MAX_X_VEL)


def _move_memory(row: Row, action: dict[str, float]) -> None:
    """Where remembered places will be after a navigation step."""
    turn = np.radians(action["theta.vel"]) * DRIVE_PULSE_S
    forward = action["x.vel"] * DRIVE_PULSE_S
    middle = np.array([np.cos(turn / 2), np.sin(turn / 2)]) * forward
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])

    def moved(place: FloatArray) -> FloatArray:
        return np.asarray(rotation @ (place - middle))

    if row.memory.get("target") is not None:
        row.memory["target"] = moved(row.memory["target"])
    tried = row.memory.get("tried", [])
    row.memory["tried"] = [(moved(place), age + 1) for place, age in tried if age < _FORGET]
