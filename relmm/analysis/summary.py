"""Every number of the report, as plain JSON values under names that stay."""

from __future__ import annotations

from typing import Any

import numpy as np

from relmm.analysis import performance, quality
from relmm.analysis.calibration import calibration, spread_against_error, surprises
from relmm.analysis.collection import Collection

FORMAT = 1  # of summary.json; grows when a name changes its meaning or goes
SUMMARY = "summary.json"
_SURPRISE_COLUMNS = ["episode", "frame", "index", "success", "x", "y", "colour", "bits"]
_TRACK_POINTS = 4000


def summarize_collection(collection: Collection, repo_id: str) -> dict[str, Any]:
    """The numbers of a report; what there is no data for is None or empty, and `not_shown` says why.

    Args:
        collection: the attempts.
        repo_id: name of the dataset, for commands.
    """
    frames, grasps, notes = collection.frames, _with_hours(collection), list(collection.notes)
    expected = "mean" if "mean" in grasps and grasps["mean"].notna().any() else "p_grasp"
    grid = performance.cells(grasps)
    unseen = _unseen(grasps, notes) if "policy_mean" in grasps else None
    judged = "policy_mean" if "policy_mean" in grasps else expected
    rare = surprises(grasps, judged)
    return {
        "format": FORMAT,
        "dataset": {
            "repo_id": repo_id,
            "root": str(collection.root),
            "episodes": int(frames["episode"].nunique()),
            "frames": len(frames),
            "attempts": len(grasps),
            "runs": collection.runs,
        },
        "success": performance.success(grasps, frames),
        "cells": grid,
        "parts": performance.best_and_worst(grid),
        "groups": performance.groups(grasps),
        "calibration": {
            "p_grasp": calibration(grasps, "p_grasp"),
            "mean": calibration(grasps, "mean"),
            "spread": spread_against_error(grasps, "mean", "spread"),
        },
        "policy": None if unseen is None else _policy(unseen, collection),
        "surprises": {
            "expected_by": judged,
            "attempts": rare[_SURPRISE_COLUMNS].assign(expected=rare[judged] if len(rare) else 0.0).to_dict("records"),
        },
        "time": quality.time_spent(frames),
        "track": _track(collection),
        "collected_by": quality.contributions(frames, grasps, collection.runs),
        "findings": quality.findings(frames, grasps, collection.runs, collection.root, repo_id),
        "next": performance.next_attempts(grid, _spread(collection)),
        "not_shown": notes + _missing(collection),
        # Of what this is a summary, which the caller may know.
        "where": None,
        "policy_path": None,
        "comparison": None,
    }


def _with_hours(collection: Collection) -> Any:
    """The attempts with `hours`: on the robot's clock until each, without the time between runs."""
    hours = collection.frames["seconds"].fillna(0).cumsum() / 3600
    before = dict(zip(collection.frames["index"], hours, strict=True))
    return collection.grasps.assign(hours=collection.grasps["index"].map(before))


def _unseen(grasps: Any, notes: list[str]) -> Any:
    if grasps["learned_from"].isna().all() and len(grasps):
        notes.append(
            "Nobody wrote down which attempts the policy has learned from, so its calibration is that of all of them, "
            "and may look better than it is."
        )
        return grasps
    unseen = grasps[~grasps["learned_from"].fillna(False).astype(bool)]
    if len(unseen) < 20:
        notes.append(
            f"The policy has learned from all but {len(unseen)} of these attempts; its calibration needs at least 20 "
            "that it has not learned from: take an earlier checkpoint, or another dataset."
        )
    return unseen


def _policy(unseen: Any, collection: Collection) -> dict[str, Any]:
    return {
        "learned_episodes": collection.learned_episodes,
        "unseen_attempts": len(unseen),
        "mean": calibration(unseen, "policy_mean"),
        "p_grasp": calibration(unseen, "policy_p_grasp"),
        "spread": spread_against_error(unseen, "policy_mean", "policy_spread"),
    }


def _spread(collection: Collection) -> Any:
    return collection.policy_spread


def _track(collection: Collection) -> list[dict[str, Any]]:
    """Where it was, by its wheels, a line for each run; thinned out to some thousand points."""
    known = collection.frames[np.isfinite(collection.frames[["odom_x", "odom_y"]]).all(axis=1)]
    every = max(len(known) // _TRACK_POINTS, 1)
    return [
        {"run": int(run), "x": part["odom_x"].iloc[::every].tolist(), "y": part["odom_y"].iloc[::every].tolist()}
        for run, part in known.groupby("run")
    ]


def _missing(collection: Collection) -> list[str]:
    grasps, notes = collection.grasps, []
    if not len(grasps):
        notes.append("There is no grasp attempt, so nothing can be said about grasping.")
        return notes
    if not grasps["p_grasp"].notna().any():
        notes.append("No P[grasp] was recorded, so nothing can be said about the robot's confidence.")
    if not collection.frames["odom_x"].notna().any():
        notes.append("No odometry was recorded, so it is not known where the robot was.")
    if len(grasps) and not (grasps["colour"].fillna("") != "").any():
        notes.append("The camera is not known, so what lay at an attempted spot is not told by colour.")
    return notes
