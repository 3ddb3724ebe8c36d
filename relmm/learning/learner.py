"""Updates of the policy from the replay: sample, relabel, loss, step."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from relmm.features import Phase
from relmm.learning.replay import Replay, to_pictures
from relmm.policies.relmm.batch import NavigationBatch, last_sides
from relmm.policies.relmm.maps import Maps
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy
from relmm.policies.relmm.navigation import ACTIONS


class RecordedEpisode(Protocol):
    """What `relmm.episodes` reads: a row a frame."""

    @property
    def images(self) -> NDArray[np.uint8]:
        """(n, 100, 100, 3)."""

    @property
    def states(self) -> NDArray[np.float32]:
        """(n, 10)."""

    @property
    def actions(self) -> NDArray[np.float32]:
        """(n, 5)."""

    @property
    def rewards(self) -> NDArray[np.float32]:
        """(n,)."""

    @property
    def phases(self) -> NDArray[np.int64]:
        """(n,)."""


class Learner:
    """Trains a policy's two modules, each with its own optimiser.

    Args:
        policy: to train; its config says how.
        replay: to learn from.
        seed: of the batches.

    Attributes:
        optimizers: by module.
        logs: of the last updates, for the metrics.
    """

    def __init__(self, policy: ReLMMPolicy, replay: Replay, seed: int) -> None:
        self.policy, self.replay, self.config = policy, replay, policy.config
        self.maps = Maps(policy.observer, policy.grasping, replay.capacity)
        self.rng = np.random.default_rng(seed)
        self.noise = torch.Generator().manual_seed(seed)
        grasping, navigation = policy.get_optim_params()
        self.optimizers = {
            "grasping": torch.optim.Adam(grasping["params"], lr=grasping["lr"], fused=True),
            "navigation": torch.optim.Adam(navigation["params"], lr=navigation["lr"], fused=True),
        }
        self.logs: dict[str, float] = {}
        policy.train()

    # --- Grasping -----------------------------------------------------------------------------------------
    @property
    def grasping_has_begun(self) -> bool:
        """Whether there were N_bt attempts; until then the ensemble knows nothing."""
        return len(self.replay.attempts) >= self.config.min_attempts_to_update

    def update_grasping(self, phase: int) -> None:
        """The updates that follow an attempt in a phase, if there are enough attempts to learn from."""
        frozen = self.config.freeze_grasping and phase != Phase.CURRICULUM
        if self.grasping_has_begun and self.replay.available(self.replay.attempts) and not frozen:
            only_failures = self.replay.attempts_since_first_success == 0
            for _ in range(self.config.grasp_updates):
                loss, logs = self._grasp_loss()
                if only_failures and logs["grasp_loss"] < self.config.min_failure_loss:
                    break
                self._step("grasping", loss, logs)
            self.maps.version += 1

    def _grasp_loss(self) -> tuple[torch.Tensor, dict[str, float]]:
        attempts = self.replay.attempts
        rows = self.replay.sample(attempts, self.config.grasp_batch_size, self.rng)
        device = self.policy.weights_device
        pictures = self._pictures(attempts["frame"][rows])
        cells = torch.from_numpy(attempts["cell"][rows]).to(device)
        successes = torch.from_numpy(attempts["success"][rows]).to(device)
        others = self._pictures(self.replay.sample_frames(len(rows), self.rng))
        return self.policy.grasp_loss(pictures, cells, successes, others, self.noise)

    # --- Recorded episodes --------------------------------------------------------------------------------
    def read(self, episode: RecordedEpisode, update: bool) -> None:
        """Take a recorded episode into the replay; with `update`, learn from each frame as if it had just happened."""
        columns = (episode.images, episode.states[:, :2], episode.actions, episode.rewards, episode.phases)
        for picture, motion, action, reward, phase in zip(*columns, strict=True):
            attempts, steps = len(self.replay.attempts), self.replay.navigation_steps
            self.replay.add(picture, (float(motion[0]), float(motion[1])), action, bool(reward > 0), int(phase))
            if update and len(self.replay.attempts) > attempts:
                self.update_grasping(int(phase))
            if update and self.replay.navigation_steps > steps:
                self.update_navigation()
        self.replay.save_episode()

    # --- Navigation ---------------------------------------------------------------------------------------
    def update_navigation(self) -> None:
        """The updates that follow a navigation step, if there are enough steps to learn from."""
        begun = len(self.replay.steps) >= self.config.min_steps_to_update
        if begun and self.replay.available(self.replay.steps):
            for _ in range(self.config.navigation_updates):
                self._step("navigation", *self._navigation_loss())
                self.policy.update()

    def _navigation_loss(self) -> tuple[torch.Tensor, dict[str, float]]:
        size, replay = self.config.navigation_batch_size, self.replay
        others = round(size * self.config.pseudo_reset_share) if replay.available(replay.pseudo_reset_steps) else 0
        length = self.config.return_steps
        chains = replay.chains(replay.steps, replay.sample(replay.steps, size - others, self.rng), length, length)
        if others:
            # Random drives: what follows on their first step is not what the policy would do.
            chosen = replay.sample(replay.pseudo_reset_steps, others, self.rng)
            more = replay.chains(replay.pseudo_reset_steps, chosen, length, 1)
            chains = {name: np.concatenate([chains[name], more[name]]) for name in chains}
        batch = self.policy.augmented(self.navigation_batch(chains), self.noise)
        noise = torch.randn(2, size, ACTIONS, generator=self.noise).to(self.policy.weights_device)
        return self.policy.navigation.loss(batch, noise)

    def navigation_batch(self, chains: dict[str, NDArray[Any]]) -> NavigationBatch:
        """Navigation steps, as `Replay.chains` gives them, as a batch, relabelled by the current ensemble."""
        device, frames = self.policy.weights_device, chains["frames"]
        observations, probabilities = (
            each.to(device).unflatten(0, frames.shape)
            for each in self.maps.get(frames.flatten(), self._pictures, self.config.refreshed_maps)
        )
        success, attempted, ends, actions = (
            torch.from_numpy(chains[name]).to(device) for name in ("success", "attempted", "lengths", "actions")
        )
        rewards, continues = self.policy.rewards(probabilities[:, 1:], success, attempted)
        # The motion of a step is that which the frame after it knows of.
        motions = torch.from_numpy(self.replay.motions(frames)).to(device)
        sides, chosen = last_sides(motions[..., 1]), torch.arange(len(frames), device=device)
        there = torch.arange(frames.shape[1] - 1, device=device) < ends[:, None]
        return NavigationBatch(
            observations[:, 0],
            sides[:, 0],
            actions,
            rewards,
            observations[chosen, ends],
            sides[chosen, ends],
            continues,
            ends,
            motions[:, 1:] * there[..., None],
        )

    def _pictures(self, frames: NDArray[np.int64]) -> torch.Tensor:
        return to_pictures(self.replay.pictures(frames), self.policy.weights_device)

    def _step(self, module: str, loss: torch.Tensor, logs: dict[str, float]) -> None:
        optimizer = self.optimizers[module]
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        self.logs |= logs
