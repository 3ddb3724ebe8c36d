"""How many attempts a second N rooms make for one learner, until the cores are full: `relmm-train --fleet.rooms=N`.

Counts what the rooms record between the moment when all of them have recorded something and the end. Prints a line for
each N, and appends it to a CSV.

    python benchmarks/fleet_rooms.py --rooms 1 2 4 8 --seconds 120
"""

from __future__ import annotations

import argparse
import os
import signal
import tempfile
import time
from pathlib import Path

import psutil
from csv_table import append_row
from fleet_actors import start, wait_until

from relmm.episodes import saved_episodes, summarize
from relmm.learning.progress import read_metrics

_START_S = 900.0  # that all rooms may take to record something


def measure(rooms: int, seconds: float) -> dict[str, float]:
    """One line of the table."""
    with tempfile.TemporaryDirectory(prefix="relmm-rooms-") as temporary:
        folder = Path(temporary)
        run = folder / "run"
        options = [f"--fleet.rooms={rooms}", "--robot.type=locobot_sim", "--policy.device=cpu", "--env_eval_freq=0"]
        fixed = ["--steps=1000000", "--log_freq=20", "--max_steps=25", "--curriculum.type=none", f"--output_dir={run}"]
        learner = start("train", folder / "train.log", *options, *fixed)
        try:
            began = time.monotonic()
            roots = [run / "rooms" / f"room_{n:02d}" for n in range(rooms)]
            wait_until(lambda: all(saved_episodes(root) for root in roots), _START_S, "the start of all rooms")
            starting = time.monotonic() - began
            before, used, began = _grasps(roots), _cpu(learner.pid), time.monotonic()
            time.sleep(seconds)
            took, cores = time.monotonic() - began, _cpu(learner.pid) - used
            frames, grasps = (now - then for now, then in zip(_grasps(roots), before, strict=True))
            metrics = read_metrics(run / "metrics.jsonl")
        finally:
            learner.send_signal(signal.SIGTERM)
            learner.wait(180)
        return {
            "rooms": rooms,
            "seconds": round(took, 1),
            "starting_s": round(starting, 1),
            "frames_per_s": round(frames / took, 3),
            "attempts_per_s": round(grasps / took, 3),
            "cores": round(cores / took, 2),
            "most_waiting": max((line.get("episodes_waiting", 0) for line in metrics), default=0),
            "load_at_end": round(os.getloadavg()[0], 1),
        }


def _grasps(roots: list[Path]) -> tuple[int, int]:
    """Frames and attempts of all rooms."""
    found = [summarize(root) for root in roots]
    return sum(each.frames for each in found), sum(each.grasps for each in found)


def _cpu(pid: int) -> float:
    """Seconds of the processors that a process and all its children have had."""
    process = psutil.Process(pid)
    return sum(sum(each.cpu_times()[:2]) for each in [process, *process.children(recursive=True)])


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--csv", type=Path, default=Path("benchmarks/results/fleet_rooms.csv"))
    arguments = parser.parse_args()
    for rooms in arguments.rooms:
        line = measure(rooms, arguments.seconds)
        print(line, flush=True)
        append_row(line, arguments.csv)


if __name__ == "__main__":
    main()
