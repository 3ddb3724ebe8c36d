"""Recording behind the loop: frames go to a writer process, and the loop waits only when that falls behind."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import multiprocessing
import queue
import select
import signal
import threading
import time
from collections.abc import Mapping
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.util import Finalize
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from numpy.typing import NDArray

from relmm.episodes.frames import FrameBuilder
from relmm.episodes.process import IGNORED_SIGNALS, Reply, WriterSettings, write_episodes
from relmm.episodes.settings import check_new, check_resume
from relmm.errors import DatasetError, RelmmError

logger = logging.getLogger(__name__)

PATIENCE_S = 2.0  # after which a user is told what is waited for
POLL_S = 0.2  # how often a waiting caller looks whether the writer is still alive
# Frames handed over at once: waking two threads and a process for each would cost the loop more than the frame itself.
BATCH_FRAMES = 16
_PIPE_BYTES = 1 << 20  # a batch and more, so that the writer is not woken in the middle of it; Linux allows this much


class EpisodeRecorder:
    """Records episodes in another process; no frame is ever dropped.

    Use it as a context manager: complete episodes are finished however the block ends. If the recording process is
    killed, the writer finishes what it has received. Scripts need `if __name__ == "__main__":`, since the writer is a
    spawned process.

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
        """Start the writer and wait until the dataset is open.

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
        root = Path(root)
        if resume:
            check_resume(root, repo_id, depth, robot_type, info)
        else:
            check_new(root, repo_id)
        self.save_unfinished = save_unfinished
        self._root = root
        self._build_frame = FrameBuilder(depth).build
        self._frames = 0  # of the unfinished episode
        self._batch: list[tuple[dict[str, NDArray[Any]], str]] = []  # those not handed over yet
        self._batch_frames = min(BATCH_FRAMES, buffered_frames)
        self._closed = False
        self._error: RelmmError | None = None
        self._error_was_raised = False
        self._saved = 0
        settings = WriterSettings(root, repo_id, resume, depth, robot_type, info)
        self._start(settings, buffered_frames // self._batch_frames)
        try:
            opened = self._wait_for_reply()
        except RelmmError:
            self.close()
            raise
        self.repaired = opened.repaired
        self._saved = self._asked = opened.saved_episodes

    @property
    def saved_episodes(self) -> int:
        """Episodes of the dataset that are durable, with those from before a resume."""
        self._read_replies()
        return self._saved

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
        self._batch.append((self._build_frame(observation, action, outcome), task))
        self._frames += 1
        if len(self._batch) > self._batch_frames:  # the last frame stays here, for `cut_episode`
            self._hand_over(self._batch_frames)

    def save_episode(self) -> None:
        """Ask for the episode to be saved; `flush` waits until it is.

        Raises:
            DatasetError: there are no frames, or the writer has failed.
        """
        self._check()
        if not self._frames:
            raise DatasetError("an episode without frames cannot be saved; add a frame first.")
        self._hand_over(len(self._batch))
        self._put(("save",))
        self._asked += 1
        self._frames = 0

    def cut_episode(self) -> None:
        """Save the frames since the last saved episode, if there are any, as an episode that was cut off.

        Raises:
            DatasetError: the writer has failed.
        """
        if self._frames:
            frame, _ = self._batch[-1]
            if not frame["next.done"]:
                frame["next.truncated"][:] = True
            self.save_episode()

    def discard_episode(self) -> None:
        """Forget the frames since the last saved episode."""
        self._put(("discard",))
        self._batch = []
        self._frames = 0

    def flush(self) -> None:
        """Wait until every episode that was asked for is durable.

        Raises:
            DatasetError: the writer has failed.
        """
        self._check()
        while self._saved < self._asked:
            self._accept(self._wait_for_reply())
            self._check()

    def close(self) -> None:
        """Wait until everything is saved and the writer has ended.

        Raises:
            DatasetError: the writer has failed, if that was not raised before.
        """
        if self._closed:
            return
        if self.save_unfinished and self._error is None:
            self.cut_episode()
        self._closed = True
        self._finish()
        said, started = False, time.monotonic()
        while self._error is None and not self._process_has_ended():
            self._read_replies(POLL_S)
            if not said and time.monotonic() - started > PATIENCE_S:
                said = True
                logger.info("saving the last episodes of %s", self._root)
        self._process.join()
        if self._error is not None and not self._error_was_raised:
            self._raise_error()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _start(self, settings: WriterSettings, buffered_batches: int) -> None:
        spawn = multiprocessing.get_context("spawn")
        commands_out, commands_in = spawn.Pipe(duplex=False)
        _widen(commands_in)
        self._replies, replies_in = spawn.Pipe(duplex=False)
        self._process = spawn.Process(
            target=write_episodes, args=(commands_out, replies_in, settings), name="relmm-writer", daemon=False
        )
        resource_tracker.ensure_running()  # or it is started by the process below, and undoes the mask
        # Masked signals stay masked in a new process: it may not die of a Ctrl-C before it can ignore them.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, IGNORED_SIGNALS)
        self._process.start()
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        commands_out.close()
        replies_in.close()
        self._poll = select.poll()  # kept, because Connection.poll builds a selector each time, which costs 20 us
        self._poll.register(self._replies.fileno(), select.POLLIN)
        self._queue: queue.Queue[tuple[Any, ...] | None] = queue.Queue(maxsize=buffered_batches)
        feeder = threading.Thread(target=_feed, args=(self._queue, commands_in), name="relmm-feeder", daemon=True)
        feeder.start()
        # Also when the interpreter ends without `close`: multiprocessing then waits for the writer, which waits for us.
        self._finish = Finalize(self, _end_feeding, args=(self._queue, feeder), exitpriority=10)

    def _hand_over(self, count: int) -> None:
        if self._batch:
            batch, self._batch = self._batch[:count], self._batch[count:]
            self._put(("frames", batch))

    def _put(self, message: tuple[Any, ...]) -> None:
        self._check()
        while True:
            try:
                self._queue.put(message, timeout=POLL_S)
                return
            except queue.Full:
                self._check()

    def _check(self) -> None:
        if self._closed:
            raise DatasetError(f"the recording of {self._root} is closed; open it again to continue.")
        self._read_replies()
        if self._error is not None:
            self._raise_error()

    def _raise_error(self) -> None:
        assert self._error is not None
        self._error_was_raised = True
        raise self._error

    def _read_replies(self, timeout: float = 0.0) -> None:
        try:
            while self._error is None and self._poll.poll(timeout * 1000):
                self._accept(self._replies.recv())
                timeout = 0.0
        except EOFError:
            self._note_end()

    def _accept(self, reply: Reply) -> None:
        self._saved = reply.saved_episodes
        self._error = reply.error

    def _wait_for_reply(self) -> Reply:
        """The next reply; raises what the writer has failed with."""
        try:
            reply: Reply = self._replies.recv()
        except EOFError:
            self._note_end()
            reply = Reply(self._saved, error=self._error)
        if reply.error is not None:
            self._error = reply.error
            self._raise_error()
        return reply

    def _process_has_ended(self) -> bool:
        return self._process.exitcode is not None

    def _note_end(self) -> None:
        """The writer has closed its end: as it should after `close`, or because it was killed."""
        self._process.join()
        if self._process.exitcode != 0 or not self._closed:
            self._error = DatasetError(
                f"the process that writes {self._root} has ended (exit code {self._process.exitcode}); the "
                f"{self._saved} episodes saved so far are whole: resume to continue."
            )


def _widen(pipe: Connection) -> None:
    if hasattr(fcntl, "F_SETPIPE_SZ"):
        with contextlib.suppress(OSError):  # a system may allow less: then it stays as it is
            fcntl.fcntl(pipe.fileno(), fcntl.F_SETPIPE_SZ, _PIPE_BYTES)


def _feed(messages: queue.Queue[tuple[Any, ...] | None], commands: Connection) -> None:
    """Send what is in the queue; once the writer is gone, empty it, so that nobody waits for room."""
    alive = True
    while (message := messages.get()) is not None:
        if alive:
            try:
                commands.send(message)
            except (BrokenPipeError, ConnectionResetError):
                alive = False  # why it is gone is in its last reply
    commands.close()


def _end_feeding(messages: queue.Queue[tuple[Any, ...] | None], feeder: threading.Thread) -> None:
    messages.put(None)
    feeder.join()
