"""What a dataset holds, read back from its parquet files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from relmm.episodes.folder import DATA_FILES, EPISODE_FILES, DatasetFolder
from relmm.episodes.outcomes import DERIVED, SOURCES, with_outcomes
from relmm.episodes.parquet import read_table
from relmm.episodes.survey import read_places
from relmm.errors import DatasetError
from relmm.features import ACTION_NAMES, FPS, Phase, Skill

COLUMNS = (
    "action",
    "next.reward",
    "next.success",
    "next.truncated",
    "complementary_info.phase",
    "complementary_info.robot_time",
    "episode_index",
)


@dataclass(frozen=True)
class DatasetSummary:
    """Counts of one dataset.

    Attributes:
        root: the dataset.
        episodes: how many.
        frames: how many, in all.
        frames_by_phase: frames of each phase.
        grasps: grasp attempts.
        successful_grasps: those that picked something up.
        ended_by_success: episodes whose last frame is a success.
        truncated: episodes that ended at their step limit.
        seconds: length as LeRobot plays it, frames divided by the frame rate.
        robot_seconds: time on the robot's clock between the first and last frame of each episode, summed.
    """

    root: Path
    episodes: int
    frames: int
    frames_by_phase: dict[Phase, int]
    grasps: int
    successful_grasps: int
    ended_by_success: int
    truncated: int
    seconds: float
    robot_seconds: float

    def __str__(self) -> str:
        rate = f" ({self.successful_grasps / self.grasps:.0%})" if self.grasps else ""
        rows = {
            "episodes": f"{self.episodes} ({self.ended_by_success} by success, {self.truncated} truncated)",
            "frames": f"{self.frames} ({self.seconds:.0f} s at {FPS} fps, {self.robot_seconds:.0f} s on the robot)",
            **{f"  {phase.name.lower().replace('_', ' ')}": str(n) for phase, n in self.frames_by_phase.items()},
            "grasps": f"{self.grasps}, successful {self.successful_grasps}{rate}",
        }
        return "\n".join([str(self.root), *(f"  {name:<16}{value}" for name, value in rows.items())])


def summarize(root: Path | str) -> DatasetSummary:
    """Count what is in a dataset; reads a few columns, no pictures, and needs no LeRobot.

    Raises:
        DatasetError: no relmm dataset, or a file that was cut off.
    """
    folder = DatasetFolder(root)
    files = folder.files(DATA_FILES)
    if not files:
        raise DatasetError(f"there are no episodes in {root}; check the folder.")
    columns = _read(folder, files)
    episode = columns["episode_index"]
    last = np.append(episode[1:] != episode[:-1], True)
    first = np.roll(last, 1)
    grasp = columns["action"].reshape(-1, len(ACTION_NAMES))[:, ACTION_NAMES.index("skill.pos")] == Skill.GRASP
    phase, time = columns["complementary_info.phase"], columns["complementary_info.robot_time"].astype(np.float64)
    return DatasetSummary(
        root=Path(root),
        episodes=int(last.sum()),
        frames=len(episode),
        frames_by_phase={p: int((phase == p).sum()) for p in Phase},
        grasps=int(grasp.sum()),
        successful_grasps=int((grasp & (columns["next.reward"] > 0)).sum()),
        ended_by_success=int(columns["next.success"][last].sum()),
        truncated=int(columns["next.truncated"][last].sum()),
        seconds=len(episode) / FPS,
        robot_seconds=float((time[last] - time[first]).sum()),
    )


def saved_episodes(root: Path | str) -> int:
    """How many episodes a dataset lists, also while it is being recorded; those in damaged files do not count."""
    folder = DatasetFolder(root)
    tables = (read_places(folder.root / name) for name in folder.files(EPISODE_FILES))
    return sum(len(table) for table in tables if table is not None)


def _read(folder: DatasetFolder, files: list[str]) -> dict[str, NDArray[Any]]:
    tables = []
    for name in files:
        try:
            found = read_table(folder.root / name, list(COLUMNS))
            missing = set(COLUMNS) - set(found.column_names)
            if missing and missing <= set(DERIVED):
                found = read_table(folder.root / name, sorted({*COLUMNS, *SOURCES} - missing))
        except (OSError, pa.ArrowException) as error:
            raise DatasetError(f"{folder.root / name} cannot be read ({error}); repair the dataset first.") from error
        if not missing <= set(DERIVED):
            raise DatasetError(f"{folder.root} is no relmm dataset, it has no column {min(missing - set(DERIVED))}.")
        tables.append(found.replace_schema_metadata())
    try:
        table, _ = with_outcomes(pa.concat_tables(tables), COLUMNS)
        flat = {key: table[key].combine_chunks() for key in COLUMNS}
        flat["action"] = flat["action"].flatten()
        numbers = {key: values.to_numpy(zero_copy_only=False).astype(np.float64) for key, values in flat.items()}
    except (ValueError, TypeError, AttributeError, pa.ArrowException) as error:
        raise DatasetError(f"{folder.root} is no relmm dataset, its columns are of other types ({error}).") from error
    whole = len(numbers["action"]) == len(ACTION_NAMES) * len(table) > 0
    if not whole or not all(np.isfinite(values).all() for values in numbers.values()):
        raise DatasetError(f"{folder.root} is damaged, numbers are missing or not finite; repair the dataset first.")
    return numbers
