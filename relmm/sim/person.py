"""The person of the stationary curriculum: pushes an object back when the robot cannot reach it any more."""

from __future__ import annotations

import numpy as np

from relmm.features import GRASP_X, GRASP_Y
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
