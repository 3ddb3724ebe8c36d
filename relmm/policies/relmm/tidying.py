"""Maps of the floor as if part of what lies about had been tidied away already.

The robot learns in a room that stays full, because it puts back what it has picked up. At the end of its work there are
only a few things left, far apart: it has to know by then how to search, and that one far thing is worth driving to.
"""

from __future__ import annotations

import torch
from torch import Tensor

from relmm.features import DRIVE_PULSE_S, GRASP_X, GRASP_Y
from relmm.policies.relmm.encoders import FloorObserver, map_places

_PATCH = 0.3  # m, side of the squares of floor that are empty or are not
_PATCHES = 24  # more than the map reaches, in a row
_AREA = complex(sum(GRASP_X) / 2, sum(GRASP_Y) / 2)  # m, its middle
_NEAR = 0.13  # m round it, that is empty as a whole or not at all


def tidy(
    maps: Tensor, next_maps: Tensor, motions: Tensor, empty: Tensor, rng: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """The maps before and after navigation steps, without what lay on a random part of the floor.

    What is gone is gone from both. Colours stay: averaged over a pixel, small things hardly show in them.

    Args:
        maps: uint8, (batch, 4, 30, 31).
        next_maps: those after the steps.
        motions: of each step between, m/s and deg/s, (batch, steps, 2).
        empty: share of the floor, (batch,).
        rng: chooses the squares.

    Returns:
        Like `maps` and `next_maps`; and whether the grasp area lay on an empty part after each step, so that there was
        nothing to pick up, bool, (batch, steps).
    """
    device, count = maps.device, len(maps)
    here = torch.complex(*map_places()).flatten().to(device)  # forward + i * left in the robot's frame, m
    moved, turned = _odometry(motions)
    emptied = torch.rand(count, _PATCHES**2, generator=rng).to(device) < empty[:, None]
    corners = torch.rand(2, count, 1, generator=rng).to(device) + _PATCHES // 2

    def is_empty(places: Tensor) -> Tensor:
        """Whether places, forward + i * left in the frame before the steps, (batch, n), lie on empty squares."""
        rows, columns = (
            (axis / _PATCH + corner).long().clamp(0, _PATCHES - 1)
            for axis, corner in zip((places.real, places.imag), corners, strict=True)
        )
        return emptied.gather(1, rows * _PATCHES + columns)

    reached = _AREA * turned + moved
    nothing = is_empty(reached)

    def without(each: Tensor, places: Tensor) -> Tensor:
        """A map without what lies on empty squares; where its pixels are, in the frame before the steps."""
        near = _squared(places - reached[:, -1:]) < _NEAR**2
        gone = torch.where(near, nothing[:, -1:], is_empty(places))
        graspable = each[:, :1] * ~gone.view(count, 1, *FloorObserver.shape[1:])
        return torch.cat([graspable, each[:, 1:]], dim=1)

    before = without(maps, here.expand(count, -1))
    return before, without(next_maps, here * turned[:, -1:] + moved[:, -1:]), nothing


def _squared(places: Tensor) -> Tensor:
    """Distances squared; the root would take longer than all else here."""
    return places.real.square() + places.imag.square()


def _odometry(motions: Tensor) -> tuple[Tensor, Tensor]:
    """Where steps lead, forward + i * left in m, and how far round, e^(i * angle), after each, (batch, steps)."""
    forward, turns = motions[..., 0] * DRIVE_PULSE_S, motions[..., 1].deg2rad() * DRIVE_PULSE_S
    headings = turns.cumsum(dim=1)
    moved = torch.polar(forward, headings - turns / 2).cumsum(dim=1)
    return moved, torch.polar(torch.ones_like(forward), headings)
