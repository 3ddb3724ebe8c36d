"""LeRobot's `meta/info.json` and relmm's `meta/relmm.json`, which may come from anybody: read, or None."""

from __future__ import annotations

from typing import Any

from relmm.episodes.folder import INFO, RELMM, DatasetFolder

DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"  # LeRobot's
_COUNTS = ("total_episodes", "chunks_size", "data_files_size_in_mb")


def read_info(folder: DatasetFolder) -> dict[str, Any] | None:
    """The content of `info.json`; None when it is missing, cut off, or not what LeRobot writes."""
    info = folder.read_json(INFO)
    if info is None or not are_features(info.get("features")):
        return None
    # A template is a small program: one from elsewhere could name any file of this machine.
    plausible = info.get("data_path") == DATA_PATH and isinstance(info.get("fps"), int | float)
    return info if plausible and all(type(info.get(key)) is int and info[key] >= 0 for key in _COUNTS) else None


def read_own(folder: DatasetFolder) -> dict[str, Any] | None:
    """The content of `relmm.json`, from which `info.json` can be rebuilt; None as in `read_info`."""
    own = folder.read_json(RELMM)
    whole = own is not None and are_features(own.get("features")) and {"fps", "robot_type"} <= own.keys()
    return own if whole else None


def are_features(features: Any) -> bool:
    """Whether columns are described as LeRobot describes them: by type and shape."""
    return isinstance(features, dict) and all(
        isinstance(feature, dict)
        and isinstance(feature.get("dtype"), str)
        and isinstance(feature.get("shape"), list | tuple)
        and isinstance(feature.get("names"), list | None)
        for feature in features.values()
    )


def runs_of(relmm: Any) -> list[dict[str, Any]]:
    """The runs in the content of a `meta/relmm.json`, none if it is not one."""
    runs = relmm.get("runs") if isinstance(relmm, dict) else None
    return runs if isinstance(runs, list) and all(isinstance(run, dict) for run in runs) else []
