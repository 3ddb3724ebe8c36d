"""relmm-record: a robot acts by a policy, and its life becomes a LeRobot dataset."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from lerobot.configs import parser
from lerobot.configs.policies import PreTrainedConfig
from lerobot.robots.config import RobotConfig

from relmm.commands.arguments import Arguments
from relmm.commands.cli import StopOnSignal, now, progress, run
from relmm.commands.display import DisplayOptions, live_views
from relmm.commands.fleet import RecordFleetConfig, act_by_newest_weights, linked, weights_folder
from relmm.commands.policies import FreshWeights, check_camera, make_actor, policy_from_path, take_seed
from relmm.commands.robots import Pause, make_locobot, person_beside
from relmm.commands.sharing import Uploads, check_dataset_upload, dataset_arguments
from relmm.commands.train_config import CurriculumConfig
from relmm.commands.upload import LICENSE
from relmm.display import LiveView
from relmm.episodes import (
    MAX_STEPS,
    EpisodeRecorder,
    check_new,
    check_repo_id,
    check_resume,
    read_episodes,
    summarize,
    verify_and_repair,
)
from relmm.errors import MANY, MAX_SEED, ConfigError, check_range
from relmm.learning.actor import Actor
from relmm.learning.collect import Cleaner, Collector, Practice, Watcher
from relmm.learning.life import Life
from relmm.learning.progress import Progress
from relmm.policies.learning import LearningConfig, LearningPolicy
from relmm.robot.locobot import LocobotRobot
from relmm.sim.locobot_sim import LocobotSim

if TYPE_CHECKING:
    from relmm.fleet.client import Link

# Keep the random numbers of the pseudo-resets and of the rooms apart from others drawn from the same seed.
_COLLECTOR_STREAM, _ROOMS_STREAM = 2, 3
MODES = ("practice", "clean")


@dataclass
class RecordDatasetConfig:
    """Where the episodes go.

    Args:
        repo_id: name of the dataset, `user/name`.
        root: its folder; None for LeRobot's own place for datasets of that name.
        num_episodes: how many to record in this run.
        push_to_hub: upload it to `repo_id` at the end.
        private: whether a new repository is private; None for the owner's default.
        license: for its card, an identifier of the Hub.
    """

    repo_id: str
    root: Path | None = None
    num_episodes: int = 10
    push_to_hub: bool = False
    private: bool | None = None
    license: str = LICENSE

    def __post_init__(self) -> None:
        check_repo_id(self.repo_id)
        check_range("dataset.num_episodes", self.num_episodes, 1, MANY)

    def folder(self) -> Path:
        """The dataset's folder."""
        from lerobot.utils.constants import HF_LEROBOT_HOME

        return self.root or HF_LEROBOT_HOME / self.repo_id


@dataclass
class RecordConfig(DisplayOptions):
    """Record a robot's life as a LeRobot dataset.

    Args:
        robot: `--robot.type=locobot_sim --robot.room=...`.
        dataset: where the episodes go.
        policy: who acts.
        fleet: the server of a fleet, if there is one.
        curriculum: of `practice`, by a policy that is learning elsewhere; `none` for none.
        mode: `practice`: what is picked up is put down elsewhere, an episode ends with it, and there are no resets, to
            learn to grasp from; `clean`: an episode is one room that is cleaned into the basket, to imitate.
        seed: of everything random; the same seed records the same dataset.
        resume: continue the dataset in its folder.
        max_steps: navigation steps after which an episode is cut off.
        pseudo_reset_steps: of `practice`: navigation steps, at most, before and after a picked-up object is put down.
    """

    robot: RobotConfig
    dataset: RecordDatasetConfig
    policy: PreTrainedConfig | None = None
    fleet: RecordFleetConfig = field(default_factory=RecordFleetConfig)
    curriculum: CurriculumConfig = field(default_factory=lambda: CurriculumConfig("none"))
    mode: str = "practice"
    seed: int = 0
    resume: bool = False
    max_steps: int = 250
    pseudo_reset_steps: int = 20

    def __post_init__(self) -> None:
        self.policy = policy_from_path(self.policy)
        self.check_display()
        check_camera(self.policy, "robot.camera", self.robot)
        if self.mode not in MODES:
            raise ConfigError(f"mode is {self.mode!r}, but must be one of {', '.join(MODES)}.")
        if self.curriculum.type != "none" and not (isinstance(self.policy, LearningConfig) and self.mode == "practice"):
            raise ConfigError(
                f"curriculum.type is {self.curriculum.type!r}, which is for --mode=practice and a policy that learns: "
                "say --policy.path of a run of relmm-train, or leave it out."
            )
        check_range("seed", self.seed, 0, MAX_SEED)
        check_range("max_steps", self.max_steps, 1, MAX_STEPS)
        check_range("pseudo_reset_steps", self.pseudo_reset_steps, 0, MAX_STEPS)

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """The fields that LeRobot's parser lets be loaded with `.path`."""
        return ["policy"]


def record(config: RecordConfig) -> None:
    """Record `num_episodes` episodes, and say what the dataset then holds."""
    root = config.dataset.folder()
    saved = 0
    if config.resume:
        check_resume(root, config.dataset.repo_id, depth=None, robot_type=None, info=None)
        report = verify_and_repair(root)
        saved = report.episodes
        if report.problems:
            print(report)
    else:
        check_new(root, config.dataset.repo_id)
    if config.dataset.push_to_hub:
        check_dataset_upload(config.dataset.repo_id, config.dataset.private, config.resume)
    # A resumed recording goes on with other random numbers than it began with.
    seed = config.seed + saved
    take_seed(config.policy, seed)
    assert config.policy is not None
    actor = make_actor(config.policy)
    robot = make_locobot(config.robot, seed, "relmm-record")
    followed = weights_folder(root) / "last" / "pretrained_model" == config.policy.pretrained_path
    with StopOnSignal() as signals, robot:
        robot.get_observation()  # a robot that cannot see fails here, before anything is written
        with (
            live_views(config, "relmm-record", robot.config.camera, actor) as views,
            _recorder(config, root, robot) as recorder,
            linked(config.fleet, root, config.dataset.repo_id, followed) as link,
        ):
            _collect(config, robot, actor, recorder, views, seed, signals, link)
            recorder.close()
            if link is not None and (left := link.finish()):
                print(f"{left} episodes are not sent yet: --resume=true sends them. {link.problem}")
    if recorder.saved_episodes == 0:
        print(f"no episode was recorded; --resume=true goes on in {root}")
        return
    print(summarize(root))
    if config.dataset.push_to_hub:
        settings = config.dataset
        Uploads(dataset_arguments(settings.repo_id, root, settings.private, settings.license), root).finish()


def _recorder(config: RecordConfig, root: Path, robot: LocobotRobot) -> EpisodeRecorder:
    settings, policy = config.robot, config.policy
    assert policy is not None
    info = {key: getattr(settings, key) for key in ("room", "num_objects", "camera", "seed") if hasattr(settings, key)}
    info["started"] = now()
    return EpisodeRecorder(
        root,
        config.dataset.repo_id,
        resume=config.resume,
        save_unfinished=True,
        depth="front_depth" in robot.observation_features,
        robot_type=robot.name,
        info={**info, "policy": policy.type, "policy_path": parser.get_path_arg("policy") or "", "mode": config.mode},
    )


def _collect(
    config: RecordConfig,
    robot: LocobotRobot,
    actor: Actor,
    recorder: EpisodeRecorder,
    views: list[LiveView],
    seed: int,
    signals: StopOnSignal,
    link: Link | None,
) -> None:
    assert config.policy is not None
    collector, life = _collector(config, robot, actor, recorder, views, seed, lambda: signals.stopped)
    fresh = FreshWeights(actor, config.policy.pretrained_path)
    frames = successes = grasps = 0
    said = ""
    with progress(config.dataset.num_episodes, "episode") as bar:
        while bar.n < config.dataset.num_episodes and not signals.stopped:
            if (checkpoint := fresh.take()) is not None:
                bar.write(f"acting by {checkpoint}")
            life.weights_step = fresh.step
            result = collector.episode()
            frames, grasps, successes = frames + result.frames, grasps + result.grasps, successes + result.picked_up
            sending = {"unsent": link.waiting} if link is not None else {}
            bar.set_postfix(frames=frames, grasps=grasps, picked_up=successes, **sending, refresh=False)
            if link is not None and link.problem != said:
                said = link.problem
                bar.write(said or "the server can be reached again")
            bar.update()


def _collector(
    config: RecordConfig,
    robot: LocobotRobot,
    actor: Actor,
    recorder: EpisodeRecorder,
    views: list[LiveView],
    seed: int,
    should_stop: Callable[[], bool],
) -> tuple[Collector | Practice | Cleaner, Life]:
    practice = config.mode == "practice"
    to_collect = None if practice else robot.body.room.num_objects if isinstance(robot, LocobotSim) else math.inf
    pause = Pause(robot, should_stop)
    progress, watcher = _counted(config)
    life = Life(robot, [recorder, progress, watcher, *views], robot.seconds, config.max_steps, pause, to_collect)
    pause.charged = life.look_again
    rng = np.random.default_rng([seed, _COLLECTOR_STREAM])
    if config.curriculum.type != "none":
        assert isinstance(actor.policy, LearningPolicy)
        person = person_beside(robot, seed)
        return Practice(
            life,
            actor.policy,
            watcher,
            progress,
            curriculum=config.curriculum.type,
            pseudo_reset_steps=config.pseudo_reset_steps,
            rng=rng,
            put_in_reach=(lambda: False) if person is None else person.put_in_reach,
        ), life
    if practice:
        return Collector(life, actor, rng, config.pseudo_reset_steps), life
    rooms = np.random.default_rng([seed, _ROOMS_STREAM])

    def set_up() -> None:
        if isinstance(robot, LocobotSim):  # else a person does it
            robot.reset(int(rooms.integers(2**31)))
        for view in views:
            view.begin_anew()

    return Cleaner(life, actor, set_up), life


def _counted(config: RecordConfig) -> tuple[Progress, Watcher]:
    """What the curricula depend on, from before a resume."""
    progress, watcher = Progress(), Watcher()
    if config.resume and config.curriculum.type != "none":
        for episode in read_episodes(config.dataset.folder()):
            progress.read(episode)
            watcher.read(episode, update=False)
    return progress, watcher


def main() -> None:
    """Entry point of `relmm-record`."""
    run("relmm-record", RecordConfig, record, prepare=_prepare)


def _prepare(arguments: Arguments) -> None:
    has_policy = any(arguments.get(f"policy.{name}") is not None for name in ("type", "path"))
    repo_id, root = arguments.get("dataset.repo_id"), arguments.get("dataset.root")
    if arguments.get("fleet.server") is not None and not has_policy and repo_id is not None:
        settings = RecordDatasetConfig(repo_id, None if root is None else Path(root))
        act_by_newest_weights(arguments, settings.folder())


if __name__ == "__main__":
    main()
