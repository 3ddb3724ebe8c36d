from __future__ import annotations

from pathlib import Path

import pytest

from relmm.features import Phase, Skill, action_dict
from relmm.learning.progress import Metrics, Progress, read_metrics


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
    progress, recorder = Progress(), Progress()
    progress.add(float(skill), success, int(phase))
    outcome = {"next.reward": float(success), "complementary_info.phase": int(phase)}
    recorder.add_frame({}, action_dict(skill), outcome, "task")
    assert progress == recorder == Progress(**counts)


def test_counts_add_up() -> None:
    progress = Progress(interventions=2)
    for _ in range(3):
        progress.add(Skill.NAVIGATE, False, Phase.LEARNING)
        progress.add(Skill.GRASP, True, Phase.LEARNING)
        progress.save_episode()
    wanted = {"steps": 3, "attempts": 3, "successes": 3, "objects": 3, "interventions": 2}
    assert progress.asdict() == {"practice_attempts": 0, "pseudo_reset_steps": 0, **wanted}


def test_metrics_are_read_as_written_and_appended_to(tmp_path: Path) -> None:
    path = tmp_path / "run" / "metrics.jsonl"
    for step in (1, 2):
        metrics = Metrics(path)
        metrics.write(steps=step, loss=step / 3)
        assert read_metrics(path)[-1] == {"steps": step, "loss": pytest.approx(step / 3, abs=1e-5)}
        metrics.close()
    assert [line["steps"] for line in read_metrics(path)] == [1, 2]


def test_metrics_of_a_resumed_run_know_how_long_it_has_trained(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    for before, after in ((0.0, 4.5), (4.5, 7.0), (7.0, 7.5)):
        metrics = Metrics(path)
        assert metrics.seconds == before
        metrics.write(steps=1, seconds=after)
        metrics.close()


def test_half_a_line_of_a_killed_run_costs_that_line_alone(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"steps": 1}\n{"steps": 2, "lo', encoding="utf-8")
    metrics = Metrics(path)
    metrics.write(steps=3)
    metrics.close()
    assert read_metrics(path) == [{"steps": 1}, {"steps": 3}]
