"""What a trained policy thinks of the grasp cells in recorded pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from relmm.errors import ConfigError
from relmm.features import FloatArray
from relmm.policies.relmm.grasping import GraspEnsemble
from relmm.policies.relmm_paper.grasping import GraspEnsemble as PaperEnsemble

_BATCH = 64


class Predictor:
    """The grasp ensemble of a policy.

    Args:
        policy: of the types relmm and relmm_paper.

    Attributes:
        camera: that it has learned with.

    Raises:
        ConfigError: the policy has no grasp ensemble.
    """

    def __init__(self, policy: Any) -> None:
        ensemble = getattr(policy, "grasping", None)
        if not isinstance(ensemble, GraspEnsemble | PaperEnsemble):
            raise ConfigError(
                f"The policy {policy.config.type} has no grasp ensemble that could be asked: choose one of the types "
                "relmm and relmm_paper, or leave --policy.path out."
            )
        self.camera = str(policy.config.camera)
        self._config, self._ensemble = policy.config, ensemble

    @torch.no_grad()
    def __call__(self, images: NDArray[np.uint8]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean and spread of every cell, (n, 225) each, and P[grasp], (n,), of pictures (n, 100, 100, 3)."""
        parts = [self._estimate(images[i : i + _BATCH]) for i in range(0, len(images), _BATCH)]
        mean, std = (np.concatenate(part) for part in zip(*parts, strict=True))
        config = self._config
        chance = getattr(config, "gate_mean_weight", 1.0) * mean + config.gate_std_weight * std
        return mean, std, np.minimum(chance.max(axis=1), 1.0)

    def _estimate(self, images: NDArray[np.uint8]) -> tuple[FloatArray, FloatArray]:
        pictures = torch.from_numpy(images).permute(0, 3, 1, 2)
        if isinstance(self._ensemble, PaperEnsemble):
            device = next(self._ensemble.parameters()).device
            estimate = self._ensemble.estimate(pictures.to(device))
            return estimate.mean.cpu().numpy(), estimate.std.cpu().numpy()
        opinion = self._ensemble.look_at_cells(pictures.to(self._ensemble.device) / 255)
        return opinion[0].cpu().numpy(), opinion[1].cpu().numpy()
