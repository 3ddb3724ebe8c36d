"""The hierarchical policy of ReLMM: a gate, then a grasp or a navigation step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from relmm.features import IMAGE_KEY, STATE_NAMES
from relmm.policies.controller import ControllerPolicy, Row, grasp_cell
from relmm.policies.relmm.batch import NavigationBatch, last_sides
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.policies.relmm.encoders import FloorObserver, make_observer
from relmm.policies.relmm.grasping import Estimate, GraspEnsemble
from relmm.policies.relmm.maps import Maps
from relmm.policies.relmm.navigation import ACTIONS, Navigation, to_navigation_step
from relmm.policies.relmm.offline import CAPACITY, Batch, Recollection, Rows
from relmm.policies.relmm.searching import Search, nearest_bearing

_TURN = STATE_NAMES.index("theta.vel")


class ReLMMPolicy(ControllerPolicy):
    """Drives with `navigation`; grasps with `grasping` where that expects success.

    Attributes:
        grasping: the ensemble.
        navigation: soft actor-critic.
        sampling: whether it acts as while training; `config.sample` at first.
        estimate: the ensemble's opinion of the last picture; None before the first.
        updates: of the navigation, or by `forward`, since its first weights.
    """

    config_class = ReLMMConfig
    name = "relmm"
    config: ReLMMConfig

    def __init__(self, config: ReLMMConfig, **kwargs: Any) -> None:
        super().__init__(config, **kwargs)
        with torch.random.fork_rng():  # the same seed gives the same weights, whatever was drawn before
            torch.manual_seed(config.seed or 0)
            self.grasping = GraspEnsemble(config)
            self.navigation = Navigation(config)
        self.observer = make_observer(config)
        self.rng = torch.Generator().manual_seed(config.seed or 0)
        self.sampling = config.sample
        self.estimate: Estimate | None = None
        self.updates: Tensor
        self.register_buffer("updates", torch.tensor(0))
        # Of the frames that `forward` has seen.
        self._maps, self._recollection = Maps(self.observer, self.grasping, CAPACITY), Recollection()

    # --- Acting -------------------------------------------------------------------------------------------
    def decide(self, image: NDArray[np.uint8], state: NDArray[np.float32], row: Row) -> dict[str, float]:
        """See `ControllerPolicy.decide`: greedily, or as while training if `sampling`."""
        pictures = self.to_pictures(image)
        estimate = self.look(pictures)
        rng = self._rng_of(row) if self.sampling else None
        if row.attempts < self.config.num_grasp and self._wants_to_grasp(estimate, row.attempts, rng):
            return self.grasp(estimate, rng)
        return self.navigate(pictures, float(state[_TURN]), row.memory.setdefault("search", Search()), rng)

    def look(self, pictures: Tensor) -> Estimate:
        """The ensemble's opinion of pictures 0..1 (batch, 3, 100, 100), which is also remembered."""
        self.estimate = self.grasping.estimate(pictures)
        return self.estimate

    @property
    def grasp_probability(self) -> float:
        """P[grasp] of the last picture, -1 before the first."""
        return -1.0 if self.estimate is None else float(self.grasping.grasp_probability(self.estimate)[0])

    def grasp(self, estimate: Estimate, rng: torch.Generator | None) -> dict[str, float]:
        """A sampled cell (paper eq. 2), or the best one of the ensemble's mean without random numbers."""
        cells = estimate.mean.argmax(dim=1) if rng is None else self.grasping.sample(estimate, rng)
        return grasp_cell(int(cells[0]))

    def navigate(
        self, pictures: Tensor, theta_vel: float, search: Search, rng: torch.Generator | None
    ) -> dict[str, float]:
        """A navigation step: sampled, or the mean action without random numbers.

        Args:
            pictures: one, 0..1, (1, 3, 100, 100).
            theta_vel: of the last navigation step, deg/s.
            search: what the robot remembers.
            rng: to sample with.
        """
        observations = self.observer(pictures, self.grasping)
        if self.navigation.is_orderly and search.leaves(nearest_bearing(observations[0]), theta_vel):
            return to_navigation_step([1.0, 0.0])
        action = self.navigation.act(observations, torch.tensor([search.side], device=self.weights_device), rng)[0]
        return to_navigation_step(action.tolist())

    def to_pictures(self, image: NDArray[Any]) -> Tensor:
        """One picture, uint8 (100, 100, 3), as the networks take it: 0..1, (1, 3, 100, 100)."""
        return torch.from_numpy(image).to(self.weights_device).permute(2, 0, 1)[None] / 255

    @property
    def weights_device(self) -> torch.device:
        """Where the weights are."""
        return self.navigation.log_temperature.device

    def _rng_of(self, row: Row) -> torch.Generator:
        """The robot's own random numbers, so that batching changes nothing."""
        if "rng" not in row.memory:
            row.memory["rng"] = torch.Generator().manual_seed(int(row.rng.integers(2**63)))
        generator: torch.Generator = row.memory["rng"]
        return generator

    def _wants_to_grasp(self, estimate: Estimate, attempts: int, rng: torch.Generator | None) -> bool:
        if rng is None:
            return float(estimate.mean.amax()) >= self.config.grasp_threshold
        # Once decided, up to N_grasp attempts follow (paper Algorithm 1).
        return attempts > 0 or float(torch.rand(1, generator=rng)) <= self.grasp_probability

    # --- Learning -----------------------------------------------------------------------------------------
    def forward(self, batch: dict[str, Any], **kwargs: Any) -> tuple[Tensor, dict[str, Any] | None]:
        """The losses of the frames of a LeRobot batch: attempts teach the ensemble, navigation steps the navigation.

        While training, the ensemble learns first and then the navigation: see `ReLMMConfig.offline_grasp_updates`.

        Args:
            batch: pictures (batch, time, 3, 100, 100) 0..1, `action` (batch, history + time, 5) and `next.reward`
                (batch,), where time is `config.observation_delta_indices`; which of them are padding.
            **kwargs: LeRobot's, not used.
        """
        memory = self._recollection if self.training else Recollection()
        attempts, steps = memory.add(Batch(batch))
        if self.training:
            attempts = memory.top_up(attempts, self.config.grasp_batch_size, self.rng)
            steps = memory.top_up(steps, self.config.navigation_batch_size, self.rng)
            grasps_first = int(self.updates) < self.config.offline_grasp_updates
            attempts, steps = (attempts, steps[:0]) if grasps_first else (attempts[:0], steps)

        def find(frames: NDArray[np.int64]) -> Tensor:
            return self._on_device(memory.pictures_of(frames)) / 255

        losses = [self._no_loss()]
        logs: dict[str, Any] = {}
        if len(attempts) > 0:
            cells, successes = (self._on_device(attempts[name]) for name in ("cell", "success"))
            others = batch[IMAGE_KEY][:, 0]
            grasp_loss, logs = self.grasp_loss(
                find(attempts["frame"]), cells, successes, others, self.rng, offline=True
            )
            losses.append(grasp_loss)
        if len(steps) > 0:
            navigation_batch = self.augmented(self._navigation_batch(steps, find), self.rng)
            noise = torch.randn(2, len(steps), ACTIONS, device=self.weights_device)
            navigation_loss, navigation_logs = self.navigation.loss(navigation_batch, noise, offline=True)
            losses.append(navigation_loss)
            logs |= navigation_logs
        return torch.stack(losses).sum(), logs

    def grasp_loss(
        self,
        images: Tensor,
        cells: Tensor,
        successes: Tensor,
        others: Tensor,
        rng: torch.Generator,
        offline: bool = False,
    ) -> tuple[Tensor, dict[str, float]]:
        """The loss of the ensemble, and the mean of the members' cross-entropies for logs.

        Args:
            images: before the attempts, as in `GraspEnsemble.loss`.
            cells: attempted.
            successes: 0 or 1.
            others: any pictures 0..1, (batch, 3, 100, 100), whose floor beyond the arm's reach is mostly empty.
            rng: chooses places in them.
            offline: nobody will try the other places; see `FloorObserver.background_loss`.
        """
        loss = self.grasping.loss(images, cells, successes)
        logs = {"grasp_loss": loss.item() / self.config.num_members}
        if isinstance(self.observer, FloorObserver) and self.config.background_weight > 0:
            background = self.observer.background_loss(others, self.grasping, rng, offline)
            loss = loss + self.config.background_weight * background
        return loss, logs

    def update(self) -> None:
        """Called after each step of the optimiser."""
        self.navigation.update_targets()
        self.updates += 1
        # From then on the ensemble stays as it is, and so do its maps.
        self._maps.version = min(int(self.updates), self.config.offline_grasp_updates)

    def get_optim_params(self) -> Any:
        """One group for the ensemble and one for the navigation, with their learning rates."""
        navigation = [weight for weight in self.navigation.parameters() if weight.requires_grad]
        return [
            {"params": list(self.grasping.parameters()), "lr": self.config.grasp_learning_rate},
            {"params": navigation, "lr": self.config.navigation_learning_rate},
        ]

    def rewards(self, probabilities: Tensor, success: Tensor, attempted: Tensor) -> tuple[Tensor, Tensor]:
        """Rewards of navigation steps, and whether the search goes on after them, shaped like the arguments.

        Steps without success are rewarded with what the current ensemble makes of where they led (paper 4.2).

        Args:
            probabilities: P[grasp] at the next observations.
            success: which steps led to one, bool.
            attempted: after which steps grasps were attempted, bool.
        """
        rewards, continues = success.float() - 1, 1 - success.float()
        if not self.config.relabel:
            return rewards, continues
        known = success if self.config.relabel_failed else success | attempted
        chance = torch.where(known, 0.0, probabilities)
        return rewards + chance, continues * (1 - chance) if self.config.relabel_terminal else continues

    def augmented(self, batch: NavigationBatch, rng: torch.Generator) -> NavigationBatch:
        """Navigation steps as they might have been as well: see `mirror`, `recolour` and `tidied_share`."""
        if self.config.mirror and torch.rand(1, generator=rng) < 0.5:
            batch = batch.mirrored()
        if self.config.navigation_encoder == "floor":
            if self.config.recolour:
                batch = batch.recoloured(rng)
            if self.config.tidied_share > 0:
                batch = batch.tidied(self.config.tidied_share, rng)
        return batch

    def _navigation_batch(self, steps: Rows, find: Callable[[NDArray[np.int64]], Tensor]) -> NavigationBatch:
        """Steps of `offline.STEP` with what the ensemble makes of their pictures, relabelled."""
        frames = np.concatenate([steps["frame"], steps["next"]])
        observations, probabilities = map(self._on_device, self._maps.get(frames, find, self.config.refreshed_maps))
        success, attempted = (self._on_device(steps[name]) for name in ("success", "attempted"))
        count, sides = len(steps), last_sides(self._on_device(steps["turns"]))
        rewards, continues = self.rewards(probabilities[count:], success, attempted)
        return NavigationBatch(
            observations[:count],
            sides[:, 0],
            self._on_device(steps["action"]),
            rewards[:, None],
            observations[count:],
            sides[:, 1],
            continues[:, None],
            torch.ones(count, dtype=torch.long, device=self.weights_device),
            self._on_device(steps["motion"])[:, None],
        )

    def _on_device(self, values: Tensor | NDArray[Any]) -> Tensor:
        return torch.as_tensor(values).to(self.weights_device)

    def _no_loss(self) -> Tensor:
        return self.navigation.log_temperature * 0.0
