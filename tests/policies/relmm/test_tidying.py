"""Maps of a tidier room: what is gone is gone before and after a step, and cannot have been picked up."""

import cmath
import math

import pytest
import torch
from torch import Tensor

from relmm.features import DRIVE_PULSE_S, GRASP_X, MAX_THETA_VEL
from relmm.policies.relmm.batch import NavigationBatch
from relmm.policies.relmm.encoders import FloorObserver, map_places
from relmm.policies.relmm.tidying import tidy

COUNT = 400
STEPS = [(0.0, 0.0), (0.44, 0.0), (0.0, MAX_THETA_VEL), (0.3, -80.0), (0.44, 60.0)]  # m/s and deg/s


def maps(count: int = COUNT) -> Tensor:
    return torch.full((count, *FloorObserver.shape), 200, dtype=torch.uint8)


def motions(*steps: tuple[float, float], count: int = COUNT) -> Tensor:
    return torch.tensor(steps).expand(count, -1, -1)


def pixel_of(forward: float, left: float) -> tuple[int, int] | None:
    """The map's pixel of a place in the robot's frame, m, if the map reaches there."""
    places = map_places()
    distances = torch.hypot(places[0] - forward, places[1] - left)
    row, column = divmod(int(distances.argmin()), places.shape[2])
    return (row, column) if distances.min() < 0.04 else None


@pytest.mark.parametrize(("x_vel", "theta_vel"), STEPS)
def test_what_is_gone_before_a_step_is_gone_after_it(x_vel: float, theta_vel: float) -> None:
    """Where the same place of the floor is, comes from how the robot moves: along an arc of 0.24 s."""
    generator = torch.Generator().manual_seed(0)
    before, after, _ = tidy(maps(), maps(), motions((x_vel, theta_vel)), torch.full((COUNT,), 0.5), generator)
    turn, length = math.radians(theta_vel) * DRIVE_PULSE_S, x_vel * DRIVE_PULSE_S
    robot = (length * math.cos(turn / 2), length * math.sin(turn / 2))
    compared = differing = 0
    for forward in (0.7, 1.0, 1.3, 1.6, 1.9):
        for left in (-0.6, -0.3, 0.0, 0.3, 0.6):
            x, y = forward - robot[0], left - robot[1]
            there = pixel_of(math.cos(turn) * x + math.sin(turn) * y, math.cos(turn) * y - math.sin(turn) * x)
            here = pixel_of(forward, left)
            if there is not None and here is not None:
                compared += COUNT
                differing += int((before[:, 0, *here] != after[:, 0, *there]).sum())
    assert compared > 5 * COUNT
    assert differing / compared < 0.15, "but for places at the edge of a square; by chance it would be half"


def test_several_steps_lead_where_they_lead_one_after_the_other() -> None:
    """Around a square, by quarter turns: back to where it began; a step that is not there changes nothing."""
    quarter = 90 / DRIVE_PULSE_S
    for steps in ([(0.4, 0.0), (0.0, quarter)] * 4, [(0.0, 0.0)]):
        before, after, _ = tidy(
            maps(), maps(), motions(*steps), torch.full((COUNT,), 0.5), torch.Generator().manual_seed(4)
        )
        assert (before != after).float().mean() < 0.01, "but for rounding at the edges of squares"
    straight = [motions((0.3, 0.0), (0.4, 0.0), (0.0, 0.0)), motions((0.7, 0.0))]
    results = [
        tidy(maps(), maps(), each, torch.full((COUNT,), 0.5), torch.Generator().manual_seed(5)) for each in straight
    ]
    for one, other in zip(*results, strict=True):
        assert (one[:, -1] != other[:, -1]).float().mean() < 0.01


@pytest.mark.parametrize("empty", [0.0, 0.3, 1.0])
def test_share_of_the_floor_is_emptied_and_colours_stay(empty: float) -> None:
    generator = torch.Generator().manual_seed(1)
    before, after, _ = tidy(maps(), maps(), motions((0.2, 40.0)), torch.full((COUNT,), empty), generator)
    far = torch.hypot(map_places()[0] - sum(GRASP_X) / 2, map_places()[1]) > 0.6
    for each in (before, after):
        assert (each[:, 0, far] == 0).float().mean().item() == pytest.approx(empty, abs=0.03)
        assert set(each[:, 0].unique().tolist()) <= {0, 200}
        assert torch.equal(each[:, 1:], maps()[:, 1:])


@pytest.mark.parametrize("steps", [[step] for step in STEPS] + [STEPS])
def test_the_grasp_area_is_empty_as_a_whole_or_not_at_all(steps: list[tuple[float, float]]) -> None:
    """After the last step; what lies there was somewhere before it, and is gone from there, too."""
    generator = torch.Generator().manual_seed(2)
    before, after, nothing = tidy(maps(), maps(), motions(*steps), torch.full((COUNT,), 0.5), generator)
    assert nothing.shape == (COUNT, len(steps))
    assert nothing.float().mean().item() == pytest.approx(0.5, abs=0.08)
    place, heading = 0j, 0.0
    for x_vel, theta_vel in steps:
        turn = math.radians(theta_vel) * DRIVE_PULSE_S
        place += cmath.rect(x_vel * DRIVE_PULSE_S, heading + turn / 2)
        heading += turn
    for forward in GRASP_X:
        then = place + cmath.rect(forward, heading)
        now, there = pixel_of(forward, 0.0), pixel_of(then.real, then.imag)
        assert now is not None
        assert torch.equal(after[:, 0, *now] == 0, nothing[:, -1])
        if there is not None:
            assert torch.equal(before[:, 0, *there] == 0, nothing[:, -1])


def test_where_nothing_lies_any_more_nothing_can_have_been_picked_up() -> None:
    """A success with the first step, and one with the second of two."""
    generator = torch.Generator().manual_seed(6)
    zeros, rewards = torch.zeros(COUNT), torch.tensor([[0.0, 0.0], [-0.7, 0.0]]).repeat(COUNT // 2, 1)
    continues, lengths = torch.tensor([[0.0, 0.0], [0.7, 0.0]]).repeat(COUNT // 2, 1), torch.tensor([1, 2])
    drives = motions((0.44, 0.0), (0.0, 0.0))
    batch = NavigationBatch(
        maps(), zeros, torch.zeros(COUNT, 2), rewards, maps(), zeros, continues, lengths.repeat(COUNT // 2), drives
    )
    tidied = batch.tidied(1.0, generator)
    area = pixel_of(sum(GRASP_X) / 2, 0.0)
    assert area is not None
    gone = tidied.next_observations[:, 0, *area] == 0
    assert 0.3 < gone.float().mean() < 0.8
    assert torch.equal(tidied.rewards[:, -1], torch.where(gone, -1.0, rewards[:, -1]))
    assert torch.equal(tidied.continues[:, -1], torch.where(gone, 1.0, continues[:, -1]))
    assert torch.equal(tidied.actions, batch.actions)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_share_of_the_steps_is_tidied(share: float) -> None:
    numbers, ones = torch.zeros(COUNT), torch.ones(COUNT, 1)
    batch = NavigationBatch(
        *(maps(), numbers, torch.zeros(COUNT, 2), ones - 2, maps(), numbers, ones, ones.long()[:, 0]),
        motions((0.1, 0.0)),
    )
    tidied = batch.tidied(share, torch.Generator().manual_seed(3))
    touched = (tidied.observations[:, 0] == 0).flatten(1).any(dim=1)
    assert touched.float().mean().item() == pytest.approx(share, abs=0.08)
    bare = (tidied.observations[:, 0] == 0).flatten(1).all(dim=1)
    assert bare.float().mean().item() == pytest.approx(share / 5, abs=0.06), "everything is gone"
    assert torch.equal(tidied.rewards, batch.rewards), "a step without success is one without it in a tidier room"
    assert torch.equal(tidied.continues, batch.continues)
