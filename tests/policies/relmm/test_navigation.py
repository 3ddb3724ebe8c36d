from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution

from relmm.policies.relmm.encoders import Encoder, FloorObserver, PictureObserver
from relmm.policies.relmm.navigation import Actor, Navigation, NavigationBatch

SIZE = 5
KINDS = ["floor", "paper_small"]
Seen = tuple[Tensor, Tensor]  # an observation and the side of the last turn
MakeNavigation = Callable[..., Navigation]


class DoubleEncoder(Encoder):
    """The layers of an encoder, in double precision."""

    def __init__(self, encoder: Encoder) -> None:
        nn.Module.__init__(self)
        self.layers, self.on_floor, self.features = encoder.layers, encoder.on_floor, encoder.features
        if encoder.on_floor:
            self.keypoints, self.embed = encoder.keypoints, encoder.embed

    def forward(self, observations: Tensor) -> Tensor:
        scaled = observations.double() / 127.5 - 1
        encoded = self.layers(scaled)
        if not self.on_floor:
            return encoded
        return torch.cat([encoded, self.embed(self.keypoints(scaled))], dim=1)


@pytest.fixture
def make_navigation(make_config) -> MakeNavigation:
    """Builds a navigation in double precision whose target networks differ from its critics."""

    def make(kind: str = "floor", **settings: Any) -> Navigation:
        torch.manual_seed(0)
        config = make_config("rectified" if kind == "floor" else "dense", **settings)
        navigation = Navigation(config).double()
        for module in list(navigation.modules()):
            for name, child in list(module.named_children()):
                if isinstance(child, Encoder):
                    setattr(module, name, DoubleEncoder(child))
        for target in navigation.targets.parameters():
            target += 0.1 * torch.randn_like(target)
        return navigation

    return make


def make_batch(kind: str = "floor") -> NavigationBatch:
    rng = torch.Generator().manual_seed(1)
    shape = FloorObserver.shape if kind == "floor" else PictureObserver.shape
    observations, following = torch.randint(0, 256, (2, SIZE, *shape), dtype=torch.uint8, generator=rng)
    actions = torch.rand(SIZE, 2, dtype=torch.double, generator=rng) * 2 - 1
    sides, next_sides = torch.tensor([[1, -1, 1, -1, 1], [-1, -1, 1, 1, 1]]).double()
    motions = torch.rand(SIZE, 3, 2, dtype=torch.double, generator=rng) - 0.5
    rewards = torch.tensor([[-1.0], [0.0], [-0.4], [-1.0], [-0.9]], dtype=torch.double)
    continues = torch.tensor([[1], [0], [0.6], [1], [1.0]]).double()
    lengths = torch.ones(SIZE, dtype=torch.long)
    return NavigationBatch(observations, sides, actions, rewards, following, next_sides, continues, lengths, motions)


def make_noise() -> Tensor:
    return torch.randn(2, SIZE, 2, dtype=torch.double, generator=torch.Generator().manual_seed(2))


def before(batch: NavigationBatch) -> Seen:
    return batch.observations, batch.sides


def after(batch: NavigationBatch) -> Seen:
    return batch.next_observations, batch.next_sides


# --- The same in other words ---------------------------------------------------------------------------------
def policy_at(navigation: Navigation, observations: Tensor, _: Tensor) -> Independent:
    """The actor's distribution before the tanh."""
    encoder = navigation.actor_encoder or navigation.critics.encoders[0]
    outputs = navigation.actor.net(encoder(observations))
    log_std = outputs[:, 2:]
    if navigation.actor_encoder is None:
        log_std = log_std.clamp(-5, 2)
    return Independent(Normal(outputs[:, :2], log_std.exp()), 1)


def act_at(navigation: Navigation, seen: Seen, noise: Tensor) -> tuple[Tensor, Tensor]:
    gaussian = policy_at(navigation, *seen)
    raw = gaussian.base_dist.loc + gaussian.base_dist.scale * noise
    return raw.tanh(), gaussian.log_prob(raw) - torch.log1p(-raw.tanh().square()).sum(dim=1)


def values_at(critics: Any, seen: Seen, actions: Tensor) -> list[Tensor]:
    encoders = list(critics.encoders) * (2 // len(critics.encoders))
    return [
        head(torch.cat([encoder(seen[0]), actions], dim=1))[:, 0]
        for head, encoder in zip(critics.heads, encoders, strict=True)
    ]


def targets_at(navigation: Navigation, batch: NavigationBatch, noise: Tensor) -> Tensor:
    actions, log_density = act_at(navigation, after(batch), noise)
    first, second = values_at(navigation.targets, after(batch), actions)
    value = torch.minimum(first, second) - navigation.log_temperature.exp() * log_density
    return batch.rewards[:, 0] + navigation.config.gamma * batch.continues[:, 0] * value


def critic_loss(navigation: Navigation, batch: NavigationBatch, targets: Tensor) -> Tensor:
    first, second = values_at(navigation.critics, before(batch), batch.actions)
    return ((first - targets).square().mean() + (second - targets).square().mean()) / 2


def actor_loss(navigation: Navigation, batch: NavigationBatch, noise: Tensor) -> Tensor:
    actions, log_density = act_at(navigation, before(batch), noise)
    first, second = values_at(navigation.critics, before(batch), actions)
    return (navigation.log_temperature.exp() * log_density - torch.minimum(first, second)).mean()


def temperature_loss(navigation: Navigation, batch: NavigationBatch, noise: Tensor) -> Tensor:
    log_density = act_at(navigation, before(batch), noise)[1]
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


def learned(weights: Iterable[Tensor]) -> bool:
    return any(weight.grad is not None and bool(weight.grad.any()) for weight in weights)


# --- Losses --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", KINDS)
def test_loss_is_the_sum_of_the_three_of_sac(kind: str, make_navigation: MakeNavigation) -> None:
    navigation, batch, noise = make_navigation(kind, clip_targets=False), make_batch(kind), make_noise()
    targets = targets_at(navigation, batch, noise[1])
    critics, actor = critic_loss(navigation, batch, targets).item(), actor_loss(navigation, batch, noise[0]).item()
    loss, logs = navigation.loss(batch, noise)
    temperature = temperature_loss(navigation, batch, noise[0]).item()
    assert logs["critic_loss"] == pytest.approx(critics)
    assert logs["actor_loss"] == pytest.approx(actor)
    assert loss.item() == pytest.approx(critics + actor + temperature)
    assert logs["temperature"] == pytest.approx(navigation.config.initial_temperature)
    assert logs["entropy"] == pytest.approx(-act_at(navigation, before(batch), noise[0])[1].mean().item())


@pytest.mark.parametrize("kind", KINDS)
def test_conservatism_adds_what_uniform_actions_seem_better_by(kind: str, make_navigation: MakeNavigation) -> None:
    navigation = make_navigation(kind, conservative_weight=0.7)
    batch, noise = make_batch(kind), make_noise()
    plain = navigation.loss(batch, noise)[0].item()
    torch.manual_seed(5)
    loss = navigation.loss(batch, noise, offline=True)[0].item()
    torch.manual_seed(5)
    critics = navigation.critics
    features = critics.encode(batch.observations)
    others = torch.stack([critics(features, actions) for actions in torch.rand(10, SIZE, 2) * 2 - 1])
    gap = others.exp().mean(dim=0).log() - critics(features, batch.actions)
    assert loss - plain == pytest.approx(0.7 * gap.mean().item())


@pytest.mark.parametrize("kind", KINDS)
def test_each_part_learns_from_its_own_loss_alone(kind: str, make_navigation: MakeNavigation) -> None:
    """The slope of the whole loss along any weight is that of one part, the others held fast."""
    navigation, batch, noise = make_navigation(kind, clip_targets=False), make_batch(kind), make_noise()
    targets = targets_at(navigation, batch, noise[1]).detach()
    navigation.loss(batch, noise)[0].backward()
    own_encoder = [] if navigation.actor_encoder is None else list(navigation.actor_encoder.parameters())
    parts: list[tuple[list[Tensor], Callable[[], Tensor]]] = [
        (list(navigation.critics.parameters()), lambda: critic_loss(navigation, batch, targets)),
        ([*navigation.actor.parameters(), *own_encoder], lambda: actor_loss(navigation, batch, noise[0])),
        ([navigation.log_temperature], lambda: temperature_loss(navigation, batch, noise[0])),
    ]
    for weights, function in parts:
        direction = [torch.randn_like(weight) for weight in weights]
        expected = sum((weight.grad * way).sum().item() for weight, way in zip(weights, direction, strict=True))
        assert expected == pytest.approx(slope(function, weights, direction), rel=1e-4)
    assert all(weight.grad is None for weight in navigation.targets.parameters())
    assert sum(len(weights) for weights, _ in parts) == sum(w.requires_grad for w in navigation.parameters())


def test_encoder_of_the_floor_is_trained_by_the_critics_alone(make_navigation: MakeNavigation) -> None:
    """Where the critics' loss is zero, the actor's must not reach the encoder or the critics."""
    navigation, batch, noise = make_navigation(), make_batch(), make_noise()
    for head in navigation.critics.heads:
        nn.init.zeros_(head[-1].weight)
        nn.init.zeros_(head[-1].bias)
    batch.rewards, batch.continues = torch.zeros(2, SIZE, 1, dtype=torch.double)
    navigation.loss(batch, noise)[0].backward()
    assert not learned(navigation.critics.parameters())
    assert learned(navigation.actor.parameters())
    assert all(weight.requires_grad for weight in navigation.critics.parameters())


# --- Bellman targets -----------------------------------------------------------------------------------------
def constant(navigation: Navigation, *values: float) -> None:
    """Makes the target networks give constant values."""
    for head, value in zip(navigation.targets.heads, values, strict=True):
        nn.init.zeros_(head[-1].weight)
        nn.init.constant_(head[-1].bias, value)


def test_targets_take_the_smaller_value_and_add_entropy(make_navigation: MakeNavigation) -> None:
    navigation, batch, noise = make_navigation(gamma=0.9, clip_targets=False), make_batch(), make_noise()
    constant(navigation, -3.0, -5.0)
    log_density = act_at(navigation, after(batch), noise[1])[1].tolist()
    rows = zip(batch.rewards[:, 0].tolist(), batch.continues[:, 0].tolist(), log_density, strict=True)
    expected = [reward + 0.9 * continues * (-5.0 - 0.1 * density) for reward, continues, density in rows]
    targets = navigation.bellman_targets(batch, noise[1], torch.tensor(0.1, dtype=torch.double))
    assert targets.tolist() == pytest.approx(expected)
    assert targets[1] == 0.0, "a success ends the search"
    assert not targets.requires_grad


@pytest.mark.parametrize(("value", "expected"), [(100.0, 0.0), (-100.0, -10.0)])
def test_targets_stay_within_what_rewards_allow(value: float, expected: float, make_navigation) -> None:
    batch, noise, temperature = make_batch(), make_noise(), torch.tensor(0.1, dtype=torch.double)
    batch.continues = torch.ones(SIZE, 1, dtype=torch.double)
    clipped, free = (make_navigation(gamma=0.9, clip_targets=clip) for clip in (True, False))
    for navigation in (clipped, free):
        constant(navigation, value, value)
    assert clipped.bellman_targets(batch, noise[1], temperature).tolist() == pytest.approx([expected] * SIZE)
    assert free.bellman_targets(batch, noise[1], temperature).abs().min() > 80


def test_target_networks_follow_by_tau(make_navigation: MakeNavigation) -> None:
    navigation = make_navigation(tau=0.25)
    pairs = list(zip(navigation.targets.parameters(), navigation.critics.parameters(), strict=True))
    expected = [0.75 * target + 0.25 * weight.detach() for target, weight in pairs]
    critics = [weight.detach().clone() for _, weight in pairs]
    navigation.update_targets()
    assert all(torch.allclose(target, wanted) for (target, _), wanted in zip(pairs, expected, strict=True))
    assert all(torch.equal(weight, before) for (_, weight), before in zip(pairs, critics, strict=True))


def test_target_networks_begin_as_the_critics_and_are_not_trained(make_config) -> None:
    navigation = Navigation(make_config())
    pairs = zip(navigation.targets.parameters(), navigation.critics.parameters(), strict=True)
    assert all(torch.equal(target, weight) and target is not weight for target, weight in pairs)
    assert not any(target.requires_grad for target in navigation.targets.parameters())


# --- Actor ---------------------------------------------------------------------------------------------------
def fixed_actor(make_config, mean: float, log_std: float, kind: str = "rectified") -> Actor:
    actor = Actor(make_config(kind), 3).double()
    nn.init.zeros_(actor.net[-1].weight)
    actor.net[-1].bias.data.copy_(torch.tensor([mean, -mean, log_std, log_std]))
    return actor


@pytest.mark.parametrize(("mean", "log_std"), [(0.0, 0.0), (0.7, -1.0), (-1.5, 0.5), (0.2, -4.0)])
def test_log_density_is_that_of_torch(mean: float, log_std: float, make_config) -> None:
    noise = torch.randn(200, 2, dtype=torch.double, generator=torch.Generator().manual_seed(0))
    actions, log_density = fixed_actor(make_config, mean, log_std).sample(torch.zeros(200, 3).double(), noise)
    before = Normal(torch.tensor([mean, -mean]).double(), math.exp(log_std))
    inside = (actions.abs() < 0.999).all(dim=1)  # torch inverts the tanh, which is not exact farther out
    expected = TransformedDistribution(before, [TanhTransform()]).log_prob(actions).sum(dim=1)
    assert inside.sum() > 50
    assert torch.allclose(log_density[inside], expected[inside], atol=1e-6)


@pytest.mark.parametrize("mean", [5.0, 20.0, 300.0])
def test_log_density_of_extreme_actions_is_exact(mean: float, make_config) -> None:
    """-log(1 - tanh(x)^2) is 2 log(cosh(x)), which is 2 (|x| - log 2) far out."""
    noise = torch.tensor([[0.3, -1.2]]).double()
    log_density = fixed_actor(make_config, mean, 0.0).sample(torch.zeros(1, 3).double(), noise)[1]
    raw = torch.tensor([mean, -mean]).double() + noise[0]
    log_cosh = raw.abs() + torch.log1p(torch.exp(-2 * raw.abs())) - math.log(2)
    expected = (-0.5 * noise[0] ** 2 - 0.5 * math.log(2 * math.pi) + 2 * log_cosh).sum()
    assert log_density.item() == pytest.approx(expected.item())


@pytest.mark.parametrize(("kind", "expected"), [("rectified", (-5.0, 2.0)), ("dense", (-30.0, 30.0))])
def test_deviation_is_limited_for_the_floor_only(kind: str, expected: tuple[float, float], make_config) -> None:
    limits = [fixed_actor(make_config, 0.0, value, kind)(torch.zeros(1, 3).double())[1] for value in (-30.0, 30.0)]
    assert tuple(limit[0, 0].item() for limit in limits) == expected


@pytest.mark.parametrize("kind", KINDS)
def test_greedy_action_is_the_mean_and_sampled_ones_follow_the_actor(kind: str, make_navigation) -> None:
    navigation = make_navigation(kind)
    observations, sides = (column[:1] for column in before(make_batch(kind)))
    gaussian = policy_at(navigation, observations, sides).base_dist
    assert torch.allclose(navigation.act(observations, sides, None), gaussian.loc.tanh())
    many = observations.expand(200, -1, -1, -1), sides.expand(200)
    raw = navigation.act(*many, torch.Generator().manual_seed(0)).atanh()
    assert torch.allclose(raw.mean(dim=0), gaussian.loc[0], atol=4 * gaussian.scale.max().item() / math.sqrt(200))
    assert torch.allclose(raw.std(dim=0), gaussian.scale[0], rtol=0.2)


@pytest.mark.parametrize("kind", KINDS)
def test_greedy_action_is_that_of_a_moving_average_of_the_actor(kind: str, make_navigation) -> None:
    navigation = make_navigation(kind, actor_tau=0.25)
    encoder = navigation.actor_encoder or navigation.critics.encoders[0]
    pairs = [
        *zip(navigation.mean_actor.parameters(), navigation.actor.parameters(), strict=True),
        *zip(navigation.mean_encoder.parameters(), encoder.parameters(), strict=True),
    ]
    assert all(torch.equal(mean, weight) and not mean.requires_grad for mean, weight in pairs)
    seen = tuple(column[:1] for column in before(make_batch(kind)))
    greedy, old = navigation.act(*seen, None), [mean.clone() for mean, _ in pairs]
    with torch.no_grad():
        for _, weight in pairs:
            weight += 0.1 * torch.randn_like(weight)
    assert torch.equal(navigation.act(*seen, None), greedy), "it has not followed yet"
    navigation.update_targets()
    wanted = [0.75 * mean + 0.25 * weight for mean, (_, weight) in zip(old, pairs, strict=True)]
    assert all(torch.allclose(mean, each) for (mean, _), each in zip(pairs, wanted, strict=True))
    assert not torch.equal(navigation.act(*seen, None), greedy)


@pytest.mark.parametrize("kind", KINDS)
def test_average_over_nothing_is_the_actor_itself(kind: str, make_navigation) -> None:
    """As in the paper."""
    navigation, seen = make_navigation(kind, actor_tau=1.0), before(make_batch(kind))
    with torch.no_grad():
        for weight in navigation.parameters():
            weight += 0.1 * torch.randn_like(weight)
    navigation.update_targets()
    assert torch.allclose(navigation.act(*seen, None), policy_at(navigation, *seen).base_dist.loc.tanh())


# --- Search --------------------------------------------------------------------------------------------------
def with_best(batch: NavigationBatch, graspability: int) -> NavigationBatch:
    """The batch with nothing better to grasp than this."""
    batch.observations[:, 0] = batch.observations[:, 0].clamp(max=graspability)
    batch.observations[:, 0, 4, 7] = graspability
    return batch


@pytest.mark.parametrize(("graspability", "keep", "bound"), [(63, True, True), (64, True, False), (63, False, False)])
@pytest.mark.parametrize("sample", [True, False])
def test_where_nothing_is_in_view_the_robot_turns_on(graspability, keep, bound, sample, make_navigation) -> None:
    """Greedily and sampled; forward, and the order of the turns, are left as they are."""
    free, kept = (make_navigation(orderly_search=on) for on in (False, keep))
    seen = before(with_best(make_batch(), graspability))
    wanted, actions = (n.act(*seen, torch.Generator().manual_seed(0) if sample else None) for n in (free, kept))
    assert torch.equal(actions[:, 0], wanted[:, 0])
    sides = torch.tensor([1, -1, 1, -1, 1]).double()
    assert torch.allclose(actions[:, 1], sides * (1 + wanted[:, 1]) / 2 if bound else wanted[:, 1])


def test_actor_learns_by_the_turns_that_are_made(make_navigation: MakeNavigation) -> None:
    """Its loss is that of the kept turns, at this observation and, in the targets, at the next."""
    navigation, noise = make_navigation(clip_targets=False), make_noise()
    batch = with_best(make_batch(), 30)
    batch.next_observations, batch.next_sides = batch.observations, batch.sides
    sides = torch.tensor([1, -1, 1, -1, 1]).double()
    made = []
    for each in noise:
        raw, log_density = act_at(navigation, before(batch), each)
        made.append((torch.stack([raw[:, 0], sides * (1 + raw[:, 1]) / 2], dim=1), log_density))
    (actions, density), (following, next_density) = made
    first, second = values_at(navigation.critics, before(batch), actions)
    wanted = (0.1 * density - torch.minimum(first, second)).mean().item()
    assert navigation.loss(batch, noise)[1]["actor_loss"] == pytest.approx(wanted)
    first, second = values_at(navigation.targets, before(batch), following)
    value = torch.minimum(first, second) - 0.1 * next_density
    targets = navigation.bellman_targets(batch, noise[1], torch.tensor(0.1, dtype=torch.double))
    assert torch.allclose(targets, batch.rewards[:, 0] + navigation.config.gamma * batch.continues[:, 0] * value)
