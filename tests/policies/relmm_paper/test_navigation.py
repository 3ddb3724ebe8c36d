from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution

from relmm.features import MAX_THETA_VEL, MAX_X_VEL, Skill
from relmm.policies.relmm_paper.configuration_relmm_paper import CHOICES
from relmm.policies.relmm_paper.navigation import (
    Actor,
    Critics,
    Encoder,
    Navigation,
    NavigationBatch,
    from_navigation_steps,
    to_navigation_step,
)

SIZE = 5
MakeNavigation = Callable[..., Navigation]


@pytest.fixture
def make_navigation(make_config, monkeypatch) -> MakeNavigation:
    """Builds a navigation in double precision whose target networks differ from its critics."""

    def make(**settings: Any) -> Navigation:
        torch.manual_seed(0)
        navigation = Navigation(make_config(**settings)).double()
        monkeypatch.setattr("relmm.policies.relmm_paper.navigation.scaled", lambda each: each.double() / 127.5 - 1)
        for target in navigation.targets.parameters():
            target += 0.1 * torch.randn_like(target)
        return navigation

    return make


@pytest.fixture
def batch() -> NavigationBatch:
    rng = torch.Generator().manual_seed(1)
    pictures, following = torch.randint(0, 256, (2, SIZE, 3, 100, 100), dtype=torch.uint8, generator=rng)
    actions = torch.rand(SIZE, 2, dtype=torch.double, generator=rng) * 2 - 1
    rewards, continues = torch.tensor([[-1.0, 0.0, -0.4, -1.0, -0.9], [1, 0, 1, 1, 1]], dtype=torch.double)
    return NavigationBatch(pictures, actions, rewards, following, continues)


@pytest.fixture
def noise() -> Tensor:
    return torch.randn(2, SIZE, 2, dtype=torch.double, generator=torch.Generator().manual_seed(2))


# --- The same in other words ---------------------------------------------------------------------------------
def act_at(navigation: Navigation, pictures: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    outputs = navigation.actor.head(navigation.actor.encoder(pictures))
    gaussian = Independent(Normal(outputs[:, :2], outputs[:, 2:].exp()), 1)
    raw = gaussian.base_dist.loc + gaussian.base_dist.scale * noise
    return raw.tanh(), gaussian.log_prob(raw) - torch.log1p(-raw.tanh().square()).sum(dim=1)


def values_at(critics: Critics, pictures: Tensor, actions: Tensor) -> list[Tensor]:
    pairs = zip(critics.heads, critics.encoders, strict=True)
    return [head(torch.cat([encoder(pictures), actions], dim=1))[:, 0] for head, encoder in pairs]


def targets_at(navigation: Navigation, batch: NavigationBatch, noise: Tensor) -> Tensor:
    actions, log_density = act_at(navigation, batch.next_pictures, noise)
    first, second = values_at(navigation.targets, batch.next_pictures, actions)
    value = torch.minimum(first, second) - navigation.log_temperature.exp() * log_density
    return batch.rewards + navigation.config.gamma * batch.continues * value


def critic_loss(navigation: Navigation, batch: NavigationBatch, targets: Tensor) -> Tensor:
    first, second = values_at(navigation.critics, batch.pictures, batch.actions)
    return ((first - targets).square().mean() + (second - targets).square().mean()) / 2


def actor_loss(navigation: Navigation, batch: NavigationBatch, noise: Tensor) -> Tensor:
    actions, log_density = act_at(navigation, batch.pictures, noise)
    first, second = values_at(navigation.critics, batch.pictures, actions)
    return (navigation.log_temperature.exp() * log_density - torch.minimum(first, second)).mean()


def temperature_loss(navigation: Navigation, batch: NavigationBatch, noise: Tensor) -> Tensor:
    log_density = act_at(navigation, batch.pictures, noise)[1]
    return -navigation.log_temperature.exp() * (log_density + navigation.config.target_entropy).mean()


def slope(function: Callable[[], Tensor], weights: list[Tensor], direction: list[Tensor], step: float = 1e-7) -> float:
    """Finite difference of a function of weights in a direction."""
    results = []
    with torch.no_grad():
        for sign in (1, -1):
            for weight, way in zip(weights, direction, strict=True):
                weight += sign * step * way
            results.append(function().item())
            for weight, way in zip(weights, direction, strict=True):
                weight -= sign * step * way
    return (results[0] - results[1]) / (2 * step)


# --- Networks ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", CHOICES["navigation_encoder"])
def test_features_have_the_promised_length(kind: str, noise_pictures) -> None:
    encoder = Encoder(kind)
    assert encoder(noise_pictures(2)).shape == (2, encoder.features)


def test_paper_encoder_is_that_of_the_authors() -> None:
    encoder = Encoder("paper")
    assert encoder.features == 9216
    assert sum(weight.numel() for weight in encoder.parameters()) == 75_648


def test_encoder_scales_its_input_to_plus_and_minus_1() -> None:
    encoder = Encoder("paper_small")
    seen: list[Tensor] = []
    encoder.layers[0].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    encoder(torch.tensor([0, 255], dtype=torch.uint8)[:, None, None, None].expand(2, 3, 100, 100))
    assert [float(values.min()) for values in seen[0]] == [float(values.max()) for values in seen[0]] == [-1.0, 1.0]


def test_networks_begin_as_in_keras(make_config) -> None:
    """Glorot: uniform within sqrt(6 / (inputs + outputs)), without bias; the targets begin as the critics."""
    navigation = Navigation(make_config(navigation_hidden=64))
    layers = [layer for layer in navigation.modules() if isinstance(layer, nn.Conv2d | nn.Linear)]
    assert len(layers) == 5 * (3 + 3)
    for layer in layers:
        taps = layer.weight[0, 0].numel() if isinstance(layer, nn.Conv2d) else 1
        limit = math.sqrt(6 / (taps * sum(layer.weight.shape[:2])))
        assert 0.85 * limit < layer.weight.abs().max() <= limit
        assert not layer.bias.any()


def test_target_networks_begin_as_the_critics_and_are_not_trained(make_config) -> None:
    navigation = Navigation(make_config())
    pairs = zip(navigation.targets.parameters(), navigation.critics.parameters(), strict=True)
    assert all(torch.equal(target, weight) and target is not weight for target, weight in pairs)
    assert not any(target.requires_grad for target in navigation.targets.parameters())


def test_no_two_networks_share_weights(make_config) -> None:
    navigation = Navigation(make_config())
    networks = [navigation.actor, navigation.critics, navigation.targets]
    counts = [len(list(network.parameters())) for network in networks]
    assert sum(counts) + 1 == len(list(navigation.parameters()))
    first, second = (list(encoder.parameters()) for encoder in navigation.critics.encoders)
    assert not torch.equal(first[0], second[0])


# --- Losses --------------------------------------------------------------------------------------------------
def test_loss_is_the_sum_of_the_three_of_sac(make_navigation: MakeNavigation, batch, noise) -> None:
    navigation = make_navigation(initial_temperature=0.3)
    targets = targets_at(navigation, batch, noise[1])
    critics, actor = critic_loss(navigation, batch, targets).item(), actor_loss(navigation, batch, noise[0]).item()
    loss, logs = navigation.loss(batch, noise)
    temperature = temperature_loss(navigation, batch, noise[0]).item()
    assert logs["critic_loss"] == pytest.approx(critics)
    assert logs["actor_loss"] == pytest.approx(actor)
    assert loss.item() == pytest.approx(critics + actor + temperature)
    assert logs["temperature"] == pytest.approx(0.3)
    assert logs["entropy"] == pytest.approx(-act_at(navigation, batch.pictures, noise[0])[1].mean().item())


def test_logs_tell_whether_pictures_matter(make_navigation: MakeNavigation, batch, noise) -> None:
    navigation = make_navigation()
    mean, log_std = navigation.actor(batch.pictures)
    logs = navigation.loss(batch, noise)[1]
    assert logs["actor_spread"] == pytest.approx(np.std(mean.tanh().tolist(), axis=0).mean(), rel=1e-4)
    assert logs["actor_std"] == pytest.approx(log_std.exp().mean().item(), rel=1e-4)
    values = navigation.critics(navigation.critics.encode(batch.pictures), batch.actions)
    assert logs["value_spread"] == pytest.approx(np.std(values.tolist(), axis=1).mean(), rel=1e-4)
    same = batch.pictures[:1].expand_as(batch.pictures)
    logs = navigation.loss(dataclasses.replace(batch, pictures=same), noise)[1]
    assert logs["actor_spread"] == pytest.approx(0, abs=1e-5)


def test_each_part_learns_from_its_own_loss_alone(make_navigation: MakeNavigation, batch, noise) -> None:
    """The slope of the whole loss along any weight is that of one part, the others held fast."""
    navigation = make_navigation()
    targets = targets_at(navigation, batch, noise[1]).detach()
    navigation.loss(batch, noise)[0].backward()
    parts: list[tuple[list[Tensor], Callable[[], Tensor]]] = [
        (list(navigation.critics.parameters()), lambda: critic_loss(navigation, batch, targets)),
        (list(navigation.actor.parameters()), lambda: actor_loss(navigation, batch, noise[0])),
        ([navigation.log_temperature], lambda: temperature_loss(navigation, batch, noise[0])),
    ]
    for weights, function in parts:
        direction = [torch.randn_like(weight) for weight in weights]
        expected = sum((weight.grad * way).sum().item() for weight, way in zip(weights, direction, strict=True))
        assert expected == pytest.approx(slope(function, weights, direction), rel=1e-4)
    assert all(weight.grad is None for weight in navigation.targets.parameters())
    assert sum(len(weights) for weights, _ in parts) == sum(w.requires_grad for w in navigation.parameters())


# --- Bellman targets -----------------------------------------------------------------------------------------
def test_targets_take_the_smaller_value_and_add_entropy(make_navigation: MakeNavigation, batch, noise) -> None:
    navigation = make_navigation(gamma=0.9)
    for head, value in zip(navigation.targets.heads, (-3.0, -5.0), strict=True):
        nn.init.zeros_(head[-1].weight)
        nn.init.constant_(head[-1].bias, value)
    log_density = act_at(navigation, batch.next_pictures, noise[1])[1].tolist()
    rows = zip(batch.rewards.tolist(), batch.continues.tolist(), log_density, strict=True)
    expected = [reward + 0.9 * continues * (-5.0 - 0.1 * density) for reward, continues, density in rows]
    targets = navigation.bellman_targets(batch, noise[1], torch.tensor(0.1, dtype=torch.double))
    assert targets.tolist() == pytest.approx(expected)
    assert targets[1] == 0.0, "a success ends the search"
    assert not targets.requires_grad


def test_target_networks_follow_by_tau(make_navigation: MakeNavigation) -> None:
    navigation = make_navigation(tau=0.25)
    pairs = list(zip(navigation.targets.parameters(), navigation.critics.parameters(), strict=True))
    expected = [0.75 * target + 0.25 * weight.detach() for target, weight in pairs]
    critics = [weight.detach().clone() for _, weight in pairs]
    navigation.update_targets()
    assert all(torch.allclose(target, wanted) for (target, _), wanted in zip(pairs, expected, strict=True))
    assert all(torch.equal(weight, before) for (_, weight), before in zip(pairs, critics, strict=True))


# --- Actor ---------------------------------------------------------------------------------------------------
def fixed_actor(make_config, mean: list[float], log_std: list[float]) -> Actor:
    actor = Actor(make_config())
    nn.init.zeros_(actor.head[-1].weight)
    actor.head[-1].bias.data = torch.tensor([*mean, *log_std])
    return actor


def test_samples_and_densities_are_those_of_a_tanh_gaussian(make_config, noise_pictures) -> None:
    mean, log_std = [0.7, -1.5], [-0.5, 0.3]
    actor, pictures = fixed_actor(make_config, mean, log_std), noise_pictures(4)
    noise = torch.randn(4, 2, generator=torch.Generator().manual_seed(3))
    actions, log_density = actor.sample(pictures, noise)
    gaussian = Normal(torch.tensor(mean), torch.tensor(log_std).exp())
    wanted = TransformedDistribution(gaussian, TanhTransform(cache_size=1))
    raw = torch.tensor(mean) + torch.tensor(log_std).exp() * noise
    assert torch.allclose(actions, raw.tanh(), atol=1e-6)
    assert torch.allclose(log_density, wanted.log_prob(wanted.transforms[0](raw)).sum(dim=1), atol=1e-4)


def test_density_of_extreme_actions_is_finite(make_config, noise_pictures) -> None:
    actor = fixed_actor(make_config, [40.0, -40.0], [0.0, 0.0])
    log_density = actor.sample(noise_pictures(1), torch.zeros(1, 2))[1]
    # log N(0; 0, 1) - log(1 - tanh(40)^2), which is 4 exp(-80), for both.
    assert log_density.item() == pytest.approx(-math.log(2 * math.pi) + 2 * (80 - math.log(4)), rel=1e-5)


def test_greedy_action_is_the_mean_and_a_sampled_one_is_not(make_config, noise_pictures) -> None:
    navigation = Navigation(make_config())
    navigation.actor = fixed_actor(make_config, [0.5, -0.2], [-1.0, 0.0])
    pictures = noise_pictures(120)
    assert torch.allclose(navigation.act(pictures[:2], None), torch.tensor([0.5, -0.2]).tanh().expand(2, -1))
    raw = navigation.act(pictures, np.random.default_rng(0)).atanh()
    assert raw.mean(dim=0).tolist() == pytest.approx([0.5, -0.2], abs=0.2)
    assert raw.std(dim=0).tolist() == pytest.approx([math.exp(-1), 1.0], rel=0.2)


# --- Actions -------------------------------------------------------------------------------------------------
def test_navigation_actions_convert_there_and_back() -> None:
    actions = torch.tensor([[-1.0, -1.0], [-1.0, 0.0], [0.0, 0.5], [1.0, 1.0], [0.3, -0.7]])
    steps = [list(to_navigation_step(action).values()) for action in actions.tolist()]
    assert torch.allclose(from_navigation_steps(torch.tensor(steps)), actions, atol=1e-6)
    assert steps[1] == [0.0, 0.0, Skill.NAVIGATE, 0.0, 0.0], "-1 forward stands still"
    assert steps[3][:2] == [MAX_X_VEL, MAX_THETA_VEL], "positive turns left"


def test_navigation_steps_beyond_the_range_are_clipped() -> None:
    """A robot that bumped drives backwards."""
    steps = torch.tensor([[-0.2, 200.0, 0, 0, 0], [0.9, -200.0, 0, 0, 0]])
    assert from_navigation_steps(steps).tolist() == [[-1.0, 1.0], [1.0, -1.0]]
