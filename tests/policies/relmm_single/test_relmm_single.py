from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from numpy.typing import NDArray
from torch import Tensor, nn

from relmm.errors import ConfigError
from relmm.features import (
    BASKET_XY,
    GRASP_X,
    GRASP_Y,
    IMAGE_KEY,
    MAX_THETA_VEL,
    MAX_X_VEL,
    STATE_KEY,
    STATE_NAMES,
    Phase,
    Skill,
    action_dict,
    in_grasp_area,
)
from relmm.policies.controller import Row
from relmm.policies.relmm_single.configuration_relmm_single import RelmmSingleConfig
from relmm.policies.relmm_single.mixed import Batch, MixedSac
from relmm.policies.relmm_single.modeling_relmm_single import RelmmSinglePolicy

STATE = np.zeros(len(STATE_NAMES), np.float32)
SMALL = {"device": "cpu", "encoder": "paper_small", "hidden": 16, "batch_size": 8, "min_steps_to_update": 3}
KINDS = {"d": Skill.NAVIGATE, "r": Skill.NAVIGATE, "f": Skill.GRASP, "s": Skill.GRASP, "p": Skill.PLACE}
MakePolicy = Callable[..., RelmmSinglePolicy]


@pytest.fixture(scope="module")
def make_policy() -> MakePolicy:
    return lambda **settings: RelmmSinglePolicy(RelmmSingleConfig(**{**SMALL, **settings})).eval()


def picture(number: int) -> NDArray[np.uint8]:
    return np.random.default_rng(number).integers(0, 256, (100, 100, 3), np.uint8)


def prefer(policy: RelmmSinglePolicy, *outputs: float) -> None:
    """Make the actor say this whatever it sees: logits, then means and log-deviations of drive and place."""
    last = policy.sac.actor.head[-1]
    assert isinstance(last, nn.Linear)
    nn.init.zeros_(last.weight)
    last.bias.data = torch.tensor(outputs)


def observed(policy: RelmmSinglePolicy, seed: int = 0) -> Row:
    row = Row(np.random.default_rng(seed))
    policy.observe(picture(0), STATE, row)
    return row


def take(policy: RelmmSinglePolicy, life: str, capacity: int = 100) -> Any:
    learner, number = policy.make_learner(seed=0, capacity=capacity), 0
    for episode in life.split():
        for kind in episode:
            action = action_dict(KINDS[kind], x_vel=0.1, theta_vel=number, x=0.4, y=0.01)
            phase = Phase.PSEUDO_RESET if kind in "rp" else Phase.LEARNING
            learner.add(picture(number), STATE, np.array(list(action.values()), np.float32), kind == "s", phase)
            number += 1
        learner.save_episode()
    return learner


# --- Settings ------------------------------------------------------------------------------------------------
def test_values_out_of_range_are_refused_by_name() -> None:
    for name, (low, high) in RelmmSingleConfig.ranges.items():
        for bad in (low - 1, high + 1, math.nan):
            with pytest.raises(ConfigError, match=f"policy.{name} is {bad}, but must be at least"):
                RelmmSingleConfig(device="cpu", **{name: bad})
    with pytest.raises(ConfigError, match=r"policy\.encoder is 'lidar': choose one of paper, paper_small"):
        RelmmSingleConfig(device="cpu", encoder="lidar")


def test_saved_and_loaded_it_acts_the_same(make_policy: MakePolicy, tmp_path) -> None:
    policy = make_policy(seed=4)
    policy.steps_seen.fill_(77)
    policy.save_pretrained(tmp_path)
    loaded = RelmmSinglePolicy.from_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path) == policy.config
    assert loaded.steps_seen == 77
    actions = [each.decide(picture(0), STATE, observed(each)) for each in (policy, loaded.eval())]
    assert actions[0] == actions[1]


# --- Acting --------------------------------------------------------------------------------------------------
def test_greedy_policy_does_the_likelier_with_its_mean(make_policy: MakePolicy) -> None:
    policy = make_policy()
    prefer(policy, 0.0, 0.3, 0.0, -0.5, 0.5, 0.0, *[0.0] * 4)
    grasp = policy.decide(picture(0), STATE, observed(policy))
    middle = [np.mean(GRASP_X) + math.tanh(0.5) * np.ptp(GRASP_X) / 2, np.mean(GRASP_Y)]
    assert list(grasp.values()) == pytest.approx([0, 0, Skill.GRASP, *middle])
    prefer(policy, 0.3, 0.0, 0.0, -0.5, 0.5, 0.0, *[0.0] * 4)
    drive = policy.decide(picture(0), STATE, observed(policy))
    assert list(drive.values()) == pytest.approx([MAX_X_VEL / 2, math.tanh(-0.5) * MAX_THETA_VEL, 0, 0, 0])


@pytest.mark.parametrize(("seen", "chance"), [(9, 0.5), (10, 0.2)])
def test_sampling_policy_grasps_by_its_chance_and_anywhere_at_first(seen, chance, make_policy: MakePolicy) -> None:
    policy = make_policy(sample=True, random_steps=10)
    policy.steps_seen.fill_(seen)
    prefer(policy, math.log(0.8), math.log(0.2), *[0.0] * 4, *[-1.0] * 4)
    row, actions = observed(policy), []
    for _ in range(300):
        actions.append(policy.decide(picture(0), STATE, row))
    grasps = [action for action in actions if action["skill.pos"] == Skill.GRASP]
    assert len(grasps) / 300 == pytest.approx(chance, abs=4 * math.sqrt(chance * (1 - chance) / 300))
    assert all(in_grasp_area(action["skill_x.pos"], action["skill_y.pos"]) for action in grasps)
    assert (len({action["skill_x.pos"] for action in grasps}) == 1) == (seen == 10), "one observation, one drawn place"


def test_it_drives_on_after_many_attempts_in_a_row(make_policy: MakePolicy, make_batch) -> None:
    policy = make_policy(max_attempts=3)
    prefer(policy, -9.0, 9.0, *[0.0] * 8)
    batch = make_batch(picture(0))
    assert [int(policy.select_action(batch)[0, 2]) for _ in range(8)] == [1, 1, 1, 0] * 2
    held = policy.select_action(make_batch(picture(0), holding=(0,)))[0]
    assert held.tolist() == pytest.approx([0, 0, Skill.PLACE, *BASKET_XY])


# --- Steps ---------------------------------------------------------------------------------------------------
def test_each_drive_and_each_attempt_is_a_step(make_policy: MakePolicy) -> None:
    learner = take(make_policy(), "dffdsrprd d")
    table = learner.steps.table
    assert table["skill"].tolist() == [0, 1, 1, 0, 1]
    assert table["theta_vel"].tolist() == [0, 1, 2, 3, 4]
    assert table["ended"].tolist() == [False] * 4 + [True]
    after = learner.steps.pictures[table["next"]]
    assert all(np.array_equal(after[index], picture(index + 1)) for index in range(4))
    assert learner.attempts_since_first_success == 1
    assert learner.policy.steps_seen == 5


def test_forward_takes_the_steps_that_the_replay_knows(make_policy: MakePolicy) -> None:
    policy, life = make_policy(), "dffs"
    learner = take(policy, life)
    pictures = np.stack([[picture(n), picture(min(n + 1, 3))] for n in range(4)])
    actions = [action_dict(KINDS[kind], 0.1, float(n), 0.4, 0.01) for n, kind in enumerate(life)]
    batch = {
        IMAGE_KEY: torch.from_numpy(pictures).permute(0, 1, 4, 2, 3) / 255,
        f"{IMAGE_KEY}_is_pad": torch.tensor([[False, n == 3] for n in range(4)]),
        "action": torch.tensor([list(action.values()) for action in actions]),
        "next.reward": torch.tensor([0.0, 0.0, 0.0, 1.0]),
    }
    torch.manual_seed(1)
    loss, logs = policy.forward(batch)
    torch.manual_seed(1)
    wanted, wanted_logs = policy.sac.loss(learner.batch(np.arange(4)), torch.randn(2, 4, 4))
    assert loss.item() == pytest.approx(wanted.item(), rel=1e-4)
    assert logs == pytest.approx(wanted_logs, rel=1e-3)
    states = torch.zeros(4, 2, len(STATE_NAMES))
    states[3, 1, STATE_NAMES.index("holding.pos")] = 1.0
    del batch["next.reward"]
    torch.manual_seed(1)
    assert policy.forward({**batch, STATE_KEY: states})[0].item() == pytest.approx(loss.item())
    with pytest.raises(ConfigError, match=r"no column next\.reward"):
        policy.forward(batch)


# --- Soft actor-critic ---------------------------------------------------------------------------------------
@pytest.fixture
def batch() -> Batch:
    rng = torch.Generator().manual_seed(0)
    pictures = torch.randint(0, 256, (2, 6, 3, 100, 100), dtype=torch.uint8, generator=rng)
    choices, successes = torch.tensor([0, 1, 0, 1, 1, 0]), torch.tensor([False, True, False, False, True, False])
    return Batch(pictures[0], choices, torch.rand(6, 4, generator=rng) * 2 - 1, pictures[1], successes)


def values(networks: nn.ModuleList, pictures: Tensor, actions: Tensor) -> Tensor:
    return torch.stack([network(pictures, actions) for network in networks])


def test_loss_is_that_of_the_expectation_over_the_choice(batch: Batch) -> None:
    sac = MixedSac(RelmmSingleConfig(**{**SMALL, "initial_temperature": 0.3}))
    sac.log_temperatures.data[1] = math.log(0.7)
    noise = torch.randn(2, 6, 4)
    loss, logs = sac.loss(batch, noise)
    following, now = sac.decide(batch.next_pictures, noise[1]), sac.decide(batch.pictures, noise[0])
    total = 0.0
    for row in range(6):
        soft = 0.0
        for k in range(2):
            chance, log_density = following.log_chances[row, k].exp(), following.log_densities[row, k]
            reached = min(values(sac.targets, batch.next_pictures, following.actions)[:, row, k].tolist())
            soft += chance.item() * (reached - 0.3 * log_density.item() - 0.7 * following.log_chances[row, k].item())
        target = 0.0 if batch.successes[row] else -1 + 0.99 * soft
        for critic in values(sac.critics, batch.pictures, batch.actions)[:, row, int(batch.choices[row])].tolist():
            total += (critic - target) ** 2 / 12
    assert logs["critic_loss"] == pytest.approx(total, rel=1e-4)
    cost = 0.0
    for row in range(6):
        for k in range(2):
            reached = min(values(sac.critics, batch.pictures, now.actions)[:, row, k].tolist())
            terms = 0.3 * now.log_densities[row, k].item() + 0.7 * now.log_chances[row, k].item() - reached
            cost += now.log_chances[row, k].exp().item() * terms / 6
    assert logs["actor_loss"] == pytest.approx(cost, rel=1e-4)
    loss.backward()
    assert all(weight.grad is None for weight in sac.targets.parameters())


def test_temperatures_rise_where_the_entropy_is_too_low(batch: Batch) -> None:
    """The choice is nearly certain; drives and places are as random as can be."""
    sac = MixedSac(RelmmSingleConfig(**SMALL))
    last = sac.actor.head[-1]
    nn.init.zeros_(last.weight)
    last.bias.data = torch.tensor([5.0, -5.0, *[0.0] * 8])
    sac.loss(batch, torch.randn(2, 6, 4))[0].backward()
    gradient = sac.log_temperatures.grad
    assert gradient[0] > 0 > gradient[1]


# --- It learns -----------------------------------------------------------------------------------------------
def test_it_learns_to_grasp_where_there_is_something_and_to_drive_elsewhere(make_policy: MakePolicy) -> None:
    """A grasp succeeds where the picture is red; a drive leads to a red one."""
    settings = {"hidden": 64, "learning_rate": 1e-3, "batch_size": 16, "gamma": 0.5, "initial_temperature": 0.05}
    policy = make_policy(**settings, choice_entropy=0.1, seed=0)
    rng, learner = np.random.default_rng(0), policy.make_learner(seed=0, capacity=500)

    def scene(red: bool) -> NDArray[np.uint8]:
        image = rng.integers(0, 60, (100, 100, 3), np.uint8)
        image[..., 0 if red else 2] += np.uint8(180)
        return image

    for _ in range(250):
        red, grasp = bool(rng.random() < 0.5), bool(rng.random() < 0.5)
        x, y = rng.uniform(GRASP_X[0], GRASP_X[1]), rng.uniform(*GRASP_Y)
        action = action_dict(Skill.GRASP, x=x, y=y) if grasp else action_dict(x_vel=rng.uniform(0, 0.4))
        learner.add(scene(red), STATE, np.array(list(action.values()), np.float32), grasp and red, Phase.LEARNING)
        learner.add(
            scene(red or not grasp), STATE, np.array(list(action_dict().values()), np.float32), False, Phase.LEARNING
        )
        learner.save_episode()
    for _ in range(90):
        learner.update_navigation()
    chances = []
    for red in (True, False):
        pictures = torch.from_numpy(np.stack([scene(red) for _ in range(10)])).permute(0, 3, 1, 2)
        chances.append(policy.sac.decide(pictures, torch.zeros(10, 4)).log_chances[:, 1].exp().mean().item())
    assert chances[0] > 0.7 > 0.3 > chances[1]
