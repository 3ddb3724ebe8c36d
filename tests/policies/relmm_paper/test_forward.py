"""What `forward` learns from LeRobot's batches."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_pre_post_processors
from lerobot.transforms import ImageTransforms, ImageTransformsConfig
from torch import Tensor
from torch.utils.data import default_collate

from relmm.errors import ConfigError
from relmm.features import FPS, IMAGE_KEY, STATE_KEY, STATE_NAMES, Phase, Skill, cell_to_xy
from relmm.policies.relmm_paper.modeling_relmm_paper import RelmmPaperPolicy
from relmm.policies.relmm_paper.navigation import NavigationBatch
from relmm.policies.relmm_paper.replay import to_pictures

RECORDED = Path(__file__).parents[3] / "datasets" / "first_attempts"
STATE = np.zeros(len(STATE_NAMES), np.float32)
CPU = torch.device("cpu")
MakePolicy = Callable[..., RelmmPaperPolicy]


@pytest.fixture
def as_batch(numbered, action_of) -> Callable[..., dict[str, Tensor]]:
    """What LeRobot's dataset gives for some frames of an episode: beyond its end, the last frame again."""

    def batch(episode: str, frames: list[int], num_grasp: int = 2) -> dict[str, Tensor]:
        last = len(episode) - 1
        rows = [[frame + delta for delta in range(num_grasp + 2)] for frame in frames]
        shown = [[min(frame, last) for frame in row] for row in rows]
        pictures = np.stack([[numbered(frame) for frame in row] for row in shown])
        return {
            IMAGE_KEY: torch.from_numpy(pictures).permute(0, 1, 4, 2, 3) / 255,
            "action": torch.from_numpy(np.stack([[action_of(episode[f], f) for f in row] for row in shown])),
            "next.reward": torch.tensor([float(episode[frame] == "s") for frame in frames]),
            "index": torch.tensor(frames),
            f"{IMAGE_KEY}_is_pad": torch.tensor([[frame > last for frame in row] for row in rows]),
        }

    return batch


@pytest.fixture
def shown(monkeypatch) -> Callable[[RelmmPaperPolicy], dict[str, list[tuple[Any, ...]]]]:
    """What a policy's two losses are computed from, by module."""

    def watch(policy: RelmmPaperPolicy) -> dict[str, list[tuple[Any, ...]]]:
        seen: dict[str, list[tuple[Any, ...]]] = {"grasping": [], "navigation": []}
        for name, calls in seen.items():
            loss = getattr(policy, name).loss

            def record(*given, loss=loss, calls=calls):
                calls.append(given)
                return loss(*given)

            monkeypatch.setattr(getattr(policy, name), "loss", record)
        return seen

    return watch


def steps_of(calls: list[tuple[Any, ...]]) -> list[NavigationBatch]:
    return [batch for batch, _ in calls]


# --- What is learned from ------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("episode", "after", "success"),
    [
        ("dd", 1, False),
        ("dfd", 2, False),
        ("dffd", 3, False),
        ("dpd", 1, False),
        ("ds", 1, True),
        ("dfs", 1, True),  # where it led does not matter: the search has ended
        ("dsp", 2, True),
        ("df", 1, False),
        ("dff", 1, False),
    ],
)
def test_forward_learns_a_drive_as_the_replay_knows_it(
    episode: str, after: int, success: bool, make_policy: MakePolicy, as_batch, shown, numbered, number_of, fill
) -> None:
    """Its own row tells what the robot saw and did; those of the attempts after it, in any order, what came of it."""
    attempts = [frame for frame, kind in enumerate(episode) if kind in "fs"]
    policy = make_policy(seed=1, relabel=True)
    seen = shown(policy)
    pictures = to_pictures(np.stack([numbered(0), numbered(after)]), CPU)
    chance = policy.grasping.grasp_probability(policy.grasping.estimate(pictures))[1].item()
    for frames in ([0, *attempts], [*attempts[::-1], 0]):
        policy.forward(as_batch(episode, frames))
    for batch in steps_of(seen["navigation"]):
        assert torch.equal(batch.pictures, pictures[:1])
        assert torch.equal(batch.next_pictures, pictures[1:])
        assert batch.actions.tolist() == [[-1.0, 0.0]]
        assert batch.rewards.item() == pytest.approx(0.0 if success else chance - 1, abs=1e-5)
        assert batch.continues.item() == (not success)
    assert len(seen["navigation"]) == 2
    replay = fill([episode])
    assert replay.steps.table["ended"][0] == success
    assert success or number_of(replay.steps.pictures[replay.steps.table["next"][:1]][0]) == after


@pytest.mark.parametrize("episode", ["d", "dfffd", "dfffs"])
def test_forward_skips_a_drive_whose_outcome_it_does_not_see(episode: str, make_policy, as_batch) -> None:
    """Nothing follows it, or a curriculum's attempts, of which there may be more than a batch holds."""
    loss, logs = make_policy().forward(as_batch(episode, [0]))
    assert loss.item() == 0.0
    assert logs == {}
    loss.backward()


def test_forward_learns_attempts_with_the_loss_of_the_ensemble(make_policy, as_batch, numbered) -> None:
    policy = make_policy(seed=1)
    loss, logs = policy.forward(as_batch("dffsp", [1, 3, 4]))
    pictures = to_pictures(np.stack([numbered(1), numbered(3)]), CPU)
    wanted, wanted_logs = policy.grasping.loss(
        pictures, torch.from_numpy(cell_to_xy(np.array([1, 3]))), torch.tensor([False, True])
    )
    assert loss.item() == pytest.approx(wanted.item())
    assert logs == pytest.approx(wanted_logs)


def test_forward_adds_both_losses_and_update_moves_the_targets(make_policy: MakePolicy, as_batch) -> None:
    policy = make_policy(seed=1)
    loss, logs = policy.forward(as_batch("dfdfs", range(5)))
    parts = logs["grasp_loss"] * policy.config.num_members + logs["critic_loss"] + logs["actor_loss"]
    entropy_gap = -logs["entropy"] + policy.config.target_entropy
    assert loss.item() == pytest.approx(parts - logs["temperature"] * entropy_gap, rel=1e-4)
    loss.backward()
    torch.optim.Adam(policy.get_optim_params()).step()
    target = next(policy.navigation.targets.parameters())
    before = target.clone()
    policy.update()
    assert not torch.equal(target, before)


# --- Batches in any order ------------------------------------------------------------------------------------
def test_forward_waits_until_it_knows_what_came_of_a_step(make_policy: MakePolicy, as_batch, shown) -> None:
    """LeRobot shuffles: the attempts after a step may be in a later batch."""
    policy = make_policy().train()
    seen = shown(policy)
    loss, logs = policy.forward(as_batch("ddfs", [1]))
    assert (loss.item(), logs) == (0.0, {})
    policy.forward(as_batch("ddfs", [2, 0]))
    assert len(seen["navigation"]) == 1, "the second drive is waiting for the second attempt"
    policy.forward(as_batch("ddfs", [3]))
    policy.forward(as_batch("ddfs", [1]))
    assert [batch.continues.tolist() for batch in steps_of(seen["navigation"])] == [[1.0], [0.0], [0.0]]
    assert (policy.attempts_seen, policy.steps_seen) == (2, 3)


def test_forward_judges_frames_alone_while_it_does_not_train(make_policy: MakePolicy, as_batch, shown) -> None:
    policy = make_policy()
    seen = shown(policy)
    for frames in ([0, 1], [2]):
        policy.forward(as_batch("dds", frames))
    assert [len(batch.rewards) for batch in steps_of(seen["navigation"])] == [1]
    assert (policy.attempts_seen, policy.steps_seen) == (0, 0)


def test_frames_of_several_datasets_are_told_apart(make_policy: MakePolicy, as_batch, shown) -> None:
    policy = make_policy().train()
    seen = shown(policy)
    step, attempt = as_batch("ds", [0]), as_batch("ds", [1])
    policy.forward({**attempt, "dataset_index": torch.tensor([1])})
    policy.forward({**step, "dataset_index": torch.tensor([0])})
    assert seen["navigation"] == []
    policy.forward({**attempt, "dataset_index": torch.tensor([0])})
    assert [batch.continues.tolist() for batch in steps_of(seen["navigation"])] == [[0.0]]


def test_forward_forgets_steps_that_wait_in_vain(make_policy: MakePolicy, as_batch, shown, monkeypatch) -> None:
    monkeypatch.setattr("relmm.policies.relmm_paper.offline._WAITING", 2)
    policy = make_policy().train()
    seen = shown(policy)
    policy.forward(as_batch("dfdfdfd", [0, 2, 4]))
    policy.forward(as_batch("dfdfdfd", [1, 3, 5]))
    assert [len(batch.rewards) for batch in steps_of(seen["navigation"])] == [2]


# --- LeRobot's datasets --------------------------------------------------------------------------------------
def frames_of(policy: RelmmPaperPolicy, **settings: Any) -> list[dict[str, Any]]:
    deltas = [delta / FPS for delta in policy.config.observation_delta_indices]
    columns = {IMAGE_KEY: deltas, "action": deltas}
    driving = list(range(57, 70))  # episodes after the curriculum
    dataset = LeRobotDataset(
        "local/sample", root=RECORDED, delta_timestamps=columns, episodes=driving, return_uint8=False, **settings
    )
    return list(dataset)


def test_stock_training_computes_the_losses_of_learning_online(make_policy) -> None:
    """LeRobot's dataset, batches and preprocessor against the replay."""
    policy = make_policy(seed=2)
    frames = frames_of(policy)
    learner, episode = policy.make_learner(seed=0, capacity=len(frames)), 0
    for frame in frames:
        if frame["episode_index"] != episode:
            learner.save_episode()
        episode = frame["episode_index"]
        picture = (frame[IMAGE_KEY][0] * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()
        learner.add(picture, STATE, frame["action"][0].numpy(), bool(frame["next.reward"] > 0), Phase.LEARNING)
    learner.save_episode()

    batch = make_pre_post_processors(policy.config)[0](default_collate(frames))
    torch.manual_seed(3)
    loss, logs = policy.forward(batch)

    replay = learner.replay
    torch.manual_seed(3)
    count = len(replay.steps)
    navigation_loss, wanted = policy.navigation.loss(
        learner.navigation_batch(np.arange(count)), torch.randn(2, count, 2)
    )
    pictures = to_pictures(replay.attempt_pictures[replay.attempts["picture"]], CPU)
    x, y, successes = (torch.from_numpy(replay.attempts[name]) for name in ("x", "y", "success"))
    grasp_loss, grasp_logs = policy.grasping.loss(pictures, torch.stack([x, y], dim=1), successes)
    assert successes.any()
    assert count > 20
    assert logs == pytest.approx({**grasp_logs, **wanted}, rel=1e-3)
    assert loss.item() == pytest.approx((grasp_loss + navigation_loss).item(), rel=1e-3)


def test_forward_loses_no_success_to_image_augmentation(make_policy: MakePolicy, shown) -> None:
    """The picture of a frame is another one whenever LeRobot shows it, as part of this row or of that one."""
    policy = make_policy().train()
    seen = shown(policy)
    frames = frames_of(policy, image_transforms=ImageTransforms(ImageTransformsConfig(enable=True)))
    order = np.random.default_rng(0).permutation(len(frames))
    for chosen in np.array_split(order, 8):
        policy.forward(default_collate([frames[index] for index in chosen]))
    skills = [round(float(frame["action"][0, 2])) for frame in frames]
    grasped = [i for i, frame in enumerate(frames) if frame["next.reward"] > 0]
    searched = [next(j for j in range(i - 1, -1, -1) if skills[j] != Skill.GRASP) for i in grasped]
    successes = sum(skills[j] == Skill.NAVIGATE for j in searched)
    ended = sum(float((1 - batch.continues).sum()) for batch in steps_of(seen["navigation"]))
    assert ended == successes > 0
    assert sum(int(given[2].sum()) for given in seen["grasping"]) == len(grasped)


def test_without_rewards_the_next_frame_tells(make_policy: MakePolicy, as_batch) -> None:
    """What the last grasp came to is not known, and a grasp with a full gripper is none."""
    policy = make_policy(seed=2).eval()
    told, batch = as_batch("dfsdpdf", [0, 1, 2, 4, 5]), as_batch("dfsfpdf", [0, 1, 2, 4, 5, 6])
    states = torch.zeros(*batch["action"].shape[:2], len(STATE_NAMES))
    for row, first in enumerate(batch["index"].tolist()):
        for time in range(states.shape[1]):
            states[row, time, STATE_NAMES.index("holding.pos")] = float(first + time in (3, 4))
    losses = []
    for each in ({**batch, "next.reward": 0.0, STATE_KEY: states}, told):
        torch.manual_seed(3)
        losses.append(policy.forward(each)[0].item())
    assert losses[0] == pytest.approx(losses[1], rel=1e-6)


def test_dataset_without_rewards_is_refused(make_policy: MakePolicy, as_batch) -> None:
    batch = as_batch("dd", [0])
    batch["next.reward"] = 0.0  # which LeRobot's processors put in where there is none
    with pytest.raises(ConfigError, match=r"no column next\.reward, .* record one with relmm-record"):
        make_policy().forward(batch)
