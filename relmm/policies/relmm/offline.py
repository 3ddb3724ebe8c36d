"""LeRobot's batches as what the policy learns from: attempts and navigation steps, also those of earlier batches."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from relmm.features import ACTION_NAMES, IMAGE_KEY, Skill, xy_to_cell
from relmm.policies.relmm.navigation import from_navigation_steps
from relmm.policies.relmm.trail import HISTORY, TRAIL_FEATURES, Trail

CAPACITY = 2**15  # pictures, 30 kB each, and as many maps
_SKILL = ACTION_NAMES.index("skill.pos")
_PLACE = slice(ACTION_NAMES.index("skill_x.pos"), ACTION_NAMES.index("skill_y.pos") + 1)

# Aligned, so that torch can take single columns.
ATTEMPT = np.dtype([("frame", np.int64), ("cell", np.int64), ("success", np.float32)], align=True)
STEP = np.dtype(
    [
        ("frame", np.int64),
        ("next", np.int64),  # frame of the picture after it
        ("action", np.float32, 2),  # forward and turn, -1..1
        ("trails", np.float32, (2, TRAIL_FEATURES)),  # before and after it
        ("success", bool),
        ("attempted", bool),
    ],
    align=True,
)
Rows = NDArray[np.void]


class Batch:
    """What a batch of LeRobot shows.

    Args:
        batch: as `ReLMMPolicy.forward` takes it.

    Attributes:
        attempts: rows of `ATTEMPT`.
        steps: rows of `STEP`: the drives whose outcome is in the batch.
        pictures: by frame, uint8 (3, 100, 100). A frame's number is also made of its picture, because another dataset
            may have another one of the same number.
    """

    def __init__(self, batch: dict[str, Any]) -> None:
        pictures = (batch[IMAGE_KEY] * 255).round().to(torch.uint8)  # (batch, time, 3, 100, 100)
        actions, padded = batch["action"][:, HISTORY:].cpu(), _padding(batch, IMAGE_KEY, pictures)
        self._frames = _frames(batch, pictures)
        skills = actions[..., _SKILL].round().numpy()
        rewards = batch["next.reward"].cpu().numpy() > 0.5
        self._chosen: dict[int, tuple[int, int]] = {}

        attempts = np.flatnonzero(skills[:, 0] == Skill.GRASP)
        self.attempts: Rows = np.zeros(len(attempts), ATTEMPT)
        self.attempts["frame"] = self._use(attempts, np.zeros_like(attempts))
        self.attempts["cell"] = [xy_to_cell(x, y) for x, y in actions[attempts, 0, _PLACE].tolist()]
        self.attempts["success"] = rewards[attempts, 0]

        # Not there are the picture after an episode's last frame, and what came of a curriculum's many attempts.
        failed = (skills == Skill.GRASP) & ~rewards & ~padded
        steps = np.flatnonzero((skills[:, 0] == Skill.NAVIGATE) & ~padded[:, 1] & ~failed[:, 1:].all(axis=1))
        # Only attempts that follow the step without another step between them are its outcome.
        own = np.logical_and.accumulate(skills[steps, 1:] == Skill.GRASP, axis=1)
        after = np.minimum(own.sum(axis=1) + 1, skills.shape[1] - 1)
        # At the episode's end there is no step after the attempts: the picture before them is what the drive led to.
        after = np.where(padded[steps, after], 1, after)
        self.steps: Rows = np.zeros(len(steps), STEP)
        self.steps["frame"] = self._use(steps, np.zeros_like(steps))
        self.steps["next"] = self._use(steps, after)
        self.steps["action"] = from_navigation_steps(actions[steps, 0]).numpy()
        self.steps["trails"] = _trails(batch, steps)
        self.steps["success"] = (own & rewards[steps, 1:]).any(axis=1)
        self.steps["attempted"] = own.any(axis=1)
        self.pictures = {frame: pictures[row, time].cpu() for frame, (row, time) in self._chosen.items()}

    def _use(self, rows: NDArray[np.intp], times: NDArray[np.intp]) -> NDArray[np.int64]:
        """The frames of some rows at some times, whose pictures will be needed."""
        frames = self._frames[rows, times]
        self._chosen |= zip(frames.tolist(), zip(rows.tolist(), times.tolist(), strict=True), strict=True)
        return frames


class Recollection:
    """Attempts and navigation steps of earlier batches.

    LeRobot takes longer to load a frame, with the frames before and after it, than the policy takes to learn from it.
    So each is learned from more than once. LeRobot shuffles, so that what fits in is as good as any.
    """

    def __init__(self) -> None:
        self.pictures: dict[int, Tensor] = {}
        self._known: dict[np.dtype[np.void], dict[int, np.void]] = {ATTEMPT: {}, STEP: {}}

    def add(self, batch: Batch) -> None:
        """Remember a batch, if there is room."""
        if len(self.pictures) < CAPACITY:
            self.pictures |= batch.pictures
            for rows in (batch.attempts, batch.steps):
                self._known[rows.dtype] |= zip(rows["frame"].tolist(), rows, strict=True)

    def top_up(self, rows: Rows, size: int, rng: torch.Generator) -> Rows:
        """Rows, and remembered ones of their kind until there are `size`, if there are any."""
        known, wanted = list(self._known[rows.dtype].values()), size - len(rows)
        if wanted <= 0 or not known:
            return rows
        chosen = torch.randint(len(known), (wanted,), generator=rng).tolist()
        return np.concatenate([rows, np.array([known[index] for index in chosen], rows.dtype)])


def _frames(batch: dict[str, Any], pictures: Tensor) -> NDArray[np.int64]:
    """Numbers of the frames, (batch, time)."""
    count, time = pictures.shape[:2]
    first = batch["index"] if "index" in batch else torch.arange(count) * time
    checksums = pictures.flatten(2).sum(dim=2).cpu()
    numbers: Tensor = first.reshape(-1, 1).cpu() + torch.arange(time) + checksums * 2**32
    return numbers.numpy()


def _trails(batch: dict[str, Any], rows: NDArray[np.intp]) -> NDArray[np.float32]:
    """Where the robot had been before and after the navigation steps in some rows, (n, 2, 21).

    From the actions of the frames before; the turns of collision avoidance, which only the odometry has, are missing.
    """
    actions: Tensor = batch["action"]
    known = ~_padding(batch, "action", actions)
    features = np.empty((len(rows), 2, TRAIL_FEATURES), np.float32)
    for row, steps, mask in zip(features, actions[rows].tolist(), known[rows].tolist(), strict=True):
        trail = Trail()
        for x_vel, theta_vel, skill, *_ in itertools.compress(steps[:HISTORY], mask):
            if round(skill) == Skill.PLACE:
                trail.reset()
            elif round(skill) == Skill.NAVIGATE:
                trail.moved(x_vel, theta_vel)
        row[0] = trail.features()
        trail.moved(*steps[HISTORY][:2])
        row[1] = trail.features()
    return features


def _padding(batch: dict[str, Any], key: str, values: Tensor) -> NDArray[np.bool_]:
    """Which frames lie beyond their episode's ends, (batch, time)."""
    padded: Tensor = batch.get(f"{key}_is_pad", torch.zeros(values.shape[:2], dtype=torch.bool))
    return padded.cpu().numpy()
