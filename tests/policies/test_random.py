from __future__ import annotations

from itertools import groupby

import numpy as np
import pytest

from relmm.errors import ConfigError
from relmm.features import GRID, MAX_THETA_VEL, MAX_X_VEL, Skill, xy_to_cell


@pytest.fixture
def actions(make_controller, make_batch, empty) -> np.ndarray:
    policy, batch = make_controller("relmm_random", seed=1), make_batch(empty)
    return np.array([policy.select_action(batch)[0].tolist() for _ in range(6000)])


def test_half_of_the_navigation_steps_end_in_two_grasps(actions: np.ndarray) -> None:
    runs = [(skill, len(list(run))) for skill, run in groupby(actions[:, 2])]
    grasps = [length for skill, length in runs if skill == Skill.GRASP]
    assert set(grasps[:-1]) == {2}
    assert len(grasps) / (actions[:, 2] == Skill.NAVIGATE).sum() == pytest.approx(0.5, abs=0.03)
    assert runs[0][0] == Skill.NAVIGATE


def test_actions_are_uniform(actions: np.ndarray) -> None:
    moves, grasps = (actions[actions[:, 2] == skill] for skill in (Skill.NAVIGATE, Skill.GRASP))
    for values, low, high in ((moves[:, 0], 0, MAX_X_VEL), (moves[:, 1], -MAX_THETA_VEL, MAX_THETA_VEL)):
        share = np.histogram(values, 4, (low, high))[0] / len(values)
        assert share == pytest.approx(np.full(4, 0.25), abs=0.04)
    cells = np.bincount([xy_to_cell(x, y) for x, y in grasps[:, 3:]], minlength=GRID**2)
    expected = len(grasps) / GRID**2
    assert ((cells - expected) ** 2 / expected).sum() < 280  # chi-squared, 224 degrees of freedom: p = 0.006


def test_the_share_of_grasps_can_be_set(make_controller, make_batch, empty) -> None:
    batch = make_batch(empty)
    never, always = (make_controller("relmm_random", grasp_probability=p, num_grasp=1) for p in (0.0, 1.0))
    assert {float(never.select_action(batch)[0, 2]) for _ in range(50)} == {Skill.NAVIGATE}
    assert [float(always.select_action(batch)[0, 2]) for _ in range(6)] == [0, 1, 0, 1, 0, 1]


def test_an_impossible_share_is_refused(make_controller) -> None:
    with pytest.raises(ConfigError, match=r"grasp_probability is 1.5, but must lie in 0..1"):
        make_controller("relmm_random", grasp_probability=1.5)
