"""Commands as people type them, on an emulated LoCoBot: those of docs/locobot.md, and LeRobot's own."""

from __future__ import annotations

import math
import os
import pty
import re
import select
import shlex
import subprocess
import time
from pathlib import Path

import pyarrow.parquet as pq
import pytest

pytest.importorskip("serial", reason="pyserial is not installed (the extra `hardware`)")
pytest.importorskip("dynamixel_sdk", reason="dynamixel-sdk is not installed (the extra `hardware`)")
pytestmark = pytest.mark.slow

from emulated_process import Emulated
from lerobot.scripts import lerobot_find_port
from pty_link import Cable

from relmm.commands.policies import make_actor
from relmm.features import ACTION_NAMES, STATE_NAMES, Phase
from relmm.geometry import CAMERAS
from relmm.policies.scripted.configuration_scripted import RelmmScriptedConfig
from relmm.robot.hardware.calibration import load_calibration

PAGE = Path(__file__).parents[3] / "docs" / "locobot.md"
_MODULES = {
    "relmm-record": "relmm.commands.record",
    "relmm-train": "relmm.commands.train",
    "relmm-doctor": "relmm.commands.doctor",
    "relmm-calibrate": "relmm.commands.calibrate",
    **{f"lerobot-{name}": f"lerobot.scripts.lerobot_{name}" for name in ("teleoperate", "record", "replay", "rollout")},
    "lerobot-calibrate": "lerobot.scripts.lerobot_calibrate",
}
# What makes a command of hours one of a minute.
_SHORTER = {"relmm-train": ["--steps=1", "--policy.num_max=2", "--policy.num_start=1", "--policy.num_stop=1"]}


def commands_of_page() -> list[list[str]]:
    """The words of every relmm or LeRobot command in the page's code blocks."""
    blocks = "\n".join(re.findall(r"```bash\n(.*?)```", PAGE.read_text(), re.DOTALL)).replace("\\\n", " ")
    lines = [shlex.split(line, comments=True) for line in blocks.splitlines()]
    return [words for words in lines if words and words[0] in _MODULES]


def words_on(emulated: Emulated, words: list[str]) -> list[str]:
    """The command on the emulated robot, as the operating system takes it."""
    name, *options = words
    ours = emulated.options if name != "relmm-doctor" else emulated.options[:3]  # which measures nothing
    given = {option.partition("=")[0] for option in ours}
    kept = [option for option in options if option.partition("=")[0] not in given]
    return [*emulated.command(_MODULES[name])[:4], *ours, *kept, *_SHORTER.get(name, [])]


def environment(emulated: Emulated, folder: Path) -> dict[str, str]:
    return {**emulated.environment, "HF_LEROBOT_HOME": str(folder / "cache"), "PYTHONUNBUFFERED": "1"}


def run(emulated: Emulated, folder: Path, *words: str) -> str:
    """Run a command without a person; what it says."""
    done = subprocess.run(
        words_on(emulated, list(words)),
        cwd=folder,
        env=environment(emulated, folder),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=550,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


class Terminal:
    """A command in a terminal, and the person before it.

    Args:
        emulated: the robot.
        folder: where the command runs.
        words: of the command.
    """

    def __init__(self, emulated: Emulated, folder: Path, *words: str) -> None:
        self._keys, slave = pty.openpty()
        self._process = subprocess.Popen(
            words_on(emulated, list(words)),
            cwd=folder,
            env=environment(emulated, folder),
            stdin=slave,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        os.close(slave)
        os.set_blocking(self._process.stdout.fileno(), False)
        self.said = ""

    def expect(self, words: str, seconds: float = 200) -> str:
        """Wait until it says something; all that it has said up to there, which then counts as read."""
        until = time.monotonic() + seconds
        while words not in self.said:
            assert time.monotonic() < until, self.said
            self._read()
        before, _, self.said = self.said.partition(words)
        return before

    def type(self, keys: str) -> None:
        os.write(self._keys, keys.encode())

    def end(self) -> str:
        """Wait for its end; what it has said since."""
        until = time.monotonic() + 200
        while self._process.poll() is None:
            assert time.monotonic() < until, self.said
            self._read()
        self._read()
        assert self._process.returncode == 0, self.said
        return self.said

    def _read(self) -> None:
        select.select([self._process.stdout], [], [], 0.1)
        self.said += (self._process.stdout.read() or b"").decode()

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        self._process.stdout.close()
        os.close(self._keys)


# --- The page ------------------------------------------------------------------------------------------------
ALONE = [words for words in commands_of_page() if "calibrate" not in words[0] and "keyboard" not in " ".join(words)]


def test_page_has_the_commands_that_it_should():
    names = [words[0] for words in commands_of_page()]
    assert {"relmm-doctor", "relmm-record", "relmm-calibrate", "relmm-train", "lerobot-teleoperate"} <= set(names)


@pytest.mark.parametrize("words", ALONE, ids=lambda words: " ".join(words)[:60])
def test_command_of_the_page(emulate, tmp_path, words):
    said = run(emulate(), tmp_path, *words)
    if "--robot.dry_run=true" in words:
        assert "would drive at" in said
    if words[0] == "relmm-doctor":
        assert "FAIL" not in said


@pytest.mark.parametrize("name", ["relmm-calibrate", "lerobot-calibrate"])
def test_person_is_guided_through_a_calibration(emulate, tmp_path, name):
    emulated = emulate(num_objects=1, wheel_scale=1.03, waist=2.0, camera_pitch=1.0)
    emulated.order("put", -0.6, 0.0)
    orders = {
        "onto empty floor": ("carry", 0.0, 0.0, 0.0),
        "in front of a wall": ("carry", 0.9, 0.0, 0.0),
        "Put a small sticker": ("stick",),
        "Take the sticker away": ("put", -0.6, 0.0),
    }
    with Terminal(emulated, tmp_path, name, "--robot.id=mine") as terminal:
        for _ in range(5 + 2 * 5):
            asked = terminal.expect("then press Enter.").splitlines()[-1]
            for words, order in orders.items():
                if words in asked:
                    emulated.order(*order)
            terminal.type("\n")
        terminal.expect("saved in")
        terminal.end()
    found = load_calibration(emulated.folder / "calibration" / "mine.json")
    assert found.wheel_scale == pytest.approx(1.03, abs=0.01)
    assert found.camera_pitch == pytest.approx(CAMERAS["d435"].pitch + 1.0, abs=0.2)
    assert found.grasp[0][1] == pytest.approx(math.sin(math.radians(2.0)), abs=0.02)


def test_person_takes_over_in_training(emulate, tmp_path):
    (words,) = (w for w in commands_of_page() if w[0] == "relmm-train" and "keyboard" in " ".join(w))
    with Terminal(emulate(), tmp_path, *words) as terminal:
        terminal.expect("t takes over")
        terminal.type("t")
        terminal.expect("You have taken over")
        terminal.type("w")
        time.sleep(8)
        terminal.type("5")
        time.sleep(8)
        terminal.type("t")
        terminal.expect("The robot goes on by itself.")
        terminal.end()
    folder = next(option.partition("=")[2] for option in words if option.startswith("--output_dir"))
    table = pq.read_table(tmp_path / folder / "dataset" / "data")
    assert Phase.TELEOPERATION in table["complementary_info.phase"].to_pylist()


# --- LeRobot's own -------------------------------------------------------------------------------------------
def test_person_drives_with_lerobot_teleoperate(emulate, tmp_path):
    (words,) = (words for words in commands_of_page() if words[0] == "lerobot-teleoperate")
    emulated = emulate()
    before = emulated.order("stands")
    with Terminal(emulated, tmp_path, *words, "--teleop_time_s=15") as terminal:
        terminal.expect("Teleop loop time")
        terminal.type("w")
        terminal.end()
    after = emulated.order("stands")
    assert math.dist(before[:2], after[:2]) == pytest.approx(0.106, abs=0.03)


def test_lerobot_record_and_replay(emulate, tmp_path):
    dataset = ["--dataset.repo_id=me/room", "--dataset.root=room", "--play_sounds=false"]
    teleop = ["--teleop.type=locobot_scripted", "--teleop.camera=d435"]
    times = ["--dataset.num_episodes=1", "--dataset.episode_time_s=10", "--dataset.reset_time_s=0", "--dataset.fps=2"]
    task = ["--dataset.single_task=Clean the room", "--dataset.push_to_hub=false"]
    run(emulate(), tmp_path, "lerobot-record", *teleop, *dataset, *times, *task)
    table = pq.read_table(tmp_path / "room" / "data")
    assert len(table) > 0
    assert len(table["action"][0]) == len(ACTION_NAMES)
    assert len(table["observation.state"][0]) == len(STATE_NAMES)
    emulated = emulate()
    before = emulated.order("stands")
    run(emulated, tmp_path, "lerobot-replay", *dataset, "--dataset.episode=0")
    assert math.dist(before, emulated.order("stands")) > 0.01


def test_lerobot_rollout(emulate, tmp_path):
    make_actor(RelmmScriptedConfig(device="cpu", camera="d435")).save_pretrained(tmp_path / "policy")
    options = ["--policy.path=policy", "--strategy.type=base", "--duration=5", "--fps=2", "--task=Clean the room"]
    assert "Rollout finished" in run(emulate(), tmp_path, "lerobot-rollout", *options)


def test_lerobot_find_port_tells_which_is_which(tmp_path, monkeypatch, capsys):
    base, arm = Cable(tmp_path / "ttyUSB0"), Cable(tmp_path / "ttyUSB1")
    monkeypatch.setattr(lerobot_find_port, "Path", lambda folder: tmp_path if folder == "/dev" else Path(folder))
    monkeypatch.setattr("builtins.input", arm.unplug)
    lerobot_find_port.find_port()
    assert f"The port of this MotorsBus is '{tmp_path}/ttyUSB1'" in capsys.readouterr().out
    base.close()
