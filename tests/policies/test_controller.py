from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_policy, make_pre_post_processors

from relmm.errors import ConfigError
from relmm.features import (
    ACTION_NAMES,
    BASKET_XY,
    IMAGE_KEY,
    MAX_THETA_VEL,
    MAX_X_VEL,
    STATE_KEY,
    STATE_NAMES,
    Skill,
    in_grasp_area,
)
from relmm.sim.config_relmm_room import RelmmRoomEnvConfig

KINDS = ["relmm_random", "relmm_scripted"]

pytestmark = pytest.mark.parametrize("kind", KINDS)


def pictures(count: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (count, 100, 100, 3), np.uint8)


def run(policy: Any, batch: dict[str, torch.Tensor], steps: int) -> torch.Tensor:
    return torch.stack([policy.select_action(batch) for _ in range(steps)])


def test_actions_have_the_shape_type_and_range_that_the_robot_takes(kind, make_controller, make_batch, empty) -> None:
    actions = run(make_controller(kind), make_batch(empty, *pictures(2)), 30)
    assert actions.shape == (30, 3, len(ACTION_NAMES))
    assert actions.dtype == torch.float32
    for x_vel, theta_vel, skill, x, y in actions.reshape(-1, 5).tolist():
        assert 0 <= x_vel <= MAX_X_VEL + 1e-6
        assert abs(theta_vel) <= MAX_THETA_VEL + 1e-6
        assert skill == Skill.NAVIGATE or (skill == Skill.GRASP and in_grasp_area(x, y))


def test_a_batch_gives_each_robot_what_it_gets_alone(kind, make_controller, make_batch, empty) -> None:
    """Robots of a batch are episodes 0, 1, 2 of a controller that meets them one after the other."""
    images = [empty, *pictures(2)]
    together = run(make_controller(kind, seed=3), make_batch(*images), 10)
    alone = make_controller(kind, seed=3)
    for index, image in enumerate(images):
        assert torch.equal(run(alone, make_batch(image), 10)[:, 0], together[:, index])
        alone.reset()


def test_what_is_held_goes_into_the_basket(kind, make_controller, make_batch, empty) -> None:
    actions = make_controller(kind).select_action(make_batch(empty, empty, holding=(1,)))
    assert actions[0, 2] == Skill.NAVIGATE
    assert actions[1].tolist() == pytest.approx([0, 0, Skill.PLACE, *BASKET_XY])


def test_each_episode_has_random_numbers_of_its_own_and_a_seed_repeats_them(
    kind, make_controller, make_batch, empty
) -> None:
    def two_episodes(seed: int) -> torch.Tensor:
        policy, batch = make_controller(kind, seed=seed), make_batch(empty)
        first = run(policy, batch, 40)
        policy.reset()
        return torch.stack([first, run(policy, batch, 40)])

    episodes = two_episodes(5)
    assert not torch.equal(episodes[0], episodes[1])
    assert torch.equal(episodes, two_episodes(5))
    assert not torch.equal(episodes, two_episodes(6))


def test_saved_and_loaded_it_does_the_same(kind, make_controller, make_batch, empty, tmp_path: Path) -> None:
    policy = make_controller(kind, seed=4, num_grasp=3)
    policy.save_pretrained(tmp_path)
    loaded = get_policy_class(kind).from_pretrained(tmp_path)
    assert loaded.config == policy.config
    batch = make_batch(empty)
    assert torch.equal(run(policy, batch, 10), run(loaded, batch, 10))


def test_lerobot_makes_it_for_the_room(kind, make_batch, empty) -> None:
    config = PreTrainedConfig.get_choice_class(kind)(device="cpu")
    policy = make_policy(config, env_cfg=RelmmRoomEnvConfig())
    assert type(policy) is get_policy_class(kind)
    before, after = make_pre_post_processors(config)
    action = after(policy.select_action(before(make_batch(empty))))
    assert action.shape == (1, len(ACTION_NAMES))


def test_processors_change_nothing(kind, make_controller, make_batch) -> None:
    before, after = make_pre_post_processors(make_controller(kind).config)
    batch, action = make_batch(*pictures(2)), torch.rand(2, len(ACTION_NAMES))
    assert all(torch.equal(before(batch)[key], batch[key]) for key in (IMAGE_KEY, STATE_KEY))
    assert torch.equal(after(action), action)


def test_a_chunk_is_one_action(kind, make_controller, make_batch, empty) -> None:
    chunk = make_controller(kind).predict_action_chunk(make_batch(empty, empty))
    assert chunk.shape == (2, 1, len(ACTION_NAMES))


def test_it_does_not_learn(kind, make_controller, make_batch, empty) -> None:
    policy = make_controller(kind)
    assert policy.get_optim_params() == []
    with pytest.raises(ConfigError, match=f"{kind} has nothing to train"):
        policy.forward(make_batch(empty))


def test_a_state_without_velocities_is_refused(kind, make_controller, make_batch, empty) -> None:
    """As `lerobot-rollout` of lerobot 0.6.0 gives it; the policy would read other numbers than it thinks."""
    batch = make_batch(empty)
    batch[STATE_KEY] = batch[STATE_KEY][:, 2:]
    words = rf"holds {len(STATE_NAMES) - 2} numbers instead of {len(STATE_NAMES)}, x\.vel to .*lerobot 0\.6\.1"
    with pytest.raises(ConfigError, match=words):
        make_controller(kind).select_action(batch)


@pytest.mark.parametrize(
    ("features", "message"),
    [
        ({STATE_KEY: PolicyFeature(FeatureType.STATE, (len(STATE_NAMES),))}, "needs a picture .*, but there is none"),
        ({IMAGE_KEY: PolicyFeature(FeatureType.VISUAL, (3, 64, 64))}, r"but there is one of shape \(3, 64, 64\)"),
        ({IMAGE_KEY: PolicyFeature(FeatureType.VISUAL, (3, 100, 100))}, "needs observation.state to hold x.vel, "),
    ],
)
def test_other_robots_are_refused(kind, features: dict[str, PolicyFeature], message: str) -> None:
    config = PreTrainedConfig.get_choice_class(kind)(device="cpu", input_features=features)
    with pytest.raises(ConfigError, match=message):
        get_policy_class(kind)(config)


def test_an_observation_that_was_watched_is_not_observed_again(kind, make_controller, make_batch, empty) -> None:
    policy, observed = make_controller(kind), []
    policy.observe = lambda image, state, row: observed.append(image)
    batch, row = make_batch(empty), policy.row(0)
    policy.select_action(batch)
    policy.observe(empty, batch[STATE_KEY][0].numpy(), row)  # as `Actor.watch` does
    row.observed = True
    assert len(observed) == 2
    policy.select_action(batch)
    assert len(observed) == 2
    policy.select_action(batch)
    assert len(observed) == 3, "the next one is another"


@pytest.mark.parametrize(("setting", "value"), [("num_grasp", 0), ("seed", -1)])
def test_impossible_settings_are_refused(kind, setting: str, value: int, make_controller) -> None:
    with pytest.raises(ConfigError, match=rf"policy.{setting} is {value}"):
        make_controller(kind, **{setting: value})
