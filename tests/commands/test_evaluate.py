"""relmm-eval, and its agreement with lerobot-eval."""

import json
import os
import pty
import shutil
import signal
import subprocess
import sys

import av
import numpy as np
import pytest
import torch

from relmm.commands import evaluate as command
from relmm.errors import ConfigError
from relmm.features import dataset_features
from relmm.learning.untrusted import check_any_policy_folder

SETTINGS = ("--env.type=relmm_room", "--env.room=diverse", "--env.navigation_steps=15", "--seed=7")


def test_evaluate_agrees_with_lerobot_eval(run, tmp_path):
    ours = run(
        "relmm-eval",
        *SETTINGS,
        "--policy.type=relmm_scripted",
        "--eval.n_episodes=3",
        "--eval.n_videos=0",
        "--output_dir=ours",
    )
    assert ours.returncode == 0, ours.stderr
    theirs = run(
        "lerobot-eval",
        *SETTINGS,
        "--policy.type=relmm_scripted",
        "--eval.n_episodes=3",
        "--eval.batch_size=3",
        "--eval.use_async_envs=false",
        "--output_dir=theirs",
    )
    assert theirs.returncode == 0, theirs.stderr
    own = json.loads((tmp_path / "ours/eval_info.json").read_text())
    stock = json.loads((tmp_path / "theirs/eval_info.json").read_text())
    collected = [episode["collected"] for episode in own["per_episode"]]
    assert stock["per_task"][0]["metrics"]["sum_rewards"] == collected
    assert sum(collected) > 0
    assert own["overall"]["avg_sum_reward"] == pytest.approx(stock["overall"]["avg_sum_reward"])
    assert own["overall"]["pc_success"] == stock["overall"]["pc_success"]


@pytest.fixture(scope="module")
def act(tmp_path_factory):
    """A small ACT that has learned nothing, as `lerobot-train` saves it."""
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot.utils.feature_utils import dataset_to_policy_features

    features = dataset_to_policy_features(dataset_features())
    config = ACTConfig(
        device="cpu",
        input_features={key: feature for key, feature in features.items() if key != "action"},
        output_features={"action": features["action"]},
        pretrained_backbone_weights=None,
        dim_model=16,
        dim_feedforward=16,
        n_heads=2,
        chunk_size=4,
        n_action_steps=4,
    )
    ones = {key: {name: torch.ones(1) for name in ("mean", "std", "min", "max")} for key in features}
    folder = tmp_path_factory.mktemp("act")
    for part in (ACTPolicy(config), *make_pre_post_processors(config, dataset_stats=ones)):
        part.save_pretrained(folder)
    # As it is by default: LeRobot would download these weights to replace them by the checkpoint's.
    saved = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(
        json.dumps(saved | {"pretrained_backbone_weights": "ResNet18_Weights.IMAGENET1K_V1"})
    )
    return folder


def test_evaluate_takes_a_policy_of_lerobot(run, act, tmp_path):
    arguments = (f"--policy.path={act}", "--eval.n_episodes=2", "--eval.n_videos=0", "--output_dir=out")
    result = run("relmm-eval", *SETTINGS, *arguments)
    assert result.returncode == 0, result.stderr
    episodes = json.loads((tmp_path / "out/eval_info.json").read_text())["per_episode"]
    assert [episode["seed"] for episode in episodes] == [7, 8]
    assert all(episode["navigation_steps"] == 15 for episode in episodes)


def test_evaluate_refuses_a_policy_of_lerobot_that_has_learned_nothing(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "argv", ["relmm-eval", "--policy.type=act", f"--output_dir={tmp_path / 'out'}"])
    with pytest.raises(SystemExit):
        command.main()
    assert (
        capsys.readouterr()
        .err.strip()
        .endswith("relmm-eval: A policy act has to learn first: say --policy.path=FOLDER_OR_REPO.")
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"input_features": {"observation.state": {"type": "STATE", "shape": [7]}}},
            "expects observation.state of (7,)",
        ),
        ({"dim_model": 32}, "cannot be loaded"),
        ({"type": "walker"}, "is of a policy 'walker', and this loads act, "),
    ],
)
def test_evaluate_refuses_a_policy_of_lerobot_that_does_not_fit(capsys, monkeypatch, act, tmp_path, change, words):
    policy = shutil.copytree(act, tmp_path / "policy")
    config = json.loads((policy / "config.json").read_text())
    (policy / "config.json").write_text(json.dumps(config | change))
    monkeypatch.setattr(sys, "argv", ["relmm-eval", f"--policy.path={policy}", f"--output_dir={tmp_path / 'out'}"])
    with pytest.raises(SystemExit) as stop:
        command.main()
    errors = capsys.readouterr().err.strip()
    assert stop.value.code == 2
    assert words in errors
    assert len(errors.splitlines()) == 1


def test_steps_that_import_a_class_are_for_local_policies_of_others_only(act, tmp_path):
    policy = shutil.copytree(act, tmp_path / "policy")
    for trusted in (True, False):
        check_any_policy_folder(policy, trusted)
    path = policy / "policy_preprocessor.json"
    pipeline = json.loads(path.read_text())
    pipeline["steps"].append({"class": "somebody.steps.Step", "config": {}})
    path.write_text(json.dumps(pipeline))
    check_any_policy_folder(policy, trusted=True)
    with pytest.raises(ConfigError, match=r"has a step 'somebody\.steps\.Step'"):
        check_any_policy_folder(policy, trusted=False)


def test_evaluate_films_the_arm_too(run, tmp_path):
    result = run("relmm-eval", *SETTINGS, "--policy.type=relmm_random", "--eval.n_episodes=1", "--output_dir=out")
    assert result.returncode == 0, result.stderr
    video = tmp_path / "out/videos/eval_episode_0.mp4"
    assert str(video.relative_to(tmp_path)) in result.stdout
    with av.open(str(video)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    seconds = json.loads((tmp_path / "out/eval_info.json").read_text())["per_episode"][0]["seconds"]
    assert len(frames) == pytest.approx(seconds / 0.2, rel=0.1), "one picture every 0.2 s of the robot's life"
    assert frames[0].shape == (480, 880, 3)
    assert np.abs(frames[0].astype(int) - frames[-1]).mean() > 1


def test_what_took_nothing_has_no_rate():
    nothing = command.EpisodeScore(1, 0, 20, 0, 0, 0, 250, 100.0, 20.0)
    half = command.EpisodeScore(2, 10, 20, 20, 10, 10, 250, 100.0, 20.0)
    rows = [line.split() for line in command.table([nothing, half]).splitlines()[1:]]
    assert rows[0] == ["1", "0.0%", "0.0", "0.0", "-", "-", "-", "20.0"]
    assert rows[1] == ["2", "50.0%", "10.0", "20.0", "50.0%", "25.0", "10.0", "20.0"]
    assert rows[2] == ["mean", "25.0%", "5.0", "10.0", "50.0%", "25.0", "10.0", "20.0"]
    assert [line.split()[4] for line in command.table([nothing]).splitlines()[1:]] == ["-", "-", "-"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_what_was_measured_before_a_signal_is_kept(number, capsys, monkeypatch, tmp_path):
    """It ends between two steps of the second episode, and the film can be played."""
    steps, step = [], command.RelmmRoomEnv.step

    def interrupted(env, action):
        steps.append(action)
        if len(steps) == 5:
            signal.raise_signal(number)
        return step(env, action)

    monkeypatch.setattr(command.RelmmRoomEnv, "step", interrupted)
    arguments = ["--policy.type=relmm_random", "--env.navigation_steps=2", "--eval.n_episodes=9", "--eval.n_videos=9"]
    monkeypatch.setattr(sys, "argv", ["relmm-eval", *arguments, f"--output_dir={tmp_path / 'out'}"])
    with pytest.raises(SystemExit) as stopped:
        command.main()
    assert stopped.value.code == 128 + number
    info = json.loads((tmp_path / "out" / "eval_info.json").read_text())
    finished = info["overall"]["n_episodes"]
    assert 1 <= finished == len(info["per_episode"]) < 5
    assert len(steps) == 5
    assert f"collected {info['overall']['mean_share_collected']:.1%}" in capsys.readouterr().out
    with av.open(str(tmp_path / "out" / "videos" / f"eval_episode_{finished}.mp4")) as container:
        assert next(container.decode(video=0)).width == 880


def test_a_terminal_that_is_gone_costs_no_result(tmp_path):
    """As when a window is closed, or a connection is lost: the terminal answers EIO to whatever is written."""
    ours, theirs = pty.openpty()
    options = ["--policy.type=relmm_random", "--env.navigation_steps=2", "--eval.n_episodes=2", "--eval.n_videos=0"]
    script = [sys.executable, "-m", "relmm.commands.evaluate", *options, f"--output_dir={tmp_path / 'out'}"]
    process = subprocess.Popen(script, stdin=theirs, stdout=theirs, stderr=theirs)
    os.close(theirs)
    os.close(ours)
    assert process.wait(300) == 0
    assert json.loads((tmp_path / "out" / "eval_info.json").read_text())["overall"]["n_episodes"] == 2


def test_evaluate_interrupted_says_so(capsys, monkeypatch, tmp_path):
    def interrupted(config):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "evaluate", interrupted)
    arguments = ["relmm-eval", "--policy.type=relmm_random", f"--output_dir={tmp_path / 'out'}"]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit) as stop:
        command.main()
    assert stop.value.code == 130
    assert capsys.readouterr().err == "relmm-eval: interrupted.\n"


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ("--env.room=no_such_room", "no_obstacles"),
        ("--env.navigation_steps=0", "must be at least 1"),
        ("--eval.n_episodes=0", "must be at least 1"),
        ("--eval.n_videos=-1", "must be at least 0"),
        ("--env.type=pusht", "relmm_room"),
        ("--env.camera=d435", "say --env.camera=paper, or --policy.camera=d435"),
        ("--policy.path=/nowhere/at/all", "No policy can be loaded from '/nowhere/at/all'"),
    ],
)
def test_evaluate_bad_input_is_one_sentence(capsys, monkeypatch, tmp_path, bad, message):
    policy = () if bad.startswith("--policy") else ("--policy.type=relmm_scripted",)
    monkeypatch.setattr(sys, "argv", ["relmm-eval", *policy, f"--output_dir={tmp_path / 'out'}", bad])
    with pytest.raises(SystemExit) as stop:
        command.main()
    errors = capsys.readouterr().err.strip()
    assert stop.value.code == 2
    assert message in errors
    assert "\n" not in errors
    assert not (tmp_path / "out").exists()


def test_evaluate_existing_output_is_refused(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "argv", ["relmm-eval", "--policy.type=relmm_random", f"--output_dir={tmp_path}"])
    with pytest.raises(SystemExit):
        command.main()
    assert "exists already" in capsys.readouterr().err
