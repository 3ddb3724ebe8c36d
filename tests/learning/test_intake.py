"""What a learner does with episodes that come faster than it learns."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from relmm.features import Phase, Skill
from relmm.learning.intake import Intake
from relmm.learning.progress import Progress


class Learner:
    """Makes as many updates as an episode has frames."""

    def __init__(self):
        weight = torch.nn.Parameter(torch.zeros(1))
        self.optimizers = {"all": torch.optim.Adam([weight])}
        self.read_with = []
        self._weight = weight

    def read(self, episode, update):
        self.read_with.append(update)
        for _ in range(len(episode.rewards) if update else 0):
            self._weight.grad = torch.ones(1)
            self.optimizers["all"].step()


def episode(weights_step=-1, frames=3):
    """Navigation steps."""
    actions = np.zeros((frames, 5), np.float32)
    actions[:, 2] = Skill.NAVIGATE
    return SimpleNamespace(
        actions=actions,
        rewards=np.zeros(frames, np.float32),
        phases=np.full(frames, Phase.LEARNING),
        robot_times=np.arange(frames, dtype=np.float32),
        weights_step=weights_step,
    )


def test_what_comes_while_too_many_wait_is_remembered_without_updates():
    learner, waiting = Learner(), [0, 2, 3, 2]
    intake = Intake(learner, Progress(), lambda: waiting[0], max_waiting=2)
    for _ in range(4):
        intake.take("a", episode())
        waiting.append(waiting.pop(0))
    assert learner.read_with == [True, True, False, True]
    assert intake.logs() == {"episodes_waiting": 0, "updates_per_episode": 9 / 4, "episodes_without_updates": 1}
    assert intake.logs()["updates_per_episode"] == 0, "counted from line to line"


def test_the_age_of_weights_is_the_steps_that_the_learner_was_ahead():
    progress = Progress()
    intake = Intake(Learner(), progress, lambda: 0, max_waiting=0)
    for step in (-1, 0, 2):
        intake.take("a", episode(step))
    logs = intake.logs()
    assert (logs["weights_age"], logs["weights_age_max"]) == ((3 + 4) / 2, 4)
    assert "weights_age" not in intake.logs()


def test_each_robot_has_its_own_clock():
    progress = Progress()
    intake = Intake(Learner(), progress, lambda: 0, max_waiting=0)
    for source in ("a", "b"):
        intake.take(source, episode(frames=61))
    assert progress.robot_minutes == pytest.approx(2.0)


def test_weights_are_saved_in_a_tenth_of_the_time():
    now = [0.0]
    intake = Intake(Learner(), Progress(), lambda: 0, max_waiting=0, clock=lambda: now[0])

    def save():
        now[0] += 2.0

    assert intake.weights_are_due
    intake.timed(save)
    assert not intake.weights_are_due
    now[0] += 17.9
    assert not intake.weights_are_due
    now[0] += 0.1
    assert intake.weights_are_due
