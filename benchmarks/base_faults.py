"""How soon the base of a LoCoBot is told to stand still after a fault, on a Kobuki that is emulated byte by byte.

    python benchmarks/base_faults.py --times 10

The emulator takes commands every 20 ms, which is part of each time, and so is what a busy machine adds.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from csv_table import write_table

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "base_faults.csv"
sys.path.insert(0, str(HERE.parent / "tests" / "robot" / "hardware"))
from kobuki_emulator import KobukiEmulator  # noqa: E402

# A program that drives for ever, and tells the number of its guard; with `once` it gives a single command.
PROGRAM = """
import sys, time
from relmm.robot.hardware.kobuki import Kobuki
kobuki = Kobuki(sys.argv[1])
kobuki.wait_until_there()
print(kobuki._guard.pid, flush=True)
kobuki.drive(0.3, 0.0)
while True:
    time.sleep(0.01)
    if sys.argv[2] == "for ever":
        kobuki.drive(0.3, 0.0)
"""
_PATIENCE_S = 20.0
Fault = Callable[[KobukiEmulator, int, int], None]  # gets the base, and the numbers of the program and its guard


def _switch(name: str, bits: int) -> Fault:
    return lambda base, program, guard: setattr(base, name, bits)


FAULTS: dict[str, Fault] = {
    "no new command": lambda base, program, guard: None,
    "bumper": _switch("bumper", 2),
    "cliff": _switch("cliff", 1),
    "wheel drop": _switch("wheel_drop", 1),
    "over-current": _switch("over_current", 1),
    "kill -9 of the program": lambda base, program, guard: os.kill(program, signal.SIGKILL),
    "SIGSTOP of the program": lambda base, program, guard: os.kill(program, signal.SIGSTOP),
    "kill -9 of the guard": lambda base, program, guard: os.kill(guard, signal.SIGKILL),
}


def _wait_for(condition: Callable[[], bool]) -> None:
    until = time.monotonic() + _PATIENCE_S
    while not condition():
        if time.monotonic() > until:
            raise TimeoutError("the base did not do what was expected")
        time.sleep(0.002)


@contextmanager
def driven(base: KobukiEmulator, how: str) -> Iterator[tuple[int, int]]:
    """A program that drives the base; its number and its guard's."""
    words = [sys.executable, "-c", PROGRAM, str(base.cable.path), how]
    program = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert program.stdout is not None
    try:
        guard = int(program.stdout.readline())
        _wait_for(lambda: base.command[0] > 100)
        yield program.pid, guard
    finally:
        program.kill()
        program.wait()


def measure(name: str) -> float:
    """Seconds from a fault to the first command to stand still."""
    with tempfile.TemporaryDirectory() as folder, KobukiEmulator(Path(folder) / "kobuki") as base:
        lonely = name == "no new command"
        with driven(base, "once" if lonely else "for ever") as (program, guard):
            # The lonely command is the fault itself: what counts from it on is when the base began to move.
            began = next(when for when, speed, _ in base.commands if speed) if lonely else time.monotonic()
            FAULTS[name](base, program, guard)
            _wait_for(lambda: any(when >= began and speed == 0 for when, speed, _ in base.commands))
            return next(when for when, speed, _ in base.commands if when >= began and speed == 0) - began


def main() -> None:
    """Measure, print the table, write the CSV."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=10, help="each fault")
    arguments = parser.parse_args()
    rows = []
    for name in FAULTS:
        seconds = [measure(name) for _ in range(arguments.times)]
        rows.append(
            {
                "fault": name,
                "times": len(seconds),
                "median_s": round(float(np.median(seconds)), 3),
                "worst_s": round(max(seconds), 3),
            }
        )
        print(", ".join(f"{key} {value}" for key, value in rows[-1].items()), flush=True)
    write_table(rows, RESULTS)


if __name__ == "__main__":
    main()
