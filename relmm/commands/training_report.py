"""`report.html` beside the metrics of a run: refreshed in the background while it trains, and made whole at its end."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from relmm.analysis.page import write_page
from relmm.commands.background import BackgroundCommand
from relmm.commands.cli import progress

_PAUSE = 20  # times as long as the last one took until the next one begins: at most 5 % of one processor


class TrainingReport:
    """The report of one run; nothing that happens to it ends the run.

    Args:
        root: the run's dataset.
        name: of the dataset.
        page: where the report goes.
        say: prints a line.
    """

    def __init__(self, root: Path, name: str, page: Path, say: Callable[[str], None] = print) -> None:
        self.say = say
        self._root, self._name, self._page = root, name, page
        self._making: BackgroundCommand | None = None
        self._begun = self._next = 0.0

    def refresh(self) -> None:
        """Begin a new one in the background, unless the last one is too fresh."""
        self.check()
        if self._making is not None or time.monotonic() < self._next:
            return
        self._begun = time.monotonic()
        self._making = BackgroundCommand(["relmm.analysis.page", str(self._root), self._name, str(self._page)])

    def check(self) -> None:
        """See whether one is ready, and say it if it has failed."""
        if self._making is None or self._making.running:
            return
        now = time.monotonic()
        self._next = now + _PAUSE * (now - self._begun)
        if problem := self._making.problem():
            self._say_failed(problem)
        self._making = None

    def finish(self) -> None:
        """Make the last one, of all there is, and wait for it."""
        if self._making is not None:
            self._making.stop()
            self._making = None
        try:
            self._write()
            self.say(f"report: {self._page}")
        except KeyboardInterrupt:
            self._say_failed("it was stopped")
        except Exception as error:  # whatever it is, the run has ended well
            self._say_failed(str(error) or type(error).__name__)

    def _write(self) -> None:
        with closing(progress(0, "frame", "writing the report", leave=False)) as bar:

            def show(frames: int, total: int) -> None:
                bar.total = total
                bar.update(frames)

            write_page(self._root, self._name, self._page, show)

    def _say_failed(self, why: str) -> None:
        words = " ".join(why.split()).rstrip(".")
        self.say(f"report: {words}. The run is none the worse; relmm-analyze --dataset.root={self._root} tries again.")
