"""The learner's side: takes episodes into mirrors of the robots' datasets, and gives the newest weights."""

from __future__ import annotations

import secrets
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import grpc
from filelock import FileLock, Timeout

from relmm.episodes.settings import check_repo_id
from relmm.errors import ConfigError, FleetError
from relmm.fleet.mirror import Mirror, check_schema
from relmm.fleet.weights import NewestWeights
from relmm.fleet.wire import (
    CALLS,
    CHANNEL_OPTIONS,
    CHUNK_BYTES,
    MANY_ROBOTS,
    MAX_WEIGHTS_BYTES,
    Guard,
    RestartError,
    number,
    service,
    text,
)

_THREADS = 8
_CALLS_AT_ONCE = 128  # more are sent away to come back later, so that memory is bounded: a message each
_GONE_S = 60.0  # without a word from a robot
_LOOK_S = 2.0  # between looks for newer weights
_FETCHING_S = 30.0  # how long weights stay in memory after a robot has asked for a part of them


@dataclass
class _Robot:
    """What the server knows about one robot.

    Attributes:
        mirror: of its dataset.
        session: of the recorder that registered last; others of that name are gone, or too late.
        heard: when it last said something, s.
        waiting: episodes that it has saved and not sent, by its own word.
    """

    mirror: Mirror
    session: str = ""
    heard: float = 0.0
    waiting: int = 0


class FleetServer:
    """Serves robots until it is left as a context manager.

    Args:
        root: folder of the mirrors, `user--name` each; nobody else may write there.
        checkpoints: of the run of relmm-train that learns from them.
        camera: the camera that robots must have, None for any.
    """

    def __init__(self, root: Path, checkpoints: Path, camera: str | None = None) -> None:
        self._root, self._camera = root, camera
        self._weights, self._looked = NewestWeights(checkpoints), 0.0
        self._robots: dict[str, _Robot] = {}
        self._names: dict[str, str] = {}  # by session
        self._fetched: dict[str, tuple[bytes, float]] = {}  # weights by digest, and when they were last asked for
        self._lock = threading.Lock()
        self.received = 0  # episodes, since the start
        self._server: grpc.Server | None = None

    def start(self, address: str, token: str, credentials: grpc.ServerCredentials) -> int:
        """Begin to serve.

        Args:
            address: HOST:PORT to listen on; port 0 for any that is free.
            token: robots must send it.
            credentials: of `relmm.fleet.wire.server_credentials`.

        Returns:
            The port.

        Raises:
            ConfigError: the address cannot be listened on, or the folder is another server's.
        """
        self._root.mkdir(parents=True, exist_ok=True)
        self._folder_lock = FileLock(self._root / ".lock", timeout=0, thread_local=False)
        try:
            self._folder_lock.acquire()
        except Timeout as error:
            raise ConfigError(
                f"{self._root} is another relmm-serve's: end that one, or choose another folder."
            ) from error
        self._server = grpc.server(
            ThreadPoolExecutor(_THREADS),
            interceptors=[Guard(token)],
            options=[*CHANNEL_OPTIONS, ("grpc.so_reuseport", 0)],
            maximum_concurrent_rpcs=_CALLS_AT_ONCE,
        )
        self._server.add_generic_rpc_handlers((service({name: getattr(self, name) for name in CALLS}),))
        try:
            port = self._server.add_secure_port(address, credentials)
        except RuntimeError as error:
            self._folder_lock.release()
            raise ConfigError(f"{address} cannot be listened on: choose another --fleet.listen=HOST:PORT.") from error
        self._server.start()
        return int(port)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._server is not None:
            self._server.stop(grace=5.0).wait()
            self._folder_lock.release()

    @property
    def robots(self) -> int:
        """Those that were heard of lately."""
        now = time.monotonic()
        return sum(now - robot.heard < _GONE_S for robot in list(self._robots.values()))

    @property
    def waiting(self) -> int:
        """Episodes that the robots have not sent yet, by their own word."""
        return sum(robot.waiting for robot in list(self._robots.values()))

    def register(self, header: dict[str, Any], body: bytes) -> tuple[dict[str, Any], bytes]:
        """A recorder begins, or comes back: `name`, `dataset` (its meta/relmm.json) to `session`, `episodes`."""
        name, dataset = text(header, "name"), header.get("dataset")
        try:
            check_repo_id(name)
        except ConfigError as error:
            raise FleetError(str(error)) from error
        check_schema(name, dataset, self._camera)
        assert isinstance(dataset, dict)
        robot, session = self._robot(name), secrets.token_hex(8)
        with robot.mirror.lock:
            robot.mirror.open(dataset)
            with self._lock:
                self._names.pop(robot.session, None)
                self._names[session] = name
            robot.session, robot.heard = session, time.monotonic()
            return {"session": session, "episodes": robot.mirror.episodes}, b""

    def put(self, header: dict[str, Any], body: bytes) -> tuple[dict[str, Any], bytes]:
        """A part of an episode: `session` and what `Mirror.put` takes, to `offset`."""
        robot = self._registered(header)
        with robot.mirror.lock:
            if robot.session != header["session"]:
                raise _superseded()
            before = robot.mirror.episodes
            offset = robot.mirror.put(header, body)
            with self._lock:
                self.received += robot.mirror.episodes - before
            return {"offset": offset, "episodes": robot.mirror.episodes}, b""

    def weights(self, header: dict[str, Any], body: bytes) -> tuple[dict[str, Any], bytes]:
        """A part of the newest weights: `digest` of what is being fetched (empty at first) and `offset`."""
        self._look()
        offset, wanted, now = number(header, "offset", MAX_WEIGHTS_BYTES), text(header, "digest"), time.monotonic()
        with self._lock:
            digest = wanted or self._weights.digest
            content = (
                self._weights.content if digest == self._weights.digest else self._fetched.get(digest, (b"", 0.0))[0]
            )
            if wanted and not content:
                raise RestartError("these weights are no longer here; begin again with newer ones.")
            # A slow link gets to the end of what it has begun, however often the learner saves.
            self._fetched[digest] = content, now
            self._fetched = {key: kept for key, kept in self._fetched.items() if now - kept[1] < _FETCHING_S}
        return {"digest": digest, "size": len(content)}, content[offset : offset + CHUNK_BYTES]

    def heartbeat(self, header: dict[str, Any], body: bytes) -> tuple[dict[str, Any], bytes]:
        """`session` and `waiting` episodes, to the `digest` of the newest weights."""
        robot = self._registered(header)
        robot.waiting = number(header, "waiting", 10**9)
        self._look()
        return {"digest": self._weights.digest}, b""

    def _robot(self, name: str) -> _Robot:
        with self._lock:
            if name not in self._robots:
                if len(self._robots) >= MANY_ROBOTS:
                    raise FleetError(
                        f"this server has {MANY_ROBOTS:,} robots, which is all that it takes; use another."
                    )
                self._robots[name] = _Robot(Mirror(self._root / name.replace("/", "--"), name, self._camera))
            return self._robots[name]

    def _registered(self, header: dict[str, Any]) -> _Robot:
        with self._lock:
            name = self._names.get(text(header, "session"))
        if name is None:
            raise _superseded()
        robot = self._robots[name]
        robot.heard = time.monotonic()
        return robot

    def _look(self) -> None:
        with self._lock:
            if time.monotonic() - self._looked >= _LOOK_S:
                self._looked = time.monotonic()
                self._weights.look()


def _superseded() -> RestartError:
    return RestartError("the server has begun anew, or another recorder of this name has: register again.")
