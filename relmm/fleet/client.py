"""The robot's side: a thread beside the recorder that sends what is saved, and fetches newer weights.

An interrupted link means that episodes wait on the robot's disk; the robot goes on with its last weights.
"""

from __future__ import annotations

import hashlib
import random
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Self

import grpc

from relmm.episodes.folder import INFO, RELMM, DatasetFolder
from relmm.errors import DatasetError, FleetError
from relmm.fleet.sealed import SealedEpisode, SealedReader
from relmm.fleet.weights import unpack_policy
from relmm.fleet.wire import CHUNK_BYTES, MAX_WEIGHTS_BYTES, LinkError, RestartError, call, number, text

_CALL_S = 20.0  # after which a call that nobody answers is given up
_LOOK_S = 1.0  # between looks at the dataset
_HEARTBEAT_S = 10.0
_LONGEST_PAUSE_S = 30.0  # between attempts, after failures
_CLOSING_S = 30.0  # how long sending the last episodes may take


class Link:
    """Keeps one dataset in step with its mirror on the server, and one folder with the newest weights.

    Args:
        channel: of `relmm.fleet.wire.open_channel`.
        root: the dataset, which may be being recorded; it must exist.
        name: of it, `user/name`.
        policy: folder for the weights, see `relmm.fleet.weights.unpack_policy`; None not to fetch any.

    Attributes:
        waiting: episodes that are saved and not sent.
        problem: why nothing travels just now, as a sentence; empty when all is well.
    """

    def __init__(self, channel: grpc.Channel, root: Path, name: str, policy: Path | None) -> None:
        self._channel, self._folder, self._name, self._policy = channel, DatasetFolder(root), name, policy
        self._session = ""
        self._sent = 0  # episodes that the server has
        self._digest = ""  # SHA-256 of the weights that we have
        self._beat_at = -_HEARTBEAT_S
        self.waiting, self.problem = 0, ""
        self._stop, self._wake = False, threading.Event()
        self._thread = threading.Thread(target=self._run, name="relmm-fleet", daemon=True)

    def __enter__(self) -> Self:
        """Start the thread.

        Raises:
            FleetError: the server refuses us. One that cannot be reached is waited for.
        """
        try:
            self.sync()
        except (LinkError, RestartError) as error:
            self.problem = _unreachable(error)
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._stop = True
        self._wake.set()
        self._thread.join(_CALL_S)
        self._channel.close()

    def finish(self, seconds: float = _CLOSING_S) -> int:
        """After the recording: let the last episodes be sent, as far as that goes in some time.

        Args:
            seconds: how long to wait, if the server can be reached.

        Returns:
            How many episodes are left.
        """
        deadline = time.monotonic() + seconds
        self._wake.set()
        while self._count() and not self.problem and time.monotonic() < deadline:
            time.sleep(0.1)
        return self.waiting

    def sync(self) -> None:
        """One round: register if need be, send what is new, and fetch newer weights.

        Raises:
            LinkError: the server does not answer; the next round goes on where this one stopped.
            FleetError: it refuses.
        """
        try:
            self._count()
            if not self._session:
                self._register()
            self._send()
            self._beat()
        except RestartError:  # another server, or its answer to us was lost
            self._session = ""
            raise
        self.problem = ""

    def _run(self) -> None:
        failures = 0
        while not self._stop:
            self._wake.wait(_pause(failures))
            self._wake.clear()
            try:
                self.sync()
                failures = 0
            except LinkError as error:
                failures, self.problem = failures + 1, _unreachable(error)
            except (FleetError, DatasetError, OSError) as error:
                failures, self.problem, self._session = failures + 1, str(error), ""

    def _count(self) -> int:
        total = int((self._folder.read_json(INFO) or {}).get("total_episodes", 0))
        self.waiting = max(total - self._sent, 0)
        return self.waiting

    def _register(self) -> None:
        header = {"name": self._name, "dataset": self._folder.read_json(RELMM)}
        answer, _ = call(self._channel, "register", header, b"", _CALL_S)
        there, here = number(answer, "episodes", 10**9), (self._folder.read_json(INFO) or {}).get("total_episodes", 0)
        if there > here:
            raise FleetError(
                f"the server has {there} episodes of {self._name} and this machine {here}, so this is an older copy; "
                "choose another --dataset.repo_id, or bring the newer one back."
            )
        self._session, self._sent = text(answer, "session"), there
        self._beat_at = -_HEARTBEAT_S
        self._count()

    def _send(self) -> None:
        if not self.waiting:
            return
        for episode in SealedReader(self._folder.root, self._sent).read_new():
            self._put(episode)
            self._sent += 1
            self._count()
            self._beat()
            if self._stop:
                return

    def _put(self, episode: SealedEpisode) -> None:
        content, offset = episode.content, 0
        header = {
            "session": self._session,
            "episode": episode.index,
            "size": len(content),
            "sha256": hashlib.sha256(content).hexdigest(),
        }
        while offset < len(content):
            chunk = content[offset : offset + CHUNK_BYTES]
            answer, _ = call(self._channel, "put", {**header, "offset": offset}, chunk, _CALL_S)
            offset = number(answer, "offset", len(content))

    def _beat(self) -> None:
        if time.monotonic() - self._beat_at < _HEARTBEAT_S:
            return
        header = {"session": self._session, "waiting": self.waiting}
        answer, _ = call(self._channel, "heartbeat", header, b"", _CALL_S)
        self._beat_at = time.monotonic()
        if self._policy is not None and text(answer, "digest") not in ("", self._digest):
            self._digest = fetch_weights(self._channel, self._policy)


def fetch_weights(channel: grpc.Channel, policy: Path) -> str:
    """Make the server's newest weights the newest in a folder.

    Args:
        channel: of `relmm.fleet.wire.open_channel`.
        policy: the folder; see `relmm.fleet.weights.unpack_policy`.

    Returns:
        Their digest; empty where the server has none yet.

    Raises:
        LinkError: the server does not answer, or newer ones came in between.
        FleetError: it refuses, or its weights cannot be used.
    """
    digest, parts, have, size = "", list[bytes](), 0, 1
    while have < size:
        try:
            answer, part = call(channel, "weights", {"digest": digest, "offset": have}, b"", _CALL_S)
        except RestartError as error:
            raise LinkError(str(error)) from error
        digest, size = text(answer, "digest"), number(answer, "size", MAX_WEIGHTS_BYTES)
        if not size:
            return ""
        if not part:
            raise LinkError("the server has sent no more of its weights.")
        parts.append(part)
        have += len(part)
    content = b"".join(parts)
    if hashlib.sha256(content).hexdigest() != digest:
        raise LinkError("the weights have been damaged on their way.")
    unpack_policy(content, policy)
    return digest


def _pause(failures: int) -> float:
    """Until the next round, s; after failures longer, and not the same for all robots of a server that comes back."""
    return _LOOK_S if not failures else random.uniform(0.5, 1.0) * min(2.0**failures, _LONGEST_PAUSE_S)


def _unreachable(error: Exception) -> str:
    return f"the server cannot be reached ({error}); episodes wait here until it can."
