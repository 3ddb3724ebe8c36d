"""The process that writes a dataset behind the robot loop. `EpisodeRecorder` is its other half."""

from __future__ import annotations

import contextlib
import os
import signal
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from relmm.episodes.writer import DurableDataset
from relmm.errors import DatasetError, RelmmError

# The recording process decides when to end; a signal to the whole group must not cut off what it has handed over.
IGNORED_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
NICENESS = 10  # the robot loop comes first; when the queue is full it waits, and the writer has the core


@dataclass(frozen=True)
class WriterSettings:
    """What the process opens or creates; the arguments of `DurableDataset`."""

    root: Path
    repo_id: str
    resume: bool
    depth: bool
    robot_type: str
    info: dict[str, Any]

    def start(self) -> DurableDataset:
        """Open or create the dataset."""
        if self.resume:
            return DurableDataset.open(
                self.root, self.repo_id, depth=self.depth, robot_type=self.robot_type, info=self.info
            )
        return DurableDataset.create(self.repo_id, self.root, self.depth, self.robot_type, self.info)


@dataclass(frozen=True)
class Reply:
    """What the process says after it has opened the dataset, after each saved episode, and when it fails."""

    saved_episodes: int
    repaired: str = ""
    error: RelmmError | None = None


def write_episodes(commands: Connection, replies: Connection, settings: WriterSettings) -> None:
    """Carry out commands until their connection is closed, which also happens when the recording process dies.

    Args:
        commands: where `("frames", [(frame, task), ...])`, `("save",)` and `("discard",)` come from.
        replies: where a `Reply` goes.
        settings: the dataset.
    """
    for number in IGNORED_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    saved = 0
    try:
        with settings.start() as dataset:
            saved = dataset.episodes
            repaired = dataset.repaired
            replies.send(Reply(saved, str(repaired) if repaired and repaired.problems else ""))
            os.nice(NICENESS)  # only now: somebody waits for the dataset to be opened
            for name, *arguments in iter(lambda: _receive(commands), None):
                _carry_out(dataset, name, arguments)
                saved = dataset.episodes
                if name == "save":
                    _answer(replies, Reply(saved))
    except RelmmError as error:
        _answer(replies, Reply(saved, error=error))
    except Exception as error:
        _answer(replies, Reply(saved, error=DatasetError(f"the writer of {settings.root} has failed: {error!r}.")))
        raise


def _carry_out(dataset: DurableDataset, name: str, arguments: list[Any]) -> None:
    if name == "frames":
        for frame, task in arguments[0]:
            dataset.add_frame(frame, task)
    elif name == "save":
        dataset.save_episode()
    else:
        dataset.discard_episode()


def _receive(commands: Connection) -> tuple[Any, ...] | None:
    try:
        return commands.recv()
    except (EOFError, OSError):  # also one that was killed in the middle of a message
        return None


def _answer(replies: Connection, reply: Reply) -> None:
    # When the recording process is dead, what it has handed over is saved all the same.
    with contextlib.suppress(BrokenPipeError):
        replies.send(reply)
