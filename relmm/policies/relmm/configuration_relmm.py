"""Settings of `relmm`: every hyper-parameter of the paper, and those of the faster default."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from lerobot.configs.policies import PreTrainedConfig
from lerobot.optim.optimizers import AdamConfig

from relmm.errors import ConfigError
from relmm.geometry import camera_geometry
from relmm.policies.controller import ControllerConfig

GRASP_BACKBONES = ("rectified", "dense")
NAVIGATION_ENCODERS = ("floor", "paper", "paper_small")


@PreTrainedConfig.register_subclass("relmm")
@dataclass
class ReLMMConfig(ControllerConfig):
    """The hierarchical policy of ReLMM (Sun, Orbik et al., CoRL 2021).

    The defaults are the preset `fast`. The presets `paper` and `paper_small` (`relmm/policies/relmm/presets`) hold the
    paper's values; where paper and released code disagree, a comment says which is followed.

    Args:
        camera: geometry of the camera that takes the pictures.
        sample: act as while training (sampled actions, P[grasp] as a probability) instead of greedily.

        grasp_backbone: `rectified` (fully convolutional over a map of the floor) or `dense` (the paper's).
        num_members: networks in the grasp ensemble.
        grasp_channels: width of a network's convolutions.
        grasp_initial_logit: output bias of a fresh network; below 0 because most attempts fail.
        grasp_initial_spread: standard deviation of a fresh rectified network's logits on noise, so that members
            disagree about what they have not seen.
        mean_weight, std_weight: of the ensemble's mean and standard deviation in the choice of a cell.
        gate_mean_weight, gate_std_weight: the same in P[grasp].
        grasp_threshold: mean success above which the greedy policy grasps.
        grasp_learning_rate, grasp_batch_size: of the ensemble's optimiser.
        grasp_updates: per attempt.
        min_failure_loss: until the first success, the ensemble does not learn where its loss is below this: failures
            alone would teach it that nothing can be grasped anywhere, and its members to agree on that.
        background_weight: how much the member that draws the navigation's map learns, from random places beyond reach,
            that nothing can be grasped there.
        offline_grasp_updates: first updates of `lerobot-train`, by which the ensemble learns. Then navigation does: its
            maps and rewards come from the ensemble, and the recorded attempts, learned for too long, teach it that what
            is far is nothing to grasp. 0 for a policy whose ensemble has learned already.
        freeze_grasping: the ensemble learns in the curriculum only.
        num_stationary: attempts of the stationary curriculum.
        min_attempts_to_update: attempts stored before the first update; until then cells are drawn uniformly.
        num_start: failures in a row that end a practice session of the autonomous curriculum without a success.
        num_stop: failures since the last success that end one with a success.
        num_max: attempts, from the first success on, after which the autonomous curriculum ends.

        navigation_encoder: `floor` (map of the floor with grasp probabilities), `paper` or `paper_small` (pictures).
        navigation_hidden: width of the dense layers.
        orderly_search: where the map shows nothing to grasp, turn only to the side where something was in view last,
            and after a full turn, or where collision avoidance comes again and again, drive 1.3 m straight on.
        relabel: reward steps without success with the current P[grasp] - 1 instead of -1.
        relabel_failed: also those whose attempts have failed. The ensemble sees what lies there, not the wall behind it
            that keeps the arm away: a step that is rewarded against the evidence is taken for ever.
        relabel_terminal: a relabelled step also ends the search with probability P[grasp].
        pseudo_reset_share: of a navigation batch that is drawn from the drives of pseudo-resets, relabelled.
        navigation_learning_rate, navigation_batch_size: of SAC's optimiser.
        navigation_updates: per navigation step.
        random_steps: navigation steps with uniform actions at first.
        min_steps_to_update: transitions stored before the first update.
        gamma: discount of a navigation step.
        return_steps: n of the n-step returns that the critics learn from; 1 for pseudo-resets, whose drives are random.
        tau: step of the target networks' moving average.
        actor_tau: step of the moving average of the actor that greedy actions come from; 1 for the actor itself.
        target_entropy: of SAC's temperature.
        initial_temperature: of SAC.
        clip_targets: keep Bellman targets within what rewards of -1 to 0 allow.
        conservative_weight: of conservative Q-learning in `forward`, that is, when LeRobot trains from a dataset alone.
        mirror: learn from mirrored maps of the floor, too.
        recolour: learn from maps of the floor in another light each time.
        tidied_share: of a batch of maps of the floor, in which part of what lay about is gone, to learn how to finish.
        refreshed_maps: frames per update whose stored grasp map and P[grasp] are computed anew by the current ensemble,
            the most outdated of the batch first; 0 for the whole batch.
    """

    camera: str = "paper"
    sample: bool = False

    # --- Grasping -------------------------------------------------------------------------------------------
    grasp_backbone: str = "rectified"
    num_members: int = 6  # M; the appendix calls it N
    grasp_channels: int = 16
    grasp_initial_logit: float = -2.0
    grasp_initial_spread: float = 5.0
    # Paper eq. 2; the authors' code applies both to probabilities, inside the softmax only.
    mean_weight: float = 10.0  # alpha
    std_weight: float = 10.0  # beta
    # Paper eq. 3 would exceed 1 with the weights above; the gate has its own, as in the authors' code.
    gate_mean_weight: float = 1.0
    gate_std_weight: float = 1.0
    grasp_threshold: float = 0.5
    grasp_learning_rate: float = 1e-3
    grasp_batch_size: int = 64
    grasp_updates: int = 4
    min_failure_loss: float = 0.1
    background_weight: float = 0.3
    offline_grasp_updates: int = 600
    freeze_grasping: bool = False
    # Curricula (paper 4.4 and App. "Grasping Curriculum").
    num_stationary: int = 200  # N_st
    min_attempts_to_update: int = 8  # N_bt
    num_start: int = 2  # N_start
    num_stop: int = 20  # N_stop
    num_max: int = 400  # N_max

    # --- Navigation -----------------------------------------------------------------------------------------
    navigation_encoder: str = "floor"
    navigation_hidden: int = 256
    orderly_search: bool = True
    relabel: bool = True
    relabel_failed: bool = False
    relabel_terminal: bool = True
    pseudo_reset_share: float = 0.5
    navigation_learning_rate: float = 5e-4
    navigation_batch_size: int = 128
    navigation_updates: int = 2
    random_steps: int = 50
    min_steps_to_update: int = 100
    gamma: float = 0.98
    return_steps: int = 3
    tau: float = 0.01
    actor_tau: float = 0.01
    target_entropy: float = 0.0  # with less, it only ever turns as fast as it can
    initial_temperature: float = 0.1
    clip_targets: bool = True
    conservative_weight: float = 0.5
    mirror: bool = True
    recolour: bool = True
    tidied_share: float = 0.5
    refreshed_maps: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        camera_geometry(self.camera)
        _choose("grasp_backbone", self.grasp_backbone, GRASP_BACKBONES)
        _choose("navigation_encoder", self.navigation_encoder, NAVIGATION_ENCODERS)
        if self.navigation_encoder == "floor" and self.grasp_backbone != "rectified":
            raise ConfigError(
                "policy.navigation_encoder=floor draws its map with the rectified ensemble: also choose "
                "--policy.grasp_backbone=rectified, or another encoder."
            )
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if not (math.isfinite(value) and low <= value <= high):
                upper = "" if high == math.inf else f" and at most {high:g}"
                raise ConfigError(f"policy.{name} is {value}, but must be at least {low:g}{upper}.")

    # LeRobot's datasets then give a batch the present frame and as many after it as a navigation step may need.
    @property
    def observation_delta_indices(self) -> list[int]:
        """The present frame and those of the attempts that may follow a navigation step."""
        return list(range(self.num_grasp + 2))

    @property
    def action_delta_indices(self) -> list[int]:
        """As the observations."""
        return self.observation_delta_indices

    def get_optimizer_preset(self) -> AdamConfig:
        """For `lerobot-train`, which has one optimiser; the learning rates are in the policy's parameter groups."""
        return AdamConfig(lr=self.navigation_learning_rate, weight_decay=0.0, grad_clip_norm=math.inf)

    def fingerprint(self) -> dict[str, Any]:
        """What a checkpoint must share with a run that goes on from it: the shapes of the networks."""
        names = ("camera", "grasp_backbone", "num_members", "grasp_channels", "navigation_encoder", "navigation_hidden")
        return {name: getattr(self, name) for name in names}


_TINY = 1e-8
_RANGES: dict[str, tuple[float, float]] = {
    "num_members": (1, 100),
    "grasp_channels": (1, 1024),
    "grasp_initial_logit": (-20, 20),
    "grasp_initial_spread": (0, 20),
    "mean_weight": (0, math.inf),
    "std_weight": (0, math.inf),
    "gate_mean_weight": (0, math.inf),
    "gate_std_weight": (0, math.inf),
    "grasp_threshold": (0, 1),
    "grasp_learning_rate": (_TINY, 1),
    "grasp_batch_size": (1, math.inf),
    "grasp_updates": (0, math.inf),
    "min_failure_loss": (0, math.inf),
    "background_weight": (0, math.inf),
    "offline_grasp_updates": (0, math.inf),
    "num_stationary": (1, math.inf),
    "min_attempts_to_update": (1, math.inf),
    "num_start": (1, math.inf),
    "num_stop": (1, math.inf),
    "num_max": (1, math.inf),
    "navigation_hidden": (1, 4096),
    "navigation_learning_rate": (_TINY, 1),
    "navigation_batch_size": (1, math.inf),
    "navigation_updates": (0, math.inf),
    "random_steps": (0, math.inf),
    "min_steps_to_update": (1, math.inf),
    "gamma": (_TINY, 0.9999),
    "return_steps": (1, 100),
    "tau": (_TINY, 1),
    "actor_tau": (_TINY, 1),
    "target_entropy": (-100, 100),
    "initial_temperature": (_TINY, math.inf),
    "pseudo_reset_share": (0, 0.9),
    "conservative_weight": (0, math.inf),
    "tidied_share": (0, 1),
    "refreshed_maps": (0, math.inf),
}


def _choose(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ConfigError(f"policy.{name} is {value!r}: choose one of {', '.join(known)}.")
