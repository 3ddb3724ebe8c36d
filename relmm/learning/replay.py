"""The replay: the frames of a robot's life in memory, and the attempts and navigation steps among them.

It takes frames as the durable dataset does (`add_frame`, `save_episode`) and can be rebuilt from it at any time, so it
is never saved itself. Pictures are kept once, as uint8; a step's next picture is that of a later frame.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from relmm.features import (
    ACTION_NAMES,
    FRONT,
    IMAGE_SIZE,
    MAX_THETA_VEL,
    MAX_X_VEL,
    Phase,
    Skill,
    xy_to_cell,
)


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

    def rows(self, indices: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """Some rows, by column."""
        return {name: column[indices] for name, column in self._columns.items()}

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._columns[name][: self._length]


class Replay:
    """Frames, attempts and navigation steps.

    A frame's number counts from the first frame ever added; the newest `capacity` frames are kept.

    Args:
        capacity: frames; a picture takes 30 kB.

    Attributes:
        attempts: `frame`, `cell`, `success`.
        steps: navigation steps: `frame`, `next` (frame of the picture after it), `forward` and `turn` (-1..1) and
            `success`, and whether grasps were `attempted` after it.
        pseudo_reset_steps: those of pseudo-resets, likewise.
        frames: how many have ever been added.
        episodes: how many have been completed.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.frames = self.episodes = self.navigation_steps = 0
        self.attempts = Table(frame=np.int64, cell=np.int64, success=bool)
        columns: dict[str, type] = {"frame": np.int64, "next": np.int64, "forward": np.float32, "turn": np.float32}
        columns |= {"success": bool, "attempted": bool}
        self.steps, self.pseudo_reset_steps = Table(**columns), Table(**columns)
        self._pictures = np.empty((capacity, IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)  # no memory until written to
        self._motions = np.zeros((capacity, 2), np.float32)
        self._open_step: dict[str, float] | None = None  # the last navigation step, until it is known where it led
        self._open_table = self.steps  # that it belongs to
        self._first_attempt: int | None = None  # frame of the first attempt since then

    # --- Filling ------------------------------------------------------------------------------------------
    def add_frame(
        self, observation: dict[str, Any], action: dict[str, float], outcome: dict[str, Any], task: str
    ) -> None:
        """Take one frame, as `relmm.episodes.EpisodeRecorder.add_frame` does."""
        values = [action[name] for name in ACTION_NAMES]
        motion = (observation["x.vel"], observation["theta.vel"])
        phase = int(outcome["complementary_info.phase"])
        self.add(observation[FRONT], motion, values, outcome["next.reward"] > 0, phase)

    def add(
        self, picture: NDArray[np.uint8], motion: tuple[float, float], action: Any, success: bool, phase: int
    ) -> None:
        """Take one frame.

        Args:
            picture: (100, 100, 3).
            motion: velocities of `observation.state`, m/s and deg/s.
            action: by `relmm.features.ACTION_NAMES`, length 5.
            success: whether this frame's attempt picked something up.
            phase: a `relmm.features.Phase`.
        """
        frame, self.frames = self.frames, self.frames + 1
        self._pictures[frame % self.capacity] = picture
        self._motions[frame % self.capacity] = motion
        x_vel, theta_vel, skill, x, y = (float(value) for value in action)
        if round(skill) == Skill.GRASP:
            self.attempts.append(frame=frame, cell=xy_to_cell(x, y), success=success)
            if success:
                self._close_step(frame, success=True)
            elif self._first_attempt is None:
                self._first_attempt = frame
            return
        self._close_step(frame)
        if round(skill) == Skill.NAVIGATE:
            self.navigation_steps += phase == Phase.LEARNING
            forward, turn = x_vel / MAX_X_VEL * 2 - 1, theta_vel / MAX_THETA_VEL
            self._open_step = {"frame": frame, "forward": forward, "turn": turn}
            self._open_table = self.pseudo_reset_steps if phase == Phase.PSEUDO_RESET else self.steps

    def save_episode(self) -> None:
        """End the episode: what comes next need not follow on."""
        if self._first_attempt is not None:
            self._close_step(self._first_attempt)
        self._open_step = self._first_attempt = None
        self.episodes += 1

    def _close_step(self, following: int, success: bool = False) -> None:
        if self._open_step is not None:
            attempted = success or self._first_attempt is not None
            self._open_table.append(**self._open_step, next=following, success=success, attempted=attempted)
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

    def motions(self, frames: NDArray[np.int64]) -> NDArray[np.float32]:
        """Velocities of the last navigation steps before frames, m/s and deg/s, shaped (..., 2)."""
        return self._motions[frames % self.capacity]

    def chains(self, table: Table, rows: NDArray[np.int64], length: int, most: int) -> dict[str, NDArray[Any]]:
        """Navigation steps and those that followed on them, until a success.

        Args:
            table: `steps` or `pseudo_reset_steps`.
            rows: the first ones', (n,).
            length: that all are padded to.
            most: steps of a chain, at most `length`.

        Returns:
            `frames`, before and after each step, (n, length + 1), and its `success` and whether grasps were
            `attempted`, (n, length), where what lies behind the end repeats it; `lengths`, (n,); and `actions`, the
            first steps' `forward` and `turn`, (n, 2).
        """
        indices = rows[:, None] + np.arange(length)
        columns = table.rows(np.minimum(indices, len(table) - 1))
        follows = (columns["frame"][:, 1:] == columns["next"][:, :-1]) & ~columns["success"][:, :-1]
        follows[:, most - 1 :] = False
        lengths = 1 + np.logical_and.accumulate(follows & (indices[:, 1:] < len(table)), axis=1).sum(axis=1)
        last = np.minimum(np.arange(length), lengths[:, None] - 1)
        after, success, attempted = (
            np.take_along_axis(columns[name], last, axis=1) for name in ("next", "success", "attempted")
        )
        return {
            "frames": np.concatenate([columns["frame"][:, :1], after], axis=1),
            "success": success,
            "attempted": attempted,
            "lengths": lengths,
            "actions": np.stack([columns["forward"][:, 0], columns["turn"][:, 0]], axis=1),
        }

    def available(self, table: Table) -> int:
        """How many rows of one of the tables have pictures that are still there."""
        return len(table) - self._first(table)

    def sample(self, table: Table, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
        """Such rows, uniformly, with replacement, (count,); there must be one."""
        return rng.integers(self._first(table), len(table), count)

    def sample_frames(self, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
        """Any frames whose pictures are still there, uniformly, with replacement, (count,)."""
        return rng.integers(max(self.frames - self.capacity, 0), self.frames, count)

    def _first(self, table: Table) -> int:
        return int(np.searchsorted(table["frame"], self.frames - self.capacity))


def to_pictures(pictures: NDArray[np.uint8], device: torch.device) -> torch.Tensor:
    """Stored pictures as the networks take them: uint8 (n, 100, 100, 3) -> 0..1, (n, 3, 100, 100)."""
    return torch.from_numpy(pictures).to(device).permute(0, 3, 1, 2) / 255
