"""Recording behind the loop."""

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from episode_helpers import INFO, REPO_ID, TASK, action, arguments, check_dataset, length_of, load, new_dataset

from relmm.episodes import EpisodeRecorder, read_episodes, summarize
from relmm.episodes.recorder import BATCH_FRAMES
from relmm.errors import ConfigError, DatasetError

SETTINGS = {"depth": False, "robot_type": "locobot_sim", "info": INFO}


def add_episode(recorder, episode, steps=None):
    for step in range(length_of(episode) if steps is None else steps):
        recorder.add_frame(*arguments(episode, step), TASK)


def test_a_slow_writer_makes_the_loop_wait_and_loses_nothing(tmp_path):
    """Then the disk refuses: that is told at the next call, and costs the unsaved episode only."""
    with EpisodeRecorder(tmp_path / "d", REPO_ID, resume=False, buffered_frames=4, **SETTINGS) as recorder:
        os.kill(recorder._process.pid, signal.SIGSTOP)
        started = time.monotonic()
        signal.signal(signal.SIGALRM, lambda *_: os.kill(recorder._process.pid, signal.SIGCONT))
        signal.setitimer(signal.ITIMER_REAL, 1.0)
        for episode in range(12):  # more than fits into the queue and the pipe
            add_episode(recorder, episode)
            recorder.save_episode()
        assert time.monotonic() - started >= 1.0
        add_episode(recorder, 99)
        recorder.discard_episode()
        recorder.flush()
        assert recorder.saved_episodes == 12
        resource.prlimit(recorder._process.pid, resource.RLIMIT_FSIZE, (1000, 1000))
        add_episode(recorder, 12)
        recorder.save_episode()
        with pytest.raises(DatasetError, match=r"cannot be written \(.*12 episodes are saved and whole"):
            recorder.flush()
    with pytest.raises(DatasetError, match="closed"):
        recorder.save_episode()
    assert recorder.saved_episodes == 12
    check_dataset(tmp_path / "d", 12)


def test_the_unfinished_episode_is_saved_where_asked(tmp_path, capfd):
    new_dataset(tmp_path / "d", 1)

    def interrupted():
        with EpisodeRecorder(tmp_path / "d", REPO_ID, resume=True, save_unfinished=True, **SETTINGS) as recorder:
            assert recorder.saved_episodes == 1
            assert recorder.repaired == ""
            add_episode(recorder, 1)
            os.kill(recorder._process.pid, signal.SIGINT)  # Ctrl-C reaches the whole process group
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    check_dataset(tmp_path / "d", 2)
    assert capfd.readouterr().err == ""


def test_episodes_of_any_length_arrive_in_order_and_without_what_was_discarded(tmp_path):
    """Frames travel in batches: shorter, equal and longer ones, and a discard in the middle of one."""
    lengths = (1, BATCH_FRAMES, BATCH_FRAMES + 1, 3 * BATCH_FRAMES - 1)
    with EpisodeRecorder(tmp_path / "d", REPO_ID, resume=False, **SETTINGS) as recorder:
        for episode, length in enumerate(lengths):
            add_episode(recorder, 99, steps=BATCH_FRAMES + 3)
            recorder.discard_episode()
            add_episode(recorder, episode, steps=length)
            recorder.save_episode()
    dataset = load(tmp_path / "d")
    assert [dataset.meta.episodes[i]["length"] for i in range(len(lengths))] == list(lengths)
    actions = np.asarray(dataset.hf_dataset["action"])
    expected = [list(action(e, s).values()) for e, length in enumerate(lengths) for s in range(length)]
    np.testing.assert_allclose(actions, expected, rtol=1e-6)


@pytest.mark.slow
def test_a_killed_writer_is_reported_and_the_saved_episodes_are_whole(tmp_path):
    recorder = EpisodeRecorder(tmp_path / "d", REPO_ID, resume=False, **SETTINGS)
    add_episode(recorder, 0)
    recorder.save_episode()
    recorder.flush()
    os.kill(recorder._process.pid, signal.SIGKILL)
    with pytest.raises(DatasetError, match="the 1 episodes saved so far are whole"):  # noqa: PT012
        for _ in range(1000):
            add_episode(recorder, 1)
    with pytest.raises(DatasetError, match="are whole"):
        recorder.save_episode()
    recorder.close()
    check_dataset(tmp_path / "d", 1)


def test_bad_settings_are_refused_before_anything_starts(tmp_path):
    new_dataset(tmp_path / "d", 1)
    started = time.monotonic()
    with pytest.raises(DatasetError, match="exists already"):
        EpisodeRecorder(tmp_path / "d", REPO_ID, resume=False, **SETTINGS)
    with pytest.raises(DatasetError, match=r"camera: have paper .* want d435"):
        EpisodeRecorder(tmp_path / "d", REPO_ID, resume=True, **SETTINGS | {"info": {"camera": "d435"}})
    with pytest.raises(DatasetError, match="there is no dataset"):
        EpisodeRecorder(tmp_path / "nothing", REPO_ID, resume=True, **SETTINGS)
    with pytest.raises(ConfigError, match="user/name"):
        EpisodeRecorder(tmp_path / "new", "noslash", resume=False, **SETTINGS)
    assert time.monotonic() - started < 1
    assert not (tmp_path / "nothing").exists()


def test_what_the_writer_refuses_is_raised_here(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(DatasetError, match=r"cannot be written \(Not a directory\)"):
        EpisodeRecorder(tmp_path / "file" / "d", REPO_ID, resume=False, **SETTINGS)


def test_summary_counts_what_is_on_disk(tmp_path):
    new_dataset(tmp_path / "d", 4)  # 3 + 4 + 5 + 6 frames; step % 3 == 1 grasps, step % 6 == 1 succeeds
    summary = summarize(tmp_path / "d")
    assert (summary.episodes, summary.frames) == (4, 18)
    assert list(summary.frames_by_phase.values()) == [6, 5, 4, 3]
    assert (summary.grasps, summary.successful_grasps) == (6, 4)
    assert (summary.ended_by_success, summary.truncated) == (2, 2)
    assert summary.seconds == 9.0
    assert summary.robot_seconds == pytest.approx(0.5 * (2 + 3 + 4 + 5))
    assert "4 (2 by success, 2 truncated)" in str(summary)
    (tmp_path / "d/data/chunk-000/file-001.parquet").write_bytes(b"")
    with pytest.raises(DatasetError, match="repair the dataset"):
        summarize(tmp_path / "d")
    with pytest.raises(DatasetError, match="no episodes"):
        summarize(tmp_path / "nothing")


@pytest.mark.parametrize("frames", [1, BATCH_FRAMES - 1, BATCH_FRAMES, BATCH_FRAMES + 1, 2 * BATCH_FRAMES])
def test_an_episode_that_is_cut_off_ends_truncated(frames, tmp_path):
    with EpisodeRecorder(tmp_path / "d", REPO_ID, resume=False, save_unfinished=True, **SETTINGS) as recorder:
        add_episode(recorder, 60, steps=frames)
        recorder.cut_episode()
        recorder.cut_episode()  # of which there are no frames: nothing
        add_episode(recorder, 60, steps=frames)
    episodes = list(read_episodes(tmp_path / "d"))
    assert [len(episode) for episode in episodes] == [frames] * 2
    for episode in episodes:
        assert episode.truncated.tolist() == [False] * (frames - 1) + [True]


SURVIVE = """
import signal, sys
sys.path.insert(0, {folder!r})
from episode_helpers import INFO, REPO_ID, TASK, arguments
from relmm.episodes import EpisodeRecorder
if __name__ == "__main__":
    start = __import__("multiprocessing").context.SpawnProcess.start
    def interrupted(process):
        start(process)
        __import__("os").kill(process.pid, signal.SIGTERM)  # long before it can ignore anything
    __import__("multiprocessing").context.SpawnProcess.start = interrupted
    with EpisodeRecorder({root!r}, REPO_ID, resume=False, depth=False, robot_type="locobot_sim", info=INFO) as recorder:
        recorder.add_frame(*arguments(0, 0), TASK)
        recorder.save_episode()
"""


def test_the_first_writer_of_a_process_does_not_die_of_a_signal_before_it_can_ignore_it(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SURVIVE.format(folder=str(Path(__file__).parent), root=str(tmp_path / "d")))
    result = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False, timeout=200)
    assert result.returncode == 0, result.stderr
    assert summarize(tmp_path / "d").episodes == 1
