"""How each frame ended, also where LeRobot's own recorder has not written it down.

Whether a grasp worked can be seen in the next observation of its episode, where the robot says whether it holds
something. Nothing follows on an episode's last frame: what a grasp there came to is not known. LeRobot's recorder keeps
what was commanded; what was done is less where the robot refuses.
"""

from __future__ import annotations

from collections.abc import Container

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from relmm.features import ACTION_NAMES, FPS, STATE_KEY, STATE_NAMES, FloatArray, Phase, Skill, carried_out

_SKILL, _HOLDING = ACTION_NAMES.index("skill.pos"), STATE_NAMES.index("holding.pos")
# The columns that `with_outcomes` makes where they are missing, and those that it makes them from.
DERIVED = (
    "next.reward",
    "next.done",
    "next.truncated",
    "next.success",
    "complementary_info.phase",
    "complementary_info.grasp_probability",
    "complementary_info.robot_time",
)
SOURCES = ("action", STATE_KEY, "episode_index")


def with_outcomes(frames: pa.Table, wanted: Container[str]) -> tuple[pa.Table, NDArray[np.bool_]]:
    """Add those columns of `DERIVED` that are wanted and missing; without rewards, `action` becomes what was done.

    Where nobody wrote down who acted, the policy did; where nobody looked at the robot's clock, a frame lasts as long
    as a navigation step, which is the least it can.

    Args:
        frames: rows of whole episodes, in order; with the columns of `SOURCES`, if any is missing.
        wanted: names of columns.

    Returns:
        The rows, and for each whether it is known how it ended, (n,).

    Raises:
        ValueError: a column of `SOURCES` does not have the shape it must have.
    """
    missing = [name for name in DERIVED if name in wanted and name not in frames.column_names]
    known = np.ones(len(frames), np.bool_)
    if not missing or not len(frames):
        return frames, known
    episode = frames["episode_index"].to_numpy()
    last = np.append(episode[1:] != episode[:-1], True)
    holding = _numbers(frames, STATE_KEY, len(STATE_NAMES))[:, _HOLDING] > 0.5
    actions = carried_out(_numbers(frames, "action", len(ACTION_NAMES)), holding)
    grasp = actions[:, _SKILL] == Skill.GRASP
    success = grasp & np.append(holding[1:], False) & ~last
    if "next.reward" in missing:
        known = ~(grasp & last)
        done = pa.FixedSizeListArray.from_arrays(pa.array(actions.ravel()), len(ACTION_NAMES))
        frames = frames.set_column(frames.column_names.index("action"), "action", done)
    first = np.flatnonzero(np.roll(last, 1))
    number = np.arange(len(frames)) - np.repeat(first, np.diff(np.append(first, len(frames))))
    values = {
        "next.reward": success.astype(np.float32),
        # A success is seen in the frame after it, so that such an episode always goes on after its last one.
        "next.done": np.zeros(len(frames), np.bool_),
        "next.truncated": last,
        "next.success": np.zeros(len(frames), np.bool_),
        "complementary_info.phase": np.full(len(frames), Phase.LEARNING, np.int64),
        "complementary_info.grasp_probability": np.full(len(frames), -1, np.float32),
        "complementary_info.robot_time": (number / FPS).astype(np.float32),
    }
    for name in missing:
        frames = frames.append_column(name, pa.array(values[name]))
    return frames, known


def _numbers(frames: pa.Table, key: str, width: int) -> FloatArray:
    """A column of lists, (n, width)."""
    numbers = frames[key].combine_chunks().flatten().to_numpy(zero_copy_only=False)
    return numbers.astype(np.float32).reshape(len(frames), width)
