from __future__ import annotations

import json
import math
from importlib.resources import files
from typing import Any

import draccus
import pytest
from lerobot.configs.policies import PreTrainedConfig

from relmm.errors import ConfigError
from relmm.policies.relmm_paper.configuration_relmm_paper import RelmmPaperConfig

PRESETS = ("paper", "paper_small", "paper_continuous")

PAPER: dict[str, Any] = {
    "camera": "paper",
    "sample": False,
    # 4.1, Appendix "Model Architectures": M = 6 networks of width 64, alpha = beta = 10, N_grasp = 2, rate 3e-4.
    "num_members": 6,
    "grasp_channels": 64,
    "grasp_input_gain": 255.0,  # what the authors' code does to pixels
    "mean_weight": 10.0,
    "std_weight": 10.0,
    "num_grasp": 2,
    "grasp_learning_rate": 3e-4,
    # The gate and the batches as in the authors' code.
    "gate_mean_weight": 1.0,
    "gate_std_weight": 1.0,
    "grasp_threshold": 0.5,
    "grasp_batch_size": 256,
    "grasp_updates": 1,
    "freeze_grasping": False,
    # 4.4, Appendix "Grasping Curriculum": N_st, N_bt, N_start, N_stop, N_max.
    "num_stationary": 2000,
    "min_attempts_to_update": 300,
    "num_start": 10,
    "num_stop": 50,
    "num_max": 2000,
    # 4.2 and the authors' SAC.
    "navigation_encoder": "paper",
    "navigation_hidden": 512,
    "relabel": False,
    "navigation_learning_rate": 3e-4,
    "navigation_batch_size": 128,
    "navigation_updates": 1,
    "random_steps": 500,
    "min_steps_to_update": 250,
    "gamma": 0.99,
    "tau": 0.005,
    "target_entropy": -2.0,
    "initial_temperature": 1.0,
}
SMALL = {"grasp_channels": 32, "grasp_batch_size": 64, "navigation_encoder": "paper_small", "navigation_batch_size": 64}


# Appendix "Continuous grasping", as in the authors' code.
CONTINUOUS = {
    "grasping": "continuous",
    "num_members": 2,
    "grasp_learning_rate": 1e-4,
    "grasp_batch_size": 256,
    "min_attempts_to_update": 1000,
}


def preset(name: str) -> PreTrainedConfig:
    text = (files("relmm.policies.relmm_paper") / "presets" / f"{name}.json").read_text(encoding="utf-8")
    return draccus.decode(PreTrainedConfig, {**json.loads(text)["policy"], "device": "cpu"})


def bad_values() -> list[tuple[str, float]]:
    cases: list[tuple[str, float]] = []
    for name, (low, high) in RelmmPaperConfig.ranges.items():
        cases += [(name, low - 1), (name, math.nan), (name, math.inf)]
        if high < math.inf:
            cases.append((name, high + 1))
    return cases


@pytest.mark.parametrize(
    ("name", "wanted"),
    [("paper", PAPER), ("paper_small", {**PAPER, **SMALL}), ("paper_continuous", {**PAPER, **CONTINUOUS})],
)
def test_preset_has_the_values_of_the_paper(name: str, wanted: dict[str, Any]) -> None:
    config = preset(name)
    assert isinstance(config, RelmmPaperConfig)
    assert {field: getattr(config, field) for field in wanted} == wanted


def test_preset_paper_is_the_default() -> None:
    assert preset("paper") == RelmmPaperConfig(device="cpu")


@pytest.mark.parametrize("name", PRESETS)
def test_saved_and_loaded_a_preset_is_the_same(name: str, tmp_path) -> None:
    config = preset(name)
    config._save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path) == config


@pytest.mark.parametrize(("name", "value"), bad_values())
def test_value_out_of_range_is_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=rf"policy\.{name} is {value}, but must be at least"):
        RelmmPaperConfig(device="cpu", **{name: value})


@pytest.mark.parametrize("name", RelmmPaperConfig.ranges)
def test_limits_of_a_range_are_allowed(name: str) -> None:
    for value in RelmmPaperConfig.ranges[name]:
        if math.isfinite(value):
            assert getattr(RelmmPaperConfig(device="cpu", **{name: value}), name) == value


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"navigation_encoder": "lidar"}, r"policy\.navigation_encoder is 'lidar': choose one of paper, paper_small"),
        ({"navigation": "slam"}, r"policy\.navigation is 'slam': choose one of sac, random"),
        ({"camera": "webcam"}, "camera 'webcam': choose one of paper, d435"),
    ],
)
def test_unknown_parts_are_refused(settings: dict[str, str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        RelmmPaperConfig(device="cpu", **settings)


@pytest.mark.parametrize("num_grasp", [1, 3])
def test_batches_hold_the_attempts_after_a_step_and_the_picture_after_them(num_grasp: int) -> None:
    config = RelmmPaperConfig(device="cpu", num_grasp=num_grasp)
    wanted = list(range(num_grasp + 2))
    assert config.observation_delta_indices == wanted
    assert config.reward_delta_indices is None, "LeRobot cannot stream several numbers of a column"
    assert config.action_delta_indices == wanted


def test_fingerprint_tells_networks_of_other_shapes_apart() -> None:
    config = RelmmPaperConfig(device="cpu")
    same = RelmmPaperConfig(device="cpu", grasp_learning_rate=1e-4, sample=True, gamma=0.9)
    assert same.fingerprint() == config.fingerprint()
    for change in (
        {"num_members": 5},
        {"camera": "d435"},
        {"navigation_encoder": "paper_small"},
        {"grasp_channels": 9},
    ):
        assert RelmmPaperConfig(device="cpu", **change).fingerprint() != config.fingerprint()
