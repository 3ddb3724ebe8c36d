"""The paper's curricula as small state machines, without a robot."""

from __future__ import annotations

from dataclasses import dataclass

CURRICULA = ("stationary", "autonomous", "none")


@dataclass
class Practice:
    """One session of grasping at one place (paper Algorithms 1 and 3).

    Attributes:
        limit: attempts in a row without success that end it before the first success.
        limit_after_success: the same after it; None ends it with the first success.
        since: attempts since the last success.
        succeeded: whether there was one; the session's reward r_max.
    """

    limit: int  # N_grasp, or N_start
    limit_after_success: int | None = None  # N_stop
    since: int = 0  # N_since
    succeeded: bool = False

    def attempted(self, success: bool) -> None:
        """Count one attempt."""
        self.since = 0 if success else self.since + 1
        self.succeeded |= success

    @property
    def finished(self) -> bool:
        """Whether the robot should drive on."""
        if self.succeeded:
            return self.limit_after_success is None or self.since >= self.limit_after_success
        return self.since >= self.limit


@dataclass(frozen=True)
class AutonomousCurriculum:
    """Practise wherever something can be grasped, until there are enough attempts (paper Algorithm 3).

    Attributes:
        num_start: failures in a row that end a session without a success (N_start).
        num_stop: failures since the last success that end one with a success (N_stop).
        num_max: attempts, from the first success on, after which the curriculum is over (N_max). The paper counts all;
            in the authors' code the first session lasts until the first success, so both begin to navigate knowing one.
    """

    num_start: int
    num_stop: int
    num_max: int

    def active(self, attempts: int) -> bool:
        """Whether it is still on after so many attempts since the first success, 0 before; P[grasp] is 1 then."""
        return attempts < self.num_max

    def session(self) -> Practice:
        """A new session."""
        return Practice(self.num_start, self.num_stop)
