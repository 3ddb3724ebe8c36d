"""A server on this machine, and robots that record without a room."""

import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
sys.path.append(str(HERE.parent / "episodes"))  # its helpers make datasets

TOKEN = "0123456789abcdef"


@pytest.fixture
def serve(tmp_path):
    """Start a server for a folder; another one for the same folder takes the place of the first."""
    from relmm.fleet.server import FleetServer
    from relmm.fleet.wire import server_credentials

    running = []

    def start(port: int = 0, camera: str | None = "paper"):
        server = FleetServer(tmp_path / "server", tmp_path / "run" / "checkpoints", camera)
        credentials = server_credentials(HERE / "localhost.pem", HERE / "localhost.key")
        server.port = server.start(f"localhost:{port}", TOKEN, credentials)
        running.append(server)
        return server

    yield start
    for server in running:
        server.__exit__(None, None, None)


@pytest.fixture
def connect():
    """A channel to a server."""
    from relmm.fleet.wire import open_channel

    channels = []

    def channel(server, token: str = TOKEN, certificate: Path | None = HERE / "localhost.pem"):
        channels.append(open_channel(f"localhost:{server.port}", token, certificate))
        return channels[-1]

    yield channel
    for each in channels:
        each.close()
