"""What a policy's folder must look like before anything of it is used: it may come from anybody.

LeRobot would import whatever class a processor's JSON names, load weights that do not fit, and never look for NaN.
"""

from __future__ import annotations

import json
import math
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.processor import ProcessorStepRegistry
from safetensors import SafetensorError, safe_open
from torch import Tensor

from relmm.errors import ConfigError
from relmm.features import dataset_features
from relmm.learning.sums import check_sums
from relmm.policies.controller import ControllerConfig

CONFIG, WEIGHTS = "config.json", "model.safetensors"
PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
# The steps of a processor, and what their settings must be, so that they change neither pictures nor actions.
_ANY = object()
_NORMALIZER = {"eps": _ANY, "features": _ANY, "norm_map": dict.fromkeys(("VISUAL", "STATE", "ACTION"), "IDENTITY")}
_STEPS: dict[str, dict[str, Any]] = {
    "rename_observations_processor": {"rename_map": {}},
    "to_batch_processor": {},
    "device_processor": {"device": _ANY, "float_dtype": None},
    "normalizer_processor": _NORMALIZER,
    "unnormalizer_processor": _NORMALIZER,
}
_LARGEST_WEIGHT = 1e3  # far above those of trained networks; 1e30 is finite, but what it is multiplied with is not
_MAX_JSON = 10 << 20
_TYPES = {"F32": torch.float32, "F64": torch.float64, "I64": torch.int64, "U8": torch.uint8, "BOOL": torch.bool}


def check_policy_folder(folder: Path) -> None:
    """Refuse a folder that is no policy of relmm, or would run code of its choice when it is loaded.

    Args:
        folder: what `--policy.path` leads to.

    Raises:
        ConfigError: with what is wrong.
    """
    config = _check_type(folder, ControllerConfig)
    refuse_first_version(config, folder / CONFIG)
    for name in PROCESSORS:
        _check_processor(folder / name, read_json(folder / name), _STEPS)
    if not (folder / WEIGHTS).is_file():
        raise ConfigError(f"{folder} has no {WEIGHTS}: give the folder of a checkpoint's pretrained_model.")
    check_sums(folder)


def check_any_policy_folder(folder: Path, trusted: bool) -> None:
    """As `check_policy_folder`, but policies of others than relmm may pass, too.

    Args:
        folder: what `--policy.path` leads to.
        trusted: it is the user's own: what the processors of a policy of others import is left to LeRobot. Else they
            may have only the steps that LeRobot itself registers by name.

    Raises:
        ConfigError: with what is wrong.
    """
    import lerobot.policies.factory  # noqa: F401  (registers LeRobot's own policies)

    config = _check_type(folder, PreTrainedConfig)
    if issubclass(PreTrainedConfig.get_choice_class(config["type"]), ControllerConfig):
        check_policy_folder(folder)
    elif not trusted:
        for name in PROCESSORS:
            _check_processor(folder / name, read_json(folder / name), dict.fromkeys(ProcessorStepRegistry.list()))


def _check_type(folder: Path, kind: type[PreTrainedConfig]) -> dict[str, Any]:
    """The config of a policy whose class is of this kind."""
    config = read_json(folder / CONFIG)
    choices = PreTrainedConfig.get_known_choices()
    known = sorted(name for name, choice in choices.items() if issubclass(choice, kind))
    if not isinstance(config, dict) or config.get("type") not in known:
        name = config.get("type") if isinstance(config, dict) else config
        raise ConfigError(
            f"{folder / CONFIG} is of a policy {name!r}, and this loads {', '.join(known)}; use another checkpoint, or "
            "install the package that the policy is from."
        )
    return config


def refuse_first_version(config: Mapping[str, Any], path: Path) -> None:
    """Refuse what relmm 0.1.0 called `relmm`: a grasp ensemble with soft actor-critic, or the paper's networks.

    Args:
        config: of a policy.
        path: of its file.

    Raises:
        ConfigError: it is one of those.
    """
    if config.get("type") == "relmm" and "navigation_encoder" in config:
        raise ConfigError(
            f"{path} is of relmm 0.1.0, whose policy relmm had other networks than this version's; use it with relmm "
            "0.1.0, or train anew."
        )


def read_json(path: Path) -> Any:
    """A small JSON file.

    Raises:
        ConfigError: missing, too large, or no JSON.
    """
    try:
        if path.stat().st_size > _MAX_JSON:
            raise ConfigError(f"{path} has {path.stat().st_size / 1e6:.0f} MB, which no policy needs; do not use it.")
        data = json.loads(path.read_text(encoding="utf-8"))
        json.dumps(data, ensure_ascii=False).encode()  # half a character could be read, but not written again
        return data
    except FileNotFoundError as error:
        raise ConfigError(
            f"{path.parent} has no {path.name}: give the folder of a checkpoint's pretrained_model."
        ) from error
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path} is no JSON that can be read ({error}); use another checkpoint.") from error


def _check_processor(path: Path, pipeline: Any, allowed: Mapping[str, dict[str, Any] | None]) -> None:
    """Refuse steps other than these, and settings other than theirs; None for any."""
    steps = pipeline.get("steps") if isinstance(pipeline, dict) else None
    if not isinstance(steps, list):
        raise ConfigError(f"{path} describes no processor, it has no list of steps; use another checkpoint.")
    for step in steps:
        name = (step.get("class") or step.get("registry_name")) if isinstance(step, dict) else step
        if not isinstance(step, dict) or not isinstance(name, str) or name not in allowed or "class" in step:
            raise ConfigError(
                f"{path} has a step {reprlib.repr(name)}, which is none of the steps that such policies have; do not "
                "use it."
            )
        if (expected := allowed[name]) is not None:
            _check_step(path, name, step.get("config", {}), expected)
        if (file := step.get("state_file")) is not None:
            _check_state(path, file)


def _check_step(path: Path, name: str, settings: Any, allowed: dict[str, Any]) -> None:
    """Refuse what would rename pictures or change numbers; relmm's commands make the steps anew, LeRobot's do not."""
    items = settings.items() if isinstance(settings, dict) else [("config", settings)]
    for key, value in items:
        if key not in allowed or allowed[key] not in (_ANY, value):
            raise ConfigError(
                f"{path} has a step {name} with the setting {reprlib.repr(key)}: {reprlib.repr(value)}, which no "
                "policy of relmm has; do not use it."
            )


def _check_state(path: Path, name: Any) -> None:
    """Refuse statistics that are elsewhere or not finite; with the only allowed settings nobody uses them."""
    if not isinstance(name, str) or Path(name).name != name:
        raise ConfigError(f"{path} names the file {reprlib.repr(name)}, which is not in its folder; do not use it.")
    try:
        with safe_open(path.parent / name, framework="pt") as file:
            finite = all(file.get_tensor(key).isfinite().all() for key in file.keys())  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise _unreadable(path.parent / name, error) from error
    if not finite:
        raise ConfigError(f"{path.parent / name} has numbers that are not finite; use another checkpoint.")


def check_features(config: PreTrainedConfig, folder: Path) -> None:
    """Refuse a policy that expects other pictures, states or actions than relmm's robots have.

    Raises:
        ConfigError: with the difference.
    """
    from lerobot.utils.feature_utils import dataset_to_policy_features

    wanted = dataset_to_policy_features(dataset_features())
    have = {**(config.input_features or {}), **(config.output_features or {})}
    for key, feature in have.items():
        if key not in wanted or (feature.type, tuple(feature.shape)) != (wanted[key].type, tuple(wanted[key].shape)):
            there = tuple(wanted[key].shape) if key in wanted else "nothing of that name"
            raise ConfigError(
                f"{folder / CONFIG} expects {key} of {tuple(feature.shape)}, and relmm has {there}; use another "
                "checkpoint."
            )


def check_weights(config: PreTrainedConfig, folder: Path) -> None:
    """Refuse weights that do not fit the config, before any memory is taken for them.

    Raises:
        ConfigError: no safetensors, cut off, other keys or shapes, or numbers that are not finite or far too large.
    """
    from lerobot.policies.factory import get_policy_class

    with torch.device("meta"):  # shapes without memory: the config may claim gigabytes
        expected = get_policy_class(config.type)(config=config).state_dict()
    check_tensors(folder / WEIGHTS, expected, _LARGEST_WEIGHT)


def check_tensors(path: Path, expected: Mapping[str, Tensor], largest: float = math.inf) -> None:
    """Refuse a safetensors file with anything but the expected names, types, shapes, and finite numbers.

    Args:
        path: of the file.
        expected: tensors of those names, types and shapes.
        largest: magnitude of a number with a fraction.

    Raises:
        ConfigError: with the first difference.
    """
    try:
        with safe_open(path, framework="pt") as file:
            _check_names(path, set(file.keys()), set(expected))
            for name, tensor in expected.items():
                _check_like(path, name, file.get_slice(name), tensor)
            for name in expected:
                tensor = file.get_tensor(name)
                if not tensor.isfinite().all() or (tensor.is_floating_point() and (tensor.abs() > largest).any()):
                    raise ConfigError(
                        f"{path} has numbers in {name} that are not finite, or above {largest:g}; use another "
                        "checkpoint."
                    )
    except (SafetensorError, OSError) as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> ConfigError:
    return ConfigError(
        f"{path} is cut off, or no safetensors file ({' '.join(str(error).split())}); use another checkpoint, or "
        "download it again."
    )


def _check_names(path: Path, have: set[str], want: set[str]) -> None:
    if have != want:
        missing, extra = sorted(want - have), sorted(have - want)
        lists = [
            f"{len(names)} {what} ({', '.join(names[:3])})"
            for names, what in ((missing, "missing"), (extra, "too many"))
            if names
        ]
        raise ConfigError(
            f"{path} does not fit its config: of its tensors {' and '.join(lists)}; use another checkpoint."
        )


def _check_like(path: Path, name: str, stored: Any, wanted: Tensor) -> None:
    have = (tuple(stored.get_shape()), _TYPES.get(stored.get_dtype(), stored.get_dtype()))
    want = (tuple(wanted.shape), wanted.dtype)
    if have != want:
        raise ConfigError(
            f"{path} does not fit its config: {name} is {have[1]} {have[0]}, not {want[1]} {want[0]}; "
            "use another checkpoint."
        )
