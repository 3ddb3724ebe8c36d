"""Finds small things on the floor in one colour picture: local contrast, contours, centroids on the floor."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from relmm.features import FloatArray
from relmm.geometry import CameraGeometry

OBJECT_HEIGHT = 0.015  # m, about the middle of an object: the plane onto which centroids are projected

# A median over a window that objects fill less than half of is the picture without them. Straight edges (walls, planks,
# rugs) survive it, so only small things differ from it.
_MEDIAN = 13  # pixels; the largest object, 4 cm at the nearest grasp cell, covers 9 x 7
_CONTRAST = 24  # of 255; grain, joints and the shades of planks differ less from their surroundings
_SIZE = (0.014, 0.055)  # m, diameter of a disc of a blob's area
_MAX_LENGTH = 0.065  # m, longer side of a blob's bounding box; joints and slivers of furniture are longer
_RING = 2  # pixels round a blob in which everything must look different from it
_RING_SHARE = 0.85
# Patterns and the ragged edges of rugs look like many objects close together; 20 objects on 9 m^2 hardly ever do.
_CROWD_RADIUS, _CROWD = 0.25, 4  # m, and how many within that count as a pattern


def local_contrast(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """How much each pixel differs from its surroundings, in the colour channel that differs most.

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
    found = [point for contour in contours if (point := _object_at(contour, image, camera)) is not None]
    points = np.array(found).reshape(-1, 2)
    neighbours = np.linalg.norm(points[:, None] - points, axis=-1) < _CROWD_RADIUS
    points = points[neighbours.sum(axis=1) < _CROWD]
    return points[np.argsort(np.hypot(*points.T))]


def _object_at(contour: NDArray[np.int32], image: NDArray[np.uint8], camera: CameraGeometry) -> FloatArray | None:
    """The point on the floor of a contour's centroid, unless it cannot be an object."""
    left, top, width, height = cv2.boundingRect(contour)
    if left == 0 or top == 0 or left + width == image.shape[1] or top + height == image.shape[0]:
        return None  # cut off by the picture's edge
    inside = np.zeros(image.shape[:2], np.uint8)
    cv2.drawContours(inside, [contour], -1, 1, cv2.FILLED)
    moments = cv2.moments(inside, binaryImage=True)
    centroid = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
    point = camera.pixel_to_floor(centroid, OBJECT_HEIGHT)
    if not np.isfinite(point).all():
        return None
    pixel = _metres_per_pixel(point, camera)
    size = 2 * np.sqrt(moments["m00"] * pixel.prod() / np.pi)
    length = (np.array([width, height]) * pixel).max()
    # The edges of a blob are known to a pixel only.
    if not _SIZE[0] <= size <= _SIZE[1] + pixel.max() or length > _MAX_LENGTH + pixel.max():
        return None
    return point if _stands_out(inside, image) else None


def _metres_per_pixel(point: FloatArray, camera: CameraGeometry) -> FloatArray:
    """Width and height of a pixel at a point on the floor, across the line of sight; m."""
    offset = np.array([*point, OBJECT_HEIGHT]) - np.array(camera.position)
    return np.asarray(offset @ camera.axes[2] / camera.focal)


def _stands_out(inside: NDArray[np.uint8], image: NDArray[np.uint8]) -> bool:
    """Whether a blob differs from everything round it, unlike the corners that a median rounds off."""
    near = cv2.dilate(inside, np.ones((3, 3), np.uint8))
    ring = cv2.dilate(near, np.ones((2 * _RING + 1, 2 * _RING + 1), np.uint8)) - near
    color = np.median(image[inside > 0], axis=0)
    different = np.abs(image[ring > 0] - color).max(axis=1) > _CONTRAST
    return bool(different.mean() >= _RING_SHARE)
