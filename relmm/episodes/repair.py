"""Bring a dataset that was cut off back to its whole episodes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from relmm.episodes.exchange import finish_exchange
from relmm.episodes.folder import EPISODE_FILES, INFO, RELMM, STATS, TASKS, DatasetFolder
from relmm.episodes.info import read_info, read_own
from relmm.episodes.parquet import read_table
from relmm.episodes.survey import Survey, survey
from relmm.errors import DatasetError


@dataclass
class RepairReport:
    """What a repair did.

    Attributes:
        root: the dataset.
        episodes: whole episodes in it now.
        frames: their frames.
        problems: sentences about what was lost or rebuilt; empty when nothing was wrong.
        dropped_to: where the files of incomplete episodes were put; None when there were none.
    """

    root: Path
    episodes: int
    frames: int
    problems: list[str] = field(default_factory=list)
    dropped_to: Path | None = None

    def __str__(self) -> str:
        state = f"{self.root} holds {self.episodes} whole episodes, {self.frames} frames"
        aside = [f"what was dropped is in {self.dropped_to}"] if self.dropped_to else []
        return "; ".join([state, *self.problems, *aside]) + "."


def verify_and_repair(root: Path | str) -> RepairReport:
    """Cut a dataset back to its longest run of whole episodes from the first one on.

    Whole episodes are never touched. Files beyond them are moved to `images/dropped-<n>`, where LeRobot does not
    look; counters, statistics and tasks are rebuilt from the parquet files. Doing it twice changes nothing more, and
    a repair that is killed can be repeated.

    Args:
        root: a LeRobot dataset (v3.0) of pictures; also one that LeRobot itself recorded.

    Raises:
        DatasetError: no dataset, being written, or nothing in it is whole; then nothing was changed.
    """
    folder = DatasetFolder(root)
    if folder.read_json(INFO) is None and folder.read_json(RELMM) is None:
        raise DatasetError(f"{root} is no LeRobot dataset, it has no readable {INFO}; check the folder.")
    try:
        folder.lock()
        try:
            report = repair(folder)
            folder.clear_scratch()
        finally:
            folder.unlock()
    except OSError as error:
        raise DatasetError(
            f"{root} cannot be repaired ({error.strerror or error}); make room or check the permissions, "
            "then repair it again."
        ) from error
    return report


def repair(folder: DatasetFolder) -> RepairReport:
    """`verify_and_repair` for whoever holds the lock."""
    finish_exchange(folder)
    stored = read_info(folder)
    info = stored or _rebuilt_info(folder)
    found = survey(folder, info["data_path"])
    _refuse_hopeless(folder, found, info, info_was_read=stored is not None)
    folder.clear_scratch()
    report = RepairReport(folder.root, len(found.episodes), found.frames, list(found.problems))
    report.problems += _describe_strays(found)
    report.dropped_to = folder.set_aside(found.stray_files)
    for name in found.cut_files:
        _keep_first_rows(folder, name, found.kept_rows[name])
    total_tasks = _repair_tasks(folder, found, report)
    _repair_stats(folder, found, report)
    counters = {
        "total_episodes": len(found.episodes),
        "total_frames": found.frames,
        "total_tasks": total_tasks,
        "splits": {"train": f"0:{len(found.episodes)}"} if found.episodes else {},
    }
    if stored != info | counters:
        folder.write_json(INFO, info | counters)
        report.problems.append("meta/info.json was rebuilt")
    return report


def _rebuilt_info(folder: DatasetFolder) -> dict[str, Any]:
    from lerobot.datasets.dataset_metadata import CODEBASE_VERSION
    from lerobot.datasets.feature_utils import create_empty_dataset_info
    from lerobot.utils.constants import DEFAULT_FEATURES

    own = read_own(folder)
    if own is None:
        raise DatasetError(f"{folder.root} has neither a readable {INFO} nor {RELMM}; restore one of them first.")
    features = own["features"] | DEFAULT_FEATURES
    return create_empty_dataset_info(CODEBASE_VERSION, own["fps"], features, False, own["robot_type"]).to_dict()


def _refuse_hopeless(folder: DatasetFolder, found: Survey, info: dict[str, Any], info_was_read: bool) -> None:
    videos = [key for key, feature in info["features"].items() if feature["dtype"] == "video"]
    if videos and (found.stray_files or found.cut_files):
        raise DatasetError(
            f"{folder.root} was cut off and has videos ({', '.join(videos)}), which cannot be cut to whole episodes; "
            "nothing was changed, restore it from a copy."
        )
    if found.episodes or not found.stray_files:
        return
    if info["total_episodes"] > 0 or not info_was_read:
        raise DatasetError(
            f"no whole episode can be read from {folder.root} (LeRobot's own recorder leaves this when it is killed); "
            "nothing was changed, restore it from a copy or record into a new folder."
        )


def _describe_strays(found: Survey) -> list[str]:
    if found.problems or not (found.stray_files or found.cut_files):
        return []
    count, files = len(found.episodes), ", ".join(found.stray_files + found.cut_files)
    return [f"episode {count} was cut off while it was saved, {files} dropped"]


def _keep_first_rows(folder: DatasetFolder, name: str, rows: int) -> None:
    table = read_table(folder.root / name)
    temporary = folder.scratch / name
    temporary.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table.slice(0, rows), temporary, compression="snappy", use_dictionary=True)
    folder.publish(folder.scratch, [name])


def _repair_tasks(folder: DatasetFolder, found: Survey, report: RepairReport) -> int:
    """Make sure that every task of a whole episode has its name; returns how many tasks there are."""
    try:
        tasks = read_table(folder.root / TASKS).to_pandas()
        known = dict(zip(tasks["task_index"], tasks.index, strict=True))
    except (OSError, KeyError, ValueError, TypeError, pa.ArrowException):
        known = {}
    names = {
        index: name
        for row, indices in zip(found.episodes, found.task_indices, strict=True)
        for index, name in zip(indices, row["tasks"], strict=False)
    }
    if names.keys() <= known.keys():
        return len(known)
    if sorted(names) != list(range(len(names))):
        raise DatasetError(f"{folder.root / TASKS} is lost and some task has no episode left; restore it from a copy.")
    ordered = [names[index] for index in range(len(names))]
    temporary = folder.scratch / TASKS
    temporary.parent.mkdir(parents=True, exist_ok=True)
    pd.DataFrame({"task_index": range(len(ordered))}, index=pd.Index(ordered, name="task")).to_parquet(temporary)
    folder.publish(folder.scratch, [TASKS])
    report.problems.append(f"{TASKS} was rebuilt")
    return len(ordered)


def _repair_stats(folder: DatasetFolder, found: Survey, report: RepairReport) -> None:
    stats = folder.read_json(STATS)
    if not found.episodes:
        if stats is not None:
            (folder.root / STATS).unlink()
        return
    if stats is not None and stats.get("index", {}).get("count") == [found.frames]:
        return
    from lerobot.datasets.compute_stats import aggregate_stats
    from lerobot.datasets.utils import serialize_dict

    folder.write_json(STATS, serialize_dict(aggregate_stats(_episode_stats(folder))))
    report.problems.append(f"{STATS} was rebuilt")


def _episode_stats(folder: DatasetFolder) -> list[dict[str, dict[str, Any]]]:
    from lerobot.datasets.io_utils import cast_stats_to_numpy

    stats: list[dict[str, Any]] = []
    for name in folder.files(EPISODE_FILES):
        rows = read_table(folder.root / name).to_pylist()
        stats += [
            {key.removeprefix("stats/"): value for key, value in row.items() if key.startswith("stats/")}
            for row in rows
        ]
    return [cast_stats_to_numpy(episode) for episode in stats]
