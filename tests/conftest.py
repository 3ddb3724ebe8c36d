"""Nothing here may reach the network, or the caches of whoever runs the tests.

Instead of the Hub there is a server on this machine, for the tests that ask for it; the others are offline.
"""

import importlib.util
import os
import socket
import sys
import tempfile
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

# Before the first import of huggingface_hub, which reads them once.
_listener = socket.socket()
_listener.bind(("127.0.0.1", 0))
os.environ["HF_ENDPOINT"] = f"http://127.0.0.1:{_listener.getsockname()[1]}"
os.environ["HF_HUB_OFFLINE"] = "1"
os.environ["HF_HUB_DISABLE_TELEMETRY"] = "1"
os.environ["HF_TOKEN"] = "hf_me"
os.environ["HF_HOME"] = tempfile.mkdtemp(prefix="relmm-test-hf-")
os.environ.pop("HF_LEROBOT_HOME", None)


def _hub_server():
    """The module `hub_server`, which is no package's."""
    if "hub_server" not in sys.modules:
        path = Path(__file__).parent / "hub_server.py"
        spec = importlib.util.spec_from_file_location("hub_server", path)
        sys.modules["hub_server"] = module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return sys.modules["hub_server"]


@pytest.fixture(scope="session")
def _server():
    server = _hub_server().Hub(_listener)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server
    server.shutdown()


@pytest.fixture
def hub(_server, monkeypatch, tmp_path):
    """An empty Hub, which this process may reach, with caches of its own."""
    import huggingface_hub.utils._http as http
    from huggingface_hub import constants
    from lerobot.utils import constants as lerobot_constants

    _server.clear()
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hf" / "hub"))
    monkeypatch.setattr(lerobot_constants, "HF_LEROBOT_HOME", tmp_path / "hf" / "lerobot")
    monkeypatch.setattr(lerobot_constants, "HF_LEROBOT_HUB_CACHE", tmp_path / "hf" / "lerobot" / "hub")
    impatient = SimpleNamespace(**{**vars(time), "sleep": lambda seconds: None})  # between the client's retries
    monkeypatch.setattr(http, "time", impatient)
    return _server


@pytest.fixture(scope="session")
def fault():
    """`Fault` of the Hub, whose module tests cannot import."""
    return _hub_server().Fault
