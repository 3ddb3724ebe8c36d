"""What the ensemble made of the replay's frames: navigation observations and P[grasp], kept up to date.

Both change whenever the ensemble learns. To ask it about every frame of every batch would cost more than all else, so
the last answer is kept, and the most outdated frames of a batch are asked about again.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from relmm.learning.replay import Replay
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy

_NEVER = -1
_CHUNK = 32  # frames that go through the ensemble at once


class Maps:
    """Navigation observations and P[grasp] of the replay's frames.

    Args:
        policy: whose ensemble and observer.
        replay: whose frames.
    """

    def __init__(self, policy: ReLMMPolicy, replay: Replay) -> None:
        self._policy, self._replay = policy, replay
        shape = (replay.capacity, *policy.observer.shape)
        self._observations = np.empty(shape, np.uint8)  # no memory until written to
        self._probabilities = np.empty(replay.capacity, np.float32)
        self._versions = np.full(replay.capacity, _NEVER, np.int64)
        self._owners = np.full(replay.capacity, _NEVER, np.int64)  # which frame an entry is of
        self.version = 0  # of the ensemble; counts its updates

    def get(self, frames: NDArray[np.int64], refresh: int) -> tuple[Tensor, Tensor]:
        """Observations, uint8 (n, ...), and P[grasp], (n,), of frames.

        Args:
            frames: numbers, (n,).
            refresh: how many outdated ones to compute anew; 0 for all of them.
        """
        unique = np.unique(frames)
        slots = unique % self._replay.capacity
        versions = np.where(self._owners[slots] == unique, self._versions[slots], _NEVER)
        order = np.argsort(versions, kind="stable")
        outdated = order[versions[order] < self.version]
        missing = int(np.count_nonzero(versions == _NEVER))
        count = len(outdated) if refresh == 0 else max(missing, min(refresh, len(outdated)))
        for start in range(0, count, _CHUNK):
            self._compute(unique[outdated[start : min(start + _CHUNK, count)]])
        slots = frames % self._replay.capacity
        device = self._policy.weights_device
        observations = torch.from_numpy(self._observations[slots]).to(device)
        return observations, torch.from_numpy(self._probabilities[slots]).to(device)

    def _compute(self, frames: NDArray[np.int64]) -> None:
        pictures = to_pictures(self._replay.pictures(frames), self._policy.weights_device)
        grasping, slots = self._policy.grasping, frames % self._replay.capacity
        self._observations[slots] = self._policy.observer(pictures, grasping).cpu().numpy()
        self._probabilities[slots] = grasping.grasp_probability(grasping.estimate(pictures)).cpu().numpy()
        self._versions[slots], self._owners[slots] = self.version, frames


def to_pictures(pictures: NDArray[np.uint8], device: torch.device) -> Tensor:
    """Stored pictures as the networks take them: uint8 (n, 100, 100, 3) -> 0..1, (n, 3, 100, 100)."""
    return torch.from_numpy(pictures).to(device).permute(0, 3, 1, 2) / 255
