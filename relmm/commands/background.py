"""A command that runs beside a training, which it neither slows nor ends."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from typing import IO


class BackgroundCommand:
    """A Python module in a process of its own, of which only the last line of stderr is kept.

    Args:
        words: the module and its arguments.
        environment: variables to set, besides one thread for numpy and PyTorch.
    """

    def __init__(self, words: list[str], **environment: str) -> None:
        self._errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115  # closed with the process
        # In a session of its own, where a Ctrl-C that is meant for the run does not reach it.
        self._process = subprocess.Popen(
            [sys.executable, "-m", *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            env={**os.environ, "OMP_NUM_THREADS": "1", **environment},
            start_new_session=True,
        )

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self._process.poll() is None

    def problem(self) -> str:
        """Why it has failed; empty if it has not. To be asked once, after it has ended."""
        self._errors.seek(0)
        errors = self._errors.read()
        self._errors.close()
        return last_line(errors) if self._process.returncode else ""

    def stop(self) -> None:
        """End it."""
        self._process.terminate()
        self._process.wait()
        self._errors.close()


def last_line(errors: bytes) -> str:
    """The last line of what a command has written to stderr."""
    lines = errors.decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else "it has ended without a word."
