"""A serial cable for emulators: a pseudo-terminal behind a link as in /dev/serial/by-id, to unplug and plug in."""

from __future__ import annotations

import contextlib
import os
import pty
import select
import tty
from pathlib import Path


class Cable:
    """One end of a serial line; the other is the device that `path` leads to.

    Args:
        path: of the link.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._master = -1
        self.plug()

    @property
    def plugged(self) -> bool:
        return self._master >= 0

    def plug(self) -> None:
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        self._slave = slave  # kept open: without it the master fails between two programs that use the line
        self.path.symlink_to(os.ttyname(slave))

    def unplug(self) -> None:
        """Whoever has it open gets an error, and the device is gone."""
        self.path.unlink()
        master, self._master = self._master, -1
        os.close(master)
        os.close(self._slave)

    def read(self) -> bytes:
        try:
            return os.read(self._master, 65536) if self.plugged else b""
        except BlockingIOError:
            return b""

    def wait(self, seconds: float) -> None:
        """Until something comes, at most so long."""
        with contextlib.suppress(OSError, ValueError):  # it is being unplugged
            select.select([self._master] if self.plugged else [], [], [], seconds)

    def write(self, data: bytes) -> None:
        if self.plugged:
            with contextlib.suppress(BlockingIOError):  # nobody reads: a serial line loses what is not taken
                os.write(self._master, data)

    def fileno(self) -> int:
        return self._master

    def close(self) -> None:
        if self.plugged:
            self.unplug()
