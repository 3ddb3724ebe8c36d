"""What a policy thought when it chose its last action, as a caption and a small picture for videos."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from relmm.features import GRID, Skill, xy_to_cell
from relmm.learning.actor import Actor
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy


def describe_action(action: dict[str, float]) -> str:
    """One line."""
    match Skill(round(action["skill.pos"])):
        case Skill.GRASP:
            return f"grasp at {action['skill_x.pos']:.2f}, {action['skill_y.pos']:+.2f} m"
        case Skill.PLACE:
            return "into the basket"
        case _:
            return f"{action['x.vel']:.2f} m/s, {action['theta.vel']:+.0f} deg/s"


def grasp_map(actor: Actor, action: dict[str, float]) -> NDArray[np.uint8] | None:
    """The ensemble's mean success of each grasp cell, far cells above and left ones on the left.

    Returns:
        uint8 (15, 15, 3), from dark (0) to yellow (1), the chosen cell in white; None for a policy without an ensemble.
    """
    policy: Any = actor.policy
    if not isinstance(policy, ReLMMPolicy) or policy.estimate is None:
        return None
    mean = policy.estimate.mean[0].cpu().numpy().reshape(GRID, GRID)
    bgr = cv2.applyColorMap((mean * 255).astype(np.uint8), cv2.COLORMAP_INFERNO)
    picture = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
    if round(action["skill.pos"]) == Skill.GRASP:
        cell = xy_to_cell(action["skill_x.pos"], action["skill_y.pos"])
        picture[cell // GRID, cell % GRID] = 255
    return np.ascontiguousarray(picture[::-1, ::-1]).astype(np.uint8)
