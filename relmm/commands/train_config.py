"""Settings of relmm-train."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from lerobot.configs.default import WandBConfig
from lerobot.configs.policies import PreTrainedConfig
from lerobot.robots.config import RobotConfig
from lerobot.teleoperators.config import TeleoperatorConfig

from relmm.commands.arguments import said
from relmm.commands.cli import dated_folder
from relmm.commands.display import DisplayOptions
from relmm.commands.policies import check_camera, policy_from_path
from relmm.commands.tracking import check_tracking
from relmm.commands.upload import LICENSE
from relmm.episodes import MAX_STEPS, check_repo_id
from relmm.episodes.folder import OWN_DATASET
from relmm.errors import MANY, MAX_SEED, ConfigError, check_range, suggestion
from relmm.learning.curriculum import CURRICULA
from relmm.policies.learning import LearningConfig
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.teleoperator.config_locobot_keyboard import LocobotKeyboardConfig


@dataclass
class TrainDatasetConfig:
    """Where the robot's life is kept, and what is learned from besides.

    Args:
        repo_id: name of the dataset, `user/name`.
        root: its folder; None for `dataset` in the output folder.
        init: a dataset (folder, or user/name on the Hub) to fill the replay with and train on first.
        follow: datasets that other processes are recording, or folders of such datasets, with commas between them;
            there is no robot then.
        max_waiting: while more episodes of these than this wait for the learner, new ones are stored without updates.
        push_to_hub: upload it to `repo_id` at the end, and every `hub.every` steps.
        private: whether a new repository is private; None for the owner's default.
        license: for its card, an identifier of the Hub.
    """

    repo_id: str = "local/relmm"
    root: Path | None = None
    init: str | None = None
    follow: str | None = None
    max_waiting: int = 100
    push_to_hub: bool = False
    private: bool | None = None
    license: str = LICENSE

    def __post_init__(self) -> None:
        check_repo_id(self.repo_id)
        check_range("dataset.max_waiting", self.max_waiting, 0, MANY)
        if self.follow is not None and not all(self.follow.split(",")):
            raise ConfigError(
                f"dataset.follow is {self.follow!r}, which has an empty name in it: say --dataset.follow=FOLDER or "
                "--dataset.follow=FOLDER,FOLDER,..."
            )
        if self.push_to_hub and self.repo_id.startswith("local/"):
            raise ConfigError(
                f"dataset.repo_id is {self.repo_id!r}, which is on this machine only: also say "
                "--dataset.repo_id=user/name to upload the dataset."
            )
        if self.push_to_hub and self.follow is not None:
            raise ConfigError(
                "--dataset.push_to_hub=true is for the process that records: say it there, not with --dataset.follow."
            )


@dataclass
class HubConfig:
    """When to upload to the Hub what `policy.push_to_hub` and `dataset.push_to_hub` ask for.

    Args:
        every: navigation steps between uploads while training, in the background; each is preceded by a checkpoint,
            and takes with it the episodes that are saved by then. 0 to upload at the end of the run only.
    """

    every: int = 0

    def __post_init__(self) -> None:
        check_range("hub.every", self.every, 0, MANY)


@dataclass
class TrainFleetConfig:
    """Several rooms at once.

    Args:
        rooms: simulated rooms that record at the same time, a process each, for one learner; 0 for the robot in this
            process. Their datasets are in `rooms/` of the output folder.
    """

    rooms: int = 0

    def __post_init__(self) -> None:
        check_range("fleet.rooms", self.rooms, 0, 1000)


@dataclass
class CurriculumConfig:
    """What comes before, or at the beginning of, learning to navigate; its numbers are in the policy's config.

    Args:
        type: `stationary` (an object in front of the robot, Algorithm 1), `autonomous` (Algorithms 3 and 4) or `none`.
    """

    type: str = "stationary"

    def __post_init__(self) -> None:
        if self.type not in CURRICULA:
            likely, known = suggestion(self.type, CURRICULA), ", ".join(CURRICULA)
            raise ConfigError(f"curriculum.type is {self.type!r}{likely}: choose one of {known}.")


@dataclass
class TrainEvalConfig:
    """Evaluation while training.

    Args:
        n_episodes: episodes each time, of the seeds `seed`, `seed` + 1, ...
        seed: of the first one.
        n_videos: how many of them to film, from the first on.
    """

    n_episodes: int = 3
    seed: int = 1000
    n_videos: int = 0

    def __post_init__(self) -> None:
        check_range("eval.n_episodes", self.n_episodes, 1, MANY)
        check_range("eval.seed", self.seed, 0, MAX_SEED)
        check_range("eval.n_videos", self.n_videos, 0, MANY)


@dataclass
class TrainConfig(DisplayOptions):
    """Train ReLMM online on a robot.

    Args:
        robot: `--robot.type=locobot_sim --robot.room=...`; not with `--dataset.follow`.
        teleop: `--teleop.type=locobot_keyboard` lets a person take over with the key t.
        dataset: where the robot's life is kept, and what is learned from besides.
        policy: `--policy.type=relmm` and its hyper-parameters, or `--policy.path` to go on from.
        fleet: several rooms at once.
        curriculum: `--curriculum.type=stationary`, `autonomous` or `none`.
        eval: evaluation while training.
        hub: when to upload; what, is said with `--policy.push_to_hub`, `--policy.repo_id`, `--dataset.push_to_hub`.
        wandb: also log to Weights & Biases, as lerobot-train does.
        steps: navigation steps to train for, those of earlier runs included.
        seed: of everything random; equal seeds give equal runs.
        output_dir: a folder that does not exist yet; None for outputs/train/DATE/TIME_JOB.
        job_name: last part of that folder's name.
        resume: go on with the run in `output_dir`.
        env_eval_freq: navigation steps between evaluations; 0 for none.
        save_freq: navigation steps between checkpoints.
        log_freq: navigation steps between lines of `metrics.jsonl`.
        max_steps: navigation steps after which an episode is cut off.
        pseudo_reset_steps: navigation steps, at most, before and after a picked-up object is put down again.
        report: keep a `report.html` as relmm-analyze writes it in the output folder, refreshed in the background.
        replay_frames: newest attempts (relmm, 1.6 kB each), or attempts and navigation steps (relmm_paper, 30 kB and at
            most 60 kB), to learn from, kept in memory.
        num_threads: of torch; 1 is the fastest on few cores.
    """

    robot: RobotConfig | None = None
    teleop: TeleoperatorConfig | None = field(default=None, metadata={"choices": LocobotKeyboardConfig})
    dataset: TrainDatasetConfig = field(default_factory=TrainDatasetConfig)
    policy: PreTrainedConfig | None = field(default=None, metadata={"choices": LearningConfig})
    fleet: TrainFleetConfig = field(default_factory=TrainFleetConfig)
    curriculum: CurriculumConfig = field(default_factory=CurriculumConfig)
    eval: TrainEvalConfig = field(default_factory=TrainEvalConfig)
    hub: HubConfig = field(default_factory=HubConfig)
    wandb: WandBConfig = field(default_factory=WandBConfig)
    steps: int = 2000
    seed: int = 0
    output_dir: Path | None = None
    job_name: str = "relmm"
    resume: bool = False
    env_eval_freq: int = 500
    save_freq: int = 500
    log_freq: int = 50
    max_steps: int = 250
    pseudo_reset_steps: int = 20
    report: bool = True
    replay_frames: int = 100_000
    num_threads: int = 1

    def __post_init__(self) -> None:
        self.policy = policy_from_path(self.policy or ReLMMConfig())
        if not isinstance(self.policy, LearningConfig):
            raise ConfigError(
                f"relmm-train trains --policy.type=relmm, relmm_paper or relmm_single, not {self.policy.type}: choose "
                "one of these, or train that one with lerobot-train."
            )
        for name, (low, high) in _RANGES.items():
            check_range(name, getattr(self, name), low, high)
        if (self.robot is None) == (self.dataset.follow is None):
            if self.resume and self.robot is None and self.output_dir is not None:  # the run would have said it
                raise ConfigError(
                    f"There is no run to go on with in {self.output_dir}, which has no checkpoints/last: check the "
                    "folder, or train into another one without --resume."
                )
            raise ConfigError(
                "Say what to learn from: either a robot (--robot.type=locobot_sim) or datasets that other processes "
                "record (--dataset.follow=FOLDER,FOLDER,...), not both."
            )
        if self.teleop is not None and self.robot is None:
            raise ConfigError("--teleop is for a person beside a robot: leave it out with --dataset.follow.")
        if not isinstance(self.teleop, LocobotKeyboardConfig | None):
            raise ConfigError(
                f"teleop.type is {self.teleop.type!r}, but a person takes over with --teleop.type=locobot_keyboard."
            )
        self._check_rooms()
        check_camera(self.policy, "robot.camera", self.robot)
        if self.policy.seed is None:
            self.policy.seed = self.seed
        self._check_uploads()
        self._check_display()
        check_tracking(self.wandb)
        self._choose_folder()

    def _check_rooms(self) -> None:
        if not self.fleet.rooms:
            return
        if self.robot is None or self.robot.type != "locobot_sim":
            raise ConfigError(
                f"fleet.rooms is {self.fleet.rooms}, and only a simulated robot can be in several rooms: say "
                "--robot.type=locobot_sim, or leave out --fleet.rooms."
            )
        if self.dataset.root is not None or self.dataset.push_to_hub:
            raise ConfigError(
                "With --fleet.rooms each room has a dataset of its own in rooms/ of the output folder: leave out "
                "--dataset.root and --dataset.push_to_hub, and upload them with relmm-upload."
            )

    def _check_uploads(self) -> None:
        policy = self.policy
        assert policy is not None
        if policy.push_to_hub and policy.repo_id is None:
            if said().get("policy.push_to_hub") is not None:
                raise ConfigError(
                    "Say where to upload the policy: --policy.push_to_hub=true --policy.repo_id=user/name."
                )
            policy.push_to_hub = False  # LeRobot's own default, in a config that it has written
        if policy.push_to_hub:
            check_repo_id(str(policy.repo_id))
        if self.hub.every and not (policy.push_to_hub or self.dataset.push_to_hub):
            raise ConfigError(
                f"hub.every is {self.hub.every}, but nothing is uploaded: also say --policy.push_to_hub=true "
                "--policy.repo_id=user/name, or --dataset.push_to_hub=true."
            )

    def _check_display(self) -> None:
        if self.display_data and self.robot is None:
            raise ConfigError("There is no robot here to display: say --display_data=true to the one that records.")
        self.check_display()

    def _choose_folder(self) -> None:
        if self.output_dir is None:
            if self.resume:
                raise ConfigError("Say which run to go on with: --resume=true --output_dir=FOLDER.")
            self.output_dir = dated_folder("train", self.job_name)
        if not self.resume and self.output_dir.exists():
            raise ConfigError(
                f"{self.output_dir} exists already: choose another --output_dir, or go on with --resume=true."
            )

    @property
    def followed(self) -> list[Path]:
        """The datasets, and folders of datasets, that other processes record and this one learns from."""
        if self.fleet.rooms:
            assert self.output_dir is not None
            return [self.output_dir / "rooms"]
        return [] if self.dataset.follow is None else [Path(name) for name in self.dataset.follow.split(",")]

    @property
    def checkpoints(self) -> Path:
        """The run's checkpoints."""
        assert self.output_dir is not None
        return self.output_dir / "checkpoints"

    @property
    def dataset_root(self) -> Path:
        """The folder of the robot's life."""
        assert self.output_dir is not None
        return self.dataset.root or self.output_dir / OWN_DATASET

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """The fields that LeRobot's parser lets be loaded with `.path`."""
        return ["policy"]


_RANGES = {
    "steps": (1, MANY),
    "seed": (0, MAX_SEED),
    "env_eval_freq": (0, MANY),
    "save_freq": (1, MANY),
    "log_freq": (1, MANY),
    "max_steps": (1, MAX_STEPS),
    "pseudo_reset_steps": (0, MAX_STEPS),
    "replay_frames": (1000, MANY),
    "num_threads": (1, 256),
}
