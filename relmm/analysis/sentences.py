"""What the numbers of a report say, in a sentence or two each."""

from __future__ import annotations

from typing import Any

from relmm.analysis.calibration import best_threshold


def sentences(summary: dict[str, Any]) -> dict[str, str]:
    """The first sentences of each section, by its name."""
    nothing = "There is no grasp attempt in this dataset."
    some = summary["dataset"]["attempts"] > 0
    return {
        "success": _success(summary["success"]) if some else nothing,
        "cells": _cells(summary) if some else nothing,
        "calibration": _calibration(summary["calibration"]),
        "policy": _policy(summary["policy"]),
        "surprises": _surprises(summary["surprises"]),
        "time": _time(summary["time"]),
        "comparison": _comparison(summary["comparison"]),
        "collected_by": _collected_by(summary["collected_by"]),
        "findings": _findings(summary["findings"]),
        "next": _next(summary["next"]) if some else nothing,
    }


def percent(row: dict[str, Any]) -> str:
    """A share with its interval."""
    if row["share"] is None:
        return "unknown"
    return f"{row['share']:.0%} ({row['low']:.0%} to {row['high']:.0%})"


def _success(numbers: dict[str, Any]) -> str:
    overall, rate = numbers["overall"], numbers["objects_per_hour"]
    text = f"{overall['successes']} of {overall['attempts']} attempts picked something up, {percent(overall)}."
    if rate is not None:
        text += f" That is {rate['rate']:.0f} objects an hour ({rate['low']:.0f} to {rate['high']:.0f})."
    if numbers["trend"] is None:
        return f"{text} There are too few attempts to say whether it is improving."
    window, now, before = numbers["window"], percent(numbers["now"]), percent(numbers["before"])
    change = {
        "improving": "It is still improving",
        "worsening": "It is getting worse",
        "steady": "Whether it still changes cannot be told",
    }[numbers["trend"]]
    return f"{text} {change}: {now} of the last {window} attempts, {before} of the {window} before them."


def _cells(summary: dict[str, Any]) -> str:
    best, worst = summary["parts"]["best"], summary["parts"]["worst"]
    empty = sum(n == 0 for n in summary["cells"]["attempts"])
    if best is None:
        return "No attempt was made within the grasp area."
    text = f"It grasps best at the {best['part']} of its grasp area, {percent(best)}"
    if best["part"] != worst["part"]:
        overlap = worst["high"] >= best["low"]
        text += f", and worst at the {worst['part']}, {percent(worst)}"
        text += "; the intervals overlap, so that may be chance" if overlap else ""
    if not empty:
        return f"{text}. Every one of its 225 cells was tried."
    return f"{text}. {empty} of 225 cells were never tried; they are hatched, and nothing is known about them."


def _calibration(numbers: dict[str, Any]) -> str:
    if numbers["p_grasp"] is None and numbers["mean"] is None:
        return "It cannot be told: fewer than 20 attempts have a recorded P[grasp]."
    parts = []
    if numbers["p_grasp"] is not None:
        parts.append(_verdict("P[grasp], on which it decides whether to try,", numbers["p_grasp"]))
    if numbers["mean"] is not None:
        parts.append(_verdict("The ensemble's mean at the spot where it tried", numbers["mean"]))
    parts.append(_threshold(numbers["mean"] or numbers["p_grasp"]))
    parts.append(_spread(numbers["spread"]))
    return " ".join(part for part in parts if part)


def _verdict(what: str, numbers: dict[str, Any]) -> str:
    said = f"{numbers['mean_prediction']:.0%} expected, {numbers['success']:.0%} happened"
    error = f"expected calibration error {numbers['ece']:.3f} ({numbers['ece_low']:.3f} to {numbers['ece_high']:.3f})"
    verdict = {
        "calibrated": "can be trusted",
        "overconfident": "promises too much",
        "underconfident": "promises too little",
    }[numbers["verdict"]]
    return f"{what} {verdict}: {said}, {error}; chance alone explains up to {numbers['ece_if_calibrated']:.3f}."


def _threshold(numbers: dict[str, Any]) -> str:
    best = best_threshold(numbers["thresholds"])
    if best is None:
        return "No threshold would have saved attempts without missing more than a tenth of the successes."
    saved = numbers["attempts"] - best["attempts"]
    return (
        f"To try only above {best['threshold']:.0%} would have saved {saved} attempts at the price of {best['missed']} "
        f"successes, and raised success from {numbers['success']:.0%} to {best['success']:.0%}."
    )


def _spread(numbers: dict[str, Any] | None) -> str:
    if numbers is None or numbers["rank_correlation"] is None:
        return ""
    rho = numbers["rank_correlation"]
    known = (
        "It is unsure where it is wrong" if rho > 0.2 else "Its members' disagreement does not tell where it is wrong"
    )
    return f"{known} (rank correlation of spread and error {rho:.2f})."


def _policy(numbers: dict[str, Any] | None) -> str:
    if numbers is None:
        return ""
    learned = numbers["learned_episodes"]
    basis = "all attempts" if learned is None else f"{numbers['unseen_attempts']} attempts that it has not learned from"
    if numbers["mean"] is None:
        return f"There are {basis}, too few to say how well it expects what happens."
    parts = [_verdict(f"On {basis}, its mean at the spot", numbers["mean"]), _spread(numbers["spread"])]
    return " ".join(part for part in parts if part)


def _surprises(numbers: dict[str, Any]) -> str:
    rows = numbers["attempts"]
    if not rows:
        return "It cannot be told without recorded expectations."
    failures = sum(not row["success"] for row in rows)
    return (
        f"Of the {len(rows)} least expected outcomes, {failures} are failures of attempts that looked good, and "
        f"{len(rows) - failures} successes of attempts that did not. A judgement that is wrong would be among them."
    )


def _comparison(numbers: dict[str, Any] | None) -> str:
    if numbers is None:
        return ""
    here, there = numbers["names"]
    if numbers["success"] is not None:
        return _more_successes(numbers["success"], here, there)
    if numbers["score"] is not None:
        return _better_score(numbers["score"], here, there)
    return "There are too few attempts that neither has learned from to tell them apart." * numbers["same_attempts"]


def _more_successes(change: dict[str, float], here: str, there: str) -> str:
    points = f"{100 * abs(change['difference']):.0f} points {'more' if change['difference'] > 0 else 'less'} often"
    text = f"{there} succeeds {points} than {here} ({100 * change['low']:+.0f} to {100 * change['high']:+.0f})"
    return f"{text}, which may be chance." if change["low"] <= 0 <= change["high"] else f"{text}."


def _better_score(score: dict[str, float], here: str, there: str) -> str:
    on = f"On the same {score['attempts']} attempts, which neither has learned from"
    ends = sorted(abs(score[end]) for end in ("low", "high"))
    if score["low"] <= 0 <= score["high"]:
        return f"{on}, their Brier scores differ by no more than chance may make them."
    better, worse = (there, here) if score["difference"] < 0 else (here, there)
    lower = f"{abs(score['difference']):.3f} ({ends[0]:.3f} to {ends[1]:.3f})"
    return f"{on}, {better} foresees what happens better than {worse}: its Brier score is {lower} lower."


def _time(seconds: dict[str, float]) -> str:
    known = {name: value for name, value in seconds.items() if name != "unknown_frames"}
    total = sum(known.values())
    if not total:
        return "No frame tells how long it took."
    longest = max(known, key=lambda name: known[name])
    shares = ", ".join(f"{name.replace('_', ' ')} {value / total:.0%}" for name, value in known.items())
    return f"It spent most of {total / 60:.0f} minutes {longest.replace('_', ' ')}: {shares}."


def _collected_by(rows: list[dict[str, Any]]) -> str:
    most = max(rows, key=lambda row: row["successes"], default=None)
    if most is None or not most["successes"]:
        return "Nobody has picked anything up."
    total = sum(row["successes"] for row in rows)
    who = most["policy"] or "an unnamed policy"
    return (
        f"{most['successes'] / total:.0%} of the {total} successes come from the {most['phase'].replace('_', ' ')} "
        f"phase of run {most['run']}, by {who}."
    )


def _findings(rows: list[dict[str, Any]]) -> str:
    if not rows:
        return (
            "Nothing was found: no duplicates, no stretch without success that chance does not explain, no judgement "
            "that the next frame contradicts, no gaps, one camera."
        )
    many = "One thing is" if len(rows) == 1 else f"{len(rows)} things are"
    return f"{many} worth a look; where a command helps, it is below."


def _next(numbers: dict[str, Any]) -> str:
    first = numbers["best_cells"][0]
    why = (
        "where the policy's members disagree most"
        if numbers["by"] == "policy_spread"
        else "where one more attempt narrows the success rate most"
    )
    x, y, empty = 100 * first["x"], 100 * first["y"], numbers["never_tried"]
    text = f"Attempts at {x:.0f} cm forward and {abs(y):.0f} cm {'left' if y > 0 else 'right'}, {why}"
    return f"{text}; {empty} cells were never tried." if empty else f"{text}."
