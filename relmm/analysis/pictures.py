"""What a picture says about an attempt: the floor within reach as a small PNG, its light, and what lay at the spot."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from relmm.features import GRASP_X, GRASP_Y, IMAGE_SIZE, FloatArray
from relmm.geometry import OBJECT_HEIGHT, CameraGeometry

_MARGIN = 0.04  # m of floor round the grasp area
_SPOT = 4  # pixels either side of where the gripper goes
_GREY = 0.25  # below this saturation a thing has no colour
_DARK, _WHITE = 0.25, 0.75
# Where on the colour circle each ends, degrees.
_HUES = ((20, "red"), (70, "yellow"), (165, "green"), (260, "blue"), (330, "purple"), (361, "red"))
COLOURS = ("red", "yellow", "green", "blue", "purple", "white", "grey", "dark")


@dataclass(frozen=True)
class Look:
    """What an attempt's picture shows.

    Attributes:
        picture: the floor within reach, PNG.
        light: mean brightness of the whole picture, 0..1.
        colour: one of `COLOURS`, of the most colourful pixels at the attempted spot.
    """

    picture: bytes
    light: float
    colour: str


class Viewer:
    """Looks at the pictures of one camera.

    Args:
        camera: None if it is not known: then pictures are kept whole, and what lies at a spot cannot be told.
    """

    def __init__(self, camera: CameraGeometry | None) -> None:
        self._camera = camera
        self._crop = (slice(None), slice(None)) if camera is None else _reach(camera)

    def look(self, image: NDArray[np.uint8], x: float, y: float) -> Look:
        """An attempt at x, y (m, robot frame) in a picture, (100, 100, 3) RGB."""
        _, png = cv2.imencode(".png", np.ascontiguousarray(image[self._crop][..., ::-1]))
        return Look(png.tobytes(), float(image.mean() / 255), self._colour(image, x, y))

    def _colour(self, image: NDArray[np.uint8], x: float, y: float) -> str:
        if self._camera is None:
            return ""
        pixel = self._camera.project(np.array([x, y, OBJECT_HEIGHT]))
        if not (np.isfinite(pixel).all() and (pixel >= 0).all() and (pixel < IMAGE_SIZE).all()):
            return ""
        column, row = pixel.round().astype(int)
        part = image[max(row - _SPOT, 0) : row + _SPOT + 1, max(column - _SPOT, 0) : column + _SPOT + 1]
        return name_of(_most_colourful(part.reshape(-1, 3) / 255))


def name_of(rgb: FloatArray) -> str:
    """The name in `COLOURS` of a colour, 0..1, (3,)."""
    hue, saturation, value = colorsys.rgb_to_hsv(*rgb)
    if value < _DARK:
        return "dark"
    if saturation < _GREY:
        return "white" if value > _WHITE else "grey"
    return next(name for end, name in _HUES if hue * 360 < end)


def _most_colourful(pixels: FloatArray) -> FloatArray:
    """The mean of the tenth of the pixels that differ most from grey: floor is greyer than what lies on it."""
    chroma = pixels.max(axis=1) - pixels.min(axis=1)
    most: FloatArray = pixels[np.argsort(chroma)[-max(len(pixels) // 10, 1) :]].mean(axis=0)
    return most


def _reach(camera: CameraGeometry) -> tuple[slice, slice]:
    """Rows and columns of a picture that show the grasp area."""
    x = np.array([GRASP_X[0] - _MARGIN, GRASP_X[1] + _MARGIN])
    y = np.array([GRASP_Y[0] - _MARGIN, GRASP_Y[1] + _MARGIN])
    corners = np.stack([*np.meshgrid(x, y), np.zeros((2, 2))], axis=-1)
    pixels = camera.project(corners).reshape(-1, 2)
    (left, top), (right, bottom) = np.floor(pixels.min(axis=0)), np.ceil(pixels.max(axis=0))
    return (
        slice(max(int(top), 0), min(int(bottom), IMAGE_SIZE)),
        slice(max(int(left), 0), min(int(right), IMAGE_SIZE)),
    )
