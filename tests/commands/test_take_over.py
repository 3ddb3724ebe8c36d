"""A person takes over from a learning robot, types, and gives back: `relmm-train --teleop.type=locobot_keyboard`."""

from __future__ import annotations

import os
import pty
import re
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from relmm.commands import train as module
from relmm.episodes import read_episodes
from relmm.features import MAX_X_VEL, Phase, Skill
from relmm.learning.progress import read_metrics
from relmm.teleoperator.locobot_keyboard import LocobotKeyboard, keypad_place


class WatchedKeyboard(LocobotKeyboard):
    """Tells the typist which keys have been heard, and which have been obeyed."""

    heard = obeyed = 0
    listens = False

    def connect(self, calibrate: bool = True) -> None:
        super().connect(calibrate)
        WatchedKeyboard.listens = True

    def _press(self, key: str) -> None:
        super()._press(key)
        WatchedKeyboard.heard += 1

    def next_action(self) -> dict[str, float] | None:
        action = super().next_action()
        WatchedKeyboard.obeyed += action is not None
        return action


def wait_for(condition: Callable[[], bool]) -> None:
    until = time.monotonic() + 100
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.01)


@pytest.fixture
def typist(monkeypatch):
    """Types keys into the command's terminal, each when the last one has been obeyed."""
    master, slave = pty.openpty()
    monkeypatch.setattr(module, "LocobotKeyboard", WatchedKeyboard)
    WatchedKeyboard.heard = WatchedKeyboard.obeyed = 0
    WatchedKeyboard.listens = False

    def work(keys: str) -> None:
        wait_for(lambda: WatchedKeyboard.listens)  # what is typed before is lost
        for number, key in enumerate(keys, 1):
            os.write(master, key.encode())
            wait_for(lambda number=number: WatchedKeyboard.heard == number)
            actions = len(keys[:number].replace("t", ""))
            wait_for(lambda actions=actions: WatchedKeyboard.obeyed == actions)

    with os.fdopen(slave) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        threads = []

        def begin(keys: str) -> None:
            threads.append(threading.Thread(target=work, args=(keys,)))
            threads[0].start()

        yield begin
        for thread in threads:
            thread.join()
    os.close(master)


@pytest.mark.slow
def test_person_drives_and_grasps_while_the_robot_learns(typist, tmp_path, tiny, monkeypatch, capfd):
    folder = tmp_path / "run"
    options = ["--teleop.type=locobot_keyboard", "--curriculum.type=none", "--steps=2", f"--output_dir={folder}"]
    monkeypatch.setattr("sys.argv", ["relmm-train", *tiny, *options])
    typist("tw5Wt")
    module.main()
    said = capfd.readouterr().out
    assert "t takes over" in said
    assert said.index("You have taken over: w drives forward") < said.index("The robot goes on by itself.")
    episodes = list(read_episodes(folder / "dataset"))
    phases, actions = (np.concatenate([getattr(e, name) for e in episodes]) for name in ("phases", "actions"))
    theirs = actions[phases == Phase.TELEOPERATION]
    assert theirs[:, 2].tolist() == [Skill.NAVIGATE, Skill.GRASP, Skill.NAVIGATE]
    assert theirs[[0, 2], 0] == pytest.approx([MAX_X_VEL, MAX_X_VEL / 4])
    assert theirs[1, 3:] == pytest.approx(keypad_place(5))
    last = read_metrics(folder / "metrics.jsonl")[-1]
    assert (last["steps"], last["interventions"]) == (2, 1), "a person's steps are not the policy's"
    assert last["attempts"] == (actions[:, 2] == Skill.GRASP).sum()


def test_without_a_terminal_nothing_moves_and_nothing_is_written(tmp_path, tiny, monkeypatch, capsys):
    options = ["--teleop.type=locobot_keyboard", f"--output_dir={tmp_path / 'run'}"]
    monkeypatch.setattr("sys.argv", ["relmm-train", *tiny, *options])
    with open(os.devnull) as nothing:
        monkeypatch.setattr("sys.stdin", nothing)
        with pytest.raises(SystemExit):
            module.main()
    assert "start the command in a terminal" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--robot.type=locobot_sim", "--teleop.type=keyboard"], "teleop.type is 'keyboard'.*locobot_keyboard"),
        (["--dataset.follow=x", "--teleop.type=locobot_keyboard"], "leave it out with --dataset.follow"),
    ],
)
def test_teleoperator_that_cannot_take_over_is_refused(monkeypatch, capsys, options, words):
    monkeypatch.setattr("sys.argv", ["relmm-train", *options])
    with pytest.raises(SystemExit):
        module.main()
    assert re.search(words, capsys.readouterr().err)
