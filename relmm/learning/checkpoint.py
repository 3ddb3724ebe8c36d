"""Checkpoints in LeRobot's tree, written so that a crash at any instant leaves the last one whole.

    checkpoints/<step>/pretrained_model/   the policy and its processors; what --policy.path takes
    checkpoints/<step>/training_state/     optimisers, random states, counters and the dataset cursor
    checkpoints/<step>/*/SHA256SUMS        check sums of the files beside it; `train_config.json` may change
    checkpoints/last                       a link to the newest

The replay is not in there: the dataset is the replay.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import wraps
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from relmm.episodes.folder import sync
from relmm.episodes.info import runs_of
from relmm.episodes.sources import Cursor
from relmm.errors import MANY, ConfigError, DiskError
from relmm.learning.actor import Actor
from relmm.learning.moments import load_moments
from relmm.learning.settings import SETTINGS
from relmm.learning.sums import check_sums, write_sums
from relmm.learning.untrusted import check_tensors, read_json
from relmm.policies.learning import Learner

_MODEL, _STATE, _LAST = "pretrained_model", "training_state", "last"
STEP = "training_step.json"  # LeRobot's
_COUNTERS, _RANDOM = "relmm_state.json", "relmm_rng.safetensors"


def _says_what_cannot_be_written[**P, R](save: Callable[P, R]) -> Callable[P, R]:
    """Safetensors has an error of its own where the disk is full."""

    @wraps(save)
    def saving(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return save(*args, **kwargs)
        except (OSError, SafetensorError) as error:
            why = getattr(error, "strerror", None) or " ".join(str(error).split())
            raise DiskError(
                f"The checkpoint cannot be written to {args[0]} ({why}), the last one is still whole; make room or "
                "check the permissions, then go on with --resume=true."
            ) from error

    return saving


@_says_what_cannot_be_written
def save_checkpoint(
    folder: Path,
    step: int,
    actor: Actor,
    learner: Learner,
    rng: Any,
    counters: dict[str, Any],
    config: dict[str, Any],
    runs: list[dict[str, Any]],
    sources: Sequence[Cursor] = (),
) -> Path:
    """Write `folder/<step>` and point `folder/last` to it.

    Args:
        folder: the run's `checkpoints`.
        step: navigation steps so far.
        actor: the policy with its processors.
        learner: its optimisers and random states.
        rng: the trainer's numpy generator.
        counters: of the run; JSON values.
        config: of the run, for `train_config.json`.
        runs: with what the run's dataset was recorded; see `relmm.episodes.upload.recorded_runs`.
        sources: how far each dataset of others has been learned from, where the run has none of its own.

    Returns:
        The checkpoint's folder.

    Raises:
        DiskError: it cannot be written.
    """
    from lerobot.optim import save_optimizer_state

    target, temporary = folder / f"{step:06d}", folder / f".{step:06d}.tmp"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    actor.save_pretrained(temporary / _MODEL)
    _write_json(temporary / _MODEL / SETTINGS, config)
    save_optimizer_state(learner.optimizers, temporary / _STATE)
    _write_json(temporary / _STATE / STEP, {"step": step})
    states = {"trainer": rng.bit_generator.state, "learner": learner.rng.bit_generator.state}
    state = {"counters": counters, "random": states, "runs": runs, "sources": [asdict(source) for source in sources]}
    _write_json(temporary / _STATE / _COUNTERS, state)
    save_file({"noise": learner.noise.get_state()}, temporary / _STATE / _RANDOM)
    write_sums(temporary / _MODEL, leave_out=(SETTINGS,))  # which becomes portable on its way to the Hub
    write_sums(temporary / _STATE)
    _sync_tree(temporary)
    if target.exists():  # the same step again: the link must never point to what is being removed
        _link(folder / _LAST, temporary.name)
        shutil.rmtree(target)
    os.replace(temporary, target)
    _link(folder / _LAST, target.name)
    return target


def _settle(folder: Path) -> None:
    """Finish what `save_checkpoint` was doing when it was killed while it replaced a checkpoint."""
    last = folder / _LAST
    if not last.is_symlink() or not (name := os.readlink(last)).startswith("."):
        return
    temporary, target = folder / name, folder / name.removeprefix(".").removesuffix(".tmp")
    if temporary.exists():
        shutil.rmtree(target, ignore_errors=True)
        os.replace(temporary, target)
    _link(last, target.name)


def last_checkpoint(folder: Path, running: bool = False) -> Path:
    """The newest checkpoint of a run's `checkpoints` folder.

    Args:
        folder: of the run.
        running: another process may be writing checkpoints there: then nothing is tidied up.

    Raises:
        ConfigError: there is none.
    """
    if not running:
        _settle(folder)
    last = folder / _LAST
    if not (last / _MODEL / "config.json").is_file():
        raise ConfigError(f"There is no checkpoint in {folder}: check the folder, or train without --resume.")
    return last.resolve()


def checkpoint_folders(folder: Path) -> list[Path]:
    """The checkpoints in a run's `checkpoints` folder, by step; none if there is no such folder."""
    return sorted((path for path in folder.glob("*") if path.name.isdecimal()), key=lambda path: int(path.name))


def pretrained_model(checkpoint: Path) -> Path:
    """The folder of a checkpoint that `--policy.path` takes."""
    return checkpoint / _MODEL


def training_state(checkpoint: Path) -> Path:
    """The folder of a checkpoint that training goes on from."""
    return checkpoint / _STATE


def install_checkpoint(folder: Path, step: int, model: Path, names: list[str]) -> None:
    """Make `folder/<step>` of a downloaded checkpoint, and point `folder/last` to it.

    Args:
        folder: the run's `checkpoints`, which does not exist yet.
        step: navigation steps so far.
        model: with the policy's files, and `training_state`.
        names: of the policy's files.
    """
    target = folder / f"{step:06d}"
    (target / _MODEL).mkdir(parents=True)
    for name in names:
        shutil.copyfile(model / name, target / _MODEL / name)
    shutil.copytree(model / _STATE, target / _STATE)
    _sync_tree(target)
    _link(folder / _LAST, target.name)


def read_training_state(checkpoint: Path) -> dict[str, Any]:
    """Counters, random states, and with what the dataset was recorded, as `save_checkpoint` wrote them."""
    state: dict[str, Any] = read_json(checkpoint / _STATE / _COUNTERS)
    return state


def read_cursors(checkpoint: Path) -> list[Cursor]:
    """How far each dataset of others has been learned from.

    Raises:
        ConfigError: the file is not as `save_checkpoint` writes it.
    """
    try:
        cursors = [Cursor(**source) for source in read_training_state(checkpoint)["sources"]]
        for cursor in cursors:
            _count(cursor.name, cursor.episodes)
            if runs_of({"runs": cursor.runs}) != cursor.runs:
                raise ValueError(f"the runs of {cursor.name} are none")
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(
            f"The training state in {checkpoint} does not say what it has learned from ({error}); resume another."
        ) from error
    return cursors


def load_training_state(checkpoint: Path, learner: Learner, rng: Any) -> dict[str, Any]:
    """Restore what `save_checkpoint` wrote, but for the weights, and give back the counters.

    Raises:
        ConfigError: the checkpoint is of a policy with other networks, or damaged.
    """
    check_sums(checkpoint / _STATE)
    load_moments(learner.optimizers, checkpoint / _STATE)
    check_tensors(checkpoint / _STATE / _RANDOM, {"noise": learner.noise.get_state()})
    state = read_training_state(checkpoint)
    try:
        learner.noise.set_state(load_file(checkpoint / _STATE / _RANDOM)["noise"])
        rng.bit_generator.state = state["random"]["trainer"]
        learner.rng.bit_generator.state = state["random"]["learner"]
        counters: dict[str, Any] = {key: _count(key, value) for key, value in state["counters"].items()}
        counters["episodes"]  # which training goes on from
    except Exception as error:  # numpy, torch and safetensors refuse what does not fit with errors of any kind
        reason = " ".join(str(error).split())
        raise ConfigError(f"The training state in {checkpoint} cannot be read ({reason}); resume another.") from error
    return counters


def _count(name: str, value: Any) -> int:
    if type(value) is not int or not 0 <= value <= MANY:
        raise ValueError(f"{name} is {value!r} and counts something")
    return value


def _write_json(path: Path, data: Any) -> None:
    path.write_text(json.dumps(data, indent=4), encoding="utf-8")


def _link(link: Path, target: str) -> None:
    temporary = link.with_name(f".{link.name}.tmp")
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(target)
    os.replace(temporary, link)
    sync(link.parent)


def _sync_tree(folder: Path) -> None:
    for path in folder.rglob("*"):
        sync(path)
    sync(folder)


def check_same_networks(checkpoint: Path, wanted: dict[str, Any]) -> None:
    """Refuse a checkpoint whose networks differ from those of this run.

    Args:
        checkpoint: its folder.
        wanted: `LearningConfig.fingerprint` of this run.

    Raises:
        ConfigError: with the differences.
    """
    have = read_json(checkpoint / _MODEL / "config.json")
    if not isinstance(have, dict):
        raise ConfigError(f"The config.json in {checkpoint / _MODEL} has no settings; resume another.")
    differences = [f"{key} is {have.get(key)}, not {value}" for key, value in wanted.items() if have.get(key) != value]
    if differences:
        raise ConfigError(
            f"The checkpoint {checkpoint} is of another preset ({'; '.join(differences)}): resume it with its own "
            "train_config.json, or train into a new folder."
        )
