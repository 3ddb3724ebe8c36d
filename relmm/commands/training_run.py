"""One run of relmm-train: what is made from its settings, saved, and restored when it is resumed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import draccus
import numpy as np

from relmm.analysis.report import REPORT
from relmm.commands.cli import StopOnSignal, progress
from relmm.commands.display import DisplayOptions
from relmm.commands.policies import make_actor
from relmm.commands.sharing import Uploads, run_arguments
from relmm.commands.tracking import Tracker
from relmm.commands.train_config import TrainConfig
from relmm.commands.training_bar import EVALUATION_WEIGHT, PRACTICE_WEIGHT, Phase, TrainingBar
from relmm.commands.training_report import TrainingReport
from relmm.episodes import (
    Episode,
    check_trainable,
    local_root,
    read_episodes,
    saved_episodes,
)
from relmm.episodes.folder import DatasetFolder
from relmm.episodes.info import runs_of
from relmm.episodes.sources import Cursor
from relmm.episodes.upload import recorded_runs
from relmm.errors import ConfigError
from relmm.learning.checkpoint import (
    check_same_networks,
    last_checkpoint,
    load_training_state,
    pretrained_model,
    read_training_state,
    save_checkpoint,
)
from relmm.learning.progress import Metrics, Progress
from relmm.learning.session import Schedule, Session
from relmm.policies.learning import LearningConfig, LearningPolicy
from relmm.sim.config_locobot_sim import LocobotSimConfig

_STREAM = 3  # keeps random numbers of one seed apart


class Run:
    """One run of relmm-train.

    Args:
        config: its settings.
        signals: tell when to stop.
    """

    def __init__(self, config: TrainConfig, signals: StopOnSignal) -> None:
        assert isinstance(config.policy, LearningConfig)
        self.config, self.signals = config, signals
        self.saved_config = settings_to_keep(config)
        self.checkpoint = last_checkpoint(config.checkpoints) if config.resume else None
        if self.checkpoint is not None:
            check_same_networks(self.checkpoint, config.policy.fingerprint())
            config.policy.pretrained_path = pretrained_model(self.checkpoint)
        self.actor = make_actor(config.policy)
        config.policy.pretrained_path = None  # a checkpoint stands for itself, wherever it is copied to
        policy = self.actor.policy
        assert isinstance(policy, LearningPolicy)
        self.policy = policy
        policy.train()
        self.learner = policy.make_learner(config.seed, config.replay_frames)
        self.rng = np.random.default_rng([config.seed, _STREAM])
        self.progress = Progress()
        self.words: Callable[[], str] = str  # more of them for the progress bar
        self.learned = 0  # episodes of the run's dataset that the checkpoint has learned from
        if self.checkpoint is not None:
            counters = load_training_state(self.checkpoint, self.learner, self.rng)
            self.learned, self.progress.interventions = counters["episodes"], counters.get("interventions", 0)
        self.listeners: list[Callable[[dict[str, Any]], None]] = []  # called with each line of the metrics
        assert config.output_dir is not None
        self._tracker: Tracker | None = None
        self._report: TrainingReport | None = None
        recorded = config.followed or [self.data]
        if config.report and len(recorded) == 1 and not config.fleet.rooms:  # a report is of one dataset
            self._report = TrainingReport(recorded[0], config.dataset.repo_id, config.output_dir / REPORT)
        self.uploads = Uploads(run_arguments(config), config.output_dir)

    @property
    def data(self) -> Path:
        """The folder of the dataset that the run records and learns from."""
        return self.config.dataset_root

    def check_cursor(self, episodes: int) -> None:
        """Refuse to go on without the data that the checkpoint has learned from.

        Args:
            episodes: that the run's dataset has.

        Raises:
            ConfigError: it has fewer, or those of another run.
        """
        if self.checkpoint is None:
            return
        what = f"the checkpoint {self.checkpoint} has learned from {self.learned} episodes"
        advice = f"bring them back, or begin a new run with --policy.path={pretrained_model(self.checkpoint)}"
        if episodes < self.learned:
            raise ConfigError(f"{what}, and its dataset {self.data} has {episodes}: {advice}.")
        runs = runs_of(read_training_state(self.checkpoint))
        if self.learned and recorded_runs(DatasetFolder(self.data))[: len(runs)] != runs:
            raise ConfigError(f"{what} of another recording than {self.data}: {advice}.")

    def read_initial_data(self) -> None:
        """Fill the replay with the dataset to start from, and learn what is new in it."""
        if self.config.dataset.init is not None:
            root = local_root(self.config.dataset.init)
            check_trainable(root, self.policy.config.camera)
            update = self.checkpoint is None
            for episode in _with_bar(root, "reading the initial dataset"):
                self.learner.read(episode, update)

    def read_own_data(self) -> int:
        """Fill the replay with the run's own dataset, and learn what the checkpoint has not; how many episodes."""
        episodes = 0
        if self.checkpoint is not None and self.data.exists():
            check_trainable(self.data, self.policy.config.camera)
            for episode in _with_bar(self.data, "reading the run's own dataset"):
                self.learner.read(episode, update=episode.index >= self.learned)
                self.progress.read(episode)
                episodes = episode.index + 1
        return episodes

    def save(
        self,
        episodes: int,
        runs: list[dict[str, Any]] | None = None,
        sources: Sequence[Cursor] = (),
        passing: bool = False,
    ) -> Path:
        """Write a checkpoint; its folder.

        Args:
            episodes: that the weights have learned from, of the run's dataset or of those of others; a resumed run
                learns the later ones.
            runs: with what they were recorded; None for those of the run's own dataset.
            sources: how far each dataset of others has been learned from.
            passing: it is for those who act, will soon be removed, and is not tracked.
        """
        counters = {"episodes": episodes, "interventions": self.progress.interventions}
        checkpoint = save_checkpoint(
            self.config.checkpoints,
            self.progress.steps,
            self.actor,
            self.learner,
            self.rng,
            counters,
            self.saved_config,
            recorded_runs(DatasetFolder(self.data)) if runs is None else runs,
            sources,
        )
        if self._tracker is not None and not passing:
            self._tracker.log_checkpoint(checkpoint)
        if self._report is not None and episodes:
            self._report.refresh()
        return checkpoint

    def track(self) -> None:
        """Begin to log to Weights & Biases, if that is asked for; to be called when the run is sure to begin.

        Raises:
            ConfigError: it cannot be.
        """
        if self.config.wandb.enable:
            self._tracker = Tracker(self.config, self.saved_config)
            self.listeners.append(self._tracker.log)

    def finish(self) -> None:
        """Make the report of all there is, and send to others what they have not got yet."""
        if self._report is not None and self.progress.attempts:
            self._report.say = print
            self._report.finish()
        if self._tracker is not None:
            self._tracker.finish()
        self.uploads.say = print
        self.uploads.finish()

    def bar(self, title: str) -> TrainingBar:
        """A progress bar of the whole run, what was done before a resume included."""
        config, done = self.config, self.progress
        if done.steps >= config.steps:
            print(f"this run has gone {done.steps} navigation steps already; a --steps above that goes on with it")
        phases = [Phase("steps", config.steps, 1.0, min(done.steps, config.steps))]
        if isinstance(config.robot, LocobotSimConfig) and config.env_eval_freq:
            weight, every = EVALUATION_WEIGHT * config.eval.n_episodes, config.env_eval_freq
            phases.append(Phase("evaluations", config.steps // every, weight, min(done.steps, config.steps) // every))
        if config.robot is not None and config.curriculum.type == "stationary":
            practice = self.policy.config.num_stationary
            phases.insert(0, Phase("practice", practice, PRACTICE_WEIGHT, min(done.practice_attempts, practice)))
        return TrainingBar(title, phases)

    def session(self, save: Callable[[], None], evaluate: Callable[[], dict[str, Any]], bar: TrainingBar) -> Session:
        """The loop with everything around it."""
        config = self.config
        assert config.output_dir is not None
        schedule = Schedule(config.steps, config.log_freq, config.save_freq, config.env_eval_freq, config.hub.every)
        self.uploads.say = bar.write
        if self._report is not None:
            self._report.say = bar.write

        def show(status: dict[str, Any]) -> None:
            words = f"{status['objects']} objects, {status['successes']}/{status['attempts']} grasps"
            words = ", ".join(filter(None, [words, self.words()]))
            bar.advance("practice", status["practice_attempts"], words)
            bar.advance("steps", status["steps"], words)
            self.uploads.check()
            if self._report is not None:
                self._report.check()

        metrics = Metrics(config.output_dir / "metrics.jsonl", self.listeners)
        return Session(
            schedule,
            self.progress,
            self.learner,
            metrics,
            save=save,
            evaluate=evaluate,
            show=show,
            upload=self.uploads.begin,
        )


def settings_to_keep(config: TrainConfig) -> dict[str, Any]:
    """For a resume, which may come from another folder: as given, but with whole paths."""
    settings: dict[str, Any] = draccus.encode(config)
    for option in fields(DisplayOptions):  # who looks on today need not look on after a resume
        del settings[option.name]
    dataset = settings["dataset"]
    if dataset["follow"] is not None:
        dataset["follow"] = ",".join(str(place.absolute()) for place in config.followed)
    for name in ("root", "init"):
        # What does not exist yet is a folder, too, but for `init`: that may be a name on the Hub.
        if dataset[name] is not None and (name != "init" or Path(dataset[name]).exists()):
            dataset[name] = str(Path(dataset[name]).absolute())
    return settings


def _with_bar(root: Path, title: str) -> Iterator[Episode]:
    with progress(saved_episodes(root), "episode", title, leave=False) as bar:
        for episode in read_episodes(root):
            yield episode
            bar.update()
