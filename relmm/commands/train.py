"""relmm-train: a robot is put into a room and learns to clean it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import draccus
import numpy as np

from relmm.commands.arguments import Arguments
from relmm.commands.cli import StopOnSignal, now, progress, run
from relmm.commands.curve import draw_learning_curve
from relmm.commands.hub_resume import take_over_from_hub
from relmm.commands.policies import make_actor
from relmm.commands.policy_type import choose_policy
from relmm.commands.presets import resolve_config_path
from relmm.commands.robots import make_locobot
from relmm.commands.sharing import Uploads, check_uploads, run_arguments
from relmm.commands.train_config import TrainConfig
from relmm.commands.train_evaluation import RoomEvaluation
from relmm.commands.training_bar import EVALUATION_WEIGHT, PRACTICE_WEIGHT, Phase, TrainingBar
from relmm.episodes import (
    Episode,
    EpisodeFollower,
    EpisodeRecorder,
    check_new,
    check_trainable,
    local_root,
    read_episodes,
    saved_episodes,
    summarize,
    verify_and_repair,
)
from relmm.episodes.folder import DatasetFolder
from relmm.episodes.upload import recorded_runs, runs_of
from relmm.errors import ConfigError
from relmm.learning.checkpoint import (
    check_same_networks,
    last_checkpoint,
    load_training_state,
    pretrained_model,
    read_training_state,
    save_checkpoint,
)
from relmm.learning.life import Life
from relmm.learning.progress import Metrics, Progress
from relmm.learning.session import Schedule, Session
from relmm.learning.trainer import Trainer
from relmm.policies.learning import LearningConfig, LearningPolicy
from relmm.robot.locobot import LocobotRobot
from relmm.sim.config_locobot_sim import LocobotSimConfig
from relmm.sim.locobot_sim import LocobotSim
from relmm.sim.person import Person

_TRAINER_STREAM, _PERSON_STREAM = 3, 4  # keep random numbers of one seed apart
_POLL_S = 0.5  # between looks at a dataset that is followed


class Run:
    """One run of relmm-train: what is made from its settings, and restored when it is resumed.

    Args:
        config: its settings.
        signals: tell when to stop.
    """

    def __init__(self, config: TrainConfig, signals: StopOnSignal) -> None:
        assert isinstance(config.policy, LearningConfig)
        self.config, self.signals = config, signals
        self.saved_config = _settings_to_keep(config)
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
        self.rng = np.random.default_rng([config.seed, _TRAINER_STREAM])
        self.progress = Progress()
        self.learned = 0  # episodes of the run's dataset that the checkpoint has learned from
        if self.checkpoint is not None:
            counters = load_training_state(self.checkpoint, self.learner, self.rng)
            self.learned, self.progress.interventions = counters["episodes"], counters["interventions"]
        assert config.output_dir is not None
        self.uploads = Uploads(run_arguments(config), config.output_dir)

    @property
    def data(self) -> Path:
        """The folder of the dataset that the run learns from."""
        return self.config.dataset.follow or self.config.dataset_root

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

    def save(self, episodes: int) -> None:
        """Write a checkpoint.

        Args:
            episodes: of the run's dataset that the weights have learned from; a resumed run learns the later ones.
        """
        counters = {"episodes": episodes, "interventions": self.progress.interventions}
        save_checkpoint(
            self.config.checkpoints,
            self.progress.steps,
            self.actor,
            self.learner,
            self.rng,
            counters,
            self.saved_config,
            recorded_runs(DatasetFolder(self.data)),
        )

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

        def show(status: dict[str, Any]) -> None:
            words = f"{status['objects']} objects, {status['successes']}/{status['attempts']} grasps"
            bar.advance("practice", status["practice_attempts"], words)
            bar.advance("steps", status["steps"], words)
            self.uploads.check()

        metrics = Metrics(config.output_dir / "metrics.jsonl")
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


def _settings_to_keep(config: TrainConfig) -> dict[str, Any]:
    """For a resume, which may come from another folder: as given, but with whole paths."""
    settings: dict[str, Any] = draccus.encode(config)
    dataset = settings["dataset"]
    for name in ("root", "follow", "init"):
        # What does not exist yet is a folder, too, but for `init`: that may be a name on the Hub.
        if dataset[name] is not None and (name != "init" or Path(dataset[name]).exists()):
            dataset[name] = str(Path(dataset[name]).absolute())
    return settings


def _with_bar(root: Path, title: str) -> Iterator[Episode]:
    with progress(saved_episodes(root), "episode", title, leave=False) as bar:
        for episode in read_episodes(root):
            yield episode
            bar.update()


def train(config: TrainConfig) -> None:
    """Train, and say where everything is."""
    import torch

    torch.set_num_threads(config.num_threads)
    check_uploads(config)
    with StopOnSignal() as signals:
        run = Run(config, signals)
        if config.dataset.follow is not None:
            _train_on_stream(run, config.dataset.follow)
        else:
            _train_on_robot(run)
    assert config.output_dir is not None
    draw_learning_curve(config.output_dir / "metrics.jsonl", config.output_dir / "learning_curve.png")
    kept = "checkpoints, metrics" if config.robot is None else "checkpoints, metrics, dataset"
    print(f"{kept} and learning_curve.png: {config.output_dir}")
    run.uploads.say = print
    run.uploads.finish()


def _train_on_robot(run: Run) -> None:
    config = run.config
    assert config.robot is not None
    saved, damaged = _own_dataset(run)
    run.read_initial_data()
    seed = config.seed + saved
    robot = make_locobot(replace(config.robot), seed, "relmm-train")
    with robot:
        robot.get_observation()  # a robot that cannot see fails here, before anything is written
        with _recorder(run, robot, seed) as recorder:
            run.read_own_data()  # now that nobody else writes to it
            if damaged:
                run.save(recorder.saved_episodes)
            life = Life(
                robot,
                [recorder, run.learner, run.progress],
                robot.seconds,
                config.max_steps,
                should_stop=lambda: run.signals.stopped,
            )
            trainer = Trainer(
                life,
                run.policy,
                run.learner,
                curriculum=config.curriculum.type,
                pseudo_reset_steps=config.pseudo_reset_steps,
                rng=run.rng,
                put_in_reach=_person(robot, seed),
                progress=run.progress,
            )

            def save() -> None:
                life.cut_episode()
                recorder.flush()
                run.save(recorder.saved_episodes)

            with run.bar("training") as bar:
                run.session(save, _evaluation(run, bar), bar).live(trainer, lambda: run.signals.stopped)
    if recorder.saved_episodes > 0:
        print(summarize(config.dataset_root))


def _own_dataset(run: Run) -> tuple[int, bool]:
    """See that the run's dataset is there, and repair it; its episodes, and whether any were lost."""
    config = run.config
    root = config.dataset_root
    if not config.resume:
        check_new(root, config.dataset.repo_id)
        return 0, False
    report = verify_and_repair(root) if root.exists() else None
    episodes, damaged = (report.episodes, bool(report.problems)) if report is not None else (0, False)
    if damaged:
        print(report)
        run.learned = min(run.learned, episodes)
    run.check_cursor(episodes)
    return episodes, damaged


def _recorder(run: Run, robot: LocobotRobot, seed: int) -> EpisodeRecorder:
    config, settings = run.config, run.config.robot
    info = {key: getattr(settings, key) for key in ("room", "num_objects", "camera") if hasattr(settings, key)}
    root = config.dataset_root
    root.parent.mkdir(parents=True, exist_ok=True)
    return EpisodeRecorder(
        root,
        config.dataset.repo_id,
        resume=config.resume and root.exists(),
        save_unfinished=True,
        depth="front_depth" in robot.observation_features,
        robot_type=robot.name,
        info={**info, "seed": seed, "started": now(), "policy": run.policy.name, "curriculum": config.curriculum.type},
    )


def _person(robot: LocobotRobot, seed: int) -> Callable[[], bool]:
    if isinstance(robot, LocobotSim):
        return Person(robot, np.random.default_rng([seed, _PERSON_STREAM])).put_in_reach
    return lambda: False


def _evaluation(run: Run, bar: TrainingBar) -> Callable[[], dict[str, Any]]:
    settings = run.config.robot
    if not isinstance(settings, LocobotSimConfig):
        return dict
    assert run.config.output_dir is not None
    folder, every = run.config.output_dir / "eval", run.config.env_eval_freq

    def show(share: float) -> None:
        bar.advance("evaluations", run.progress.steps // every - 1 + share)

    evaluation = RoomEvaluation(
        settings, run.actor, run.config.eval, folder, should_stop=lambda: run.signals.stopped, show=show
    )

    def evaluate() -> dict[str, Any]:
        scores = evaluation(run.progress.steps)
        if scores:
            bar.write(f"step {run.progress.steps}: collected {scores['eval_collected']:.1%} of the objects")
        return scores

    return evaluate


def _train_on_stream(run: Run, root: Path) -> None:
    run.check_cursor(saved_episodes(root))
    run.read_initial_data()
    follower = EpisodeFollower(root, run.read_own_data(), run.policy.config.camera)

    def episodes() -> Iterator[Episode]:
        while not run.signals.stopped:
            before = follower.next
            for episode in follower.read_new():
                yield episode
                if run.signals.stopped:
                    return
            if follower.next == before:
                time.sleep(_POLL_S)

    with run.bar(f"following {root}") as bar:
        if not root.exists():
            bar.write(f"waiting for {root}, which is not there yet: start its recorder, or check the name")
        run.session(lambda: run.save(follower.next), dict, bar).follow(episodes())


def main() -> None:
    """Entry point of `relmm-train`."""
    run("relmm-train", TrainConfig, train, prepare=_prepare)


def _prepare(arguments: Arguments) -> None:
    take_over_from_hub(arguments)
    resolve_config_path(arguments)
    choose_policy(arguments)


if __name__ == "__main__":
    main()
