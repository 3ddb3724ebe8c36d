"""How good the robot is, whether it still improves, and where it grasps well."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view

from relmm.analysis.pictures import COLOURS
from relmm.analysis.statistics import difference, poisson_rate, teaches, wilson
from relmm.features import GRID, cell_to_xy

WINDOW = 100  # attempts that "now" means, or a third of all if there are fewer than three times as many
_POINTS = 200  # of a curve, at most
_GROUPS = 5  # of distances, bearings and brightness, with equal counts


def success(grasps: pd.DataFrame, frames: pd.DataFrame) -> dict[str, Any]:
    """Success of all attempts, of the last and those before, objects an hour, and the curve over attempts."""
    hours = float(frames["seconds"].sum()) / 3600
    window = min(WINDOW, len(grasps) // 3)
    result: dict[str, Any] = {
        "overall": share(grasps["success"]),
        "robot_hours": hours,
        "window": window,
        "trend": None,
        "objects_per_hour": None,
        "curve": curve(grasps, max(window, 1)),
    }
    if hours > 0:
        low, high = poisson_rate(int(grasps["success"].sum()), hours)
        rate = float(grasps["success"].sum()) / hours
        result["objects_per_hour"] = {"rate": rate, "low": low, "high": high}
    if window >= 5:
        result |= {
            "now": share(grasps["success"].iloc[-window:]),
            "before": share(grasps["success"].iloc[-2 * window : -window]),
        }
        (d, low, high), beginning = _change(result["before"], result["now"]), share(grasps["success"].iloc[:window])
        result |= {"beginning": beginning, "change": {"difference": d, "low": low, "high": high}}
        result["trend"] = "improving" if low > 0 else "worsening" if high < 0 else "steady"
    return result


def share(outcomes: pd.Series) -> dict[str, Any]:
    """`counted` of a column of outcomes."""
    return counted(int(outcomes.sum()), len(outcomes))


def counted(successes: int, attempts: int) -> dict[str, Any]:
    """Attempts, successes, and their share with Wilson's interval; None where there is none."""
    low, high = wilson(successes, attempts)
    known = {"share": successes / attempts, "low": float(low), "high": float(high)} if attempts else {}
    return {"attempts": attempts, "successes": successes, "share": None, "low": None, "high": None, **known}


def curve(grasps: pd.DataFrame, window: int) -> dict[str, list[float]]:
    """The share of successes of the last `window` attempts, with intervals, over attempts and robot hours."""
    total = np.concatenate([[0], np.cumsum(grasps["success"].to_numpy(int))])
    if not len(grasps):
        return {name: [] for name in ("attempt", "robot_hours", "share", "low", "high")}
    at = np.unique(np.linspace(min(window, len(grasps)), len(grasps), _POINTS).round().astype(int))
    successes = total[at] - total[np.maximum(at - window, 0)]
    counts = np.minimum(at, window)
    low, high = wilson(successes, counts)
    hours = grasps["hours"].to_numpy()[at - 1]
    columns = {"attempt": at, "robot_hours": hours, "share": successes / counts, "low": low, "high": high}
    return {name: values.tolist() for name, values in columns.items()}


def cells(grasps: pd.DataFrame) -> dict[str, Any]:
    """Attempts and successes of each of the 225 cells, and what one more would teach.

    Lists have 225 entries, row by row from near right; shares are None in empty cells. What one more attempt
    would teach takes the neighbouring cells into account.
    """
    inside = grasps[grasps["cell"] >= 0]
    attempts = np.bincount(inside["cell"], minlength=GRID**2)
    successes = np.bincount(inside["cell"], weights=inside["success"], minlength=GRID**2).astype(int)
    low, high = wilson(successes, attempts)
    shares = np.where(attempts > 0, successes / np.maximum(attempts, 1), np.nan)
    return {
        "attempts": attempts.tolist(),
        "successes": successes.tolist(),
        "share": _with_none(shares),
        "low": _with_none(low),
        "high": _with_none(high),
        "teaches": teaches(_with_neighbours(successes), _with_neighbours(attempts)).tolist(),
        "outside": int((grasps["cell"] < 0).sum()),
    }


def best_and_worst(grid: dict[str, Any]) -> dict[str, Any]:
    """The third of the grasp area with the best and with the worst success: near, middle, far; right, centre, left."""
    attempts = np.array(grid["attempts"]).reshape(GRID, GRID)
    successes = np.array(grid["successes"]).reshape(GRID, GRID)
    third = GRID // 3
    parts: list[dict[str, Any]] = []
    for i, depth in enumerate(("near", "middle", "far")):
        for j, side in enumerate(("right", "centre", "left")):
            block = np.s_[i * third : (i + 1) * third, j * third : (j + 1) * third]
            parts.append(
                {"part": f"{depth} {side}", **counted(int(successes[block].sum()), int(attempts[block].sum()))}
            )
    known = sorted((part for part in parts if part["attempts"]), key=lambda part: part["share"])
    return {"parts": parts, "best": known[-1] if known else None, "worst": known[0] if known else None}


def groups(grasps: pd.DataFrame) -> dict[str, list[dict[str, Any]]]:
    """Success by distance (m), bearing (degrees) and light, in groups of about equal counts, and by colour."""
    result = {name: _by_quantile(grasps, name) for name in ("distance", "bearing", "light")}
    known = grasps[grasps["colour"].isin(COLOURS)]
    result["colour"] = [
        {"name": colour, **share(known.loc[known["colour"] == colour, "success"])}
        for colour in COLOURS
        if (known["colour"] == colour).any()
    ]
    return result


def next_attempts(grid: dict[str, Any], spread: np.ndarray | None) -> dict[str, Any]:
    """The cells where one more attempt teaches most.

    Args:
        grid: of `cells`.
        spread: of the policy's ensemble in each cell, on average over recorded pictures; None without a policy.
    """
    worth = np.array(grid["teaches"]) if spread is None else spread
    ranked = np.argsort(-worth, kind="stable")
    xy = cell_to_xy(ranked[:5].astype(float))
    return {
        "by": "beta_variance" if spread is None else "policy_spread",
        "worth": worth.tolist(),
        "best_cells": [
            {"cell": int(cell), "x": float(x), "y": float(y), "worth": float(worth[cell])}
            for cell, (x, y) in zip(ranked[:5], xy, strict=True)
        ],
        "never_tried": int((np.array(grid["attempts"]) == 0).sum()),
    }


def _with_neighbours(counts: Any) -> Any:
    """Sums over each cell and those round it: a gripper is wider than a cell, so neighbours tell of each other."""
    padded = np.pad(np.reshape(counts, (GRID, GRID)), 1)
    return sliding_window_view(padded, (3, 3)).sum(axis=(2, 3)).ravel()


def _change(before: dict[str, Any], after: dict[str, Any]) -> tuple[float, float, float]:
    return difference((before["successes"], before["attempts"]), (after["successes"], after["attempts"]))


def _by_quantile(grasps: pd.DataFrame, name: str) -> list[dict[str, Any]]:
    known = grasps[np.isfinite(grasps[name])]
    if not len(known):
        return []
    parts = pd.qcut(known[name], min(_GROUPS, max(len(known) // 10, 1)), duplicates="drop")
    return [
        {"from": float(rows[name].min()), "to": float(rows[name].max()), **share(rows["success"])}
        for _, rows in known.groupby(parts, observed=True)
    ]


def _with_none(values: Any) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in values]
