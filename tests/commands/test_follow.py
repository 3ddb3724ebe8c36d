"""Two processes that work together: one records by the newest checkpoint, the other trains on what is recorded."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from relmm.episodes import summarize
from relmm.learning.progress import read_metrics


def start(module: str, log: Path, *arguments: str) -> subprocess.Popen[bytes]:
    with log.open("wb") as file:
        return subprocess.Popen([sys.executable, "-m", module, *arguments], stdout=file, stderr=subprocess.STDOUT)


@pytest.mark.slow
def test_recorder_and_trainer_work_together(tmp_path):
    data, run = tmp_path / "data", tmp_path / "run"
    trainer = start(
        "relmm.commands.train",
        tmp_path / "train.log",
        f"--dataset.follow={data}",
        f"--output_dir={run}",
        "--steps=60",
        "--policy.device=cpu",
        "--policy.min_attempts_to_update=4",
        "--replay_frames=2000",
        "--log_freq=5",
    )
    last = run / "checkpoints" / "last" / "pretrained_model"
    deadline = time.monotonic() + 100
    while not last.exists():
        assert trainer.poll() is None, (tmp_path / "train.log").read_text()
        assert time.monotonic() < deadline
        time.sleep(0.1)
    recorder = start(
        "relmm.commands.record",
        tmp_path / "record.log",
        "--robot.type=locobot_sim",
        f"--policy.path={last}",
        "--policy.sample=true",
        "--policy.device=cpu",
        "--dataset.repo_id=me/stream",
        f"--dataset.root={data}",
        "--dataset.num_episodes=1000",
        "--max_steps=8",
        "--pseudo_reset_steps=1",
    )
    try:
        assert trainer.wait(150) == 0, (tmp_path / "train.log").read_text()
    finally:
        recorder.terminate()
        recorder.wait(60)
        trainer.kill()
    assert recorder.returncode == 0, (tmp_path / "record.log").read_text()
    assert f"waiting for {data}, which is not there yet" in (tmp_path / "train.log").read_text()
    assert (tmp_path / "record.log").read_text().count("acting by") >= 3, "new weights are picked up"
    metrics = read_metrics(run / "metrics.jsonl")
    assert metrics[-1]["steps"] >= 60
    assert any("grasp_loss" in line for line in metrics)
    assert summarize(data).grasps >= metrics[-1]["attempts"]
