"""`relmm-record` for a room of `relmm-train --fleet.rooms`: it ends, with all saved, as soon as the learner is gone."""

from __future__ import annotations

import os
import signal
import sys
import threading

from relmm.commands import record


def _end_with_learner() -> None:
    sys.stdin.buffer.read()  # until the other end of the pipe is closed, by whatever ended the learner
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    threading.Thread(target=_end_with_learner, daemon=True).start()
    record.main()
