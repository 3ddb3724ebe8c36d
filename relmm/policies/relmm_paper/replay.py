"""The replay: the attempts and navigation steps of a robot's life in memory, with their pictures as uint8."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from relmm.features import IMAGE_SIZE, Phase, Skill

Picture = NDArray[np.uint8]
VELOCITIES = ("x_vel", "theta_vel")  # m/s and deg/s, of a navigation step


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


class Pictures:
    """The newest pictures; each has a number, counted from the first.

    Args:
        capacity: how many; one takes 30 kB.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity, self._added = capacity, 0
        self._pictures: list[Picture] = []  # one by one: an array for all of them may not fit into memory

    def add(self, picture: Picture) -> int:
        """Take one, (100, 100, 3); its number."""
        number, self._added = self._added, self._added + 1
        if number < self._capacity:
            self._pictures.append(picture.copy())
        else:
            self._pictures[number % self._capacity][:] = picture
        return number

    def __getitem__(self, numbers: NDArray[np.int64]) -> NDArray[np.uint8]:
        """By number, (n, 100, 100, 3)."""
        pictures = np.empty((len(numbers), IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
        for row, number in enumerate(numbers.tolist()):
            pictures[row] = self._pictures[number % self._capacity]
        return pictures


class Steps:
    """The newest navigation steps that have led somewhere, with the pictures before and after them.

    Args:
        capacity: steps.
        columns: what is kept of an action.

    Attributes:
        table: `picture` and `next`, the numbers of those pictures in `pictures`, the columns, and `ended`: whether
            nothing follows on the step, because it led to a success, say.
    """

    def __init__(self, capacity: int, *columns: str) -> None:
        self.capacity = capacity
        self.table = Table(picture=np.int64, next=np.int64, ended=bool, **dict.fromkeys(columns, np.float32))
        self.pictures = Pictures(2 * capacity)
        # The last step, until it is known where it led: its picture, that picture's number if it is kept already, and
        # the action's numbers.
        self._open: tuple[Picture, int | None, dict[str, float]] | None = None
        self._closed: tuple[Picture, int] | None = None  # what the last step led to

    def __len__(self) -> int:
        return len(self.table)

    def begin(self, picture: Picture, **action: float) -> None:
        """Take a step, with a number for each column, of which it is not known yet where it leads."""
        known = self._closed is not None and self._closed[0] is picture
        number = self._closed[1] if known and self._closed is not None else None
        self._open = picture, number, action

    def end(self, following: Picture, ended: bool = False) -> None:
        """Say where the last step led, if there is one that is not ended yet."""
        self._closed = None
        if self._open is not None:
            picture, before, action = self._open
            before = self.pictures.add(picture) if before is None else before
            number = self.pictures.add(following)
            self.table.append(picture=before, next=number, ended=ended, **action)
            self._closed = following, number
        self._open = None

    def forget(self) -> None:
        """Drop the last step if nobody knows where it led."""
        self._open = self._closed = None

    def sample(self, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
        """The newest rows, uniformly, with replacement, (count,); there must be one."""
        return rng.integers(max(len(self) - self.capacity, 0), len(self), count)


class Replay:
    """The newest attempts and the newest navigation steps, `capacity` of each, as in the code.

    The random drives of pseudo-resets are no navigation steps, as in the paper; their pictures are not kept.

    Args:
        capacity: attempts, and navigation steps.

    Attributes:
        attempts: `picture` (its number in `attempt_pictures`), `x` and `y` (m), `success`.
        steps: of the policy.
        navigation_steps: how many the policy has made while learning, wherever they led.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.navigation_steps = 0
        self.attempts = Table(picture=np.int64, x=np.float32, y=np.float32, success=bool)
        self.attempt_pictures, self.steps = Pictures(capacity), Steps(capacity, *VELOCITIES)
        self._first_attempt: Picture | None = None  # before the first attempt since the last navigation step

    # --- Filling ------------------------------------------------------------------------------------------
    def add(self, picture: Picture, action: NDArray[np.float32], success: bool, phase: int) -> None:
        """Take one frame, as `relmm.policies.learning.Learner.add` does."""
        x_vel, theta_vel, skill, x, y = (float(value) for value in action)
        if round(skill) == Skill.GRASP:
            self.attempts.append(picture=self.attempt_pictures.add(picture), x=x, y=y, success=success)
            if success:
                self._end_step(picture, success=True)
            elif self._first_attempt is None:
                self._first_attempt = picture
            return
        self._end_step(picture)
        if round(skill) == Skill.NAVIGATE and phase != Phase.PSEUDO_RESET:
            self.navigation_steps += phase == Phase.LEARNING
            self.steps.begin(picture, x_vel=x_vel, theta_vel=theta_vel)

    def save_episode(self) -> None:
        """End the episode: what comes next need not follow on."""
        if self._first_attempt is not None:
            self._end_step(self._first_attempt)
        self.steps.forget()

    def _end_step(self, following: Picture, success: bool = False) -> None:
        self.steps.end(following, success)
        self._first_attempt = None

    # --- Reading ------------------------------------------------------------------------------------------
    def sample_attempts(self, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
        """The newest rows, uniformly, with replacement, (count,); there must be one."""
        return rng.integers(max(len(self.attempts) - self.capacity, 0), len(self.attempts), count)


def to_pictures(pictures: NDArray[np.uint8], device: torch.device) -> torch.Tensor:
    """Pictures as robots give them, uint8 (n, 100, 100, 3), as the networks take them, uint8 (n, 3, 100, 100)."""
    return torch.tensor(pictures, device=device).permute(0, 3, 1, 2)
