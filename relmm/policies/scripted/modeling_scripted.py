"""The paper's scripted controller: drive to the closest object, grasp it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relmm.features import DRIVE_PULSE_S, MAX_THETA_VEL, MAX_X_VEL, FloatArray, action_dict, xy_to_cell
from relmm.geometry import CameraGeometry, camera_geometry
from relmm.policies.controller import ControllerPolicy, Row, grasp_cell
from relmm.policies.scripted.configuration_scripted import RelmmScriptedConfig
from relmm.policies.scripted.vision import OBJECT_HEIGHT, detect_objects

_GRASP_AREA = np.array([[0.305, -0.075], [0.460, 0.075]])  # m; inside the graspable area by a centroid's error
_AIM = 0.40  # m in front of the robot, where an approach ends
_NEAREST = 0.31  # m; the robot cannot drive backwards, so nearer objects are out of reach
_TURN_FIRST = 30.0  # degrees; driving forward beyond that would lead past the object
_AHEAD = 15.0  # degrees either side, where the robot is known to have space after a detour

_VIEW_MARGIN = 5  # pixels; objects cut by the picture's edge are not detected
_SAME = 0.12  # m between an object and where it was expected; centroids at 2 m err by 4 cm and driving adds to it
_TRIED_RADIUS, _TRIED_STEPS = 0.03, 20  # m and steps in which a place that was grasped in vain is left alone
_STEP, _TURN = MAX_X_VEL * DRIVE_PULSE_S, MAX_THETA_VEL * DRIVE_PULSE_S  # m and degrees in a navigation step

_LOOK_ROUND = int(np.ceil(360 / _TURN)) - 1  # steps; the first and the last view are 60 degrees wide
_LEG = (4, 12)  # steps straight on after looking round in vain; 0.4 to 1.2 m
_MAX_LEAVE = 6  # steps straight on after a detour


@dataclass
class _Memory:
    """Places in the robot's present frame (m), and what the robot is up to."""

    seen: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))  # objects, also those out of view by now
    tried: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # x, y and the steps since
    target: FloatArray | None = None
    search: list[dict[str, float]] = field(default_factory=list)  # what remains of a search
    leave: int = 0  # steps that remain to get away from what the robot turned away from
    detours: int = 0  # since the last grasp

    def look(self, found: FloatArray, camera: CameraGeometry) -> bool:
        """Take in what is seen now; false if nothing is where it was expected, because the robot has turned."""
        in_view = _in_view(self.seen, camera)
        again = (_distances(self.seen, found) < _SAME).any(axis=1)
        if self.target is not None and _in_view(self.target[None], camera)[0]:
            if not (np.linalg.norm(found - self.target, axis=1) < _SAME).any():
                # Not there from here: a stain, a pattern, or something hidden now. Do not dither in front of it.
                self.tried = np.vstack([self.tried, [*self.target, 0]])
                self.target = None
        as_expected = not in_view.any() or bool(again[in_view].any())
        kept = self.seen[~in_view & ~again] if as_expected else np.zeros((0, 2))
        self.seen = np.concatenate([found, kept])
        return as_expected

    def worth_trying(self) -> FloatArray:
        """Objects that can be reached and were not grasped in vain lately, shape (n, 2), quickest to reach first."""
        distance, angle = np.hypot(*self.seen.T), np.abs(np.degrees(np.arctan2(self.seen[:, 1], self.seen[:, 0])))
        steps = distance / _STEP + np.maximum(angle - _TURN, 0) / _TURN
        good = (distance >= _NEAREST) & (_distances(self.seen, self.tried[:, :2]) > _TRIED_RADIUS).all(axis=1)
        return self.seen[good][np.argsort(steps[good])]

    def move(self, action: dict[str, float]) -> None:
        """Carry the places along with the robot through a navigation step."""
        turn, forward = np.radians(action["theta.vel"]) * DRIVE_PULSE_S, action["x.vel"] * DRIVE_PULSE_S
        shift = forward * np.array([np.cos(turn / 2), np.sin(turn / 2)])
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])  # p @ R turns p by -turn
        self.seen = (self.seen - shift) @ rotation
        self.tried[:, :2] = (self.tried[:, :2] - shift) @ rotation
        self.tried[:, 2] += 1
        self.tried = self.tried[self.tried[:, 2] < _TRIED_STEPS]
        self.target = None if self.target is None else (self.target - shift) @ rotation


class RelmmScriptedPolicy(ControllerPolicy):
    """Drives to the closest object it has seen and grasps it; searches at random where there is none."""

    config_class = RelmmScriptedConfig
    name = "relmm_scripted"
    config: RelmmScriptedConfig

    def __init__(self, config: RelmmScriptedConfig, **kwargs: Any) -> None:
        super().__init__(config, **kwargs)
        self._camera = camera_geometry(config.camera)

    def decide(self, image: NDArray[np.uint8], row: Row) -> dict[str, float]:
        """See `ControllerPolicy.decide`."""
        memory: _Memory = row.memory.setdefault("scripted", _Memory())
        if not memory.look(detect_objects(image, self._camera), self._camera):
            _begin_leaving(memory, row.rng)
        objects = memory.worth_trying()
        graspable = objects[((objects >= _GRASP_AREA[0]) & (objects <= _GRASP_AREA[1])).all(axis=1)]
        if len(graspable) and row.attempts < self.config.num_grasp:
            return _grasp(graspable[0], memory)
        action = _navigate(objects, memory, row.rng)
        memory.move(action)
        return action


def _in_view(places: FloatArray, camera: CameraGeometry) -> NDArray[np.bool_]:
    """Which of some places (n, 2) the camera must see, shape (n,)."""
    pixels = camera.project(np.column_stack([places, np.full(len(places), OBJECT_HEIGHT)]))
    inside = (pixels > _VIEW_MARGIN) & (pixels < np.array(camera.size) - 1 - _VIEW_MARGIN)
    return np.asarray(inside.all(axis=1))


def _distances(places: FloatArray, others: FloatArray) -> FloatArray:
    """Between (n, 2) and (m, 2), shape (n, m)."""
    return np.asarray(np.linalg.norm(places[:, None] - others, axis=-1))


def _begin_leaving(memory: _Memory, rng: np.random.Generator) -> None:
    """The robot has turned away from an obstacle: the same object would lead back to it, so first go on a little.

    The more often that happens, the further.
    """
    memory.detours += 1
    memory.target = None
    memory.leave = int(rng.integers(1, 1 + min(1 + memory.detours, _MAX_LEAVE)))


def _grasp(point: FloatArray, memory: _Memory) -> dict[str, float]:
    memory.target, memory.detours, memory.leave = None, 0, 0
    memory.seen = memory.seen[(memory.seen != point).any(axis=1)]
    memory.tried = np.vstack([memory.tried, [*point, 0]])
    return grasp_cell(xy_to_cell(*point))


def _navigate(objects: FloatArray, memory: _Memory, rng: np.random.Generator) -> dict[str, float]:
    if memory.leave > 0:
        memory.leave -= 1
        objects = objects[np.abs(np.degrees(np.arctan2(objects[:, 1], objects[:, 0]))) < _AHEAD]
        if len(objects) == 0:
            return action_dict(x_vel=MAX_X_VEL)
    if len(objects) == 0:
        return _search(memory, rng)
    memory.search = []
    memory.target = _choose(objects, memory.target)
    return _approach(memory.target)


def _choose(objects: FloatArray, target: FloatArray | None) -> FloatArray:
    """The object that the robot was on its way to, else the first one."""
    if target is not None:
        distance = np.linalg.norm(objects - target, axis=1)
        if distance.min() < _SAME:
            return objects[distance.argmin()]
    return objects[0]


def _approach(point: FloatArray) -> dict[str, float]:
    """The navigation step towards a point, proportional to what is missing."""
    distance, angle = float(np.hypot(*point)), float(np.degrees(np.arctan2(point[1], point[0])))
    x_vel = np.clip((distance - _AIM) / DRIVE_PULSE_S, 0, MAX_X_VEL) if abs(angle) < _TURN_FIRST else 0.0
    return action_dict(x_vel=float(x_vel), theta_vel=float(np.clip(angle / DRIVE_PULSE_S, -MAX_THETA_VEL, MAX_THETA_VEL)))


def _search(memory: _Memory, rng: np.random.Generator) -> dict[str, float]:
    """Look round one way, go on in a random direction, and again."""
    memory.target = None
    if not memory.search:
        turns = _LOOK_ROUND + int(rng.integers(_LOOK_ROUND))
        turn = action_dict(theta_vel=float(rng.choice((-MAX_THETA_VEL, MAX_THETA_VEL))))
        memory.search = [turn] * turns + [action_dict(x_vel=MAX_X_VEL)] * int(rng.integers(*_LEG))
    return memory.search.pop(0)
