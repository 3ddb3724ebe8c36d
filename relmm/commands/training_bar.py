"""One bar for a run of relmm-train: practice attempts, navigation steps and evaluations, and when it will end."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from relmm.commands.cli import progress

_LATEST = 100  # parts of the work that its pace is taken from: attempts and steps become slower as more is learned
PRACTICE_WEIGHT, EVALUATION_WEIGHT = 0.7, 160.0  # an attempt and an evaluated episode, in navigation steps
_LAYOUT = "{desc}: {percentage:3.0f}%|{bar}| [{elapsed}{postfix}]"


@dataclass
class Phase:
    """One kind of work.

    Args:
        name: of its parts, for the user.
        total: how many parts there are.
        weight: what a part takes, compared with a navigation step, as long as none has been timed.
        done: parts that have ended; the one under way counts as a fraction.
    """

    name: str
    total: int
    weight: float
    done: float = 0.0

    def __post_init__(self) -> None:
        self.timed = self.seconds = 0.0  # parts of the latest, and what they took

    def take(self, done: float, seconds: float) -> None:
        """Go on, and learn from it how long the rest takes."""
        keep = max(1 - (done - self.done) / _LATEST, 0)
        self.timed, self.seconds = self.timed * keep + done - self.done, self.seconds * keep + seconds
        self.done = done

    def pace(self, seconds_per_weight: float) -> float:
        """Seconds a part takes, as timed or by its weight."""
        return self.seconds / self.timed if self.timed else self.weight * seconds_per_weight


class TrainingBar:
    """Shows how much of all the work is done, by the time it takes.

    Args:
        title: what is done.
        phases: the kinds of work, in order.
        clock: for the pace.
    """

    def __init__(self, title: str, phases: list[Phase], clock: Callable[[], float] = time.monotonic) -> None:
        self._phases, self._clock = {phase.name: phase for phase in phases if phase.total}, clock
        self._bar = progress(100, "%", title, layout=_LAYOUT)
        self._last, self._words = clock(), ""
        self.write = self._bar.write

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._bar.close()

    def advance(self, name: str, done: float, words: str | None = None) -> None:
        """So many parts of a phase are done; the time since the last advance of any is theirs.

        Args:
            name: of the phase; one that there is none of in this run is left out.
            done: parts, those of earlier runs included.
            words: to show besides, from now on.
        """
        self._words = self._words if words is None else words
        phase, now = self._phases.get(name), self._clock()
        if phase is None or min(done, phase.total) <= phase.done:
            return
        phase.take(min(done, phase.total), now - self._last)
        self._last = now
        counts = [f"{int(phase.done)}/{phase.total} {phase.name}" for phase in self._phases.values()]
        left = _in_words(self.seconds_left())
        self._bar.set_postfix_str(", ".join([f"{left} left", *counts, *filter(None, [self._words])]), refresh=False)
        self._bar.update(max(100 * self.share() - self._bar.n, 0))

    def seconds_left(self) -> float:
        """How long the rest takes, as far as this run has been timed."""
        return sum((phase.total - phase.done) * pace for phase, pace in self._paces())

    def share(self) -> float:
        """How much of the whole is done, from 0 to 1."""
        done = sum(phase.done * pace for phase, pace in self._paces())
        return done / ((done + self.seconds_left()) or 1)

    def _paces(self) -> list[tuple[Phase, float]]:
        phases = self._phases.values()
        weight = sum(phase.timed * phase.weight for phase in phases)
        scale = sum(phase.seconds for phase in phases) / weight if weight else 0.0
        return [(phase, phase.pace(scale)) for phase in phases]


def _in_words(seconds: float) -> str:
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"about {seconds / size:.0f} {unit}"
    return f"about {math.ceil(seconds)} s"
