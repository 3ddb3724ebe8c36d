"""What a dataset is recorded with, and the checks that come before anything is written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from huggingface_hub.errors import HFValidationError
from huggingface_hub.utils import validate_repo_id

from relmm.episodes.folder import INFO, RELMM, DatasetFolder
from relmm.episodes.info import DATA_PATH, are_features, runs_of
from relmm.episodes.outcomes import DERIVED
from relmm.errors import ConfigError, DatasetError
from relmm.features import DEPTH_KEY, FPS, IMAGE_KEY, SCAN_NAMES, STATE_KEY, STATE_NAMES, dataset_features
from relmm.geometry import camera_info, other_camera

# The columns that LeRobot adds by itself.
LEROBOT_COLUMNS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
# The columns that learning reads; of `DERIVED` those that there are.
TRAINING_COLUMNS = (IMAGE_KEY, STATE_KEY, "action", *(name for name in DERIVED if name != "next.success"))
_STATE_NAMES_0_1_0 = [name for name in STATE_NAMES if name not in ("y.vel", *SCAN_NAMES)]
FORMAT_VERSION = "v3.0"  # LeRobot's, also the tag of datasets on the Hub


def features_to_store(depth: bool, camera: str | None) -> dict[str, dict[str, Any]]:
    """The schema as LeRobot stores it, with the unit of the depth picture; `camera` is its name, if it is known."""
    features = dataset_features(depth, None if camera is None else camera_info(camera))
    if depth:
        features[DEPTH_KEY]["info"]["depth_unit"] = "mm"
    return features


def check_repo_id(repo_id: str) -> None:
    """Refuse names that the Hub would refuse later.

    Raises:
        ConfigError: not of the form `user/name`, or with characters that the Hub does not allow.
    """
    try:
        validate_repo_id(repo_id)
    except HFValidationError as error:
        reason = str(error).split("\n")[0].rstrip(".")
        raise ConfigError(
            f"{repo_id!r} cannot name a dataset ({reason}); use the form user/name with letters, digits, '-', '_' "
            "and '.', for example me/first_run."
        ) from error
    if "/" not in repo_id:
        raise ConfigError(f"{repo_id!r} cannot name a dataset, the user is missing; use the form user/name.")


def check_new(root: Path, repo_id: str) -> None:
    """Refuse a place where a new dataset cannot begin.

    Raises:
        ConfigError: LeRobot or the Hub would refuse the name.
        DatasetError: there is something already.
    """
    check_repo_id(repo_id)
    if root.exists() or root.is_symlink():
        raise DatasetError(
            f"{root} exists already and recording never overwrites; choose another folder, or go on with this one by "
            "--resume=true."
        )


def check_resume(
    root: Path, repo_id: str, depth: bool | None, robot_type: str | None, info: dict[str, Any] | None
) -> None:
    """Refuse a folder that cannot be continued with these settings; reads only.

    Args:
        root: the dataset.
        repo_id: its name, `user/name`.
        depth: whether it must have the depth picture; None takes it as it is.
        robot_type: the robot it must be of; None takes it as it is.
        info: what the run is recorded with; its `camera` must be that of the dataset.

    Raises:
        ConfigError: LeRobot or the Hub would refuse the name, or an unknown camera.
        DatasetError: no relmm dataset, or one with other settings: each difference is spelled out.
    """
    check_repo_id(repo_id)
    have = _stored_settings(DatasetFolder(root))
    features = have["features"]
    _refuse_old(root, features)
    differences = _differences("fps", have["fps"], FPS)
    differences += feature_differences(features, dataset_features(DEPTH_KEY in features if depth is None else depth))
    if robot_type is not None:
        differences += _differences("robot type", have["robot_type"], robot_type)
    if info is not None and "camera" in info:
        cameras = other_camera(features, info["camera"])
        differences += [] if cameras is None else [f"camera: have {cameras[0]}, want {cameras[1]}"]
    if differences:
        raise DatasetError(
            f"{root} cannot be continued with these settings: {'; '.join(differences)}; "
            "record into a new folder, or use the settings of this one."
        )


def check_trainable(root: Path | str, camera: str | None = None) -> None:
    """Refuse a dataset that relmm cannot learn from; reads `info.json` only, so it may have any number of episodes.

    More columns than `TRAINING_COLUMNS` are welcome, and any frame rate: a frame is one skill, however long it took.

    Args:
        root: the dataset.
        camera: that of the policy, None for any; a dataset that does not tell its own may have it.

    Raises:
        DatasetError: no LeRobot dataset, of relmm 0.1.0, of another camera, or of another format or columns:
            each difference is spelled out.
    """
    info = DatasetFolder(root).read_json(INFO) or {}
    if not {"features", "fps", "codebase_version"} <= info.keys() or not are_features(info["features"]):
        raise DatasetError(
            f"{root} is no LeRobot dataset, it has no readable {INFO}; choose the folder of a dataset, "
            "or the name of one on the Hub."
        )
    have, want = info["features"], dataset_features()
    _refuse_old(root, have)
    differences = []
    if str(info["codebase_version"]).split(".")[0] != FORMAT_VERSION.split(".")[0]:
        differences += _differences("format", info["codebase_version"], FORMAT_VERSION)
    differences += _differences("data_path", info.get("data_path"), DATA_PATH)
    for key in TRAINING_COLUMNS:
        if key in DERIVED and key not in have:
            continue
        feature = have.get(key)
        if key == IMAGE_KEY and feature is not None and feature["dtype"] == "video":
            feature = {**feature, "dtype": "image"}
        differences += _differences(f"column {key}", _describe(feature), _describe(want[key]))
    if differences:
        raise DatasetError(
            f"{root} cannot be trained on: {'; '.join(differences)}; choose a dataset of relmm-record, or of "
            "lerobot-record with --robot.type=locobot_sim."
        )
    cameras = other_camera(have, camera)
    if cameras is not None:
        raise DatasetError(
            f"{root} was recorded with the camera {cameras[0]}, but the policy's is {cameras[1]}; choose another "
            "dataset, or set --policy.camera to the dataset's."
        )


def add_run(
    folder: DatasetFolder, features: dict[str, Any], robot_type: str | None, episode: int, info: dict[str, Any]
) -> None:
    """Write down in `meta/relmm.json` with what the episodes from `episode` on are recorded.

    The file also keeps what `info.json` cannot be rebuilt without.
    """
    runs = runs_of(folder.read_json(RELMM))
    settings = {
        "robot_type": robot_type,
        "fps": FPS,
        "features": {key: feature for key, feature in features.items() if key not in LEROBOT_COLUMNS},
        "runs": [*runs, {"first_episode": episode, **info}],
    }
    folder.write_json(RELMM, settings)


def _stored_settings(folder: DatasetFolder) -> dict[str, Any]:
    if not folder.root.is_dir():
        raise DatasetError(f"there is no dataset at {folder.root}; check the folder, or record without resuming.")
    settings = folder.read_json(INFO) or folder.read_json(RELMM) or {}
    if not {"features", "fps", "robot_type"} <= settings.keys() or not are_features(settings["features"]):
        raise DatasetError(
            f"{folder.root} is no LeRobot dataset, it has no readable {INFO}; choose the folder of a dataset, "
            "or a folder that does not exist yet to record a new one."
        )
    return settings


def _refuse_old(root: Path | str, features: dict[str, Any]) -> None:
    state = features.get(STATE_KEY)
    if isinstance(state, dict) and state.get("names") == _STATE_NAMES_0_1_0:
        raise DatasetError(
            f"{root} was recorded by relmm 0.1.0, its {STATE_KEY} has no y.vel and no {SCAN_NAMES[0]} to "
            f"{SCAN_NAMES[-1]}; choose a newer dataset, or read it with relmm 0.1.0."
        )


def feature_differences(have: dict[str, Any], want: dict[str, Any]) -> list[str]:
    """In which columns two schemas differ, in words; those that LeRobot adds by itself do not count."""
    differences: list[str] = []
    for key in sorted((have.keys() | want.keys()) - set(LEROBOT_COLUMNS)):
        differences += _differences(f"column {key}", _describe(have.get(key)), _describe(want.get(key)))
    return differences


def _describe(feature: Any) -> str:
    if feature is None:
        return "no such column"
    names = feature.get("names")
    return f"{feature['dtype']} {tuple(feature['shape'])}" + (f" of {', '.join(map(str, names))}" if names else "")


def _differences(name: str, have: Any, want: Any) -> list[str]:
    return [] if have == want else [f"{name}: have {have}, want {want}"]
