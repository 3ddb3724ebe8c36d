"""What relmm's policies share: LeRobot's policy interface around one decision per robot."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.optim.optimizers import AdamConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import (
    AddBatchDimensionProcessorStep,
    DeviceProcessorStep,
    NormalizerProcessorStep,
    PolicyProcessorPipeline,
    RenameObservationsProcessorStep,
    UnnormalizerProcessorStep,
)
from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action
from numpy.typing import NDArray

from relmm.errors import MANY, MAX_SEED, ConfigError, check_range
from relmm.features import (
    ACTION_NAMES,
    BASKET_XY,
    IMAGE_KEY,
    IMAGE_SIZE,
    STATE_KEY,
    STATE_NAMES,
    Skill,
    action_dict,
    cell_to_xy,
)
from relmm.geometry import other_camera
from relmm.policies.pseudo_reset import random_pseudo_reset

_NORMALIZED = ("VISUAL", "STATE", "ACTION")
_HOLDING = STATE_NAMES.index("holding.pos")


@dataclass
class ControllerConfig(PreTrainedConfig):
    """Settings that every policy of relmm has.

    Args:
        seed: of its random choices; each episode draws its own stream from it, however episodes are batched. None for
            that of the command, or 0.
        num_grasp: grasp attempts in a row after a navigation step (N_grasp of the paper).
        push_to_hub: upload it to `repo_id`; only when asked, where LeRobot's default is to upload.
    """

    push_to_hub: bool = False
    seed: int | None = None
    num_grasp: int = 2
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(_NORMALIZED, NormalizationMode.IDENTITY)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        # Filled in so that a controller can be made without a dataset or an environment at hand.
        self.input_features: dict[str, PolicyFeature] = self.input_features or {
            IMAGE_KEY: PolicyFeature(FeatureType.VISUAL, (3, IMAGE_SIZE, IMAGE_SIZE)),
            STATE_KEY: PolicyFeature(FeatureType.STATE, (len(STATE_NAMES),)),
        }
        self.output_features: dict[str, PolicyFeature] = self.output_features or {
            "action": PolicyFeature(FeatureType.ACTION, (len(ACTION_NAMES),))
        }
        check_range("policy.num_grasp", self.num_grasp, 1, MANY)
        check_range("policy.seed", self.seed or 0, 0, MAX_SEED)
        if not self.normalization_mapping.items() <= dict.fromkeys(_NORMALIZED, NormalizationMode.IDENTITY).items():
            raise ConfigError(
                "policy.normalization_mapping must be IDENTITY throughout, for relmm's policies take raw pictures; "
                "leave it out."
            )

    @property
    def observation_delta_indices(self) -> list[int] | None:
        """Only the present observation is used."""
        return None

    @property
    def action_delta_indices(self) -> list[int] | None:
        """Only the present action is used."""
        return None

    @property
    def reward_delta_indices(self) -> list[int] | None:
        """Only the present reward is used."""
        return None

    def get_optimizer_preset(self) -> AdamConfig:
        """LeRobot asks for one; there is nothing to optimise."""
        return AdamConfig()

    def get_scheduler_preset(self) -> None:
        """None."""

    def validate_features(self) -> None:
        """Check that the robot gives what the controller needs.

        Raises:
            ConfigError: no front camera, a picture of another size, or other state or action names.
        """
        image, state = self.input_features.get(IMAGE_KEY), self.input_features.get(STATE_KEY)
        wanted = (3, IMAGE_SIZE, IMAGE_SIZE)
        if image is None or tuple(image.shape) != wanted:
            have = "none" if image is None else f"one of shape {tuple(image.shape)}"
            raise ConfigError(f"{self.type} needs a picture {IMAGE_KEY} of shape {wanted}, but there is {have}.")
        if state is None or tuple(state.shape) != (len(STATE_NAMES),):
            raise ConfigError(f"{self.type} needs {STATE_KEY} to hold {', '.join(STATE_NAMES)}.")


@dataclass
class Row:
    """What a policy remembers about one robot of a batch.

    Attributes:
        rng: of its random choices.
        attempts: grasps since the last navigation step.
        observed: whether the present observation has been taken in already.
        belief: what the last decision was based on, by `relmm.features.BELIEF`; empty without an opinion.
        memory: whatever else.
    """

    rng: np.random.Generator
    attempts: int = 0
    observed: bool = False
    belief: dict[str, float] = field(default_factory=dict)
    memory: dict[str, Any] = field(default_factory=dict)


class ControllerPolicy(PreTrainedPolicy):
    """A LeRobot policy that decides for one robot at a time, so that batching changes nothing."""

    config_class = ControllerConfig
    name = "relmm_controller"
    config: ControllerConfig

    def __init__(self, config: ControllerConfig, **kwargs: Any) -> None:
        super().__init__(config)
        config.validate_features()
        meta = kwargs.get("dataset_meta")  # LeRobot's factory gives it, where there is a dataset
        cameras = None if meta is None else other_camera(meta.features, getattr(config, "camera", None))
        if cameras is not None:
            raise ConfigError(
                f"The dataset was recorded with the camera {cameras[0]}, but the policy's is {cameras[1]}; choose "
                "another dataset, or set --policy.camera to the dataset's."
            )
        self._rows: list[Row] = []
        self._episodes = 0

    def observe(self, image: NDArray[np.uint8], state: NDArray[np.float32], row: Row) -> None:
        """Take in an observation; to be called once with each, whoever decides what is done next.

        Args:
            image: the front camera, (100, 100, 3).
            state: by `relmm.features.STATE_NAMES`.
            row: what is remembered about this robot.
        """

    @abstractmethod
    def decide(self, image: NDArray[np.uint8], state: NDArray[np.float32], row: Row) -> dict[str, float]:
        """Choose the next action of a robot with empty hands, after `observe`.

        Args:
            image: the front camera, (100, 100, 3).
            state: by `relmm.features.STATE_NAMES`.
            row: what is remembered about this robot.
        """

    def pseudo_reset(self, row: Row, steps: int, holding: Callable[[], bool]) -> Iterator[dict[str, float]]:
        """The actions that carry what is held to somewhere else and put it down there.

        Args:
            row: what is remembered about this robot; `observe` is to be called between the actions.
            steps: navigation steps before and after the object is put down.
            holding: whether something is in the gripper now.
        """
        return random_pseudo_reset(row.rng, steps, holding)

    def describe(self, action: dict[str, float], row: Row) -> str:
        """What an action is for, in a few words for people."""
        match Skill(round(action["skill.pos"])):
            case Skill.GRASP:
                return "grasps"
            case Skill.PLACE:
                return "puts it down"
            case _:
                return f"drives at {action['x.vel']:.2f} m/s" if action["x.vel"] > 0 else "turns"

    def picture(self, row: Row) -> NDArray[np.uint8] | None:
        """What is thought about a robot's surroundings, to look at, uint8 (height, width, 3); None for nothing."""
        return None

    def reset(self) -> None:
        """Begin new episodes."""
        self._episodes += len(self._rows)
        self._rows = []

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> torch.Tensor:
        """One action a robot, float32 (batch, 5), in the order and units of `relmm.features.ACTION_NAMES`.

        Raises:
            ConfigError: a state of another length, as `lerobot-rollout` of lerobot 0.6.0 gives it.
        """
        if batch[STATE_KEY].shape[-1] != len(STATE_NAMES):  # numbers of other things at the places of those it reads
            raise ConfigError(
                f"{STATE_KEY} holds {batch[STATE_KEY].shape[-1]} numbers instead of {len(STATE_NAMES)}, "
                f"{STATE_NAMES[0]} to {STATE_NAMES[-1]}; if this is lerobot-rollout of lerobot 0.6.0, which drops "
                "velocities, install lerobot 0.6.1."
            )
        images = (batch[IMAGE_KEY] * 255).round().to(torch.uint8).permute(0, 2, 3, 1).cpu().numpy()
        states = batch[STATE_KEY].float().cpu().numpy()
        rows = [self.row(index) for index in range(len(images))]
        actions = [self._act(*each) for each in zip(images, states, rows, strict=True)]
        return torch.tensor([[action[name] for name in ACTION_NAMES] for action in actions])

    def row(self, index: int) -> Row:
        """What is remembered about a robot of the batch."""
        while len(self._rows) <= index:
            stream = [self.config.seed or 0, self._episodes + len(self._rows)]
            self._rows.append(Row(np.random.default_rng(stream)))
        return self._rows[index]

    def _act(self, image: NDArray[np.uint8], state: NDArray[np.float32], row: Row) -> dict[str, float]:
        if not row.observed:
            self.observe(image, state, row)
        row.observed = False
        if state[_HOLDING] > 0.5:
            row.attempts = 0
            return action_dict(Skill.PLACE, x=BASKET_XY[0], y=BASKET_XY[1])
        action = self.decide(image, state, row)
        row.attempts = row.attempts + 1 if action["skill.pos"] == Skill.GRASP else 0
        return action

    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> torch.Tensor:
        """A chunk of one action, (batch, 1, 5)."""
        return self.select_action(batch).unsqueeze(1)


class UntrainedPolicy(ControllerPolicy):
    """A policy without weights."""

    config_class = ControllerConfig
    name = "relmm_untrained"

    def __init__(self, config: ControllerConfig, **kwargs: Any) -> None:
        super().__init__(config, **kwargs)
        # LeRobot looks at a policy's parameters to find its device.
        self.placeholder = torch.nn.Parameter(torch.zeros(1), requires_grad=False)

    def forward(self, batch: dict[str, Any], **kwargs: Any) -> tuple[torch.Tensor, dict[str, Any] | None]:
        """There is nothing to learn.

        Raises:
            ConfigError: always.
        """
        raise ConfigError(f"{self.name} has nothing to train: choose a policy that learns.")

    def get_optim_params(self) -> list[torch.nn.Parameter]:
        """None of them learns."""
        return []


def grasp_cell(cell: int) -> dict[str, float]:
    """The action that grasps at the centre of a cell."""
    x, y = cell_to_xy(cell)
    return action_dict(Skill.GRASP, x=float(x), y=float(y))


def make_identity_processors(
    config: PreTrainedConfig, dataset_stats: dict[str, Any] | None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """LeRobot's standard steps under their standard names, so that its overrides find them; nothing is normalised."""
    features = {**config.input_features, **config.output_features}
    norm_map = config.normalization_mapping
    pre = [
        RenameObservationsProcessorStep(rename_map={}),
        AddBatchDimensionProcessorStep(),
        DeviceProcessorStep(device=config.device),
        NormalizerProcessorStep(features=features, norm_map=norm_map, stats=dataset_stats),
    ]
    post = [
        UnnormalizerProcessorStep(features=config.output_features, norm_map=norm_map, stats=dataset_stats),
        DeviceProcessorStep(device="cpu"),
    ]
    return (
        PolicyProcessorPipeline(steps=pre, name="policy_preprocessor"),
        PolicyProcessorPipeline(
            steps=post,
            name="policy_postprocessor",
            to_transition=policy_action_to_transition,
            to_output=transition_to_policy_action,
        ),
    )
