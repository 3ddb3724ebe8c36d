from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from relmm.features import FloatArray, in_grasp_area
from relmm.policies.relmm.driving import STEP_LENGTH, STEP_TURN
from relmm.policies.relmm.memory import CELL, PLACES, SIDE, FloorMemory
from relmm.policies.relmm.planning import Plan, Planner, find_things
from relmm.policies.relmm.ways import COARSE, TIGHT

LEAST = 0.25
BODY = 0.19  # m, within which the base pushes a thing: their radii
FAILURE = 25.0
KnownFloor = Callable[..., FloorMemory]
Promise = Callable[..., NDArray[np.float32]]
NOTHING = np.zeros((SIDE, SIDE), np.float32)
NO_THINGS = np.zeros((0, 2))


def polar(bearing: float, distance: float) -> tuple[float, float]:
    return distance * math.cos(bearing), distance * math.sin(bearing)


def take(memory: FloorMemory, step: tuple[float, float]) -> None:
    """Drive a step's arc: half the turn before its chord and half after it."""
    forward, turn = step
    memory.move(np.array([forward * math.cos(turn / 2), forward * math.sin(turn / 2), turn]))
    memory.steps += 1


def follow(planner: Planner, memory: FloorMemory, success: NDArray[np.float32], thing, most: int = 60) -> FloatArray:
    """The poses of a robot that does as planned, until it could grasp a thing, (n, 3)."""
    poses = [memory.pose.copy()]
    while not in_grasp_area(*memory.to_robot(np.array(thing))):
        assert len(poses) <= most, f"it does not get to {thing}: {poses[-5:]}"
        take(memory, planner.plan(memory, np.where(memory.left_alone, 0, success), LEAST).step)
        poses.append(memory.pose.copy())
    return np.array(poses)


def make_planner(unseen_promise: float = 0.0, failure_steps: float = FAILURE) -> Planner:
    return Planner(failure_steps, unseen_promise)


def turn_to(plan: Plan, memory: FloorMemory) -> float:
    """By how far the robot would have to turn to look at a plan's target, rad."""
    offset = plan.target - memory.pose[:2]
    return abs((math.atan2(offset[1], offset[0]) - memory.pose[2] + math.pi) % (2 * math.pi) - math.pi)


# --- Driving to things ---------------------------------------------------------------------------------------
@pytest.mark.parametrize("bearing", np.radians([0, 20, -50, 85, -120, 150, 180]))
@pytest.mark.parametrize("distance", [0.55, 0.9, 1.6])
def test_the_way_to_a_thing_takes_about_as_many_steps_as_it_must(bearing, distance, known_floor, promise) -> None:
    memory, thing = known_floor(), polar(bearing, distance)
    poses = follow(make_planner(), memory, promise((thing, 0.9)), thing)
    # It drives until the thing is in the grasp area, the middle of which is 0.38 m before it.
    assert len(poses) - 1 <= max(distance - 0.38, 0) / STEP_LENGTH + abs(bearing) / STEP_TURN + 3


def test_things_beside_the_robot_are_reached_too(known_floor, promise) -> None:
    """It cannot drive backwards, so the nearest ones take a few steps more."""
    rng, steps = np.random.default_rng(0), []
    for distance in rng.uniform(0.2, 0.5, 20):
        thing = polar(rng.uniform(-math.pi, math.pi), distance)
        try:
            steps.append(len(follow(make_planner(), known_floor(), promise((thing, 0.9)), thing, most=20)) - 1)
        except AssertionError:
            steps.append(20)
    assert np.mean(steps) < 9
    assert np.mean(np.array(steps) < 20) >= 0.9


@pytest.mark.parametrize("pose", [(0.5, -0.4, 2.0), (-0.8, 0.3, -1.0)])
def test_where_the_robot_is_on_the_map_changes_nothing(pose, known_floor, promise) -> None:
    lengths = []
    for start in ((0.0, 0.0, 0.0), pose):
        memory = known_floor()
        memory.move(np.array(start))
        thing = tuple(memory.to_map(np.array([0.7, 0.6])))
        lengths.append(len(follow(make_planner(), memory, promise((thing, 0.9)), thing)))
    assert abs(lengths[0] - lengths[1]) <= 1


def test_steps_are_such_as_the_robot_can_take_and_none_stands_still(known_floor, promise) -> None:
    rng, planner, memory = np.random.default_rng(0), make_planner(), known_floor((1.4, -2, 1.5, 2))
    for _ in range(20):
        thing = tuple(rng.uniform(-1.2, 1.2, 2))
        forward, turn = planner.plan(memory, promise((thing, 0.9)), LEAST).step
        assert 0 <= forward <= STEP_LENGTH
        assert abs(turn) <= STEP_TURN
        assert forward > 0.01 or abs(turn) > 0.05
        take(memory, (forward, turn))


# --- Ways past what stands and what lies ---------------------------------------------------------------------
@pytest.mark.parametrize("side", [1, -1])
def test_it_drives_round_a_wall_and_no_closer_to_it_than_it_must(side: int, known_floor, promise) -> None:
    """The wall goes on to one side; its other end is 0.6 m off the straight line."""
    wall = (0.8, -0.6, 0.9, 2.5) if side == 1 else (0.8, -2.5, 0.9, 0.6)
    memory, thing = known_floor(wall), (1.7, 0.0)
    poses = follow(make_planner(), memory, promise((thing, 0.9)), thing)
    clearance = memory.clearance()
    rows, columns = np.moveaxis(np.floor(poses[:, :2] / CELL).astype(int) + SIDE // 2, -1, 0)
    assert clearance[rows, columns].min() > TIGHT - 2 * CELL
    assert (side * poses[:, 1]).min() < -0.6, "past its end"
    # Straight to beside the end of the wall, and from there into reach of the thing.
    shortest = math.hypot(0.85, 0.6 + TIGHT) + math.hypot(0.85, 0.6 + TIGHT) - 0.4
    assert len(poses) - 1 < 1.35 * shortest / STEP_LENGTH + 3 * math.radians(60) / STEP_TURN


def test_it_takes_a_gap_that_it_fits_through_rather_than_a_long_way(known_floor, promise) -> None:
    gap = known_floor((0.8, 0.45, 0.9, 3.0), (0.8, -3.0, 0.9, -0.45))
    poses = follow(make_planner(), gap, promise(((1.6, 0.0), 0.9)), (1.6, 0.0))
    assert np.abs(poses[:, 1]).max() < 0.3
    assert len(poses) - 1 < 1.3 / STEP_LENGTH + 3


def test_a_thing_against_a_wall_is_grasped_from_the_free_side(known_floor, promise) -> None:
    memory = known_floor((0.6, -1.0, 0.7, 1.0))
    poses = follow(make_planner(), memory, promise(((0.52, 0.7), 0.9)), (0.52, 0.7))
    assert poses[:, 0].max() < 0.6 - TIGHT + 2 * CELL


@pytest.mark.parametrize("off", [0.0, 0.06, -0.1])
def test_it_drives_round_things_that_it_does_not_want_now(off: float, known_floor, promise) -> None:
    """The near one is half as likely as the far one, so it is passed, though it lies in the straight line."""
    other, thing = (0.85, off), (1.7, 0.0)
    success = promise((other, 0.3), (thing, 0.95))
    memory = known_floor()
    planner = make_planner(failure_steps=60)
    assert planner.plan(memory, success, LEAST).target == pytest.approx(np.array(thing), abs=CELL)
    poses = follow(planner, memory, success, thing)
    assert np.linalg.norm(poses[:, :2] - other, axis=1).min() > BODY
    assert len(poses) - 1 < 1.3 / STEP_LENGTH + 6, "not far round"


# --- What to want --------------------------------------------------------------------------------------------
@pytest.mark.parametrize("nearer", [0, 1])
def test_of_two_equal_things_the_nearer_is_fetched(nearer: int, known_floor, promise) -> None:
    things = [polar(0.6, 1.0), polar(-0.6, 1.0)]
    things[nearer] = polar(math.copysign(0.6, things[nearer][1]), 0.7)
    plan = make_planner().plan(known_floor(), promise(*((thing, 0.9) for thing in things)), LEAST)
    assert plan.target == pytest.approx(np.array(things[nearer]), abs=CELL)
    assert plan.promise == pytest.approx(0.9, abs=0.1)
    assert not plan.searching


@pytest.mark.parametrize("failure_steps", [10.0, 25.0])
@pytest.mark.parametrize("near_chance", [0.4, 0.6])
@pytest.mark.parametrize("side", [1, -1])
def test_a_likely_thing_is_worth_so_many_steps_more_than_an_unlikely_one(
    failure_steps: float, near_chance: float, side: int, known_floor, promise
) -> None:
    """steps + (1 - p) * F is least; the two lie as far to the left as to the right."""
    worth = (0.9 - near_chance) * failure_steps
    for extra, wanted in ((worth - 2, "far"), (worth + 2, "near")):
        near, far = polar(side * 0.6, 0.6), polar(-side * 0.6, 0.6 + extra * STEP_LENGTH)
        success = promise((near, near_chance), (far, 0.9))
        plan = make_planner(failure_steps=failure_steps).plan(known_floor(), success, LEAST)
        assert plan.target == pytest.approx(np.array(far if wanted == "far" else near), abs=CELL), (extra, wanted)


def test_what_promises_too_little_is_not_worth_a_way(known_floor, promise) -> None:
    memory = known_floor()
    assert not make_planner().plan(memory, promise(((1.0, 0.0), 0.9)), 0.8).searching
    assert make_planner().plan(memory, promise(((1.0, 0.0), 0.7)), 0.8).searching


def test_with_nothing_to_want_on_known_floor_it_looks_round(known_floor) -> None:
    memory = known_floor()
    plan = make_planner().plan(memory, NOTHING, LEAST)
    assert plan.searching
    assert plan.step[0] == 0
    assert 0.5 * STEP_TURN < abs(plan.step[1]) <= STEP_TURN


def test_a_goal_is_kept_when_another_is_hardly_better(known_floor, promise) -> None:
    memory, planner = known_floor(), make_planner()
    left, right = polar(0.8, 0.9), polar(-0.8, 0.9)
    first = planner.plan(memory, promise((left, 0.9), (right, 0.88)), LEAST)
    assert first.target == pytest.approx(np.array(left), abs=CELL)
    again = planner.plan(memory, promise((left, 0.88), (right, 0.9)), LEAST)
    assert again.target == pytest.approx(np.array(left), abs=CELL)
    much_better = planner.plan(memory, promise((left, 0.3), (right, 0.9)), LEAST)
    assert much_better.target == pytest.approx(np.array(right), abs=CELL)


# --- Searching -----------------------------------------------------------------------------------------------
def test_with_nothing_to_want_it_goes_and_looks_at_unseen_floor(grid, make_world) -> None:
    memory, world = FloorMemory(grid), make_world()
    world.look(memory)
    plan = make_planner(0.2).plan(memory, memory.success(0.0), LEAST)
    row, column = np.floor(plan.target / CELL).astype(int) + SIDE // 2
    assert plan.searching
    assert plan.promise == 0.2
    assert memory.unseen()[row, column] > 0.5
    assert np.linalg.norm(plan.target) < 1.5, "and not far away"


@pytest.mark.parametrize(("chance", "searching"), [(0.3, True), (0.95, False)])
def test_unseen_floor_is_a_goal_as_any_other(chance: float, searching: bool, grid, make_world, promise) -> None:
    """An unlikely thing far away is worth less than a look round the corner, a likely one is worth more."""
    memory, world = FloorMemory(grid), make_world()
    for _ in range(15):
        world.look(memory)
        memory.move(world.drive(0.0, 2 * math.pi / 15))
    success = promise(((1.9, 0.0), chance))
    assert make_planner(0.5).plan(memory, success, LEAST).searching == searching


@pytest.mark.parametrize("seed", range(2))
def test_a_searching_robot_sees_all_of_a_room(seed: int, grid, make_world) -> None:
    """A room of 3 m by 2.6 m with an obstacle in it."""
    rng = np.random.default_rng(seed)
    along, across = np.arange(-1.5, 1.51, 0.1), np.arange(-1.3, 1.31, 0.1)
    walls = [(x, y) for x in along for y in (-1.3, 1.3)] + [(x, y) for x in (-1.5, 1.5) for y in across]
    posts = [(x, y, 0.06) for x, y in walls] + [(0.1, 0.6, 0.15)]
    start = (rng.uniform(-0.9, 0.9), rng.uniform(-0.8, 0), rng.uniform(-3, 3))
    memory, world, planner = FloorMemory(grid), make_world(posts=posts, pose=start), make_planner(0.2)
    memory.pose = world.pose.copy()
    x, y = np.moveaxis(PLACES, -1, 0)
    room = (np.abs(x) < 1.3) & (np.abs(y) < 1.1) & (np.hypot(x - 0.1, y - 0.6) > 0.25)
    for _ in range(60):
        world.look(memory)
        planner.shift(memory.move(world.drive(*planner.plan(memory, memory.success(0.0), LEAST).step)))
        memory.steps += 1
        gaps = np.linalg.norm(world.posts[:, :2] - world.pose[:2], axis=1) - world.posts[:, 2]
        assert gaps.min() > 0.18, "it does not run into anything, even without its own avoidance"
    assert (memory.unseen()[room] < 1).mean() > 0.9


# --- Giving up -----------------------------------------------------------------------------------------------
def steps_until_given_up(planner: Planner, memory: FloorMemory, success: NDArray[np.float32], thwarted: bool) -> int:
    first = planner.plan(memory, success, LEAST).target
    for steps in range(1, 60):
        memory.steps += 1
        if thwarted:
            planner.thwart()
        plan = planner.plan(memory, success, LEAST)
        if np.linalg.norm(plan.target - first) > 0.05:
            assert memory.is_left_alone(first[None])[0]
            return steps
    raise AssertionError("never")


def test_a_goal_that_does_not_come_nearer_is_given_up_for_another(known_floor, promise) -> None:
    success = promise(((0.9, 0.2), 0.9), ((-1.2, 0.2), 0.9))
    patient, thwarted = (steps_until_given_up(make_planner(), known_floor(), success, each) for each in (False, True))
    assert 1 < thwarted < patient < 30


def test_what_was_given_up_is_wanted_again_later(known_floor, promise) -> None:
    memory, planner, success = known_floor(), make_planner(), promise(((0.9, 0.2), 0.9))
    first = planner.plan(memory, success, LEAST).target
    while not memory.left_alone.any():
        planner.plan(memory, success, LEAST)
    assert planner.plan(memory, np.where(memory.left_alone, 0, success), LEAST).searching
    memory.steps += 1000
    assert planner.plan(memory, success, LEAST).target == pytest.approx(first)


def test_unseen_floor_that_cannot_be_seen_is_given_up_too(grid, make_world) -> None:
    memory, world, planner = FloorMemory(grid), make_world(), make_planner(0.2)
    world.look(memory)
    assert steps_until_given_up(planner, memory, NOTHING, False) < 30


def test_a_goal_stays_the_same_when_the_map_moves(known_floor, promise) -> None:
    by = np.array([0.8, -0.4])
    left, right = polar(0.8, 0.9), polar(-0.8, 0.9)
    planner, memory = make_planner(), known_floor()
    planner.plan(memory, promise((left, 0.9), (right, 0.88)), LEAST)
    planner.shift(by)
    memory.pose[:2] -= by
    moved = [tuple(np.array(thing) - by) for thing in (left, right)]
    plan = planner.plan(memory, promise((moved[0], 0.88), (moved[1], 0.9)), LEAST)
    assert plan.target == pytest.approx(np.array(moved[0]), abs=CELL)


# --- Plans ---------------------------------------------------------------------------------------------------
def test_a_plan_is_the_same_again(known_floor, promise) -> None:
    success = promise(*((polar(angle, 0.9), 0.9) for angle in range(6)))
    memory = known_floor((0.5, 0.5, 0.6, 0.6))
    first, second = (make_planner().plan(copy.deepcopy(memory), success, LEAST) for _ in range(2))
    for name, value in vars(first).items():
        assert np.array_equal(value, getattr(second, name)), name


def test_a_plan_leads_from_the_robot_to_a_goal_from_which_its_target_is_in_reach(known_floor, promise) -> None:
    memory, planner = known_floor((0.7, -0.4, 0.8, 0.4)), make_planner()
    plan = planner.plan(memory, promise(((1.5, 0.1), 0.9)), LEAST)
    assert plan.way[-1] == pytest.approx(plan.goal[:2])
    assert np.linalg.norm(np.diff(plan.way[:-1], axis=0), axis=1).max() <= math.sqrt(2) * CELL * COARSE + 1e-9
    assert np.linalg.norm(plan.way[0] - memory.pose[:2]) < 2 * CELL * COARSE
    memory.pose = plan.goal.copy()
    assert in_grasp_area(*memory.to_robot(plan.target))


@pytest.mark.parametrize("goal", [(0.9, 0.5, 0.5), (-0.7, 0.2, 3.0), (0.1, -0.8, -1.5)])
def test_it_goes_to_any_pose(goal: tuple[float, float, float], known_floor) -> None:
    """Well enough to put something down 0.33 m before it."""
    memory, planner = known_floor(), make_planner()
    target = np.array(goal[:2]) + 0.33 * np.array([math.cos(goal[2]), math.sin(goal[2])])
    for steps in itertools.count():
        assert steps < 25
        if np.linalg.norm(memory.to_robot(target) - (0.33, 0.0)) < 0.15:
            break
        take(memory, planner.go(memory, target, np.array(goal), NO_THINGS).step)


# --- Things --------------------------------------------------------------------------------------------------
def apart(rng: np.random.Generator, count: int, gap: float) -> list[FloatArray]:
    places: list[FloatArray] = []
    while len(places) < count:
        place = rng.uniform(-2.5, 2.5, 2)
        if all(np.linalg.norm(place - other) > gap for other in places):
            places.append(place)
    return places


@pytest.mark.parametrize("seed", range(4))
def test_each_of_several_things_is_found_once(seed: int, promise) -> None:
    rng = np.random.default_rng(seed)
    places = apart(rng, 12, 0.2)
    chances = rng.uniform(0.4, 1.0, 12)
    things, promises = find_things(promise(*zip(places, chances, strict=True)), 0.2, np.zeros(2))
    assert len(things) == 12
    distances = np.linalg.norm(things[:, None] - np.array(places), axis=-1)
    assert distances.min(axis=1).max() < 1.5 * CELL
    assert len(set(distances.argmin(axis=1))) == 12
    assert promises == pytest.approx(chances[distances.argmin(axis=1)], rel=0.25)
    assert (np.diff(np.linalg.norm(things, axis=1)) >= 0).all(), "the nearest first"


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_a_thing_that_is_equally_likely_all_over_is_found_once(size: int) -> None:
    """Of a saturated ensemble, or of one with the uncertainty bonus, the chances are exactly 1 in several cells."""
    success = NOTHING.copy()
    success[100 : 100 + size, 120 : 120 + size] = success[150 : 150 + size, 90 : 90 + size] = 1.0
    things, promises = find_things(success, 0.3, np.zeros(2))
    assert len(things) == 2
    assert promises.tolist() == [1.0, 1.0]


def test_the_least_promise_counts(promise) -> None:
    success = promise(((0.5, 0.5), 0.9), ((-0.5, 0.5), 0.4))
    assert [len(find_things(success, least, np.zeros(2))[0]) for least in (0.2, 0.6, 0.95)] == [2, 1, 0]


def test_of_too_many_things_the_nearest_are_taken(promise) -> None:
    places = [(x, y) for x in np.arange(-2.4, 2.5, 0.4) for y in np.arange(-2.4, 2.5, 0.4)]
    near = np.array([1.0, -1.0])
    things, _ = find_things(promise(*((place, 0.9) for place in places)), 0.3, near)
    assert 10 < len(things) < len(places)
    nearest = sorted(np.linalg.norm(np.array(places) - near, axis=1))[: len(things)]
    assert np.linalg.norm(things - near, axis=1) == pytest.approx(np.array(nearest), abs=1.5 * CELL)
