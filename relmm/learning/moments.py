"""The moments of Adam in a training state, which may come from anybody.

They are all that is taken from a stored optimiser: its settings, such as the learning rate, are the run's own.
"""

from __future__ import annotations

from pathlib import Path

import torch
from lerobot.utils.constants import OPTIMIZER_STATE
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file
from torch import Tensor

from relmm.errors import ConfigError
from relmm.learning.untrusted import check_tensors

# Moments of real gradients obey |m| <= 7.3 sqrt(v) (Cauchy-Schwarz, with betas 0.9 and 0.999), but for underflow. So
# no forged ones make a step longer than about ten learning rates.
_RATIO, _UNDERFLOW = 10.0, 1e-15


def load_moments(optimizers: dict[str, torch.optim.Optimizer], folder: Path) -> None:
    """Give Adam optimisers the moments that LeRobot's `save_optimizer_state` has written.

    Args:
        optimizers: by name, with the weights that the moments belong to.
        folder: of the training state.

    Raises:
        ConfigError: a file is missing, damaged, of other weights, or has moments that no gradients have.
    """
    for name, optimizer in optimizers.items():
        path = folder / name / OPTIMIZER_STATE
        weights = [weight for group in optimizer.param_groups for weight in group["params"]]
        check_tensors(path, _expected(path, weights))
        stored = load_file(path)
        state = {
            index: {key: stored[f"state/{index}/{key}"] for key in ("step", "exp_avg", "exp_avg_sq")}
            for index in range(len(weights))
            if f"state/{index}/step" in stored
        }
        for index, moments in state.items():
            step, mean, square = moments.values()
            if step < 0 or (square < 0).any() or (mean.abs() > _RATIO * square.sqrt() + _UNDERFLOW).any():
                raise ConfigError(f"{path} has moments of weight {index} that no gradients have; resume another.")
        optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})


def _expected(path: Path, weights: list[Tensor]) -> dict[str, Tensor]:
    """What the file must hold: all moments of each weight that has any."""
    try:
        with safe_open(path, framework="pt") as file:
            names = set(file.keys())
    except (SafetensorError, OSError) as error:
        raise ConfigError(f"{path} cannot be read ({' '.join(str(error).split())}); resume another.") from error
    expected: dict[str, Tensor] = {}
    for index, weight in enumerate(weights):
        if any(name.startswith(f"state/{index}/") for name in names):
            moments = dict.fromkeys(("exp_avg", "exp_avg_sq"), weight) | {"step": torch.tensor(0.0)}
            expected |= {f"state/{index}/{key}": like for key, like in moments.items()}
    return expected
