"""Finds small things on the floor in one colour picture: local contrast, contours, centroids on the floor."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from relmm.features import FloatArray
from relmm.geometry import CameraGeometry

OBJECT_HEIGHT = 0.015  # m, about the middle of an object: the plane onto which centroids are projected

# A median over a window that objects fill less than half of is the picture without them. Straight edges (walls, planks,
# rugs) survive it, so only small things differ from it.
_MEDIAN = 13  # pixels; the largest object, 4 cm at the nearest grasp cell, covers 9 x 7
_CONTRAST = 30  # of 255; grain and joints of planks rarely differ more, balls and most toys do
_MIN_PIXELS = 2  # a single one is noise, such as a joint between walls
_SIZE = (0.014, 0.055)  # m, diameter of a disc of a blob's area
_MAX_LENGTH = 0.065  # m, longer side of a blob's bounding box; joints and slivers of furniture are longer
_RING = 2  # pixels round a blob in which everything must look different from it
_RING_SHARE = 0.9
# Patterns and the ragged edges of rugs look like many objects close together; 20 objects on 9 m^2 hardly ever do.
_CROWD_RADIUS, _CROWD = 0.25, 4  # m, and how many within that, itself included, are a pattern


def local_contrast(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """How much each pixel differs from its surroundings, in the colour channel that differs most.

    The paper thresholds brightness instead, in which a yellow toy is hardly seen on a wooden floor.

    Args:
        image: RGB, (height, width, 3).

    Returns:
        A grey picture, (height, width).
    """
    return np.asarray(cv2.absdiff(image, cv2.medianBlur(image, _MEDIAN)).max(axis=2))


def detect_objects(image: NDArray[np.uint8], camera: CameraGeometry) -> FloatArray:
    """Where small things lie.

    Args:
        image: RGB, (height, width, 3).
        camera: what took it.

    Returns:
        m, robot frame, shape (n, 2), nearest first.
    """
    mask = (local_contrast(image) > _CONTRAST).astype(np.uint8)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    blobs = (_Blob(np.asarray(contour), image, camera) for contour in contours)
    points = np.array([blob.place for blob in blobs if blob.is_object()]).reshape(-1, 2)
    neighbours = np.linalg.norm(points[:, None] - points, axis=-1) < _CROWD_RADIUS
    points = points[neighbours.sum(axis=1) < _CROWD]
    return points[np.argsort(np.hypot(*points.T))]


class _Blob:
    """What a contour encloses.

    Attributes:
        place: its centroid on the floor, m, robot frame, shape (2,); NaN above the horizon.
    """

    def __init__(self, contour: NDArray[Any], image: NDArray[np.uint8], camera: CameraGeometry) -> None:
        self._image = image
        self._box = cv2.boundingRect(contour)  # left, top, width, height
        self._inside = np.zeros(image.shape[:2], np.uint8)
        cv2.drawContours(self._inside, [contour], -1, 1, cv2.FILLED)
        moments = cv2.moments(self._inside, binaryImage=True)
        self._pixels = moments["m00"]
        self.place = camera.pixel_to_floor(np.array([moments["m10"], moments["m01"]]) / self._pixels, OBJECT_HEIGHT)
        # Width and height of a pixel there, across the line of sight; m.
        offset = np.array([*self.place, OBJECT_HEIGHT]) - np.array(camera.position)
        self._pixel = offset @ camera.axes[2] / camera.focal

    def is_object(self) -> bool:
        """Whether it is whole, on the floor, as large as an object and unlike its surroundings."""
        return self._is_whole() and self._has_size_of_object() and self._stands_out()

    def _is_whole(self) -> bool:
        left, top, width, height = self._box
        return left > 0 and top > 0 and left + width < self._image.shape[1] and top + height < self._image.shape[0]

    def _has_size_of_object(self) -> bool:
        """Never true above the horizon, where sizes are NaN. The edges of a blob are known to a pixel only."""
        size = 2 * np.sqrt(self._pixels * self._pixel.prod() / np.pi)
        length = (np.array(self._box[2:]) * self._pixel).max()
        slack = self._pixel.max()
        enough = self._pixels >= _MIN_PIXELS
        return bool(enough and _SIZE[0] <= size <= _SIZE[1] + slack and length <= _MAX_LENGTH + slack)

    def _stands_out(self) -> bool:
        """Whether it differs from everything round it, unlike the corners that a median rounds off."""
        near = cv2.dilate(self._inside, np.ones((3, 3), np.uint8))
        ring = cv2.dilate(near, np.ones((2 * _RING + 1, 2 * _RING + 1), np.uint8)) - near
        color = np.median(self._image[self._inside > 0], axis=0)
        different = np.abs(self._image[ring > 0] - color).max(axis=1) > _CONTRAST
        return bool(different.mean() >= _RING_SHARE)
