"""The bar of relmm-train counts everything, and its remaining time comes true."""

import json
import re

import pytest

from relmm.commands.training_bar import Phase, TrainingBar


def test_the_remaining_time_counts_practice_steps_and_evaluations():
    clock = [0.0]
    phases = [Phase("practice", 10, 0.7), Phase("steps", 20, 1.0), Phase("evaluations", 2, 16.0)]
    with TrainingBar("training", phases, lambda: clock[0]) as bar:
        assert bar.share() == 0
        for attempt in range(10):
            clock[0] += 0.7
            bar.advance("practice", attempt + 1)
        assert bar.seconds_left() == pytest.approx(20 + 2 * 16), "by the weights, as long as nothing is timed"
        assert bar.share() == pytest.approx(7 / 59)
        for step in range(10):
            clock[0] += 2.0
            bar.advance("steps", step + 1)
        for share in (0.25, 0.5, 1.0):
            clock[0] = 27.0 + 100 * share
            bar.advance("evaluations", share)
        assert bar.seconds_left() == pytest.approx(10 * 2.0 + 100), "as timed"
        bar.advance("steps", 20)
        bar.advance("evaluations", 2)
        assert (bar.seconds_left(), bar.share()) == (0, 1)


def test_a_resumed_run_begins_where_it_was():
    clock = [0.0]
    with TrainingBar("training", [Phase("practice", 5, 0.7, 5), Phase("steps", 100, 1.0, 50)], lambda: clock[0]) as bar:
        clock[0] = 3.0
        bar.advance("practice", 5)  # nothing new: the time is that of what follows
        bar.advance("steps", 51)
        assert bar.seconds_left() == pytest.approx(49 * 3.0)
        assert bar.share() == pytest.approx(0.51, abs=0.02)


def test_the_pace_is_that_of_late():
    clock = [0.0]
    with TrainingBar("training", [Phase("steps", 2000, 1.0)], lambda: clock[0]) as bar:
        for step in range(1500):
            clock[0] += 1.0 if step < 500 else 2.0
            bar.advance("steps", step + 1)
        assert bar.seconds_left() == pytest.approx(500 * 2.0, rel=0.01)


@pytest.mark.slow
def test_a_run_ends_at_all_of_everything(run, tiny, tmp_path):
    evaluations = ("--env_eval_freq=2", "--eval.n_episodes=1")
    result = run("relmm-train", *tiny, *evaluations, "--steps=2", "--output_dir=out")
    assert result.returncode == 0, result.stderr
    last = [line for line in re.split(r"[\r\n]+", result.stderr) if " left, " in line][-1]
    assert "100%" in last
    assert "about 0 s left, 6/6 practice, 2/2 steps, 1/1 evaluations" in last
    assert "eval_collected" in json.loads((tmp_path / "out/metrics.jsonl").read_text().splitlines()[-1])
