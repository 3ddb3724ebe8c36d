"""Going on with a run from the Hub: it is made here again, with its dataset, and then resumed like any other."""

from __future__ import annotations

import json
import os
import shutil
from fnmatch import fnmatch
from pathlib import Path

from relmm.commands.arguments import Arguments
from relmm.episodes import check_trainable, verify_and_repair
from relmm.episodes.folder import DATA_FILES, EPISODE_FILES, INFO, OWN_DATASET, RELMM, STATS, TASKS
from relmm.episodes.hub import download_dataset
from relmm.errors import ConfigError, DatasetError
from relmm.learning.checkpoint import install_checkpoint, pretrained_model
from relmm.learning.hub import METRICS, POLICY_FILES, Source, fetch_checkpoint, split_revision
from relmm.learning.settings import SETTINGS, portable_settings
from relmm.learning.untrusted import read_json

_DATASET_FILES = (INFO, STATS, TASKS, RELMM, EPISODE_FILES, DATA_FILES)


def take_over_from_hub(arguments: Arguments) -> None:
    """With `--resume=true --policy.path=user/repo[@revision]`, make that run in `--output_dir`.

    Args:
        arguments: of the command line; the path is removed, for what is left resumes a local run.

    Raises:
        ConfigError: there is no such checkpoint, training cannot go on from it, or the folder exists.
        DatasetError: its dataset cannot be had, or is damaged.
    """
    path, folder = arguments.get("policy.path"), arguments.get("output_dir")
    if path is None or not arguments.is_true("resume"):
        return
    if not folder:
        raise ConfigError(f"Say where to go on with {path}: --output_dir=FOLDER, which does not exist yet.")
    output = Path(folder)
    if output.exists():
        raise ConfigError(
            f"{output} exists already: go on with the run in it without --policy.path, or choose another --output_dir."
        )
    if Path(path).is_dir():
        raise ConfigError(
            f"{path} is a folder: go on with a run of this machine with --resume=true --output_dir=FOLDER_OF_THE_RUN."
        )
    _make_run(*split_revision(path), output)
    arguments.remove("policy.path")


def _make_run(repo_id: str, revision: str, output: Path) -> None:
    model, source = fetch_checkpoint(repo_id, revision)
    if source.repo_id is None or source.revision is None:
        raise ConfigError(
            f"the dataset of {repo_id} is not shared, and training goes on from both; begin a run with its weights "
            "instead: leave out --resume=true."
        )
    print(f"downloading the dataset {source.repo_id}, {source.episodes} episodes")
    dataset = download_dataset(source.repo_id, source.revision)
    check_trainable(dataset)
    temporary = output.with_name(f".{output.name}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        _copy_run(model, dataset, source, temporary)
        os.replace(temporary, output)
    except OSError as error:
        raise DatasetError(
            f"{output} cannot be written ({error.strerror or error}); make room or check the permissions, "
            "then try again."
        ) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _copy_run(model: Path, dataset: Path, source: Source, run: Path) -> None:
    names = [path.name for path in model.iterdir() if any(fnmatch(path.name, pattern) for pattern in POLICY_FILES)]
    install_checkpoint(run / "checkpoints", source.step, model, names)
    settings = pretrained_model(run / "checkpoints" / f"{source.step:06d}") / SETTINGS
    settings.write_text(json.dumps(portable_settings(read_json(settings)), indent=4), encoding="utf-8")
    if (model / METRICS).is_file():
        shutil.copyfile(model / METRICS, run / METRICS)
    for file in (file for pattern in _DATASET_FILES for file in dataset.glob(pattern)):
        target = run / OWN_DATASET / file.relative_to(dataset)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, target)
    _check_whole(run / OWN_DATASET, source)


def _check_whole(root: Path, source: Source) -> None:
    try:
        report = verify_and_repair(root)
        problems = report.problems
        if not problems and report.episodes < source.episodes:
            problems = [f"it has {report.episodes} episodes instead of {source.episodes}"]
    except DatasetError as error:
        problems = [str(error).split(";")[0].replace(str(root), "it")]
    if problems:
        raise DatasetError(
            f"the dataset {source.repo_id} on the Hub is damaged ({'; '.join(problems)}); try another revision."
        )
