"""Where to look next, when a full turn has shown nothing to grasp."""

from __future__ import annotations

from relmm.features import DRIVE_PULSE_S

_ROUND = 360.0  # degrees
_AVOIDED = 30.0  # degrees; more is the turn of collision avoidance
_AWAY = 12  # navigation steps straight on, 1.3 m: what was too far to see comes into view


class Search:
    """How far one robot has turned since something was in view.

    The policy sees the present picture alone: in a corner where nothing is in view it would turn for ever, because next
    to everything that it has learned from, something lay near by.
    """

    def __init__(self) -> None:
        self._turned, self._away = 0.0, 0

    def leaves(self, in_view: bool, theta_vel: float) -> bool:
        """Whether the next navigation step goes straight on; to be asked once before each.

        Args:
            in_view: whether there is something to grasp on the map.
            theta_vel: of the last navigation step, deg/s.
        """
        turned = abs(theta_vel) * DRIVE_PULSE_S
        if self._away > 0:
            # What turns the robot now is a wall: it has not got anywhere yet.
            self._away = _AWAY if turned > _AVOIDED else self._away
        else:
            self._turned = 0.0 if in_view else self._turned + turned
            if self._turned < _ROUND:
                return False
            self._turned, self._away = 0.0, _AWAY
        self._away -= 1
        return True
