"""Draws every figure that there are results for: `python benchmarks/paper/figures.py`.

From `results/<figure>.csv`, the curves of its experiments, means over seeds; from `results/<run>_metrics.jsonl`, how
soft actor-critic went.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np
from run import RESULTS, read

from relmm.learning.progress import read_metrics

METRICS = ("temperature", "entropy", "value", "value_spread", "actor_spread", "critic_loss")


def draw_scores(path: Path) -> Path:
    """One curve an experiment of a figure; a bar where there is one evaluation."""
    import matplotlib.pyplot as plt

    curves: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in read(path):
        curves[row["experiment"].split("/", 1)[1]][int(row["step"])].append(100 * float(row["collected"]))
    figure, axes = plt.subplots(figsize=(8, 4.5), layout="constrained")
    single = all(len(each) == 1 for each in curves.values())
    for index, (name, points) in enumerate(curves.items()):
        steps = sorted(points)
        means, stds = (np.array([f(points[step]) for step in steps]) for f in (np.mean, np.std))
        if single:
            bar = axes.bar(index, means, 0.5, yerr=stds, color="tab:blue", capsize=3)
            axes.bar_label(bar, fmt="%.0f", label_type="center", color="white")
        else:
            (line,) = axes.plot(steps, means, marker="o", label=f"{name} ({len(points[steps[0]])} seeds)")
            axes.fill_between(steps, means - stds, means + stds, color=line.get_color(), alpha=0.15)
    axes.set(title=path.stem, ylabel="objects collected, %", ylim=(0, 102))
    if single:
        seeds = [f"{name}\n{len(next(iter(points.values())))} seed(s)" for name, points in curves.items()]
        axes.set_xticks(range(len(curves)), seeds, fontsize=8)
    else:
        axes.set_xlabel("navigation steps")
        axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
    return _saved(figure, path.with_suffix(".png"))


def draw_metrics(path: Path) -> Path:
    """How temperature, values and the actor went, and what was picked up."""
    import matplotlib.pyplot as plt

    lines = [line for line in read_metrics(path) if "temperature" in line]
    steps = [line["steps"] for line in lines]
    figure, panels = plt.subplots(2, 4, figsize=(15, 6), layout="constrained", sharex=True)
    for name, axes in zip(METRICS, panels.flat, strict=False):
        axes.plot(steps, [line[name] for line in lines], linewidth=0.8)
        axes.set(title=name, yscale="log" if name == "temperature" else "linear")
    panels[1, 2].plot(steps, [line["objects"] for line in lines])
    panels[1, 2].set(title="objects picked up")
    scores = [line for line in read_metrics(path) if "eval_collected" in line]
    panels[1, 3].plot([line["steps"] for line in scores], [100 * line["eval_collected"] for line in scores], "o-")
    panels[1, 3].set(title="collected in evaluations, %", ylim=(0, 102))
    for axes in panels.flat:
        axes.grid(alpha=0.3)
    return _saved(figure, path.with_suffix(".png"))


def _saved(figure: object, path: Path) -> Path:
    figure.savefig(path, dpi=100)  # type: ignore[attr-defined]
    return path


def main() -> None:
    """Draw all there is."""
    import matplotlib as mpl

    mpl.use("Agg")
    drawn = [draw_scores(path) for path in sorted(RESULTS.glob("*.csv")) if read(path)]
    drawn += [draw_metrics(path) for path in sorted(RESULTS.glob("*_metrics.jsonl"))]
    print("\n".join(map(str, drawn)) or f"There is nothing in {RESULTS} yet: run run.py first.")


if __name__ == "__main__":
    main()
