"""What breaks with LeRobot's newest version is seen before it is released.

git clone --depth 1 https://github.com/huggingface/lerobot
NEWEST_LEROBOT=lerobot/src python -m pytest -m slow tests/test_newest_lerobot.py
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = os.environ.get("NEWEST_LEROBOT")
TESTS = (
    "learning/test_checkpoint.py",
    "episodes/test_writer.py",
    "episodes/test_compact.py",
    "policies/test_camera.py",
)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.skipif(SOURCE is None, reason="NEWEST_LEROBOT names no source of it")
def test_what_uses_lerobots_insides_works_with_its_newest_version() -> None:
    paths = os.pathsep.join([str(Path(str(SOURCE)).absolute()), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-m", "pytest", "-q", *(str(Path(__file__).parent / name) for name in TESTS)]
    result = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stdout
