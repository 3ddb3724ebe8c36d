"""A dataset as a table of numbers, a row a frame, with the pictures passing by one episode at a time.

Numbers of 100,000 frames are some 20 MB; pictures never stay in memory. Damage does not end the reading: what cannot be
read is left out, and said.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pyarrow as pa
from numpy.typing import NDArray

from relmm.analysis.columns import belief, column, fingerprints, matrix, without_nulls
from relmm.episodes.folder import EPISODE_FILES, INFO, RELMM, DatasetFolder
from relmm.episodes.info import runs_of
from relmm.episodes.outcomes import DERIVED, with_outcomes
from relmm.episodes.parquet import are_whole_numbers
from relmm.episodes.settings import LEROBOT_COLUMNS, check_trainable
from relmm.episodes.survey import read_columns, read_places, rows_of
from relmm.episodes.video import VIDEO_COLUMNS, in_video, read_video
from relmm.features import (
    ACTION_NAMES,
    BELIEF,
    DEPTH_KEY,
    GRASP_X,
    GRASP_Y,
    GRID,
    IMAGE_KEY,
    ODOMETRY,
    STATE_KEY,
    STATE_NAMES,
    FloatArray,
    Phase,
    Skill,
)
from relmm.geometry import CAMERAS

_OPTIONAL = tuple(f"complementary_info.{name}" for name in (*BELIEF, *ODOMETRY))
_STATE = {name: STATE_NAMES.index(name) for name in ("holding.pos", "gripper.pos")}
FOLLOWS_S = 60.0  # a frame that begins later than this after the one before does not follow on it
_FOLLOWS_M = 0.5  # nor one that is farther away; a skill moves the base by 0.1 m


Columns = dict[str, NDArray[Any]]  # of some frames, by name


class Reader:
    """Reads a relmm dataset, which may be growing.

    Args:
        root: its folder.
        camera: the camera that it must be of, None for any.

    Attributes:
        root: as given.
        columns: what is in it, of what is looked for.
        runs: what `meta/relmm.json` says with what its parts were recorded; none if nobody wrote it down.
        camera: geometry of the camera of its pictures, None if it is not known.
        camera_name: its name, None if nobody wrote it down.
        robot_type: as LeRobot stores it.
        frames_listed: how many there are, as soon as reading has begun.

    Raises:
        DatasetError: it is no relmm dataset, or of another camera.
    """

    def __init__(self, root: Path, camera: str | None = None) -> None:
        check_trainable(root, camera)
        self.root = root
        self._folder = DatasetFolder(root)
        info = self._folder.read_json(INFO) or {}
        self._features, self._data_path, self._fps = info["features"], str(info["data_path"]), float(info["fps"])
        self.columns = [name for name in dict.fromkeys((*DERIVED, *_OPTIONAL)) if name in self._features]
        self.runs = runs_of(self._folder.read_json(RELMM))
        self.camera_name = _camera_name(self._features)
        self.camera = None if self.camera_name is None else CAMERAS.get(self.camera_name)
        self.robot_type = str(info.get("robot_type"))
        self._lost: dict[str, list[str]] = {}
        self._bad_frames = 0
        self.frames_listed = 0

    def read(self, see: Callable[[Columns, pa.Table], None], progress: Callable[[int], None]) -> pd.DataFrame:
        """All frames that are saved by now, a row each; `with_consequences` adds what only the next frame tells.

        Args:
            see: takes the numbers and the table of each episode, pictures included, while they are in memory.
            progress: takes how many frames were read since the last call.
        """
        parts = [_no_frames()]
        for row, table in self.episodes([IMAGE_KEY, STATE_KEY, "action", *self.columns]):
            frames, lost = self._numbers(row, table)
            self._bad_frames += lost
            see(frames, table)
            parts.append(frames)
            progress(row["length"])
        return pd.DataFrame({name: np.concatenate([part[name] for part in parts]) for name in parts[0]})

    def rows(self) -> list[dict[str, Any]]:
        """Rows of meta/episodes, as far as its files can be read."""
        rows: list[dict[str, Any]] = []
        for name in self._folder.files(EPISODE_FILES):
            table = read_places(self._folder.root / name, VIDEO_COLUMNS if in_video(self._features) else ())
            if table is None:
                self._lose(name, "missing or cut off")
            else:
                rows += table.to_pylist()
        return sorted(rows, key=lambda row: row["episode_index"])

    @property
    def stored_columns(self) -> list[str]:
        """All but those that LeRobot adds by itself."""
        return [name for name in self._features if name not in LEROBOT_COLUMNS]

    @property
    def has_depth(self) -> bool:
        """Whether the depth picture is stored."""
        return DEPTH_KEY in self._features

    def episodes(self, columns: list[str]) -> Iterator[tuple[dict[str, Any], pa.Table]]:
        """Rows of meta/episodes, each with these columns of its frames, picture too; damage is left out and noted."""
        rows, name, table = self.rows(), "", None
        self.frames_listed = sum(max(row["length"], 0) for row in rows)
        wanted = ["episode_index", "index", *columns]
        filmed = in_video(self._features)
        if filmed:
            wanted.remove(IMAGE_KEY)
        for number in range(len(rows)):
            if not (self.root / self._place(rows[number])).is_file():
                # A recorder that ends packs its small files into a few: then everything is listed anew.
                rows[number:] = self.rows()[number : len(rows)] or rows[number:]
            row = rows[number]
            if self._place(row) != name:
                name = self._place(row)
                table = self._file(name, wanted)
            part = None if table is None else rows_of(row, table)
            if part is None and table is not None:
                self._lose(name, "without all the frames that are listed")
            if part is not None and filmed:
                part = self._with_pictures(row, part)
            if part is not None:
                yield row, part

    def _with_pictures(self, row: dict[str, Any], part: pa.Table) -> pa.Table | None:
        """The rows of an episode with the pictures of its video, as they would be stored without one."""
        try:
            images = read_video(self.root, row, len(part), self._fps)
        except ValueError:
            images = None
        if images is None:
            self._lose(f"the video of episode {row['episode_index']}", "missing or damaged")
            return None
        files = [cv2.imencode(".png", image[..., ::-1])[1].tobytes() for image in images]
        return part.append_column(IMAGE_KEY, pa.array([{"bytes": file} for file in files]))

    def _place(self, row: dict[str, Any]) -> str:
        return self._data_path.format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"])

    def _file(self, name: str, wanted: list[str]) -> pa.Table | None:
        table = read_columns(self._folder.root / name, wanted)
        if table is None or not are_whole_numbers(table, ["episode_index", "index"]):
            self._lose(name, "missing, cut off, or without a column that is listed")
            return None
        return table

    def _lose(self, name: str, why: str) -> None:
        files = self._lost.setdefault(why, [])
        if name not in files:
            files.append(name)

    @property
    def notes(self) -> list[str]:
        """Sentences about what could not be read."""
        lost = [
            f"{names[0]}{f' and {len(names) - 1} more files' * (len(names) > 1)}: {why}; what it held is left out."
            for why, names in self._lost.items()
        ]
        bad = f"{self._bad_frames} frames have numbers that are missing or not finite; they are left out."
        return lost + [bad] * bool(self._bad_frames)

    def _numbers(self, row: dict[str, Any], table: pa.Table) -> tuple[Columns, int]:
        """The numbers of an episode, and how many frames had none."""
        filled, known = with_outcomes(without_nulls(table), DERIVED)
        states, actions = matrix(filled, STATE_KEY, len(STATE_NAMES)), matrix(filled, "action", len(ACTION_NAMES))
        columns: Columns = {
            "episode": np.full(len(filled), row["episode_index"]),
            "frame": np.arange(len(filled)),
            "index": filled["index"].to_numpy(),
            "x_vel": actions[:, 0],
            "theta_vel": actions[:, 1],
            "skill": actions[:, 2].round(),
            "skill_x": actions[:, 3],
            "skill_y": actions[:, 4],
            **{name.partition(".")[0]: states[:, i] for name, i in _STATE.items()},
            "success": column(filled, "next.reward") > 0.5,
            "phase": column(filled, "complementary_info.phase"),
            "robot_time": column(filled, "complementary_info.robot_time"),
            **{name: belief(filled, name) for name in (*BELIEF, *ODOMETRY)},
            "known": known,
            "fingerprint": fingerprints(table, states, actions),
        }
        needed = ["skill", "skill_x", "skill_y", "phase", "robot_time", "x_vel", "theta_vel", "holding"]
        numbers = np.stack([*(columns[name] for name in needed), column(filled, "next.reward")])
        usable = np.isfinite(numbers).all(axis=0)
        usable &= np.isin(columns["skill"], list(Skill)) & np.isin(columns["phase"], list(Phase))
        return {name: values[usable] for name, values in columns.items()}, int((~usable).sum())


def with_consequences(frames: pd.DataFrame, runs: list[dict[str, Any]]) -> pd.DataFrame:
    """Add what only the next frame tells: how long each took, and what was in the gripper afterwards.

    Args:
        frames: of `Reader.read`.
        runs: of the reader.

    Returns:
        The frames with `run`, `follows` (whether the next row is the next moment of this robot's life), `seconds`,
        `holding_after` and `gripper_after` (NaN where nothing follows), and names for skill and phase.
    """
    frames = frames.copy()
    first = [int(run.get("first_episode", 0)) for run in runs] or [0]
    frames["run"] = np.searchsorted(first, frames["episode"], side="right") - 1
    later = frames.shift(-1)
    seconds = later["robot_time"] - frames["robot_time"]
    near = np.hypot(later["odom_x"] - frames["odom_x"], later["odom_y"] - frames["odom_y"]) < _FOLLOWS_M
    near |= frames["odom_x"].isna() & (later["episode"] == frames["episode"])
    frames["follows"] = (later["index"] == frames["index"] + 1) & (seconds > 0) & (seconds < FOLLOWS_S) & near
    frames["follows"] &= later["run"] == frames["run"]
    frames["seconds"] = seconds.where(frames["follows"])
    for name in ("holding", "gripper"):
        frames[f"{name}_after"] = later[name].where(frames["follows"])
    frames["skill"] = frames["skill"].map({skill: skill.name.lower() for skill in Skill})
    frames["phase"] = frames["phase"].map({phase: phase.name.lower() for phase in Phase})
    return frames


def cells_of(x: FloatArray, y: FloatArray) -> NDArray[np.int64]:
    """The grasp cell of each point (m, robot frame), as `relmm.features.xy_to_cell`; -1 outside the grasp area."""
    ix = np.floor((x - GRASP_X[0]) / (GRASP_X[1] - GRASP_X[0]) * GRID)
    iy = np.floor((y - GRASP_Y[0]) / (GRASP_Y[1] - GRASP_Y[0]) * GRID)
    inside = (ix >= 0) & (ix < GRID) & (iy >= 0) & (iy < GRID)
    return np.where(inside, GRID * ix + iy, -1).astype(np.int64)


def _camera_name(features: dict[str, Any]) -> str | None:
    info = features[IMAGE_KEY].get("info")
    camera = info.get("camera") if isinstance(info, dict) else None
    return str(camera.get("name")) if isinstance(camera, dict) else None


def _no_frames() -> Columns:
    kinds = {"known": bool, "success": bool, "fingerprint": np.uint64, "episode": int, "frame": int, "index": int}
    names = [*kinds, "x_vel", "theta_vel", "skill", "skill_x", "skill_y", "holding", "gripper", "phase", "robot_time"]
    return {name: np.zeros(0, kinds.get(name, float)) for name in (*names, *BELIEF, *ODOMETRY)}
