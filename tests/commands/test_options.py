"""`--help_all`, and what a typo is answered with."""

import contextlib
import sys

import pytest

from relmm.commands import evaluate, record, train, upload
from relmm.commands.policies import make_actor
from relmm.policies.relmm.configuration_relmm import ReLMMConfig

COMMANDS = {"relmm-train": train, "relmm-eval": evaluate, "relmm-record": record, "relmm-upload": upload}


@pytest.fixture
def answer(monkeypatch, capsys):
    """What a command prints when it is asked for help, or for what it cannot do."""

    def call(command, *words):
        monkeypatch.setattr(sys, "argv", [command, *words])
        with contextlib.suppress(SystemExit):
            COMMANDS[command].main()
        output = capsys.readouterr()
        return output.out + output.err

    return call


def test_all_options_are_listed_with_defaults_and_words_but_no_comments(answer):
    listing = answer("relmm-train", "--help_all")
    for line in (
        "  --steps=2000                            navigation steps to train for, those of earlier runs included.",
        "  --robot.room=no_obstacles               name of a registered room.",
        "  --robot.id                              tells robots of one type apart",
        "  --resume=false                          go on with the run in `output_dir`.",
        "  --policy.num_members=6                  networks in the grasp ensemble (M of the paper).",
    ):
        assert line in listing.splitlines()
    assert "__post_init__" not in listing
    assert max(map(len, listing.splitlines())) <= 120


def test_only_the_chosen_type_is_listed(answer):
    both, one = answer("relmm-train", "--help_all"), answer("relmm-train", "--help_all", "--policy.type", "relmm_paper")
    assert "--policy.num_max=100 " in both
    assert "--policy.num_max=100 " not in one
    assert "--policy.navigation_encoder" in one


@pytest.mark.parametrize("command", COMMANDS)
def test_no_type_is_offered_that_fails(answer, command):
    listing = answer(command, "--help_all")
    assert "smolvla" not in listing
    assert "pusht" not in listing
    assert ("relmm_scripted" in listing) == (command in ("relmm-eval", "relmm-record"))


@pytest.mark.parametrize(
    ("command", "word", "likely"),
    [
        ("relmm-train", "--robot.tpye=locobot_sim", "--robot.type"),
        ("relmm-train", "--robot.type=locobt_sim", "locobot_sim"),
        ("relmm-train", "--policy.type=relm", "relmm"),
        ("relmm-train", "--stpes=3", "--steps"),
        ("relmm-train", "--config_path=papr", "paper"),
        ("relmm-train", "--curriculum.type=stationery", "stationary"),
        ("relmm-eval", "--env.room=obstackles", "obstacles"),
        ("relmm-eval", "--env.camera=papr", "paper"),
        ("relmm-record", "--dataset.num_epsodes=3", "--dataset.num_episodes"),
        ("relmm-upload", "--polcy.repo_id=a/b", "--policy.repo_id"),
    ],
)
def test_a_typo_gets_a_suggestion_in_one_sentence(answer, command, word, likely):
    words = answer(command, word)
    assert f"(did you mean {likely}?)" in words
    assert words.startswith(f"{command}: ")
    assert words.count("\n") == 1


def test_a_typo_in_a_setting_of_a_loaded_policy_is_told_as_typed(answer, tmp_path):
    make_actor(ReLMMConfig(device="cpu")).save_pretrained(tmp_path / "policy")
    words = answer("relmm-eval", f"--policy.path={tmp_path / 'policy'}", "--policy.num_gras=3")
    assert words.startswith("relmm-eval: There is no option --policy.num_gras=3 (did you mean --policy.num_grasp?)")
