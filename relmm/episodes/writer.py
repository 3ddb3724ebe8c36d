"""A LeRobot dataset of which every saved episode survives `kill -9`, a full disk and a power cut."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pyarrow as pa

from relmm.episodes.compact import pack
from relmm.episodes.folder import DATA_FILES, EPISODE_FILES, INFO, STATS, TASKS, DatasetFolder
from relmm.episodes.repair import RepairReport, repair
from relmm.episodes.settings import add_run, check_new, check_resume, features_to_store
from relmm.errors import DatasetError
from relmm.features import FPS

# Tasks before the data that refers to them, and the counters of info.json when everything else is there.
PUBLISHING_ORDER = (TASKS, DATA_FILES, EPISODE_FILES, STATS, INFO)


class DurableDataset:
    """Records episodes through LeRobot's writer into a staging folder, and publishes each by renaming its files.

    At any instant the dataset holds whole episodes only, so LeRobot can load it and stream it, also after a kill.
    The time to save an episode does not depend on how many there are.

    Attributes:
        root: the folder of the dataset.
        episodes: how many are saved.
        pending_frames: how many frames the unfinished episode has.
        repaired: what opening had to repair; None for a new dataset.
    """

    def __init__(self, folder: DatasetFolder, lerobot_dataset: Any, repaired: RepairReport | None) -> None:
        """Use `create` or `open`."""
        self.root = folder.root
        self.repaired = repaired
        self.episodes: int = lerobot_dataset.meta.total_episodes
        self.pending_frames = 0
        self._folder = folder
        self._dataset = lerobot_dataset
        self._failure: DatasetError | None = None
        self._closed = False

    @classmethod
    def create(
        cls, repo_id: str, root: Path | str, depth: bool, robot_type: str, info: dict[str, Any] | None = None
    ) -> Self:
        """Begin a dataset in a folder that does not exist yet.

        Args:
            repo_id: its name, `user/name`.
            root: its folder.
            depth: also store the depth picture.
            robot_type: stored by LeRobot.
            info: what the run is recorded with (room, camera, seed, policy ...), kept in `meta/relmm.json`.

        Raises:
            ConfigError: the Hub would refuse the name, or an unknown camera.
            DatasetError: the folder exists, or cannot be written.
        """
        check_new(Path(root), repo_id)
        info = info or {}
        features = features_to_store(depth, info.get("camera"))
        folder = DatasetFolder(root)
        try:
            folder.root.mkdir(parents=True)
            folder.lock()
        except OSError as error:
            raise DatasetError(_cannot_write(folder.root, error, 0)) from error
        try:
            add_run(folder, features, robot_type, 0, info)
            dataset = _create_staged(folder, repo_id, features, robot_type)
        except OSError as error:
            folder.unlock()
            raise DatasetError(_cannot_write(folder.root, error, 0)) from error
        return cls(folder, dataset, repaired=None)

    @classmethod
    def open(
        cls,
        root: Path | str,
        repo_id: str,
        *,
        depth: bool | None = None,
        robot_type: str | None = None,
        info: dict[str, Any] | None = None,
    ) -> Self:
        """Repair a dataset where needed, and continue it.

        Args:
            root: its folder.
            repo_id: its name, `user/name`.
            depth: whether it must have the depth picture; None takes it as it is.
            robot_type: the robot it must be of; None takes it as it is.
            info: what this run is recorded with; its `camera` must be that of the dataset.

        Raises:
            ConfigError: the Hub would refuse the name.
            DatasetError: no relmm dataset, other settings, another writer, or beyond repair.
        """
        check_resume(Path(root), repo_id, depth, robot_type, info)
        folder = DatasetFolder(root)
        try:
            folder.lock()
        except OSError as error:
            raise DatasetError(_cannot_write(folder.root, error, None)) from error
        try:
            report = repair(folder)
            pack(folder)
            dataset = _resume_staged(folder, repo_id)
            if info is not None:
                meta = dataset.meta
                add_run(folder, meta.features, meta.robot_type, meta.total_episodes, info)
        except OSError as error:
            folder.unlock()
            raise DatasetError(_cannot_write(folder.root, error, None)) from error
        except DatasetError:
            folder.unlock()
            raise
        return cls(folder, dataset, report)

    def add_frame(self, frame: dict[str, Any], task: str) -> None:
        """Add a frame to the unfinished episode, in memory.

        Args:
            frame: an array of the right type and shape for each of `relmm.features.dataset_features`.
            task: what the robot was doing, in words.

        Raises:
            DatasetError: the frame does not fit the dataset, or an earlier write has failed.
        """
        self._check_usable()
        try:
            self._dataset.add_frame({**frame, "task": task})
        except ValueError as error:
            problem = " ".join(str(error).split())
            raise DatasetError(f"the frame does not fit the dataset: {problem}") from error
        except OSError as error:
            raise self._fail(error) from error
        self.pending_frames += 1

    def save_episode(self) -> None:
        """Make the unfinished episode durable: when this returns, nothing can take it away.

        Raises:
            DatasetError: there are no frames, or the disk refuses; the earlier episodes stay whole.
        """
        self._check_usable()
        if not self.pending_frames:
            raise DatasetError("an episode without frames cannot be saved; add a frame first.")
        try:
            self._dataset.save_episode()
            self._publish()
        except (OSError, pa.ArrowException) as error:
            raise self._fail(error) from error
        self.episodes += 1
        self.pending_frames = 0

    def close(self) -> None:
        """Finish: an unfinished episode is dropped, and other writers may open the dataset."""
        if self._closed:
            return
        self._closed = True
        if self._failure is None:
            pack(self._folder)
        self._folder.clear_scratch()
        self._folder.unlock()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _publish(self) -> None:
        staging = self._folder.staging
        staged = [path for pattern in PUBLISHING_ORDER for path in staging.glob(pattern)]
        self._folder.publish(staging, [path.relative_to(staging).as_posix() for path in staged])

    def _check_usable(self) -> None:
        if self._failure is not None:
            raise self._failure
        if self._closed:
            raise DatasetError(f"the dataset at {self.root} is closed; open it again to continue.")

    def _fail(self, error: Exception) -> DatasetError:
        """Give up writing: what LeRobot holds in memory no longer matches the disk."""
        # Or LeRobot's destructors would write the cut episode once more.
        self._dataset.meta._metadata_buffer.clear()
        self._failure = DatasetError(_cannot_write(self.root, error, self.episodes))
        return self._failure


def _cannot_write(root: Path, error: Exception, episodes: int | None) -> str:
    reason = (getattr(error, "strerror", None) or str(error)).split("\n")[0]
    saved = "" if episodes is None else f"{episodes} episodes are saved and whole; "
    return f"{root} cannot be written ({reason}); {saved}make room or check the permissions, then resume."


def _create_staged(folder: DatasetFolder, repo_id: str, features: dict[str, Any], robot_type: str) -> Any:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset.create(
        repo_id,
        fps=FPS,
        features=features,
        root=folder.staging,
        robot_type=robot_type,
        use_videos=False,
        video_backend="pyav",  # spares LeRobot the search for a decoder
        metadata_buffer_size=1,
    )
    folder.publish(folder.staging, [INFO])
    return _with_episode_writer(dataset)


def _resume_staged(folder: DatasetFolder, repo_id: str) -> Any:
    """Let LeRobot resume a small copy that has the last episode only: thousands of files would take it minutes."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    last = folder.files(EPISODE_FILES)[-1:]
    if not last:  # lerobot 0.6.0 would look for the missing files on the Hub
        info = folder.read_json(INFO)
        assert info is not None  # repaired
        return _create_staged(folder, repo_id, info["features"], info["robot_type"])
    for name in [INFO, *(name for name in (STATS, TASKS, *last) if (folder.root / name).is_file())]:
        (folder.staging / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(folder.root / name, folder.staging / name)
    dataset = LeRobotDataset.resume(repo_id, root=folder.staging, video_backend="pyav")
    dataset.meta._metadata_buffer_size = 1
    if dataset.meta.episodes is not None:
        dataset.meta.episodes = [dataset.meta.episodes[-1]]
    shutil.rmtree(folder.staging)
    folder.staging.mkdir()
    return _with_episode_writer(dataset)


def _with_episode_writer(dataset: Any) -> Any:
    from relmm.episodes.lerobot_writer import EpisodeWriter

    dataset.writer = EpisodeWriter(dataset)
    return dataset
