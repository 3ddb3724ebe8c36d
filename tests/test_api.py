"""What `import relmm` offers, as a user's own script uses it; and the scripts and the package in examples/."""

import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import relmm
from relmm.errors import ConfigError, DatasetError

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
SAMPLE = ROOT / "datasets" / "first_attempts"


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """A policy that has learned nothing."""
    from relmm.commands.policies import make_actor
    from relmm.policies.relmm.configuration_relmm import ReLMMConfig

    folder = tmp_path_factory.mktemp("policy") / "pretrained_model"
    make_actor(ReLMMConfig(device="cpu")).save_pretrained(folder)
    return folder


def example(monkeypatch, name, *arguments):
    monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")


def test_importing_relmm_loads_nothing_and_registers_nothing():
    code = "import sys, relmm; print(*relmm.__all__); assert not {'lerobot', 'torch', 'numpy'} & set(sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["load_grasps", "load_policy", "make_env", "make_robot"]


def test_what_is_not_there():
    with pytest.raises(AttributeError, match="no attribute 'load_world'"):
        relmm.load_world  # noqa: B018
    with pytest.raises(ConfigError, match="no robot 'aloha': make_robot takes locobot_sim or locobot"):
        relmm.make_robot("aloha")
    with pytest.raises(ConfigError, match="ball_pit"):
        relmm.make_robot(room="ball_pit")
    with pytest.raises(ConfigError, match="nowhere"):
        relmm.load_policy("nowhere at all")
    with pytest.raises(DatasetError, match="nowhere"):
        relmm.load_grasps("nowhere at all")


def test_a_policy_with_another_setting(checkpoint):
    assert relmm.load_policy(checkpoint, std_weight=0.25).policy.config.std_weight == 0.25


@pytest.mark.parametrize("standard", [False, True])
def test_a_room(standard):
    env = relmm.make_env(standard=standard, navigation_steps=2, num_objects=3)
    observation, _ = env.reset(seed=0)
    assert set(observation) == ({"front", "state"} if standard else {"pixels", "agent_pos"})
    assert env.unwrapped.navigation_steps == 2
    env.close()


def test_a_policy_cleans_a_room(checkpoint, monkeypatch, capsys):
    example(monkeypatch, "clean_a_room.py", checkpoint, 3)
    assert len(capsys.readouterr().out.splitlines()) >= 3


def test_grasps_by_colour(monkeypatch, capsys):
    grasps = relmm.load_grasps(SAMPLE)
    example(monkeypatch, "grasps_by_colour.py", SAMPLE)
    lines = capsys.readouterr().out.splitlines()[2:]
    assert sum(int(line.split()[1]) for line in lines) == len(grasps)
    assert {line.split()[0] for line in lines} == set(grasps["colour"])


def test_grasps_beside_what_a_policy_expects_of_them(checkpoint):
    grasps = relmm.load_grasps(SAMPLE, policy=checkpoint)
    assert grasps["policy_mean"].between(0, 1).all()
    assert "policy_mean" not in relmm.load_grasps(SAMPLE)


@pytest.mark.slow
def test_a_package_with_a_room_of_its_own(tmp_path):
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"]
    package = shutil.copytree(EXAMPLES / "own_room", tmp_path / "own_room")  # pip builds where the package lies
    subprocess.run([*pip, "--target", tmp_path / "site", package], check=True, cwd=tmp_path)
    evaluate = [Path(sys.executable).parent / "relmm-eval", "--policy.type=relmm_random", "--env.room=kitchen"]
    done = subprocess.run(
        [*evaluate, "--env.navigation_steps=2", "--eval.n_episodes=1", "--eval.n_videos=0", "--output_dir=out"],
        env={"PYTHONPATH": str(tmp_path / "site"), "HF_HUB_OFFLINE": "1"},
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "eval_info.json").is_file()
