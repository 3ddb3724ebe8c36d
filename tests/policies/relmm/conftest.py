"""Ensembles whose outputs are known, floors of which all is known, and a robot that moves exactly as it is told."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import nn

from relmm.features import (
    ACTION_NAMES,
    DRIVE_PULSE_S,
    MOTION,
    SCAN,
    SCAN_BEARINGS,
    SCAN_RANGE,
    STATE_NAMES,
    FloatArray,
    Skill,
    cell_to_xy,
)
from relmm.geometry import OBJECT_HEIGHT, camera_geometry
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.policies.relmm.grasping import FIRST_COLUMN, FIRST_ROW, GraspEnsemble
from relmm.policies.relmm.memory import PLACES, SIDE, FloorGrid, FloorMemory, cells
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy

SMALL = {"device": "cpu", "num_members": 3, "channels": 4}
_PIXELS = np.stack(np.meshgrid(np.arange(100), np.arange(100)), axis=-1)  # (column, row)
_RADIUS = 0.022  # m, of a thing
_HALF_SECTOR = np.radians((SCAN_BEARINGS[1] - SCAN_BEARINGS[0]) / 2)
_SECTORS = np.radians(np.array(SCAN_BEARINGS))
# Rays a sector: the scan tells the nearest thing in it.
_RAYS = _SECTORS[:, None] + np.linspace(-0.99, 0.99, 5) * _HALF_SECTOR

MakeConfig = Callable[..., ReLMMConfig]
MakePolicy = Callable[..., ReLMMPolicy]


# --- Ensembles and pictures ----------------------------------------------------------------------------------
@pytest.fixture(scope="session")
def make_config() -> MakeConfig:
    """Builds a config with small networks."""
    return lambda **settings: ReLMMConfig(**{**SMALL, **settings})


@pytest.fixture(scope="session")
def make_policy(make_config: MakeConfig) -> MakePolicy:
    """Builds a policy with small networks."""
    return lambda **settings: ReLMMPolicy(make_config(**settings)).eval()


@pytest.fixture(scope="session")
def see_green() -> Callable[..., None]:
    """Makes each member of an ensemble give scale * max(green - red, 0) + bias at each cell, of colours -1..1."""

    def set_(ensemble: GraspEnsemble, scales: Sequence[float], bias: float = -5.0) -> None:
        for member, scale in zip(ensemble.members, scales, strict=True):
            convolutions = [layer for layer in member.learned if isinstance(layer, nn.Conv2d)]
            for layer in [*convolutions, *(layer for layer in member.prior if isinstance(layer, nn.Conv2d))]:
                nn.init.zeros_(layer.weight)
                nn.init.zeros_(layer.bias)
            for layer in convolutions:
                layer.weight.data[0, 0, 1, 1] = 1.0
            convolutions[0].weight.data[0, :, 1, 1] = torch.tensor([-1.0, 1.0, 0.0])
            convolutions[-1].weight.data *= scale
            convolutions[-1].bias.data.fill_(bias)

    return set_


@pytest.fixture(scope="session")
def make_green(make_policy: MakePolicy, see_green) -> MakePolicy:
    """Builds a policy that wants to grasp what is green."""

    def make(scales: Sequence[float] = (6.0, 7.0, 8.0), **settings: Any) -> ReLMMPolicy:
        policy = make_policy(**settings)
        see_green(policy.grasping, scales)
        return policy

    return make


@pytest.fixture(scope="session")
def draw() -> Callable[..., NDArray[np.uint8]]:
    """Draws a grey floor with green things on it, at places in the robot's frame, m, (n, 2)."""

    def picture(things: FloatArray, camera: str = "paper", color: Sequence[int] = (0, 255, 0)) -> NDArray[np.uint8]:
        floor = camera_geometry(camera).pixel_to_floor(_PIXELS, OBJECT_HEIGHT)
        image = np.full((100, 100, 3), 128, np.uint8)
        for thing in np.reshape(things, (-1, 2)):
            image[np.linalg.norm(floor - thing, axis=-1) < _RADIUS] = color
        return image

    return picture


# --- Floors --------------------------------------------------------------------------------------------------
@pytest.fixture(scope="session")
def grid(make_config: MakeConfig) -> FloorGrid:
    """Of the maps that an ensemble draws."""
    return FloorGrid(FIRST_ROW, FIRST_COLUMN, GraspEnsemble(make_config()).known.numpy())


class KnownFloor(FloorMemory):
    """A floor of which all is known.

    Args:
        grid: of the maps, not used.
        standing: where something stands, (SIDE, SIDE); None for nowhere.
    """

    def __init__(self, grid: FloorGrid, standing: NDArray[np.bool_] | None = None) -> None:
        super().__init__(grid)
        self.obstacles = np.zeros((SIDE, SIDE), bool) if standing is None else standing

    @property
    def standing(self) -> NDArray[np.bool_]:
        return self.obstacles

    def unseen(self) -> NDArray[np.float32]:
        return np.zeros((SIDE, SIDE), np.float32)


@pytest.fixture(scope="session")
def known_floor(grid: FloorGrid) -> Callable[..., KnownFloor]:
    """Builds a floor of which all is known; walls are boxes (x from, y from, x to, y to), m."""

    def make(*walls: tuple[float, float, float, float]) -> KnownFloor:
        standing = np.zeros((SIDE, SIDE), bool)
        for wall in walls:
            standing |= ((wall[:2] <= PLACES) & (wall[2:] >= PLACES)).all(axis=-1)
        return KnownFloor(grid, standing)

    return make


@pytest.fixture(scope="session")
def promise() -> Callable[..., NDArray[np.float32]]:
    """What a floor promises where things lie, as bumps 10 cm wide round their cells: ((x, y), success), ..."""

    def success(*things: tuple[tuple[float, float], float]) -> NDArray[np.float32]:
        layer = np.zeros((SIDE, SIDE), np.float32)
        for place, chance in things:
            squared = ((PLACES - PLACES[tuple(cells(np.array(place)))]) ** 2).sum(axis=-1)
            layer = np.maximum(layer, chance * np.exp(-squared / (2 * 0.02**2)) * (squared < 0.05**2))
        return layer.astype(np.float32)

    return success


# --- A robot -------------------------------------------------------------------------------------------------
class World:
    """A robot that moves exactly as it is told, on a floor with things to pick up and posts that stand.

    Args:
        grid: of the maps that an ensemble would draw.
        draw: pictures.
        things: m, (n, 2).
        posts: x, y and radius, m, (n, 3).
        wheel_scale: by which its wheels exaggerate its motions.

    Attributes:
        pose: x, y (m) and heading (rad).
        holding: whether it holds something.
    """

    def __init__(
        self,
        grid: FloorGrid,
        draw: Callable[..., NDArray[np.uint8]],
        things: Sequence[Sequence[float]] = (),
        posts: Sequence[Sequence[float]] = (),
        pose: Sequence[float] = (0.0, 0.0, 0.0),
        wheel_scale: float = 1.0,
    ) -> None:
        self._grid, self._draw, self._wheel_scale = grid, draw, wheel_scale
        self.things, self.posts = np.reshape(things, (-1, 2)).astype(float), np.reshape(posts, (-1, 3)).astype(float)
        self.pose = np.array(pose, float)
        self.motion = np.zeros(3)  # of the last skill, by the wheels
        self.holding = False

    def in_robot_frame(self, places: FloatArray) -> FloatArray:
        """Places, m, (..., 2), as the robot has them."""
        offset = (places - self.pose[:2]) @ np.array([1, 1j])
        turned = offset * np.exp(-1j * self.pose[2])
        return np.stack([turned.real, turned.imag], axis=-1)

    def drive(self, forward: float, turn: float, left: float = 0.0) -> FloatArray:
        """Take a navigation step, m and rad: along an arc, half the turn before its chord and half after it.

        Returns:
            How the wheels tell it: m forward, m left, rad.
        """
        chord = (forward + 1j * left) * np.exp(1j * turn / 2)
        place = self.pose[:2] @ np.array([1, 1j]) + chord * np.exp(1j * self.pose[2])
        self.pose = np.array([place.real, place.imag, self.pose[2] + turn])
        self.motion = self._wheel_scale * np.array([chord.real, chord.imag, turn])
        return self.motion

    def scan(self) -> FloatArray:
        """As `relmm.features.SCAN_NAMES`."""
        centres = self.in_robot_frame(self.posts[:, :2]) @ np.array([1, 1j])
        along = centres * np.exp(-1j * _RAYS[..., None])  # (41, rays, posts), as each ray has them
        with np.errstate(invalid="ignore"):
            near = along.real - np.sqrt(self.posts[:, 2] ** 2 - along.imag**2)
        hit = np.where(np.isfinite(near) & (along.real > 0), near, SCAN_RANGE)
        return np.asarray(hit.min(axis=(1, 2), initial=SCAN_RANGE))

    def mean(self, chance: float = 0.9) -> NDArray[np.float32]:
        """What a perfect ensemble thinks of the floor in view, on the grid's pixels."""
        rows, columns = np.indices(self._grid.known.shape)
        pixels = self._grid.origin + np.stack([rows, columns], axis=-1) * self._grid.pitch
        shown = np.zeros(self._grid.known.shape, np.float32)
        for thing in self.in_robot_frame(self.things):
            squared = ((pixels - thing) ** 2).sum(axis=-1)
            shown = np.maximum(shown, chance * np.exp(-squared / (2 * 0.015**2)) * (squared < 0.04**2))
        return np.where(self._grid.known, shown, 0).astype(np.float32)

    def look(self, memory: FloorMemory, chance: float = 0.9) -> None:
        """Show a memory what is in view."""
        mean = self.mean(chance)
        memory.look(mean, np.zeros_like(mean), self.scan())

    def observe(self) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """The picture, and the state by `relmm.features.STATE_NAMES`."""
        state = np.zeros(len(STATE_NAMES), np.float32)
        state[MOTION] = self.motion / DRIVE_PULSE_S * np.array([1, 1, 180 / np.pi])
        state[SCAN] = self.scan()
        state[STATE_NAMES.index("holding.pos")] = self.holding
        return self._draw(self.in_robot_frame(self.things)), state

    def act(self, action: dict[str, float]) -> bool:
        """Do as told; whether a grasp has picked something up (within 3 cm; then it is held, and not on the floor)."""
        assert set(action) == set(ACTION_NAMES)
        self.motion = np.zeros(3)
        there = np.array([action["skill_x.pos"], action["skill_y.pos"]])
        match Skill(int(action["skill.pos"])):
            case Skill.NAVIGATE:
                self.drive(action["x.vel"] * DRIVE_PULSE_S, np.radians(action["theta.vel"]) * DRIVE_PULSE_S)
            case Skill.PLACE:
                place = self.pose[:2] @ np.array([1, 1j]) + (there @ np.array([1, 1j])) * np.exp(1j * self.pose[2])
                self.things = np.vstack([self.things, [place.real, place.imag]])
                self.holding = False
            case Skill.GRASP:
                reached = np.linalg.norm(self.in_robot_frame(self.things) - there, axis=1) < 0.03
                self.things, self.holding = self.things[~reached], bool(reached.any())
                return self.holding
        return False


@pytest.fixture(scope="session")
def make_world(grid: FloorGrid, draw) -> Callable[..., World]:
    """Builds a robot in its surroundings."""
    return lambda *things, **settings: World(grid, draw, things, **settings)


@pytest.fixture(scope="session")
def thing_at(draw) -> Callable[[int], NDArray[np.uint8]]:
    """A picture of a green thing in a grasp cell."""
    return lambda cell: draw(cell_to_xy(cell))
