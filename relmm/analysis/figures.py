"""The pictures of a report. Text is drawn in a colour that the page replaces by its own, for light and dark."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from relmm.analysis.collection import Sample
from relmm.features import GRASP_X, GRASP_Y, GRID

INK = "#010203"  # replaced by the page's colour of text
STYLE: Any = {  # matplotlib has a type of its own for its settings
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 10,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": INK,
    "axes.titlecolor": INK,
    "axes.titlesize": 10,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "legend.frameon": False,
    "hatch.linewidth": 0.5,
}
_BLUE, _ORANGE, _GREY = "#3b82c4", "#e07b39", "#888888"
_EXTENT = (GRASP_Y[0] * 100, GRASP_Y[1] * 100, GRASP_X[0] * 100, GRASP_X[1] * 100)  # cm


def figures(summary: dict[str, Any], samples: list[Sample]) -> dict[str, Figure]:
    """All pictures that the numbers of a report suffice for, by name.

    Args:
        summary: of `summarize_collection`.
        samples: attempts with a policy's maps.
    """
    made: dict[str, Figure] = {}
    draw: dict[str, tuple[bool, Callable[[], Figure]]] = {
        "success": (len(summary["success"]["curve"]["attempt"]) > 1, lambda: _success(summary["success"])),
        "cells": (summary["dataset"]["attempts"] > 0, lambda: _cells(summary["cells"])),
        "groups": (summary["dataset"]["attempts"] >= 10, lambda: _groups(summary["groups"])),
        "calibration": (_calibrated(summary["calibration"]), lambda: _calibration(summary["calibration"])),
        "policy": (
            summary["policy"] is not None and _calibrated(summary["policy"]),
            lambda: _calibration(summary["policy"]),
        ),
        "samples": (bool(samples), lambda: _samples(samples)),
        "track": (any(len(line["x"]) > 1 for line in summary["track"]), lambda: _track(summary["track"])),
        "time": (any(_hours(summary["time"]).values()), lambda: _time(_hours(summary["time"]))),
        "next": (summary["dataset"]["attempts"] > 0, lambda: _next(summary["next"])),
    }
    with mpl.rc_context(STYLE):
        for name, (possible, function) in draw.items():
            if possible:
                made[name] = function()
    return made


def _new(width: float, height: float, columns: int = 1) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(1, columns, squeeze=False)[0]
    return figure, axes


def _success(numbers: dict[str, Any]) -> Figure:
    figure, axes = _new(8, 3, 2)
    curve = numbers["curve"]
    for ax, x, label in zip(axes, ("attempt", "robot_hours"), ("attempts", "hours on the robot's clock"), strict=True):
        ax.fill_between(curve[x], _percent(curve["low"]), _percent(curve["high"]), color=_BLUE, alpha=0.25, lw=0)
        ax.plot(curve[x], _percent(curve["share"]), color=_BLUE)
        ax.set(xlabel=label, ylim=(0, 100), xlim=(0, None))
    axes[0].set_ylabel(f"success of the last {max(numbers['window'], 1)}, %")
    return figure


def _cells(grid: dict[str, Any]) -> Figure:
    figure, axes = _new(9, 3.4, 3)
    attempts = _map(grid["attempts"])
    _heat(figure, axes[0], np.where(attempts > 0, attempts, np.nan), "attempts", "viridis", None)
    _heat(figure, axes[1], 100 * _map(grid["share"]), "success, %", "RdYlBu", (0, 100))
    width = 100 * (_map(grid["high"]) - _map(grid["low"]))
    _heat(figure, axes[2], width, "width of the interval, points", "magma_r", (0, 100))
    axes[0].set_ylabel("forward of the robot, cm")
    return figure


def _heat(figure: Figure, ax: Any, values: Any, title: str, colours: str, limits: tuple[float, float] | None) -> None:
    """A map of the grasp cells as the robot sees them: left is left. Hatched cells have no data."""
    ax.set_facecolor("none")
    ax.patch.set(hatch="////", edgecolor=_GREY, facecolor="none")
    low, high = limits or (0, None)
    shown = ax.imshow(
        np.ma.masked_invalid(values)[:, ::-1],
        origin="lower",
        extent=(_EXTENT[1], _EXTENT[0], *_EXTENT[2:]),
        cmap=colours,
        vmin=low,
        vmax=high,
        interpolation="none",
        aspect="equal",
    )
    ax.set(title=title, xlabel="left, cm")
    ax.spines[["top", "right"]].set_visible(True)
    bar = figure.colorbar(shown, ax=ax, shrink=0.75, location="right")
    bar.outline.set_edgecolor(INK)


def _groups(groups: dict[str, list[dict[str, Any]]]) -> Figure:
    titles = {
        "distance": "distance, cm",
        "bearing": "bearing, degrees left",
        "light": "brightness, %",
        "colour": "colour",
    }
    scale = {"distance": 100, "bearing": 1, "light": 100}
    figure, axes = _new(9.5, 2.9, len(titles))
    for ax, (name, title) in zip(axes, titles.items(), strict=True):
        rows = groups[name]
        labels = [
            row.get("name") or f"{row['from'] * scale[name]:.0f} to {row['to'] * scale[name]:.0f}" for row in rows
        ]
        _shares(ax, rows, labels)
        ax.set(title=title, ylim=(0, 100))
    axes[0].set_ylabel("success, %")
    return figure


def _shares(ax: Any, rows: list[dict[str, Any]], labels: list[str]) -> None:
    at = np.arange(len(rows))
    shares = np.array([row["share"] for row in rows]) * 100
    ends = np.array([[row["low"], row["high"]] for row in rows]).reshape(-1, 2).T * 100
    ax.bar(at, shares, color=_BLUE, alpha=0.6)
    ax.errorbar(at, shares, yerr=np.abs(ends - shares), fmt="none", ecolor=INK, capsize=2, lw=1)
    ax.set_xticks(at, [f"{label}\n({row['attempts']})" for label, row in zip(labels, rows, strict=True)])
    ax.tick_params(axis="x", labelsize=7, rotation=45 if len(rows) > 3 else 0)


def _calibrated(numbers: dict[str, Any]) -> bool:
    return numbers["p_grasp"] is not None or numbers["mean"] is not None


def _calibration(numbers: dict[str, Any]) -> Figure:
    figure, (left, middle, right) = _new(9.5, 3.3, 3)
    left.plot([0, 100], [0, 100], color=_GREY, lw=1, ls="--")
    best = numbers["mean"] or numbers["p_grasp"]
    for name, colour, label in (("p_grasp", _ORANGE, "P[grasp]"), ("mean", _BLUE, "mean at the spot")):
        if numbers[name] is not None:
            reliability_curve(left, numbers[name]["bins"], colour, label)
    left.set(xlabel="expected, %", ylabel="picked up, %", xlim=(0, 100), ylim=(0, 100), title="expected and happened")
    left.legend(fontsize=8, loc="upper left")
    _threshold(middle, best["thresholds"])
    if numbers["spread"] is not None:
        bins = numbers["spread"]["bins"]
        right.errorbar(bins["spread"], bins["error"], yerr=bins["standard_error"], color=_BLUE, marker="o", capsize=2)
        right.set(xlabel="members' spread", ylabel="error", title="is it unsure where it is wrong?", ylim=(0, None))
    else:
        right.set_axis_off()
    return figure


def reliability_curve(ax: Any, bins: dict[str, list[float]], colour: str, label: str) -> None:
    """Expectations against outcomes, with intervals."""
    observed = np.array(bins["observed"])
    ends = np.abs(np.array([bins["low"], bins["high"]]) - observed) * 100
    ax.errorbar(
        _percent(bins["predicted"]),
        100 * observed,
        yerr=ends,
        color=colour,
        marker="o",
        ms=4,
        lw=1,
        capsize=2,
        label=label,
    )


def _threshold(ax: Any, rows: list[dict[str, Any]]) -> None:
    known = [row for row in rows if row["success"] is not None]
    at = [100 * row["threshold"] for row in known]
    successes = rows[0]["attempts"] * (rows[0]["success"] or 0)
    ax.plot(at, [100 * row["success"] for row in known], color=_BLUE, marker=".", label="success of what is left")
    missed = [100 * row["missed"] / successes if successes else 0 for row in known]
    ax.plot(at, missed, color=_ORANGE, marker=".", ls="--", label="successes missed")
    ax.set(xlabel="attempt only above, %", ylabel="%", ylim=(0, 100), title="what a threshold would gain")
    ax.legend(fontsize=8)


def _samples(samples: list[Sample]) -> Figure:
    figure = Figure(figsize=(9.5, 3.6), layout="constrained")
    axes = figure.subplots(2, len(samples), squeeze=False)
    for column, sample in enumerate(samples):
        top, bottom = axes[:, column]
        top.imshow(sample.image)
        top.set_title(f"episode {sample.episode}\n{'picked up' if sample.success else 'failed'}", fontsize=8)
        top.set_axis_off()
        bottom.imshow(
            sample.mean.reshape(GRID, GRID)[:, ::-1],
            origin="lower",
            cmap="viridis",
            vmin=0,
            vmax=1,
            interpolation="none",
        )
        if sample.cell >= 0:
            bottom.plot(GRID - 1 - sample.cell % GRID, sample.cell // GRID, "o", mfc="none", mec="red", mew=2, ms=9)
        bottom.set_axis_off()
    return figure


def _track(lines: list[dict[str, Any]]) -> Figure:
    figure, (ax,) = _new(5, 4.2)
    for line in lines:
        x, y = np.array(line["x"]), np.array(line["y"])
        jumps = np.hypot(np.diff(x), np.diff(y)) > 1.0  # carried by a person, or a new run
        breaks = np.flatnonzero(jumps) + 1
        for piece in zip(np.split(x, breaks), np.split(y, breaks), strict=True):
            ax.plot(-piece[1], piece[0], lw=0.8, alpha=0.8, color=f"C{line['run'] % 10}")
    ax.set(xlabel="right of where it began, m", ylabel="forward of where it began, m", aspect="equal")
    return figure


def _hours(time: dict[str, float]) -> dict[str, float]:
    return {name: seconds for name, seconds in time.items() if name != "unknown_frames"}


def _time(seconds: dict[str, float]) -> Figure:
    figure, (ax,) = _new(7, 2.2)
    total, names = sum(seconds.values()), list(seconds)[::-1]
    shares = [100 * seconds[name] / total for name in names]
    bars = ax.barh([name.replace("_", " ") for name in names], shares, color=_BLUE, alpha=0.7)
    ax.bar_label(
        bars,
        [f"{share:.0f} %, {seconds[name] / 60:.1f} min" for share, name in zip(shares, names, strict=True)],
        padding=4,
        color=INK,
    )
    ax.set(xlabel="share of the robot's time, %", xlim=(0, max(shares) * 1.35))
    return figure


def _next(numbers: dict[str, Any]) -> Figure:
    figure, (ax,) = _new(3.8, 3.3)
    by = "policy's spread" if numbers["by"] == "policy_spread" else "expected gain"
    worth = _map(numbers["worth"])
    _heat(figure, ax, worth, f"where an attempt teaches most\n({by})", "viridis", None)
    ax.set_ylabel("forward of the robot, cm")
    return figure


def _map(values: list[float | None]) -> Any:
    return np.array(values, float).reshape(GRID, GRID)


def _percent(values: list[float]) -> Any:
    return 100 * np.array(values)
