"""Whether what the robot expected of an attempt was right, and which attempts surprised it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from relmm.analysis.statistics import (
    brier,
    ece_if_calibrated,
    ece_interval,
    reliability,
    surprise,
    thresholds,
)

_SURPRISES = 20
_ENOUGH = 20  # predictions that a reliability diagram needs


def calibration(grasps: pd.DataFrame, expected: str) -> dict[str, Any] | None:
    """A column of predictions against outcomes; None with fewer than 20 of them.

    Args:
        grasps: the attempts.
        expected: name of the column.
    """
    known = grasps[np.isfinite(grasps[expected].astype(float))] if expected in grasps else grasps.iloc[:0]
    if len(known) < _ENOUGH:
        return None
    predictions, outcomes = known[expected].to_numpy(float), known["success"].to_numpy(bool)
    table, (low, high) = reliability(predictions, outcomes), ece_interval(predictions, outcomes)
    bins = {
        "predicted": table.predicted,
        "observed": table.observed,
        "count": table.counts,
        "low": table.low,
        "high": table.high,
    }
    error, most = table.ece, ece_if_calibrated(predictions)
    bias = float(predictions.mean() - outcomes.mean())
    return {
        "attempts": len(known),
        "mean_prediction": float(predictions.mean()),
        "success": float(outcomes.mean()),
        "bias": bias,
        "ece": error,
        "ece_low": low,
        "ece_high": high,
        "ece_if_calibrated": most,
        "verdict": "calibrated" if error <= most else "overconfident" if bias > 0 else "underconfident",
        "brier": brier(predictions, outcomes),
        "bins": {name: values.tolist() for name, values in bins.items()},
        "thresholds": [_without_nan(row) for row in thresholds(predictions, outcomes)],
    }


def spread_against_error(grasps: pd.DataFrame, expected: str, spread: str) -> dict[str, Any] | None:
    """Whether the ensemble disagrees where it is wrong: error by spread, in bins, and their rank correlation."""
    if expected not in grasps or spread not in grasps:
        return None
    known = grasps[np.isfinite(grasps[[expected, spread]].astype(float)).all(axis=1)]
    if len(known) < _ENOUGH or known[spread].nunique() < 2:
        return None
    error = (known[expected] - known["success"]).abs()
    order = np.argsort(known[spread].to_numpy(), kind="stable")
    parts = np.array_split(order, max(1, min(10, len(order) // 10)))
    spreads, errors = known[spread].to_numpy(), error.to_numpy()
    return {
        "attempts": len(known),
        "rank_correlation": float(known[spread].corr(error, method="spearman")) if error.nunique() > 1 else None,
        "bins": {
            "spread": [float(spreads[part].mean()) for part in parts],
            "error": [float(errors[part].mean()) for part in parts],
            "standard_error": [float(errors[part].std(ddof=1) / np.sqrt(len(part))) for part in parts],
        },
    }


def best_threshold(rows: list[dict[str, Any]]) -> dict[str, Any] | None:
    """The threshold with the best success that misses at most a tenth of the successes; None if none helps."""
    successes = round(rows[0]["attempts"] * rows[0]["success"])
    allowed = [row for row in rows if row["success"] is not None and row["missed"] <= 0.1 * successes]
    best = max(allowed, key=lambda row: row["success"])
    return best if best["attempts"] < rows[0]["attempts"] else None


def surprises(grasps: pd.DataFrame, expected: str) -> pd.DataFrame:
    """The attempts whose outcome was least expected, with `bits`, at most twenty; none without expectations."""
    if expected not in grasps:
        return grasps.iloc[:0].assign(bits=0.0)
    known = grasps[np.isfinite(grasps[expected].astype(float))]
    bits = surprise(known[expected].to_numpy(float), known["success"].to_numpy(bool))
    return known.assign(bits=bits).nlargest(_SURPRISES, "bits")


def _without_nan(row: dict[str, float]) -> dict[str, Any]:
    return {name: None if isinstance(value, float) and np.isnan(value) else value for name, value in row.items()}
