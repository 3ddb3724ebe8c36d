"""Trainings that are killed again and again: what is recorded, learned and counted must agree every time.

    python benchmarks/kill_training.py --kills 50

`own` trains on a robot and records; `followed` learns from a dataset that another process records all the time. Adam
counts its steps, four an attempt, so a checkpoint tells whether it has learned from each attempt exactly once.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
from csv_table import write_table
from long_life import sample_frames
from safetensors.torch import load_file

from relmm.episodes import DurableDataset, read_episodes, summarize
from relmm.features import ACTION_NAMES, Skill
from relmm.learning.progress import read_metrics

OUTPUT = Path(__file__).parent / "results" / "kill_training.csv"
SKILL = ACTION_NAMES.index("skill.pos")
LEAST, UPDATES = 4, 4  # attempts before the first update, and updates an attempt
LEARN = [
    *("--policy.device=cpu", f"--policy.min_attempts_to_update={LEAST}", "--policy.batch_size=4"),
    *("--policy.channels=4", "--policy.num_stationary=4", "--replay_frames=100000"),
    *("--env_eval_freq=0", "--log_freq=1", "--save_freq=2", "--steps=1000000"),
]
ROBOT = ["--robot.type=locobot_sim", "--robot.room=no_obstacles", "--max_steps=6", "--pseudo_reset_steps=1"]
FORKS = multiprocessing.get_context("forkserver")


def start(module: str, arguments: list[str], log: Path) -> BaseProcess:
    """A command in a process that has imported everything already."""
    process = FORKS.Process(target=_run, args=(module, arguments, str(log)))
    process.start()
    return process


def record_slowly(root: Path) -> None:
    """A live recorder: an episode of the sample dataset's frames every now and then, until it is terminated."""
    frames = itertools.cycle(sample_frames())
    with DurableDataset.create("local/life", root, False, "locobot_sim", {"camera": "paper"}) as dataset:
        while True:
            for frame in itertools.islice(frames, 5):
                dataset.add_frame(frame, "tidy the room")
            dataset.save_episode()
            time.sleep(0.5)


def _run(module: str, arguments: list[str], log: str) -> None:
    os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND), 1)
    os.dup2(1, 2)
    sys.argv = [module, *arguments]
    __import__(f"relmm.commands.{module}", fromlist=["main"]).main()


def grasps(root: Path, episodes: int) -> int:
    """Attempts in the first so many episodes."""
    total = 0
    for episode in read_episodes(root):
        if episode.index < episodes:
            total += int((episode.actions[:, SKILL].round() == Skill.GRASP).sum())
    return total


def adam_steps(run: Path) -> tuple[int, int]:
    """Of the newest checkpoint: its episodes, and the updates it has made."""
    state = (run / "checkpoints" / "last").resolve() / "training_state"
    episodes = json.loads((state / "relmm_state.json").read_text())["counters"]["episodes"]
    moments = load_file(state / "grasping" / "optimizer_state.safetensors")
    steps = [int(value) for name, value in moments.items() if name.endswith("/step")]
    return episodes, max(steps, default=0)


def wait(until: Callable[[], bool], process: BaseProcess | None, log: Path) -> None:
    """Wait; a process that ends meanwhile is an error."""
    deadline = time.monotonic() + 300
    while not until():
        if time.monotonic() > deadline or (process is not None and not process.is_alive()):
            raise SystemExit(f"{log}: {log.read_text()[-2000:]}")
        time.sleep(0.05)


def check(run: Path, root: Path) -> bool:
    """Whether the newest checkpoint has learned from each of its attempts once."""
    episodes, steps = adam_steps(run)
    return steps == UPDATES * max(grasps(root, episodes) - LEAST + 1, 0)


def kill_again_and_again(mode: str, kills: int, folder: Path) -> dict[str, object]:
    """A row of the table."""
    rng, run, log = np.random.default_rng(0), folder / "run", folder / "train.log"
    root = run / "dataset" if mode == "own" else folder / "data"
    recorder = None
    if mode == "followed":
        recorder = FORKS.Process(target=record_slowly, args=(root,))
        recorder.start()
    source = ROBOT if mode == "own" else [f"--dataset.follow={root}", "--dataset.max_waiting=100000"]
    begin = [*source, *LEARN, f"--output_dir={run}"]
    resume = ["--resume=true", f"--output_dir={run}", "--policy.device=cpu"]
    last, wrong = run / "checkpoints" / "last", 0
    for number in range(kills):
        before = last.readlink() if last.is_symlink() else None
        trainer = start("train", begin if number == 0 else resume, log)
        wait(lambda: last.is_symlink() and last.readlink() != before, trainer, log)  # noqa: B023
        time.sleep(rng.uniform(0, 2))
        assert trainer.pid is not None
        os.kill(trainer.pid, signal.SIGKILL)
        trainer.join()
        wrong += not check(run, root)
    trainer = start("train", [*resume, f"--steps={int(last.readlink().name) + 3}"], log)
    trainer.join()
    if recorder is not None:
        recorder.terminate()
        recorder.join()
    wrong += not check(run, root)
    episodes, steps = adam_steps(run)
    counted = read_metrics(run / "metrics.jsonl")[-1]["attempts"]
    return {
        "mode": mode,
        "kills": kills,
        "disagreements": wrong,
        "episodes_recorded": summarize(root).episodes,
        "episodes_learned": episodes,
        "attempts_recorded": grasps(root, episodes),
        "attempts_learned": steps // UPDATES + LEAST - 1,
        "attempts_counted": counted,
    }


def main() -> None:
    """Kill, print the table, write the CSV."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50, help="of each kind of training")
    kills = parser.parse_args().kills
    FORKS.set_forkserver_preload(["relmm.commands.train"])
    rows = []
    for mode in ("own", "followed"):
        with tempfile.TemporaryDirectory() as folder:
            rows.append(kill_again_and_again(mode, kills, Path(folder)))
        print(", ".join(f"{key} {value}" for key, value in rows[-1].items()), flush=True)
    write_table(rows, OUTPUT)


if __name__ == "__main__":
    main()
