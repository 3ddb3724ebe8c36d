"""relmm-eval: how much of a room does a policy clean? Same episodes as lerobot-eval, more to see."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from numpy.typing import NDArray

from relmm.commands.arguments import Arguments
from relmm.commands.cli import StopOnSignal, dated_folder, progress, run
from relmm.commands.display import DisplayOptions, live_views
from relmm.commands.policies import check_camera, make_actor, policy_from_path, take_seed
from relmm.display import LiveView
from relmm.errors import MANY, MAX_SEED, ConfigError, check_range
from relmm.features import ACTION_NAMES, FRONT, STATE_NAMES, FloatArray, Skill
from relmm.geometry import moved
from relmm.learning.actor import Actor
from relmm.learning.life import motion_of
from relmm.sim.config_relmm_room import RelmmRoomEnvConfig
from relmm.sim.env import SUCCESS_SHARE, RelmmRoomEnv
from relmm.sim.film import Film

_COLUMNS = {  # and their formats
    "collected": ".1%",
    "picked up": ".1f",
    "grasps": ".1f",
    "grasp success": ".1%",
    "steps/object": ".1f",
    "s/object": ".1f",
    "metres": ".1f",
}


@dataclass
class EvalSettings:
    """How to evaluate.

    Args:
        n_episodes: episodes, of the seeds `seed`, `seed` + 1, ...
        n_videos: how many of them to film, from the first on.
    """

    n_episodes: int = 10
    n_videos: int = 1

    def __post_init__(self) -> None:
        check_range("eval.n_episodes", self.n_episodes, 1, MANY)
        check_range("eval.n_videos", self.n_videos, 0, MANY)


@dataclass
class EvalConfig(DisplayOptions):
    """Evaluate a policy in a simulated room.

    Args:
        env: `--env.room=...`.
        policy: who acts, any policy of LeRobot with relmm's pictures, states and actions.
        eval: how many episodes and videos.
        output_dir: a folder that does not exist yet; None for outputs/eval/DATE/TIME_ROOM_POLICY, as lerobot-eval.
        seed: of the first episode; 1000 as in lerobot-eval.
    """

    env: EnvConfig
    policy: PreTrainedConfig | None = None
    eval: EvalSettings = field(default_factory=EvalSettings)
    output_dir: Path | None = None
    seed: int = 1000

    def __post_init__(self) -> None:
        self.policy = policy_from_path(self.policy)
        if not isinstance(self.env, RelmmRoomEnvConfig):
            raise ConfigError(f"relmm-eval needs --env.type=relmm_room, not {self.env.type}.")
        self.check_display()
        check_camera(self.policy, "env.camera", self.env)
        check_range("seed", self.seed, 0, MAX_SEED)
        if self.output_dir is None:
            self.output_dir = dated_folder("eval", f"{self.env.room}_{self.policy.type}")
        if self.output_dir.exists():
            raise ConfigError(f"{self.output_dir} exists already: choose another --output_dir.")

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """The fields that LeRobot's parser lets be loaded with `.path`."""
        return ["policy"]


@dataclass(frozen=True)
class EpisodeScore:
    """One episode.

    Attributes:
        seed: where the objects lay.
        collected, total: objects in the basket at the end, of how many.
        grasps, picked_up, picked_up_judged: attempts, those that lifted something, and those the robot believed did.
        navigation_steps: taken.
        seconds: on the robot's clock.
        metres: driven, from the wheels' odometry.
    """

    seed: int
    collected: int
    total: int
    grasps: int
    picked_up: int
    picked_up_judged: int
    navigation_steps: int
    seconds: float
    metres: float

    def row(self) -> list[float]:
        """The values of `_COLUMNS`; NaN is what none of something took."""
        objects = self.collected or math.nan
        share = self.picked_up / (self.grasps or math.nan)
        rates = (self.navigation_steps / objects, self.seconds / objects)
        return [self.collected / self.total, self.picked_up, self.grasps, share, *rates, self.metres]


class EpisodeStopped(Exception):
    """An episode was stopped before its end, so that it has no score."""


def evaluate(config: EvalConfig) -> None:
    """Run the episodes; `eval_info.json` holds those that have ended, whenever and however the command does."""
    assert isinstance(config.env, RelmmRoomEnvConfig)
    assert config.policy is not None
    assert config.output_dir is not None
    take_seed(config.policy, 0)
    torch.manual_seed(config.seed)  # policies of others may draw from it
    actor = make_actor(config.policy)
    env = RelmmRoomEnv(**{**config.env.gym_kwargs, "render_mode": None})
    scores: list[EpisodeScore] = []
    with (
        StopOnSignal() as signals,
        closing(env),
        live_views(config, "relmm-eval", config.env.camera, actor) as views,
        _bar(config) as bar,
    ):

        def show(info: dict[str, Any]) -> None:
            bar.set_description(f"episode {len(scores) + 1}/{config.eval.n_episodes}", refresh=False)
            bar.set_postfix(collected=info["objects_collected"], grasps=info["grasp_attempts"], refresh=False)
            bar.update(round((len(scores) + share_done(env, info)) * env.navigation_steps) - bar.n)

        with suppress(EpisodeStopped):
            for index in range(config.eval.n_episodes):
                filmed = index < config.eval.n_videos
                video = config.output_dir / "videos" / f"eval_episode_{index}.mp4" if filmed else None
                scores.append(run_episode(env, actor, config.seed + index, video, lambda: signals.stopped, show, views))
                _write(config.output_dir, scores)
    _say(config, scores)
    if signals.number is not None:
        sys.exit(128 + signals.number)


def _bar(config: EvalConfig) -> Any:
    assert isinstance(config.env, RelmmRoomEnvConfig)
    return progress(config.eval.n_episodes * config.env.navigation_steps, "step", leave=False)


def share_done(env: RelmmRoomEnv, info: dict[str, Any]) -> float:
    """How much of an episode is over, 0..1: it ends at its last step, or when everything is in the basket."""
    collected = info["objects_collected"] / info["objects_total"]
    return float(max(info["navigation_steps"] / env.navigation_steps, collected))


def run_episode(
    env: RelmmRoomEnv,
    actor: Actor,
    seed: int,
    video: Path | None,
    should_stop: Callable[[], bool] = lambda: False,
    show: Callable[[dict[str, Any]], None] = lambda info: None,
    views: Sequence[LiveView] = (),
) -> EpisodeScore:
    """One episode, filmed at four times its speed.

    Args:
        env: the room.
        actor: who acts.
        seed: where the objects lie.
        video: the film; None for none.
        should_stop: asked before each step.
        show: takes the room's `info` after each step.
        views: show the robot.

    Raises:
        EpisodeStopped: it was told to stop; the film shows what there was.
    """
    observation, info = env.reset(seed=seed)
    actor.reset()
    film = Film(env.robot.body, video) if video is not None else None
    ended = False
    pose: FloatArray = np.zeros(3)
    for view in views:
        view.begin_anew()
    with film or nullcontext():
        while not ended and not should_stop():
            before = _robot_observation(observation)
            action = actor.act(before)
            if film is not None:
                film.caption, film.inset = _caption(info, actor.describe(action)), actor.picture()
            observation, _, terminated, truncated, info = env.step(np.array([action[n] for n in ACTION_NAMES]))
            ended = terminated or truncated
            show(info)
            after = _robot_observation(observation)
            for view in views:
                view.show(before, action, actor.belief, pose, _picked_up(action, after))
            pose = moved(pose, motion_of(after))
        if film is not None:
            film.caption = _caption(info, "the end" if ended else "stopped here")
    if not ended:
        raise EpisodeStopped
    return EpisodeScore(
        seed=seed,
        collected=info["objects_collected"],
        total=info["objects_total"],
        grasps=info["grasp_attempts"],
        picked_up=info["grasp_successes"],
        picked_up_judged=info["grasp_successes_judged"],
        navigation_steps=info["navigation_steps"],
        seconds=info["robot_seconds"],
        metres=info["metres_driven"],
    )


def _picked_up(action: dict[str, float], after: dict[str, Any]) -> bool:
    """Whether the robot believes that it did."""
    return round(action["skill.pos"]) == Skill.GRASP and after["holding.pos"] > 0.5


def _caption(info: dict[str, Any], doing: str) -> str:
    return (
        f"{info['objects_collected']} of {info['objects_total']} collected, step {info['navigation_steps']}, "
        f"{info['grasp_attempts']} grasps\n{doing}"
    )


def _robot_observation(observation: dict[str, Any]) -> dict[str, Any]:
    state = dict(zip(STATE_NAMES, observation["agent_pos"].tolist(), strict=True))
    return {**state, FRONT: observation["pixels"][FRONT]}


def table(scores: list[EpisodeScore]) -> str:
    """A row an episode, then mean and standard deviation over the episodes that have a value."""
    rows = np.ma.masked_invalid([score.row() for score in scores])
    lines = ["  ".join(f"{name:>13}" for name in ("seed", *_COLUMNS))]
    labels = [*(str(score.seed) for score in scores), "mean", "std"]
    for label, row in zip(labels, [*rows, rows.mean(axis=0), rows.std(axis=0)], strict=True):
        values = ["-" if v is np.ma.masked else format(v, f) for v, f in zip(row, _COLUMNS.values(), strict=True)]
        lines.append("  ".join(f"{value:>13}" for value in (label, *values)))
    return "\n".join(lines)


def _shares(scores: list[EpisodeScore]) -> NDArray[np.float64]:
    return np.array([score.collected / score.total for score in scores])


def _write(folder: Path, scores: list[EpisodeScore]) -> None:
    """Replace the results as a whole: whoever reads them meanwhile, or after a crash, finds the last ones."""
    share = _shares(scores)
    overall = {"mean_share_collected": share.mean(), "std_share_collected": share.std(), "n_episodes": len(scores)}
    overall["pc_success"] = 100 * float(np.mean(share >= SUCCESS_SHARE))
    overall["avg_sum_reward"] = float(np.mean([score.collected for score in scores]))
    info = {"overall": overall, "per_episode": [asdict(score) for score in scores]}
    folder.mkdir(parents=True, exist_ok=True)
    temporary = folder / ".eval_info.json.tmp"
    temporary.write_text(json.dumps(info, indent=2))
    os.replace(temporary, folder / "eval_info.json")


def _say(config: EvalConfig, scores: list[EpisodeScore]) -> None:
    folder, share = config.output_dir, _shares(scores)
    assert folder is not None
    if len(scores) < config.eval.n_episodes:
        print(f"stopped after {len(scores)} of {config.eval.n_episodes} episodes")
    if scores:
        print(table(scores))
        print(f"\ncollected {share.mean():.1%} of the objects (std {share.std():.1%}); details in {folder}")
    for video in sorted(folder.glob("videos/*.mp4")):
        print(f"video: {video}")


def main() -> None:
    """Entry point of `relmm-eval`."""
    run("relmm-eval", EvalConfig, evaluate, prepare=_prepare)


def _prepare(arguments: Arguments) -> None:
    """There is only one environment, so its type need not be said."""
    if arguments.get("env.type") is None and arguments.get("config_path") is None:
        arguments.set("env.type", "relmm_room")


if __name__ == "__main__":
    main()
