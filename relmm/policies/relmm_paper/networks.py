"""What the paper's networks are built of: convolutions over a picture, dense layers, and how Keras initialises them."""

from __future__ import annotations

import torch
from torch import Tensor, nn


def scaled(pictures: Tensor, gain: float = 1.0) -> Tensor:
    """Uint8 pictures, (batch, 3, height, width), as networks see them, in the fastest memory layout for convolutions.

    Args:
        pictures: as robots take them.
        gain: 1 for -1..1, 255 for -1..509.
    """
    return (pictures.float() * (gain / 127.5) - 1).contiguous(memory_format=torch.channels_last)


def strided_convolutions(width: int) -> list[nn.Module]:
    """Three of kernel 3 and stride 2, and what they give as one vector; sides are halved and rounded up."""
    layers = [(nn.Conv2d(inputs, width, 3, stride=2, padding=1), nn.ReLU()) for inputs in (3, width, width)]
    return [*(part for layer in layers for part in layer), nn.Flatten()]


def pooled_convolutions(width: int) -> list[nn.Module]:
    """Three of kernel 3 and stride 1 with average pooling after each, as in the code (the paper: between them)."""
    layers = [(nn.Conv2d(inputs, width, 3, padding=1), nn.ReLU(), nn.AvgPool2d(2)) for inputs in (3, width, width)]
    return [*(part for layer in layers for part in layer), nn.Flatten()]


def dense_layers(inputs: int, hidden: int, outputs: int) -> list[nn.Module]:
    """Two hidden layers and a linear one."""
    return [nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, outputs)]


def initialised(layers: list[nn.Module]) -> nn.Sequential:
    """A network of these layers, with weights as Keras draws them by default: Glorot uniform, and no bias."""
    for layer in layers:
        if isinstance(layer, nn.Conv2d | nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            assert layer.bias is not None
            nn.init.zeros_(layer.bias)
    return nn.Sequential(*layers)
