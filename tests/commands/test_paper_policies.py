"""The paper's baselines and ablations through relmm's commands: they train, resume, and act in an evaluation."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from safetensors.torch import load_file

from relmm.commands import evaluate as evaluate_module
from relmm.commands import train as train_module
from relmm.learning.progress import read_metrics

SMALL = ["--policy.grasp_channels=4", "--policy.num_members=2", "--policy.grasp_batch_size=8"]
SMALL += ["--policy.navigation_encoder=paper_small", "--policy.navigation_hidden=8", "--policy.navigation_batch_size=4"]
SMALL += ["--policy.num_stationary=6", "--policy.min_attempts_to_update=4", "--policy.min_steps_to_update=2"]
PAPER = ["--policy.type=relmm_paper", *SMALL]
SINGLE = ["--policy.type=relmm_single", "--policy.encoder=paper_small", "--policy.hidden=8", "--policy.batch_size=4"]
VARIANTS = {
    "sac": PAPER,
    "rand_nav": [*PAPER, "--policy.navigation=random"],
    "continuous": [*PAPER, "--policy.grasping=continuous"],
    "novelty": [*PAPER, "--policy.perturbation=novelty"],
    "single": [*SINGLE, "--policy.min_steps_to_update=2", "--curriculum.type=none"],
}
Call = Callable[..., str]


@pytest.fixture
def call(monkeypatch, capsys) -> Call:
    """A command in this process, and what it prints."""

    def call(module, *arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["relmm", *arguments])
        with contextlib.suppress(SystemExit):
            module.main()
        said = capsys.readouterr()
        return str(said.out + said.err)

    return call


def weights(run: Path, step: str) -> dict:
    return load_file(run / "checkpoints" / step / "pretrained_model" / "model.safetensors")


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_it_trains_resumes_and_is_evaluated(variant: str, call: Call, tmp_path: Path) -> None:
    run = tmp_path / "run"
    fixed = ["--robot.type=locobot_sim", "--robot.tidy_every=2", "--policy.device=cpu", "--pseudo_reset_steps=2"]
    fixed += ["--replay_frames=1000", "--env_eval_freq=0", "--log_freq=1", "--save_freq=2", f"--output_dir={run}"]
    said = call(train_module, *VARIANTS[variant], *fixed, "--steps=4")
    assert "checkpoints, metrics, dataset" in said, said
    before = read_metrics(run / "metrics.jsonl")[-1]
    said = call(train_module, "--resume=true", f"--output_dir={run}", "--policy.device=cpu", "--steps=6")
    assert "checkpoints, metrics, dataset" in said, said
    after = read_metrics(run / "metrics.jsonl")[-1]
    assert (before["steps"], after["steps"]) == (4, 6)
    assert after["attempts"] >= before["attempts"]
    config = json.loads((run / "checkpoints" / "last" / "pretrained_model" / "config.json").read_text())
    assert config["type"] == VARIANTS[variant][0].split("=")[1]
    first, last = weights(run, "000002"), weights(run, "000006")
    assert first.keys() == last.keys()
    learned = {name.split(".")[0] for name in first if not first[name].equal(last[name])}
    assert ("navigation" in learned or "sac" in learned) == (variant != "rand_nav")
    policy = f"--policy.path={run / 'checkpoints' / 'last' / 'pretrained_model'}"
    said = call(
        evaluate_module, policy, "--env.room=no_obstacles", "--env.navigation_steps=3", "--eval.n_episodes=1",
        "--eval.n_videos=0", "--policy.device=cpu", f"--output_dir={tmp_path / 'eval'}",
    )  # fmt: skip
    assert (tmp_path / "eval" / "eval_info.json").exists(), said
