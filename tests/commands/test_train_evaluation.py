"""An evaluation while training: it can be stopped between two steps."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import av
import pytest

from relmm.commands.policies import make_actor
from relmm.commands.train_config import TrainEvalConfig
from relmm.commands.train_evaluation import RoomEvaluation
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.sim.config_locobot_sim import LocobotSimConfig


def test_a_stopped_evaluation_has_no_scores_and_a_whole_film(tmp_path):
    actor = make_actor(ReLMMConfig(device="cpu", seed=0))
    actor.policy.sampling = True
    shown = []
    evaluation = RoomEvaluation(
        LocobotSimConfig(),
        actor,
        TrainEvalConfig(n_episodes=2, n_videos=1),
        tmp_path,
        should_stop=lambda: len(shown) == 3,
        show=shown.append,
    )
    assert evaluation(7) == {}
    assert len(shown) == 3
    assert shown[-1] <= 3 / 500, "the share of both episodes"
    assert actor.policy.sampling, "training goes on as before"
    with av.open(str(tmp_path / "videos_step_000007" / "eval_episode_0.mp4")) as film:
        assert sum(1 for _ in film.decode(video=0)) > 1


@pytest.mark.slow
def test_a_hangup_during_an_evaluation_ends_the_run_with_its_checkpoint(tiny, tmp_path):
    options = ("--steps=1", "--env_eval_freq=1", "--eval.n_episodes=100", "--eval.n_videos=1", "--output_dir=out")
    command = [str(Path(sys.executable).parent / "relmm-train"), *tiny, *options]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    film = tmp_path / "out/eval/videos_step_000001/eval_episode_0.mp4"
    while not film.exists() and process.poll() is None:
        time.sleep(0.1)
    process.send_signal(signal.SIGHUP)
    words, _ = process.communicate(timeout=60)
    assert process.returncode == 0, words
    assert (tmp_path / "out/checkpoints/last").resolve().name == "000001"
    assert "eval_collected" not in (tmp_path / "out/metrics.jsonl").read_text()
    with av.open(str(film)) as container:
        assert next(container.decode(video=0)) is not None
