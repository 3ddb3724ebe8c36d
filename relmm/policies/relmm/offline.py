"""LeRobot's batches as what the policy learns from: attempts and navigation steps, also those of earlier batches."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from relmm.errors import ConfigError
from relmm.features import ACTION_NAMES, IMAGE_KEY, STATE_KEY, STATE_NAMES, Skill, xy_to_cell
from relmm.policies.relmm.navigation import from_navigation_steps

CAPACITY = 2**15  # pictures, 30 kB each, and as many maps
_SKILL = ACTION_NAMES.index("skill.pos")
_MOTION = [STATE_NAMES.index(name) for name in ("x.vel", "theta.vel")]
_PLACE = slice(ACTION_NAMES.index("skill_x.pos"), ACTION_NAMES.index("skill_y.pos") + 1)

# Aligned, so that torch can take single columns.
ATTEMPT = np.dtype([("frame", np.int64), ("cell", np.int64), ("success", np.float32)], align=True)
STEP = np.dtype(
    [
        ("frame", np.int64),
        ("next", np.int64),  # frame of the picture after it
        ("action", np.float32, 2),  # forward and turn, -1..1
        ("motion", np.float32, 2),  # by the wheels, m/s and deg/s
        ("turns", np.float32, 2),  # of the step before it and of itself, deg/s
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
        steps: rows of `STEP`; whether they led to a success, other frames tell.
        tries: by step, the frames of the attempts that followed it.
        pictures: by frame, uint8 (3, 100, 100). A frame's number is also made of its picture, because another dataset
            may have another one of the same number.

    Raises:
        ConfigError: the dataset has no rewards.
    """

    def __init__(self, batch: dict[str, Any]) -> None:
        if not isinstance(batch.get("next.reward"), Tensor):  # LeRobot puts in the number 0 where there is no column
            raise ConfigError("The dataset has no column next.reward: train relmm from one of relmm-record or -train.")
        pictures = (batch[IMAGE_KEY] * 255).round().to(torch.uint8)  # (batch, time, 3, 100, 100)
        actions, padded = batch["action"].cpu(), _padding(batch, IMAGE_KEY, pictures)
        self._frames = _frames(batch, pictures)
        self._places: dict[int, tuple[int, int]] = {}
        grasps, drives = (actions[..., _SKILL].round().numpy() == skill for skill in (Skill.GRASP, Skill.NAVIGATE))

        attempts = np.flatnonzero(grasps[:, 0])
        self.attempts: Rows = np.zeros(len(attempts), ATTEMPT)
        self.attempts["frame"] = self._use(attempts, np.zeros_like(attempts))
        self.attempts["cell"] = [xy_to_cell(x, y) for x, y in actions[attempts, 0, _PLACE].tolist()]
        self.attempts["success"] = batch["next.reward"].reshape(-1).cpu().numpy()[attempts] > 0.5

        # Only attempts that follow the step without another step between them are its outcome.
        own = np.logical_and.accumulate(grasps[:, 1:] & ~padded[:, 1:], axis=1)
        # Not there are the picture after an episode's last frame, and what came of a curriculum's many attempts.
        steps = np.flatnonzero(drives[:, 0] & ~padded[:, 1] & ~own.all(axis=1))
        after = own[steps].sum(axis=1) + 1
        self.tries = [self._frames[row, 1:end].tolist() for row, end in zip(steps, after, strict=True)]
        # At the episode's end there is no step after the attempts: the picture before them is what the drive led to.
        after = np.where(padded[steps, after], 1, after)
        self.steps: Rows = np.zeros(len(steps), STEP)
        self.steps["frame"] = self._use(steps, np.zeros_like(steps))
        self.steps["next"] = self._use(steps, after)
        self.steps["action"] = from_navigation_steps(actions[steps, 0]).numpy()
        motions = batch[STATE_KEY][..., _MOTION].cpu().numpy()
        self.steps["motion"] = motions[steps, after]
        self.steps["turns"][:, 0], self.steps["turns"][:, 1] = motions[steps, 0, 1], motions[steps, after, 1]
        self.steps["attempted"] = own[steps, 0]
        self.pictures = {frame: pictures[row, time].cpu() for frame, (row, time) in self._places.items()}

    def _use(self, rows: NDArray[np.intp], times: NDArray[np.intp]) -> NDArray[np.int64]:
        """The frames of some rows at some times, whose pictures will be needed."""
        frames = self._frames[rows, times]
        self._places |= zip(frames.tolist(), zip(rows.tolist(), times.tolist(), strict=True), strict=True)
        return frames


class Recollection:
    """Attempts and navigation steps of LeRobot's batches, which come in any order.

    LeRobot takes longer to load a frame, with the frames before and after it, than the policy takes to learn from it.
    So each is learned from more than once. When there are too many, it begins anew.
    """

    def __init__(self) -> None:
        self._pictures: dict[int, Tensor] = {}
        self._successes: dict[int, bool] = {}  # by frame of the attempt
        self._waiting: list[tuple[np.void, list[int]]] = []  # steps for attempts that no batch has shown yet
        self._known: dict[np.dtype[np.void], dict[int, np.void]] = {ATTEMPT: {}, STEP: {}}  # by frame

    def add(self, batch: Batch) -> tuple[Rows, Rows]:
        """Take in a batch.

        Returns:
            Attempts that are new, and steps whose outcome is newly known.
        """
        if len(self._pictures) > CAPACITY:
            self.__init__()  # type: ignore[misc]
        self._pictures |= batch.pictures
        self._successes |= zip(batch.attempts["frame"].tolist(), batch.attempts["success"] > 0.5, strict=True)
        found, waiting = [], self._waiting + list(zip(batch.steps, batch.tries, strict=True))
        self._waiting = []
        for step, tries in waiting:
            if all(frame in self._successes for frame in tries):
                step["success"] = any(self._successes[frame] for frame in tries)
                found.append(step)
            else:
                self._waiting.append((step, tries))
        steps = np.array(found, STEP)
        for rows in (batch.attempts, steps):
            self._known[rows.dtype] |= zip(rows["frame"].tolist(), rows, strict=True)
        return batch.attempts, steps

    def top_up(self, rows: Rows, size: int, rng: torch.Generator) -> Rows:
        """Rows, and remembered ones of their kind until there are `size`, if there are any."""
        known, wanted = list(self._known[rows.dtype].values()), size - len(rows)
        if wanted <= 0 or not known:
            return rows
        chosen = torch.randint(len(known), (wanted,), generator=rng).tolist()
        return np.concatenate([rows, np.array([known[index] for index in chosen], rows.dtype)])

    def pictures_of(self, frames: NDArray[np.int64]) -> Tensor:
        """Uint8, (n, 3, 100, 100)."""
        return torch.stack([self._pictures[frame] for frame in frames.tolist()])


def _frames(batch: dict[str, Any], pictures: Tensor) -> NDArray[np.int64]:
    """Numbers of the frames, (batch, time)."""
    count, time = pictures.shape[:2]
    first = batch["index"] if "index" in batch else torch.arange(count) * time
    checksums = pictures.flatten(2).sum(dim=2).cpu()
    numbers: Tensor = first.reshape(-1, 1).cpu() + torch.arange(time) + checksums * 2**32
    return numbers.numpy()


def _padding(batch: dict[str, Any], key: str, values: Tensor) -> NDArray[np.bool_]:
    """Which frames lie beyond their episode's ends, (batch, time)."""
    padded: Tensor = batch.get(f"{key}_is_pad", torch.zeros(values.shape[:2], dtype=torch.bool))
    return padded.cpu().numpy()
