"""Server, learner and recorder as three processes: what users run."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from relmm.episodes import saved_episodes
from relmm.learning.progress import read_metrics

HERE = Path(__file__).parent


@pytest.mark.slow
def test_a_robot_elsewhere_is_learned_from_and_acts_by_what_was_learned(tmp_path):
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
    (tmp_path / "token").write_text("0123456789abcdef")
    (tmp_path / "token").chmod(0o600)
    shared = [f"--fleet.token_file={tmp_path}/token", f"--fleet.certificate={HERE}/localhost.pem"]
    commands = {
        "serve": [
            *shared,
            f"--fleet.key={HERE}/localhost.key",
            "--dataset.root=robots",
            "--output_dir=run",
            f"--fleet.listen=localhost:{port}",
        ],
        "train": [
            "--dataset.follow=robots",
            "--output_dir=run",
            "--steps=20",
            "--policy.device=cpu",
            "--policy.min_attempts_to_update=4",
            "--replay_frames=2000",
            "--log_freq=2",
        ],
        "record": [
            *shared,
            f"--fleet.server=localhost:{port}",
            "--robot.type=locobot_sim",
            "--policy.device=cpu",
            "--dataset.repo_id=me/robot",
            "--dataset.root=robot",
            "--dataset.num_episodes=1000",
            "--max_steps=4",
            "--pseudo_reset_steps=1",
        ],
    }
    processes = {}
    for name, options in commands.items():
        with (tmp_path / f"{name}.log").open("wb") as log:
            command = [sys.executable, "-m", f"relmm.commands.{name}", *options]
            processes[name] = subprocess.Popen(command, stdout=log, stderr=log, cwd=tmp_path, env=os.environ)
    said = {name: tmp_path / f"{name}.log" for name in commands}
    try:
        assert processes["train"].wait(400) == 0, said["train"].read_text()
        deadline = time.monotonic() + 60
        while "acting by" not in said["record"].read_text():
            assert time.monotonic() < deadline, said["record"].read_text()
            time.sleep(0.2)
        for name in ("record", "serve"):
            processes[name].send_signal(signal.SIGTERM)
            assert processes[name].wait(100) == 0, said[name].read_text()
    finally:
        for process in processes.values():
            process.kill()
    assert saved_episodes(tmp_path / "robot") == saved_episodes(tmp_path / "robots" / "me--robot") > 0
    metrics = read_metrics(tmp_path / "run" / "metrics.jsonl")
    assert metrics[-1]["steps"] >= 20
    assert any("grasp_loss" in line for line in metrics)
    assert any(line.get("weights_age", 0) > 0 for line in metrics)
