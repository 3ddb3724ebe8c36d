"""The paper's pseudo-reset as a list of actions."""

from __future__ import annotations

import numpy as np
import pytest

from relmm.features import MAX_THETA_VEL, MAX_X_VEL, Skill, action_dict, in_grasp_area
from relmm.policies.pseudo_reset import PLACE_XY, drive_anywhere, random_pseudo_reset

TURN_ROUND, TURN_AWAY = 6, 4  # steps


def actions(seed: int, steps: int, holding: bool) -> list[dict[str, float]]:
    return list(random_pseudo_reset(np.random.default_rng(seed), steps, lambda: holding))


def is_turn(action: dict[str, float]) -> bool:
    return action["x.vel"] == 0 and abs(action["theta.vel"]) == MAX_THETA_VEL


@pytest.mark.parametrize("steps", [0, 1, 20])
@pytest.mark.parametrize("holding", [True, False])
def test_it_drives_turns_round_puts_down_turns_away_and_drives(steps: int, holding: bool) -> None:
    done = actions(0, steps, holding)
    assert [int(action["skill.pos"]) for action in done] == [
        *[Skill.NAVIGATE] * (steps + TURN_ROUND),
        *[Skill.PLACE] * holding,
        *[Skill.NAVIGATE] * (TURN_AWAY + steps),
    ]
    turns = [is_turn(action) for action in done if action["skill.pos"] == Skill.NAVIGATE]
    assert turns == [False] * steps + [True] * (TURN_ROUND + TURN_AWAY) + [False] * steps


def test_it_turns_to_one_side_or_the_other_and_not_to_and_fro() -> None:
    sides = set()
    for seed in range(20):
        turns = [np.sign(action["theta.vel"]) for action in actions(seed, 0, holding=False)]
        assert len(set(turns[:TURN_ROUND])) == len(set(turns[TURN_ROUND:])) == 1
        sides.add((turns[0], turns[-1]))
    assert sides == {(1, 1), (1, -1), (-1, 1), (-1, -1)}


def test_what_is_lost_on_the_way_is_not_put_down() -> None:
    done: list[dict[str, float]] = []
    done.extend(random_pseudo_reset(np.random.default_rng(0), 3, lambda: len(done) < 5))
    assert Skill.PLACE not in [action["skill.pos"] for action in done]


def test_it_puts_down_where_it_can_be_picked_up_again() -> None:
    (place,) = [action for action in actions(0, 2, holding=True) if action["skill.pos"] == Skill.PLACE]
    assert place == action_dict(Skill.PLACE, x=PLACE_XY[0], y=PLACE_XY[1])
    assert in_grasp_area(*PLACE_XY)


def test_drives_are_uniform_over_all_there_are() -> None:
    rng = np.random.default_rng(0)
    drives = np.array([(action["x.vel"], action["theta.vel"]) for action in (drive_anywhere(rng) for _ in range(4000))])
    low, high = np.array([0, -MAX_THETA_VEL]), np.array([MAX_X_VEL, MAX_THETA_VEL])
    shares = (drives - low) / (high - low)
    assert ((shares >= 0) & (shares <= 1)).all()
    for quarter in range(4):
        inside = (shares >= quarter / 4) & (shares < (quarter + 1) / 4)
        assert inside.mean(axis=0) == pytest.approx([0.25, 0.25], abs=0.03)


def test_the_same_seed_drives_the_same_way() -> None:
    assert actions(3, 5, holding=True) == actions(3, 5, holding=True) != actions(4, 5, holding=True)
