from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from relmm.features import SCAN_BEARINGS, SCAN_RANGE
from relmm.policies.relmm.drawing import draw_floor
from relmm.policies.relmm.memory import SIDE, FloorGrid, FloorMemory
from relmm.policies.relmm.planning import Plan

SIZE = 384  # pixels
PIXEL = 0.0125  # m
NOTHING = np.zeros((SIDE, SIDE), np.float32)
Picture = NDArray[np.uint8]
headings = pytest.mark.parametrize("heading", [0.0, 0.8, 2.5, -1.7])


def pixel(x: float, y: float) -> tuple[int, int]:
    """Row and column of a place in the robot's frame, of a picture that it looks up."""
    return round(SIZE / 2 - x / PIXEL), round(SIZE / 2 - y / PIXEL)


def around(picture: Picture, x: float, y: float, half: int = 3) -> NDArray[Any]:
    row, column = pixel(x, y)
    return picture[row - half : row + half + 1, column - half : column + half + 1].reshape(-1, 3).astype(int)


def is_green(colours: NDArray[Any]) -> NDArray[np.bool_]:
    return (colours[:, 1] > colours[:, 0] + 40) & (colours[:, 1] > colours[:, 2] + 40)


def is_red(colours: NDArray[Any]) -> NDArray[np.bool_]:
    return (colours[:, 0] > colours[:, 1] + 60) & (colours[:, 0] > colours[:, 2] + 60)


def turned(grid: FloorGrid, heading: float) -> FloorMemory:
    memory = FloorMemory(grid)
    memory.move(np.array([0.4, -0.3, heading]))
    return memory


def test_a_picture_of_nothing_is_dark_but_for_the_robot_in_the_middle(grid: FloorGrid) -> None:
    picture = draw_floor(FloorMemory(grid), NOTHING, None)
    assert picture.shape == (SIZE, SIZE, 3)
    assert picture.dtype == np.uint8
    blue = (picture[..., 2].astype(int) - picture[..., 0] > 60).nonzero()
    assert np.mean(blue, axis=1) == pytest.approx([SIZE / 2, SIZE / 2], abs=8)
    assert around(picture, 2.0, 1.0).max() < 100


@headings
@pytest.mark.parametrize("place", [(0.6, 0.0), (0.9, 0.3), (1.0, -0.4)])
def test_what_promises_something_is_green_and_where_the_robot_has_it(place, heading, grid, make_world) -> None:
    """Up is forward, and left is left."""
    memory = turned(grid, heading)
    world = make_world(pose=memory.pose)
    there = memory.to_map(np.array(place))
    world.things = there[None]
    world.look(memory)
    picture = draw_floor(memory, memory.success(0.0), None)
    assert is_green(around(picture, *place)).mean() > 0.3
    assert not is_green(around(picture, place[0], -place[1] - 0.3)).any()
    greens = is_green(picture.reshape(-1, 3).astype(int)).reshape(SIZE, SIZE).nonzero()
    assert np.mean(greens, axis=1) == pytest.approx(pixel(*place), abs=3)


@headings
def test_seen_floor_is_bright_and_what_stands_is_black(heading: float, grid: FloorGrid) -> None:
    memory = turned(grid, heading)
    scan = np.full(len(SCAN_BEARINGS), SCAN_RANGE)
    scan[[abs(bearing) < 12 for bearing in SCAN_BEARINGS]] = 0.9
    empty = np.zeros(grid.known.shape, np.float32)
    memory.look(empty, empty, scan)
    picture = draw_floor(memory, NOTHING, None)
    assert around(picture, 0.6, 0.0).min() > 150
    assert around(picture, 1.1, 0.0).max() < 100, "not seen: behind it"
    assert around(picture, -0.6, 0.0).max() < 100
    assert around(picture, 0.9 * math.cos(0.1), 0.9 * math.sin(0.1), 2).min() < 40


@headings
def test_a_plan_is_drawn_with_its_target(heading: float, grid: FloorGrid) -> None:
    memory = turned(grid, heading)
    way = memory.to_map(np.array([[0.3, 0.1], [0.6, 0.2], [0.9, 0.3]]))
    target = memory.to_map(np.array([1.2, 0.4]))
    plan = Plan((0.1, 0.0), np.array([*way[-1], heading]), way, target, 0.5, False)
    picture = draw_floor(memory, NOTHING, plan)
    reds = is_red(picture.reshape(-1, 3).astype(int)).reshape(SIZE, SIZE)
    beyond = np.indices(reds.shape)[0] < pixel(1.1, 0)[0]
    assert np.mean((reds & beyond).nonzero(), axis=1) == pytest.approx(pixel(1.2, 0.4), abs=4)
    for place in ((0.3, 0.1), (0.6, 0.2), (0.9, 0.3)):
        dots = around(picture, *place)
        assert ((dots[:, 0] > 180) & (dots[:, 1] > 120) & (dots[:, 2] < 120)).any()


def test_the_memory_is_only_looked_at(grid: FloorGrid, make_world) -> None:
    memory = FloorMemory(grid)
    make_world((0.6, 0.0)).look(memory)
    before = memory.success(0.0)
    first, second = (draw_floor(memory, memory.success(0.0), None) for _ in range(2))
    assert np.array_equal(first, second)
    assert np.array_equal(memory.success(0.0), before)
