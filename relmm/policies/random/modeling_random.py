"""The paper's "Rand all" baseline."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from relmm.features import GRID
from relmm.policies.controller import Row, UntrainedPolicy, grasp_cell
from relmm.policies.pseudo_reset import drive_anywhere
from relmm.policies.random.configuration_random import RelmmRandomConfig


class RelmmRandomPolicy(UntrainedPolicy):
    """Drives and grasps uniformly at random."""

    config_class = RelmmRandomConfig
    name = "relmm_random"
    config: RelmmRandomConfig

    def decide(self, image: NDArray[np.uint8], state: NDArray[np.float32], row: Row) -> dict[str, float]:
        """See `ControllerPolicy.decide`; the picture is ignored."""
        driven = row.memory.get("driven", False)
        if driven and row.attempts == 0:
            row.memory["grasping"] = row.rng.random() < self.config.grasp_probability
        row.memory["driven"] = True
        if row.memory.get("grasping") and row.attempts < self.config.num_grasp:
            return grasp_cell(int(row.rng.integers(GRID**2)))
        return drive_anywhere(row.rng)
