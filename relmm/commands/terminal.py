"""A terminal that may go away while a job goes on: words that reach nobody are dropped, and never end the job."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import Any, TextIO


class _Words:
    """A stream whose reader may be gone.

    Args:
        stream: stdout or stderr.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write, or drop what nobody can read."""
        with self._dropping():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush, or drop."""
        with self._dropping():
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @contextlib.contextmanager
    def _dropping(self) -> Iterator[None]:
        try:
            yield
        except RuntimeError:  # a signal's words in the midst of others
            pass
        except (OSError, ValueError):  # BrokenPipeError of a pipe, EIO of a terminal, or closed
            # For good, and for everybody: what is buffered is written again when the interpreter ends.
            with contextlib.suppress(OSError, ValueError):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self._stream.fileno())
                os.close(nowhere)


@contextlib.contextmanager
def lasting() -> Iterator[None]:
    """Within it, what is printed cannot fail."""
    streams = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = words = _Words(sys.stdout), _Words(sys.stderr)
    try:
        yield
    finally:
        for stream in words:
            stream.flush()
        sys.stdout, sys.stderr = streams


def say_loading(command: str) -> None:
    """Tell who watches that it has begun: the imports take seconds."""
    if sys.stderr.isatty():
        print(f"{command}: loading", file=sys.stderr, flush=True)
