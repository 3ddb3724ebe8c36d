"""Two reports side by side."""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from relmm.analysis.figures import STYLE
from relmm.analysis.statistics import difference

_COLOURS = ("#3b82c4", "#e07b39")


def compare(here: dict[str, Any], there: dict[str, Any], names: tuple[str, str]) -> tuple[dict[str, Any], Figure]:
    """How another dataset or policy differs from this one.

    Args:
        here: of `summarize_collection`.
        there: likewise.
        names: what to call them.

    Returns:
        The numbers, with `there` minus `here`, and a picture of both.
    """
    a, b = here["success"]["overall"], there["success"]["overall"]
    result: dict[str, Any] = {"names": list(names), "rows": [_row(here), _row(there)], "success": None}
    if a["attempts"] and b["attempts"]:
        d, low, high = difference((a["successes"], a["attempts"]), (b["successes"], b["attempts"]))
        result["success"] = {"difference": d, "low": low, "high": high}
    with mpl.rc_context(STYLE):
        return result, _picture(here, there, names)


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


def _picture(here: dict[str, Any], there: dict[str, Any], names: tuple[str, str]) -> Figure:
    figure = Figure(figsize=(8, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    right.plot([0, 100], [0, 100], color="#888888", lw=1, ls="--")
    for summary, name, colour in zip((here, there), names, _COLOURS, strict=True):
        curve, beliefs = summary["success"]["curve"], _beliefs(summary)
        left.plot(curve["attempt"], 100 * np.array(curve["share"]), color=colour, label=name)
        if beliefs is not None:
            bins = {key: 100 * np.array(values) for key, values in beliefs["bins"].items()}
            ends = np.abs(np.stack([bins["low"], bins["high"]]) - bins["observed"])
            right.errorbar(
                bins["predicted"], bins["observed"], yerr=ends, color=colour, marker="o", ms=4, lw=1, capsize=2
            )
    left.set(xlabel="attempts", ylabel="success, %", ylim=(0, 100), title="success")
    left.legend(fontsize=8)
    right.set(xlabel="expected, %", ylabel="picked up, %", xlim=(0, 100), ylim=(0, 100), title="expected and happened")
    return figure
