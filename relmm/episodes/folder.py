"""The folder of a dataset: its paths, its scratch space, its lock, and how a finished file gets into it.

LeRobot calls `<root>/images` its scratch folder: its loaders do not look into it and `push_to_hub` leaves it out.
Whatever must not be seen by readers lives there, on the file system of the dataset, so that a rename is atomic.
"""

from __future__ import annotations

import glob
import json
import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from relmm.errors import DatasetError

INFO = "meta/info.json"
STATS = "meta/stats.json"
TASKS = "meta/tasks.parquet"
RELMM = "meta/relmm.json"
EPISODE_FILES = "meta/episodes/*/*.parquet"
DATA_FILES = "data/*/*.parquet"
OWN_DATASET = "dataset"  # name of the folder of a run's dataset, in that of the run


def sync(path: Path) -> None:
    """Wait until a file, or the entries of a folder, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def refuse_links(root: Path) -> None:
    """See that a folder holds its files itself: what a link leads to must not be deleted, changed or uploaded.

    Raises:
        DatasetError: with the first link in it.
    """
    for folder, folders, files in os.walk(root):
        for name in sorted((*folders, *files)):
            path = Path(folder) / name
            if path.is_symlink():
                raise DatasetError(
                    f"{path} is a link to {os.readlink(path)}, and what links lead to is neither changed nor uploaded; "
                    "put a copy in its place, or remove it."
                )


class DatasetFolder:
    """Paths of one dataset, and the few operations on them that must be atomic.

    Attributes:
        root: the dataset.
        scratch: LeRobot's scratch folder, invisible to loaders and uploads.
        staging: where the next episode is written before it is published.
    """

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)
        self.scratch = self.root / "images"
        self.staging = self.scratch / "staging"
        self._lock_path = self.scratch / ".lock"
        # Not thread-local: a dataset may be closed by another thread than the one that opened it.
        self._lock = FileLock(self._lock_path, timeout=0, thread_local=False)

    def lock(self) -> None:
        """Become the only writer of this dataset; the lock of a killed process is free again.

        Raises:
            DatasetError: another writer has it open, or it has links.
        """
        refuse_links(self.root)
        self.scratch.mkdir(exist_ok=True)
        try:
            self._lock.acquire()
        except Timeout as error:
            raise DatasetError(
                f"{self.root} is being written by another process; a dataset takes one writer at a time: "
                "wait until it has ended or record into another folder."
            ) from error

    def unlock(self) -> None:
        """Let other writers in, and leave no trace of the lock."""
        # Removed while it is held: whoever has opened the old file already finds that it has no name, and retries.
        self._lock_path.unlink(missing_ok=True)
        self._lock.release()
        if self.scratch.is_dir() and not any(self.scratch.iterdir()):
            self.scratch.rmdir()

    def publish(self, source: Path, names: Iterable[str]) -> None:
        """Move finished files from `source` into the dataset, in the given order.

        Everything is on the disk before the first rename, so the renames follow each other within microseconds.

        Args:
            source: a folder below `scratch`.
            names: paths relative to `source`, and to the dataset.
        """
        names = list(names)
        for name in names:
            sync(source / name)
            (self.root / name).parent.mkdir(parents=True, exist_ok=True)
        for name in names:
            os.replace(source / name, self.root / name)
        for parent in {(self.root / name).parent for name in names}:
            sync(parent)

    def write_json(self, name: str, data: Any) -> None:
        """Replace a JSON file of the dataset atomically, formatted as LeRobot does."""
        temporary = self.scratch / name
        temporary.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(json.dumps(data, indent=4, ensure_ascii=False), encoding="utf-8")
        self.publish(self.scratch, [name])

    def read_json(self, name: str) -> dict[str, Any] | None:
        """A JSON object of the dataset; None when the file is missing, cut off or something else."""
        try:
            data = json.loads((self.root / name).read_text(encoding="utf-8"))
            json.dumps(data, ensure_ascii=False).encode()  # half a character could be read, but not written again
        except (FileNotFoundError, NotADirectoryError, ValueError, RecursionError):
            return None
        return data if isinstance(data, dict) else None

    def files(self, pattern: str) -> list[str]:
        """Relative paths that match, sorted as LeRobot reads them."""
        # Strings: thousands of `Path` objects would take a reader that polls 0.1 s each time.
        return sorted(glob.glob(pattern, root_dir=self.root, include_hidden=True))

    def set_aside(self, names: Iterable[str]) -> Path | None:
        """Move files of the dataset to a fresh `images/dropped-<n>`, where no loader finds them.

        Returns:
            The folder, or None when there was nothing to move.
        """
        names = list(names)
        if not names:
            return None
        taken = {path.name for path in self.scratch.glob("dropped-*")}
        number = next(n for n in range(1, len(taken) + 2) if f"dropped-{n}" not in taken)
        target = self.scratch / f"dropped-{number}"
        for name in names:
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(self.root / name, target / name)
        return target

    def clear_scratch(self) -> None:
        """Remove what an interrupted writer left behind; what was set aside stays."""
        for path in self.scratch.iterdir():
            if path == self._lock_path or path.name.startswith("dropped-"):
                continue
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
