"""The learning curve of a run as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from relmm.learning.progress import Progress, read_metrics

_ATTEMPTS, _STEPS = 20, 200  # each point of a curve covers at least so many


def draw_learning_curve(metrics: Path, picture: Path) -> None:
    """Draw what a `metrics.jsonl` holds: how the training went, and what evaluations there were.

    Args:
        metrics: of a run.
        picture: PNG to write.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    lines = read_metrics(metrics)
    evaluations = [line for line in lines if "eval_collected" in line]
    panels = 1 + bool(evaluations)
    figure, axes = plt.subplots(1, panels, figsize=(6 * panels, 4), layout="constrained", squeeze=False)
    _draw_training(axes[0][0], [line for line in lines if "eval_collected" not in line])
    if evaluations:
        _draw_evaluations(axes[0][1], evaluations)
    for panel in axes[0]:
        panel.set(ylim=(0, 105))
        panel.set_xlim(left=0)
        panel.grid(alpha=0.3)
    figure.savefig(picture, dpi=110)
    plt.close(figure)


def _draw_training(axes: Any, lines: list[dict[str, Any]]) -> None:
    """The share of attempts that succeed, and objects per 100 navigation steps, over the robot's own time."""
    for (over, of), least, label, style in (
        (("attempts", "successes"), _ATTEMPTS, "successful grasps, %", "-"),
        (("steps", "objects"), _STEPS, "objects picked up per 100 steps", "--"),
    ):
        points = []
        before = [Progress().asdict(), *lines]
        for number, line in enumerate(lines, 1):
            earlier = next((other for other in reversed(before[:number]) if other[over] <= line[over] - least), None)
            if earlier is not None:
                points.append((line["robot_minutes"], 100 * (line[of] - earlier[of]) / (line[over] - earlier[over])))
        if points:
            axes.plot(*zip(*points, strict=True), style, marker=".", label=label)
    practice = [line["robot_minutes"] for line in lines if line["steps"] == 0]
    if practice:
        axes.axvspan(0, practice[-1], color="grey", alpha=0.15, label="curriculum")
    axes.set(title="training", xlabel="minutes on the robot's clock")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8)


def _draw_evaluations(axes: Any, lines: list[dict[str, Any]]) -> None:
    steps, shares, spreads = zip(
        *((line["steps"], 100 * line["eval_collected"], 100 * line["eval_collected_std"]) for line in lines),
        strict=True,
    )
    axes.errorbar(steps, shares, yerr=spreads, marker="o", capsize=3)
    axes.set(title="evaluation", xlabel="navigation steps", ylabel="objects collected, %")
