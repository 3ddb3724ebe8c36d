"""The replay: the frames of a robot's life in memory, and the attempts and navigation steps among them.

Pictures are kept once, as uint8; a step's next picture is that of a later frame.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from relmm.features import IMAGE_SIZE, Phase, Skill, xy_to_cell


class Table:
    """Columns of numbers that grow by rows.

    Args:
        dtypes: of each column.
    """

    def __init__(self, **dtypes: type) -> None:
        self._columns: dict[str, NDArray[Any]] = {name: np.zeros(1024, dtype) for name, dtype in dtypes.items()}
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def append(self, **values: float) -> None:
        """Add a row, with a value for each column."""
        for name, column in self._columns.items():
            if self._length == len(column):
                self._columns[name] = column = np.concatenate([column, np.zeros_like(column)])
            column[self._length] = values[name]
        self._length += 1

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._columns[name][: self._length]


class Replay:
    """Frames, attempts and navigation steps.

    A frame's number counts from the first frame ever added; the newest `capacity` frames are kept. The random drives of
    pseudo-resets are no navigation steps, as in the paper.

    Args:
        capacity: frames; a picture takes 30 kB.

    Attributes:
        attempts: `frame`, `cell`, `success`.
        steps: navigation steps that have led somewhere: `frame`, `next` (frame of the picture after it), `x_vel` and
            `theta_vel` (m/s and deg/s), and `success`.
        navigation_steps: how many the policy has made while learning, wherever they led.
        frames: how many have ever been added.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.frames = self.navigation_steps = 0
        self.attempts = Table(frame=np.int64, cell=np.int64, success=bool)
        self.steps = Table(frame=np.int64, next=np.int64, x_vel=np.float32, theta_vel=np.float32, success=bool)
        self._pictures = np.empty((capacity, IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)  # no memory until written to
        self._open_step: dict[str, float] | None = None  # the last navigation step, until it is known where it led
        self._first_attempt: int | None = None  # frame of the first attempt since then

    # --- Filling ------------------------------------------------------------------------------------------
    def add(self, picture: NDArray[np.uint8], action: NDArray[np.float32], success: bool, phase: int) -> None:
        """Take one frame, as `relmm.policies.learning.Learner.add` does."""
        frame, self.frames = self.frames, self.frames + 1
        self._pictures[frame % self.capacity] = picture
        x_vel, theta_vel, skill, x, y = (float(value) for value in action)
        if round(skill) == Skill.GRASP:
            self.attempts.append(frame=frame, cell=xy_to_cell(x, y), success=success)
            if success:
                self._close_step(frame, success=True)
            elif self._first_attempt is None:
                self._first_attempt = frame
            return
        self._close_step(frame)
        if round(skill) == Skill.NAVIGATE and phase != Phase.PSEUDO_RESET:
            self.navigation_steps += phase == Phase.LEARNING
            self._open_step = {"frame": frame, "x_vel": x_vel, "theta_vel": theta_vel}

    def save_episode(self) -> None:
        """End the episode: what comes next need not follow on."""
        if self._first_attempt is not None:
            self._close_step(self._first_attempt)
        self._open_step = self._first_attempt = None

    def _close_step(self, following: int, success: bool = False) -> None:
        if self._open_step is not None:
            self.steps.append(**self._open_step, next=following, success=success)
        self._open_step = self._first_attempt = None

    # --- Reading ------------------------------------------------------------------------------------------
    @property
    def attempts_since_first_success(self) -> int:
        """How many attempts there were from the first that succeeded on, 0 if none has."""
        successes = self.attempts["success"]
        return len(successes) - int(successes.argmax()) if successes.any() else 0

    def pictures(self, frames: NDArray[np.int64]) -> NDArray[np.uint8]:
        """The pictures of frames, uint8 (n, 100, 100, 3)."""
        return self._pictures[frames % self.capacity]

    def available(self, table: Table) -> int:
        """How many rows of one of the tables have pictures that are still there."""
        return len(table) - self._first(table)

    def sample(self, table: Table, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
        """Such rows, uniformly, with replacement, (count,); there must be one."""
        return rng.integers(self._first(table), len(table), count)

    def _first(self, table: Table) -> int:
        return int(np.searchsorted(table["frame"], self.frames - self.capacity))


def to_pictures(pictures: NDArray[np.uint8], device: torch.device) -> torch.Tensor:
    """Pictures as robots give them, uint8 (n, 100, 100, 3), as the networks take them, uint8 (n, 3, 100, 100)."""
    return torch.tensor(pictures, device=device).permute(0, 3, 1, 2)
