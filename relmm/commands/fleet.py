"""relmm-record's side of a fleet: the first weights before it begins, and the link beside it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from relmm.commands.arguments import Arguments
from relmm.commands.serve import check_address, check_installed
from relmm.errors import ConfigError

if TYPE_CHECKING:
    import grpc

    from relmm.fleet.client import Link

_FIRST_WEIGHTS_S = 600.0  # how long a robot waits for the learner's first weights
_RETRY_S = 2.0
_UNREACHABLE = "it cannot be reached"


@dataclass
class RecordFleetConfig:
    """The server of a fleet.

    Args:
        server: HOST:PORT of relmm-serve; episodes are sent there, and without a policy of one's own the robot acts by
            the newest weights of its learner.
        token_file: holds the fleet's token.
        certificate: of the server, if no authority that this system trusts has signed it, PEM.
    """

    server: str | None = None
    token_file: Path | None = None
    certificate: Path | None = None

    def __post_init__(self) -> None:
        if self.server is not None:
            check_address("fleet.server", self.server)
            check_installed()
        elif self.token_file is not None or self.certificate is not None:
            raise ConfigError(
                "fleet.token_file and fleet.certificate are for a server: also say --fleet.server=HOST:PORT."
            )


def weights_folder(dataset: Path) -> Path:
    """Where the weights go: beside the dataset."""
    return dataset.with_name(f"{dataset.name}_policy")


def act_by_newest_weights(arguments: Arguments, dataset: Path) -> None:
    """With `--fleet.server` and no policy, fetch the learner's weights and say them as `--policy.path`.

    Args:
        arguments: of the command line.
        dataset: its folder.

    Raises:
        FleetError: the server refuses.
        ConfigError: neither it nor an earlier run has any weights.
    """
    options = {name: arguments.get(f"fleet.{name}") for name in ("server", "token_file", "certificate")}
    paths = {name: None if value is None else Path(value) for name, value in options.items() if name != "server"}
    config = RecordFleetConfig(options["server"], **paths)
    from relmm.fleet.client import fetch_weights
    from relmm.fleet.wire import LinkError

    folder, deadline = weights_folder(dataset), time.monotonic() + _FIRST_WEIGHTS_S
    problem = said = ""
    with contextlib.closing(_channel(config)) as channel:
        while True:
            try:
                problem = "" if fetch_weights(channel, folder) else "its learner has no weights yet"
            except LinkError as error:
                problem = problem if problem.startswith(_UNREACHABLE) else f"{_UNREACHABLE} ({error})"
            there = (folder / "last").exists()
            if problem and problem != said:
                print(f"{config.server}: {problem}; " + ("acting by the last ones" if there else "waiting"), flush=True)
                said = problem
            if there:
                break
            if time.monotonic() > deadline:
                raise ConfigError(
                    f"{config.server} has given no weights: {problem}; start relmm-serve and relmm-train."
                )
            time.sleep(_RETRY_S)
    arguments.set("policy.path", folder / "last" / "pretrained_model")
    if arguments.get("policy.sample") is None:
        arguments.set("policy.sample", "true")


def _channel(config: RecordFleetConfig) -> grpc.Channel:
    from relmm.fleet.wire import open_channel, read_token

    assert config.server is not None
    return open_channel(config.server, read_token(config.token_file), config.certificate)


@contextlib.contextmanager
def linked(config: RecordFleetConfig, root: Path, name: str, with_weights: bool) -> Iterator[Link | None]:
    """Send a dataset's episodes while it is recorded; without a server, nothing.

    Args:
        config: of the server.
        root: the dataset, which exists.
        name: of it, `user/name`.
        with_weights: whether to fetch newer weights.

    Raises:
        FleetError: the server refuses.
    """
    if config.server is None:
        yield None
        return
    from relmm.fleet.client import Link

    with Link(_channel(config), root, name, weights_folder(root) if with_weights else None) as link:
        yield link
