"""Pictures for people: the room from above with the robot's own view in the corner."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from relmm.sim.body import SimBody
from relmm.sim.renderer import Renderer, overview_camera

SIZE = (640, 480)  # pixels
_INSET = 150  # pixels, side of the robot's view
_BORDER = 2


class Film:
    """Looks at a simulated robot through a third-person camera.

    Args:
        body: what to look at.
    """

    def __init__(self, body: SimBody) -> None:
        self._body = body
        self._renderer = Renderer(body.model, overview_camera(body.room.size), SIZE)
        self.frames: list[NDArray[np.uint8]] = []

    def frame(self) -> NDArray[np.uint8]:
        """One picture, uint8 (480, 640, 3)."""
        picture, _ = self._renderer.render(self._body.data)
        rgb, _ = self._body.capture()
        view = cv2.resize(rgb, (_INSET, _INSET), interpolation=cv2.INTER_NEAREST)
        view = cv2.copyMakeBorder(view, *(_BORDER,) * 4, cv2.BORDER_CONSTANT, value=(255, 255, 255))
        picture[8 : 8 + view.shape[0], 8 : 8 + view.shape[1]] = view
        return picture

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()
