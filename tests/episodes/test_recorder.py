"""Recording behind the loop."""

import errno
import threading
import time

import pyarrow.parquet as pq
import pytest
from episode_children import end_without_closing
from episode_helpers import INFO, REPO_ID, TASK, arguments, check_dataset, length_of, new_dataset

from relmm.episodes import DurableDataset, EpisodeRecorder, read_episodes, summarize
from relmm.errors import ConfigError, DatasetError

SETTINGS = {"depth": False, "robot_type": "locobot_sim", "info": INFO}


def add_episode(recorder, episode, steps=None):
    for step in range(length_of(episode) if steps is None else steps):
        recorder.add_frame(*arguments(episode, step), TASK)


def test_a_slow_writer_makes_the_loop_wait_and_loses_nothing(tmp_path, monkeypatch):
    """Then the disk refuses: that is told at the next call, and costs the unsaved episode only."""
    resumed, add = threading.Event(), DurableDataset.add_frame
    monkeypatch.setattr(DurableDataset, "add_frame", lambda *frame: resumed.wait() and add(*frame))
    with EpisodeRecorder(tmp_path / "d", REPO_ID, resume=False, buffered_frames=4, **SETTINGS) as recorder:
        threading.Timer(1.0, resumed.set).start()
        for episode in range(12):
            add_episode(recorder, episode)
            recorder.save_episode()
            assert resumed.is_set() or episode == 0, "nobody waited"
        recorder.flush()
        assert recorder.saved_episodes == 12
        monkeypatch.setattr(pq.ParquetWriter, "write_table", refuse)
        add_episode(recorder, 12)
        recorder.save_episode()
        with pytest.raises(DatasetError, match=r"cannot be written \(.*12 episodes are saved and whole"):
            recorder.flush()
    with pytest.raises(DatasetError, match="closed"):
        recorder.save_episode()
    assert recorder.saved_episodes == 12
    check_dataset(tmp_path / "d", 12)


def refuse(*arguments, **settings):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_fault_of_the_writer_itself_is_raised_with_its_cause(tmp_path, monkeypatch):
    recorder = EpisodeRecorder(tmp_path / "d", REPO_ID, resume=False, **SETTINGS)
    add_episode(recorder, 0)
    recorder.save_episode()
    recorder.flush()
    monkeypatch.setattr(DurableDataset, "add_frame", lambda *frame: 1 / 0)
    with pytest.raises(DatasetError, match=r"the writer of .* has failed: ZeroDivisionError") as raised:  # noqa: PT012
        add_episode(recorder, 1)
        recorder.flush()
    assert isinstance(raised.value.__cause__, ZeroDivisionError)
    recorder.close()
    check_dataset(tmp_path / "d", 1)


def test_the_unfinished_episode_is_saved_where_asked(tmp_path):
    new_dataset(tmp_path / "d", 1)

    def interrupted():
        with EpisodeRecorder(tmp_path / "d", REPO_ID, resume=True, save_unfinished=True, **SETTINGS) as recorder:
            assert recorder.saved_episodes == 1
            assert recorder.repaired == ""
            add_episode(recorder, 1)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    check_dataset(tmp_path / "d", 2)


def test_what_was_handed_over_is_saved_when_the_interpreter_ends(tmp_path, forkserver):
    process = forkserver.Process(target=end_without_closing, args=(tmp_path / "d", 3))
    process.start()
    process.join()
    check_dataset(tmp_path / "d", 3)


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
    assert list(summary.frames_by_phase.values()) == [6, 5, 4, 3, 0]
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


@pytest.mark.parametrize("frames", [1, 2, 33])
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
