"""Evaluating a policy in its room while it is being trained."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from relmm.commands.evaluate import EpisodeScore, EpisodeStopped, run_episode, share_done
from relmm.commands.train_config import TrainEvalConfig
from relmm.learning.actor import Actor
from relmm.policies.learning import LearningPolicy
from relmm.sim.config_locobot_sim import LocobotSimConfig
from relmm.sim.env import RelmmRoomEnv


class RoomEvaluation:
    """The paper's evaluation (250 steps, greedy, no pseudo-reset) in a room of its own.

    Args:
        robot: whose room.
        actor: the policy that is being trained, with its processors.
        config: how many episodes, of which seeds.
        videos: where to put them.
        should_stop: asked before each step.
        show: takes the share of the evaluation that is done, after each step.
    """

    def __init__(
        self,
        robot: LocobotSimConfig,
        actor: Actor,
        config: TrainEvalConfig,
        videos: Path,
        *,
        should_stop: Callable[[], bool],
        show: Callable[[float], None] = lambda done: None,
    ) -> None:
        self._actor, self._config, self._videos = actor, config, videos
        self._should_stop, self._show = should_stop, show
        self._env = RelmmRoomEnv(room=robot.room, num_objects=robot.num_objects, camera=robot.camera)

    def __call__(self, step: int) -> dict[str, Any]:
        """The scores of the policy as it is now, for the metrics; none if it was stopped."""
        policy = self._actor.policy
        assert isinstance(policy, LearningPolicy)
        policy.sampling = False
        policy.eval()
        try:
            scores = [self._episode(step, index) for index in range(self._config.n_episodes)]
        except EpisodeStopped:
            return {}
        finally:
            policy.sampling = True
            policy.train()
        self._show(1.0)  # an episode ends early when all is collected
        shares = [score.collected / score.total for score in scores]
        return {
            "eval_collected": float(np.mean(shares)),
            "eval_collected_std": float(np.std(shares)),
            "eval_collected_each": [round(share, 4) for share in shares],
            "eval_grasp_success": sum(s.picked_up for s in scores) / max(sum(s.grasps for s in scores), 1),
        }

    def _episode(self, step: int, index: int) -> EpisodeScore:
        filmed = index < self._config.n_videos
        video = self._videos / f"videos_step_{step:06d}" / f"eval_episode_{index}.mp4" if filmed else None

        def show(info: dict[str, Any]) -> None:
            self._show((index + share_done(self._env, info)) / self._config.n_episodes)

        return run_episode(self._env, self._actor, self._config.seed + index, video, self._should_stop, show)
