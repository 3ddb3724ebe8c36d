"""Several rooms beside one learner: started, started again, and ended."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from relmm.commands import rooms as module
from relmm.commands.rooms import Rooms
from relmm.episodes import saved_episodes, verify_and_repair
from relmm.errors import ConfigError, FleetError
from relmm.learning.progress import read_metrics

# Stands for a recorder: says that it has begun, records an episode if it is told to, and ends as it is told to.
RECORDER = """
import json, pathlib, sys
root = pathlib.Path([a for a in sys.argv if a.startswith("--config_path=")][0][14:-5])
(root / "meta").mkdir(parents=True, exist_ok=True)
(root / "meta/relmm.json").write_text("{}")
with open(root / "starts", "a") as starts:
    starts.write(" ".join(sys.argv) + "\\n")
if "--records" in sys.argv:
    info = root / "meta/info.json"
    count = json.loads(info.read_text())["total_episodes"] + 1 if info.exists() else 1
    info.write_text(json.dumps({"total_episodes": count}))
print("words", flush=True)
print("last words", flush=True)
if "--stays" in sys.argv:
    sys.stdin.buffer.read()
    (root / "saved").write_text("")
sys.exit(3)
"""


@pytest.fixture
def rooms(tmp_path, monkeypatch):
    """Two rooms of recorders that do what the options say."""
    script = tmp_path / "recorder.py"
    script.write_text(RECORDER)
    monkeypatch.setattr(module, "_COMMAND", (sys.executable, str(script)))
    monkeypatch.setattr(module, "_LONGEST_PAUSE_S", 0.0)

    def start(*options, count=2):
        return Rooms(tmp_path / "rooms", {"type": "locobot_sim"}, tmp_path / "last", count, 7, list(options))

    return start


def watch(rooms, until, said=None):
    deadline = time.monotonic() + 30
    while not until():
        assert time.monotonic() < deadline
        rooms.watch((said if said is not None else []).append)
        time.sleep(0.02)


def starts(tmp_path, room="room_00"):
    path = tmp_path / "rooms" / room / "starts"
    return path.read_text().splitlines() if path.exists() else []


def test_each_room_has_its_own_dataset_and_seed_and_ends_when_it_is_asked_to(rooms, tmp_path):
    with rooms("--stays") as running:
        watch(running, lambda: starts(tmp_path) and starts(tmp_path, "room_01"))
    settings = [json.loads((tmp_path / "rooms" / f"room_0{n}.json").read_text()) for n in range(2)]
    assert len({each["seed"] for each in settings}) == len({each["dataset"]["root"] for each in settings}) == 2
    assert all((tmp_path / "rooms" / f"room_0{n}" / "saved").exists() for n in range(2))
    assert "--resume=false" in starts(tmp_path)[0]
    with rooms("--stays") as running:
        watch(running, lambda: len(starts(tmp_path)) == 2 and len(starts(tmp_path, "room_01")) == 2)
    assert "--resume=true" in starts(tmp_path)[1]


def test_a_room_that_ends_is_started_again_and_resumed(rooms, tmp_path):
    said = []
    with rooms("--records", count=1) as running:
        watch(running, lambda: len(starts(tmp_path)) == 4, said)
    assert "room_00 has ended (exit code 3: last words); it starts again" in said
    assert str(running).startswith("1 rooms, 3 restarts")
    assert ["--resume=true" in start for start in starts(tmp_path)] == [False, True, True, True]


def test_a_room_that_ends_again_and_again_without_an_episode_ends_the_run(rooms, tmp_path):
    with rooms(count=1) as running, pytest.raises(FleetError, match="3 times in a row without a new episode; see "):
        watch(running, lambda: False)
    assert len(starts(tmp_path)) == 3


def test_a_room_that_does_not_end_is_killed(rooms, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_SAVING_S", 0.0)
    script = tmp_path / "recorder.py"
    script.write_text(RECORDER.replace("sys.stdin.buffer.read()", "import time; time.sleep(1000)"))
    with rooms("--stays", count=1) as running:
        watch(running, lambda: starts(tmp_path))
        (process,) = (child for child in psutil.Process().children() if str(script) in child.cmdline())
    assert not process.is_running()


def test_rooms_are_for_simulated_robots_and_have_their_own_datasets(tmp_path):
    from relmm.commands.train_config import TrainConfig, TrainDatasetConfig, TrainFleetConfig
    from relmm.robot.hardware.config_locobot import LocobotConfig
    from relmm.sim.config_locobot_sim import LocobotSimConfig

    fleet, folder = TrainFleetConfig(rooms=2), tmp_path / "run"
    with pytest.raises(ConfigError, match="only a simulated robot can be in several rooms"):
        TrainConfig(robot=LocobotConfig(), fleet=fleet, output_dir=folder)
    with pytest.raises(ConfigError, match=r"leave out --dataset.root"):
        TrainConfig(robot=LocobotSimConfig(), fleet=fleet, dataset=TrainDatasetConfig(root=tmp_path), output_dir=folder)
    assert TrainConfig(robot=LocobotSimConfig(), fleet=fleet, output_dir=folder).followed == [folder / "rooms"]


# --- The real thing ------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_rooms_and_learner_survive_kills_and_end_cleanly(tmp_path, tiny):
    run = tmp_path / "run"
    command = [sys.executable, "-m", "relmm.commands.train", f"--output_dir={run}"]
    options = [*tiny, "--fleet.rooms=2", "--max_steps=4", "--steps=100000"]
    roots = [run / "rooms" / f"room_0{n}" for n in range(2)]

    def start(*arguments):
        with (tmp_path / "log").open("ab") as log:
            return subprocess.Popen([*command, *arguments], stdout=log, stderr=log)

    def wait_for(condition):
        deadline = time.monotonic() + 300
        while not condition():
            assert learner.poll() is None, (tmp_path / "log").read_text()
            assert time.monotonic() < deadline
            time.sleep(0.2)

    def recorders():
        found = psutil.Process(learner.pid).children()
        return [each for each in found if "relmm.commands.room" in each.cmdline()]

    learner = start(*options)
    wait_for(lambda: all(saved_episodes(root) for root in roots))
    before = [saved_episodes(root) for root in roots]
    recorders()[0].kill()
    wait_for(lambda: all(saved_episodes(root) > had for root, had in zip(roots, before, strict=True)))
    left = recorders()
    learner.kill()
    learner.wait()
    psutil.wait_procs(left, timeout=100)
    assert not any(each.is_running() for each in left), "rooms end when the learner is gone"
    assert all(not verify_and_repair(root).problems for root in roots), "nothing is cut off"
    had = [saved_episodes(root) for root in roots]

    learner = start("--resume=true", "--policy.device=cpu")
    wait_for(lambda: all(saved_episodes(root) > number for root, number in zip(roots, had, strict=True)))
    os.kill(learner.pid, signal.SIGINT)
    assert learner.wait(200) == 0, (tmp_path / "log").read_text()
    state = json.loads((run / "checkpoints/last/training_state/relmm_state.json").read_text())
    learned = {Path(source["name"]).name: source["episodes"] for source in state["sources"]}
    saved = {root.name: saved_episodes(root) for root in roots}
    assert all(had[n] <= learned[root.name] <= saved[root.name] for n, root in enumerate(roots))
    metrics = read_metrics(run / "metrics.jsonl")
    assert any("weights_age" in line for line in metrics)
    assert metrics[-1]["practice_attempts"] >= 6
