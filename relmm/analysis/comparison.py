"""Two reports side by side."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import norm

from relmm.analysis.collection import Collection
from relmm.analysis.figures import STYLE, reliability_curve
from relmm.analysis.statistics import LEVEL, difference

_COLOURS = ("#3b82c4", "#e07b39")
_ENOUGH = 20  # attempts for an interval


def on_common_ground(here: Collection, there: Collection) -> tuple[Collection, Collection]:
    """Two collections of one dataset, with the attempts that are in both and that neither policy has learned from."""
    in_both = np.intersect1d(here.grasps["index"], there.grasps["index"])
    learned = np.union1d(*(_learned_from(collection.grasps) for collection in (here, there)))
    wanted = np.setdiff1d(in_both, learned)
    narrowed = [
        replace(each, grasps=each.grasps[each.grasps["index"].isin(wanted)].reset_index(drop=True))
        for each in (here, there)
    ]
    return narrowed[0], narrowed[1]


def score_difference(here: Collection, there: Collection) -> dict[str, Any] | None:
    """How much higher the Brier score of one is on the same attempts, of `on_common_ground`; higher is worse.

    Returns:
        `attempts`, and `difference`, of there minus here, with the `low` and `high` ends of its 95 % interval, which is
        that of the mean of paired differences; None with too few attempts.
    """
    errors = [(_expected(each.grasps) - each.grasps["success"].to_numpy(float)) ** 2 for each in (here, there)]
    differences = errors[1] - errors[0]
    differences = differences[np.isfinite(differences)]
    if len(differences) < _ENOUGH:
        return None
    middle = float(differences.mean())
    half = float(norm.ppf((1 + LEVEL) / 2) * differences.std(ddof=1) / np.sqrt(len(differences)))
    return {"attempts": len(differences), "difference": middle, "low": middle - half, "high": middle + half}


def compare(
    here: dict[str, Any], there: dict[str, Any], names: tuple[str, str], score: dict[str, Any] | None = None
) -> tuple[dict[str, Any], Figure]:
    """How another dataset or policy differs from this one.

    Args:
        here: of `summarize_collection`.
        there: likewise.
        names: what to call them.
        score: of `score_difference`, where both are about the same attempts.

    Returns:
        The numbers, with `there` minus `here`, and a picture of both.
    """
    a, b = here["success"]["overall"], there["success"]["overall"]
    same = here["dataset"]["root"] == there["dataset"]["root"]
    result: dict[str, Any] = {"names": list(names), "rows": [_row(here), _row(there)], "success": None, "score": score}
    result["same_attempts"] = same
    if a["attempts"] and b["attempts"] and not same:
        d, low, high = difference((a["successes"], a["attempts"]), (b["successes"], b["attempts"]))
        result["success"] = {"difference": d, "low": low, "high": high}
    with mpl.rc_context(STYLE):
        return result, _picture(here, there, names, same)


def _learned_from(grasps: pd.DataFrame) -> Any:
    """Indices of the attempts that the policy has learned from, as far as anybody knows."""
    if "learned_from" not in grasps:
        return grasps["index"].iloc[:0]
    return grasps.loc[grasps["learned_from"].fillna(False).astype(bool), "index"]


def _expected(grasps: pd.DataFrame) -> Any:
    """The probability of success that was given to each attempt: the policy's, if there is one."""
    for name in ("policy_mean", "mean"):
        if name in grasps and grasps[name].notna().any():
            return grasps[name].to_numpy(float)
    return grasps["p_grasp"].to_numpy(float)


def _row(summary: dict[str, Any]) -> dict[str, Any]:
    """The numbers that are compared."""
    beliefs = _beliefs(summary)
    rate = summary["success"]["objects_per_hour"]
    return {
        "attempts": summary["dataset"]["attempts"],
        "success": summary["success"]["overall"]["share"],
        "objects_per_hour": rate and rate["rate"],
        "ece": beliefs and beliefs["ece"],
        "ece_low": beliefs and beliefs["ece_low"],
        "ece_high": beliefs and beliefs["ece_high"],
        "brier": beliefs and beliefs["brier"]["score"],
        "predictions": beliefs and beliefs["attempts"],
    }


def _beliefs(summary: dict[str, Any]) -> dict[str, Any] | None:
    """The policy's, where there is one, on what it has not learned from; else those that were recorded."""
    if summary["policy"] is not None:
        of_policy: dict[str, Any] | None = summary["policy"]["mean"]
        return of_policy
    recorded = summary["calibration"]
    found: dict[str, Any] | None = recorded["mean"] or recorded["p_grasp"]
    return found


def _picture(here: dict[str, Any], there: dict[str, Any], names: tuple[str, str], same: bool) -> Figure:
    figure = Figure(figsize=(4.3 if same else 8, 3.4), layout="constrained")
    axes = figure.subplots(1, 1 if same else 2, squeeze=False)[0]
    for summary, name, colour in zip((here, there), names, _COLOURS, strict=True):
        if not same:
            curve = summary["success"]["curve"]
            axes[0].plot(curve["attempt"], 100 * np.array(curve["share"]), color=colour, label=name)
        beliefs = _beliefs(summary)
        if beliefs is not None:
            reliability_curve(axes[-1], beliefs["bins"], colour, name)
    axes[0].set(xlabel="attempts", ylabel="success, %", ylim=(0, 100), title="success")
    axes[-1].plot([0, 100], [0, 100], color="#888888", lw=1, ls="--")
    axes[-1].set(xlabel="expected, %", ylabel="picked up, %", xlim=(0, 100), ylim=(0, 100))
    axes[-1].set_title("expected and happened")
    axes[0].legend(fontsize=8, loc="upper left")
    return figure
