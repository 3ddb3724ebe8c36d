from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from relmm.learning.curriculum import AutonomousCurriculum, Practice

Attempt = Callable[[], bool]  # an attempt, and whether it picked something up


class Robot:
    """Attempts with scripted outcomes, counted."""

    def __init__(self, seed: int, chance: float, before: int = 0) -> None:
        self._rng, self._chance = np.random.default_rng(seed), chance
        self.attempts = before  # |D_g|

    def attempt(self) -> bool:
        self.attempts += 1
        return bool(self._rng.random() < self._chance)


def train_grasp(attempt: Attempt, n: int) -> bool:
    """Algorithm 1 with st = False, line by line."""
    for _ in range(n):
        r_g = attempt()
        if r_g:
            return r_g
    return False


def train_grasp_auto_curr(robot: Robot, n_start: int, n_stop: int, n_max: int) -> bool:
    """Algorithm 3 from its fifth line on."""
    n_since, r_max = 0, False
    while True:
        r_g = robot.attempt()
        if r_g:
            n_since = 0
            r_max = True
        else:
            n_since = n_since + 1
        if robot.attempts >= n_max:
            break
        if r_max:
            if n_since >= n_stop:
                break
        elif n_since >= n_start:
            break
    return r_max


@pytest.mark.parametrize("limit", [1, 2, 7])
@pytest.mark.parametrize("chance", [0.0, 0.2, 1.0])
def test_session_of_normal_training_is_algorithm_1(limit: int, chance: float) -> None:
    for seed in range(50):
        paper, ours = Robot(seed, chance), Robot(seed, chance)
        practice = Practice(limit)
        while not practice.finished:
            practice.attempted(ours.attempt())
        assert practice.succeeded == train_grasp(paper.attempt, limit)
        assert ours.attempts == paper.attempts


@pytest.mark.parametrize(("n_start", "n_stop"), [(10, 50), (2, 20), (3, 1), (1, 1), (5, 2)])
@pytest.mark.parametrize("chance", [0.0, 0.1, 0.5, 1.0])
@pytest.mark.parametrize("before", [0, 80, 99])
def test_session_of_the_autonomous_curriculum_is_algorithm_3(n_start, n_stop, chance, before) -> None:
    curriculum = AutonomousCurriculum(n_start, n_stop, num_max=100)
    for seed in range(30):
        paper, ours = Robot(seed, chance, before), Robot(seed, chance, before)
        practice = curriculum.session()
        while not practice.finished:
            practice.attempted(ours.attempt())
            if not curriculum.active(ours.attempts):
                break
        assert practice.succeeded == train_grasp_auto_curr(paper, n_start, n_stop, 100)
        assert ours.attempts == paper.attempts


def test_autonomous_curriculum_ends_after_so_many_attempts() -> None:
    curriculum = AutonomousCurriculum(2, 5, num_max=3)
    assert [curriculum.active(attempts) for attempts in (0, 2, 3, 4)] == [True, True, False, False]


def test_each_session_begins_anew() -> None:
    curriculum = AutonomousCurriculum(2, 5, num_max=3)
    curriculum.session().attempted(True)
    assert curriculum.session() == Practice(2, 5, since=0, succeeded=False)
