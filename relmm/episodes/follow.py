"""Whole episodes of a dataset as arrays, also while another process is still recording it.

The writer publishes the data of an episode before the row of meta/episodes that lists it, each by a rename. So what is
listed is there and stays as it is, and every file has to be read only once. Needs no LeRobot.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
from numpy.typing import DTypeLike, NDArray

from relmm.episodes.folder import EPISODE_FILES, INFO, DatasetFolder
from relmm.episodes.outcomes import with_outcomes
from relmm.episodes.parquet import are_whole_numbers
from relmm.episodes.pictures import decode_picture
from relmm.episodes.settings import TRAINING_COLUMNS, check_trainable
from relmm.episodes.survey import read_columns, read_places, rows_of
from relmm.episodes.video import VIDEO_COLUMNS, in_video, read_video
from relmm.errors import DatasetError
from relmm.features import ACTION_NAMES, IMAGE_KEY, IMAGE_SIZE, STATE_KEY, STATE_NAMES, WEIGHTS_STEP

_WRONG_TYPES = (ValueError, TypeError, AttributeError, KeyError, pa.ArrowException)  # of columns of other types
MAX_STEPS = 10_000  # navigation steps of an episode, and of a pseudo-reset before and after it
_MAX_FRAMES = 5 * MAX_STEPS  # of an episode: they are in memory at once, and a small file may claim any number


@dataclass(frozen=True, eq=False)
class Episode:
    """One whole episode of n frames.

    Attributes:
        index: its number in the dataset.
        images: (n, 100, 100, 3) uint8, RGB.
        states: (n, len(STATE_NAMES)) float32, units as in `relmm.features`.
        actions: (n, 5) float32, what was done, by `relmm.features.ACTION_NAMES`.
        rewards: (n,) float32, 1 where the frame's grasp picked something up; see `relmm.episodes.outcomes`.
        dones: (n,) bool, ended with what the episode was for.
        truncated: (n,) bool, ended at the step limit.
        phases: (n,) int64, a `relmm.features.Phase` each.
        grasp_probabilities: (n,) float32, P[grasp], -1 where it was not asked.
        robot_times: (n,) float32, s on the robot's clock.
        weights_step: steps of the learner whose weights acted last, -1 where that is not known.
    """

    index: int
    images: NDArray[np.uint8]
    states: NDArray[np.float32]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float32]
    dones: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    phases: NDArray[np.int64]
    grasp_probabilities: NDArray[np.float32]
    robot_times: NDArray[np.float32]
    weights_step: int = -1

    def __len__(self) -> int:
        return len(self.rewards)


def read_episodes(root: Path | str, first: int = 0, camera: str | None = None) -> Iterator[Episode]:
    """All episodes that are saved by now, in order, one at a time in memory.

    Args:
        root: a dataset; it may be being recorded.
        first: number of the first episode to read.
        camera: the camera that it must be of, None for any.

    Returns:
        An iterator, which raises DatasetError where a listed episode is damaged.

    Raises:
        DatasetError: no dataset, or none that relmm can train on; at once, not at the first episode.
    """
    check_trainable(root, camera)
    return _read_all(EpisodeFollower(root, first, camera))


def _read_all(follower: EpisodeFollower) -> Iterator[Episode]:
    stopped_at = None
    while True:
        yield from follower.read_new()
        if not follower.problem:
            return
        # Once may be a file that appeared between listing and reading; twice is damage.
        if stopped_at == follower.next:
            raise DatasetError(
                f"{follower.problem}; resume its recording, which repairs it, or restore it from a copy."
            )
        stopped_at = follower.next


class RowFollower:
    """Reads the list of a growing dataset's episodes: each row once, and in order.

    Attributes:
        next: number of the next episode; whoever takes one counts on.
        problem: why the last reading stopped, in words; empty when it came to the end.
        more_columns: of the list, to be read besides `PLACE_COLUMNS`.
    """

    def __init__(self, root: Path | str, first: int) -> None:
        self.next, self.problem = first, ""
        self.more_columns: Sequence[str] = ()
        self._folder = DatasetFolder(root)
        # By file of meta/episodes: which one it was when it was read, and the number of its last episode.
        self._last_episodes: dict[str, tuple[int, int]] = {}

    def new_rows(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Rows of meta/episodes from episode `next` on, with the file each is in; reads a file when it is needed."""
        names = self._folder.files(EPISODE_FILES)
        for name in names[bisect_left(names, self.next, key=self._last_episode) :]:
            rows = self._rows(name)
            if rows is None:
                self.problem = f"{self._folder.root / name} is missing or cut off"
                return
            yield from ((name, row) for row in rows if row["episode_index"] >= self.next)

    def _last_episode(self, name: str) -> int:
        """Of a file of meta/episodes; for one that cannot be read, a number that does not let it be skipped."""
        known = self._last_episodes.get(name)
        if known is None or known[0] != self._inode(name):  # another file has taken its place, with more in it
            self._rows(name)
            known = self._last_episodes.get(name)
        return self.next if known is None else known[1]

    def _inode(self, name: str) -> int:
        try:
            return (self._folder.root / name).stat().st_ino
        except FileNotFoundError:
            return -1

    def _rows(self, name: str) -> list[dict[str, Any]] | None:
        inode = self._inode(name)  # before it is read: what comes in between is seen as another one the next time
        table = read_places(self._folder.root / name, self.more_columns)
        if table is None:
            return None
        rows: list[dict[str, Any]] = table.to_pylist()
        if rows:
            self._last_episodes[name] = inode, rows[-1]["episode_index"]
        return rows


class EpisodeFollower(RowFollower):
    """Reads episodes as they are saved: each once, whole, and in order.

    Attributes:
        next: number of the next episode.
        problem: why the last reading stopped at an episode that is listed, in words; empty when it did not. It passes
            where files were just being replaced, or LeRobot's own recorder has not finished them; else it is damage.
    """

    def __init__(self, root: Path | str, first: int = 0, camera: str | None = None) -> None:
        """Reads no episode yet.

        Args:
            root: the dataset; it need not exist yet.
            first: number of the first episode to read.
            camera: the camera that it must be of, None for any.

        Raises:
            DatasetError: it exists, and is none that relmm can train on.
        """
        super().__init__(root, first)
        self._camera = camera
        self._data = self._find_data()

    def poll(self) -> list[Episode]:
        """The episodes that were saved since the last call; none while there is no dataset.

        Raises:
            DatasetError: the dataset is none that relmm can train on, or has a picture that cannot be decoded.
        """
        return list(self.read_new())

    def read_new(self) -> Iterator[Episode]:
        """As `poll`, with one episode at a time in memory."""
        self.problem = ""
        if self._data is None:
            self._data = self._find_data()
        if self._data is None:
            return
        data = _DataFiles(self._folder, self._data)
        for _, row in self.new_rows():
            episode = data.read(row) if row["episode_index"] == self.next else None
            if episode is None:
                self.problem = f"episode {self.next} of {self._folder.root} is missing or cut off"
                return
            self.next += 1
            yield episode

    def read_frames(self, row: dict[str, Any], frames: pa.Table) -> Episode | None:
        """An episode that is in memory, checked like any other.

        Args:
            row: of meta/episodes.
            frames: with the columns of a data file.

        Returns:
            The episode; None when the frames are not all there.

        Raises:
            DatasetError: as `poll`.
        """
        assert self._data is not None
        return _DataFiles(self._folder, self._data).read_table(row, frames.select(self._data.columns))

    def _find_data(self) -> _Layout | None:
        info = self._folder.read_json(INFO)
        if info is None:
            return None
        check_trainable(self._folder.root, self._camera)
        filmed = in_video(info["features"])
        self.more_columns = VIDEO_COLUMNS if filmed else ()
        wanted = (*TRAINING_COLUMNS, WEIGHTS_STEP)
        columns = [name for name in wanted if name in info["features"] and not (filmed and name == IMAGE_KEY)]
        return _Layout(str(info["data_path"]), ["episode_index", "index", *columns], float(info["fps"]), filmed)


@dataclass(frozen=True)
class _Layout:
    """Where a dataset's episodes are: LeRobot's template for data files, their columns, whether there are videos."""

    data_path: str
    columns: list[str]
    fps: float
    in_video: bool


class _DataFiles:
    """Reads episodes from the data files; LeRobot puts several into one file when it edits a dataset."""

    def __init__(self, folder: DatasetFolder, layout: _Layout) -> None:
        self._folder, self._layout = folder, layout
        self._name = ""
        self._table: pa.Table | None = None  # the file of the last episode, its pictures still compressed

    def read(self, row: dict[str, Any]) -> Episode | None:
        """The episode of a row of meta/episodes; None when its file does not hold it whole."""
        name = self._layout.data_path.format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"])
        if name != self._name:
            self._name = name
            self._table = read_columns(self._folder.root / name, self._layout.columns)
        return None if self._table is None else self.read_table(row, self._table)

    def read_table(self, row: dict[str, Any], table: pa.Table) -> Episode | None:
        """The episode of a row; None when a table of its columns does not hold it whole."""
        frames = rows_of(row, table) if are_whole_numbers(table, ["episode_index", "index"]) else None
        return None if frames is None else self._episode(row, frames)

    def _episode(self, row: dict[str, Any], frames: pa.Table) -> Episode | None:
        index, where = row["episode_index"], self._folder.root / self._name
        if len(frames) > _MAX_FRAMES:
            raise DatasetError(
                f"episode {index} in {where} has {len(frames)} frames, and at most {_MAX_FRAMES:,} are plausible; "
                "choose another dataset."
            )
        try:
            images = self._images(row, frames)
            if images is None:
                return None
        except (*_WRONG_TYPES, cv2.error) as error:
            raise DatasetError(f"a picture of episode {index} in {where} cannot be read: {error}.") from error
        try:
            frames, known = with_outcomes(frames, TRAINING_COLUMNS)
            if not known[-1]:  # it teaches nothing, and would count as a failure
                images, frames = images[:-1], frames.slice(0, len(frames) - 1)
            return self._checked(index, images, frames)
        except _WRONG_TYPES as error:
            raise DatasetError(f"episode {index} in {where} cannot be learned from: {error}.") from error

    def _images(self, row: dict[str, Any], frames: pa.Table) -> NDArray[np.uint8] | None:
        if self._layout.in_video:
            return read_video(self._folder.root, row, len(frames), self._layout.fps)
        return _decode(frames[IMAGE_KEY])

    def _checked(self, index: int, images: NDArray[np.uint8], frames: pa.Table) -> Episode:
        return Episode(
            index=index,
            images=images,
            states=_numbers(frames[STATE_KEY], np.float32).reshape(-1, len(STATE_NAMES)),
            actions=_numbers(frames["action"], np.float32).reshape(-1, len(ACTION_NAMES)),
            rewards=_numbers(frames["next.reward"], np.float32),
            dones=_numbers(frames["next.done"], np.bool_),
            truncated=_numbers(frames["next.truncated"], np.bool_),
            phases=_numbers(frames["complementary_info.phase"], np.int64),
            grasp_probabilities=_numbers(frames["complementary_info.grasp_probability"], np.float32),
            robot_times=_numbers(frames["complementary_info.robot_time"], np.float32),
            weights_step=int(_numbers(frames[WEIGHTS_STEP], np.int64)[-1])
            if WEIGHTS_STEP in frames.column_names
            else -1,
        )


def _weights_step(frames: pa.Table) -> int:
    if WEIGHTS_STEP not in frames.column_names or not len(frames):
        return -1
    return int(_numbers(frames[WEIGHTS_STEP], np.int64)[-1])


def _numbers(column: pa.ChunkedArray, dtype: DTypeLike) -> NDArray[Any]:
    """A copy, so that it does not keep its whole file in memory; lists are joined."""
    values = column.combine_chunks()
    while pa.types.is_fixed_size_list(values.type) or pa.types.is_list(values.type):
        values = values.flatten()
    numbers = values.to_numpy(zero_copy_only=False).astype(dtype)
    if len(numbers) % max(len(column), 1) or not np.isfinite(numbers).all():
        raise ValueError("it has numbers that are missing or not finite")
    return numbers


def _decode(column: pa.ChunkedArray) -> NDArray[np.uint8]:
    files = column.combine_chunks().field("bytes").to_pylist()
    images = np.empty((len(files), IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
    for image, file in zip(images, files, strict=True):
        image[:] = decode_picture(file)
    return images
