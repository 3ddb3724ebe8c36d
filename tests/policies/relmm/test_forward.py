"""What `forward` learns from LeRobot's batches."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

import relmm.plugin  # noqa: F401
from relmm.errors import ConfigError
from relmm.features import ACTION_NAMES, IMAGE_KEY, STATE_KEY, Skill, action_dict
from relmm.policies.controller import grasp_cell
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy
from relmm.policies.relmm.navigation import NavigationBatch, from_navigation_steps

MakePolicy = Callable[..., ReLMMPolicy]
# Batches of LeRobot's are large enough, and are learned from as they are.
PLAIN = {
    "offline_grasp_updates": 0,
    "grasp_batch_size": 1,
    "navigation_batch_size": 1,
    "mirror": False,
    "recolour": False,
    "tidied_share": 0.0,
}
Frame = tuple[NDArray[np.uint8], dict[str, float], float]  # picture, action, reward
DRIVE = action_dict(x_vel=0.3, theta_vel=-40.0)
DRIVEN = (0.28, -37.0)  # by the wheels, m/s and deg/s


@pytest.fixture
def green(make_green: MakePolicy) -> ReLMMPolicy:
    return make_green(**PLAIN)


def as_batch(policy: ReLMMPolicy, episode: list[Frame], frames: list[int]) -> dict[str, Tensor]:
    """What LeRobot's dataset gives for some frames: beyond the episode's ends, its first or last frame again."""

    def look(deltas: list[int]) -> tuple[list[list[Frame]], Tensor]:
        wanted = [[frame + delta for delta in deltas] for frame in frames]
        rows = [[episode[min(max(index, 0), len(episode) - 1)] for index in row] for row in wanted]
        return rows, torch.tensor([[not 0 <= index < len(episode) for index in row] for row in wanted])

    deltas = policy.config.observation_delta_indices
    rows, padded = look(deltas)
    action_rows, action_padded = look(policy.config.action_delta_indices)
    return {
        IMAGE_KEY: torch.from_numpy(np.stack([[f[0] for f in row] for row in rows])).permute(0, 1, 4, 2, 3) / 255,
        "action": torch.tensor([[[f[1][name] for name in ACTION_NAMES] for f in row] for row in action_rows]),
        "next.reward": torch.tensor([row[0][2] for row in rows]),
        STATE_KEY: torch.tensor(
            [[[*(DRIVEN if delta > 0 else (0.1, 20.0)), *[0.0] * 8] for delta in deltas] for _ in frames]
        ),
        "index": torch.tensor(frames),
        f"{IMAGE_KEY}_is_pad": padded,
        "action_is_pad": action_padded,
    }


def make_episode(draw, *outcomes: str) -> list[Frame]:
    """An episode of drives (d), failed attempts (f), successes (s) and placements (p), each with its own picture."""
    actions = {"d": DRIVE, "f": grasp_cell(40), "s": grasp_cell(112), "p": action_dict(Skill.PLACE)}
    return [
        (
            draw(100 + index, color=(0, 18 + 5 * index, 0)),
            actions[outcome],
            float(outcome == "s"),
        )
        for index, outcome in enumerate(outcomes)
    ]


def expected_batch(policy: ReLMMPolicy, episode: list[Frame], after: int, success: bool) -> NavigationBatch:
    """The transition of the drive in frame 0."""
    pictures = torch.cat([policy.to_pictures(episode[frame][0]) for frame in (0, after)])
    attempted = episode[1][1]["skill.pos"] == Skill.GRASP
    chance = 0.0 if attempted else policy.grasping.grasp_probability(policy.grasping.estimate(pictures))[1].item()
    observations = policy.observer(pictures, policy.grasping)
    return NavigationBatch(
        observations[:1],
        torch.ones(1),
        from_navigation_steps(torch.tensor([list(DRIVE.values())])),
        torch.tensor([[0.0 if success else chance - 1]]),
        observations[1:],
        -torch.ones(1),
        torch.tensor([[0.0 if success else 1 - chance]]),
        torch.tensor([1]),
        torch.tensor([[DRIVEN]]),
    )


@pytest.mark.parametrize(
    ("outcomes", "after", "success"),
    [
        ("dd", 1, False),
        ("dfd", 2, False),
        ("dffd", 3, False),
        ("dpd", 1, False),
        ("ddfs", 1, False),
        ("ds", 1, True),
        ("dfs", 2, True),
        ("df", 1, False),
        ("dff", 1, False),
    ],
)
def test_forward_learns_a_drive_as_the_replay_knows_it(outcomes, after, success, green: ReLMMPolicy, draw) -> None:
    """Its own row tells what the robot saw and did; those of the attempts after it, in any order, what came of it."""
    episode = make_episode(draw, *outcomes)
    attempts = [frame for frame, (_, action, _) in enumerate(episode) if action["skill.pos"] == Skill.GRASP]
    for frames in ([0, *attempts], [*attempts[::-1], 0]):
        torch.manual_seed(7)
        logs = green.forward(as_batch(green, episode, frames))[1]
        assert logs is not None
        torch.manual_seed(7)
        batch, noise = expected_batch(green, episode, after, success), torch.randn(2, 1, 2)
        wanted = green.navigation.loss(batch, noise, offline=True)[1]
        assert {name: logs[name] for name in wanted} == pytest.approx(wanted, rel=1e-4)


@pytest.mark.parametrize("outcomes", ["d", "dfffd", "dfffs"])
def test_forward_skips_a_drive_whose_outcome_it_does_not_see(outcomes: str, green: ReLMMPolicy, draw) -> None:
    """Nothing follows it, or a curriculum's attempts, of which there may be more than a batch holds."""
    loss, logs = green.forward(as_batch(green, make_episode(draw, *outcomes), [0]))
    assert loss.item() == 0.0
    assert logs == {}
    loss.backward()


def test_forward_learns_attempts_with_the_loss_of_the_ensemble(green: ReLMMPolicy, draw) -> None:
    episode = make_episode(draw, *"dffsp")
    loss, logs = green.forward(as_batch(green, episode, [1, 3, 4]))
    pictures = torch.cat([green.to_pictures(episode[frame][0]) for frame in (1, 3)])
    attempts = green.grasping.loss(pictures, torch.tensor([40, 112]), torch.tensor([0.0, 1.0])).item()
    assert logs == {"grasp_loss": pytest.approx(attempts / green.config.num_members)}
    rng = torch.Generator().manual_seed(0)
    others = torch.cat([green.to_pictures(episode[frame][0]) for frame in (1, 3, 4)])
    background = green.observer.background_loss(others, green.grasping, rng, offline=True).item()
    assert loss.item() == pytest.approx(attempts + green.config.background_weight * background, rel=1e-3)


def test_forward_adds_both_losses_and_update_moves_the_targets(make_policy_of: MakePolicy, draw) -> None:
    policy = make_policy_of(seed=1, background_weight=0.0, conservative_weight=0.0, **PLAIN)
    episode = make_episode(draw, *"dfdfs")
    batch = as_batch(policy, episode, range(5))
    loss, logs = policy.forward(batch)
    parts = logs["grasp_loss"] * policy.config.num_members + logs["critic_loss"] + logs["actor_loss"]
    entropy_gap = -logs["entropy"] + policy.config.target_entropy
    assert loss.item() == pytest.approx(parts - logs["temperature"] * entropy_gap, rel=1e-4)
    loss.backward()
    torch.optim.Adam(policy.get_optim_params()).step()
    target = next(policy.navigation.targets.parameters())
    before = target.clone()
    policy.update()
    assert not torch.equal(target, before)


def test_forward_remembers_maps_by_number_but_not_those_of_another_dataset(green: ReLMMPolicy, draw) -> None:
    """The same numbers with other pictures are other frames; the ensemble may have moved on meanwhile."""
    losses = []
    for life in ("dfds", "ddfs"):
        batch = as_batch(green, make_episode(draw, *life), [0, 2])
        for known in (batch.keys() - {"index"}, batch, batch):
            torch.manual_seed(7)
            green.rng.manual_seed(7)
            losses.append(green.forward({name: batch[name] for name in known})[0].item())
    assert losses[0] == pytest.approx(losses[1]) == pytest.approx(losses[2])
    assert losses[3] == pytest.approx(losses[4]) == pytest.approx(losses[5])
    assert losses[0] != pytest.approx(losses[3])


@pytest.fixture
def shown(monkeypatch) -> Callable[[ReLMMPolicy], dict[str, list[Any]]]:
    """What a policy's two losses are computed from, by module."""

    def watch(policy: ReLMMPolicy) -> dict[str, list[Any]]:
        seen: dict[str, list[Any]] = {"grasping": [], "navigation": []}
        for name, arguments in seen.items():
            loss = getattr(policy, name).loss

            def record(*given, loss=loss, seen=arguments, **options):
                seen.append(given[0])
                return loss(*given, **options)

            monkeypatch.setattr(getattr(policy, name), "loss", record)
        return seen

    return watch


@pytest.mark.parametrize("grasp_updates", [0, 2])
def test_forward_tops_up_small_batches_with_what_earlier_ones_showed(
    grasp_updates: int, make_policy_of: MakePolicy, draw, shown
) -> None:
    """Loading is slow; to learn twice from what was loaded is not. What is new is always there."""
    sizes = {"grasp_batch_size": 20, "navigation_batch_size": 30, "offline_grasp_updates": grasp_updates}
    policy = make_policy_of(**PLAIN | sizes).train()
    seen, episode = shown(policy), make_episode(draw, *"ddfds")
    for frames in ([0, 2], [1, 3, 4]):
        policy.forward(as_batch(policy, episode, frames))
    pictures = [policy.to_pictures(picture)[0] for picture, _, _ in episode]
    if grasp_updates:
        assert seen["navigation"] == []
        assert [len(batch) for batch in seen["grasping"]] == [20, 20]
        assert torch.equal(seen["grasping"][1][0], pictures[4])
        assert any(torch.equal(each, pictures[2]) for each in seen["grasping"][1][1:])
    else:
        assert seen["grasping"] == []
        assert [len(batch.rewards) for batch in seen["navigation"]] == [30, 30]
        maps = [policy.observer(picture[None], policy.grasping)[0] for picture in pictures]
        assert torch.equal(seen["navigation"][1].observations[0], maps[1])
        assert any(torch.equal(each, maps[0]) for each in seen["navigation"][1].observations[2:])


def test_forward_learns_to_grasp_and_then_to_navigate(make_policy_of: MakePolicy, draw, tmp_path: Path) -> None:
    """Also if it goes on from a checkpoint. Navigation learns from maps that are no longer changing."""
    policy = make_policy_of(**PLAIN | {"offline_grasp_updates": 2}).train()
    learned = []
    for _ in range(4):
        optimizer = torch.optim.Adam(policy.get_optim_params())
        loss, logs = policy.forward(as_batch(policy, make_episode(draw, *"dfds"), range(4)))
        loss.backward()
        optimizer.step()
        policy.update()
        learned.append((set(logs) & {"grasp_loss", "critic_loss"}).pop())
        policy.save_pretrained(tmp_path)
        policy = ReLMMPolicy.from_pretrained(tmp_path).train()
    assert learned == ["grasp_loss", "grasp_loss", "critic_loss", "critic_loss"]


def test_forward_judges_both_while_it_does_not_train(make_policy_of: MakePolicy, draw, shown) -> None:
    """Each frame that LeRobot holds out, and no other."""
    policy = make_policy_of(**PLAIN | {"grasp_batch_size": 3, "navigation_batch_size": 4})
    seen, episode = shown(policy), make_episode(draw, *"ddfds")
    for frames in ([2], [1, 3, 4]):
        policy.forward(as_batch(policy, episode, frames))
    assert [len(pictures) for pictures in seen["grasping"]] == [1, 1]
    assert [len(batch.rewards) for batch in seen["navigation"]] == [1]


def test_forward_waits_until_it_knows_what_came_of_a_step(make_policy_of: MakePolicy, draw, shown) -> None:
    """LeRobot shuffles: the attempts after a step may be in a later batch."""
    policy = make_policy_of(**PLAIN).train()
    seen, episode = shown(policy), make_episode(draw, *"ddfs")
    loss, logs = policy.forward(as_batch(policy, episode, [1]))
    assert (loss.item(), logs) == (0.0, {})
    policy.forward(as_batch(policy, episode, [2, 0]))
    assert seen["navigation"][-1].rewards.tolist() != [[0.0]], "the second drive is waiting for the second attempt"
    policy.forward(as_batch(policy, episode, [3]))
    assert seen["navigation"][-1].rewards.tolist() == [[0.0]]
    assert len(seen["navigation"]) == 2


def test_forward_begins_anew_when_it_remembers_too_much(make_policy_of: MakePolicy, draw, shown, monkeypatch) -> None:
    monkeypatch.setattr("relmm.policies.relmm.offline.CAPACITY", 3)
    policy = make_policy_of(**PLAIN | {"navigation_batch_size": 100}).train()
    seen, episode = shown(policy), make_episode(draw, *"dddddddd")
    old = policy.observer(policy.to_pictures(episode[0][0]), policy.grasping)[0]
    for frames in ([0, 1, 2], [3, 4, 5], [5, 6]):
        policy.forward(as_batch(policy, episode, frames))
    remembered = [any(torch.equal(each, old) for each in batch.observations) for batch in seen["navigation"]]
    assert remembered == [True, False, False]
    assert [len(batch.rewards) for batch in seen["navigation"]] == [100, 100, 100]


def test_forward_learns_from_tidier_maps(make_policy_of: MakePolicy, draw, shown) -> None:
    policy = make_policy_of(
        **PLAIN | {"tidied_share": 1.0, "navigation_batch_size": 50}, grasp_initial_logit=5.0
    ).train()
    seen, episode = shown(policy), make_episode(draw, *"dd")
    policy.forward(as_batch(policy, episode, [0]))
    whole = policy.observer(policy.to_pictures(episode[0][0]), policy.grasping)[0, 0]
    graspable = seen["navigation"][0].observations[:, 0]
    assert ((graspable == whole) | (graspable == 0)).all()
    assert (graspable != whole).flatten(1).any(dim=1).float().mean() > 0.9


def test_dataset_without_rewards_is_refused(green: ReLMMPolicy, draw) -> None:
    batch = as_batch(green, make_episode(draw, *"dd"), [0])
    batch["next.reward"] = 0.0  # which LeRobot's processors put in where there is none
    with pytest.raises(ConfigError, match=r"no column next\.reward"):
        green.forward(batch)
