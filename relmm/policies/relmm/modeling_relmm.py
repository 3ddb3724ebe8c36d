"""The default policy: a gate, then a grasp, or the first step of a planned way."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from relmm.features import (
    DRIVE_PULSE_S,
    GRID,
    MOTION,
    SCAN,
    STATE_NAMES,
    Skill,
    action_dict,
    cell_to_xy,
)
from relmm.policies.controller import Row, grasp_cell
from relmm.policies.learning import LearningPolicy
from relmm.policies.pseudo_reset import PLACE_XY
from relmm.policies.relmm.carrying import choose_place, is_there
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.policies.relmm.drawing import draw_floor
from relmm.policies.relmm.grasping import FIRST_COLUMN, FIRST_ROW, GraspEnsemble
from relmm.policies.relmm.learner import Attempts, ReLMMLearner
from relmm.policies.relmm.memory import FloorGrid, FloorMemory
from relmm.policies.relmm.mind import Mind
from relmm.policies.relmm.offline import BatchReader
from relmm.policies.relmm.planning import Planner, find_things

_HOLDING = STATE_NAMES.index("holding.pos")
_CELLS = cell_to_xy(np.arange(GRID**2, dtype=float))  # m, robot frame, (225, 2)
_TO_MOTION = DRIVE_PULSE_S * np.array([1.0, 1.0, np.pi / 180])  # from m/s, m/s, deg/s to m, m, rad
_CAPACITY = 2**15  # attempts that `forward` remembers
_FAR_PROMISE = 0.25  # of what is not near enough to be sure, from which on it is worth a look
_FAILED_RADIUS, _FAILED_STEPS = 0.08, 60  # m round attempts that have failed, and how long nothing is expected there
_PUT_DOWN_RADIUS, _PUT_DOWN_STEPS = 0.12, 60  # the same round what was just put down
_PLACE_WITHIN = 0.12  # m of where it was to be put down
_UNWANTED_STEPS = 20  # the same for what lies in reach and is not wanted


class ReLMMPolicy(LearningPolicy):
    """Grasps where the ensemble expects success, and drives to where it would."""

    config_class = ReLMMConfig
    name = "relmm"
    config: ReLMMConfig

    def __init__(self, config: ReLMMConfig, **kwargs: Any) -> None:
        super().__init__(config, **kwargs)
        with torch.random.fork_rng():  # the same seed gives the same weights, whatever was drawn before
            torch.manual_seed(config.seed or 0)
            self.grasping = GraspEnsemble(config)
        self.grid = FloorGrid(FIRST_ROW, FIRST_COLUMN, self.grasping.known.numpy())
        self.sampling = config.sample
        # Of `forward`.
        self._attempts, self._batches = Attempts(_CAPACITY), BatchReader(self.grasping)
        self._rng = np.random.default_rng(config.seed or 0)
        self._noise = torch.Generator().manual_seed(config.seed or 0)

    # --- Acting -------------------------------------------------------------------------------------------
    def observe(self, image: NDArray[np.uint8], state: NDArray[np.float32], row: Row) -> None:
        """See `ControllerPolicy.observe`: lays what is seen into the remembered floor."""
        mind = self.mind(row)
        if state[_HOLDING] > 0.5:
            mind.attempted = []
        mind.move(state[MOTION] * _TO_MOTION)
        opinion = self.grasping.look(self.grasping.to_pictures(image))
        mind.floor.look(opinion.mean[0].cpu().numpy(), opinion.std[0].cpu().numpy(), state[SCAN])
        # What has failed is not tried again at once, as long as it can be seen from where the robot stands.
        mean, std = opinion.cells
        left_alone = torch.from_numpy(mind.floor.is_left_alone(mind.floor.to_map(_CELLS))).to(mean.device)
        mind.mean, mind.std = mean.masked_fill(left_alone, 0.0), std.masked_fill(left_alone, 0.0)
        chance = float((mind.mean + self.config.gate_std_weight * mind.std).amax())
        row.belief = {"grasp_probability": min(chance, 1.0)}

    def decide(self, image: NDArray[np.uint8], state: NDArray[np.float32], row: Row) -> dict[str, float]:
        """See `ControllerPolicy.decide`: greedily, or as while training if `sampling`."""
        if row.attempts < self.config.num_grasp and self._wants_to_grasp(row):
            return self.attempt(row)
        return self.navigate(row)

    def attempt(self, row: Row) -> dict[str, float]:
        """See `LearningPolicy`: a sampled cell (paper eq. 2), or the best one of the ensemble's mean."""
        mind = self.mind(row)
        mean, std = mind.mean, mind.std
        cell = int((self.grasping.sample(mean, std, mind.rng) if self.sampling else mean.argmax(dim=1))[0])
        mind.attempted.append(mind.floor.to_map(cell_to_xy(cell)))
        row.belief |= {"grasp_mean": float(mean[0, cell]), "grasp_std": float(std[0, cell])}
        return grasp_cell(cell)

    def navigate(self, row: Row) -> dict[str, float]:
        """See `LearningPolicy`: the first step of the best way."""
        mind = self.mind(row)
        for place in mind.attempted:
            mind.floor.leave_alone(place, _FAILED_RADIUS, _FAILED_STEPS)
        if not mind.attempted:
            mind.floor.leave_area_alone(_UNWANTED_STEPS)
        mind.attempted = []
        least = _FAR_PROMISE if self.sampling else self.config.grasp_threshold
        mind.plan = mind.planner.plan(mind.floor, self._success(mind), least)
        return mind.drive()

    def pseudo_reset(self, row: Row, steps: int, holding: Callable[[], bool]) -> Iterator[dict[str, float]]:
        """See `ControllerPolicy.pseudo_reset`: to free floor; the next plan leads away from there."""
        mind = self.mind(row)
        mind.attempted = []
        things, _ = find_things(self._success(mind), self.config.grasp_threshold, mind.floor.pose[:2])
        mind.carry_to = choose_place(mind.floor, things, steps, row.rng)
        for _ in range(steps):
            if mind.carry_to is None or not holding() or is_there(mind.floor, mind.carry_to[0], _PLACE_WITHIN):
                break
            things, _ = find_things(self._success(mind), self.config.grasp_threshold, mind.floor.pose[:2])
            mind.plan = mind.planner.go(mind.floor, *mind.carry_to, things)
            yield mind.drive()
        if holding():
            put_down = mind.floor.to_map(np.array(PLACE_XY))
            mind.floor.leave_alone(put_down, _PUT_DOWN_RADIUS, _PUT_DOWN_STEPS)  # before it is seen there
            yield action_dict(Skill.PLACE, x=PLACE_XY[0], y=PLACE_XY[1])

    def _success(self, mind: Mind) -> NDArray[np.float32]:
        return mind.floor.success(self.config.gate_std_weight if self.sampling else 0.0)

    def describe(self, action: dict[str, float], row: Row) -> str:
        """See `ControllerPolicy.describe`."""
        plan = self.mind(row).plan
        if plan is None or round(action["skill.pos"]) != Skill.NAVIGATE:
            return super().describe(action, row)
        if plan.searching:
            return "goes to see what lies there"
        return f"goes to grasp: {plan.promise:.0%} sure"

    def picture(self, row: Row) -> NDArray[np.uint8]:
        """See `ControllerPolicy.picture`: the remembered floor."""
        mind = self.mind(row)
        return draw_floor(mind.floor, self._success(mind), mind.plan)

    def mind(self, row: Row) -> Mind:
        """What is kept about a robot."""
        if "mind" not in row.memory:
            planner = Planner(self.config.failure_steps, self.config.unseen_promise)
            rng = torch.Generator().manual_seed(int(row.rng.integers(2**63)))
            row.memory["mind"] = Mind(FloorMemory(self.grid), planner, rng)
        mind: Mind = row.memory["mind"]
        return mind

    def _wants_to_grasp(self, row: Row) -> bool:
        mind = self.mind(row)
        if not self.sampling:
            return float(mind.mean.amax()) >= self.config.grasp_threshold
        # Once decided, up to N_grasp attempts follow (paper Algorithm 1).
        return row.attempts > 0 or row.rng.random() <= row.belief["grasp_probability"]

    # --- Learning -----------------------------------------------------------------------------------------
    def make_learner(self, seed: int, capacity: int) -> ReLMMLearner:
        """See `LearningPolicy`."""
        return ReLMMLearner(self.grasping, seed, capacity)

    def forward(self, batch: dict[str, Any], **kwargs: Any) -> tuple[Tensor, dict[str, Any] | None]:
        """The loss of attempts of a dataset: those of a LeRobot batch and, while training, of earlier ones.

        Args:
            batch: pictures 0..1 (batch, 3, 100, 100), `action` (batch, 5), `next.reward` and `index` (batch,); without
                `next.reward`, also `observation.state` and `episode_index`, which tell it sooner or later.
            **kwargs: LeRobot's, not used.

        Raises:
            ConfigError: the dataset has no rewards, nor what tells them.
        """
        attempts = self._attempts if self.training else Attempts(len(batch["action"]))
        reader = self._batches if self.training else BatchReader(self.grasping)
        for attempt, success in reader.read(batch):
            attempts.add(attempt.area, attempt.action, success, attempt.index)
        if len(attempts) == 0:
            return torch.stack([weight.sum() * 0.0 for weight in self.grasping.learned()]).sum(), {}
        if self.training:
            learned = attempts.sample(self.config.batch_size, self._rng, self.grasping.device)
            return self.grasping.loss(*learned, self._noise)
        return self.grasping.loss(*attempts.all(self.grasping.device))

    def get_optim_params(self) -> Any:
        """The ensemble's weights."""
        return self.grasping.learned()
