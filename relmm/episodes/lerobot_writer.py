"""LeRobot's episode writer, with pictures kept in memory and every episode in parquet files of its own.

The stock writer stores each picture as a file, reads it again for the statistics and once more to embed it, and
keeps its parquet files open, unreadable, across episodes. Import this module lazily: LeRobot takes seconds.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.compute_stats import RunningQuantileStats, compute_episode_stats, sample_indices
from lerobot.datasets.dataset_writer import DatasetWriter
from lerobot.datasets.feature_utils import get_hf_features_from_features, validate_episode_buffer
from lerobot.datasets.image_writer import image_array_to_pil_image
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import update_chunk_file_indices
from numpy.typing import NDArray

# Run lengths of differences to the left neighbour: a sixth of the time of LeRobot's level 6, for files a fifth larger.
_PNG = (
    *(cv2.IMWRITE_PNG_COMPRESSION, 1),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE),
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB),
)


class EpisodeWriter(DatasetWriter):
    """Writes each episode into one data file and one metadata file, both finished when `save_episode` returns."""

    def __init__(self, dataset: LeRobotDataset) -> None:
        super().__init__(
            meta=dataset.meta,
            root=dataset.root,
            rgb_encoder=None,
            depth_encoder=None,
            encoder_threads=None,
            batch_encoding_size=1,
            initial_frames=dataset.meta.total_frames,
        )
        self._encoded: dict[str, bytes] = {}  # by the path that LeRobot gives a picture
        self._pixels: dict[str, NDArray[Any]] = {}

    def _save_image(self, image: Any, fpath: Path, compress_level: int = 1) -> None:
        self._encoded[str(fpath)] = _png(image) if fpath.suffix == ".png" else _tiff(image)
        self._pixels[str(fpath)] = image

    def save_episode(self, episode_data: dict | None = None, parallel_encoding: bool = True) -> None:
        """Write the buffered episode; the arguments are LeRobot's, for datasets with videos, and are not used."""
        buffer = self.episode_buffer
        validate_episode_buffer(buffer, self._meta.total_episodes, self._meta.features)
        length, tasks, episode = buffer.pop("size"), buffer.pop("task"), buffer["episode_index"]
        # In the order of appearance, so that task indices can be told again from the data files.
        episode_tasks = list(dict.fromkeys(tasks))
        self._meta.save_episode_tasks(episode_tasks)
        buffer["index"] = np.arange(self._meta.total_frames, self._meta.total_frames + length)
        buffer["episode_index"] = np.full(length, episode)
        task_index = {task: self._meta.get_task_index(task) for task in episode_tasks}
        buffer["task_index"] = np.array([task_index[task] for task in tasks])
        for key, feature in self._meta.features.items():
            if feature["dtype"] != "image":
                values = np.stack(buffer[key])
                buffer[key] = values.reshape(length) if tuple(feature["shape"]) == (1,) else values
        stats = {key: self._column_stats(key, values) for key, values in buffer.items()}
        place = self._save_episode_data(buffer)
        self._meta.save_episode(episode, length, episode_tasks, stats, place)
        self._meta._close_writer()
        self._begin_next_file()

    def clear_episode_buffer(self, delete_images: bool = True) -> None:
        """Forget the frames since the last saved episode."""
        super().clear_episode_buffer(delete_images)
        self._encoded.clear()
        self._pixels.clear()

    def _begin_next_file(self) -> None:
        # LeRobot starts new files when it finds no episode of its own session: as if after a resume.
        self._meta.episodes = [{key: values[0] for key, values in self._meta.latest_episode.items()}]
        self._meta.latest_episode = None
        self.clear_episode_buffer()

    def _column_stats(self, key: str, values: Any) -> dict[str, NDArray[Any]]:
        feature = self._meta.features[key]
        if feature["dtype"] != "image":
            return compute_episode_stats({key: values}, {key: feature})[key]
        pictures = np.stack([self._pixels[values[i]] for i in sample_indices(len(values))])
        return picture_stats(pictures, unit=1.0 if key in self._meta.depth_keys else 255.0)

    def _save_episode_data(self, episode_buffer: dict) -> dict:
        chunk, file, start = 0, 0, 0
        if self._meta.episodes:
            last = self._meta.episodes[-1]
            chunk, file = last["data/chunk_index"], last["data/file_index"]
            chunk, file = update_chunk_file_indices(chunk, file, self._meta.chunks_size)
            start = last["dataset_to_index"]
        path = self._root / self._meta.data_path.format(chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        table = self._table(episode_buffer)
        pq.write_table(table, path, compression="snappy", use_dictionary=True)
        return {
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": start,
            "dataset_to_index": start + len(table),
        }

    def _table(self, buffer: dict) -> pa.Table:
        # What `datasets.Dataset.from_dict` builds, without its hashing, caching and passes over every row.
        schema = get_hf_features_from_features(self._meta.features).arrow_schema
        return pa.Table.from_arrays([self._column(buffer[field.name], field.type) for field in schema], schema=schema)

    def _column(self, values: Any, type_: pa.DataType) -> pa.Array:
        if pa.types.is_struct(type_):
            pictures = [self._encoded[path] for path in values]
            names = [Path(path).name for path in values]
            return pa.StructArray.from_arrays([pa.array(pictures, pa.binary()), pa.array(names)], fields=list(type_))
        if pa.types.is_fixed_size_list(type_) or pa.types.is_list(type_):
            flat = pa.array(values.reshape(-1))
            return pa.FixedSizeListArray.from_arrays(flat, values.shape[1]).cast(type_)
        return pa.array(values).cast(type_)


def _png(image: NDArray[np.uint8]) -> bytes:
    return bytes(cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), _PNG)[1])


def _tiff(image: NDArray[Any]) -> bytes:
    file = io.BytesIO()
    image_array_to_pil_image(image).save(file, format="TIFF", compression="raw")  # as LeRobot does
    return file.getvalue()


def picture_stats(pictures: NDArray[Any], unit: float) -> dict[str, NDArray[Any]]:
    """LeRobot's statistics of pictures, from the counts of their values instead of from every pixel.

    Args:
        pictures: (N, height, width, channels), unsigned integers.
        unit: what the values are divided by, 255 for colours.

    Returns:
        LeRobot's keys, each (channels, 1, 1) but `count`, (1,).
    """
    channels = [_CountedStats.of(pictures[..., i]) for i in range(pictures.shape[-1])]
    stats = {
        key: np.concatenate([channel[key] for channel in channels]).reshape(-1, 1, 1) / unit for key in channels[0]
    }
    stats["count"] = np.array([len(pictures)])  # of pictures, where a channel counts pixels
    return stats


class _CountedStats(RunningQuantileStats):
    @classmethod
    def of(cls, values: NDArray[Any]) -> dict[str, NDArray[Any]]:
        counts = np.bincount(values.reshape(-1))
        levels = np.flatnonzero(counts)
        stats = cls()
        stats.update_counts(levels.astype(np.float64), counts[levels])
        return stats.get_statistics()

    def update_counts(self, levels: NDArray[np.float64], counts: NDArray[Any]) -> None:
        """As `update` does it, of a batch in which each level occurs `counts` times."""
        self._count = int(counts.sum())
        self._mean = np.array([np.average(levels, weights=counts)])
        self._mean_of_squares = np.array([np.average(levels**2, weights=counts)])
        self._min, self._max = levels[:1], levels[-1:]
        edges = np.linspace(levels[0] - 1e-10, levels[-1] + 1e-10, self._num_quantile_bins + 1)
        self._bin_edges = [edges]
        self._histograms = [np.histogram(levels, bins=edges, weights=counts)[0]]
