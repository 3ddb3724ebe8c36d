"""From what the robot loop has in hand to a frame of the dataset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relmm.errors import DatasetError
from relmm.features import (
    ACTION_NAMES,
    DEPTH_KEY,
    FRONT,
    FRONT_DEPTH,
    IMAGE_KEY,
    IMAGE_SIZE,
    STATE_KEY,
    STATE_NAMES,
    outcome_features,
)


class FrameBuilder:
    """Builds frames for `DurableDataset.add_frame`.

    Args:
        depth: the dataset has the depth picture.
    """

    def __init__(self, depth: bool) -> None:
        self._depth = depth
        self._outcome = {key: np.dtype(feature["dtype"]) for key, feature in outcome_features().items()}

    def build(
        self, observation: Mapping[str, Any], action: Mapping[str, float], outcome: Mapping[str, Any]
    ) -> dict[str, NDArray[Any]]:
        """A frame that shares no memory with its arguments.

        Args:
            observation: the robot's: `relmm.features.STATE_NAMES` as numbers, `front` as (100, 100, 3) uint8 and,
                for a dataset with depth, `front_depth` as (100, 100, 1) uint16 in mm; other keys are not stored.
            action: by `relmm.features.ACTION_NAMES`.
            outcome: a number or truth value for each of `relmm.features.outcome_features`.

        Raises:
            DatasetError: something is missing, of another shape, or not a finite number.
        """
        frame = {
            "action": _vector("action", action, ACTION_NAMES),
            STATE_KEY: _vector("observation", observation, STATE_NAMES),
            IMAGE_KEY: _picture(observation, FRONT, 3, np.dtype(np.uint8)),
        }
        if self._depth:
            frame[DEPTH_KEY] = _picture(observation, FRONT_DEPTH, 1, np.dtype(np.uint16))
        if outcome.keys() != self._outcome.keys():
            names = ", ".join(sorted(outcome.keys() ^ self._outcome.keys()))
            raise DatasetError(f"the outcome of a frame has missing or unknown columns: {names}.")
        for key, dtype in self._outcome.items():
            frame[key] = np.array([outcome[key]], dtype)
        return frame


def _vector(what: str, values: Mapping[str, Any], names: tuple[str, ...]) -> NDArray[np.float32]:
    try:
        vector = np.array([values[name] for name in names], np.float32)
    except KeyError as error:
        raise DatasetError(f"the {what} has no {error.args[0]!r}; a frame needs {', '.join(names)}.") from error
    if not np.isfinite(vector).all():
        bad = {name: values[name] for name, ok in zip(names, np.isfinite(vector), strict=True) if not ok}
        raise DatasetError(f"the {what} has values that are not finite numbers, {bad}; nothing could learn from them.")
    return vector


def _picture(
    observation: Mapping[str, Any], name: str, channels: int, dtype: np.dtype[np.uint8] | np.dtype[np.uint16]
) -> NDArray[Any]:
    if name not in observation:
        raise DatasetError(f"the observation has no picture {name!r}, which this dataset stores in every frame.")
    picture, shape = np.asarray(observation[name]), (IMAGE_SIZE, IMAGE_SIZE, channels)
    if picture.shape != shape or picture.dtype != dtype:
        raise DatasetError(
            f"the picture {name!r} is {picture.dtype} {picture.shape}, and the dataset stores {dtype} {shape}."
        )
    return picture.copy()
