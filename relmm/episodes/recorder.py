"""Recording behind the loop: a thread writes, and the loop waits only when that falls behind."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from numpy.typing import NDArray

from relmm.episodes.frames import FrameBuilder
from relmm.episodes.writer import DurableDataset
from relmm.errors import DatasetError, RelmmError

logger = logging.getLogger(__name__)

PATIENCE_S = 2.0  # after which a user is told what is waited for


class EpisodeRecorder:
    """Records episodes in another thread; no frame is ever dropped.

    Use it as a context manager: complete episodes are finished however the block ends, and also when the interpreter
    ends.

    Attributes:
        save_unfinished: whether `close` also saves the frames since the last saved episode, as one that was cut off.
        repaired: what had to be repaired on resuming, in words; empty when nothing.
    """

    def __init__(
        self,
        root: Path | str,
        repo_id: str,
        *,
        resume: bool,
        depth: bool,
        robot_type: str,
        info: dict[str, Any],
        save_unfinished: bool = False,
        buffered_frames: int = 512,
    ) -> None:
        """Open the dataset.

        Args:
            root: the folder of the dataset.
            repo_id: its name, `user/name`.
            resume: continue a dataset, instead of beginning one in a folder that does not exist.
            depth: also store the depth picture.
            robot_type: stored by LeRobot; must be that of a resumed dataset.
            info: what the run is recorded with (room, camera, seed, policy ...), plain JSON values.
            save_unfinished: whether `close` also saves the frames since the last saved episode.
            buffered_frames: how many frames the loop may be ahead of the writer (30 kB each, 50 kB with depth).

        Raises:
            ConfigError: the Hub would refuse the name.
            DatasetError: the dataset cannot be begun or continued so.
        """
        if resume:
            self._dataset = DurableDataset.open(root, repo_id, depth=depth, robot_type=robot_type, info=info)
        else:
            self._dataset = DurableDataset.create(repo_id, root, depth, robot_type, info)
        self.save_unfinished = save_unfinished
        repaired = self._dataset.repaired
        self.repaired = str(repaired) if repaired and repaired.problems else ""
        self._build_frame = FrameBuilder(depth).build
        self._frames = 0  # of the unfinished episode
        self._last: tuple[dict[str, NDArray[Any]], str] | None = None  # its last frame, which `cut_episode` may mark
        self._closed = False
        self._error: RelmmError | None = None
        self._error_was_raised = False
        self._room = threading.Semaphore(buffered_frames)
        # When the interpreter ends without `close`, the pool still finishes what it was given.
        self._writer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="relmm-writer")

    @property
    def saved_episodes(self) -> int:
        """Episodes of the dataset that are durable, with those from before a resume."""
        return self._dataset.episodes

    def add_frame(
        self, observation: Mapping[str, Any], action: Mapping[str, float], outcome: Mapping[str, Any], task: str
    ) -> None:
        """Record a frame; waits when the writer is `buffered_frames` behind.

        Args:
            observation: the robot's: state by name, `front` (100, 100, 3) uint8, `front_depth` (100, 100, 1) uint16 mm.
            action: what was done, by name.
            outcome: a number or truth value for each of `relmm.features.outcome_features`.
            task: what the robot was doing, in words.

        Raises:
            DatasetError: the frame does not fit the dataset, or the writer has failed.
        """
        self._check()
        frame = self._build_frame(observation, action, outcome), task
        self._hand_over_last()
        self._last = frame
        self._frames += 1

    def save_episode(self) -> None:
        """Ask for the episode to be saved; `flush` waits until it is.

        Raises:
            DatasetError: there are no frames, or the writer has failed.
        """
        self._check()
        if not self._frames:
            raise DatasetError("an episode without frames cannot be saved; add a frame first.")
        self._hand_over_last()
        self._submit(self._dataset.save_episode)
        self._frames = 0

    def cut_episode(self) -> None:
        """Save the frames since the last saved episode, if there are any, as an episode that was cut off.

        Raises:
            DatasetError: the writer has failed.
        """
        if self._last is not None:
            frame, _ = self._last
            if not frame["next.done"]:
                frame["next.truncated"][:] = True
            self.save_episode()

    def flush(self) -> None:
        """Wait until every episode that was asked for is durable.

        Raises:
            DatasetError: the writer has failed.
        """
        self._check()
        self._writer.submit(lambda: None).result()
        self._check()

    def close(self) -> None:
        """Wait until everything is saved.

        Raises:
            DatasetError: the writer has failed, if that was not raised before.
        """
        if self._closed:
            return
        if self.save_unfinished and self._error is None:
            self.cut_episode()
        self._closed = True
        done = self._writer.submit(self._carry_out, self._dataset.close, even_after_error=True)
        try:
            done.result(PATIENCE_S)
        except TimeoutError:
            logger.info("saving the last episodes of %s", self._dataset.root)
        self._writer.shutdown()
        if self._error is not None and not self._error_was_raised:
            self._raise_error()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _hand_over_last(self) -> None:
        if self._last is not None:
            self._submit(self._dataset.add_frame, *self._last)
            self._last = None

    def _submit(self, job: Callable[..., None], *arguments: Any) -> None:
        self._room.acquire()
        self._writer.submit(self._carry_out, job, *arguments).add_done_callback(lambda _: self._room.release())

    def _carry_out(self, job: Callable[..., None], *arguments: Any, even_after_error: bool = False) -> None:
        """In the thread: after an error, what was handed over no longer fits together."""
        if self._error is not None and not even_after_error:
            return
        try:
            job(*arguments)
        except RelmmError as error:
            self._error = error
        except Exception as error:
            self._error = DatasetError(f"the writer of {self._dataset.root} has failed: {error!r}.")
            self._error.__cause__ = error

    def _check(self) -> None:
        if self._closed:
            raise DatasetError(f"the recording of {self._dataset.root} is closed; open it again to continue.")
        if self._error is not None:
            self._raise_error()

    def _raise_error(self) -> None:
        assert self._error is not None
        self._error_was_raised = True
        raise self._error
