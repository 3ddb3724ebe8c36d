"""relmm-train: a robot is put into a room and learns to clean it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import draccus
import numpy as np

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
from relmm.episodes import (
    EpisodeFollower,
    EpisodeRecorder,
    check_new,
    check_trainable,
    local_root,
    read_episodes,
    saved_episodes,
    summarize,
)
from relmm.learning.checkpoint import (
    check_same_networks,
    last_checkpoint,
    load_training_state,
    pretrained_model,
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
        self.saved_config = draccus.encode(config)  # as it was given, for a resume
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
        assert config.output_dir is not None
        self.uploads = Uploads(run_arguments(config), config.output_dir)

    def load_data(self) -> None:
        """Fill the replay: with the dataset to start from, then with the run's own, and learn what is new in them."""
        cursor = -1
        if self.checkpoint is not None:
            counters = load_training_state(self.checkpoint, self.learner, self.rng)
            cursor, self.progress.interventions = counters["episodes"], counters.get("interventions", 0)
        if self.config.dataset.init is not None:
            root = local_root(self.config.dataset.init)
            check_trainable(root, self.policy.config.camera)
            self._read(root, "reading the initial dataset", update_from=0 if self.checkpoint is None else None)
        if self.checkpoint is not None:
            root = self.config.dataset.follow or self.config.dataset_root
            if root.exists():
                check_trainable(root, self.policy.config.camera)
                self._read(root, "reading the run's own dataset", update_from=cursor, count=True)

    def _read(self, root: Path, title: str, update_from: int | None, count: bool = False) -> None:
        with progress(saved_episodes(root), "episode", title, leave=False) as bar:
            for episode in read_episodes(root):
                update = update_from is not None and episode.index >= update_from
                self.learner.read(episode, update)
                if count:
                    self.progress.read(episode)
                bar.update()

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
        )

    def bar(self, title: str) -> Any:
        """A progress bar of all navigation steps, those before a resume included."""
        done, steps = self.progress.steps, self.config.steps
        bar = progress(steps, "step", title, initial=done)
        if done >= steps:
            bar.write(f"this run has gone {done} navigation steps already; a --steps above that goes on with it")
        return bar

    def session(self, save: Callable[[], None], evaluate: Callable[[], dict[str, Any]], bar: Any) -> Session:
        """The loop with everything around it."""
        config = self.config
        assert config.output_dir is not None
        schedule = Schedule(config.steps, config.log_freq, config.save_freq, config.env_eval_freq, config.hub.every)
        self.uploads.say = bar.write

        def show(status: dict[str, Any]) -> None:
            if status["steps"] == 0 and status["practice_attempts"] > 0:
                planned = f"/{self.policy.config.num_stationary}" if config.curriculum.type == "stationary" else ""
                shown = {"curriculum": f"{status['practice_attempts']}{planned} grasps"}
            else:
                shown = {"objects": status["objects"], "grasps": f"{status['successes']}/{status['attempts']}"}
                shown |= {key: f"{value:.2f}" for key, value in self.learner.logs.items() if key.endswith("_loss")}
            bar.set_postfix(shown, refresh=False)
            bar.update(status["steps"] - bar.n)
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
    if not config.resume:
        check_new(config.dataset_root, config.dataset.repo_id)
    run.load_data()
    seed = config.seed + (saved_episodes(config.dataset_root) if config.resume else 0)
    robot = make_locobot(replace(config.robot), seed, "relmm-train")
    with robot:
        robot.get_observation()  # a robot that cannot see fails here, before anything is written
        with _recorder(run, robot, seed) as recorder:
            if recorder.repaired:
                print(recorder.repaired)
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
                recorder.flush()
                run.save(recorder.saved_episodes)

            with run.bar("training") as bar:
                run.session(save, _evaluation(run, bar), bar).live(trainer, lambda: run.signals.stopped)
    if recorder.saved_episodes > 0:
        print(summarize(config.dataset_root))


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


def _evaluation(run: Run, bar: Any) -> Callable[[], dict[str, Any]]:
    settings = run.config.robot
    if not isinstance(settings, LocobotSimConfig):
        return dict
    assert run.config.output_dir is not None
    evaluation = RoomEvaluation(settings, run.actor, run.config.eval, run.config.output_dir / "eval")

    def evaluate() -> dict[str, Any]:
        scores = evaluation(run.progress.steps)
        bar.write(f"step {run.progress.steps}: collected {scores['eval_collected']:.1%} of the objects")
        return scores

    return evaluate


def _train_on_stream(run: Run, root: Path) -> None:
    config = run.config
    run.load_data()
    follower = EpisodeFollower(root, saved_episodes(root) if config.resume else 0, run.policy.config.camera)

    def episodes() -> Iterator[Any]:
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


def _prepare(arguments: list[str]) -> None:
    take_over_from_hub(arguments)
    resolve_config_path(arguments)
    choose_policy(arguments)


if __name__ == "__main__":
    main()
