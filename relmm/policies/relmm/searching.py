"""Where to look next, when nothing to grasp is in view."""

from __future__ import annotations

import torch
from torch import Tensor

from relmm.features import DRIVE_PULSE_S
from relmm.policies.relmm.encoders import NOTICED, map_places

_ROUND = 360.0  # degrees
_AVOIDED = 30.0  # degrees; more is the turn of collision avoidance
_TRAPPED = 2.0  # such turns, of which a tenth is forgotten with every step
_AWAY = 12  # navigation steps straight on, 1.3 m: what was too far to see comes into view


def nearest_bearing(floor_map: Tensor) -> float | None:
    """Where the nearest thing to grasp is, degrees to the left of straight ahead; None if there is none.

    Args:
        floor_map: as `FloorObserver` draws it, uint8, (4, 30, 31).
    """
    places = map_places()[:, floor_map[0].cpu() >= NOTICED]
    if places.shape[1] == 0:
        return None
    forward, left = places[:, places.norm(dim=0).argmin()]
    return float(torch.atan2(left, forward).rad2deg())


class Search:
    """What one robot remembers: which way things went out of view, how far it has turned since, what turned it back.

    The policy sees the present picture alone. It would turn away from what has just gone out of view at one side; in a
    corner where nothing is in view it would turn for ever, because next to everything that it has learned from,
    something lay near by; and before a wall it may steer into collision avoidance again and again.

    Attributes:
        side: to turn to while nothing is in view, 1 for the left and -1 for the right: where something was last, then
            on and on.
    """

    def __init__(self) -> None:
        self.side = 1.0
        self._bearing: float | None = None  # of what was in view at the last step
        self._turned, self._avoided, self._away = 0.0, 0.0, 0

    def leaves(self, bearing: float | None, theta_vel: float) -> bool:
        """Whether the next navigation step goes straight on; to be asked once before each.

        Args:
            bearing: of what is in view, as from `nearest_bearing`.
            theta_vel: of the last navigation step, deg/s.
        """
        turn = theta_vel * DRIVE_PULSE_S
        if bearing is None and (self._bearing is not None or turn != 0):
            ahead = turn if self._bearing is None else self._bearing - turn
            self.side = 1.0 if ahead >= 0 else -1.0
        self._bearing = bearing
        self._avoided = 0.9 * self._avoided + (abs(turn) > _AVOIDED)
        if self._away > 0:
            # What turns the robot now is a wall: it has not got anywhere yet.
            self._away = _AWAY if abs(turn) > _AVOIDED else self._away
        else:
            self._turned = self._turned + abs(turn) if bearing is None else 0.0
            if self._turned < _ROUND and self._avoided < _TRAPPED:
                return False
            self._turned, self._avoided, self._away = 0.0, 0.0, _AWAY
        self._away -= 1
        return True
