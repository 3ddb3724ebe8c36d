"""Where the time went, who collected what, and what is wrong with the data."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from relmm.analysis.performance import share
from relmm.analysis.reading import FOLLOWS_S
from relmm.analysis.statistics import unlikely_failures
from relmm.features import GRID, NAVIGATION_STEP_S

_SELDOM = 0.001  # of a stretch without success that chance does not explain
_LISTED = 20  # of a kind of finding


def time_spent(frames: pd.DataFrame) -> dict[str, float]:
    """Seconds of the robot's clock by what it did; what a navigation step took beyond its 0.5 s went into turning away.

    Frames after which nothing follows count as `unknown_frames`, because nobody knows how long they took.
    """
    known = frames[frames["follows"]]
    navigation = known[known["skill"] == "navigate"]
    turning = (navigation["seconds"] - NAVIGATION_STEP_S).clip(lower=0)
    turning = turning.where(turning > 0.05, 0.0)  # the clock is a float32
    carrying = navigation["holding"] > 0.5
    moving = navigation["seconds"] - turning
    return {
        "driving": float(moving[~carrying].sum()),
        "carrying": float(moving[carrying].sum()),
        "turning_away": float(turning.sum()),
        "grasping": float(known.loc[known["skill"] == "grasp", "seconds"].sum()),
        "placing": float(known.loc[known["skill"] == "place", "seconds"].sum()),
        "unknown_frames": int((~frames["follows"]).sum()),
    }


def contributions(frames: pd.DataFrame, grasps: pd.DataFrame, runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Frames, attempts and successes of each run and phase, with what the run was recorded with."""
    rows = []
    for (run, phase), part in frames.groupby(["run", "phase"], sort=True):
        known = runs[run] if 0 <= run < len(runs) else {}
        attempts = grasps[(grasps["run"] == run) & (grasps["phase"] == phase)]
        who = {name: known.get(name) for name in ("policy", "room", "seed", "camera")}
        rows.append({"run": int(run), "phase": phase, **who, "frames": len(part), **share(attempts["success"])})
    return rows


def findings(
    frames: pd.DataFrame, grasps: pd.DataFrame, runs: list[dict[str, Any]], root: Path, repo_id: str
) -> list[dict[str, Any]]:
    """What looks wrong, each with what it is, how many, where, and a command that does something about it.

    Args:
        frames: all of them.
        grasps: the attempts.
        runs: of `meta/relmm.json`.
        root: of the dataset, for the commands.
        repo_id: its name, likewise.
    """
    edit = f"lerobot-edit-dataset --repo_id {shlex.quote(repo_id)} --root {shlex.quote(str(root))} --new_repo_id "
    edit += f"{shlex.quote(repo_id + '_kept')} --new_root {shlex.quote(str(root) + '_kept')} "
    edit += "--operation.type delete_episodes --operation.episode_indices "
    keep = f"relmm-analyze --dataset.root={shlex.quote(str(root))} --output_dir=selected --export.root=kept --where="
    found = [
        _duplicates(frames, edit),
        _judgements(grasps, keep),
        *_stretches(grasps, keep),
        _unbalanced(grasps, keep),
        _gaps(frames),
        _cameras(runs),
    ]
    return [finding for finding in found if finding is not None]


def duplicate_episodes(frames: pd.DataFrame) -> list[int]:
    """Episodes all of whose frames are, in order, those of an earlier one."""
    whole = frames.groupby("episode")["fingerprint"].agg(tuple)
    return [int(episode) for episode in whole.index[whole.duplicated()]]


def wrong_judgements(grasps: pd.DataFrame) -> pd.DataFrame:
    """Attempts whose outcome the next frame contradicts: the gripper holds something, or nothing, after all."""
    after = grasps["holding_after"]
    return grasps[after.notna() & ((after > 0.5) != grasps["success"])]


def dry_stretches(grasps: pd.DataFrame) -> list[dict[str, Any]]:
    """Failures in a row that are longer than chance explains, at the success rate of the 100 attempts round them."""
    outcomes = grasps["success"].to_numpy(bool)
    local = grasps["success"].astype(float).rolling(101, center=True, min_periods=1).mean().to_numpy()
    ends = np.flatnonzero(np.diff(np.concatenate([[True], outcomes, [True]]).astype(int)))
    stretches = []
    for begin, end in zip(ends[::2], ends[1::2], strict=True):
        success = max(local[max(begin - 1, 0)], local[min(end, len(local) - 1)], float(outcomes.mean()))
        # As many chances for a stretch as there are attempts (Bonferroni).
        chance = min(unlikely_failures(end - begin, success) * len(outcomes), 1.0)
        if chance < _SELDOM:
            first, last = grasps.iloc[begin], grasps.iloc[end - 1]
            stretches.append(
                {
                    "attempts": int(end - begin),
                    "first_episode": int(first["episode"]),
                    "last_episode": int(last["episode"]),
                    "first_index": int(first["index"]),
                    "last_index": int(last["index"]),
                    "chance": chance,
                }
            )
    return sorted(stretches, key=lambda stretch: -stretch["attempts"])


def _duplicates(frames: pd.DataFrame, edit: str) -> dict[str, Any] | None:
    copies = frames["fingerprint"].duplicated()
    if not copies.any():
        return None
    episodes = duplicate_episodes(frames)
    words = f"{int(copies.sum())} frames are exact copies of earlier ones"
    words += f", {len(episodes)} episodes entirely" if episodes else "; no episode is one entirely"
    command = f'{edit}"{episodes}"' if episodes else None
    return _finding("duplicates", words, int(copies.sum()), command, episodes=episodes)


def _judgements(grasps: pd.DataFrame, keep: str) -> dict[str, Any] | None:
    wrong = wrong_judgements(grasps)
    if not len(wrong):
        return None
    false = int(wrong["success"].sum())
    words = f"{len(wrong)} judgements look wrong: {false} successes with nothing in the gripper afterwards, "
    words += f"{len(wrong) - false} failures with something in it"
    command = f"{keep}'not (success == (holding_after < 0.5))'"
    places = wrong[["episode", "frame", "success"]].head(_LISTED).to_dict("records")
    return _finding("wrong_judgements", words, len(wrong), command, attempts=places)


def _stretches(grasps: pd.DataFrame, keep: str) -> list[dict[str, Any]]:
    found = []
    for stretch in dry_stretches(grasps)[:3]:
        first, last = stretch["first_episode"], stretch["last_episode"]
        where = f"in episode {first}" if first == last else f"in episodes {first} to {last}"
        words = f"{stretch['attempts']} attempts in a row failed, {where}, where chance would hardly make so many"
        command = f"{keep}'not ({stretch['first_index']} <= index <= {stretch['last_index']})'"
        found.append(_finding("no_success", words, stretch["attempts"], command, **stretch))
    return found


def _unbalanced(grasps: pd.DataFrame, keep: str) -> dict[str, Any] | None:
    counts = np.bincount(grasps.loc[grasps["cell"] >= 0, "cell"], minlength=GRID**2)
    if counts.sum() < GRID**2:
        return None
    busiest = np.sort(counts)[::-1][: GRID**2 // 10].sum() / counts.sum()
    if busiest < 0.5:
        return None
    top = np.argsort(-counts, kind="stable")[: GRID**2 // 10]
    words = f"{busiest:.0%} of the attempts lie in a tenth of the cells"
    command = f"{keep}'cell not in {sorted(int(cell) for cell in top)}'"
    return _finding("unbalanced_cells", words, int((counts == 0).sum()), command, busiest_tenth=float(busiest))


def _gaps(frames: pd.DataFrame) -> dict[str, Any] | None:
    later = frames.shift(-1)
    same = (later["run"] == frames["run"]) & (later["episode"] == frames["episode"])
    wait = later["robot_time"] - frames["robot_time"]
    gaps = frames[(same & ((wait > FOLLOWS_S) | (wait < 0))) | (later["index"] > frames["index"] + 1)]
    if not len(gaps):
        return None
    words = f"the recording has {len(gaps)} gaps: frames that are missing, or a clock that jumps within an episode"
    places = gaps[["episode", "frame"]].head(_LISTED).to_dict("records")
    return _finding("gaps", words, len(gaps), None, places=places)


def _cameras(runs: list[dict[str, Any]]) -> dict[str, Any] | None:
    cameras = sorted({str(run["camera"]) for run in runs if run.get("camera") is not None})
    if len(cameras) < 2:
        return None
    words = f"the runs were recorded with different cameras ({', '.join(cameras)}): one policy cannot learn from both"
    return _finding("cameras", words, len(cameras), None, cameras=cameras)


def _finding(kind: str, words: str, count: int, command: str | None, **details: Any) -> dict[str, Any]:
    return {"kind": kind, "words": words, "count": count, "command": command, **details}
