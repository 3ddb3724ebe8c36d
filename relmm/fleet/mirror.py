"""The server's copy of one robot's dataset: whole episodes in order, each checked before it becomes part of it."""

from __future__ import annotations

import hashlib
import shutil
import threading
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from relmm.episodes.compact import pack as pack_files
from relmm.episodes.folder import INFO, RELMM, TASKS, DatasetFolder
from relmm.episodes.follow import EpisodeFollower
from relmm.episodes.info import DATA_PATH, are_features, runs_of
from relmm.episodes.parquet import read_table
from relmm.episodes.repair import verify_and_repair
from relmm.episodes.settings import feature_differences
from relmm.episodes.survey import PLACE_COLUMNS, are_places
from relmm.errors import DatasetError, FleetError
from relmm.features import DEPTH_KEY, FPS, dataset_features
from relmm.fleet.wire import MAX_EPISODE_BYTES, LinkError, RestartError, number, unpack
from relmm.geometry import other_camera

_FILES_IN_CHUNK = 1000  # LeRobot's
_SPARE_BYTES = 1 << 30  # kept free on the disk
_LIST_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_LIST_COLUMNS = ("meta/episodes/chunk_index", "meta/episodes/file_index", *PLACE_COLUMNS)


def check_schema(name: str, dataset: Any, camera: str | None) -> None:
    """Refuse a robot whose dataset has other columns than ours, or is seen through another camera.

    Args:
        name: of the dataset.
        dataset: content of its `meta/relmm.json`.
        camera: the policy's, None for any.

    Raises:
        FleetError: with the differences.
    """
    if not isinstance(dataset, dict) or not are_features(dataset.get("features")):
        raise FleetError(f"the dataset {name} does not say which columns it has; record it with relmm-record.")
    features = dataset["features"]
    differences = feature_differences(features, dataset_features(DEPTH_KEY in features))
    if dataset.get("fps") != FPS:
        differences.append(f"fps: have {str(dataset.get('fps'))[:20]}, want {FPS}")
    if not isinstance(dataset.get("robot_type"), str):
        differences.append("robot type: have none")
    if (cameras := other_camera(features, camera)) is not None:
        differences.append(f"camera: have {cameras[0]}, want {cameras[1]}")
    if differences:
        raise FleetError(
            f"the dataset {name} does not fit this fleet: {'; '.join(differences)}; record with the relmm of the "
            "server, and with the camera of its policy."
        )


class Mirror:
    """One robot's dataset on the server; only one thread at a time may use it, the one that holds `lock`.

    Args:
        root: its folder, which may not exist yet.
        name: the robot's name for it, `user/name`.
        camera: the camera that it must be of, None for any.

    Attributes:
        episodes: how many are whole and durable here.
        lock: to be held by whoever uses it.
    """

    def __init__(self, root: Path, name: str, camera: str | None) -> None:
        self._folder, self._name, self._camera = DatasetFolder(root), name, camera
        self.lock = threading.Lock()
        self.episodes = self._frames = 0
        self._tasks: list[str] = []
        self._schema: pa.Schema | None = None
        self._reader: EpisodeFollower | None = None  # reads the staged episode
        self._partial: _Partial | None = None

    def open(self, dataset: dict[str, Any]) -> None:
        """Begin it, or go on with it.

        Args:
            dataset: content of the robot's `meta/relmm.json`, after `check_schema`.

        Raises:
            FleetError: there is another recording of this name.
        """
        root, own, theirs = self._folder.root, runs_of(self._folder.read_json(RELMM)), runs_of(dataset)
        if not theirs or (own and theirs[: len(own)] != own):
            raise FleetError(
                f"the name {self._name} belongs to another recording on this server; choose another --dataset.repo_id."
            )
        if own != theirs:
            keys = ("robot_type", "fps", "features")
            self._folder.scratch.mkdir(parents=True, exist_ok=True)
            self._folder.write_json(RELMM, {**{key: dataset[key] for key in keys}, "runs": theirs})
        self._drop_partial()
        if self._schema is None:
            verify_and_repair(root)
            self._read_state()
        pack_files(self._folder)

    def put(self, header: dict[str, Any], chunk: bytes) -> int:
        """Take a part of the next episode; with its last part it is checked and becomes durable.

        Args:
            header: `episode`, `offset`, `size` and `sha256` of the whole.
            chunk: of its content, from the offset on.

        Returns:
            How many bytes of it are here.

        Raises:
            FleetError: it is not the next one, too large, damaged, or not what this dataset holds.
        """
        size, offset = number(header, "size", 1 << 62), number(header, "offset", 1 << 62)
        if (episode := number(header, "episode", 10**9)) != self.episodes:
            raise RestartError(
                f"episode {episode} of {self._name} is not the next one, which is {self.episodes}: what is here is "
                "never replaced."
            )
        if size > MAX_EPISODE_BYTES:
            raise FleetError(
                f"episode {episode} of {self._name} claims {size / 1e6:,.0f} MB, and at most "
                f"{MAX_EPISODE_BYTES / 1e6:.0f} MB are plausible; record shorter ones with --max_steps."
            )
        if offset == 0:
            self._begin(size, str(header.get("sha256")))
        if self._partial is None or not self._partial.fits(offset, size, header.get("sha256"), len(chunk)):
            self._drop_partial()
            raise RestartError(
                f"a part of episode {episode} of {self._name} does not follow on; send it from its start."
            )
        self._partial.add(chunk)
        if self._partial.have == size:
            self._finish()
        return offset + len(chunk)

    def _begin(self, size: int, digest: str) -> None:
        self._drop_partial()
        free = shutil.disk_usage(self._folder.root).free
        if size + _SPARE_BYTES > free:
            raise LinkError(f"the server's disk is full ({free / 1e6:.0f} MB are free): make room there.")
        self._folder.scratch.mkdir(exist_ok=True)
        self._partial = _Partial(self._folder.scratch / "incoming", size, digest)

    def _drop_partial(self) -> None:
        if self._partial is not None:
            self._partial.remove()
        self._partial = None

    def _finish(self) -> None:
        assert self._partial is not None
        content = self._partial.content()
        self._drop_partial()
        what = f"episode {self.episodes} of {self._name}"
        if content is None:
            raise RestartError(f"{what} has been damaged on its way; send it again.")
        try:
            self._stage(content)
        except (DatasetError, OSError, LookupError, TypeError, ValueError, pa.ArrowException) as error:
            shutil.rmtree(self._folder.staging, ignore_errors=True)
            self._reader = None
            words = " ".join(str(error).replace(str(self._folder.staging), self._name).split())
            raise FleetError(f"{what} is not what relmm records ({words}).") from error

    def _stage(self, content: bytes) -> None:
        """Write the episode as a dataset of its own, read it as a learner would, and publish its files."""
        staging = self._folder.staging
        place = dict(zip(("chunk_index", "file_index"), divmod(self.episodes, _FILES_IN_CHUNK), strict=True))
        data, listed = DATA_PATH.format(**place), _LIST_PATH.format(**place)
        header, body = unpack(content)
        length = number(header, "data", len(body))
        for name, part in ((data, body[:length]), (listed, body[length:])):
            (staging / name).parent.mkdir(parents=True, exist_ok=True)
            (staging / name).write_bytes(part)
        row, frames = self._write_again(staging / data, staging / listed, place)
        if self._reader is None:
            shutil.copyfile(self._folder.root / INFO, staging / INFO)
            self._reader = EpisodeFollower(staging, camera=self._camera)
        if self._reader.read_frames(row, frames) is None:
            raise DatasetError("its frames are not those that its row of the list tells of")
        self._publish(staging, [data, listed], row["length"], self._tasks_with(row["tasks"], frames))

    def _write_again(self, data: Path, listed: Path, place: dict[str, int]) -> tuple[dict[str, Any], pa.Table]:
        """Both files with the columns that they must have, and no others; the row of the list, and the frames."""
        rows, frames = read_table(listed), read_table(data)
        known = [name for name in rows.column_names if name in _LIST_COLUMNS or name.startswith("stats/")]
        if len(rows) != 1 or not are_places(rows) or not set(_LIST_COLUMNS) <= set(known):
            raise DatasetError("its row of the list of episodes is none")
        sent, rows = rows, rows.select(known)
        for kind in ("data", "meta/episodes"):
            for name, value in place.items():
                at = rows.column_names.index(f"{kind}/{name}")
                rows = rows.set_column(at, f"{kind}/{name}", pa.array([value], pa.int64()))
        row: dict[str, Any] = rows.select(PLACE_COLUMNS).to_pylist()[0]
        if (row["episode_index"], row["dataset_from_index"]) != (self.episodes, self._frames):
            raise DatasetError("its row of the list of episodes does not follow on")
        assert self._schema is not None
        if set(frames.column_names) != set(self._schema.names) or len(frames) != row["length"]:
            raise DatasetError("its frames have other columns, or another number, than it says")
        if not rows.equals(sent):  # as of a robot that has packed its files
            pq.write_table(rows, listed)
        if not frames.schema.equals(self._schema) or frames.schema.metadata != self._schema.metadata:
            frames = frames.select(self._schema.names).cast(self._schema)
            pq.write_table(frames, data, compression="snappy", use_dictionary=True)
        return row, frames

    def _tasks_with(self, names: list[str], frames: pa.Table) -> list[str]:
        """The tasks of the dataset, with those of one more episode."""
        tasks = list(self._tasks)
        for index, name in zip(dict.fromkeys(frames["task_index"].to_pylist()), names, strict=True):
            if index == len(tasks):
                tasks.append(name)
            if not 0 <= index < len(tasks) or tasks[index] != name:
                raise DatasetError(f"its task {index} is not the one that this dataset has")
        return tasks

    def _publish(self, staging: Path, names: list[str], frames: int, tasks: list[str]) -> None:
        info = self._folder.read_json(INFO)
        assert info is not None
        self._folder.publish(staging, names)
        self.episodes, self._frames = self.episodes + 1, self._frames + frames
        if tasks != self._tasks:
            self._tasks = tasks
            self._write_tasks()
        counters = {
            "total_episodes": self.episodes,
            "total_frames": self._frames,
            "total_tasks": len(tasks),
            "splits": {"train": f"0:{self.episodes}"},
        }
        self._folder.write_json(INFO, info | counters)

    def _write_tasks(self) -> None:
        import pandas as pd

        temporary = self._folder.scratch / TASKS
        temporary.parent.mkdir(parents=True, exist_ok=True)
        index = pd.Index(self._tasks, name="task")
        pd.DataFrame({"task_index": range(len(self._tasks))}, index=index).to_parquet(temporary)
        self._folder.publish(self._folder.scratch, [TASKS])

    def _read_state(self) -> None:
        from lerobot.datasets.feature_utils import get_hf_features_from_features

        info = self._folder.read_json(INFO)
        assert info is not None  # repaired
        self.episodes, self._frames = info["total_episodes"], info["total_frames"]
        features = {name: {**feature, "shape": tuple(feature["shape"])} for name, feature in info["features"].items()}
        self._schema = get_hf_features_from_features(features).arrow_schema
        if (self._folder.root / TASKS).is_file():
            tasks = read_table(self._folder.root / TASKS).to_pandas()
            self._tasks = list(tasks.sort_values("task_index").index)


class _Partial:
    """An episode that is coming in, in a file.

    Args:
        path: of the file.
        size: of the whole episode, bytes.
        digest: its SHA-256, as hexadecimal digits.
    """

    def __init__(self, path: Path, size: int, digest: str) -> None:
        self._path, self._size, self._digest = path, size, digest
        self.have = 0
        path.write_bytes(b"")

    def fits(self, offset: int, size: int, digest: Any, length: int) -> bool:
        """Whether a part follows on what is here."""
        return (offset, size, digest) == (self.have, self._size, self._digest) and 0 < length <= size - offset

    def add(self, chunk: bytes) -> None:
        """Take the next part."""
        with self._path.open("ab") as file:
            file.write(chunk)
        self.have += len(chunk)

    def content(self) -> bytes | None:
        """All of it; None where its sum is another."""
        content = self._path.read_bytes()
        return content if hashlib.sha256(content).hexdigest() == self._digest else None

    def remove(self) -> None:
        """Forget it."""
        self._path.unlink(missing_ok=True)
