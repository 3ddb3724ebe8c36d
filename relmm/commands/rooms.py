"""Several simulated rooms on this machine: a recorder process each, looked after by the learner."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from relmm.episodes.folder import INFO, RELMM, DatasetFolder
from relmm.errors import MANY, MAX_SEED, FleetError

_COMMAND = (sys.executable, "-m", "relmm.commands.room")
_SEED_STEP = 1_000_003  # between rooms: a resumed recording goes on with its seed plus its episodes
_TRIES = 3  # starts of a room without a single episode, after which something else is wrong
_LONGEST_PAUSE_S = 30.0  # between a room's end and its next start
_SAVING_S = 60.0  # how long a room may take to save and end


class Rooms:
    """Recorders of one run, each started again when it ends; a context manager that ends them all.

    Args:
        folder: of their datasets and logs.
        robot: settings of the robot, as JSON values.
        policy: folder of the checkpoint that they act by, which is renewed while they run.
        count: how many.
        seed: of the run.
        options: more of them for relmm-record.
    """

    def __init__(
        self, folder: Path, robot: dict[str, Any], policy: Path, count: int, seed: int, options: list[str]
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._rooms = []
        for index in range(count):
            root = folder / f"room_{index:02d}"
            settings = {
                "robot": robot,
                "dataset": {"repo_id": f"local/{root.name}", "root": str(root)},
                "seed": (seed + _SEED_STEP * (index + 1)) % MAX_SEED,
            }
            root.with_suffix(".json").write_text(json.dumps(settings, indent=4), encoding="utf-8")
            self._rooms.append(_Room(root, [f"--policy.path={policy.absolute()}", *options]))

    def watch(self, say: Callable[[str], None]) -> None:
        """Start those that do not run.

        Args:
            say: takes a line for the user, where one has ended by itself.

        Raises:
            FleetError: one ends again and again.
        """
        for room in self._rooms:
            if (problem := room.keep_running()) is not None:
                say(problem)

    def __str__(self) -> str:
        restarts = sum(room.restarts for room in self._rooms)
        return f"{len(self._rooms)} rooms" + (f", {restarts} restarts" if restarts else "")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for room in self._rooms:
            room.ask_to_end()
        deadline = time.monotonic() + _SAVING_S
        for room in self._rooms:
            room.wait(deadline)


class _Room:
    """One recorder.

    Args:
        root: of its dataset; settings and log are beside it.
        options: of relmm-record, beyond its settings.
    """

    def __init__(self, root: Path, options: list[str]) -> None:
        self._root, self._options = root, options
        self._process: subprocess.Popen[bytes] | None = None
        self._episodes, self._failures, self._start_at = self._saved(), 0, 0.0
        self.restarts = 0

    def keep_running(self) -> str | None:
        """Start it if it does not run; why it ended, if it just did."""
        if self._process is None:
            if time.monotonic() >= self._start_at:
                self._start()
            return None
        if self._process.poll() is None:
            return None
        assert self._process.stdin is not None
        self._process.stdin.close()
        why = f"{self._root.name} has ended (exit code {self._process.returncode}: {self._last_words()})"
        self._process, saved = None, self._saved()
        self._failures = 1 if saved > self._episodes else self._failures + 1
        self._episodes = saved
        if self._failures >= _TRIES:
            raise FleetError(
                f"{why} {_TRIES} times in a row without a new episode; see {self._root.with_suffix('.log')}, then go "
                "on with --resume=true."
            )
        self.restarts += 1
        self._start_at = time.monotonic() + min(2.0**self._failures, _LONGEST_PAUSE_S)
        return f"{why}; it starts again"

    def ask_to_end(self) -> None:
        """Let it save and end."""
        if self._process is not None:
            assert self._process.stdin is not None
            self._process.stdin.close()

    def wait(self, deadline: float) -> None:
        """Until it has ended; what does not end by itself is killed, and loses the episode it was in."""
        if self._process is None:
            return
        try:
            self._process.wait(max(deadline - time.monotonic(), 0.1))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _start(self) -> None:
        if self._root.exists() and not (self._root / RELMM).exists():  # killed before there was anything to resume
            shutil.rmtree(self._root)
        options = [*self._options, f"--resume={str(self._root.exists()).lower()}"]
        with self._root.with_suffix(".log").open("ab") as log:
            # In a session of its own, where a Ctrl-C that is meant for the run does not reach it.
            self._process = subprocess.Popen(
                [
                    *_COMMAND,
                    *(f"--config_path={self._root.with_suffix('.json')}", f"--dataset.num_episodes={MANY}", *options),
                ],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
                start_new_session=True,
            )

    def _saved(self) -> int:
        total = (DatasetFolder(self._root).read_json(INFO) or {}).get("total_episodes")
        return total if isinstance(total, int) else 0

    def _last_words(self) -> str:
        lines = self._root.with_suffix(".log").read_bytes()[-10_000:].decode(errors="replace").strip().splitlines()
        return lines[-1].strip() if lines else "it said nothing"
