"""The hierarchical policy of ReLMM: a gate, then a grasp or a navigation step."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from relmm.features import ACTION_NAMES, IMAGE_KEY, MAX_THETA_VEL, MAX_X_VEL, Skill, action_dict, xy_to_cell
from relmm.policies.controller import ControllerPolicy, Row, grasp_cell
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.policies.relmm.encoders import FloorObserver, make_observer
from relmm.policies.relmm.grasping import Estimate, GraspEnsemble
from relmm.policies.relmm.maps import Maps
from relmm.policies.relmm.navigation import ACTIONS, Navigation, NavigationBatch
from relmm.policies.relmm.trail import HISTORY, TRAIL_FEATURES, Trail

_REMEMBERED_FRAMES = 2**17  # 4 kB each, as they are met
_SKILL = ACTION_NAMES.index("skill.pos")
_PLACE = slice(ACTION_NAMES.index("skill_x.pos"), ACTION_NAMES.index("skill_y.pos") + 1)


class ReLMMPolicy(ControllerPolicy):
    """Drives with `navigation`; grasps with `grasping` where that expects success.

    Attributes:
        grasping: the ensemble.
        navigation: soft actor-critic.
        sampling: whether it acts as while training; `config.sample` at first.
        estimate: the ensemble's opinion of the last picture; None before the first.
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
        self._maps: Maps | None = None  # of the frames that `forward` has seen

    # --- Acting -------------------------------------------------------------------------------------------
    def decide(self, image: NDArray[np.uint8], state: NDArray[np.float32], row: Row) -> dict[str, float]:
        """See `ControllerPolicy.decide`: greedily, or as while training if `sampling`."""
        pictures = self.to_pictures(image)
        estimate = self.look(pictures)
        trail: Trail = row.memory.setdefault("trail", Trail())
        if row.memory.pop("drove", False):
            trail.moved(float(state[0]), float(state[1]))
        rng = self._rng_of(row) if self.sampling else None
        if row.attempts < self.config.num_grasp and self._wants_to_grasp(estimate, row.attempts, rng):
            return self.grasp(estimate, rng)
        row.memory["drove"] = True
        return self.navigate(pictures, trail.features(), rng)

    def forget_search(self, row: Row) -> None:
        """Begin with an empty trail, as training does after a pseudo-reset."""
        row.memory.pop("trail", None)
        row.memory.pop("drove", None)

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

    def navigate(self, pictures: Tensor, trail: NDArray[np.float32], rng: torch.Generator | None) -> dict[str, float]:
        """A navigation step for one picture and trail: sampled, or the mean action without random numbers."""
        observations = self.observer(pictures, self.grasping)
        trails = torch.from_numpy(trail[None]).to(self.weights_device)
        action = self.navigation.act(observations, trails, rng)[0]
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

        Args:
            batch: pictures (batch, time, 3, 100, 100) 0..1, `action` (batch, history + time, 5) and `next.reward`
                (batch, time), where time is `config.observation_delta_indices`; which of them are padding.
            **kwargs: LeRobot's, not used.
        """
        trails = _trails(batch)
        batch = {**batch, "action": batch["action"][:, HISTORY:]}
        skills = batch["action"][:, 0, _SKILL].round().long()
        attempts, steps = skills == Skill.GRASP, _drives(batch, skills)
        losses = [self._no_loss()]
        logs: dict[str, Any] = {}
        if attempts.any():
            others = batch[IMAGE_KEY][:, 0]
            grasp_loss, logs = self.grasp_loss(*_attempts(batch, attempts), others, self.rng, offline=True)
            losses.append(grasp_loss)
        if steps.any():
            navigation_batch = self.augmented(self._navigation_batch(batch, steps, trails[:, steps]), self.rng)
            noise = torch.randn(2, int(steps.sum()), ACTIONS, device=batch["action"].device)
            conservatism = self.config.conservative_weight
            navigation_loss, navigation_logs = self.navigation.loss(navigation_batch, noise, conservatism)
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
        if self._maps is not None:
            self._maps.version += 1

    def get_optim_params(self) -> Any:
        """One group for the ensemble and one for the navigation, with their learning rates."""
        navigation = [weight for weight in self.navigation.parameters() if weight.requires_grad]
        return [
            {"params": list(self.grasping.parameters()), "lr": self.config.grasp_learning_rate},
            {"params": navigation, "lr": self.config.navigation_learning_rate},
        ]

    def relabel(
        self, batch: NavigationBatch, probabilities: Tensor, success: Tensor, attempted: Tensor
    ) -> NavigationBatch:
        """Reward steps without success with what the current ensemble makes of where they led (paper 4.2).

        Args:
            batch: with rewards of -1 and 0.
            probabilities: P[grasp] at the next observations, (batch,).
            success: which steps led to one, (batch,) bool.
            attempted: after which steps grasps were attempted, (batch,) bool.
        """
        if not self.config.relabel:
            return batch
        known = success if self.config.relabel_failed else success | attempted
        chance = torch.where(known, 0.0, probabilities)
        continues = batch.continues * (1 - chance) if self.config.relabel_terminal else batch.continues
        return replace(batch, rewards=batch.rewards + chance, continues=continues)

    def augmented(self, batch: NavigationBatch, rng: torch.Generator) -> NavigationBatch:
        """Navigation steps as they might have been as well: see `mirror` and `tidied_share`."""
        if self.config.mirror and torch.rand(1, generator=rng) < 0.5:
            batch = batch.mirrored()
        tidied = self.config.tidied_share > 0 and self.config.navigation_encoder == "floor"
        return batch.tidied(self.config.tidied_share, rng) if tidied else batch

    def _navigation_batch(self, batch: dict[str, Any], steps: Tensor, trails: Tensor) -> NavigationBatch:
        pictures, actions = batch[IMAGE_KEY][steps], batch["action"][steps]
        attempted = actions[:, 1:, _SKILL].round() == Skill.GRASP
        # Only attempts that follow the step without another step between them are its outcome.
        own = attempted.long().cumprod(dim=1).bool()
        success = (own & (batch["next.reward"][steps][:, 1:] > 0.5)).any(dim=1)
        after = (own.sum(dim=1) + 1).clamp(max=pictures.shape[1] - 1)
        # At the episode's end there is no step after the attempts: the picture before them is what the drive led to.
        after = torch.where(_padded(batch, steps).gather(1, after[:, None]).squeeze(1), 1, after)
        rows = torch.arange(len(pictures), device=pictures.device)
        seen = torch.cat([pictures[:, 0], pictures[rows, after]])
        numbers = None if "index" not in batch else torch.cat([batch["index"][steps], batch["index"][steps] + after])
        observations, probabilities = self._see(seen, numbers)
        count = len(pictures)
        result = NavigationBatch(
            observations[:count],
            trails[0],
            from_navigation_steps(actions[:, 0]),
            success.float() - 1,
            observations[count:],
            trails[1],
            1 - success.float(),
        )
        return self.relabel(result, probabilities[count:], success, own.any(dim=1))

    def _see(self, pictures: Tensor, numbers: Tensor | None) -> tuple[Tensor, Tensor]:
        """Observations and P[grasp] of pictures; of those with numbers, what earlier batches found out is kept."""
        if numbers is None:
            estimate = self.grasping.estimate(pictures)
            return self.observer(pictures, self.grasping), self.grasping.grasp_probability(estimate)
        if self._maps is None:
            self._maps = Maps(self.observer, self.grasping, _REMEMBERED_FRAMES)
        # Another dataset may have another picture of the same number.
        checksums = (pictures * 255).double().round().flatten(1).sum(dim=1).long()
        frames = (numbers + checksums * _REMEMBERED_FRAMES).cpu().numpy()
        rows = {frame: row for row, frame in enumerate(frames.tolist())}

        def find(wanted: NDArray[np.int64]) -> Tensor:
            return pictures[[rows[frame] for frame in wanted.tolist()]]

        observations, probabilities = self._maps.get(frames, find, self.config.refreshed_maps)
        return observations.to(pictures.device), probabilities.to(pictures.device)

    def _no_loss(self) -> Tensor:
        return self.navigation.log_temperature * 0.0


def to_navigation_step(action: list[float]) -> dict[str, float]:
    """A navigation step for forward and turn in -1..1; -1 forward stands still, as in the authors' code."""
    return action_dict(x_vel=(action[0] + 1) / 2 * MAX_X_VEL, theta_vel=action[1] * MAX_THETA_VEL)


def from_navigation_steps(actions: Tensor) -> Tensor:
    """Forward and turn in -1..1, (batch, 2), of actions as datasets hold them, (batch, 5)."""
    return torch.stack([actions[:, 0] / MAX_X_VEL * 2 - 1, actions[:, 1] / MAX_THETA_VEL], dim=1).clamp(-1, 1)


def _drives(batch: dict[str, Any], skills: Tensor) -> Tensor:
    """Which frames are navigation steps whose outcome is in the batch, (batch,) bool.

    Not there are the picture after an episode's last frame, and what came of a curriculum's many attempts.
    """
    drives = skills == Skill.NAVIGATE
    padded = _padded(batch, drives.new_ones(len(drives)))
    failed = (batch["action"][..., _SKILL].round() == Skill.GRASP) & (batch["next.reward"] < 0.5) & ~padded
    return drives & ~padded[:, 1] & ~failed[:, 1:].all(dim=1)


def _trails(batch: dict[str, Any]) -> Tensor:
    """Where the robot had been before each frame, and if it drives, after it, (2, batch, 21).

    From the actions of the frames before; the turns of collision avoidance, which only the odometry has, are missing.
    """
    actions: Tensor = batch["action"]
    unknown: Tensor = batch.get("action_is_pad", torch.zeros(actions.shape[:2], dtype=torch.bool))
    features = np.empty((2, len(actions), TRAIL_FEATURES), np.float32)
    for row, (steps, padded) in enumerate(zip(actions.tolist(), unknown.tolist(), strict=True)):
        trail = Trail()
        for x_vel, theta_vel, skill, *_ in itertools.compress(steps[:HISTORY], np.logical_not(padded)):
            if round(skill) == Skill.PLACE:
                trail.reset()
            elif round(skill) == Skill.NAVIGATE:
                trail.moved(x_vel, theta_vel)
        features[0, row] = trail.features()
        trail.moved(*steps[HISTORY][:2])
        features[1, row] = trail.features()
    return torch.from_numpy(features).to(actions.device)


def _padded(batch: dict[str, Any], rows: Tensor) -> Tensor:
    """Which frames lie beyond their episode's end, (rows, time) bool."""
    padded: Tensor | None = batch.get(f"{IMAGE_KEY}_is_pad")
    return (
        torch.zeros(batch["action"].shape[:2], dtype=torch.bool, device=rows.device)[rows]
        if padded is None
        else padded[rows]
    )


def _attempts(batch: dict[str, Any], attempts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    places = batch["action"][attempts][:, 0, _PLACE].tolist()
    cells = torch.tensor([xy_to_cell(x, y) for x, y in places], device=attempts.device)
    return batch[IMAGE_KEY][attempts][:, 0], cells, (batch["next.reward"][attempts][:, 0] > 0.5).float()
