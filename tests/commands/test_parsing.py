"""Command lines and files of settings that cannot work are refused in one sentence, before anything happens."""

import sys

import pytest

from relmm.commands import evaluate, record, train, upload

HUGE = str(10**23)
TRAIN = (train.main, "--robot.type=locobot_sim", "--output_dir={folder}/out")
EVALUATE = (evaluate.main, "--policy.type=relmm_random", "--output_dir={folder}/out")
RECORD = (record.main, "--robot.type=locobot_sim", "--policy.type=relmm_random", "--dataset.repo_id=me/x")
UPLOAD = (upload.main, "--output_dir={folder}/out")


@pytest.fixture
def refused(monkeypatch, capsys, tmp_path):
    """The one sentence that a command ends in."""

    def call(command, *arguments):
        main, *usual = command
        monkeypatch.setattr(sys, "argv", ["command", *(a.format(folder=tmp_path) for a in usual), *arguments])
        with pytest.raises(SystemExit) as stop:
            main()
        lines = capsys.readouterr().err.strip().splitlines()
        assert stop.value.code == 2, lines
        assert len(lines) == 1, lines
        assert not (tmp_path / "out").exists()
        return lines[0]

    return call


@pytest.mark.parametrize(
    ("command", "argument", "words"),
    [
        (TRAIN, f"--seed={HUGE}", "seed is 1000"),
        (TRAIN, f"--eval.seed={HUGE}", "eval.seed is 1000"),
        (TRAIN, f"--policy.seed={HUGE}", "policy.seed is 1000"),
        (TRAIN, "--robot.seed=-1", "robot.seed is -1, but must be at least 0 and at most 4,294,967,295."),
        (TRAIN, f"--policy.batch_size={HUGE}", "policy.batch_size is 1000"),
        (TRAIN, "--policy.learning_rate=nan", "policy.learning_rate is nan"),
        (TRAIN, "--policy.learning_rate=1e30", "policy.learning_rate is 1e+30"),
        (TRAIN, "--num_threads=100000", "num_threads is 100000, but must be at least 1 and at most 256."),
        (TRAIN, f"--replay_frames={HUGE}", "replay_frames is 1000"),
        (TRAIN, f"--steps={HUGE}", "steps is 1000"),
        (TRAIN, f"--max_steps={HUGE}", "max_steps is 1000"),
        (TRAIN, f"--hub.every={HUGE}", "hub.every is 1000"),
        (TRAIN, f"--robot.num_objects={HUGE}", "num_objects is 1000"),
        (TRAIN, "--steps=" + "9" * 5000, "relmm-train: "),
        (EVALUATE, f"--seed={HUGE}", "seed is 1000"),
        (EVALUATE, f"--env.navigation_steps={HUGE}", "env.navigation_steps is 1000"),
        (EVALUATE, f"--eval.n_episodes={HUGE}", "eval.n_episodes is 1000"),
        (RECORD, f"--dataset.num_episodes={HUGE}", "dataset.num_episodes is 1000"),
        (RECORD, f"--policy.num_grasp={HUGE}", "policy.num_grasp is 1000"),
        (RECORD, "--robot.discover_packages_path=no.such.package", "no.such.package"),
        (UPLOAD, "--policy.repo_id=../x", "cannot name a dataset"),
    ],
)
def test_numbers_out_of_range(refused, command, argument, words):
    assert words in refused(command, argument)


@pytest.mark.parametrize("name", ["settings.json", "settings.yaml"])
@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[" * 100_000,
        b"\xff\xfe\x00",
        b"[]",
        b"1",
        b'{"policy": 3}',
        b'{"policy": {"type": "os.system"}}',
        b"{",
        b"a: b: c",
    ],
)
def test_broken_files_of_settings(refused, tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    for command in (TRAIN, EVALUATE, RECORD):
        refused(command, f"--config_path={tmp_path / name}", "--sudo=true")
