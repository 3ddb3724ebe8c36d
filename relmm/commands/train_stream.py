"""The learner of relmm-train where others record: episodes come in, checkpoints go out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from relmm.commands.cli import progress
from relmm.commands.training_bar import TrainingBar
from relmm.commands.training_run import Run
from relmm.episodes import Episode
from relmm.episodes.sources import Sources
from relmm.errors import ConfigError
from relmm.learning.checkpoint import pretrained_model, read_cursors
from relmm.learning.intake import Intake

_POLL_S = 0.5  # between looks at the datasets


def train_on_stream(run: Run, watch: Callable[[TrainingBar], None] = lambda bar: None) -> None:
    """Learn from the datasets that a run follows, until its last step or a signal.

    Args:
        run: with `--dataset.follow`.
        watch: called at each look at the datasets, to look after whoever records them.

    Raises:
        ConfigError: a dataset that its checkpoint has learned from is missing.
        DatasetError: a dataset that was named cannot be learned from.
    """
    sources = _sources(run)
    run.read_initial_data()
    _read_learned(run, sources)
    intake = Intake(run.learner, run.progress, lambda: sources.waiting, run.config.dataset.max_waiting)
    with run.bar(f"following {run.config.dataset.follow}") as bar:
        for place in run.config.followed:
            if not place.exists():
                bar.write(f"waiting for {place}, which is not there yet: start its recorder, or check the name")
        run.words = lambda: _words(sources)
        session = run.session(lambda: _save(run, sources), dict, bar)
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
    total = sum(source.learned for source in sources.all)
    with progress(total, "episode", "reading what was learned from", leave=False) as bar:
        for source, episode in sources.read_learned():
            run.learner.read(episode, update=False)
            run.progress.read(episode, str(source.root))
            bar.update()


def _arrivals(
    run: Run, sources: Sources, bar: TrainingBar, watch: Callable[[TrainingBar], None]
) -> Iterator[tuple[str, Episode]]:
    said: dict[str, str] = {}
    while not run.signals.stopped:
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
        watch(bar)
        if none:
            time.sleep(_POLL_S)


def _save(run: Run, sources: Sources) -> None:
    cursors = [source.cursor for source in sources.all]
    run.save(sum(cursor.episodes for cursor in cursors), [r for c in cursors for r in c.runs[:1]], cursors)


def _words(sources: Sources) -> str:
    """Who records, and what waits."""
    many = f"{len(sources.all)} robots, " if len(sources.all) > 1 else ""
    return f"{many}{sources.waiting} episodes waiting" if many or sources.waiting else ""
