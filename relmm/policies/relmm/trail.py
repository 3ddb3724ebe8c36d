"""Where the robot has just been, from its own odometry: the navigation policy's short memory.

A policy that only knows the present picture cannot search: it does not know which way it has begun to turn, nor that it
has turned all the way round.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from relmm.features import DRIVE_PULSE_S

# Navigation steps; turning round takes 14. Odd ones too, or turning left and right by turns would look like standing
# still.
_LAGS = (1, 2, 3, 5, 9, 17, 33)
HISTORY = max(_LAGS)
_MAX_TURNS = 2.0  # half turns to either side that still make a difference

TRAIL_FEATURES = 3 * len(_LAGS)
MIRROR = torch.tensor([1.0, -1.0, -1.0] * len(_LAGS))  # what exchanging left and right does to the features


def last_sides(features: Tensor) -> Tensor:
    """To which side the last step turned, 1 for the left and -1 for the right, (batch,).

    Args:
        features: `Trail.features`, (batch, 21).
    """
    return torch.where(features[:, 2] <= 0, 1.0, -1.0)


class Trail:
    """The robot's poses after its last navigation steps, as seen from where it is now."""

    def __init__(self) -> None:
        self._poses: deque[tuple[float, float, float]] = deque(maxlen=HISTORY + 1)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._poses.clear()
        self._poses.append((0.0, 0.0, 0.0))

    def copy(self) -> Trail:
        """Another one that remembers the same."""
        other = Trail()
        other._poses = self._poses.copy()
        return other

    def moved(self, x_vel: float, theta_vel: float) -> None:
        """Take in one navigation step, with its velocities as `observation.state` gives them, m/s and deg/s."""
        x, y, heading = self._poses[-1]
        forward, turn = x_vel * DRIVE_PULSE_S, math.radians(theta_vel) * DRIVE_PULSE_S
        middle = heading + turn / 2
        self._poses.append((x + forward * math.cos(middle), y + forward * math.sin(middle), heading + turn))

    def features(self) -> NDArray[np.float32]:
        """Forward and left (m) and the turn (half turns, at most 2 either way) of earlier poses, (21,)."""
        x, y, heading = self._poses[-1]
        cos, sin = math.cos(heading), math.sin(heading)
        values: list[float] = []
        for lag in _LAGS:
            then_x, then_y, then_heading = self._poses[max(len(self._poses) - 1 - lag, 0)]
            dx, dy = then_x - x, then_y - y
            turn = (then_heading - heading) / math.pi
            values += [cos * dx + sin * dy, cos * dy - sin * dx, min(max(turn, -_MAX_TURNS), _MAX_TURNS)]
        return np.array(values, np.float32)
