"""The pseudo-reset (paper 4.3): carry what was picked up to somewhere else, put it down there, and drive away."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from relmm.features import MAX_THETA_VEL, MAX_X_VEL, Skill, action_dict

# m, where the object is put down. The authors do it at 0.40 in front of the robot; nearer, fewer end up at a wall.
PLACE_XY = (0.33, 0.0)
_TURN_ROUND_STEPS = 6  # 162 degrees: in front there often is a wall by then, and things at a wall are hard to pick up
_TURN_AWAY_STEPS = 4  # 108 degrees, so that driving on does not push what was just put down


def drive_anywhere(rng: np.random.Generator) -> dict[str, float]:
    """A navigation step drawn uniformly from all of them."""
    return action_dict(x_vel=rng.uniform(0, MAX_X_VEL), theta_vel=rng.uniform(-MAX_THETA_VEL, MAX_THETA_VEL))


def is_turn(x_vel: float, theta_vel: float) -> bool:
    """Whether a navigation step of a pseudo-reset is one of the turns before and after the object is put down."""
    return x_vel == 0 and abs(theta_vel) == MAX_THETA_VEL


def random_pseudo_reset(
    rng: np.random.Generator, steps: int, holding: Callable[[], bool]
) -> Iterator[dict[str, float]]:
    """The actions of the paper's pseudo-reset, which drives at random; see `driven_pseudo_reset`."""
    return driven_pseudo_reset(rng, steps, holding, *[lambda: drive_anywhere(rng)] * 2)


def driven_pseudo_reset(
    rng: np.random.Generator,
    steps: int,
    holding: Callable[[], bool],
    carry: Callable[[], dict[str, float]],
    leave: Callable[[], dict[str, float]],
) -> Iterator[dict[str, float]]:
    """The actions of a pseudo-reset.

    Args:
        rng: of the turns.
        steps: navigation steps before and after the object is put down.
        holding: whether something is in the gripper now; it may be lost on the way.
        carry: the next navigation step before.
        leave: the next one after.
    """
    for _ in range(steps):
        yield carry()
    direction = float(rng.choice((-1.0, 1.0)))
    for _ in range(_TURN_ROUND_STEPS):
        yield action_dict(theta_vel=direction * MAX_THETA_VEL)
    if holding():
        yield action_dict(Skill.PLACE, x=PLACE_XY[0], y=PLACE_XY[1])
    direction = float(rng.choice((-1.0, 1.0)))
    for _ in range(_TURN_AWAY_STEPS):
        yield action_dict(theta_vel=direction * MAX_THETA_VEL)
    for _ in range(steps):
        yield leave()
