import json

import cv2

from relmm.commands.curve import draw_learning_curve
from relmm.learning.progress import Progress

EVALUATION = {"eval_collected_std": 0.1, "eval_collected_each": [], "eval_grasp_success": 0.5}


def write(path, lines):
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def counts(steps: int) -> dict[str, float]:
    progress = Progress(steps, attempts=steps // 4, objects=steps // 10, successes=steps // 8)
    return {**progress.asdict(), "seconds": 0.0}


def test_curve_shows_evaluations_and_training(tmp_path):
    evaluated = [{**counts(s), **EVALUATION, "eval_collected": s / 2000} for s in (500, 1000)]
    write(tmp_path / "full.jsonl", [*(counts(s) for s in range(0, 1001, 50)), *evaluated])
    write(tmp_path / "short.jsonl", [counts(10)])
    for name in ("full", "short"):
        draw_learning_curve(tmp_path / f"{name}.jsonl", tmp_path / f"{name}.png")
    full, short = (cv2.imread(str(tmp_path / f"{name}.png")) for name in ("full", "short"))
    assert (full < 128).sum() > (short < 128).sum(), "curves are drawn"


def test_half_a_line_is_skipped(tmp_path):
    write(tmp_path / "metrics.jsonl", [counts(50), counts(300)])
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"steps": 30')
    draw_learning_curve(tmp_path / "metrics.jsonl", tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 1000
