"""relmm-serve: robots on other machines send their episodes here, and get the newest weights of a training."""

from __future__ import annotations

import resource
import time
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

from relmm.commands.cli import StopOnSignal, progress, run
from relmm.errors import ConfigError
from relmm.geometry import camera_geometry

_SHOW_S = 0.5


@dataclass
class ServeDatasetConfig:
    """Where the episodes go.

    Args:
        root: folder of the robots' datasets, which `relmm-train --dataset.follow` is given.
    """

    root: Path


@dataclass
class ServeFleetConfig:
    """How robots reach the server.

    Args:
        listen: HOST:PORT to listen on; 0.0.0.0 for all of this machine's addresses.
        token_file: holds the token that the robots must know.
        certificate: of the server, PEM.
        key: of the certificate, PEM.
        camera: the camera that robots must have, None for any; the learner checks it as well.
    """

    listen: str = "0.0.0.0:50151"
    token_file: Path | None = None
    certificate: Path | None = None
    key: Path | None = None
    camera: str | None = None

    def __post_init__(self) -> None:
        check_address("fleet.listen", self.listen)
        if self.camera is not None:
            camera_geometry(self.camera)


@dataclass
class ServeConfig:
    """Take robots' episodes in, and give the newest weights out.

    Args:
        dataset: where the episodes go.
        output_dir: of the run of relmm-train that learns from them; it need not exist yet.
        fleet: how robots reach the server.
    """

    dataset: ServeDatasetConfig
    output_dir: Path
    fleet: ServeFleetConfig = field(default_factory=ServeFleetConfig)

    @property
    def checkpoints(self) -> Path:
        """Whose newest one the robots get."""
        return self.output_dir / "checkpoints"


def check_installed() -> None:
    """See that there is gRPC, which only fleets need.

    Raises:
        ConfigError: there is none.
    """
    if find_spec("grpc") is None:
        raise ConfigError("A fleet needs gRPC, which is not installed: pip install 'lerobot_policy_relmm[fleet]'.")


def check_address(option: str, address: str) -> None:
    """Refuse what is no HOST:PORT.

    Raises:
        ConfigError: with an example.
    """
    host, colon, port = address.rpartition(":")
    if not host or not colon or not port.isdecimal() or int(port) > 65535:
        raise ConfigError(f"{option} is {address!r}, but must be HOST:PORT, for example 192.168.1.5:50151.")


def serve(config: ServeConfig) -> None:
    """Serve until a signal."""
    check_installed()
    from relmm.fleet.server import FleetServer
    from relmm.fleet.wire import read_token, server_credentials

    fleet = config.fleet
    token, credentials = read_token(fleet.token_file), server_credentials(fleet.certificate, fleet.key)
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))  # a connection a robot
    server = FleetServer(config.dataset.root, config.checkpoints, fleet.camera)
    with StopOnSignal() as signals, server:
        port = server.start(fleet.listen, token, credentials)
        print(
            f"listening on {fleet.listen.rpartition(':')[0]}:{port}; episodes go to {config.dataset.root}", flush=True
        )
        with progress(None, "episode") as bar:
            while not signals.stopped:
                bar.set_postfix(robots=server.robots, waiting_there=server.waiting, refresh=False)
                bar.update(server.received - bar.n)
                time.sleep(_SHOW_S)


def main() -> None:
    """Entry point of `relmm-serve`."""
    run("relmm-serve", ServeConfig, serve)


if __name__ == "__main__":
    main()
