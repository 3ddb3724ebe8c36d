"""The paper's scripted controller: drive to the closest object, grasp it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relmm.features import DRIVE_PULSE_S, MAX_THETA_VEL, MAX_X_VEL, FloatArray, action_dict, xy_to_cell
from relmm.geometry import CameraGeometry, camera_geometry
from relmm.policies.controller import Row, UntrainedPolicy, grasp_cell
from relmm.policies.scripted.configuration_scripted import RelmmScriptedConfig
from relmm.policies.scripted.vision import OBJECT_HEIGHT, detect_objects

_GRASP_AREA = np.array([[0.305, -0.075], [0.460, 0.075]])  # m; inside the graspable area by a centroid's error
_AIM = 0.40  # m in front of the robot, where an approach ends
_NEAREST = 0.31  # m; the robot cannot drive backwards, so nearer objects are out of reach
_TURN_FIRST = 30.0  # degrees; driving forward beyond that would lead past the object
_AHEAD = 15.0  # degrees either side, where the robot is known to have space after a detour

_VIEW_MARGIN = 5  # pixels; objects cut by the picture's edge are not detected
_SAME = 0.12  # m between an object and where it was expected; centroids at 2 m err by 4 cm and driving adds to it
_TRIED_RADIUS, _TRIED_STEPS = 0.03, 20  # m round a place without success, and for how many steps it is left alone

_LOOK_ROUND = 12  # steps of 27 degrees, after which everything round the robot has been in view
_LEG = (4, 12)  # steps straight on after looking round in vain; 0.4 to 1.2 m
_MAX_LEAVE = 6  # steps straight on after a detour


@dataclass
class _Memory:
    """Places in the robot's present frame (m), and what the robot is up to."""

    seen: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))  # objects of the last picture
    tried: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # x, y and the steps since
    target: FloatArray | None = None
    search: list[dict[str, float]] = field(default_factory=list)  # what remains of a search
    leave: int = 0  # steps that remain to get away from what the robot turned away from
    detours: int = 0  # since the last grasp

    def look(self, found: FloatArray, camera: CameraGeometry) -> bool:
        """Take in what is seen now; false if nothing is where it was expected, because the robot has turned."""
        expected = self.seen[_in_view(self.seen, camera)]
        self.seen = found
        if self.target is not None and _in_view(self.target[None], camera)[0] and not _near(self.target, found).any():
            # A stain, a pattern, or hidden from here: without this the robot would dither in front of it.
            self.leave_alone(self.target)
            self.target = None
        return len(expected) == 0 or any(_near(place, found).any() for place in expected)

    def leave_alone(self, place: FloatArray) -> None:
        """Do not try to grasp there again for a while."""
        self.tried = np.vstack([self.tried, [*place, 0]])

    def worth_trying(self) -> FloatArray:
        """Objects in view that can be reached and are not to be left alone, shape (n, 2), closest first."""
        apart = np.linalg.norm(self.seen[:, None] - self.tried[:, :2], axis=-1)
        good = (np.hypot(*self.seen.T) >= _NEAREST) & (apart > _TRIED_RADIUS).all(axis=1)
        return np.asarray(self.seen[good])

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


class RelmmScriptedPolicy(UntrainedPolicy):
    """Drives to the closest object it sees and grasps it; searches at random where there is none."""

    config_class = RelmmScriptedConfig
    name = "relmm_scripted"
    config: RelmmScriptedConfig

    def __init__(self, config: RelmmScriptedConfig, **kwargs: Any) -> None:
        super().__init__(config, **kwargs)
        self._camera = camera_geometry(config.camera)

    def decide(self, image: NDArray[np.uint8], state: NDArray[np.float32], row: Row) -> dict[str, float]:
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


def _near(place: FloatArray, places: FloatArray) -> NDArray[np.bool_]:
    """Which of some places (n, 2) may be the same object as one, shape (n,)."""
    return np.asarray(np.linalg.norm(places - place, axis=1) < _SAME)


def _begin_leaving(memory: _Memory, rng: np.random.Generator) -> None:
    """The robot has turned away from an obstacle: the same object would lead back to it, so first go on a little.

    The more often that happens, the further.
    """
    memory.detours += 1
    memory.target = None
    memory.leave = int(rng.integers(1, 1 + min(1 + memory.detours, _MAX_LEAVE)))


def _grasp(point: FloatArray, memory: _Memory) -> dict[str, float]:
    memory.leave_alone(point)
    memory.seen = memory.seen[(memory.seen != point).any(axis=1)]
    memory.target, memory.detours, memory.leave = None, 0, 0
    return grasp_cell(xy_to_cell(*point))


def _navigate(objects: FloatArray, memory: _Memory, rng: np.random.Generator) -> dict[str, float]:
    if memory.leave > 0:
        memory.leave -= 1
        objects = objects[np.abs(_angles(objects)) < _AHEAD]
        if len(objects) == 0:
            return action_dict(x_vel=MAX_X_VEL)
    if len(objects) == 0:
        return _search(memory, rng)
    memory.search = []
    memory.target = _choose(objects, memory.target)
    return _approach(memory.target)


def _choose(objects: FloatArray, target: FloatArray | None) -> FloatArray:
    """The object that the robot was on its way to, else the closest."""
    if target is None or not _near(target, objects).any():
        return np.asarray(objects[0])
    return np.asarray(objects[np.linalg.norm(objects - target, axis=1).argmin()])


def _approach(point: FloatArray) -> dict[str, float]:
    """The navigation step towards a point, proportional to what is missing."""
    distance, angle = np.hypot(*point), _angles(point)
    x_vel = np.clip((distance - _AIM) / DRIVE_PULSE_S, 0, MAX_X_VEL) if abs(angle) < _TURN_FIRST else 0.0
    theta_vel = np.clip(angle / DRIVE_PULSE_S, -MAX_THETA_VEL, MAX_THETA_VEL)
    return action_dict(x_vel=float(x_vel), theta_vel=float(theta_vel))


def _angles(places: FloatArray) -> FloatArray:
    """Bearings of places (..., 2) in degrees, positive = left."""
    return np.asarray(np.degrees(np.arctan2(places[..., 1], places[..., 0])))


def _search(memory: _Memory, rng: np.random.Generator) -> dict[str, float]:
    """Look round one way, go on in a random direction, and again."""
    memory.target = None
    if not memory.search:
        turns = _LOOK_ROUND + int(rng.integers(_LOOK_ROUND))
        turn = action_dict(theta_vel=float(rng.choice((-MAX_THETA_VEL, MAX_THETA_VEL))))
        memory.search = [turn] * turns + [action_dict(x_vel=MAX_X_VEL)] * int(rng.integers(*_LEG))
    return memory.search.pop(0)
