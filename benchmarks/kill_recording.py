"""Kills recordings at random instants, and counts which acknowledged episodes LeRobot can read afterwards.

Every round starts a recording, kills it with SIGKILL, loads the dataset with stock LeRobot as it lies there, and
compares every frame. The next round resumes the same dataset, which repairs it, and compares again; after ten rounds a
new dataset is begun.

    python benchmarks/kill_recording.py --kills 100 --seed 0
"""

from __future__ import annotations

import argparse
import itertools
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from csv_table import write_table

REPO_ID = "benchmark/kills"
ROUNDS_PER_DATASET = 10
IMAGE = "observation.images.front"


def length_of(episode: int) -> int:
    """Frames of an episode."""
    return 20 + 7 * (episode % 5)


def picture(episode: int, step: int) -> np.ndarray:
    """(100, 100, 3) uint8: smooth, as rooms are, and different in every frame."""
    y, x = np.mgrid[:100, :100]
    image = np.stack([x + step, y + episode, x * y // 50 + episode], axis=-1).astype(np.uint8)
    image[0, 0] = (episode % 256, episode // 256, step)
    return image


def record(root: Path, resume: bool) -> None:
    """Record until killed, and print after every save how many episodes are acknowledged."""
    from relmm.episodes import EpisodeRecorder
    from relmm.features import STATE_NAMES, action_dict, outcome_features

    outcome = dict.fromkeys(outcome_features(), 0)
    state = dict.fromkeys(STATE_NAMES, 0.0)
    with EpisodeRecorder(root, REPO_ID, resume=resume, depth=False, robot_type="none", info={}) as recorder:
        episode = recorder.saved_episodes
        print(episode, flush=True)
        while True:
            for step in range(length_of(episode)):
                action = action_dict(x=episode, y=step)
                recorder.add_frame({**state, "front": picture(episode, step)}, action, outcome, "benchmark")
                print(recorder.saved_episodes, flush=True)
            recorder.save_episode()
            episode += 1


def kill_one(root: Path, resume: bool, delay: float) -> int:
    """Start a recording, kill it `delay` seconds after its start-up, and return what it had acknowledged."""
    command = [sys.executable, __file__, "--record", str(root), *(["--resume"] if resume else [])]
    # Unbuffered: what a buffer has read ahead would come after what is read past it.
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True, bufsize=0) as process:
        assert process.stdout is not None
        output = process.stdout.readline()  # the start-up is over
        end = time.monotonic() + delay
        while (left := end - time.monotonic()) > 0:
            if select.select([process.stdout], [], [], left)[0]:
                output += os.read(process.stdout.fileno(), 65536)
        os.killpg(process.pid, signal.SIGKILL)
        output += process.stdout.read()
    counts = [int(line) for line in output.decode().split("\n")[:-1]]
    # The queue of the recorder holds no more than 25 episodes, so the count cannot jump further.
    if any(not 0 <= b - a <= 25 for a, b in itertools.pairwise(counts)):
        raise RuntimeError(f"the acknowledgements are out of order, so this round shows nothing: {counts}")
    return counts[-1]


def readable_episodes(root: Path, checked: int) -> int:
    """How many episodes stock LeRobot reads whole, each once; pictures are compared from episode `checked` on."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset(REPO_ID, root=root, video_backend="pyav")
    columns = dataset.hf_dataset.with_format("numpy", columns=["episode_index", "frame_index", "action"])[:]
    start = 0
    for episode in range(dataset.num_episodes):
        length = length_of(episode)
        rows = slice(start, start + length)
        whole = (
            np.array_equal(columns["episode_index"][rows], np.full(length, episode))
            and np.array_equal(columns["frame_index"][rows], np.arange(length))
            and np.array_equal(columns["action"][rows, 3:], [(episode, step) for step in range(length)])
        )
        if whole and episode >= checked:
            pixels = [(np.asarray(dataset[start + step][IMAGE]) * 255).round() for step in range(length)]
            whole = all(np.array_equal(p.transpose(1, 2, 0), picture(episode, s)) for s, p in enumerate(pixels))
        if not whole:
            return episode
        start += length
    return dataset.num_episodes


def run(kills: int, seed: int, output: Path) -> bool:
    """The whole benchmark; returns whether every acknowledged episode was readable."""
    random = np.random.default_rng(seed)
    folder = Path(tempfile.mkdtemp(prefix="relmm-kills-"))
    rows: list[dict[str, float]] = []
    checked = 0
    for number in range(kills):
        root, fresh = folder / str(number // ROUNDS_PER_DATASET), number % ROUNDS_PER_DATASET == 0
        delay = float(random.uniform(0.1, 2.0))
        acknowledged = kill_one(root, resume=not fresh, delay=delay)
        before = 0 if fresh else checked
        readable = checked = readable_episodes(root, before) if acknowledged else 0
        row = {"kill": number, "seed": seed, "delay_s": round(delay, 3), "before": before}
        row |= {"acknowledged": acknowledged, "readable": readable, "unreadable": max(0, acknowledged - readable)}
        rows.append(row)
        print(f"{number + 1}/{kills}: acknowledged {acknowledged}, readable {readable}", file=sys.stderr, flush=True)
    shutil.rmtree(folder)
    save(rows, output)
    return not any(row["unreadable"] for row in rows)


def save(rows: list[dict[str, float]], output: Path) -> None:
    """Write a row a kill as CSV, counting whole datasets, and print the sums, counting each episode once."""
    write_table(rows, output)
    new = [sum(row[key] - row["before"] for row in rows) for key in ("acknowledged", "readable")]
    sums = [*new, sum(row["unreadable"] for row in rows)]
    print("kills  episodes acknowledged before the kill  readable after  unreadable")
    print(f"{len(rows):5}  {sums[0]:39}  {sums[1]:14}  {sums[2]:10}")


def main() -> int:
    """Parse the arguments; `--record` is for the processes that are killed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "kill_recording.csv")
    parser.add_argument("--record", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--resume", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.record is not None:
        record(arguments.record, arguments.resume)
        return 0
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    with tempfile.TemporaryDirectory(prefix="relmm-kills-hf-") as caches:
        os.environ["HF_HOME"] = caches
        return 0 if run(arguments.kills, arguments.seed, arguments.output) else 1


if __name__ == "__main__":
    sys.exit(main())
