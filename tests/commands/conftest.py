"""Runs commands as users do: as processes, with only what they print and write to go by."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """Run a console script of this environment in a folder of its own."""

    def call(command: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        script = Path(sys.executable).parent / command
        return subprocess.run(
            [str(script), *arguments],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env={**os.environ, **environment},
            stdin=subprocess.DEVNULL,
            timeout=110,
        )

    return call
