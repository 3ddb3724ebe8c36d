"""Growing datasets of many robots or rooms, read as one stream: each episode once, whoever recorded it."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from relmm.episodes.folder import INFO, DatasetFolder
from relmm.episodes.follow import Episode, EpisodeFollower
from relmm.episodes.summary import saved_episodes
from relmm.episodes.upload import recorded_runs
from relmm.errors import DatasetError

_SETTLED_S = 1.0  # file systems keep times of some milliseconds: what changed just now may change again unnoticed


@dataclass
class Cursor:
    """How far one dataset has been learned from, as a checkpoint keeps it.

    Attributes:
        name: the dataset's folder, for messages; and what it is known by if its recorder wrote no runs.
        episodes: how many of the first ones were learned from.
        runs: with what it was recorded; see `relmm.episodes.upload.recorded_runs`.
    """

    name: str
    episodes: int = 0
    runs: list[dict[str, Any]] = field(default_factory=list)

    def is_of(self, name: str, runs: list[dict[str, Any]]) -> bool:
        """Whether a dataset is the one of this cursor, wherever it has been moved to."""
        return runs[: len(self.runs)] == self.runs if self.runs else name == self.name


class Source:
    """One growing dataset.

    Args:
        root: its folder; it need not exist yet.
        camera: the camera that it must be of, None for any.

    Attributes:
        learned: episodes that an earlier run has learned from.
        follower: reads it.
        waiting: episodes that were saved and not read, when it was last looked at.
        runs: with what it was recorded, likewise.

    Raises:
        DatasetError: it exists, and is none that relmm can train on.
    """

    def __init__(self, root: Path, camera: str | None) -> None:
        self.root, self.learned, self.waiting = root, 0, 0
        self.follower = EpisodeFollower(root, 0, camera)
        self.runs = recorded_runs(DatasetFolder(root))
        self._seen: tuple[float, ...] = ()  # when files were added, before it was read to the end
        self._looking: tuple[float, ...] = ()  # likewise, before it was last looked at
        self._looked = 0.0

    @property
    def cursor(self) -> Cursor:
        """How far it has been read."""
        return Cursor(str(self.root.absolute()), self.follower.next, self.runs)

    def look(self) -> bool:
        """Whether there may be something new; a thousand quiet datasets must cost next to nothing."""
        times = _times(self.root)
        if times == self._seen and not self.follower.problem and max(times, default=0.0) < self._looked - _SETTLED_S:
            return False
        self._looking, self._looked = times, time.time()
        self.runs = recorded_runs(DatasetFolder(self.root))
        info = DatasetFolder(self.root).read_json(INFO) or {}
        total = info.get("total_episodes")
        self.waiting = max(total - self.follower.next, 0) if isinstance(total, int) else 0
        return True

    def read_new(self) -> Iterator[Episode]:
        """Every episode that was saved since, one at a time in memory.

        Raises:
            DatasetError: as `EpisodeFollower.read_new`.
        """
        for episode in self.follower.read_new():
            self.waiting = max(self.waiting - 1, 0)
            yield episode
        self._seen = self._looking


def _times(root: Path) -> tuple[float, ...]:
    """When files were last added to the list of episodes, or the newest of them written to."""
    folders = sorted((root / "meta" / "episodes").glob("*"))
    return tuple(folder.stat().st_mtime for folder in folders)


class Sources:
    """Growing datasets that are learned from together.

    Args:
        places: each a dataset, or a folder of datasets, which may be joined by others at any time; none need exist yet.
        camera: the camera that they must be of, None for any.
        learned: cursors of an earlier run.

    Attributes:
        problems: by folder, why a dataset in a folder of datasets is left out, or is not read any further for now.

    Raises:
        DatasetError: a dataset that was named is none that relmm can train on, or there twice.
    """

    def __init__(self, places: Sequence[Path], camera: str | None, learned: Sequence[Cursor] = ()) -> None:
        self._places, self._camera, self._cursors = places, camera, list(learned)
        self._by_root: dict[Path, Source] = {}
        self._by_recording: dict[str, Source] = {}  # by the first run
        self.problems: dict[Path, str] = {}
        self._left_out: set[Path] = set()
        self.find()

    @property
    def all(self) -> list[Source]:
        """Those that were found so far, in that order."""
        return list(self._by_root.values())

    @property
    def missing(self) -> list[Cursor]:
        """Cursors of an earlier run whose dataset is not there, or has fewer episodes than were learned from."""
        return [cursor for cursor in self._cursors if cursor.episodes]

    @property
    def waiting(self) -> int:
        """Episodes that are known to be saved, and not read."""
        return sum(source.waiting for source in self.all)

    def find(self) -> None:
        """Look for datasets that are new."""
        for place in self._places:
            if not _is_folder_of_datasets(place):
                if (place / INFO).exists():
                    self._add(place)
                continue
            for root in sorted(path.parent.parent for path in place.glob(f"*/{INFO}")):
                try:
                    self._add(root)
                except DatasetError as error:
                    self.leave_out(root, error)

    def read_learned(self) -> Iterator[tuple[Source, Episode]]:
        """The episodes that an earlier run has learned from, to fill a replay with.

        Raises:
            DatasetError: one of them is damaged.
        """
        for source in self.all:
            while source.follower.next < source.learned:
                before = source.follower.next
                for episode in source.follower.read_new():
                    yield source, episode
                    if source.follower.next == source.learned:
                        break
                if source.follower.next == before:
                    raise DatasetError(f"{source.follower.problem}; restore it from a copy.")

    def read_new(self) -> Iterator[tuple[Source, Episode]]:
        """Every episode that was saved since, one at a time in memory; a dataset that is new begins with its first.

        Raises:
            DatasetError: a dataset that was named is damaged; one in a folder of datasets is left out instead.
        """
        self.find()
        changed = [source for source in self.all if source.root not in self._left_out and source.look()]
        for source in changed:
            try:
                for episode in source.read_new():
                    yield source, episode
            except DatasetError as error:
                if source.root in self._places:
                    raise
                self.leave_out(source.root, error)
            if source.follower.problem:
                self.problems[source.root] = source.follower.problem
            elif source.root not in self._left_out:
                self.problems.pop(source.root, None)

    def leave_out(self, root: Path, error: DatasetError) -> None:
        """Read no more of a dataset: one bad robot must not end the learning of all."""
        self._left_out.add(root)
        self.problems[root] = str(error)

    def _add(self, root: Path) -> None:
        if root in self._left_out or root in self._by_root:
            return
        source = Source(root, self._camera)
        recording = json.dumps(source.runs[:1], sort_keys=True) if source.runs else str(root)
        if recording in self._by_recording:
            raise DatasetError(
                f"{root} and {self._by_recording[recording].root} hold the same recording, and each episode is learned "
                "from once; leave one of them out."
            )
        self._by_root[root] = self._by_recording[recording] = source
        for cursor in self._cursors:
            if cursor.is_of(str(root.absolute()), source.runs) and saved_episodes(root) >= cursor.episodes:
                source.learned = cursor.episodes
                self._cursors.remove(cursor)
                break


def _is_folder_of_datasets(place: Path) -> bool:
    return place.is_dir() and not (place / "meta").exists()
