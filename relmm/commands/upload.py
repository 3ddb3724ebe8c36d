"""relmm-upload: bring a run or a dataset to the Hub, now or again. Training uses it, too, in the background."""

from __future__ import annotations

import os
import shutil
import signal
import sys
from dataclasses import dataclass, field
from pathlib import Path

from relmm.commands.cli import run
from relmm.commands.curve import draw_learning_curve
from relmm.commands.model_card import ModelFacts, model_card
from relmm.episodes import UploadedDataset, check_repo_id, upload_dataset
from relmm.episodes.folder import OWN_DATASET, DatasetFolder
from relmm.episodes.upload import recorded_runs
from relmm.errors import ConfigError
from relmm.learning.checkpoint import last_checkpoint, pretrained_model
from relmm.learning.hub import CARD, CURVE, METRICS, upload_checkpoint
from relmm.learning.settings import read_settings

LICENSE = "apache-2.0"
_NICENESS = 19  # whatever else the machine does comes first


@dataclass
class UploadDatasetConfig:
    """The dataset to upload.

    Args:
        repo_id: its name on the Hub, `user/name`; None to upload none.
        root: its folder; None for that of the run in `output_dir`.
        private: whether a new repository is private; None for the owner's default.
        license: for its card, an identifier of the Hub.
    """

    repo_id: str | None = None
    root: Path | None = None
    private: bool | None = None
    license: str = LICENSE


@dataclass
class UploadPolicyConfig:
    """The newest checkpoint of the run, to upload.

    Args:
        repo_id: its name on the Hub, `user/name`; None to upload none.
        private: whether a new repository is private; None for the owner's default.
        license: for its card, an identifier of the Hub.
        tags: more of them for its card.
    """

    repo_id: str | None = None
    private: bool | None = None
    license: str | None = None
    tags: list[str] | None = None


@dataclass
class UploadConfig:
    """Upload the newest checkpoint of a run, and a dataset; what is on the Hub already is not sent again.

    Args:
        output_dir: of a run of relmm-train; it may be running.
        policy: `--policy.repo_id=user/name` for its newest checkpoint.
        dataset: `--dataset.repo_id=user/name` for its dataset, or that in `--dataset.root`.
        background: give way to everything else.
    """

    output_dir: Path | None = None
    policy: UploadPolicyConfig = field(default_factory=UploadPolicyConfig)
    dataset: UploadDatasetConfig = field(default_factory=UploadDatasetConfig)
    background: bool = False

    def __post_init__(self) -> None:
        names = [name for name in (self.policy.repo_id, self.dataset.repo_id) if name is not None]
        for name in names:
            check_repo_id(name)
        if not names:
            raise ConfigError("Say what to upload: --policy.repo_id=user/name, --dataset.repo_id=user/name, or both.")
        if self.output_dir is None and (self.policy.repo_id is not None or self.dataset.root is None):
            raise ConfigError(
                "Say what to upload: --output_dir=FOLDER of a run of relmm-train, or --dataset.root=FOLDER."
            )

    @property
    def dataset_root(self) -> Path:
        """The folder of the dataset."""
        if self.dataset.root is not None:
            return self.dataset.root
        assert self.output_dir is not None
        checkpoint = last_checkpoint(self.output_dir / "checkpoints", running=True)
        settings = read_settings(pretrained_model(checkpoint))["dataset"]
        root = settings["root"] or settings["follow"]
        return Path(root) if root else self.output_dir / OWN_DATASET


def upload(config: UploadConfig) -> None:
    """Upload the dataset, then the checkpoint that says which one it was trained on."""
    if config.background:
        os.nice(_NICENESS)
    # Looked up first: whatever this checkpoint has learned from is in the dataset by now.
    checkpoint = _newest(config.output_dir)
    dataset = None
    if config.dataset.repo_id is not None:
        dataset = upload_dataset(
            config.dataset_root,
            config.dataset.repo_id,
            private=config.dataset.private,
            license=config.dataset.license,
        )
        print(f"dataset, {dataset.episodes} episodes: {_url('datasets/' + dataset.repo_id)}", flush=True)
    if config.policy.repo_id is not None:
        assert checkpoint is not None
        _upload_policy(config, checkpoint, dataset)
        print(f"policy: {_url(config.policy.repo_id)}", flush=True)


def _upload_policy(config: UploadConfig, checkpoint: Path, dataset: UploadedDataset | None) -> None:
    assert config.output_dir is not None
    assert config.policy.repo_id is not None
    metrics = config.output_dir / METRICS
    facts = ModelFacts(
        repo_id=config.policy.repo_id,
        settings=read_settings(pretrained_model(checkpoint)),
        metrics=metrics,
        dataset=dataset,
        license=config.policy.license or LICENSE,
        tags=tuple(config.policy.tags or ()),
    )

    def decorate(folder: Path) -> None:
        if metrics.is_file():
            shutil.copyfile(metrics, folder / METRICS)
            draw_learning_curve(folder / METRICS, folder / CURVE)
        model_card(facts).save(folder / CARD)

    upload_checkpoint(
        checkpoint,
        config.policy.repo_id,
        private=config.policy.private,
        dataset=dataset,
        runs=recorded_runs(DatasetFolder(config.dataset_root)),
        decorate=decorate,
    )


def _newest(output_dir: Path | None) -> Path | None:
    return last_checkpoint(output_dir / "checkpoints", running=True) if output_dir else None


def _url(path: str) -> str:
    from huggingface_hub import constants

    return f"{constants.ENDPOINT}/{path}"


def main() -> None:
    """Entry point of `relmm-upload`."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:  # as under nohup
            signal.signal(number, lambda *_: sys.exit(1))  # so that the copy that is uploaded is removed
    run("relmm-upload", UploadConfig, upload)


if __name__ == "__main__":
    main()
