"""What the commands say when asked for help."""

import re
import subprocess
import sys
from dataclasses import MISSING, fields

import pytest

from relmm.commands.evaluate import EvalConfig
from relmm.commands.record import RecordConfig
from relmm.commands.start import SHORT_HELP
from relmm.commands.train_config import TrainConfig

FUNCTIONS = {
    "relmm-train": "train",
    "relmm-eval": "evaluate",
    "relmm-record": "record",
    "relmm-analyze": "analyze",
    "relmm-calibrate": "calibrate",
    "relmm-upload": "upload",
    "relmm-serve": "serve",
}
CONFIGS = {TrainConfig: "relmm-train", EvalConfig: "relmm-eval", RecordConfig: "relmm-record"}
KINDS = {
    "relmm-train": ("--policy.type=relmm", "--robot.type=locobot_sim"),
    "relmm-eval": ("--policy.type=relmm", "--env.type=relmm_room"),
    "relmm-record": ("--policy.type=relmm", "--robot.type=locobot_sim"),
    "relmm-analyze": ("--policy.type=relmm",),
    "relmm-calibrate": ("--robot.type=locobot",),
    "relmm-upload": (),
    "relmm-serve": (),
}


@pytest.mark.parametrize("command", SHORT_HELP)
def test_help_loads_nothing_heavy(command):
    code = (
        f"import sys; from relmm.commands import start; sys.argv = ['{command}', '--help']; "
        f"start.{FUNCTIONS[command]}(); assert not {{'torch', 'lerobot', 'mujoco', 'draccus'}} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert SHORT_HELP[command] in done.stdout
    assert f"{command} --help_all" in done.stdout


@pytest.mark.parametrize("command", SHORT_HELP)
def test_help_names_options_that_exist(run, command):
    done = run(command, *KINDS[command], "--help_all", COLUMNS="200")
    assert done.returncode == 0, done.stderr
    known = set(re.findall(r"--[a-z_.]+", done.stdout)) | {"--policy.path", "--help_all"}
    named = set(re.findall(r"--[a-z_.]+", SHORT_HELP[command]))
    assert named <= known


@pytest.mark.parametrize(("config", "command"), CONFIGS.items())
def test_help_names_defaults_that_hold(config, command):
    named = re.findall(r"^  --(?!env)([a-z_.]+)=(\d+) ", SHORT_HELP[command], re.MULTILINE)
    assert named
    for option, value in named:
        default = config
        for name in option.split("."):
            field = {field.name: field for field in fields(default)}[name]
            default = field.default if field.default is not MISSING else field.default_factory()
        assert default == int(value), option


def test_help_in_a_pipe_that_is_closed_early():
    done = subprocess.run(
        f"{sys.executable} -c 'from relmm.commands.start import train; train()' --help | true; exit ${{PIPESTATUS[0]}}",
        shell=True,
        executable="/bin/bash",
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
