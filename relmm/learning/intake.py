"""Whether a learner keeps up with the episodes that come from elsewhere, and what it does where it does not."""

from __future__ import annotations

import time
from collections.abc import Callable

from relmm.episodes import Episode
from relmm.learning.progress import Progress
from relmm.policies.learning import Learner

_SAVING_SHARE = 0.1  # most of a learner's time that saving weights for others may take


class Intake:
    """Feeds recorded episodes to a learner; while too many wait, they are stored without updates.

    Robots never wait for a slow learner, its replay stays recent, and no episode is lost.

    Args:
        learner: takes them.
        progress: counts their frames.
        waiting: how many episodes are saved and not read yet.
        max_waiting: while more episodes than this wait, new ones are stored without updates.
        clock: s.
    """

    def __init__(
        self,
        learner: Learner,
        progress: Progress,
        waiting: Callable[[], int],
        max_waiting: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._learner, self._progress, self._waiting, self._max_waiting = learner, progress, waiting, max_waiting
        self._clock, self._saved_at, self._saving_s = clock, clock(), 0.0
        self._episodes = self._without_updates = 0
        self._ages: list[int] = []
        self._updates = self._all_updates()

    def take(self, source: str, episode: Episode) -> None:
        """Learn from an episode.

        Args:
            source: the dataset it is of, which has a clock of its own.
            episode: whole.
        """
        if episode.weights_step >= 0:
            self._ages.append(max(self._progress.steps - episode.weights_step, 0))
        self._progress.read(episode, source)
        update = self._waiting() <= self._max_waiting
        self._learner.read(episode, update=update)
        self._episodes += 1
        self._without_updates += not update

    @property
    def weights_are_due(self) -> bool:
        """Whether those who act should get newer weights now."""
        return self._clock() - self._saved_at >= self._saving_s * (1 / _SAVING_SHARE - 1)

    def timed(self, save: Callable[[], None]) -> None:
        """Save weights, and note how long that takes."""
        started = self._clock()
        save()
        self._saved_at = self._clock()
        self._saving_s = self._saved_at - started

    def logs(self) -> dict[str, float]:
        """For a line of the metrics: what came since the last one, and how far behind the learner is."""
        updates, episodes = self._all_updates(), max(self._episodes, 1)
        logs = {
            "episodes_waiting": self._waiting(),
            "updates_per_episode": (updates - self._updates) / episodes,
            "episodes_without_updates": self._without_updates,
        }
        if self._ages:  # in navigation steps of all robots together
            logs |= {"weights_age": sum(self._ages) / len(self._ages), "weights_age_max": max(self._ages)}
        self._updates, self._episodes, self._without_updates, self._ages = updates, 0, 0, []
        return logs

    def _all_updates(self) -> int:
        """Of all optimisers, each of which counts its own."""
        states = [next(iter(each.state.values()), None) for each in self._learner.optimizers.values()]
        return sum(int(state["step"]) for state in states if state)
