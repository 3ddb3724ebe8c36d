"""Every saved episode survives SIGKILL at every step of a save."""

import contextlib
import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from episode_children import (
    die_after_renames,
    die_in_first_save,
    fill_limited_files,
    record_until_killed,
)
from episode_helpers import REPO_ID, TASK, arguments, check_dataset, length_of, load, new_dataset, record

from relmm.episodes import DurableDataset, EpisodeRecorder, summarize
from relmm.errors import DatasetError

PROJECT = Path(__file__).parents[2]


def run(forkserver, function, *arguments):
    process = forkserver.Process(target=function, args=arguments)
    process.start()
    process.join()
    return process.exitcode


# An episode of a known task is published by four renames: data, meta/episodes, stats, info.
@pytest.mark.parametrize(("done", "whole"), [(0, 2), (1, 2), (2, 3), (3, 3), (4, 3)])
def test_killed_between_the_renames_of_a_save(tmp_path, forkserver, done, whole):
    root = tmp_path / "d"
    new_dataset(root, 1)
    assert run(forkserver, die_after_renames, root, 1, done) == -signal.SIGKILL
    stock = load(root)  # as it is, without a repair
    assert stock.num_episodes >= 2
    assert {int(index) for index in stock.hf_dataset["episode_index"]} >= {0, 1}
    with DurableDataset.open(root, REPO_ID) as dataset:
        # Once data and metadata of the episode are there, it is whole, even if nobody was told.
        assert dataset.episodes == whole
        record(dataset, range(whole, whole + 1))
    check_dataset(root, whole + 1)
    assert summarize(root).episodes == whole + 1


def test_killed_at_random_instants(tmp_path, forkserver):
    root, random = tmp_path / "d", np.random.default_rng(11)
    new_dataset(root, 1)
    for _ in range(3):
        receiver, sender = forkserver.Pipe(duplex=False)
        process = forkserver.Process(target=record_until_killed, args=(root, sender))
        process.start()
        sender.close()
        acknowledged = receiver.recv()
        time.sleep(random.uniform(0.0, 0.6))
        process.kill()
        process.join()
        with contextlib.suppress(EOFError):
            while True:
                acknowledged = receiver.recv()
        assert load(root).num_episodes >= acknowledged
    with DurableDataset.open(root, REPO_ID) as dataset:
        assert dataset.episodes >= acknowledged
        record(dataset, range(dataset.episodes, dataset.episodes + 1))
    check_dataset(root, dataset.episodes)


def test_killed_in_the_first_save(tmp_path, forkserver):
    root = tmp_path / "d"
    assert run(forkserver, die_in_first_save, root) == -signal.SIGKILL
    with DurableDataset.open(root, REPO_ID) as dataset:  # the lock of the dead is free
        assert dataset.episodes == 0
        record(dataset, range(2))
    check_dataset(root, 2)


def test_a_refused_write_leaves_the_earlier_episodes_whole(tmp_path, forkserver):
    root = tmp_path / "d"
    new_dataset(root, 1)
    assert run(forkserver, fill_limited_files, root, 100_000) == 7
    check_dataset(root, 1)
    with DurableDataset.open(root, REPO_ID) as dataset:
        record(dataset, range(1, 2))
    check_dataset(root, 2)


@pytest.fixture
def small_disk(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=2M", "tmpfs", str(disk)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("cannot mount a small disk here")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.slow
def test_a_full_disk(small_disk):
    root = small_disk / "d"
    settings = {"depth": False, "robot_type": "locobot_sim", "info": {}}
    recorder = EpisodeRecorder(root, REPO_ID, resume=False, **settings)
    message = r"No space left on device.*episodes are saved and whole"
    with pytest.raises(DatasetError, match=message), recorder:  # noqa: PT012
        for episode in range(1000):
            for step in range(length_of(episode)):
                recorder.add_frame(*arguments(episode, step), TASK)
            recorder.save_episode()
    assert recorder.saved_episodes >= 5
    check_dataset(root, recorder.saved_episodes)


@pytest.mark.slow
def test_kills_of_a_whole_recording(tmp_path):
    """A few rounds of the benchmark."""
    table = tmp_path / "kills.csv"
    script = PROJECT / "benchmarks" / "kill_recording.py"
    command = [sys.executable, str(script), "--kills", "3", "--seed", "5", "--output", str(table)]
    result = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": str(PROJECT)}, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr
    rows = list(csv.DictReader(table.open()))
    assert [row["unreadable"] for row in rows] == ["0"] * 3
