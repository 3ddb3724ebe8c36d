"""What reads files and command lines, with a healthy example of each."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs import parser

from relmm.commands.arguments import Arguments
from relmm.commands.cli import _parse
from relmm.commands.curve import draw_learning_curve
from relmm.commands.evaluate import EvalConfig
from relmm.commands.model_card import ModelFacts, model_card
from relmm.commands.policies import make_actor, policy_from_path
from relmm.commands.policy_type import choose_policy
from relmm.commands.presets import resolve_config_path
from relmm.commands.record import RecordConfig
from relmm.commands.train_config import TrainConfig
from relmm.commands.upload import UploadConfig
from relmm.episodes import (
    EpisodeRecorder,
    check_resume,
    read_episodes,
    saved_episodes,
    summarize,
    verify_and_repair,
)
from relmm.episodes.card import dataset_card
from relmm.episodes.compact import compact
from relmm.episodes.folder import DatasetFolder
from relmm.episodes.upload import recorded_runs
from relmm.features import FRONT, FRONT_DEPTH, STATE_NAMES, Phase, Skill, action_dict, outcome_features
from relmm.learning.checkpoint import (
    check_same_networks,
    load_training_state,
    pretrained_model,
    save_checkpoint,
)
from relmm.learning.hub import _read_source, _read_step
from relmm.learning.progress import Metrics, Progress, read_metrics
from relmm.learning.settings import portable_settings, read_settings
from relmm.learning.sums import SUMS
from relmm.learning.untrusted import read_json
from relmm.policies.learning import LearningConfig, LearningPolicy
from relmm.policies.relmm.configuration_relmm import ReLMMConfig

Healthy = dict[str, Path]
CONFIG = ReLMMConfig(device="cpu", num_members=2, channels=4, batch_size=4, min_attempts_to_update=1, seed=0)


def prepare(folder: Path) -> Healthy:
    """A checkpoint, a run's settings and metrics, and a dataset, by name."""
    folder.mkdir(parents=True)
    _record(folder / "dataset")
    actor = make_actor(CONFIG)
    assert isinstance(actor.policy, LearningPolicy)
    actor.policy.train()
    learner = actor.policy.make_learner(0, 1000)
    for number, frame in enumerate(_frames(12)):
        learner.add(frame[FRONT], np.zeros(len(STATE_NAMES), np.float32), _action(number), number % 3 == 0, 1)
    for _ in range(3):
        learner.update_grasping(Phase.LEARNING)
    config = {
        "robot": {"type": "locobot_sim", "room": "no_obstacles"},
        "dataset": {"repo_id": "me/life", "root": None, "follow": None, "init": None},
        "policy": {"type": "relmm", "camera": "paper", "device": "cpu", "num_members": 2, "channels": 4},
        "curriculum": {"type": "none"},
        "eval": {"n_episodes": 3, "seed": 1000, "n_videos": 0},
        "steps": 2000,
        "seed": 0,
        "output_dir": str(folder / "no such run"),
    }
    counters = {"episodes": 3, "interventions": 1}
    rng = np.random.default_rng(5)
    checkpoint = save_checkpoint(folder / "checkpoints", 7, actor, learner, rng, counters, config, [])
    for sums in checkpoint.rglob(SUMS):  # or nearly every damage would be found by them
        sums.unlink()
    source = {"step": 7, "repo_id": "me/life", "revision": "a" * 40, "episodes": 3, "runs": [{"seed": 0}]}
    (checkpoint / "training_state" / "dataset.json").write_text(json.dumps(source))
    (checkpoint / "training_state" / "training_step.json").write_text('{"step": 7}')
    lines: list[dict[str, Any]] = [
        {**Progress(steps, attempts=steps // 2).asdict(), "seconds": float(steps)} for steps in (100, 400, 700)
    ]
    evaluation = {"eval_collected": 0.5, "eval_collected_std": 0.1, "eval_collected_each": [0.4, 0.6]}
    lines.append({**lines[-1], **evaluation, "eval_grasp_success": 0.5})
    (checkpoint / "metrics.jsonl").write_text("\n".join(map(json.dumps, lines)) + "\n")
    return {"checkpoint": checkpoint, "dataset": folder / "dataset"}


def _frames(count: int) -> list[dict[str, Any]]:
    rng = np.random.default_rng(0)
    frames = [
        {FRONT: rng.integers(0, 256, (100, 100, 3), np.uint8), **dict.fromkeys(STATE_NAMES, 0.0)} for _ in range(count)
    ]
    return [{**frame, FRONT_DEPTH: np.full((100, 100, 1), 500, np.uint16)} for frame in frames]


def _action(number: int) -> Any:
    skill = Skill.GRASP if number % 2 else Skill.NAVIGATE
    return np.array([0.2, 30.0, skill, 0.35, 0.0], np.float32)


def _record(root: Path) -> None:
    with EpisodeRecorder(
        root, "me/life", resume=False, depth=False, robot_type="locobot_sim", info={"seed": 0}
    ) as recorder:
        for _ in range(3):
            for number, frame in enumerate(_frames(4)):
                outcome = {key: np.dtype(feature["dtype"]).type(0) for key, feature in outcome_features().items()}
                outcome["complementary_info.robot_time"] = float(number)
                recorder.add_frame(frame, action_dict(Skill.GRASP, x=0.35, y=0.0), outcome, "tidy")
            recorder.save_episode()
        recorder.flush()
        assert recorder.saved_episodes == 3


# --- Files --------------------------------------------------------------------------------------------------
def policy(checkpoint: Path) -> None:
    """As a command takes `--policy.path`; then it acts."""
    sys.argv = ["fuzz", f"--policy.path={pretrained_model(checkpoint)}"]
    actor = make_actor(policy_from_path(None))
    assert all(np.isfinite(list(actor.act(_frames(1)[0]).values())))


def training_state(checkpoint: Path) -> None:
    """As a resume takes it; then it learns."""
    check_same_networks(checkpoint, CONFIG.fingerprint())
    actor = make_actor(CONFIG)
    assert isinstance(actor.policy, LearningPolicy)
    learner, rng = actor.policy.make_learner(0, 1000), np.random.default_rng(0)
    load_training_state(checkpoint, learner, rng)
    for number, frame in enumerate(_frames(4)):
        learner.add(frame[FRONT], np.zeros(len(STATE_NAMES), np.float32), _action(number), number % 3 == 0, 1)
    rng.random()
    for _ in range(2):
        learner.update_grasping(Phase.LEARNING)
    assert all(weights.isfinite().all() for weights in actor.policy.state_dict().values())


def settings(checkpoint: Path) -> None:
    """As the Hub's settings are made a run here, and as a run is gone on with."""
    file = pretrained_model(checkpoint) / "train_config.json"
    read_metrics(checkpoint / "metrics.jsonl")
    file.write_text(json.dumps(portable_settings(read_json(file))))
    parse(TrainConfig, [f"--config_path={file}", f"--output_dir={checkpoint / 'out'}"])


def settings_file(checkpoint: Path) -> None:
    """As `--config_path` takes them."""
    parse(TrainConfig, [f"--config_path={pretrained_model(checkpoint) / 'train_config.json'}"])


def card(checkpoint: Path) -> None:
    """What an upload makes of settings and metrics."""
    model_card(
        ModelFacts("me/p", read_settings(pretrained_model(checkpoint)), checkpoint / "metrics.jsonl", None, "mit")
    )


def metrics(checkpoint: Path) -> None:
    """The run's clock and curve."""
    file = checkpoint / "metrics.jsonl"
    Metrics(file).close()
    card(checkpoint)
    draw_learning_curve(file, checkpoint / "curve.png")


def dataset(root: Path) -> None:
    """As learning, a resume and an upload read it."""
    for episode in read_episodes(root):
        assert np.isfinite(episode.actions).all()
    saved_episodes(root)
    check_resume(root, "me/life", None, "locobot_sim", None)
    recorded_runs(DatasetFolder(root))
    summarize(root)


def repair(root: Path) -> None:
    """As a resume repairs it; then it is whole."""
    assert verify_and_repair(root).episodes == len(list(read_episodes(root)))


def upload(root: Path) -> None:
    """As an upload copies and describes it."""
    copy = root.with_name("compact")
    compact(root, copy)
    dataset_card(DatasetFolder(copy), "me/life", "mit", True)


_EPISODES, _DATA = "meta/episodes/chunk-000/file-000.parquet", "data/chunk-000/file-000.parquet"
_MODEL, _STATE = "pretrained_model", "training_state"
FILES: dict[str, tuple[str, str, Callable[[Path], object]]] = {
    "config.json": ("checkpoint", f"{_MODEL}/config.json", policy),
    "policy_preprocessor.json": ("checkpoint", f"{_MODEL}/policy_preprocessor.json", policy),
    "model.safetensors": ("checkpoint", f"{_MODEL}/model.safetensors", policy),
    "relmm_state.json": ("checkpoint", f"{_STATE}/relmm_state.json", training_state),
    "optimizer_state.safetensors": ("checkpoint", f"{_STATE}/grasping/optimizer_state.safetensors", training_state),
    "relmm_rng.safetensors": ("checkpoint", f"{_STATE}/relmm_rng.safetensors", training_state),
    "config.json, resumed": ("checkpoint", f"{_MODEL}/config.json", training_state),
    "train_config.json from the Hub": ("checkpoint", f"{_MODEL}/train_config.json", settings),
    "train_config.json, --config_path": ("checkpoint", f"{_MODEL}/train_config.json", settings_file),
    "train_config.json, uploaded": ("checkpoint", f"{_MODEL}/train_config.json", card),
    "metrics.jsonl": ("checkpoint", "metrics.jsonl", metrics),
    "dataset.json": ("checkpoint", f"{_STATE}/dataset.json", lambda c: _read_source(c / _STATE / "dataset.json")),
    "training_step.json": (
        "checkpoint", f"{_STATE}/training_step.json", lambda c: _read_step(c / _STATE / "training_step.json")
    ),
    "info.json": ("dataset", "meta/info.json", dataset),
    "info.json, repaired": ("dataset", "meta/info.json", repair),
    "info.json, uploaded": ("dataset", "meta/info.json", upload),
    "relmm.json, uploaded": ("dataset", "meta/relmm.json", upload),
    "stats.json, repaired": ("dataset", "meta/stats.json", repair),
    "tasks.parquet, repaired": ("dataset", "meta/tasks.parquet", repair),
    "episodes parquet": ("dataset", _EPISODES, dataset),
    "episodes parquet, repaired": ("dataset", _EPISODES, repair),
    "data parquet": ("dataset", _DATA, dataset),
    "data parquet, repaired": ("dataset", _DATA, repair),
}  # fmt: skip

# --- Command lines ------------------------------------------------------------------------------------------
_NEVER = "--output_dir=/nonexistent/run"
COMMANDS: dict[str, tuple[type, list[str]]] = {
    "relmm-train": (
        TrainConfig,
        [
            "--robot.type=locobot_sim", "--robot.room=diverse", "--robot.num_objects=5", "--robot.seed=1",
            "--policy.type=relmm", "--policy.batch_size=8", "--policy.learning_rate=0.001", "--policy.device=cpu",
            "--dataset.repo_id=me/life", "--curriculum.type=none", "--steps=10", "--seed=3", "--num_threads=1",
            "--eval.n_episodes=2", "--eval.seed=7", "--hub.every=0", "--replay_frames=2000", "--max_steps=20",
            _NEVER,
        ],
    ),
    "relmm-eval": (
        EvalConfig,
        [
            "--env.type=relmm_room", "--env.room=no_obstacles", "--env.num_objects=3", "--env.navigation_steps=5",
            "--policy.type=relmm_scripted", "--policy.seed=1", "--eval.n_episodes=1", "--eval.n_videos=0", "--seed=5",
            _NEVER,
        ],
    ),
    "relmm-record": (
        RecordConfig,
        [
            "--robot.type=locobot_sim", "--robot.depth=true", "--policy.type=relmm_random", "--policy.num_grasp=2",
            "--dataset.repo_id=me/life", "--dataset.num_episodes=2", "--max_steps=5", "--pseudo_reset_steps=2",
            "--seed=5", "--resume=false",
        ],
    ),
    "relmm-upload": (
        UploadConfig,
        [
            "--policy.repo_id=me/p", "--policy.tags=[a,b]", "--dataset.repo_id=me/life", "--dataset.license=mit",
            "--dataset.private=true", "--background=false", _NEVER,
        ],
    ),
}  # fmt: skip

# LeRobot's parser takes most of a second, and networks a tenth: so many times fewer cases of these.
_SLOW = {"relmm-train", "relmm-eval", "relmm-record", "metrics.jsonl", "stats.json, repaired", "info.json, uploaded"}
_SLOW |= {"train_config.json from the Hub", "train_config.json, --config_path", "relmm.json, uploaded"}
_READS_LITTLE = {"dataset.json", "training_step.json", "info.json", "relmm-upload", "train_config.json, uploaded"}
_READS_LITTLE |= {"episodes parquet", "data parquet"}
SLOWNESS = {kind: 20 if kind in _SLOW else 1 if kind in _READS_LITTLE else 3 for kind in (*FILES, *COMMANDS)}


def parse(config_class: type, arguments: list[str]) -> Any:
    """As a command takes its arguments."""
    said = Arguments(arguments)
    # LeRobot's parser keeps the paths of earlier command lines.
    parser._config_path_args.clear()
    parser._config_yaml_overrides.clear()
    if config_class is TrainConfig:
        resolve_config_path(said)
        choose_policy(said)
    said.hand_over()
    config: Any = _parse(config_class, said)
    assert not isinstance(getattr(config, "policy", None), LearningConfig) or config.policy.fingerprint()
    return config
