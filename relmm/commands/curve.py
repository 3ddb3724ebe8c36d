"""The learning curve of a run as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from relmm.learning.progress import read_metrics


def draw_learning_curve(metrics: Path, picture: Path) -> None:
    """Draw what a `metrics.jsonl` holds: objects collected in evaluations, and how the training itself went.

    Args:
        metrics: of a run.
        picture: PNG to write.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    lines = read_metrics(metrics)
    evaluations = [line for line in lines if "eval_collected" in line]
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    steps = [line["steps"] for line in evaluations]
    shares = [100 * line["eval_collected"] for line in evaluations]
    left.errorbar(steps, shares, yerr=[100 * line["eval_collected_std"] for line in evaluations], marker="o", capsize=3)
    left.set(title="evaluation", xlabel="navigation steps", ylabel="objects collected, %", ylim=(0, 105))
    training = [line for line in lines if "eval_collected" not in line and line["steps"] > 0]
    _draw_training(right, training)
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.set_xlim(left=0)
    figure.savefig(picture, dpi=110)
    plt.close(figure)


def _draw_training(axes: Any, lines: list[dict[str, Any]]) -> None:
    """Objects per 100 navigation steps and the share of attempts that succeed, between lines about 200 steps apart."""
    points = []
    for line in lines:
        before = next((other for other in reversed(lines) if other["steps"] <= line["steps"] - 200), None)
        if before is not None:
            steps, attempts = line["steps"] - before["steps"], line["attempts"] - before["attempts"]
            objects, successes = line["objects"] - before["objects"], line["successes"] - before["successes"]
            points.append((line["steps"], 100 * objects / steps, 100 * successes / max(attempts, 1)))
    if points:
        at, objects_per_100, success = zip(*points, strict=True)
        axes.plot(at, objects_per_100, marker=".", label="objects per 100 steps")
        axes.plot(at, success, label="successful grasps, %", linestyle="--", marker=".")
        axes.legend(fontsize=8)
    axes.set(title="training", xlabel="navigation steps", ylim=(0, 105))
