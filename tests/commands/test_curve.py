import json

import cv2

from relmm.commands.curve import draw_learning_curve
from relmm.learning.progress import Progress

EVALUATION = {"eval_collected_std": 0.1, "eval_collected_each": [], "eval_grasp_success": 0.5}


def write(path, lines):
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def counts(steps: int) -> dict[str, float]:
    progress = Progress(steps, attempts=steps // 4, objects=steps // 10, successes=steps // 8)
    return {**progress.asdict(), "seconds": 0.0, "robot_minutes": steps / 10}


def practice(attempts: int) -> dict[str, float]:
    progress = Progress(practice_attempts=attempts, attempts=attempts, successes=attempts // 2)
    return {**progress.asdict(), "seconds": 0.0, "robot_minutes": attempts / 10}


def test_curve_shows_evaluations_and_training(tmp_path):
    evaluated = [{**counts(s), **EVALUATION, "eval_collected": s / 2000} for s in (500, 1000)]
    write(tmp_path / "full.jsonl", [*(counts(s) for s in range(0, 1001, 50)), *evaluated])
    write(tmp_path / "short.jsonl", [counts(10)])
    for name in ("full", "short"):
        draw_learning_curve(tmp_path / f"{name}.jsonl", tmp_path / f"{name}.png")
    full, short = (cv2.imread(str(tmp_path / f"{name}.png")) for name in ("full", "short"))
    assert (full < 128).sum() > (short < 128).sum(), "curves are drawn"
    assert full.shape[1] > 1.5 * short.shape[1], "no panel for evaluations where there was none"


def test_curve_of_a_short_run_shows_its_curriculum(tmp_path):
    write(tmp_path / "practised.jsonl", [practice(attempts) for attempts in range(10, 101, 10)])
    write(tmp_path / "nothing.jsonl", [])
    for name in ("practised", "nothing"):
        draw_learning_curve(tmp_path / f"{name}.jsonl", tmp_path / f"{name}.png")
    practised, nothing = (cv2.imread(str(tmp_path / f"{name}.png")) for name in ("practised", "nothing"))
    blue = (practised[..., 0].astype(int) - practised[..., 2] > 60).sum()
    assert blue > 200 > (nothing[..., 0].astype(int) - nothing[..., 2] > 60).sum()


def test_half_a_line_is_skipped(tmp_path):
    write(tmp_path / "metrics.jsonl", [counts(50), counts(300)])
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"steps": 30')
    draw_learning_curve(tmp_path / "metrics.jsonl", tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 1000
