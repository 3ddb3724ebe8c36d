"""relmm-train as a user runs it: tiny runs from the command line."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import load_file

from relmm.commands import train as module
from relmm.commands.train import main
from relmm.episodes import read_episodes, summarize
from relmm.features import Phase, Skill
from relmm.learning.progress import read_metrics


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "relmm.commands.train", *arguments]


def train(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*arguments), capture_output=True, text=True, timeout=200, check=False)


def weights(folder: Path) -> dict[str, np.ndarray]:
    return {key: value.numpy() for key, value in load_file(folder / "pretrained_model" / "model.safetensors").items()}


def recorded(root: Path) -> list[np.ndarray]:
    return [episode.actions for episode in read_episodes(root)]


@pytest.fixture(scope="module")
def finished(run_in, tmp_path_factory, tiny) -> Path:
    folder = tmp_path_factory.mktemp("train") / "run"
    result = run_in(folder.parent, "relmm-train", *tiny, "--steps=8", "--output_dir=run")
    assert result.returncode == 0, result.stderr
    return folder


def test_run_leaves_lerobots_tree(finished):
    last = finished / "checkpoints" / "last"
    assert last.is_symlink()
    assert last.resolve().name == "000008"
    assert {path.name for path in (finished / "checkpoints").iterdir()} == {"000000", "000004", "000008", "last"}
    model = {path.name for path in (last / "pretrained_model").iterdir()}
    assert {"config.json", "model.safetensors", "train_config.json", "policy_preprocessor.json"} <= model
    state = {path.name for path in (last / "training_state").iterdir()}
    assert {"grasping", "training_step.json", "relmm_state.json", "relmm_rng.safetensors"} <= state


def test_dataset_holds_the_whole_life(finished):
    episodes = list(read_episodes(finished / "dataset"))
    actions = np.concatenate([episode.actions for episode in episodes])
    phases = np.concatenate([episode.phases for episode in episodes])
    skills = actions[:, 2].round()
    assert np.count_nonzero((skills == Skill.GRASP) & (phases == Phase.CURRICULUM)) == 6
    assert np.count_nonzero((skills == Skill.NAVIGATE) & (phases == Phase.LEARNING)) == 8


def test_metrics_count_what_the_dataset_holds(finished):
    last = read_metrics(finished / "metrics.jsonl")[-1]
    summary = summarize(finished / "dataset")
    assert last["steps"] == 8
    assert last["attempts"] == summary.grasps
    assert last["successes"] == summary.successful_grasps
    *_, newest = read_episodes(finished / "dataset")
    assert last["robot_minutes"] == pytest.approx(newest.robot_times[-1] / 60, abs=1e-4)


@pytest.mark.slow
def test_equal_seeds_give_equal_runs(finished, tmp_path, tiny):
    assert train(*tiny, "--steps=8", f"--output_dir={tmp_path / 'again'}").returncode == 0
    first, second = weights(finished / "checkpoints" / "last"), weights(tmp_path / "again" / "checkpoints" / "last")
    assert all(np.array_equal(first[key], second[key]) for key in first)


@pytest.mark.slow
def test_resume_goes_on_with_all_recorded_steps(tmp_path, tiny):
    folder = tmp_path / "run"
    assert train(*tiny, "--steps=4", f"--output_dir={folder}").returncode == 0
    result = train("--resume=true", f"--output_dir={folder}", "--steps=8", "--policy.device=cpu")
    assert result.returncode == 0, result.stderr
    skills = [(e.actions[:, 2].round(), e.phases) for e in read_episodes(folder / "dataset")]
    drives = sum(np.count_nonzero((s == Skill.NAVIGATE) & (p == Phase.LEARNING)) for s, p in skills)
    curriculum = sum(np.count_nonzero((s == Skill.GRASP) & (p == Phase.CURRICULUM)) for s, p in skills)
    assert (drives, curriculum) == (8, 6), "steps of before count, and the curriculum is not done twice"
    times = np.concatenate([e.robot_times for e in read_episodes(folder / "dataset")])
    (begun,) = np.flatnonzero(np.diff(times) < 0)  # where the robot's clock began anew
    minutes = read_metrics(folder / "metrics.jsonl")[-1]["robot_minutes"]
    assert minutes == pytest.approx((times[begun] + times[-1]) / 60, abs=1e-3), "of both lives"
    result = train("--resume=true", f"--output_dir={folder}", "--steps=8", "--policy.device=cpu")
    assert "this run has gone 8 navigation steps already" in result.stderr + result.stdout


@pytest.mark.slow
@pytest.mark.parametrize("max_steps", [3, 250], ids=["with saved episodes", "perhaps before the first one"])
def test_killed_run_resumes(tmp_path, max_steps, tiny):
    folder = tmp_path / "run"
    process = subprocess.Popen(
        command(*tiny, "--steps=100000", f"--max_steps={max_steps}", f"--output_dir={folder}"),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    deadline = time.monotonic() + 180
    while not (folder / "checkpoints" / "000004").exists():
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    before = recorded(folder / "dataset")
    steps = json.loads((folder / "checkpoints" / "last" / "training_state" / "training_step.json").read_text())["step"]
    result = train("--resume=true", f"--output_dir={folder}", f"--steps={steps + 8}", "--policy.device=cpu")
    assert result.returncode == 0, result.stderr
    after = recorded(folder / "dataset")
    assert len(after) > len(before)
    assert all(np.array_equal(mine, theirs) for mine, theirs in zip(before, after, strict=False)), "nothing was lost"


BAD = {
    "curriculum": (["--curriculum.type=nonsense"], "stationary, autonomous, none"),
    "encoder": (["--policy.type=relmm_paper", "--policy.navigation_encoder=eyes"], "paper, paper_small"),
    "gone": (["--policy.navigation_encoder=floor"], "`navigation_encoder` are not valid for ReLMMConfig"),
    "members": (["--policy.num_members=0"], "policy.num_members is 0"),
    "rate": (["--policy.learning_rate=-1"], "policy.learning_rate is -1"),
    "gamma": (["--policy.type=relmm_paper", "--policy.gamma=1.5"], "policy.gamma is 1.5"),
    "steps": (["--steps=0"], "steps is 0"),
    "policy": (["--policy.type=relmm_random"], "--policy.type=relmm, relmm_paper or relmm_single"),
    "another preset's policy": (["--policy.type=relmm", "--config_path=paper"], "'relmm_paper': leave one of them out"),
    "camera": (["--robot.camera=d435"], "--policy.camera=d435"),
    "unknown camera": (["--policy.camera=fisheye"], "paper, d435"),
    "room": (["--robot.room=attic"], "no_obstacles"),
    "device": (["--policy.device=cuda:7"], "--policy.device=cpu"),
    "init": (["--dataset.init=nowhere/at_all"], "nowhere/at_all"),
    "resume": (["--resume=true"], "There is no checkpoint"),
}


@pytest.fixture
def refused(monkeypatch, capsys) -> Callable[..., str]:
    """The one sentence that a command line ends in; in this process, because importing LeRobot takes seconds."""

    def call(*arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["relmm-train", *arguments])
        with pytest.raises(SystemExit) as stop:
            main()
        assert stop.value.code == 2
        errors = capsys.readouterr().err.strip()
        assert errors.startswith("relmm-train: ")
        assert len(errors.splitlines()) == 1
        return errors

    return call


@pytest.mark.parametrize(("arguments", "words"), BAD.values(), ids=BAD)
def test_bad_settings_end_in_one_sentence(tmp_path, refused, arguments, words, tiny):
    folder = tmp_path / "run"
    replaced = ("--policy.",) if "policy.type" in arguments[0] else (arguments[0].partition("=")[0],)
    kept = [argument for argument in tiny if not argument.startswith(replaced)]
    assert words in refused(*kept, *arguments, f"--output_dir={folder}")
    assert not folder.exists()


@pytest.mark.parametrize("preset", ["paper", "paper_small"])
def test_preset_and_checkpoint_together_are_refused(tmp_path, refused, tiny, preset):
    """Which of the two policies was meant?"""
    both = (f"--config_path={preset}", "--policy.path=me/cleaner")
    kept = [argument for argument in tiny if not argument.startswith("--policy.")]
    assert "leave one of them out" in refused(*kept, *both, f"--output_dir={tmp_path / 'run'}")


@pytest.mark.parametrize(
    ("arguments", "kind"),
    [
        ([], "relmm"),
        (["--policy.type=relmm_paper"], "relmm_paper"),
        (["--config_path=paper"], "relmm_paper"),
        (["--config_path=paper_small", "--policy.grasp_channels=4"], "relmm_paper"),
        (["--config_path=paper_small", "--policy.type=relmm_paper"], "relmm_paper"),
        (["--config_path={folder}/room.yaml"], "relmm"),
        (["--config_path={folder}/room.yaml", "--policy.type=relmm_paper"], "relmm_paper"),
        (["--config_path={folder}/paper.json"], "relmm_paper"),
    ],
)
def test_policy_is_the_one_that_anything_names_or_the_default(tmp_path, monkeypatch, arguments, kind):
    (tmp_path / "room.yaml").write_text("robot:\n  type: locobot_sim\nsteps: 9\n")
    (tmp_path / "paper.json").write_text('{"policy": {"type": "relmm_paper", "num_members": 2}}')
    given = [argument.format(folder=tmp_path) for argument in arguments]
    configs = []
    monkeypatch.setattr(module, "train", configs.append)
    robot = ["--robot.type=locobot_sim", "--policy.device=cpu", "--policy.num_stationary=6"]
    monkeypatch.setattr(sys, "argv", ["relmm-train", *robot, *given, f"--output_dir={tmp_path / 'run'}"])
    main()
    (config,) = configs
    assert config.policy.type == kind
    assert config.policy.num_stationary == 6
    assert config.steps == (9 if "room" in "".join(given) else 2000)


def test_config_path_that_is_neither_file_nor_preset_is_refused(tmp_path, refused, tiny):
    words = refused(*tiny, "--config_path=nonsense", f"--output_dir={tmp_path / 'run'}")
    assert (
        "--config_path=nonsense: there is no such file; choose one, or a preset: paper, paper_small, paper_continuous."
        in words
    )


def test_no_run_to_resume_is_said_before_what_it_would_have_known(tmp_path, refused):
    assert "There is no run to go on with" in refused("--resume=true", f"--output_dir={tmp_path / 'typo'}")


@pytest.mark.parametrize("option", ["follow", "init"])
def test_dataset_that_cannot_be_trained_on_is_refused(tmp_path, refused, finished, tiny, option):
    data, folder = tmp_path / "data", tmp_path / "run"
    shutil.copytree(finished / "dataset", data)
    info = json.loads((data / "meta/info.json").read_text())
    del info["features"]["action"]
    (data / "meta/info.json").write_text(json.dumps(info))
    learner = [argument for argument in tiny if option == "init" or not argument.startswith("--robot.")]
    words = refused(*learner, f"--dataset.{option}={data}", f"--output_dir={folder}")
    assert "column action: have no such column" in words
    assert not folder.exists()


def test_nothing_to_learn_from_is_refused(tmp_path, refused):
    assert "--robot.type=locobot_sim" in refused("--policy.device=cpu", f"--output_dir={tmp_path / 'run'}")
