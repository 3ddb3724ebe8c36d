"""What the ensemble made of recorded frames: navigation observations and P[grasp], kept up to date.

Both change whenever the ensemble learns. To ask it about every frame of every batch would cost more than all else, so
the last answer is kept, and the most outdated frames of a batch are asked about again.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from relmm.policies.relmm.encoders import FloorObserver, PictureObserver
from relmm.policies.relmm.grasping import GraspEnsemble

_NEVER = -1
_CHUNK = 32  # frames that go through the ensemble at once

Frames = NDArray[np.int64]


class Maps:
    """Navigation observations and P[grasp] of numbered frames.

    Args:
        observer: makes the observations.
        grasping: the ensemble.
        capacity: frames to remember; what shares its number modulo `capacity` is computed anew each time.

    Attributes:
        version: of the ensemble; to be counted up when it learns.
    """

    def __init__(self, observer: FloorObserver | PictureObserver, grasping: GraspEnsemble, capacity: int) -> None:
        self._observer, self._grasping, self._capacity = observer, grasping, capacity
        self._observations = np.empty((capacity, *observer.shape), np.uint8)  # no memory until written to
        self._probabilities = np.empty(capacity, np.float32)
        self._versions = np.full(capacity, _NEVER, np.int64)
        self._owners = np.full(capacity, _NEVER, np.int64)  # which frame an entry is of
        self.version = 0

    def get(self, frames: Frames, pictures: Callable[[Frames], Tensor], refresh: int) -> tuple[Tensor, Tensor]:
        """Observations, uint8 (n, ...), and P[grasp], (n,), of frames.

        Args:
            frames: numbers, (n,).
            pictures: gives those of some of the frames, 0..1, (k, 3, 100, 100).
            refresh: how many outdated ones to compute anew; 0 for all of them.
        """
        unique = np.unique(frames)
        slots = unique % self._capacity
        versions = np.where(self._owners[slots] == unique, self._versions[slots], _NEVER)
        order = np.argsort(versions, kind="stable")
        outdated = order[versions[order] < self.version]
        missing = int(np.count_nonzero(versions == _NEVER))
        count = len(outdated) if refresh == 0 else max(missing, min(refresh, len(outdated)))
        for start in range(0, count, _CHUNK):
            chosen = unique[outdated[start : min(start + _CHUNK, count)]]
            self._compute(chosen, pictures(chosen))
        slots = frames % self._capacity
        observations, probabilities = self._observations[slots], self._probabilities[slots]
        lost = self._owners[slots] != frames  # to another frame of this very answer
        if lost.any():
            observations[lost], probabilities[lost] = self._look(pictures(frames[lost]))
        return torch.from_numpy(observations), torch.from_numpy(probabilities)

    def _compute(self, frames: Frames, pictures: Tensor) -> None:
        slots = frames % self._capacity
        self._observations[slots], self._probabilities[slots] = self._look(pictures)
        self._versions[slots], self._owners[slots] = self.version, frames

    def _look(self, pictures: Tensor) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        probabilities = self._grasping.grasp_probability(self._grasping.estimate(pictures))
        return self._observer(pictures, self._grasping).cpu().numpy(), probabilities.cpu().numpy()
