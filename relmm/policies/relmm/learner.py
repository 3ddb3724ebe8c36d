"""Training of the grasp ensemble from attempts, online or from LeRobot's batches."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from relmm.features import ACTION_NAMES, Phase, Skill, xy_to_cell
from relmm.policies.learning import Learner
from relmm.policies.relmm.grasping import AREA, GraspEnsemble

_SKILL, _X, _Y = (ACTION_NAMES.index(name) for name in ("skill.pos", "skill_x.pos", "skill_y.pos"))
_SCALE = 127.0  # of stored floor, -1..1, as int8


class Attempts:
    """The newest attempts: the floor before each, the cell, and whether it picked something up.

    Args:
        capacity: attempts; one takes 1.6 kB.

    Attributes:
        added: how many have ever been added.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._areas = np.empty((capacity, 3, AREA, AREA), np.int8)  # no memory until written to
        self._cells, self._successes = np.empty(capacity, np.int64), np.empty(capacity, bool)
        self._rows: dict[int, int] = {}  # by name
        self._names: dict[int, int] = {}  # by row
        self.added = 0

    def add(self, area: Tensor, action: NDArray[np.float32], success: bool, name: int | None = None) -> None:
        """Take one.

        Args:
            area: the floor before it, as `GraspEnsemble.area` draws it, (3, 23, 23).
            action: by `relmm.features.ACTION_NAMES`.
            success: whether something was picked up.
            name: of its frame; another picture of the same frame takes the place of the first.
        """
        row = self._rows.get(name, -1) if name is not None else -1
        if row < 0:
            row, self.added = self.added % self._capacity, self.added + 1
            self._rows.pop(self._names.pop(row, -1), None)  # whose place it takes
            if name is not None:
                self._rows[name], self._names[row] = row, name
        self._areas[row] = (area * _SCALE).round().cpu().numpy()
        self._cells[row], self._successes[row] = xy_to_cell(float(action[_X]), float(action[_Y])), success

    def __len__(self) -> int:
        return min(self.added, self._capacity)

    def all(self, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
        """All of them, as `GraspEnsemble.loss` takes them."""
        return self._get(np.arange(len(self)), device)

    def sample(self, count: int, rng: np.random.Generator, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
        """Some, uniformly, with replacement."""
        return self._get(rng.integers(len(self), size=count), device)

    def _get(self, rows: NDArray[np.int64], device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
        areas = torch.from_numpy(self._areas[rows]).to(device) / _SCALE
        cells, successes = (torch.from_numpy(each[rows]).to(device) for each in (self._cells, self._successes))
        return areas, cells, successes


class ReLMMLearner(Learner):
    """Trains a policy's ensemble.

    Args:
        grasping: to train.
        seed: of the batches.
        capacity: attempts to remember.
    """

    def __init__(self, grasping: GraspEnsemble, seed: int, capacity: int) -> None:
        self._grasping, self._config = grasping, grasping.config
        self.attempts = Attempts(capacity)
        self.rng = np.random.default_rng(seed)
        self.noise = torch.Generator().manual_seed(seed)
        self.optimizers = {"grasping": torch.optim.Adam(grasping.learned(), lr=self._config.learning_rate, fused=True)}
        self.logs = {}

    def add(
        self,
        picture: NDArray[np.uint8],
        state: NDArray[np.float32],
        action: NDArray[np.float32],
        success: bool,
        phase: int,
    ) -> None:
        """See `Learner`: only attempts teach anything."""
        if round(float(action[_SKILL])) == Skill.GRASP:
            self.count_attempt(success)
            self.attempts.add(self._grasping.area(self._grasping.to_pictures(picture))[0], action, success)

    def save_episode(self) -> None:
        """See `Learner`: attempts do not follow on each other."""

    def update_grasping(self, phase: int) -> None:
        """See `Learner`."""
        if len(self.attempts) < self._config.min_attempts_to_update:
            return
        if self._config.freeze_grasping and phase != Phase.CURRICULUM:
            return
        optimizer = self.optimizers["grasping"]
        for _ in range(self._config.updates):
            batch = self.attempts.sample(self._config.batch_size, self.rng, self._grasping.device)
            loss, self.logs = self._grasping.loss(*batch, self.noise)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()

    def update_navigation(self) -> None:
        """See `Learner`: there is nothing to learn, ways are planned."""
