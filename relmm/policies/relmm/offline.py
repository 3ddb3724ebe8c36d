"""Attempts in LeRobot's batches, which show single frames in any order, and how they ended."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from relmm.features import ACTION_NAMES, IMAGE_KEY, STATE_KEY, STATE_NAMES, Skill, carried_out
from relmm.policies.learning import no_rewards
from relmm.policies.relmm.grasping import GraspEnsemble

_SKILL, _HOLDING = ACTION_NAMES.index("skill.pos"), STATE_NAMES.index("holding.pos")
_WAITING = 4096  # attempts, 6 kB each; a dataset shows what is forgotten again


_Frame = tuple[int, int]  # its episode and index


@dataclass
class Attempt:
    """A grasp.

    Attributes:
        area: the floor before it, as `GraspEnsemble.area` draws it, (3, 23, 23).
        action: by `relmm.features.ACTION_NAMES`.
        index: of its frame; None where the batch does not tell.
    """

    area: Tensor
    action: NDArray[np.float32]
    index: int | None


class BatchReader:
    """Reads attempts from batches; where a dataset has no rewards, the frame after an attempt tells how it ended.

    Args:
        grasping: draws the floor.
    """

    def __init__(self, grasping: GraspEnsemble) -> None:
        self._grasping = grasping
        self._holding: dict[_Frame, bool] = {}  # before each
        self._waiting: deque[tuple[Attempt, _Frame]] = deque(maxlen=_WAITING)  # attempts, and the frame after each

    def read(self, batch: dict[str, Any]) -> Iterator[tuple[Attempt, bool]]:
        """Attempts, of this batch or of earlier ones, of which it is now known whether they picked something up.

        Args:
            batch: as `ReLMMPolicy.forward` takes it.

        Raises:
            ConfigError: neither rewards, nor what tells them.
        """
        actions, rewards = batch["action"].float().cpu().numpy(), batch.get("next.reward")
        if isinstance(rewards, Tensor):  # LeRobot puts in the number 0 where there is no column
            successes = rewards.flatten().cpu().numpy() > 0.5
            for row, attempt in self._attempts(batch, actions):
                yield attempt, bool(successes[row])
            return
        if not {STATE_KEY, "episode_index", "index"} <= batch.keys():
            raise no_rewards()
        holding = batch[STATE_KEY][:, _HOLDING].cpu().numpy() > 0.5
        episodes, indices = (batch[key].flatten().tolist() for key in ("episode_index", "index"))
        self._holding |= dict(zip(zip(episodes, indices, strict=True), holding.tolist(), strict=True))
        asked = [*self._waiting]
        self._waiting.clear()
        for row, attempt in self._attempts(batch, carried_out(actions, holding)):
            asked.append((attempt, (episodes[row], indices[row] + 1)))
        for attempt, after in asked:
            if after in self._holding:
                yield attempt, self._holding[after]
            else:
                self._waiting.append((attempt, after))

    def _attempts(self, batch: dict[str, Any], actions: NDArray[np.float32]) -> Iterator[tuple[int, Attempt]]:
        """Those of a batch, with their rows."""
        rows = np.flatnonzero(actions[:, _SKILL].round() == Skill.GRASP)
        areas = self._grasping.area(batch[IMAGE_KEY][torch.from_numpy(rows)])
        indices = batch["index"].flatten().tolist() if "index" in batch else [None] * len(actions)
        for row, area in zip(rows.tolist(), areas, strict=True):
            yield row, Attempt(area, actions[row], indices[row])
