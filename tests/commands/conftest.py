"""Runs commands as users do: as processes, with only what they print and write to go by."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

FIRST_VERSION = Path(__file__).parent / "first_version"  # config.json of its policies
_PATIENCE_S = 550
Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def _scripts() -> Iterator[Callable[[dict[str, Any]], int]]:
    """Runs a console script and returns its exit status; see `command_server.py`."""
    processes: list[subprocess.Popen[bytes]] = []

    def ask(request: dict[str, Any]) -> int:
        if not processes:
            script = [sys.executable, "-W", "ignore", str(Path(__file__).with_name("command_server.py"))]
            processes.append(subprocess.Popen(script, stdin=subprocess.PIPE, stdout=subprocess.PIPE))
        (server,) = processes
        assert server.stdin is not None
        assert server.stdout is not None
        server.stdin.write(json.dumps(request).encode() + b"\n")
        server.stdin.flush()
        return int(server.stdout.readline())

    yield ask
    for process in processes:
        process.communicate()


@pytest.fixture(scope="session")
def run_in(_scripts, tmp_path_factory) -> Run:
    """Run a console script of this environment in a folder."""

    def call(folder: Path, command: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        output = tmp_path_factory.mktemp("output")
        request = {
            "command": command,
            "arguments": arguments,
            "cwd": str(folder),
            "environment": environment,
            "stdout": str(output / "stdout"),
            "stderr": str(output / "stderr"),
            "seconds": _PATIENCE_S,
        }
        status = _scripts(request)
        said, errors = ((output / name).read_text() for name in ("stdout", "stderr"))
        return subprocess.CompletedProcess([command, *arguments], status, said, errors)

    return call


@pytest.fixture
def run(tmp_path: Path, run_in: Run) -> Run:
    """Run a console script of this environment in a folder of its own."""

    def call(command: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        if command.startswith(("relmm-", "lerobot-")) and not any(name.startswith("HF_") for name in environment):
            return run_in(tmp_path, command, *arguments, **environment)
        # Hugging Face's libraries read their settings when they are imported, so this takes a process of its own.
        return subprocess.run(
            [str(Path(sys.executable).parent / command), *arguments],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env={**os.environ, **environment},
            stdin=subprocess.DEVNULL,
            timeout=_PATIENCE_S,
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
