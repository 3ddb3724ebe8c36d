"""A command outlives its terminal, and a pipe that nobody reads."""

import json
import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from relmm.commands.cli import StopOnSignal

COMMANDS = Path(sys.executable).parent
EVALUATE = ("relmm-eval", "--policy.type=relmm_random", "--eval.n_videos=0", "--output_dir=out")


def begin(folder, *arguments, **options):
    command = [str(COMMANDS / arguments[0]), *arguments[1:]]
    return subprocess.Popen(command, cwd=folder, stdin=subprocess.DEVNULL, start_new_session=True, **options)


def wait_for(path, seconds=100):
    end = time.monotonic() + seconds
    while not path.exists() and time.monotonic() < end:
        time.sleep(0.1)
    assert path.exists()


def episodes(folder):
    return json.loads((folder / "out/eval_info.json").read_text())["overall"]["n_episodes"]


def test_an_evaluation_outlives_its_terminal(tmp_path):
    ours, theirs = pty.openpty()
    process = begin(
        tmp_path, *EVALUATE, "--env.navigation_steps=8", "--eval.n_episodes=2", stdout=theirs, stderr=theirs
    )
    os.close(theirs)
    first = b""
    while not first.endswith(b"\n"):
        first += os.read(ours, 1)
    os.close(ours)  # every word that follows fails with EIO
    assert first == b"relmm-eval: loading\r\n", "said at once, before the imports"
    assert process.wait(100) == 0
    assert episodes(tmp_path) == 2


@pytest.mark.slow
def test_an_evaluation_outlives_the_pipe_that_it_tells_of_itself(tmp_path):
    reader, writer = os.pipe()
    os.close(reader)
    process = begin(
        tmp_path, *EVALUATE, "--env.navigation_steps=3", "--eval.n_episodes=1", stdout=writer, stderr=writer
    )
    os.close(writer)
    assert process.wait(100) == 0
    assert episodes(tmp_path) == 1


@pytest.mark.parametrize("number", [pytest.param(signal.SIGHUP, marks=pytest.mark.slow), signal.SIGINT])
def test_a_stopped_evaluation_keeps_what_it_has_measured(tmp_path, number):
    process = begin(
        tmp_path, *EVALUATE, "--env.navigation_steps=8", "--eval.n_episodes=1000", stdout=-1, stderr=-1, text=True
    )
    wait_for(tmp_path / "out/eval_info.json")
    assert episodes(tmp_path) >= 1, "results are there while it goes on"
    process.send_signal(number)
    output, errors = process.communicate(timeout=30)
    assert process.returncode == 128 + number, errors
    assert f"stopped after {episodes(tmp_path)} of 1000 episodes" in output
    assert "Traceback" not in errors


def test_a_hangup_comes_twice_and_ends_nothing():
    with StopOnSignal() as signals:
        os.kill(os.getpid(), signal.SIGHUP)
        os.kill(os.getpid(), signal.SIGHUP)
        assert signals.number == signal.SIGHUP
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


def test_what_nohup_ignores_stays_ignored(monkeypatch):
    previous = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopOnSignal() as signals:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not signals.stopped
    finally:
        signal.signal(signal.SIGHUP, previous)
