"""Pictures that LeRobot's recorder has put into a video, as it does unless it is told otherwise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relmm.features import IMAGE_KEY, IMAGE_SIZE

# The columns of meta/episodes that say where an episode's pictures are.
VIDEO_COLUMNS = [f"videos/{IMAGE_KEY}/{name}" for name in ("chunk_index", "file_index", "from_timestamp")]
_TOLERANCE_S = 1e-2  # between a frame and its time, which the file keeps in whole ticks


def in_video(features: dict[str, Any]) -> bool:
    """Whether the camera's pictures are in videos."""
    return bool(features[IMAGE_KEY]["dtype"] == "video")


def read_video(root: Path, row: dict[str, Any], count: int, fps: float) -> NDArray[np.uint8] | None:
    """The pictures of an episode, (count, 100, 100, 3), RGB; None while its video is not there.

    Args:
        root: the dataset.
        row: of meta/episodes, with `VIDEO_COLUMNS`.
        count: frames of the episode.
        fps: frames a second.

    Raises:
        ValueError: the video is damaged, too short, or has pictures of another size.
    """
    from av.error import FFmpegError
    from lerobot.datasets.utils import DEFAULT_VIDEO_PATH
    from lerobot.datasets.video_utils import FrameTimestampError, decode_video_frames

    chunk, file, start = (row[name] for name in VIDEO_COLUMNS)
    path = root / DEFAULT_VIDEO_PATH.format(video_key=IMAGE_KEY, chunk_index=chunk, file_index=file)
    if not path.exists():
        return None
    times = (start + np.arange(count) / fps).tolist()
    try:
        frames = decode_video_frames(path, times, _TOLERANCE_S, "pyav", return_uint8=True)
    except (FFmpegError, FrameTimestampError, RuntimeError, IndexError) as error:
        raise ValueError(f"its video {path} is damaged or too short") from error
    images = frames.permute(0, 2, 3, 1).numpy()
    if images.shape[1:3] != (IMAGE_SIZE, IMAGE_SIZE):
        raise ValueError(f"its video {path} has the size {images.shape[1:3]}, and {IMAGE_SIZE, IMAGE_SIZE} is needed")
    return np.ascontiguousarray(images)
