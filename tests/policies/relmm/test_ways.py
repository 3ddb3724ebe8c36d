from __future__ import annotations

import heapq
import itertools
import math

import numpy as np
import pytest

from relmm.features import FloatArray
from relmm.policies.relmm.memory import CELL, SIDE
from relmm.policies.relmm.ways import COARSE, ROOMY, TIGHT, WAY_PLACES, Ways

NO_THINGS = np.zeros((0, 2))
BODY = 0.19  # m, within which the base pushes a thing: their radii


def dijkstra(costs: FloatArray, start: tuple[int, int]) -> FloatArray:
    """The least cost to each cell: a step to a cell costs its length, m, times the cell's cost."""
    lengths = np.full(costs.shape, math.inf)
    lengths[start] = 0
    queue: list[tuple[float, tuple[int, int]]] = [(0.0, start)]
    while queue:
        length, (row, column) = heapq.heappop(queue)
        if length > lengths[row, column]:
            continue
        for down, right in itertools.product((-1, 0, 1), repeat=2):
            beside = row + down, column + right
            if (down or right) and 0 <= beside[0] < len(costs) and 0 <= beside[1] < costs.shape[1]:
                there = length + COARSE * CELL * math.hypot(down, right) * costs[beside]
                if there < lengths[beside]:
                    lengths[beside] = there
                    heapq.heappush(queue, (there, beside))
    return lengths


def test_lengths_of_ways_are_the_least_there_are(known_floor) -> None:
    memory = known_floor((0.5, -1.0, 0.6, 2.0), (-1.0, 0.9, 0.5, 1.0), (-0.5, -1.5, -0.4, -0.2))
    ways = Ways(np.array([0.12, 0.13]), memory.clearance(), np.array([[-0.3, 0.4], [0.2, -0.9]]))
    start = (np.floor(np.array([0.12, 0.13]) / (COARSE * CELL)) + SIDE // COARSE // 2).astype(int)
    assert len(np.unique(ways.costs)) >= 3
    assert ways.lengths() == pytest.approx(dijkstra(ways.costs, tuple(start)))


def test_the_nearer_to_what_stands_and_lies_the_dearer_the_way(known_floor) -> None:
    memory, thing = known_floor((0.5, -3.2, 0.6, 3.2)), np.array([-0.8, 0.0])
    costs = Ways(np.zeros(2), memory.clearance(), thing[None]).costs
    x, y = np.moveaxis(WAY_PLACES, -1, 0)
    to_wall = np.maximum(np.maximum(0.5 - x, x - 0.6), 0)
    to_thing = np.hypot(x - thing[0], y - thing[1])
    assert (costs[(to_wall > 0.6) & (to_thing > 0.4)] == 1).all()
    inside, beside = costs[to_wall < TIGHT - 2 * CELL], costs[(to_wall > TIGHT + CELL) & (to_wall < ROOMY - CELL)]
    assert inside.min() > 10 > beside.max() >= beside.min() > 1
    assert costs[to_thing < 0.15].min() > 1


@pytest.mark.parametrize("place", [(1.2, 0.0), (0.5, 0.5), (-0.7, 1.4), (0.0, -2.0)])
def test_ways_over_free_floor_are_as_long_as_they_look(place: tuple[float, float], known_floor) -> None:
    ways = Ways(np.zeros(2), known_floor().clearance(), NO_THINGS)
    high, low = max(map(abs, place)), min(map(abs, place))
    octile = high - low + math.sqrt(2) * low
    assert ways.length(np.array(place)) == pytest.approx(octile, abs=1.5 * COARSE * CELL)
    way = ways.way(np.array(place))
    assert way[-1] == pytest.approx(np.array(place))
    along = np.vstack([np.zeros(2), way])
    assert np.linalg.norm(np.diff(along, axis=0), axis=1).sum() == pytest.approx(octile, abs=2 * COARSE * CELL)


def test_a_way_passes_no_wall_that_it_can_get_round(known_floor) -> None:
    memory = known_floor((0.5, -1.0, 0.6, 2.0))
    ways = Ways(np.zeros(2), memory.clearance(), NO_THINGS)
    way = ways.way(np.array([1.3, 0.3]))
    rows, columns = np.moveaxis(np.floor(way / CELL).astype(int) + SIDE // 2, -1, 0)
    assert memory.clearance()[rows, columns].min() >= TIGHT - CELL
    assert way[:, 1].min() < -1.0


def test_the_way_to_where_it_is_goes_nowhere(known_floor) -> None:
    here = np.array([0.31, 0.17])
    ways = Ways(here, known_floor().clearance(), NO_THINGS)
    assert ways.length(here) == 0
    assert ways.way(here) == pytest.approx(here[None])
