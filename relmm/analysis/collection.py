"""The attempts of a dataset, with what their pictures show and what a policy thinks of them, written as parquet."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from relmm.analysis.pictures import Viewer
from relmm.analysis.reading import Columns, Reader, cells_of, with_consequences
from relmm.episodes.pictures import decode_picture
from relmm.features import GRID, IMAGE_KEY, FloatArray, Skill

if TYPE_CHECKING:  # torch takes seconds, and most reports need none
    from relmm.analysis.predictions import Predictor

GRASPS, STEPS = "grasps.parquet", "steps.parquet"
# fmt: off
_STEP_COLUMNS = [
    "episode", "frame", "index", "run", "robot_time", "seconds", "phase", "skill", "x_vel", "theta_vel", "holding",
    "holding_after", "p_grasp", "odom_x", "odom_y", "odom_heading",
]
# fmt: on
_SAMPLES = 3  # pictures with a policy's maps, of successes and of failures each


@dataclass(frozen=True, eq=False)
class Sample:
    """An attempt with the map that a policy had of it.

    Attributes:
        episode, frame: where it is in the dataset.
        success: whether it picked something up.
        cell: attempted, -1 outside the grasp area.
        image: the whole picture, (100, 100, 3).
        mean: the policy's, of each cell, (225,).
    """

    episode: int
    frame: int
    success: bool
    cell: int
    image: NDArray[np.uint8]
    mean: FloatArray


@dataclass
class Collection:
    """What was collected.

    Attributes:
        root: of the dataset.
        frames: a row a frame, of `relmm.analysis.reading.with_consequences`.
        grasps: a row an attempt, without pictures; see `docs/analysis.md` for the columns.
        runs: of `meta/relmm.json`.
        notes: what could not be read or shown, in sentences.
        samples: attempts with a policy's maps.
        learned_episodes: how many of the first episodes the policy has learned from; None if nobody wrote it down.
        policy_spread: of the policy in each cell, on average over the attempts' pictures, (225,); None without one.
    """

    root: Path
    frames: pd.DataFrame
    grasps: pd.DataFrame
    runs: list[dict[str, Any]]
    notes: list[str]
    samples: list[Sample] = field(default_factory=list)
    learned_episodes: int | None = None
    policy_spread: FloatArray | None = None

    @property
    def steps(self) -> pd.DataFrame:
        """A row for each frame that is no attempt."""
        frames = self.frames.rename(columns={"grasp_probability": "p_grasp"})
        return frames.loc[frames["skill"] != "grasp", _STEP_COLUMNS]


def collect(
    root: Path,
    output: Path,
    predictor: Predictor | None = None,
    learned_episodes: int | None = None,
    progress: Callable[[int, int], None] = lambda frames, total: None,
) -> Collection:
    """Read a dataset and write `grasps.parquet` and `steps.parquet`.

    Args:
        root: the dataset.
        output: folder for the files.
        predictor: of the policy to ask about each attempt.
        learned_episodes: how many of the first episodes it has learned from, None if that is not known.
        progress: takes frames read since the last call, and how many there are in all.

    Raises:
        DatasetError: it is no relmm dataset, or of another camera than the policy's.
    """
    reader = Reader(root, predictor.camera if predictor else None)
    output.mkdir(parents=True, exist_ok=True)
    with _PictureFile(output / f".{GRASPS}.pictures", Viewer(reader.camera), predictor) as pictures:
        numbers = reader.read(pictures.see, lambda count: progress(count, reader.frames_listed))
        frames = with_consequences(numbers, reader.runs)
        grasps = _attempts(frames, learned_episodes, predictor is not None)
        grasps = pictures.write(grasps, output / GRASPS)
    notes = reader.notes
    if pictures.broken:
        notes.append(f"{pictures.broken} attempts have no picture that can be decoded.")
    collection = Collection(
        root, frames, grasps, reader.runs, notes, pictures.samples, learned_episodes, pictures.spread
    )
    _write(output / STEPS, lambda path: collection.steps.to_parquet(path, index=False))
    return collection


def _attempts(frames: pd.DataFrame, learned: int | None, predicted: bool) -> pd.DataFrame:
    grasps = frames[(frames["skill"] == "grasp")].copy()
    grasps = grasps.rename(
        columns={"skill_x": "x", "skill_y": "y", "grasp_probability": "p_grasp", "grasp_mean": "mean"}
    ).rename(columns={"grasp_std": "spread"})
    grasps["cell"] = cells_of(grasps["x"].to_numpy(), grasps["y"].to_numpy())
    grasps["distance"] = np.hypot(grasps["x"], grasps["y"])
    grasps["bearing"] = np.degrees(np.arctan2(grasps["y"], grasps["x"]))
    if predicted:
        grasps["learned_from"] = pd.Series(pd.NA if learned is None else grasps["episode"] < learned, grasps.index)
        grasps["learned_from"] = grasps["learned_from"].astype("boolean")
    return grasps.drop(columns=["skill", "x_vel", "theta_vel"])


@dataclass(frozen=True)
class _Attempt:
    """What is needed of a row of numbers to look at its picture."""

    episode: int
    frame: int
    index: int
    success: bool
    skill_x: float
    skill_y: float


class _PictureFile:
    """Keeps what pictures show on the disk until all numbers are known."""

    def __init__(self, path: Path, viewer: Viewer, predictor: Predictor | None) -> None:
        self._path, self._viewer, self._predictor = path, viewer, predictor
        self._rows: list[dict[str, Any]] = []
        self._writer: pq.ParquetWriter | None = None
        self._recent = {True: deque[Sample](maxlen=_SAMPLES), False: deque[Sample](maxlen=_SAMPLES)}
        names = ("policy_mean", "policy_spread", "policy_p_grasp") if predictor else ()
        self._schema = pa.schema(
            [("index", pa.int64()), ("light", pa.float64()), ("colour", pa.string())]
            + [(name, pa.float64()) for name in names]
            + [("picture", pa.binary())]
        )
        self.broken = self._predicted = 0
        self._spreads = np.zeros(GRID**2)

    def __enter__(self) -> _PictureFile:
        return self

    def __exit__(self, *_: object) -> None:
        if self._writer is not None:
            self._writer.close()
        self._path.unlink(missing_ok=True)

    @property
    def samples(self) -> list[Sample]:
        """The last successes and failures with maps."""
        return [*self._recent[True], *self._recent[False]]

    @property
    def spread(self) -> FloatArray | None:
        """Of the policy in each cell, on average over the pictures; None without one."""
        return self._spreads / self._predicted if self._predicted else None

    def see(self, frames: Columns, table: pa.Table) -> None:
        """Look at the attempts of an episode."""
        column, looks = table[IMAGE_KEY], []
        for place in np.flatnonzero(frames["skill"] == Skill.GRASP):
            attempt = _Attempt(*(frames[name][place].item() for name in _Attempt.__annotations__))
            row: dict[str, Any] = {"index": attempt.index}
            self._rows.append(row)
            try:
                image = decode_picture(column[attempt.frame]["bytes"].as_py())
            except (ValueError, cv2.error):
                self.broken += 1
                continue
            row |= vars(self._viewer.look(image, attempt.skill_x, attempt.skill_y))
            looks.append((row, image, attempt))
        if self._predictor is not None and looks:
            self._predict(looks)
        if len(self._rows) >= 1000:
            self._flush()

    def _predict(self, looks: list[tuple[dict[str, Any], Any, _Attempt]]) -> None:
        assert self._predictor is not None
        mean, spread, chance = self._predictor(np.stack([image for _, image, _ in looks]))
        self._spreads += spread.sum(axis=0)
        self._predicted += len(looks)
        for i, (row, image, attempt) in enumerate(looks):
            cell = int(cells_of(np.array([attempt.skill_x]), np.array([attempt.skill_y]))[0])
            row["policy_p_grasp"] = float(chance[i])
            if cell >= 0:
                row |= {"policy_mean": float(mean[i, cell]), "policy_spread": float(spread[i, cell])}
            sample = Sample(attempt.episode, attempt.frame, attempt.success, cell, image, mean[i])
            self._recent[sample.success].append(sample)

    def _flush(self) -> None:
        self._writer = self._writer or pq.ParquetWriter(self._path, self._schema)
        self._writer.write_table(pa.Table.from_pylist(self._rows, self._schema))
        self._rows = []

    def write(self, grasps: pd.DataFrame, path: Path) -> pd.DataFrame:
        """Write the attempts with their pictures; returns them with what the pictures show."""
        self._flush()
        assert self._writer is not None
        self._writer.close()
        with pq.ParquetFile(self._path) as seen:
            shown = [name for name in seen.schema_arrow.names if name != "picture"]
            complete = grasps.merge(seen.read(shown).to_pandas(), on="index", how="left", validate="one_to_one")
            _write(path, lambda temporary: self._join(complete, seen, temporary))
        return complete

    def _join(self, complete: pd.DataFrame, seen: pq.ParquetFile, path: Path) -> None:
        schema = pa.Schema.from_pandas(complete, preserve_index=False).append(pa.field("picture", pa.binary()))
        begin = 0
        with pq.ParquetWriter(path, schema) as writer:
            for group in range(seen.num_row_groups):
                pictures = seen.read_row_group(group, ["picture"])["picture"].combine_chunks()
                rows = complete.iloc[begin : begin + len(pictures)]
                table = pa.Table.from_pandas(rows, preserve_index=False)
                writer.write_table(table.append_column("picture", pictures).cast(schema))
                begin += len(pictures)


def _write(path: Path, write: Callable[[Path], None]) -> None:
    """A file that is there whole, or not at all."""
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        write(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
