"""LeRobot builds Arrow caches where it loads datasets: they go to a temporary folder, and nothing to the Hub."""

import multiprocessing
import os
import shutil
import sys
import tempfile
from pathlib import Path

import pytest

os.environ["HF_HUB_OFFLINE"] = "1"
os.environ["HF_HOME"] = tempfile.mkdtemp(prefix="relmm-tests-hf-")
sys.path.insert(0, str(Path(__file__).parent))  # for episode_helpers, also in processes that tests start


@pytest.fixture(scope="session", autouse=True)
def remove_hf_home():
    yield
    shutil.rmtree(os.environ["HF_HOME"], ignore_errors=True)


@pytest.fixture(scope="session")
def forkserver():
    """Processes that can be killed, without importing LeRobot in each."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["relmm.episodes.lerobot_writer", "episode_children"])
    return context
