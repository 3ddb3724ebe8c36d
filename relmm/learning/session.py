"""A training session: the trainer's loop with its evaluations, checkpoints and metrics."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from relmm.episodes.follow import Episode
from relmm.learning.intake import Intake
from relmm.learning.progress import Metrics, Progress
from relmm.learning.trainer import Trainer
from relmm.policies.learning import Learner

_PRACTICE_LOG_FREQ = 10  # attempts of the stationary curriculum between lines of the metrics


@dataclass(frozen=True)
class Schedule:
    """When to do what, in navigation steps.

    Attributes:
        steps: the end.
        log_freq, save_freq: between lines of the metrics, and between checkpoints.
        eval_freq: between evaluations; 0 for none.
        upload_freq: between uploads of a new checkpoint; 0 for none.
    """

    steps: int
    log_freq: int
    save_freq: int
    eval_freq: int
    upload_freq: int = 0


class Session:
    """Does what is due after each navigation step.

    Args:
        schedule: when to do what.
        progress: counts of the run.
        learner: whose losses are logged.
        metrics: takes them.
        save: writes a checkpoint.
        evaluate: the scores of the policy as it is, none if there is nothing to evaluate or it was stopped.
        show: tells the user, after every attempt and step.
        upload: begins to upload the newest checkpoint, without waiting.
    """

    def __init__(
        self,
        schedule: Schedule,
        progress: Progress,
        learner: Learner,
        metrics: Metrics,
        *,
        save: Callable[[], None],
        evaluate: Callable[[], dict[str, Any]],
        show: Callable[[dict[str, Any]], None],
        upload: Callable[[], None] = lambda: None,
    ) -> None:
        self._schedule, self._progress, self._learner, self._metrics = schedule, progress, learner, metrics
        self._save, self._evaluate, self._show, self._upload = save, evaluate, show, upload
        self._started = time.monotonic() - metrics.seconds  # a resumed run goes on
        self._saved_at = -1
        self._logged: dict[str, float] = {}
        self._more_logs: Callable[[], dict[str, float]] = dict

    def live(self, trainer: Trainer, should_stop: Callable[[], bool]) -> None:
        """Train on a robot until the last step, or until told to stop; ends with a checkpoint."""
        self._begin()
        while trainer.in_stationary_curriculum and not should_stop():
            before = self._progress.practice_attempts
            trainer.stationary_attempt()
            self._show(self._status())
            if _passed(before, self._progress.practice_attempts, _PRACTICE_LOG_FREQ):
                self._log()
        while self._progress.steps < self._schedule.steps and not should_stop():
            before = self._progress.steps
            trainer.navigation_step()
            self._after(before)
        self._end()

    def follow(self, episodes: Iterable[tuple[str, Episode] | None], intake: Intake) -> None:
        """Train on episodes that come in from elsewhere, until the last step or the last of them.

        Args:
            episodes: with the dataset that each is of; None where there is none for the moment.
            intake: takes them, and tells how well it keeps up.
        """
        self._begin()
        self._more_logs = intake.logs
        for arrival in episodes:
            if arrival is None:
                if intake.weights_are_due:
                    self._checkpoint()
                continue
            before, practised = self._progress.steps, self._progress.practice_attempts
            intake.take(*arrival)
            self._saved_at = -1  # what was saved at this step has not learned from this episode
            self._after(before, save=intake.weights_are_due)
            if _passed(practised, self._progress.practice_attempts, _PRACTICE_LOG_FREQ):
                self._log()
            if self._progress.steps >= self._schedule.steps:
                break
        self._end()

    def _begin(self) -> None:
        if self._progress.attempts + self._progress.steps == 0:
            self._checkpoint()  # so that a run that is killed at once can be resumed, and recorders find a policy

    def _after(self, before: int, save: bool = False) -> None:
        schedule, step = self._schedule, self._progress.steps
        self._show(self._status())
        if _passed(before, step, schedule.log_freq):
            self._log()
        evaluate, upload = (_passed(before, step, every) for every in (schedule.eval_freq, schedule.upload_freq))
        if save or evaluate or upload or _passed(before, step, schedule.save_freq):
            self._checkpoint()  # before the evaluation, which takes long and may be stopped
        if evaluate and (scores := self._evaluate()):
            self._metrics.write(**self._status(), **scores)
        if upload:
            self._upload()

    def _end(self) -> None:
        self._checkpoint()
        if self._logged != self._progress.asdict():
            self._log()  # so that the last line counts all there is

    def _log(self) -> None:
        self._logged = self._progress.asdict()
        self._metrics.write(**self._status(), **self._learner.logs, **self._more_logs())

    def _checkpoint(self) -> None:
        if self._saved_at != self._progress.steps:
            self._save()
            self._saved_at = self._progress.steps

    def _status(self) -> dict[str, Any]:
        return {**self._progress.asdict(), "seconds": round(time.monotonic() - self._started, 1)}


def _passed(before: int, now: int, every: int) -> bool:
    """Whether a multiple of `every` lies after `before` and up to `now`; 0 is never."""
    return every > 0 and now // every > before // every
