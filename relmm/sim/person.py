"""A person beside the robot: pushes an object back that it cannot reach any more, and frees those stuck at walls."""

from __future__ import annotations

import numpy as np

from relmm.features import GRASP_X, GRASP_Y, FloatArray
from relmm.sim.locobot_sim import LocobotSim

_MARGIN = 0.01  # m, inside the grasp area


class Person:
    """Watches a simulated room with ground truth, as a person watches a real one.

    Args:
        robot: in the room.
        rng: of the places.
    """

    def __init__(self, robot: LocobotSim, rng: np.random.Generator) -> None:
        self._robot, self._rng = robot, rng

    def put_in_reach(self) -> bool:
        """Put the nearest object into the grasp area, unless one lies there; whether something had to be done."""
        body = self._robot.body
        places = body.truth.objects_in_robot_frame()
        inside = (places[:, 0] >= GRASP_X[0]) & (places[:, 0] <= GRASP_X[1])
        inside &= (places[:, 1] >= GRASP_Y[0]) & (places[:, 1] <= GRASP_Y[1])
        if inside.any():
            return False
        nearest = int(np.argmin(np.hypot(places[:, 0], places[:, 1])))
        low, high = np.array([GRASP_X[0], GRASP_Y[0]]) + _MARGIN, np.array([GRASP_X[1], GRASP_Y[1]]) - _MARGIN
        body.put_object(nearest, self._rng.uniform(low, high))
        self._robot.skills.forget_picture()
        return True

    def tidy(self) -> int:
        """Lay what lies at walls and obstacles anywhere else on the floor, as far as possible; how many objects.

        The authors' simulator moves such objects at every step; a person of theirs does it every five hours.
        """
        body = self._robot.body
        objects, carried = body.truth.objects(), body.truth.carried()
        stuck = np.setdiff1d(np.flatnonzero(~body.room.is_clear(objects[:, :2])), carried)
        free = [xy for xy in body.room.scatter(self._rng)[:, :2] if self._is_free(xy)][: len(stuck)]
        for index, xy in zip(stuck.tolist(), free, strict=False):
            body.put_object(index, body.truth.in_robot_frame(xy))
        if free:
            self._robot.skills.forget_picture()
        return len(free)

    def _is_free(self, xy: FloatArray) -> bool:
        """Whether an object can be laid at a place of the room, m."""
        truth, spacing = self._robot.body.truth, self._robot.body.room.object_spacing
        away = np.hypot(*(xy - truth.robot()[:2])) >= self._robot.body.room.robot_clearance
        return bool(away and np.hypot(*(truth.objects()[:, :2] - xy).T).min() >= spacing)
