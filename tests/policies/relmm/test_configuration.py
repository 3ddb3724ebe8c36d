from __future__ import annotations

import math
from dataclasses import fields

import pytest
from lerobot.configs.policies import PreTrainedConfig

from relmm.errors import ConfigError
from relmm.policies.controller import ControllerConfig
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy

OWN = [field.name for field in fields(ReLMMConfig) if field.name not in {f.name for f in fields(ControllerConfig)}]
NUMBERS = [name for name in OWN if type(getattr(ReLMMConfig, name)) in (int, float)]


def test_lerobot_finds_it_by_its_name(tmp_path) -> None:
    config = PreTrainedConfig.get_choice_class("relmm")(device="cpu", num_members=3, std_weight=2.5, sample=True)
    assert isinstance(config, ReLMMConfig)
    config._save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path) == config


def test_every_number_has_a_range() -> None:
    """So no setting is taken unchecked; `tests/policies/test_learning.py` tries the limits."""
    assert set(ReLMMConfig.ranges) == set(NUMBERS)


@pytest.mark.parametrize("name", NUMBERS)
def test_default_lies_within_its_range(name: str) -> None:
    low, high = ReLMMConfig.ranges[name]
    assert low <= getattr(ReLMMConfig(device="cpu"), name) <= high


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_members", 0),
        ("learning_rate", 0.0),
        ("smoothing", 0.6),
        ("grasp_threshold", 1.1),
        ("unseen_promise", -0.1),
        ("failure_steps", math.nan),
        ("std_weight", math.inf),
    ],
)
def test_what_makes_no_sense_is_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=rf"policy\.{name} is {value}, but must be at least"):
        ReLMMConfig(device="cpu", **{name: value})


def test_batches_hold_the_present_frame_alone() -> None:
    config = ReLMMConfig(device="cpu")
    assert config.observation_delta_indices is config.action_delta_indices is config.reward_delta_indices is None


def test_fingerprint_tells_what_cannot_share_weights_apart(make_config) -> None:
    config = make_config()
    for same in ({"learning_rate": 0.1}, {"sample": True}, {"prior_scale": 1.0}, {"failure_steps": 3.0}):
        assert make_config(**same).fingerprint() == config.fingerprint()
    for other in ({"num_members": 5}, {"channels": 9}, {"camera": "d435"}):
        assert make_config(**other).fingerprint() != config.fingerprint()


def test_lerobot_train_learns_at_the_rate_that_is_set(make_config) -> None:
    preset = make_config(learning_rate=0.02).get_optimizer_preset()
    assert preset.lr == 0.02
    assert preset.weight_decay == 0, "weights of the ensemble are not pulled to 0"
    assert ReLMMPolicy(make_config()).get_optim_params()
