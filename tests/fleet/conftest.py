"""A server on this machine, and robots that record without a room."""

import json
import shutil
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
sys.path.append(str(HERE.parent / "episodes"))  # its helpers make datasets

TOKEN, NAME = "0123456789abcdef", "me/d"


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


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A dataset of two episodes."""
    root = tmp_path_factory.mktemp("recorded") / "robot"
    from episode_helpers import new_dataset

    new_dataset(root, 2)
    return root


@pytest.fixture
def robot(recorded, tmp_path):
    """It, to be changed."""
    return shutil.copytree(recorded, tmp_path / "robot")


@pytest.fixture
def mirror(tmp_path):
    return tmp_path / "server" / "me--d"


@pytest.fixture
def register():
    """Registers a robot, and returns the server's answer."""
    from relmm.fleet.wire import call

    def ask(channel, robot):
        header = {"name": NAME, "dataset": json.loads((robot / "meta/relmm.json").read_text())}
        return call(channel, "register", header, b"", 10)[0]

    return ask


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """A checkpoint of a policy that has learned nothing."""
    import relmm.plugin  # noqa: F401
    from relmm.commands.policies import make_actor
    from relmm.learning.sums import write_sums
    from relmm.policies.relmm.configuration_relmm import ReLMMConfig

    folder = tmp_path_factory.mktemp("policy") / "000007" / "pretrained_model"
    make_actor(ReLMMConfig(num_members=1, channels=2, device="cpu")).save_pretrained(folder)
    write_sums(folder)
    (folder / "train_config.json").write_text('{"secret": "paths of this machine"}')
    return folder.parent


@pytest.fixture
def run(tmp_path, policy):
    """The checkpoints of a run."""
    folder = tmp_path / "run" / "checkpoints"
    shutil.copytree(policy, folder / "000007")
    (folder / "last").symlink_to("000007")
    return folder
