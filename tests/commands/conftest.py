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


@pytest.fixture(scope="session")
def tiny() -> list[str]:
    """Settings of relmm-train for a run of seconds."""
    return [
        "--robot.type=locobot_sim",
        "--policy.device=cpu",
        "--policy.num_stationary=6",
        "--policy.min_attempts_to_update=4",
        "--policy.min_steps_to_update=4",
        "--policy.navigation_batch_size=8",
        "--policy.grasp_batch_size=8",
        "--policy.random_steps=2",
        "--pseudo_reset_steps=2",
        "--replay_frames=2000",
        "--env_eval_freq=0",
        "--log_freq=2",
        "--save_freq=4",
    ]
