"""Runs commands as users do: as processes, with only what they print and write to go by."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

FIRST_VERSION = Path(__file__).parent / "first_version"  # config.json of its policies
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
            timeout=550,
        )

    return call


@pytest.fixture(params=["relmm", "paper"])
def first_version(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A run of relmm 0.1.0 with a checkpoint of its default, or of the paper's networks, as far as anybody reads it."""
    model = tmp_path / "first_version" / "checkpoints" / "000007" / "pretrained_model"
    model.mkdir(parents=True)
    (model.parents[1] / "last").symlink_to("000007")
    config = json.loads((FIRST_VERSION / f"{request.param}.json").read_text())
    settings = {"policy": config, "dataset": {"repo_id": "me/life", "root": None, "follow": None}, "seed": 3}
    (model / "config.json").write_text(json.dumps(config))
    (model / "train_config.json").write_text(json.dumps({"robot": {"type": "locobot_sim"}, **settings}))
    (model / "model.safetensors").write_bytes(b"")
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        (model / name).write_text('{"name": "processor", "steps": []}')
    (model.parent / "training_state").mkdir()
    (model.parent / "training_state" / "training_step.json").write_text('{"step": 7}')
    return tmp_path / "first_version"


@pytest.fixture(scope="session")
def tiny() -> list[str]:
    """Settings of relmm-train for a run of seconds."""
    return [
        "--robot.type=locobot_sim",
        "--policy.device=cpu",
        "--policy.num_stationary=6",
        "--policy.min_attempts_to_update=4",
        "--policy.batch_size=8",
        "--pseudo_reset_steps=2",
        "--replay_frames=2000",
        "--env_eval_freq=0",
        "--log_freq=2",
        "--save_freq=4",
        "--report=false",
    ]
