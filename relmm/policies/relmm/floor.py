"""The floor as a map: pictures of a camera that is fixed to the robot, seen from straight above.

One row of a map is a strip of floor across the robot, from near to far; columns run from right to left, so that rows
and columns count as the grasp cells of `relmm.features` do. A pixel of the finest map is one grasp cell.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from relmm.features import GRASP_X, GRASP_Y, GRID
from relmm.geometry import OBJECT_HEIGHT, CameraGeometry


class FloorView(nn.Module):
    """Draws a rectangle of floor, aligned with the grasp cells, from pictures.

    Args:
        camera: that takes the pictures.
        first_row, first_column: grid index of the rectangle's nearest and rightmost cell; the grasp area is 0..14.
        rows, columns: of the map, in grasp cells.
    """

    grid: Tensor

    def __init__(self, camera: CameraGeometry, first_row: int, first_column: int, rows: int, columns: int) -> None:
        super().__init__()
        x = GRASP_X[0] + (first_row + np.arange(rows) + 0.5) * (GRASP_X[1] - GRASP_X[0]) / GRID
        y = GRASP_Y[0] + (first_column + np.arange(columns) + 0.5) * (GRASP_Y[1] - GRASP_Y[0]) / GRID
        points = np.stack([*np.meshgrid(x, y, indexing="ij"), np.full((rows, columns), OBJECT_HEIGHT)], axis=-1)
        # grid_sample counts from the picture's left and upper edge, -1, to its right and lower one, 1.
        grid = 2 * (camera.project(points) + 0.5) / np.array(camera.size) - 1
        grid = np.where(np.isfinite(grid), grid, 2.0)  # behind the camera: outside
        self.register_buffer("grid", torch.from_numpy(grid.astype(np.float32)), persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        """The map of each picture.

        Args:
            images: 0..1, (batch, channels, height, width).

        Returns:
            -1..1, and 0 for what is out of view, (batch, channels, rows, columns).
        """
        return self.at(images, self.grid.expand(len(images), -1, -1, -1))

    def at(self, images: Tensor, grid: Tensor) -> Tensor:
        """The same for other parts of `grid`, one of each picture, (batch, h, w, 2) -> (batch, channels, h, w)."""
        return functional.grid_sample(images * 2 - 1, grid, mode="bilinear", align_corners=False)
