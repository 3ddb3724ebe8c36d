"""Checkpoints on the Hub: the policy at the root, where `--policy.path` looks, and beside it what training needs.

config.json, model.safetensors, policy_*.json, train_config.json    the policy
training_state/                                                     as in a local checkpoint
training_state/dataset.json                                         which dataset, and which revision of it
README.md, learning_curve.png, metrics.jsonl                        the card, and what it was made from
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from relmm.episodes import UploadedDataset, check_repo_id
from relmm.episodes.folder import refuse_links
from relmm.episodes.info import runs_of
from relmm.episodes.remote import download, push_folder, reason
from relmm.episodes.upload import refuse_other_runs
from relmm.errors import MANY, ConfigError, HubError
from relmm.learning.checkpoint import STEP, pretrained_model, training_state
from relmm.learning.settings import SETTINGS, portable_settings
from relmm.learning.sums import SUMS
from relmm.learning.untrusted import CONFIG, WEIGHTS, check_any_policy_folder, check_policy_folder, read_json

METRICS, CURVE, CARD = "metrics.jsonl", "learning_curve.png", "README.md"
_DATASET = "training_state/dataset.json"
_PROCESSOR_FILES = ("policy_*.json", "policy_*.safetensors")
# What is taken from a repository, and the largest plausible sizes in bytes.
POLICY_FILES = {
    CONFIG: 1 << 20,
    SETTINGS: 1 << 20,
    WEIGHTS: 2 << 30,
    SUMS: 1 << 20,
    **dict.fromkeys(_PROCESSOR_FILES, 10 << 20),
}
_CHECKPOINT_FILES = {**POLICY_FILES, "training_state/*": 4 << 30, METRICS: 1 << 30}


@dataclass(frozen=True)
class Source:
    """From what a checkpoint was trained, as `training_state/dataset.json` keeps it.

    Attributes:
        step: navigation steps of the run so far.
        repo_id, revision: of its dataset on the Hub; None if that is not shared.
        episodes: of the dataset at that revision.
        runs: with what it was recorded; see `relmm.episodes.upload.recorded_runs`.
    """

    step: int
    repo_id: str | None
    revision: str | None
    episodes: int
    runs: list[dict[str, Any]]


def upload_checkpoint(
    checkpoint: Path,
    repo_id: str,
    *,
    private: bool | None,
    dataset: UploadedDataset | None,
    runs: list[dict[str, Any]],
    decorate: Callable[[Path], None],
) -> str:
    """Upload a checkpoint, which is not changed.

    Args:
        checkpoint: its folder.
        repo_id: `user/name`.
        private: whether a new repository is private; None for the owner's default.
        dataset: what it was trained on, uploaded before; None if it is not shared.
        runs: with what that was recorded.
        decorate: adds card and pictures to the folder that is uploaded.

    Returns:
        The commit.

    Raises:
        ConfigError: the Hub would refuse the name, or the checkpoint is damaged, or of relmm 0.1.0.
        DatasetError: the checkpoint has links in it.
        HubError: the upload has failed, or the repository holds another run.
    """
    check_repo_id(repo_id)
    refuse_links(checkpoint)
    check_policy_folder(pretrained_model(checkpoint))
    step = _read_step(training_state(checkpoint) / STEP)
    source = Source(step, None, None, 0, runs)
    if dataset is not None:
        source = replace(source, repo_id=dataset.repo_id, revision=dataset.revision, episodes=dataset.episodes)
    with tempfile.TemporaryDirectory(prefix="relmm-upload-") as temporary:
        folder = Path(temporary)
        try:
            _stage(checkpoint, source, folder)
            decorate(folder)
        except OSError as error:
            raise HubError(
                f"the copy of {checkpoint} that is uploaded cannot be written to {folder} ({error.strerror or error}); "
                "make room there, or set TMPDIR to a larger disk."
            ) from error
        return push_folder(
            folder,
            repo_id,
            "model",
            private=private,
            replaces=["*.json", "*.safetensors", f"*{SUMS}"],
            check=_refuse_others(repo_id, source),
            message=f"{step} navigation steps",
        )


def _stage(checkpoint: Path, source: Source, folder: Path) -> None:
    shutil.copytree(pretrained_model(checkpoint), folder, dirs_exist_ok=True)
    shutil.copytree(training_state(checkpoint), folder / "training_state")
    config = portable_settings(read_json(folder / SETTINGS))
    (folder / SETTINGS).write_text(json.dumps(config, indent=4), encoding="utf-8")
    (folder / _DATASET).write_text(json.dumps(asdict(source), indent=4), encoding="utf-8")


def _refuse_others(repo_id: str, source: Source) -> Callable[[Callable[[str], Any]], None]:
    """A check that a repository has nothing, or an earlier checkpoint of this run."""

    def check(read: Callable[[str], Any]) -> None:
        if read(CONFIG) is None:
            return
        there = read(_DATASET)
        refuse_other_runs(f"model {repo_id}", source.runs, runs_of(there))
        if not isinstance(there.get("step"), int) or there["step"] > source.step:
            raise HubError(
                f"the model {repo_id} on the Hub has learned for {there.get('step')} steps and this one for "
                f"{source.step}, so somebody else goes on with it; choose another --policy.repo_id for this one."
            )

    return check


def split_revision(path_or_repo: str) -> tuple[str, str]:
    """`user/name@revision` as name and revision, `main` if it has none.

    Raises:
        ConfigError: neither a folder nor a name that the Hub allows.
    """
    repo_id, _, revision = path_or_repo.partition("@")
    try:
        check_repo_id(repo_id)
    except ConfigError as error:
        raise ConfigError(
            f"No policy can be loaded from {path_or_repo!r}: give the folder of a checkpoint's pretrained_model, or a "
            "repository user/name or user/name@revision on the Hub."
        ) from error
    return repo_id, revision or "main"


def fetch_policy(path_or_repo: str) -> Path:
    """The folder of a policy that somebody names, of relmm or not: a local one, or one from the Hub; checked.

    Raises:
        ConfigError: there is none, or it could run code of its choice.
    """
    folder = Path(path_or_repo).expanduser()
    trusted = folder.is_dir()
    if not trusted:
        folder = _download(*split_revision(path_or_repo), POLICY_FILES)
    check_any_policy_folder(folder, trusted)
    return folder


def fetch_checkpoint(repo_id: str, revision: str) -> tuple[Path, Source]:
    """A whole checkpoint from the Hub, in the cache, and what it was trained on; checked.

    Raises:
        ConfigError: there is none, it is not one of relmm's, or training cannot go on from it.
    """
    folder = _download(repo_id, revision, _CHECKPOINT_FILES)
    check_policy_folder(folder)
    if not (folder / _DATASET).is_file() or not (folder / SETTINGS).is_file():
        raise ConfigError(
            f"the model {repo_id} on the Hub has no {_DATASET}, so training cannot go on from it; "
            f"begin a run with its weights: leave out --resume=true."
        )
    return folder, _read_source(folder / _DATASET)


def _read_step(path: Path) -> int:
    content = read_json(path)
    step = content.get("step") if isinstance(content, dict) else None
    if type(step) is not int or not 0 <= step <= MANY:
        raise ConfigError(f"{path} does not say how many steps the checkpoint has; use another checkpoint.")
    return step


def _read_source(path: Path) -> Source:
    content = read_json(path)
    try:
        source = Source(**content)
        plausible = (
            type(source.step) is type(source.episodes) is int
            and 0 <= source.step <= MANY
            and 0 <= source.episodes <= MANY
            and isinstance(source.runs, list)
            and all(isinstance(name, str | None) for name in (source.repo_id, source.revision))
        )
    except TypeError:
        plausible = False
    if not plausible:
        raise ConfigError(f"{path} does not say what the checkpoint was trained on; use another checkpoint.")
    return source


def _download(repo_id: str, revision: str, limits: dict[str, int]) -> Path:
    try:
        return download(repo_id, "model", revision, limits)
    except HubError as error:
        raise ConfigError(str(error)) from error
    except Exception as error:  # the Hub's client also raises those of its HTTP library, which may change
        why = reason(f"model {repo_id}", revision, error)
        raise ConfigError(f"No policy can be loaded from {repo_id!r}: {why}.") from error
