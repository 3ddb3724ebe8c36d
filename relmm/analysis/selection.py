"""Some attempts of a dataset: chosen by an expression, and written as a dataset of their own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pyarrow as pa

from relmm.analysis.collection import Collection
from relmm.analysis.reading import Reader
from relmm.episodes import DurableDataset
from relmm.episodes.pictures import decode_picture
from relmm.errors import ConfigError, DatasetError
from relmm.features import DEPTH_KEY, IMAGE_KEY, STATE_KEY, outcome_features


def select(collection: Collection, where: str) -> pd.DataFrame:
    """The attempts for which an expression holds.

    Args:
        collection: the attempts.
        where: of `pandas.DataFrame.query`, over the columns of `grasps.parquet`.

    Raises:
        ConfigError: the expression cannot be understood, or does not say of each attempt whether it is wanted.
    """
    grasps = collection.grasps
    try:
        wanted = grasps.eval(where, engine="python")
    except Exception as error:  # whatever pandas makes of what somebody typed
        names = ", ".join(grasps.columns)
        reason = " ".join(str(error).split())
        raise ConfigError(f"--where={where!r} cannot be understood ({reason}); the columns are {names}.") from error
    if not isinstance(wanted, pd.Series) or not pd.api.types.is_bool_dtype(wanted):
        raise ConfigError(
            f"--where={where!r} does not say of each attempt whether it is wanted: compare a column with something, as "
            "in success == 0."
        )
    return grasps[wanted.fillna(False).astype(bool)]


def narrowed(collection: Collection, where: str) -> Collection:
    """The collection with the attempts for which an expression holds; everything else stays."""
    return Collection(**{**vars(collection), "grasps": select(collection, where)})


def export(
    grasps: pd.DataFrame,
    source: Path,
    target: Path,
    repo_id: str,
    *,
    whole_episodes: bool = False,
    info: dict[str, Any] | None = None,
    progress: Callable[[int], None] = lambda frames: None,
) -> int:
    """Write selected attempts as a dataset: an episode for each that has some, with these frames only.

    Args:
        grasps: of `select`.
        source: the dataset that they are of.
        target: a folder that does not exist yet.
        repo_id: name of the new dataset.
        whole_episodes: keep all frames of the episodes, to learn navigation from as well.
        info: what to keep in `meta/relmm.json` about where they come from.
        progress: takes frames read since the last call.

    Returns:
        How many frames were written.

    Raises:
        ConfigError: nothing was selected.
        DatasetError: the folder exists, cannot be written, or the dataset lacks columns.
    """
    if not len(grasps):
        raise ConfigError("No attempt was selected, so there is nothing to export: say another --where.")
    reader = Reader(source)
    _refuse_incomplete(reader)
    chosen = {int(episode): np.sort(rows.to_numpy(int)) for episode, rows in grasps.groupby("episode")["frame"]}
    camera = {} if reader.camera_name is None else {"camera": reader.camera_name}
    written = 0
    with DurableDataset.create(repo_id, target, reader.has_depth, reader.robot_type, {**camera, **(info or {})}) as new:
        for row, table in reader.episodes(reader.stored_columns):
            progress(row["length"])
            if row["episode_index"] in chosen:
                everything = np.arange(len(table))
                wanted = everything if whole_episodes else chosen[row["episode_index"]]
                for frame in wanted:
                    new.add_frame(_frame(table, int(frame)), row["tasks"][0])
                    written += 1
                new.save_episode()
    return written


def _refuse_incomplete(reader: Reader) -> None:
    missing = sorted(set(outcome_features()) - set(reader.stored_columns))
    if missing:
        raise DatasetError(
            f"{reader.root} has no column {missing[0]}, which a relmm dataset needs and which cannot be made up: use "
            "lerobot-edit-dataset --operation.type=split on it, which takes whole episodes."
        )


def _frame(table: pa.Table, number: int) -> dict[str, Any]:
    """A frame as it was stored, as `DurableDataset.add_frame` takes it."""
    row = table.slice(number, 1).to_pylist()[0]
    frame: dict[str, Any] = {IMAGE_KEY: decode_picture(row[IMAGE_KEY]["bytes"])}
    if DEPTH_KEY in row:
        depth = cv2.imdecode(np.frombuffer(row[DEPTH_KEY]["bytes"], np.uint8), cv2.IMREAD_UNCHANGED)
        frame[DEPTH_KEY] = np.asarray(depth)[..., None]
    for key in ("action", STATE_KEY):
        frame[key] = np.array(row[key], np.float32)
    for key, feature in outcome_features().items():
        frame[key] = np.array(row[key], feature["dtype"]).reshape(1)
    return frame
