from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from relmm.features import Skill, action_dict
from relmm.policies.pseudo_reset import PLACE_XY
from relmm.policies.relmm.carrying import choose_place, is_there
from relmm.policies.relmm.driving import STEP_LENGTH
from relmm.policies.relmm.memory import CELL, FloorMemory

FREE = 0.4  # m to walls and things, where there is such a place
STEPS = 30
NO_THINGS = np.zeros((0, 2))
# A room of 4 m by 3 m.
ROOM = ((-2.1, -1.6, -2.0, 1.6), (2.0, -1.6, 2.1, 1.6), (-2.1, -1.6, 2.1, -1.5), (-2.1, 1.5, 2.1, 1.6))


def places(memory: FloorMemory, things: Any, steps: int = STEPS, count: int = 40) -> np.ndarray:
    chosen = [choose_place(memory, np.array(things), steps, np.random.default_rng(seed)) for seed in range(count)]
    assert None not in chosen
    return np.array([place for place, _ in chosen])


def to_walls(points: np.ndarray) -> np.ndarray:
    return np.minimum(2.0 - np.abs(points[:, 0]), 1.5 - np.abs(points[:, 1]))


# --- The place -----------------------------------------------------------------------------------------------
def test_a_place_is_away_from_walls_and_from_other_things(known_floor) -> None:
    things = np.array([[0.9, 0.2], [-0.6, -0.7], [0.3, 0.9]])
    chosen = places(known_floor(*ROOM), things)
    assert to_walls(chosen).min() > FREE - 2 * CELL
    assert np.linalg.norm(chosen[:, None] - things, axis=-1).min() > FREE - 2 * CELL
    assert len({tuple(place) for place in chosen}) > 10, "and not always the same"


@pytest.mark.parametrize("steps", [10, 30])
def test_a_place_is_so_near_that_the_steps_suffice_and_not_right_here(steps: int, known_floor) -> None:
    distances = np.linalg.norm(places(known_floor(*ROOM), NO_THINGS, steps), axis=1)
    assert distances.max() < steps * STEP_LENGTH + PLACE_XY[0]
    assert distances.min() > 0.3


def test_a_place_can_be_got_to(known_floor) -> None:
    """Most of the free floor is behind a wall."""
    chosen = places(known_floor(*ROOM, (0.8, -1.6, 0.9, 1.6)), NO_THINGS)
    assert chosen[:, 0].max() < 0.8


def test_where_no_place_is_free_enough_it_is_one_of_the_freest(known_floor) -> None:
    """A corridor 0.7 m wide."""
    chosen = places(known_floor((-2.0, 0.35, 2.0, 0.45), (-2.0, -0.45, 2.0, -0.35)), NO_THINGS)
    assert np.abs(chosen[:, 1]).max() < 0.11


def test_a_place_was_seen(grid, make_world) -> None:
    memory, world = FloorMemory(grid), make_world()
    world.look(memory)
    chosen = places(memory, NO_THINGS)
    rows, columns = np.moveaxis(np.floor(chosen / CELL).astype(int) + 128, -1, 0)
    assert memory.unseen()[rows, columns].max() < 0.5
    assert np.abs(np.arctan2(chosen[:, 1], chosen[:, 0])).max() < 0.8


def test_there_is_no_place_where_nothing_was_seen(grid) -> None:
    assert choose_place(FloorMemory(grid), NO_THINGS, STEPS, np.random.default_rng(0)) is None


def test_from_the_pose_the_arm_puts_it_at_the_place(known_floor) -> None:
    memory = known_floor(*ROOM)
    for seed in range(10):
        chosen = choose_place(memory, NO_THINGS, STEPS, np.random.default_rng(seed))
        assert chosen is not None
        place, (x, y, heading) = chosen
        turned = complex(x, y) + complex(*PLACE_XY) * np.exp(1j * heading)
        assert place == pytest.approx([turned.real, turned.imag])


@pytest.mark.parametrize(("off", "there"), [(0.05, True), (0.15, False)])
def test_it_is_there_when_what_is_put_down_would_lie_near_enough(off: float, there: bool, known_floor) -> None:
    memory = known_floor()
    memory.move(np.array([0.3, 0.2, 1.1]))
    place = memory.to_map(np.array(PLACE_XY)) + off * np.array([math.cos(2), math.sin(2)])
    assert is_there(memory, place, 0.1) == there


# --- A life --------------------------------------------------------------------------------------------------
def carry(policy: Any, world: Any, steps: int = STEPS) -> list[dict[str, float]]:
    """What a robot that has just picked something up does then."""
    row = policy.row(0)
    for _ in range(14):  # it knows the floor round it
        policy.observe(*world.observe(), row)
        world.act(action_dict(theta_vel=112.0))
    world.holding = True
    policy.observe(*world.observe(), row)
    actions = []
    for action in policy.pseudo_reset(row, steps, lambda: world.holding):
        actions.append(action)
        world.act(action)
        policy.observe(*world.observe(), row)
    return actions


@pytest.mark.parametrize("seed", range(4))
def test_what_is_held_is_put_down_on_free_floor(seed: int, make_green, make_world) -> None:
    things = [(0.7, 0.3), (0.6, -0.5), (-0.8, 0.2)]
    policy, world = make_green(seed=seed), make_world(*things)
    actions = carry(policy, world)
    skills = [int(action["skill.pos"]) for action in actions]
    assert skills == [Skill.NAVIGATE] * (len(skills) - 1) + [Skill.PLACE]
    assert len(skills) <= STEPS + 1
    assert actions[-1] == action_dict(Skill.PLACE, x=PLACE_XY[0], y=PLACE_XY[1])
    assert np.linalg.norm(world.things[:-1] - world.things[-1], axis=1).min() > FREE - 0.12
    assert np.linalg.norm(world.things[-1]) > 0.4, "it was carried away"


def test_what_was_put_down_is_left_alone_for_a_while(make_green, make_world) -> None:
    policy, world = make_green(seed=1), make_world()
    carry(policy, world)
    row = policy.row(0)
    assert row.belief["grasp_probability"] < 0.1, "though it lies in reach, and is green"
    place = policy.mind(row).floor.to_map(world.in_robot_frame(world.things[-1]))
    for _ in range(10):
        action = policy.decide(*world.observe(), row)
        assert action["skill.pos"] == Skill.NAVIGATE
        assert np.linalg.norm(policy.mind(row).plan.target - place) > 0.1
        world.act(action)
        policy.observe(*world.observe(), row)


def test_what_is_lost_on_the_way_is_not_put_down(make_green, make_world) -> None:
    policy, world = make_green(seed=0), make_world((0.8, 0.5))
    for _ in range(14):
        policy.observe(*world.observe(), policy.row(0))
        world.act(action_dict(theta_vel=112.0))
    actions, held = [], iter([True, True, *[False] * 50])
    for action in policy.pseudo_reset(policy.row(0), STEPS, lambda: next(held)):
        actions.append(action)
        world.act(action)
        policy.observe(*world.observe(), policy.row(0))
    assert [action["skill.pos"] for action in actions] == [Skill.NAVIGATE] * 2


def test_where_it_knows_no_floor_it_puts_it_down_at_once(make_green) -> None:
    policy = make_green()
    actions = list(policy.pseudo_reset(policy.row(0), STEPS, lambda: True))
    assert [action["skill.pos"] for action in actions] == [Skill.PLACE]


def test_it_ends_within_the_steps_it_was_given(make_green, make_world) -> None:
    actions = carry(make_green(seed=2), make_world((0.7, 0.3)), steps=2)
    assert len(actions) <= 3
    assert actions[-1]["skill.pos"] == Skill.PLACE
