from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from relmm.features import GRASP_X, GRASP_Y, SCAN_BEARINGS, SCAN_RANGE, FloatArray, in_grasp_area
from relmm.policies.relmm.memory import CELL, PLACES, SIDE, FloorGrid, FloorMemory, cells
from relmm.policies.relmm.planning import find_things

CLEAR = np.full(len(SCAN_BEARINGS), SCAN_RANGE)
MakeWorld = Callable[..., Any]


@pytest.fixture
def memory(grid: FloorGrid) -> FloorMemory:
    return FloorMemory(grid)


def level(grid: FloorGrid, mean: float = 0.0) -> NDArray[np.float32]:
    """An opinion that is the same of all floor."""
    return np.full(grid.known.shape, mean, np.float32) * grid.known


def look(memory: FloorMemory, grid: FloorGrid, mean: float = 0.0, std: float = 0.0, scan: FloatArray = CLEAR) -> None:
    memory.look(level(grid, mean), level(grid, std), scan)


def at(layer: NDArray[Any], place: FloatArray) -> Any:
    return layer[tuple(cells(np.asarray(place)))]


def promised(memory: FloorMemory) -> FloatArray:
    """The middle of what a memory of a single thing promises."""
    success = memory.success(0.0)
    assert success.max() > 0.3
    return (success[..., None] * PLACES).sum(axis=(0, 1)) / success.sum()


def one_hit(bearing: float, distance: float) -> FloatArray:
    """A scan with one obstacle."""
    scan = CLEAR.copy()
    scan[SCAN_BEARINGS.index(bearing)] = distance
    return scan


def polar(bearing: float, distance: float) -> FloatArray:
    return distance * np.array([math.cos(math.radians(bearing)), math.sin(math.radians(bearing))])


# --- Where things are ----------------------------------------------------------------------------------------
@pytest.mark.parametrize("place", [(0.35, 0.0), (0.4, -0.07), (0.8, 0.3), (1.2, -0.4), (1.9, 0.5)])
@pytest.mark.parametrize(
    "drives",
    [
        [],
        [(0.5, 0.0, 0.0)],
        [(0.0, 1.2, 0.0), (0.3, 0.0, 0.0)],
        [(0.1, 0.4, 0.0)] * 6 + [(0.0, -2.8, 0.0)],
        [(0.2, 0.0, 0.1), (0.1, -0.5, -0.15)],
    ],
)
def test_what_is_seen_lies_at_its_place_whatever_the_way_there(place, drives, memory, make_world) -> None:
    world = make_world()
    for drive in drives:
        memory.move(world.drive(*drive))
    robot = world.pose[:2] @ np.array([1, 1j])
    thing = robot + np.exp(1j * world.pose[2]) * complex(*place)
    world.things = np.array([[thing.real, thing.imag]])
    world.look(memory)
    assert promised(memory) == pytest.approx([thing.real, thing.imag], abs=0.5 * CELL)
    assert memory.to_robot(promised(memory)) == pytest.approx(np.array(place), abs=0.5 * CELL)


def test_a_thing_stays_where_it_was_seen_while_the_robot_drives_round(memory: FloorMemory, make_world) -> None:
    world, rng = make_world((0.7, 0.2)), np.random.default_rng(0)
    world.look(memory)
    for _ in range(30):
        memory.move(world.drive(rng.uniform(0, 0.1), rng.uniform(-0.4, 0.4)))
    assert promised(memory) == pytest.approx([0.7, 0.2], abs=0.5 * CELL)
    assert memory.to_robot(promised(memory)) == pytest.approx(world.in_robot_frame(world.things)[0], abs=0.5 * CELL)


def test_maps_of_points_and_places_are_inverse_and_those_of_the_pose(memory: FloorMemory) -> None:
    memory.move(np.array([0.3, 0.1, 2.0]))
    points = np.random.default_rng(0).uniform(-2, 2, (4, 5, 2))
    assert memory.to_robot(memory.to_map(points)) == pytest.approx(points)
    turned = (points @ np.array([1, 1j])) * np.exp(2j) + complex(0.3, 0.1)
    assert memory.to_map(points) == pytest.approx(np.stack([turned.real, turned.imag], axis=-1))
    assert memory.to_robot(memory.pose[:2]) == pytest.approx([0, 0])


@pytest.mark.parametrize("heading", [0.0, 0.7, 2.2, -1.8])
def test_after_five_metres_all_that_is_left_on_the_map_is_in_its_place(heading: float, memory, make_world) -> None:
    """The square moves along with the robot, so what is compared is how the robot has it."""
    world = make_world(*(polar(math.degrees(heading), 4.9) + offset for offset in ((0.3, 0), (-0.3, 0.1))))
    memory.move(world.drive(0.0, heading))
    shifts = np.zeros(2)
    for _ in range(50):
        shifts += memory.move(world.drive(0.1, 0.0))
        memory.steps += 1
        world.look(memory)
        assert np.abs(memory.pose[:2]).max() < SIDE / 2 * CELL - 1.2, "the grasp area and more lies within the square"
    assert np.linalg.norm(shifts) > 2
    assert memory.pose[:2] + shifts == pytest.approx(world.pose[:2])
    memory.move(world.drive(0.3, 2.5))
    places, promises = find_things(memory.success(0.0), 0.3, memory.pose[:2])
    assert sorted(map(tuple, (places + shifts).round(1))) == sorted(map(tuple, world.things.round(1)))
    errors = memory.to_robot(places)[:, None] - world.in_robot_frame(world.things)
    assert np.linalg.norm(errors, axis=-1).min(axis=1).max() < 1.5 * CELL


def test_all_that_is_remembered_moves_along_with_the_square(memory: FloorMemory, grid: FloorGrid, make_world) -> None:
    world = make_world((1.0, 0.3), posts=[(1.3, -0.2, 0.05), (0.9, -0.5, 0.1)])
    world.look(memory)
    look(memory, grid, std=0.2, scan=world.scan())
    memory.leave_alone(np.array([1.0, 0.1]), 0.1, 1000)

    def layers() -> list[NDArray[Any]]:
        return [memory.success(0.0), memory.success(1.0), memory.left_alone, memory.standing, memory.unseen()]

    before, shift = layers(), np.zeros(2)
    for _ in range(20):
        shift = memory.move(world.drive(0.1, 0.03))
        if shift.any():
            break
    assert shift.any()
    rows, columns = np.rint(shift / CELL).astype(int)
    assert shift == pytest.approx(np.array([rows, columns]) * CELL), "whole cells"
    for old, new in zip(before, layers(), strict=True):
        assert len(np.unique(old)) > 1
        assert np.array_equal(old[rows:, columns:], new[: SIDE - rows, : SIDE - columns])


def test_what_has_left_the_square_is_forgotten(memory: FloorMemory, make_world) -> None:
    world = make_world((0.6, 0.0), posts=[(0.9, 0.3, 0.1)])
    world.look(memory)
    for turn in (math.pi, math.pi):
        memory.move(world.drive(0.0, turn))
        for _ in range(70):
            memory.move(world.drive(0.1, 0.0))
    assert world.pose[:2] == pytest.approx([0, 0], abs=1e-6)
    assert memory.success(1.0).max() == 0
    assert not memory.standing.any()
    assert memory.unseen().min() == 1


# --- What wins -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("std_weight", [0.0, 1.0])
def test_what_is_seen_now_wins_over_what_was_remembered(std_weight: float, memory: FloorMemory, grid) -> None:
    look(memory, grid, 0.8, 0.1)
    place = np.array([0.6, 0.0])
    assert at(memory.success(std_weight), place) == pytest.approx(0.8 + std_weight * 0.1)
    look(memory, grid, 0.2, 0.0)
    assert at(memory.success(std_weight), place) < 0.5
    for _ in range(3):
        look(memory, grid, 0.2, 0.0)
    assert at(memory.success(std_weight), place) == pytest.approx(0.2, abs=0.01)


def test_a_look_from_near_counts_more_than_one_from_afar(memory: FloorMemory, grid: FloorGrid) -> None:
    for mean in (0.0, 1.0):
        look(memory, grid, mean)
    assert at(memory.mean, (0.6, 0.0)) > at(memory.mean, (2.2, 0.0)) > 0


def test_a_thing_that_is_gone_disappears(memory: FloorMemory, make_world) -> None:
    world = make_world((0.6, 0.1))
    world.look(memory)
    world.things = np.array([[0.9, -0.2]])
    for _ in range(3):
        world.look(memory)
    places, _ = find_things(memory.success(0.0), 0.1, memory.pose[:2])
    assert places == pytest.approx(np.array([[0.9, -0.2]]), abs=1.5 * CELL)


def test_a_look_changes_nothing_out_of_view(memory: FloorMemory, make_world) -> None:
    world = make_world((0.6, 0.1))
    world.look(memory)
    before = memory.success(0.0)
    world.things = np.zeros((0, 2))
    memory.move(world.drive(0.0, math.pi))
    for _ in range(3):
        world.look(memory)
    assert np.array_equal(memory.success(0.0), before)


def test_promises_are_chances_and_only_where_something_was_seen(memory: FloorMemory, grid: FloorGrid) -> None:
    look(memory, grid, 0.9, 0.4)
    success = memory.success(1.0)
    assert success.max() == 1
    assert success.min() == 0
    x, y = np.moveaxis(PLACES, -1, 0)
    assert success[(x < 0.2) | (np.abs(np.arctan2(y, x)) > 0.8)].max() == 0


# --- Time ----------------------------------------------------------------------------------------------------
def test_what_is_out_of_view_fades_and_what_is_in_view_does_not(memory: FloorMemory, make_world) -> None:
    world, thing = make_world((0.6, 0.1)), (0.6, 0.1)
    world.look(memory)
    promises = [at(memory.success(0.0), thing)]
    for _ in range(2):
        memory.steps += 20
        promises.append(at(memory.success(0.0), thing))
    first, second, third = promises
    assert first > second > third > 0
    assert third / second == pytest.approx(second / first), "by the same share in the same time"
    assert at(memory.unseen(), thing) == pytest.approx(1 - third / first, rel=1e-5), "and the floor with it"
    world.look(memory)
    assert at(memory.success(0.0), thing) == pytest.approx(first, rel=1e-5)
    assert at(memory.unseen(), thing) == 0


def test_nothing_is_expected_where_things_are_left_alone_until_the_time_is_over(memory, grid) -> None:
    look(memory, grid, 0.6)
    memory.steps = 5
    before, place, radius = memory.success(0.0), np.array([0.6, 0.1]), 0.1
    memory.leave_alone(place, radius, 10)
    inside = np.linalg.norm(PLACES - place, axis=-1) < radius
    for steps in (5, 14):
        memory.steps = steps
        assert np.array_equal(memory.left_alone, inside)
        assert memory.success(0.0)[~inside].max() > 0.5
        assert np.array_equal(memory.is_left_alone(PLACES.reshape(-1, 2)).reshape(SIDE, SIDE), inside)
    look(memory, grid, 0.6)
    memory.steps = 15
    look(memory, grid, 0.6)
    assert not memory.left_alone.any()
    assert memory.success(0.0)[inside] == pytest.approx(before[inside], rel=0.2)


def test_what_is_left_alone_is_not_worth_a_look(memory: FloorMemory) -> None:
    memory.leave_alone(np.array([1.0, 1.0]), 0.2, 10)
    assert at(memory.unseen(), (1.0, 1.0)) == 0
    assert at(memory.unseen(), (1.0, 0.7)) == 1


@pytest.mark.parametrize("motion", [(0, 0, 0), (0.4, 0.1, 2.0)])
def test_the_grasp_area_is_left_alone_whichever_way_it_lies(motion, memory: FloorMemory) -> None:
    memory.move(np.array(motion, float))
    memory.leave_area_alone(10)
    inside = np.array([in_grasp_area(*point) for point in memory.to_robot(PLACES).reshape(-1, 2)])
    left_alone = memory.left_alone.ravel()
    assert not (left_alone & ~inside).any()
    middle = memory.to_map(np.array([[np.mean(GRASP_X) + x, y] for x in (-0.05, 0, 0.05) for y in (-0.05, 0, 0.05)]))
    assert memory.is_left_alone(middle).all()
    assert left_alone.sum() > 0.5 * inside.sum()
    assert at(memory.left_alone, memory.to_map(np.array([np.mean(GRASP_X), GRASP_Y[1] + CELL]))) == 0
    memory.steps = 10
    assert not memory.left_alone.any()


# --- What stands ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("bearing", [-60, -30, 0, 21, 60])
@pytest.mark.parametrize("distance", [0.4, 1.1, 2.4])
@pytest.mark.parametrize("motion", [(0, 0, 0), (0.3, -0.2, 2.4)])
def test_a_scan_puts_an_obstacle_at_its_bearing_and_distance(bearing, distance, motion, memory, grid) -> None:
    memory.move(np.array(motion, float))
    look(memory, grid, scan=one_hit(bearing, distance))
    standing = memory.to_robot(PLACES[memory.standing])
    assert np.linalg.norm(standing - polar(bearing, distance), axis=1).min() < CELL
    assert np.hypot(*standing.T) == pytest.approx(np.full(len(standing), distance), abs=1.5 * CELL)
    off = np.abs(np.degrees(np.arctan2(standing[:, 1], standing[:, 0])) - bearing)
    assert off.max() < 1.5 + math.degrees(1.5 * CELL / distance)
    assert np.linalg.norm(np.ptp(standing, axis=0)) < 2 * distance * math.tan(math.radians(1.5)) + 4 * CELL


def test_nothing_stands_where_nothing_was_scanned(memory: FloorMemory, grid: FloorGrid) -> None:
    look(memory, grid)
    assert not memory.standing.any()
    assert memory.clearance().min() > 2


def test_floor_before_an_obstacle_is_free_and_none_behind_it_is_seen(memory: FloorMemory, make_world, grid) -> None:
    world = make_world(posts=[(1.0, 0.0, 0.15)])
    look(memory, grid, 0.7, scan=world.scan())
    x, y = np.moveaxis(PLACES, -1, 0)
    before, behind = (np.abs(y) < 0.05) & (x > 0.4) & (x < 0.78), (np.abs(y) < 0.1) & (x > 0.95) & (x < 2.2)
    assert memory.success(0.0)[before].min() > 0.6
    assert memory.mean[behind].max() == 0
    assert not memory.standing[before | behind].any()
    beside = (y > 0.35) & (y < 0.45) & (x > 0.7) & (x < 1.2)
    assert memory.success(0.0)[beside].min() > 0.6


def test_what_is_visible_is_nearer_than_the_obstacles_of_its_sector_and_those_beside(grid: FloorGrid) -> None:
    rng = np.random.default_rng(0)
    scan = rng.uniform(0.3, SCAN_RANGE, len(SCAN_BEARINGS))
    visible = grid.visible(scan)
    assert not visible[~grid.known].any()
    for row, column in zip(*(each[::97] for each in np.nonzero(grid.known)), strict=True):
        x, y = grid.origin + np.array([row, column]) * grid.pitch
        sector = round((math.degrees(math.atan2(y, x)) - SCAN_BEARINGS[0]) / 3)
        nearest = min(scan[max(sector - 1, 0) : sector + 2])
        assert visible[row, column] == (math.hypot(x, y) < nearest)


def test_nothing_is_believed_of_what_stands_and_right_beside_it(memory: FloorMemory, grid: FloorGrid) -> None:
    look(memory, grid, 0.9)
    for _ in range(2):
        look(memory, grid, 0.9, scan=np.full(len(SCAN_BEARINGS), 0.8))
    rows, columns = np.nonzero(memory.standing)
    assert len(rows) > 20
    success = memory.success(0.5)
    for row, column in zip(rows, columns, strict=True):
        assert success[row - 1 : row + 2, column - 1 : column + 2].max() == 0
    assert at(success, (0.6, 0.0)) > 0.8


def test_clearance_is_the_distance_to_what_stands(memory: FloorMemory, grid: FloorGrid) -> None:
    look(memory, grid, scan=np.random.default_rng(1).choice([0.5, 0.9, 1.7, SCAN_RANGE], len(SCAN_BEARINGS)))
    standing = PLACES[memory.standing]
    places = PLACES[::17, ::13]
    brute = np.linalg.norm(places[..., None, :] - standing, axis=-1).min(axis=-1)
    assert memory.clearance()[::17, ::13] == pytest.approx(brute, rel=0.03, abs=1e-6)


def test_what_was_taken_for_an_obstacle_goes_when_floor_is_seen_there(memory: FloorMemory, grid: FloorGrid) -> None:
    for _ in range(10):
        look(memory, grid, scan=one_hit(0, 0.8))
    assert memory.standing.any()
    look(memory, grid)
    assert memory.standing.any(), "one look may be wrong"
    for _ in range(5):
        look(memory, grid)
    assert not memory.standing.any()
    assert at(memory.mean, (1.2, 0.0)) == 0
    assert at(memory.unseen(), (1.2, 0.0)) == 0


def test_obstacles_out_of_view_are_forgotten_in_time_the_later_the_surer(memory: FloorMemory, grid: FloorGrid) -> None:
    def lasts(looks: int) -> int:
        one = copy.deepcopy(memory)
        for _ in range(looks):
            look(one, grid, scan=one_hit(0, 0.8))
        while one.standing.any() and one.steps < 2000:
            one.steps += 1
        return one.steps

    assert 10 < lasts(1) < lasts(5) < 2000


# --- What is known -------------------------------------------------------------------------------------------
def test_floor_is_known_once_it_was_in_view_from_near(memory: FloorMemory, make_world) -> None:
    world = make_world()
    assert memory.unseen().min() == 1
    world.look(memory)
    assert at(memory.unseen(), (0.6, 0.0)) == 0
    for far in ((2.2, 0.0), (-0.5, 0.0), (0.6, 1.0)):
        assert at(memory.unseen(), far) == 1
    for _ in range(15):
        memory.move(world.drive(0.1, 0.0))
    world.look(memory)
    assert at(memory.unseen(), (2.2, 0.0)) == 0


# --- Wheels --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("wheel_scale", [0.95, 1.05])
@pytest.mark.parametrize("turn", [0.3, -0.3])
def test_with_wheels_that_err_what_is_seen_again_is_where_it_is(wheel_scale, turn, memory, grid, make_world) -> None:
    """Driving once round: by then the wheels are 18 degrees and some decimetres wrong."""
    world = make_world((0.8, 0.1), (1.0, -0.3), wheel_scale=wheel_scale)
    world.look(memory)
    while abs(world.pose[2]) < 2 * math.pi:
        memory.move(world.drive(0.1, turn))
        memory.steps += 1
        world.look(memory)
    assert abs(abs(memory.pose[2]) - abs(world.pose[2])) > 0.25
    places, _ = find_things(memory.success(0.0), 0.3, memory.pose[:2])
    seen = memory.to_robot(places)
    for thing in world.in_robot_frame(world.things):
        assert np.linalg.norm(seen - thing, axis=1).min() < 1.5 * CELL
    pixels = np.rint((seen - grid.origin) / grid.pitch).astype(int)
    in_view = [grid.known[tuple(pixel)] for pixel in pixels if (pixel >= 0).all() and (pixel < grid.known.shape).all()]
    assert sum(in_view) == 2, "what the wheels had put elsewhere is gone from where it can be seen not to be"
