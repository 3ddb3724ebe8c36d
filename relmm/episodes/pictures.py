"""Pictures as they are stored in a dataset, which may come from anybody."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from relmm.features import IMAGE_SIZE

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def decode_picture(file: bytes | None) -> NDArray[np.uint8]:
    """A picture of the robot's camera, (100, 100, 3), RGB.

    Args:
        file: PNG.

    Raises:
        ValueError: it is missing, damaged, no PNG, or of another shape; its size is looked at before it is unpacked.
        cv2.error: OpenCV refuses it.
    """
    shape = (IMAGE_SIZE, IMAGE_SIZE, 3)
    if not file:
        raise ValueError("it is not in the file, which has only its name")
    # The size is in the first bytes; a small file may claim gigabytes of pixels.
    if file[:8] != _PNG_SIGNATURE:
        raise ValueError("it is no PNG")
    width, height = (int.from_bytes(file[i : i + 4], "big") for i in (16, 20))
    if (height, width) != shape[:2]:
        raise ValueError(f"it has the shape {(height, width)}, and {shape[:2]} is needed")
    picture = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise ValueError("it is damaged")
    if picture.shape != shape:
        raise ValueError(f"it has the shape {picture.shape}, and {shape} is needed")
    return picture[..., ::-1].astype(np.uint8)  # OpenCV's order is BGR
