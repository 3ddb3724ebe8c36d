"""relmm-analyze: what a robot did, and whether what it believed was right, from a dataset and perhaps a checkpoint."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot.configs import parser
from lerobot.configs.policies import PreTrainedConfig
from lerobot.utils.constants import PRETRAINED_MODEL_DIR
from matplotlib.figure import Figure

from relmm.analysis import Collection, collect, compare, export, summarize_collection, write_report
from relmm.analysis.comparison import on_common_ground, score_difference
from relmm.analysis.predictions import Predictor
from relmm.analysis.selection import narrowed
from relmm.analysis.summary import SUMMARY
from relmm.commands.cli import progress, run
from relmm.commands.policies import load_config, make_actor, policy_from_path
from relmm.episodes import check_repo_id, local_root
from relmm.episodes.folder import OWN_DATASET, RELMM, DatasetFolder
from relmm.episodes.info import runs_of
from relmm.errors import ConfigError
from relmm.learning.checkpoint import read_training_state, training_state


@dataclass
class AnalyzeDatasetConfig:
    """A dataset to read.

    Args:
        repo_id: its name, `user/name` or `user/name@revision`; it is downloaded if it is not on this machine.
        root: its folder.
    """

    repo_id: str | None = None
    root: Path | None = None

    @property
    def given(self) -> bool:
        """Whether there is one."""
        return self.repo_id is not None or self.root is not None

    @property
    def name(self) -> str:
        """For people, and commands that ask for a name; that of the run where relmm-train chose the folder's."""
        if self.repo_id is not None:
            return self.repo_id.partition("@")[0]
        assert self.root is not None
        root = self.root.resolve()
        return f"local/{root.parent.name if root.name == OWN_DATASET else root.name}"

    def folder(self) -> Path:
        """Where it is, after a download if need be."""
        return local_root(str(self.root if self.root is not None else self.repo_id))


@dataclass
class ComparedPolicyConfig:
    """Another policy.

    Args:
        path: its folder, or user/repo[@revision].
    """

    path: str | None = None


@dataclass
class CompareConfig:
    """Another dataset, or another policy, to put side by side.

    Args:
        dataset: another dataset.
        policy: another policy, on the same dataset or on the other one.
    """

    dataset: AnalyzeDatasetConfig = field(default_factory=AnalyzeDatasetConfig)
    policy: ComparedPolicyConfig = field(default_factory=ComparedPolicyConfig)

    @property
    def given(self) -> bool:
        """Whether there is anything to compare with."""
        return self.dataset.given or self.policy.path is not None


@dataclass
class ExportConfig:
    """Where the selected attempts go, as a dataset.

    Args:
        root: a folder that does not exist yet; None to write none.
        repo_id: name of the new dataset.
        whole_episodes: keep all frames of the episodes that have a selected attempt, not only the attempts.
    """

    root: Path | None = None
    repo_id: str = "local/selected"
    whole_episodes: bool = False


@dataclass
class AnalyzeConfig:
    """What `relmm-analyze` does.

    Args:
        output_dir: folder for the report; new, unless `overwrite`.
        dataset: the dataset.
        policy: a policy to ask about each attempt; None for what was recorded only.
        where: which attempts, as `pandas.DataFrame.query` takes it: "success == 0 and phase == 'learning'".
        compare: another dataset or policy.
        export: writes the selected attempts as a dataset.
        overwrite: replace an earlier report in `output_dir`.
    """

    output_dir: Path | None = None
    dataset: AnalyzeDatasetConfig = field(default_factory=AnalyzeDatasetConfig)
    policy: PreTrainedConfig | None = None
    where: str | None = None
    compare: CompareConfig = field(default_factory=CompareConfig)
    export: ExportConfig = field(default_factory=ExportConfig)
    overwrite: bool = False

    def __post_init__(self) -> None:
        if not self.dataset.given:
            raise ConfigError("Say which dataset: --dataset.root=FOLDER, or --dataset.repo_id=user/name.")
        if self.output_dir is None:
            raise ConfigError("Say where the report goes: --output_dir=FOLDER.")
        if self.output_dir.exists() and not self.overwrite:
            raise ConfigError(
                f"{self.output_dir} exists already: choose another --output_dir, or say --overwrite=true."
            )
        if self.export.root is not None:
            check_repo_id(self.export.repo_id)
            if self.export.root.exists():
                raise ConfigError(f"{self.export.root} exists already: choose another --export.root.")
        if self.policy is not None or parser.get_path_arg("policy"):
            self.policy = policy_from_path(self.policy)

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """The fields that LeRobot's parser lets be loaded with `.path`."""
        return ["policy"]


def analyze(config: AnalyzeConfig) -> None:
    """Write the report, and the selection if one is wanted."""
    assert config.output_dir is not None
    root = config.dataset.folder()
    collection = _collect(root, config.output_dir, config.policy, "reading")
    if config.where is not None:
        collection = narrowed(collection, config.where)
    summary = _summary(collection, config)
    write_report(config.output_dir, collection, summary, _comparison(collection, config, root))
    print(f"report: {config.output_dir / 'report.html'}")
    if config.export.root is not None:
        _export(config, collection, root)


def _collect(root: Path, output: Path, policy: PreTrainedConfig | None, title: str) -> Collection:
    predictor = learned = None
    if policy is not None:
        predictor = Predictor(make_actor(policy).policy)
        learned = learned_episodes(Path(str(policy.pretrained_path)), root)
    with closing(progress(0, "frame", title, leave=False)) as bar:

        def show(frames: int, total: int) -> None:
            bar.total = total
            bar.update(frames)

        return collect(root, output, predictor, learned, show)


def _summary(collection: Collection, config: AnalyzeConfig) -> dict[str, Any]:
    path = None if config.policy is None else str(config.policy.pretrained_path)
    return {
        **summarize_collection(collection, config.dataset.name),
        "where": config.where,
        "policy_path": path,
    }


def learned_episodes(model: Path, root: Path) -> int | None:
    """How many of a dataset's first episodes a checkpoint has learned from.

    Args:
        model: its folder, `pretrained_model`.
        root: the dataset.

    Returns:
        The cursor of its training if that wrote this dataset, 0 if it wrote another one, None if nobody knows.
    """
    state = training_state(model.parent)
    if not (state / "relmm_state.json").is_file():
        return None
    stored = read_training_state(model.parent)
    own, theirs = runs_of(DatasetFolder(root).read_json(RELMM)), runs_of(stored)
    beside = model.resolve().parents[2] / OWN_DATASET == root.resolve()
    if not beside and not (own and theirs):
        return None
    return int(stored["counters"]["episodes"]) if beside or own[: len(theirs)] == theirs else 0


def _comparison(collection: Collection, config: AnalyzeConfig, root: Path) -> tuple[dict[str, Any], Figure] | None:
    compared, path = config.compare.dataset, config.compare.policy.path
    if not config.compare.given:
        return None
    assert config.output_dir is not None
    policy = config.policy if path is None else load_config(path, [])
    there = compared.folder() if compared.given else root
    other = _collect(there, config.output_dir / "compared", policy, "reading the other one")
    if config.where is not None:
        other = narrowed(other, config.where)
    name, own = compared.name if compared.given else config.dataset.name, parser.get_path_arg("policy")
    score = None
    if there == root:
        collection, other = on_common_ground(collection, other)
        score = score_difference(collection, other)
    here, beyond = summarize_collection(collection, config.dataset.name), summarize_collection(other, name)
    names = told_apart((config.dataset.name, own), (name, path or own))
    (config.output_dir / "compared" / SUMMARY).write_text(json.dumps(beyond, indent=2), encoding="utf-8")
    return compare(here, beyond, (names[0], names[1]), score)


def told_apart(*compared: tuple[str, str | None]) -> list[str]:
    """Short names of what is compared: the dataset if these differ, and the policy if those do.

    Args:
        compared: name of a dataset, and path of a policy or None.
    """
    datasets, policies = ([each[i] for each in compared] for i in (0, 1))
    names = []
    for dataset, policy in compared:
        parts = [dataset] if len(set(datasets)) > 1 or len(set(policies)) == 1 else []
        parts += [_short(policy)] if len(set(policies)) > 1 else []
        names.append(", ".join(parts))
    return names


def _short(policy: str | None) -> str:
    """A checkpoint of relmm-train by its run and step, whatever is on the Hub by its name."""
    if policy is None:
        return "as recorded"
    path = Path(policy)
    if path.name != PRETRAINED_MODEL_DIR or not path.is_dir():
        return policy
    step = path.resolve().parent
    return f"{step.parents[1].name} at step {step.name.lstrip('0') or '0'}"


def _export(config: AnalyzeConfig, collection: Collection, root: Path) -> None:
    assert config.export.root is not None
    with closing(progress(len(collection.frames), "frame", "exporting", leave=False)) as bar:
        show: Callable[[int], None] = bar.update
        frames = export(
            collection.grasps,
            root,
            config.export.root,
            config.export.repo_id,
            whole_episodes=config.export.whole_episodes,
            info={"selected_from": config.dataset.name, "where": config.where, "runs": collection.runs},
            progress=show,
        )
    print(f"{len(collection.grasps)} attempts in {frames} frames: {config.export.root}")


def main() -> None:
    """Entry point of `relmm-analyze`."""
    run("relmm-analyze", AnalyzeConfig, analyze)


if __name__ == "__main__":
    main()
