"""relmm-record, as a process."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from relmm.episodes import saved_episodes, summarize
from relmm.features import ACTION_NAMES, BASKET_XY, Phase

SIM = ("--robot.type=locobot_sim", "--robot.room=no_obstacles", "--dataset.repo_id=me/room")
QUICK = ("--policy.type=relmm_random", "--max_steps=6", "--pseudo_reset_steps=2")


def columns(root: Path, *names: str) -> dict[str, np.ndarray]:
    files = sorted(root.glob("data/*/*.parquet"))
    table = pq.ParquetDataset(files).read(columns=list(names)).to_pydict()
    return {name: np.array(table[name]) for name in names}


def record(run, root: Path, *extra: str, seed: int = 0, episodes: int = 2):
    return run(
        "relmm-record",
        *SIM,
        *QUICK,
        f"--dataset.root={root}",
        f"--dataset.num_episodes={episodes}",
        f"--seed={seed}",
        *extra,
    )


def test_record_same_seed_writes_same_dataset(run, tmp_path):
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        result = record(run, tmp_path / name, seed=seed)
        assert result.returncode == 0, result.stderr
    names = ("action", "observation.state", "observation.images.front", "complementary_info.robot_time")
    a, b, c = (columns(tmp_path / name, *names) for name in "abc")
    assert all(np.array_equal(a[name], b[name]) for name in names)
    assert not np.array_equal(a["action"], c["action"])


def test_record_prints_summary_read_back_from_files_and_resumes(run, tmp_path):
    root = tmp_path / "room"
    first = record(run, root)
    assert first.returncode == 0, first.stderr
    assert "episodes        2" in first.stdout
    second = record(run, root, "--resume=true", episodes=1)
    assert second.returncode == 0, second.stderr
    summary = summarize(root)
    assert summary.episodes == 3
    assert summary.truncated + summary.ended_by_success == 3
    index = columns(root, "index", "episode_index")
    assert index["index"].tolist() == list(range(summary.frames))
    runs = json.loads((root / "meta/relmm.json").read_text())["runs"]
    assert [run["seed"] for run in runs] == [0, 2], "a resumed run must not repeat the room it began with"


def test_record_carries_what_it_picked_up_elsewhere(run, tmp_path):
    root = tmp_path / "room"
    arguments = ("--policy.type=relmm_scripted", "--dataset.num_episodes=2", "--pseudo_reset_steps=3")
    result = run("relmm-record", *SIM, f"--dataset.root={root}", *arguments)
    assert result.returncode == 0, result.stderr
    data = columns(
        root, "action", "episode_index", "next.reward", "next.done", "complementary_info.phase", "observation.state"
    )
    assert data["next.reward"].sum() == 2 == data["next.done"].sum(), "the scripted policy picks something up each time"
    last_of_first = np.flatnonzero(data["episode_index"] == 0)[-1]
    assert data["next.done"][last_of_first]
    second = data["episode_index"] == 1
    phases = data["complementary_info.phase"][second]
    pseudo_reset = phases == Phase.PSEUDO_RESET
    assert pseudo_reset.sum() == 3 + 6 + 1 + 4 + 3
    assert pseudo_reset[: pseudo_reset.sum()].all()
    skills = data["action"][second][pseudo_reset][:, ACTION_NAMES.index("skill.pos")]
    assert skills.tolist() == [0] * 9 + [2] + [0] * 7
    assert not data["next.reward"][second][pseudo_reset].any()


def test_record_of_cleaning_has_a_room_an_episode_and_goes_on_with_other_rooms(run, tmp_path):
    root = tmp_path / "room"
    arguments = (*SIM, f"--dataset.root={root}", "--policy.type=relmm_scripted", "--mode=clean", "--max_steps=12")
    for more in ("--dataset.num_episodes=2", "--dataset.num_episodes=1 --resume=true"):
        result = run("relmm-record", *arguments, *more.split())
        assert result.returncode == 0, result.stderr
    data = columns(root, "action", "episode_index", "next.reward", "complementary_info.phase", "observation.state")
    assert set(data["complementary_info.phase"].tolist()) == {Phase.LEARNING}
    placed = data["action"][:, ACTION_NAMES.index("skill.pos")] == 2
    assert placed.sum() > 0
    np.testing.assert_allclose(data["action"][placed][:, 3:], [BASKET_XY] * placed.sum(), atol=1e-6)
    starts = np.flatnonzero(np.diff(data["episode_index"], prepend=-1))
    assert len(np.unique(data["observation.state"][starts], axis=0)) == 3
    assert [run["mode"] for run in json.loads((root / "meta/relmm.json").read_text())["runs"]] == ["clean"] * 2


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_record_stopped_by_signal_saves_and_finishes(tmp_path, number):
    root = tmp_path / "room"
    script = Path(sys.executable).parent / "relmm-record"
    arguments = (*SIM, "--policy.type=relmm_random", f"--dataset.root={root}", "--dataset.num_episodes=1000")
    with subprocess.Popen(
        [str(script), *arguments, "--max_steps=10"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        deadline = time.monotonic() + 100
        while len(list(root.glob("data/*/*.parquet"))) < 3 and time.monotonic() < deadline:
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(number)
        output, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    assert "Stopping: saving what there is" in errors
    assert "Traceback" not in errors
    summary = summarize(root)
    assert f"episodes        {summary.episodes}" in output
    assert summary.episodes >= 3
    assert summary.truncated + summary.ended_by_success == summary.episodes, "the cut-off episode is marked truncated"


@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGKILL])
def test_record_ended_before_its_first_episode_goes_on(run, tmp_path, number):
    root = tmp_path / "room"
    script = Path(sys.executable).parent / "relmm-record"
    arguments = (*SIM, "--policy.type=relmm_random", f"--dataset.root={root}", "--dataset.num_episodes=2")
    with subprocess.Popen(
        [str(script), *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        while not (root / "meta/info.json").exists():
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(number)
        output, errors = process.communicate(timeout=100)
    assert "Traceback" not in errors
    saved = saved_episodes(root)
    assert saved == 0 or number == signal.SIGINT
    if number == signal.SIGINT:
        assert process.returncode == 0, errors
        assert (f"episodes        {saved}" if saved else "no episode was recorded; --resume=true") in output
    result = record(run, root, "--resume=true", episodes=1)
    assert result.returncode == 0, result.stderr
    assert summarize(root).episodes == saved + 1


def test_record_by_a_policy_of_another_camera_is_refused(capsys, monkeypatch, tmp_path):
    from relmm.commands import record as command

    options = [*SIM, "--policy.type=relmm_scripted", "--robot.camera=d435", f"--dataset.root={tmp_path / 'room'}"]
    monkeypatch.setattr(sys, "argv", ["relmm-record", *options, "--dataset.num_episodes=1"])
    with pytest.raises(SystemExit):
        command.main()
    assert "say --robot.camera=paper, or --policy.camera=d435" in capsys.readouterr().err
    assert not (tmp_path / "room").exists()


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ("--robot.room=no_such_room", "no_obstacles, obstacles, obstacles_rugs"),
        ("--robot.num_objects=0", "num_objects is 0"),
        ("--robot.num_objects=-3", "num_objects is -3"),
        ("--robot.camera=webcam", "choose one of paper, d435"),
        ("--dataset.repo_id=room", "user/name"),
        ("--dataset.repo_id=me/ro om", "cannot name a dataset"),
        ("--dataset.num_episodes=0", "must be at least 1"),
        ("--max_steps=-1", "must be at least 1"),
        ("--pseudo_reset_steps=-1", "must be at least 0"),
        ("--mode=tidy", "mode is 'tidy', but must be one of practice, clean"),
        ("--seed=-1", "must be at least 0"),
        ("--seed=abc", "abc"),
        ("--policy.num_grasp=0", "must be at least 1"),
        ("--policy.grasp_probability=2", "must lie in 0..1"),
        ("--nonsense=1", "--nonsense=1"),
        ("--resume=true", "no dataset"),
    ],
)
def test_record_bad_input_is_one_sentence_and_writes_nothing(capsys, monkeypatch, tmp_path, bad, message):
    from relmm.commands import record as command

    root = tmp_path / "room"
    monkeypatch.setattr(sys, "argv", ["relmm-record", *SIM, *QUICK, f"--dataset.root={root}", bad])
    with pytest.raises(SystemExit) as stop:
        command.main()
    errors = capsys.readouterr().err.strip()
    assert stop.value.code == 2
    assert message in errors
    assert errors.startswith("relmm-record: ")
    assert "\n" not in errors
    assert not root.exists()


def test_record_existing_folder_is_refused(run, tmp_path):
    (tmp_path / "room").mkdir()
    result = record(run, tmp_path / "room")
    assert result.returncode == 2
    assert "exists already" in result.stderr
    assert "Traceback" not in result.stderr
    assert not any((tmp_path / "room").iterdir())


def test_record_without_policy_says_which_there_are(capsys, monkeypatch, tmp_path):
    from relmm.commands import record as command

    monkeypatch.setattr(sys, "argv", ["relmm-record", *SIM, f"--dataset.root={tmp_path / 'room'}"])
    with pytest.raises(SystemExit):
        command.main()
    assert "--policy.type=relmm_scripted" in capsys.readouterr().err


def test_record_without_opengl_says_what_to_install(run, tmp_path):
    no_driver = {"__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent", "MUJOCO_GL": "egl"}
    result = run("relmm-record", *SIM, *QUICK, f"--dataset.root={tmp_path / 'room'}", **no_driver)
    assert result.returncode == 2
    assert "apt-get install" in result.stderr
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "room").exists()
