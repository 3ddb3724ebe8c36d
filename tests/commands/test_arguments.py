"""Every spelling of an option that LeRobot's parser takes means the same to relmm."""

import json
import sys

import pytest

from relmm.commands import train
from relmm.commands.arguments import Arguments
from relmm.commands.policy_type import choose_policy
from relmm.commands.presets import preset_path, resolve_config_path


def test_every_spelling_becomes_one():
    words = ["--resume", "True", "--output_dir", "a b", "--seed=1", "--seed", "-2", "--policy.tags=[a=b]", "stray"]
    arguments = Arguments(words)
    assert arguments.words == ["--resume=True", "--output_dir=a b", "--seed=-2", "--policy.tags=[a=b]", "stray"]
    assert Arguments(arguments.words).words == arguments.words
    assert arguments.get("policy.tags") == "[a=b]"
    assert arguments.get("steps") is None


@pytest.mark.parametrize(("value", "means"), [("true", 1), ("True", 1), ("TRUE", 1), ("false", 0), ("1", 0), ("no", 0)])
def test_what_is_true_is_what_the_parser_takes_for_true(value, means):
    assert Arguments([f"--resume={value}"]).is_true("resume") == means
    assert Arguments(["--resume", value]).is_true("resume") == means


@pytest.mark.parametrize("words", [["--help"], ["-h"], ["--robot.type", "-h"], ["--steps", "--help"]])
def test_help_is_no_value(words):
    assert Arguments(words).asks_for_help


def test_an_option_without_value_is_left_to_the_parser():
    arguments = Arguments(["--resume", "--steps=3"])
    assert arguments.words == ["--resume", "--steps=3"]
    assert arguments.get("resume") is None


@pytest.mark.parametrize(
    "spelling", ["--config_path paper", "--config_path=paper", "--config_path=x --config_path paper"]
)
def test_a_preset_is_found_in_every_spelling(spelling):
    arguments = Arguments(spelling.split())
    resolve_config_path(arguments)
    choose_policy(arguments)
    assert arguments.words == [f"--config_path={preset_path('paper')}"]


SPELLINGS = (
    ("--resume=true", "--output_dir={0}"),
    ("--resume=True", "--output_dir={0}"),
    ("--resume", "true", "--output_dir", "{0}"),
    ("--resume=false", "--output_dir", "{0}", "--resume", "TRUE"),
)


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_a_run_is_resumed_with_its_own_settings_in_every_spelling(monkeypatch, tmp_path, spelling):
    stored = tmp_path / "run" / "checkpoints" / "000077" / "pretrained_model"
    stored.mkdir(parents=True)
    (tmp_path / "run" / "checkpoints" / "last").symlink_to("000077")
    settings = {"robot": {"type": "locobot_sim"}, "policy": {"type": "relmm_paper"}, "steps": 77, "resume": False}
    (stored / "train_config.json").write_text(json.dumps(settings))
    configs = []
    monkeypatch.setattr(train, "train", configs.append)
    words = [word.format(tmp_path / "run") for word in spelling]
    monkeypatch.setattr(sys, "argv", ["relmm-train", *words, "--policy.device", "cpu"])
    train.main()
    (config,) = configs
    assert (config.resume, config.steps, config.policy.type) == (True, 77, "relmm_paper")
