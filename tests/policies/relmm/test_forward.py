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
from relmm.features import ACTION_NAMES, IMAGE_KEY, STATE_KEY, STATE_NAMES, Phase, Skill, action_dict
from relmm.policies.controller import grasp_cell
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy

RECORDED = Path(__file__).parents[3] / "datasets" / "first_attempts"
STATE = np.zeros(len(STATE_NAMES), np.float32)
SKILLS = {"d": Skill.NAVIGATE, "f": Skill.GRASP, "s": Skill.GRASP, "p": Skill.PLACE}
MakePolicy = Callable[..., ReLMMPolicy]


def picture(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 256, (100, 100, 3), np.uint8)


def action_of(kind: str, number: int) -> list[float]:
    cell = grasp_cell(number * 7 % 225)
    x, y = cell["skill_x.pos"], cell["skill_y.pos"]
    return [action_dict(SKILLS[kind], 0.1, 20.0, x, y)[name] for name in ACTION_NAMES]


def as_batch(frames: str, first: int = 0) -> dict[str, Any]:
    """What LeRobot gives for frames: drives (d), attempts that fail (f) or do not (s), placements (p)."""
    numbers = range(first, first + len(frames))
    return {
        IMAGE_KEY: torch.from_numpy(np.stack([picture(number) for number in numbers])).permute(0, 3, 1, 2) / 255,
        "action": torch.tensor([action_of(kind, number) for kind, number in zip(frames, numbers, strict=True)]),
        "next.reward": torch.tensor([float(kind == "s") for kind in frames]),
        "index": torch.tensor(numbers),
    }


@pytest.fixture
def shown(monkeypatch) -> Callable[[ReLMMPolicy], list[tuple[Tensor, Tensor, Tensor]]]:
    """What a policy's loss is computed from."""

    def watch(policy: ReLMMPolicy) -> list[tuple[Tensor, Tensor, Tensor]]:
        seen: list[tuple[Tensor, Tensor, Tensor]] = []
        loss = policy.grasping.loss
        monkeypatch.setattr(policy.grasping, "loss", lambda *given: (seen.append(given), loss(*given))[1])
        return seen

    return watch


def test_the_loss_is_that_of_learning_online(make_policy: MakePolicy) -> None:
    policy, frames = make_policy(seed=2), "dfsfpfdsf"
    learner = policy.make_learner(seed=0, capacity=50)
    for number, kind in enumerate(frames):
        learner.add(picture(number), STATE, np.array(action_of(kind, number), np.float32), kind == "s", Phase.LEARNING)
    wanted, wanted_logs = policy.grasping.loss(*learner.attempts.all(torch.device("cpu")))
    loss, logs = policy.forward(as_batch(frames))
    assert loss.item() == pytest.approx(wanted.item(), rel=1e-6)
    assert logs == wanted_logs
    assert loss.requires_grad


def test_while_it_does_not_train_a_batch_is_judged_alone(make_policy: MakePolicy, shown) -> None:
    policy = make_policy().train()
    policy.forward(as_batch("ssss", first=50))
    policy.eval()
    seen = shown(policy)
    for _ in range(2):
        policy.forward(as_batch("dfs"))
    assert [successes.tolist() for _, _, successes in seen] == [[False, True]] * 2
    assert len(policy._attempts) == 4, "and not remembered"


def test_while_training_it_learns_from_earlier_batches_too(make_policy: MakePolicy, shown) -> None:
    policy = make_policy(batch_size=200, seed=1).train()
    seen = shown(policy)
    for first, frames in ((0, "ff"), (2, "ds"), (4, "dd")):
        policy.forward(as_batch(frames, first))
    assert [len(cells) for _, cells, _, _ in seen] == [200] * 3
    last = set(zip(seen[-1][1].tolist(), seen[-1][2].tolist(), strict=True))
    assert last == {(0, False), (7, False), (21, True)}


def test_a_frame_that_is_shown_again_counts_once(make_policy: MakePolicy) -> None:
    policy = make_policy().train()
    for _ in range(3):
        policy.forward(as_batch("dsfd"))
    assert len(policy._attempts) == 2
    policy.forward(as_batch("s", first=9))
    assert len(policy._attempts) == 3


def test_without_numbers_of_frames_each_is_new(make_policy: MakePolicy) -> None:
    policy = make_policy().train()
    batch = as_batch("sf")
    del batch["index"]
    for _ in range(2):
        loss, _ = policy.forward(batch)
    assert len(policy._attempts) == 4
    assert loss.requires_grad


@pytest.mark.parametrize("training", [False, True])
def test_a_batch_without_attempts_teaches_nothing_and_can_be_stepped_on(training: bool, make_policy) -> None:
    policy = make_policy().train(training)
    before = [weight.clone() for weight in policy.get_optim_params()]
    optimizer = torch.optim.SGD(policy.get_optim_params(), lr=1.0)
    loss, logs = policy.forward(as_batch("dpd"))
    assert (loss.item(), logs) == (0.0, {})
    loss.backward()
    optimizer.step()
    assert all(torch.equal(*each) for each in zip(before, policy.get_optim_params(), strict=True))


def without_rewards(frames: str, held: str) -> dict[str, Any]:
    """As `as_batch`, for an episode of LeRobot's own recorder: before each frame something is held (1) or not (0)."""
    states = np.tile(STATE, (len(frames), 1))
    states[:, STATE_NAMES.index("holding.pos")] = [float(each) for each in held]
    return as_batch(frames) | {
        "next.reward": 0.0,  # which LeRobot's processors put in where there is no column
        STATE_KEY: torch.from_numpy(states),
        "episode_index": torch.zeros(len(frames), dtype=torch.int64),
    }


def test_without_rewards_the_next_frame_tells(make_policy: MakePolicy) -> None:
    """What the last grasp came to is not known, and a grasp with a full gripper is none."""
    policy = make_policy().eval()
    loss, _ = policy.forward(without_rewards("dfsfpff", "0001100"))
    wanted, _ = policy.forward(as_batch("dfsdpfd"))
    assert loss.item() == pytest.approx(wanted.item(), rel=1e-6)


def test_without_rewards_an_attempt_waits_for_the_next_frame(make_policy: MakePolicy) -> None:
    policy = make_policy().train()
    batch = without_rewards("dsdfs", "00100")
    known = []
    for row in (1, 0, 4, 3, 2):
        policy.forward(
            {key: value[row : row + 1] if isinstance(value, Tensor) else value for key, value in batch.items()}
        )
        known.append(policy._attempts.all(torch.device("cpu"))[2].tolist())
    assert known == [[], [], [], [False], [False, True]]


def test_the_next_frame_is_one_of_the_same_episode(make_policy: MakePolicy) -> None:
    policy, batch = make_policy().train(), without_rewards("sdf", "010")
    policy.forward({**batch, "episode_index": torch.tensor([0, 1, 1])})
    assert len(policy._attempts) == 0


def test_a_dataset_that_does_not_tell_how_grasps_ended_is_refused(make_policy: MakePolicy) -> None:
    batch = without_rewards("ff", "00")
    del batch[STATE_KEY]
    for missing in (0.0, None):
        with pytest.raises(ConfigError, match=r"no column next\.reward, .* record one with relmm-record"):
            make_policy().forward({**batch, "next.reward": missing})


def test_rewards_may_have_a_dimension_of_their_own(make_policy: MakePolicy) -> None:
    policy, batch = make_policy(), as_batch("fsf")
    loss, _ = policy.forward(batch)
    columns = {name: batch[name][:, None] for name in ("next.reward", "index")}
    assert policy.forward({**batch, **columns})[0].item() == loss.item()


# --- LeRobot's datasets --------------------------------------------------------------------------------------
def frames_of(**settings: Any) -> list[dict[str, Any]]:
    dataset = LeRobotDataset("local/diverse", root=RECORDED, episodes=[0, 1, 2], return_uint8=False, **settings)
    return list(dataset)


def is_attempt(frame: dict[str, Any]) -> bool:
    return round(float(frame["action"][2])) == Skill.GRASP


def test_stock_training_computes_the_loss_of_learning_online(make_policy: MakePolicy) -> None:
    """LeRobot's dataset, batches and preprocessor against the learner."""
    policy, frames = make_policy(seed=2), frames_of()
    learner = policy.make_learner(seed=0, capacity=len(frames))
    for frame in frames:
        image = (frame[IMAGE_KEY] * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()
        learner.add(image, STATE, frame["action"].numpy(), bool(frame["next.reward"] > 0), Phase.LEARNING)
    loss, logs = policy.forward(make_pre_post_processors(policy.config)[0](default_collate(frames)))
    areas, cells, successes = learner.attempts.all(torch.device("cpu"))
    wanted, wanted_logs = policy.grasping.loss(areas, cells, successes)
    assert len(cells) == sum(map(is_attempt, frames)) >= 2
    assert successes.any()
    assert loss.item() == pytest.approx(wanted.item(), rel=1e-3)
    assert logs == pytest.approx(wanted_logs, rel=1e-3)


def test_no_success_is_lost_to_image_augmentation(make_policy: MakePolicy) -> None:
    """The picture of a frame is another one whenever LeRobot shows it."""
    policy = make_policy().train()
    frames = frames_of(image_transforms=ImageTransforms(ImageTransformsConfig(enable=True)))
    for seed in range(2):
        order = np.random.default_rng(seed).permutation(len(frames))
        for chosen in np.array_split(order, 8):
            policy.forward(default_collate([frames[index] for index in chosen]))
    _, _, successes = policy._attempts.all(torch.device("cpu"))
    assert len(successes) == sum(map(is_attempt, frames))
    assert int(successes.sum()) == sum(bool(frame["next.reward"] > 0) for frame in frames) > 0
