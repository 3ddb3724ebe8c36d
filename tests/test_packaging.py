"""The distribution as a user installs it: its name, its dependencies, its files, its commands."""

import json
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from importlib.metadata import metadata, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
DISTRIBUTION = "lerobot_policy_relmm"
COMMANDS = sorted(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"])

# What each registry must hold once LeRobot has looked for plugins.
REGISTERED = {
    "policy": {"relmm_scripted", "relmm_random"},
    "env": {"relmm_room"},
    "robot": {"locobot", "locobot_sim"},
    "teleop": {"locobot_scripted"},
}
DISCOVER = """
import json
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.robots.config import RobotConfig
from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.utils.import_utils import register_third_party_plugins

register_third_party_plugins()
bases = {"policy": PreTrainedConfig, "env": EnvConfig, "robot": RobotConfig, "teleop": TeleoperatorConfig}
print(json.dumps({kind: sorted(base.get_known_choices()) for kind, base in bases.items()}))
"""


def run(*command: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(part) for part in command], cwd=cwd, capture_output=True, text=True, check=False)


def constraints() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [line for line in lines if not line.startswith("#")]
    malformed = [pin for pin in pins if not re.fullmatch(r"[\w.-]+==[\w.+!]+", pin)]
    assert not malformed, "not of the form name==version"
    return {canonicalize_name(name): version for name, version in (pin.split("==") for pin in pins)}


def test_distribution_name_keeps_its_underscores():
    assert metadata(DISTRIBUTION)["Name"] == DISTRIBUTION


def test_lerobot_discovers_every_part(tmp_path):
    # Run elsewhere: only what is installed counts.
    done = run(sys.executable, "-c", DISCOVER, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    known = json.loads(done.stdout.splitlines()[-1])
    missing = {kind: names - set(known[kind]) for kind, names in REGISTERED.items()}
    assert not any(missing.values()), f"missing: {missing}\n{done.stderr}"


@pytest.mark.parametrize("command", COMMANDS)
def test_command_shows_its_help(command, tmp_path):
    done = run(Path(sysconfig.get_path("scripts")) / command, "--help", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert command in done.stdout


def test_constraints_fit_what_the_package_asks_for():
    pins = constraints()
    for requirement in map(Requirement, requires(DISTRIBUTION) or []):
        if requirement.marker and not requirement.marker.evaluate({"extra": "dev"}):
            continue
        assert pins[canonicalize_name(requirement.name)] in requirement.specifier, requirement


def test_wheel_holds_every_file_of_the_package(tmp_path):
    source = tmp_path / "source"
    shutil.copytree(ROOT / "relmm", source / "relmm", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "LICENSE", "lerobot_policy_relmm.py"):
        shutil.copy(ROOT / name, source)
    wanted = {str(path.relative_to(source)) for path in (source / "relmm").rglob("*") if path.is_file()}

    build = "from setuptools import build_meta; build_meta.build_wheel('..')"
    done = run(sys.executable, "-c", build, cwd=source)
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    assert wanted | {"lerobot_policy_relmm.py"} <= set(zipfile.ZipFile(wheel).namelist())


def test_hugging_face_datasets_is_not_shadowed_in_the_checkout():
    # The folder datasets/ must stay without an __init__.py, or LeRobot would import it instead.
    find = "import importlib.util; print(importlib.util.find_spec('datasets').origin)"
    assert "site-packages" in run(sys.executable, "-c", find, cwd=ROOT).stdout
