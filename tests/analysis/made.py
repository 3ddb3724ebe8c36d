"""A made dataset whose answers are known, because they were planted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from relmm.episodes import DurableDataset, FrameBuilder
from relmm.features import BELIEF, ODOMETRY, STATE_NAMES, Phase, Skill, action_dict, cell_to_xy

REPO_ID = "tester/planted"
INFO = {"room": "no_obstacles", "camera": "paper", "seed": 3, "policy": "relmm"}
GRASP_S, STEP_S = 4.0, 0.5


def attempt(cell: int, success: bool, chance: float = -1.0, **more: Any) -> dict[str, Any]:
    """A grasp; `judged` is what is written down, if that is not the truth."""
    return {"skill": Skill.GRASP, "cell": cell, "success": success, "chance": chance, **more}


def step(**more: Any) -> dict[str, Any]:
    """A navigation step, forward."""
    return {"skill": Skill.NAVIGATE, **more}


def write(root: Path, episodes: list[list[dict[str, Any]]], info: dict[str, Any] | None = None) -> Path:
    """Record episodes: a success fills the gripper, which the frame after it has put down."""
    build, clock, x, noise = FrameBuilder(depth=False).build, 1.0, 0.0, np.random.default_rng(0)
    with DurableDataset.create(REPO_ID, root, False, "locobot_sim", INFO if info is None else info) as dataset:
        holding = False
        for frames in episodes:
            for frame in frames:
                seed = frame.get("seed", None)
                rng = noise if seed is None else np.random.default_rng(seed)
                image = rng.integers(0, 60, (100, 100, 3), np.uint8)
                if "colour" in frame:
                    image[:] = frame["colour"]
                state = dict.fromkeys(STATE_NAMES, 0.0) | {"holding.pos": float(holding)}
                state["scan_00.pos"] = float(rng.random())
                grasp = frame["skill"] == Skill.GRASP
                cx, cy = cell_to_xy(frame["cell"]) if grasp else (0.0, 0.0)
                action = action_dict(frame["skill"], 0.2 * (not grasp), 0.0, float(cx), float(cy))
                judged = frame.get("judged", frame.get("success", False))
                belief = dict.fromkeys(BELIEF, -1.0) | {"grasp_probability": frame.get("chance", -1.0)}
                if grasp and "mean" in frame:
                    belief |= {"grasp_mean": frame["mean"], "grasp_std": frame["std"]}
                outcome = {
                    "next.reward": float(judged),
                    "next.done": False,
                    "next.truncated": frame is frames[-1],
                    "next.success": False,
                    "complementary_info.phase": int(frame.get("phase", Phase.LEARNING)),
                    **{f"complementary_info.{name}": value for name, value in belief.items()},
                    **dict(zip((f"complementary_info.{name}" for name in ODOMETRY), (x, 0.0, 0.0), strict=True)),
                    "complementary_info.robot_time": clock,
                    "complementary_info.weights_step": -1,
                }
                dataset.add_frame(build({**state, "front": image}, action, outcome), "tidy")
                holding = bool(frame.get("success", False))
                clock += frame.get("seconds", GRASP_S if grasp else STEP_S)
                x += 0.0 if grasp else 0.1
            dataset.save_episode()
    return root
