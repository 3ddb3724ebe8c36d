from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from relmm.features import ACTION_NAMES, Phase, Skill, action_dict
from relmm.learning.progress import Metrics, Progress, read_metrics

Frame = tuple[Skill, bool, Phase, float]  # the last is s on the robot's clock


def line(steps: int, seconds: float = 0.0) -> dict[str, float]:
    """A line of metrics."""
    return {**Progress(steps=steps).asdict(), "seconds": seconds}


def live(progress: Progress, *frames: Frame) -> Progress:
    """Count frames as they happen."""
    for skill, success, phase, time in frames:
        outcome = {"next.reward": float(success), "complementary_info.phase": int(phase)}
        progress.add_frame({}, action_dict(skill), outcome | {"complementary_info.robot_time": time}, "task")
    progress.save_episode()
    return progress


def recorded(*frames: Frame) -> Any:
    """The columns of an episode."""
    skills, rewards, phases, times = (np.array(column) for column in zip(*frames, strict=True))
    actions = np.zeros((len(frames), len(ACTION_NAMES)), np.float32)
    actions[:, ACTION_NAMES.index("skill.pos")] = skills
    return SimpleNamespace(actions=actions, rewards=rewards.astype(np.float32), phases=phases, robot_times=times)


@pytest.mark.parametrize(
    ("skill", "success", "phase", "counts"),
    [
        (Skill.NAVIGATE, False, Phase.LEARNING, {"steps": 1}),
        (Skill.NAVIGATE, False, Phase.PSEUDO_RESET, {"pseudo_reset_steps": 1}),
        (Skill.NAVIGATE, False, Phase.CURRICULUM, {}),
        (Skill.GRASP, False, Phase.LEARNING, {"attempts": 1}),
        (Skill.GRASP, True, Phase.LEARNING, {"attempts": 1, "successes": 1, "objects": 1}),
        (Skill.GRASP, False, Phase.CURRICULUM, {"attempts": 1, "practice_attempts": 1}),
        (Skill.GRASP, True, Phase.CURRICULUM, {"attempts": 1, "practice_attempts": 1, "successes": 1}),
        (Skill.PLACE, False, Phase.PSEUDO_RESET, {}),
        (Skill.PLACE, False, Phase.CURRICULUM, {}),
    ],
)
def test_each_frame_counts_as_what_it_is(skill: Skill, success: bool, phase: Phase, counts: dict[str, int]) -> None:
    frame = (skill, success, phase, 0.0)
    read = Progress()
    read.read(recorded(frame))
    assert live(Progress(), frame) == read == Progress(**counts)


def test_counts_add_up() -> None:
    progress = Progress(interventions=2)
    for index in range(3):
        drive, grasp = (Skill.NAVIGATE, False, Phase.LEARNING), (Skill.GRASP, True, Phase.LEARNING)
        live(progress, (*drive, 40.0 * index), (*grasp, 40.0 * index + 10))
    wanted = {"steps": 3, "attempts": 3, "successes": 3, "objects": 3, "interventions": 2, "robot_minutes": 1.5}
    assert progress.asdict() == {"practice_attempts": 0, "pseudo_reset_steps": 0, **wanted}


def test_the_robots_minutes_add_up_over_its_lives() -> None:
    """Its clock begins anew when it is connected again; the run counts the frames of its dataset, then goes on."""
    drive = (Skill.NAVIGATE, False, Phase.LEARNING)
    progress = Progress()
    progress.read(recorded((*drive, 6.0), (*drive, 60.0)))
    progress.read(recorded((*drive, 90.0)))
    assert progress.robot_minutes == pytest.approx(1.5)
    assert live(progress, (*drive, 1.2), (*drive, 30.0)).robot_minutes == pytest.approx(2.0)
    progress.read(recorded((*drive, 60.0)))
    assert progress.robot_minutes == pytest.approx(2.5)


def test_metrics_are_read_as_written_and_appended_to(tmp_path: Path) -> None:
    path = tmp_path / "run" / "metrics.jsonl"
    for step in (1, 2):
        metrics = Metrics(path)
        metrics.write(**line(step), loss=step / 3)
        assert read_metrics(path)[-1] == {**line(step), "loss": pytest.approx(step / 3, abs=1e-5)}
        metrics.close()
    assert [line["steps"] for line in read_metrics(path)] == [1, 2]


def test_metrics_of_a_resumed_run_know_how_long_it_has_trained(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    for before, after in ((0.0, 4.5), (4.5, 7.0), (7.0, 7.5)):
        metrics = Metrics(path)
        assert metrics.seconds == before
        metrics.write(**line(1, after))
        metrics.close()


def test_half_a_line_of_a_killed_run_costs_that_line_alone(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text(json.dumps(line(1)) + '\n{"steps": 2, "lo', encoding="utf-8")
    metrics = Metrics(path)
    metrics.write(**line(3))
    metrics.close()
    assert read_metrics(path) == [line(1), line(3)]


BEGIN = json.dumps(line(1)).encode()[:-1]


@pytest.mark.parametrize(
    "nonsense",
    [
        b"[]",
        b'"steps"',
        b'{"steps": 1}',
        BEGIN + b', "seconds": "long"}',
        BEGIN + b', "loss": NaN}',
        BEGIN + b', "loss": 1' + b"0" * 400 + b"}",
        BEGIN + b', "eval_collected": 0.5}',
        BEGIN + b', "eval_collected_std": 0, "eval_collected_each": [], "eval_collected": ["much"]}',
        b"\xff\xfe",
        b"[" * 100_000,
    ],
)
def test_what_is_no_metrics_of_a_run_is_skipped(tmp_path: Path, nonsense: bytes) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(
        json.dumps(line(1)).encode() + b"\n" + nonsense + b"\n" + json.dumps(line(2, 7.5)).encode() + b"\n"
    )
    assert read_metrics(path) == [line(1), line(2, 7.5)]
    metrics = Metrics(path)
    metrics.close()
    assert metrics.seconds == 7.5
