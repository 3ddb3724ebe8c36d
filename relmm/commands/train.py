"""relmm-train: a robot is put into a room and learns to clean it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from relmm.commands.arguments import Arguments
from relmm.commands.cli import StopOnSignal, now, run
from relmm.commands.curve import draw_learning_curve
from relmm.commands.display import live_views
from relmm.commands.hub_resume import take_over_from_hub
from relmm.commands.policy_type import choose_policy
from relmm.commands.presets import resolve_config_path
from relmm.commands.robots import Pause, make_locobot, person_beside
from relmm.commands.rooms import Rooms
from relmm.commands.sharing import check_uploads
from relmm.commands.take_over import TakeOver
from relmm.commands.train_config import TrainConfig
from relmm.commands.train_evaluation import RoomEvaluation
from relmm.commands.train_stream import train_on_stream
from relmm.commands.training_bar import TrainingBar
from relmm.commands.training_run import Run
from relmm.episodes import (
    EpisodeRecorder,
    check_new,
    summarize,
    verify_and_repair,
)
from relmm.learning.life import Life
from relmm.learning.trainer import Trainer
from relmm.policies.learning import LearningConfig
from relmm.robot.locobot import LocobotRobot
from relmm.sim.config_locobot_sim import LocobotSimConfig
from relmm.teleoperator.locobot_keyboard import TAKE_OVER, LocobotKeyboard


def train(config: TrainConfig) -> None:
    """Train, and say where everything is."""
    import torch

    torch.set_num_threads(config.num_threads)
    check_uploads(config)
    with StopOnSignal() as signals:
        run = Run(config, signals)
        if config.fleet.rooms:
            _train_in_rooms(run)
        elif config.dataset.follow is not None:
            train_on_stream(run)
        else:
            _train_on_robot(run)
    assert config.output_dir is not None
    draw_learning_curve(config.output_dir / "metrics.jsonl", config.output_dir / "learning_curve.png")
    recorded = "rooms" if config.fleet.rooms else "dataset" if config.robot is not None else ""
    kept = ", ".join(filter(None, ["checkpoints", "metrics", recorded]))
    print(f"{kept} and learning_curve.png: {config.output_dir}")
    run.finish()


def _train_on_robot(run: Run) -> None:
    config = run.config
    assert config.robot is not None
    saved, damaged = _own_dataset(run)
    run.read_initial_data()
    seed = config.seed + saved
    robot = make_locobot(replace(config.robot), seed, "relmm-train")
    with _keyboard(config) as keyboard, robot:
        robot.get_observation()  # a robot that cannot see fails here, before anything is written
        run.track()
        with (
            live_views(config, "relmm-train", robot.config.camera, run.actor, learning=True) as views,
            _recorder(run, robot, seed) as recorder,
        ):
            run.listeners += [view.show_metrics for view in views]
            run.read_own_data()  # now that nobody else writes to it
            if damaged:
                run.save(recorder.saved_episodes)
            pause = Pause(robot, lambda: run.signals.stopped)
            life = Life(
                robot,
                [recorder, run.learner, run.progress, *views],
                robot.seconds,
                config.max_steps,
                should_stop=pause,
            )
            person = person_beside(robot, seed)

            def charged() -> None:
                run.progress.interventions += 1
                life.look_again()

            pause.charged = charged

            def save() -> None:
                life.cut_episode()
                recorder.flush()
                run.save(recorder.saved_episodes)

            with run.bar("training") as bar:
                trainer = Trainer(
                    life,
                    run.policy,
                    run.learner,
                    curriculum=config.curriculum.type,
                    pseudo_reset_steps=config.pseudo_reset_steps,
                    rng=run.rng,
                    put_in_reach=(lambda: False) if person is None else person.put_in_reach,
                    progress=run.progress,
                    tidy=(lambda: 0) if person is None else person.tidy,
                    tidy_every=getattr(config.robot, "tidy_every", 0),
                    person=_take_over(run, robot, keyboard, bar.write),
                )
                run.session(save, _evaluation(run, bar), bar).live(trainer, lambda: run.signals.stopped)
    if recorder.saved_episodes > 0:
        print(summarize(config.dataset_root))


def _keyboard(config: TrainConfig) -> contextlib.AbstractContextManager[LocobotKeyboard | None]:
    """Of a person who may take over, if that was asked for."""
    return contextlib.nullcontext() if config.teleop is None else LocobotKeyboard(config.teleop)


def _take_over(
    run: Run, robot: LocobotRobot, keyboard: LocobotKeyboard | None, say: Callable[[str], None]
) -> Callable[[], dict[str, float] | None]:
    if keyboard is None:
        return lambda: None
    say(f"{TAKE_OVER} takes over")
    return TakeOver(robot, keyboard, lambda: run.signals.stopped, say)


def _train_in_rooms(run: Run) -> None:
    config = run.config
    assert isinstance(config.policy, LearningConfig)
    shares = {name: -(-getattr(config.policy, name) // config.fleet.rooms) for name in ("num_stationary", "num_max")}
    options = [
        *(f"--policy.{name}={share}" for name, share in shares.items()),
        *("--policy.sample=true", "--policy.device=cpu", f"--curriculum.type={config.curriculum.type}"),
        *(f"--{name}={getattr(config, name)}" for name in ("max_steps", "pseudo_reset_steps")),
    ]
    policy = config.checkpoints / "last" / "pretrained_model"
    robot = run.saved_config["robot"]
    with Rooms(config.followed[0], robot, policy, config.fleet.rooms, config.seed, options) as rooms:
        train_on_stream(run, lambda bar: rooms.watch(bar.write), lambda bar: _evaluation(run, bar), lambda: str(rooms))


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


def main() -> None:
    """Entry point of `relmm-train`."""
    run("relmm-train", TrainConfig, train, prepare=_prepare)


def _prepare(arguments: Arguments) -> None:
    take_over_from_hub(arguments)
    resolve_config_path(arguments)
    choose_policy(arguments)


if __name__ == "__main__":
    main()
