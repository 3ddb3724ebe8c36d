"""The learner of relmm-train where others record: episodes come in, checkpoints go out."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from relmm.commands.cli import progress
from relmm.commands.training_bar import TrainingBar
from relmm.commands.training_run import Run
from relmm.episodes import Episode
from relmm.episodes.sources import Sources
from relmm.errors import ConfigError
from relmm.learning.checkpoint import checkpoint_folders, pretrained_model, read_cursors
from relmm.learning.intake import Intake

_POLL_S = 0.5  # between looks at the datasets
_PASSING = 4  # checkpoints between those that are kept: somebody may be reading one of them


def train_on_stream(
    run: Run,
    watch: Callable[[TrainingBar], None] = lambda bar: None,
    evaluation: Callable[[TrainingBar], Callable[[], dict[str, Any]]] = lambda bar: dict,
    describe: Callable[[], str] = str,
) -> None:
    """Learn from the datasets that a run follows, until its last step or a signal.

    Args:
        run: with `--dataset.follow`.
        watch: called now and then, to look after whoever records.
        evaluation: makes what evaluates the policy.
        describe: who records, in a few words.

    Raises:
        ConfigError: a dataset that its checkpoint has learned from is missing.
        DatasetError: a dataset that was named cannot be learned from.
    """
    sources = _sources(run)
    run.read_initial_data()
    run.track()
    _read_learned(run, sources)
    intake = Intake(run.learner, run.progress, lambda: sources.waiting, run.config.dataset.max_waiting)
    with run.bar("training") as bar:
        for place in run.config.followed:
            if not place.exists():
                bar.write(f"waiting for {place}, which is not there yet: start its recorder, or check the name")
        run.words = lambda: ", ".join(filter(None, [describe(), _words(sources)]))
        checkpoints = _Checkpoints(run, sources)
        session = run.session(lambda: intake.timed(checkpoints.save), evaluation(bar), bar)
        session.follow(_arrivals(run, sources, bar, watch), intake)


def _sources(run: Run) -> Sources:
    learned = [] if run.checkpoint is None else read_cursors(run.checkpoint)
    sources = Sources(run.config.followed, run.policy.config.camera, learned)
    if run.checkpoint is not None and sources.missing:
        lost = sources.missing[0]
        raise ConfigError(
            f"the checkpoint {run.checkpoint} has learned from {lost.episodes} episodes of {lost.name}, which are not "
            f"in --dataset.follow={run.config.dataset.follow}: bring them back, or begin a new run with "
            f"--policy.path={pretrained_model(run.checkpoint)}."
        )
    return sources


def _read_learned(run: Run, sources: Sources) -> None:
    """Fill the replay with what the checkpoint has learned from."""
    if not (total := sum(source.learned for source in sources.all)):
        return
    with progress(total, "episode", "reading what was learned from", leave=False) as bar:
        for source, episode in sources.read_learned():
            run.learner.read(episode, update=False)
            run.progress.read(episode, str(source.root))
            bar.update()


def _arrivals(
    run: Run, sources: Sources, bar: TrainingBar, watch: Callable[[TrainingBar], None]
) -> Iterator[tuple[str, Episode] | None]:
    said: dict[str, str] = {}
    while not run.signals.stopped:
        watch(bar)
        none = True
        for source, episode in sources.read_new():
            none = False
            yield str(source.root), episode
            watch(bar)
            if run.signals.stopped:
                return
        problems = {str(root): problem for root, problem in sources.problems.items()}
        for root in problems.keys() - said.keys():
            bar.write(f"left out for now: {problems[root]}")
        said = problems
        if none:
            yield None
            time.sleep(_POLL_S)


class _Checkpoints:
    """Checkpoints of a run: those between two of `save_freq` are for those who act, and only the newest are kept.

    Args:
        run: the run that writes them.
        sources: what it learns from.
    """

    def __init__(self, run: Run, sources: Sources) -> None:
        self._run, self._sources = run, sources
        self._kept_at, self._passing = -1, list[Path]()
        for folder in checkpoint_folders(run.config.checkpoints):  # written before a resume
            self._note(folder, int(folder.name))

    def save(self) -> None:
        """Write one, and remove what is no longer needed."""
        cursors = [source.cursor for source in self._sources.all]
        runs = [first for cursor in cursors for first in cursor.runs[:1]]
        step = self._run.progress.steps
        folder = self._run.save(
            sum(cursor.episodes for cursor in cursors), runs, cursors, passing=self._period(step) <= self._kept_at
        )
        self._note(folder, step)
        while len(self._passing) > _PASSING:
            shutil.rmtree(self._passing.pop(0))

    def _period(self, step: int) -> int:
        return step // self._run.config.save_freq

    def _note(self, folder: Path, step: int) -> None:
        """The first of each period is kept."""
        if self._period(step) > self._kept_at:
            self._kept_at = self._period(step)
        elif folder not in self._passing:
            self._passing.append(folder)


def _words(sources: Sources) -> str:
    """How many datasets there are, and what waits."""
    waiting = f"{sources.waiting} episodes waiting" if sources.waiting else ""
    return ", ".join(filter(None, [f"{len(sources.all)} datasets" if len(sources.all) > 1 else "", waiting]))
