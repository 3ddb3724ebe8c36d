"""Attempts and navigation steps in LeRobot's batches, which show frames in any order."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from relmm.features import ACTION_NAMES, IMAGE_KEY, STATE_KEY, STATE_NAMES, Skill, carried_out
from relmm.policies.learning import no_rewards
from relmm.policies.relmm_paper.navigation import from_navigation_steps

_SKILL, _X, _Y = (ACTION_NAMES.index(name) for name in ("skill.pos", "skill_x.pos", "skill_y.pos"))
_HOLDING = STATE_NAMES.index("holding.pos")
_WAITING = 4096  # steps, each with two pictures of 30 kB; a dataset shows what is forgotten again

Frame = tuple[int, int]  # the dataset, and the frame's number in it; pictures may be augmented, so they do not tell


@dataclass
class Attempt:
    """A grasp.

    Attributes:
        frame: its own.
        picture: before it, uint8 (3, 100, 100).
        place: where, m, (2,).
        success: whether it picked something up.
    """

    frame: Frame
    picture: Tensor
    place: Tensor
    success: bool


@dataclass
class Step:
    """A navigation step.

    Attributes:
        picture, next_picture: before and after it, uint8 (3, 100, 100).
        action: -1..1, (2,).
        attempts: that followed it; whether it led to a success, those tell.
    """

    picture: Tensor
    action: Tensor
    next_picture: Tensor
    attempts: list[Frame]


def read_batch(batch: dict[str, Any]) -> tuple[list[Attempt], list[Step]]:
    """What the frames of a batch are, as `RelmmPaperPolicy.forward` takes it; placements are neither.

    Raises:
        ConfigError: the dataset has no rewards, nor states that tell them.
    """
    pictures = (batch[IMAGE_KEY].clamp(0, 1) * 255).round().to(torch.uint8)  # (batch, time, 3, 100, 100)
    padded = batch[f"{IMAGE_KEY}_is_pad"].tolist()
    actions, successes = _outcomes(batch, padded)
    indices = batch["index"].flatten().tolist()
    datasets = batch["dataset_index"].flatten().tolist() if "dataset_index" in batch else [0] * len(indices)
    attempts, steps = [], []
    for row, (skills, first) in enumerate(zip(actions[..., _SKILL].round().tolist(), indices, strict=True)):
        frames = [(datasets[row], first + time) for time in range(len(skills))]
        if skills[0] == Skill.GRASP:
            success = successes[row]
            if success is not None:
                attempts.append(Attempt(frames[0], pictures[row, 0], actions[row, 0, [_X, _Y]], success))
        elif skills[0] == Skill.NAVIGATE:
            after = _after(skills, padded[row])
            # Not there are the picture after an episode's last frame, and what came of a curriculum's many attempts.
            if after < len(skills) and not padded[row][1]:
                # At the episode's end nothing comes after the attempts: the picture before them is what it led to.
                following = pictures[row, 1 if padded[row][after] else after]
                action = from_navigation_steps(actions[row, :1])[0]
                steps.append(Step(pictures[row, 0], action, following, frames[1:after]))
    return attempts, steps


def _outcomes(batch: dict[str, Any], padded: list[list[bool]]) -> tuple[Tensor, list[bool | None]]:
    """What was done, (batch, time, 5), and whether each row's frame picked something up, None where nobody can tell."""
    actions, rewards = batch["action"].cpu(), batch.get("next.reward")
    if isinstance(rewards, Tensor):  # LeRobot puts in the number 0 where there is no column
        return actions, [reward > 0 for reward in rewards.flatten().tolist()]
    if STATE_KEY not in batch:
        raise no_rewards()
    holding = batch[STATE_KEY][..., _HOLDING].cpu() > 0.5  # before each frame, (batch, time)
    done = carried_out(actions.flatten(0, 1).numpy(), holding.flatten().numpy())
    ended = [None if pads[1] else held for pads, held in zip(padded, holding[:, 1].tolist(), strict=True)]
    return torch.from_numpy(done).reshape(actions.shape), ended


def _after(skills: list[float], padded: list[bool]) -> int:
    """Which of a row's frames is the first after its navigation step and the attempts that follow on it."""
    after = 1
    while after < len(skills) and skills[after] == Skill.GRASP and not padded[after]:
        after += 1
    return after


class Outcomes:
    """Which attempts have succeeded, as far as batches have shown, and the steps that wait to be told."""

    def __init__(self) -> None:
        self._successes: dict[Frame, bool] = {}
        self._waiting: deque[Step] = deque(maxlen=_WAITING)

    def add(self, attempts: list[Attempt], steps: list[Step]) -> list[tuple[Step, bool]]:
        """Take in a batch.

        Returns:
            Steps, of this batch or of earlier ones, of which it is now known whether they led to a success.
        """
        self._successes |= {attempt.frame: attempt.success for attempt in attempts}
        known, asked = [], [*self._waiting, *steps]
        self._waiting.clear()
        for step in asked:
            outcomes = [self._successes.get(frame) for frame in step.attempts]
            if None in outcomes:
                self._waiting.append(step)
            else:
                known.append((step, any(outcomes)))
        return known
