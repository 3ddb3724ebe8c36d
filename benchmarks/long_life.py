"""How long LeRobot takes to open a long life before and after its files are packed, and how long packing takes.

    python benchmarks/long_life.py --frames 20000

Frames are those of the sample dataset, over and over, in episodes of 13, as in training.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from csv_table import write_table
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from relmm.episodes import DurableDataset, compact
from relmm.episodes.settings import LEROBOT_COLUMNS
from relmm.features import IMAGE_KEY, outcome_features

SAMPLE = Path(__file__).parents[1] / "datasets" / "first_attempts"
OUTPUT = Path(__file__).parent / "results" / "long_life.csv"
REPO_ID, LENGTH, DEFAULT_FRAMES = "local/long_life", 13, 20_000


def sample_frames() -> list[dict[str, Any]]:
    """Frames as the writer takes them."""
    sample = LeRobotDataset("local/sample", root=SAMPLE)
    frames = []
    for item in sample:
        frame = {key: np.zeros(1, feature["dtype"]) for key, feature in outcome_features().items()}  # of newer columns
        for key, feature in sample.features.items():
            if key not in LEROBOT_COLUMNS and key != IMAGE_KEY:
                frame[key] = item[key].numpy().reshape(feature["shape"])
        frame[IMAGE_KEY] = (item[IMAGE_KEY].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
        frames.append(frame)
    return frames


def opening(root: Path) -> float:
    """Seconds until a frame can be had."""
    start = time.perf_counter()
    LeRobotDataset(REPO_ID, root=root)[0]
    return time.perf_counter() - start


def measure(frames: int, root: Path) -> dict[str, Any]:
    """A row of the table."""
    many, compact._MANY_FILES = compact._MANY_FILES, frames  # packed only when it has been opened as it is
    dataset = DurableDataset.create(REPO_ID, root, False, "locobot_sim", {"camera": "paper"})
    endless = itertools.cycle(sample_frames())
    for _ in range(frames // LENGTH):
        for frame in itertools.islice(endless, LENGTH):
            dataset.add_frame(frame, "tidy the room")
        dataset.save_episode()
    dataset.close()
    before, files = opening(root), len(list(root.glob("data/*/*.parquet")))
    compact._MANY_FILES = many
    start = time.perf_counter()
    DurableDataset.open(root, REPO_ID).close()
    packing = time.perf_counter() - start
    return {
        "frames": frames // LENGTH * LENGTH,
        "episodes": frames // LENGTH,
        "files_before": files,
        "open_before_s": round(before, 1),
        "pack_s": round(packing, 1),
        "files_after": len(list(root.glob("data/*/*.parquet"))),
        "open_after_s": round(opening(root), 1),
    }


def main() -> None:
    """Measure, print the row, write the CSV."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=DEFAULT_FRAMES)
    arguments = parser.parse_args()
    opening(SAMPLE)  # imports and caches do not count
    with tempfile.TemporaryDirectory() as folder:
        row = measure(arguments.frames, Path(folder) / "life")
    print(", ".join(f"{key} {value}" for key, value in row.items()))
    write_table([row], OUTPUT)


if __name__ == "__main__":
    main()
