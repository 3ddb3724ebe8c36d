from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from relmm.features import GRASP_X, GRASP_Y, GRID, cell_to_xy, xy_to_cell
from relmm.geometry import CAMERAS, OBJECT_HEIGHT, CameraGeometry, camera_geometry
from relmm.policies.relmm.floor import FloorView
from relmm.sim.body import SimBody
from relmm.sim.rooms import make_room

CELL = np.array([GRASP_X[1] - GRASP_X[0], GRASP_Y[1] - GRASP_Y[0]]) / GRID  # m
WIDE = (-5, -75, 100, 165)  # first row and column, rows and columns: as the navigation's map
AWAY = np.array([-1.2, 0.0])  # m, behind the robot


@pytest.fixture(scope="module", params=CAMERAS)
def body(request: pytest.FixtureRequest) -> Iterator[SimBody]:
    """A robot and one ball in a plain room."""
    body = SimBody(make_room("no_obstacles", num_objects=1, floor="plain"), camera_geometry(request.param))
    body.reset(np.random.default_rng(0))
    yield body
    body.close()


def to_images(picture: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(picture).permute(2, 0, 1)[None] / 255


def seen_at(body: SimBody, view: FloorView, place: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Where the map shows the ball, and where it really is: (row, column) of the map."""
    body.put_object(0, AWAY)
    without = view(to_images(body.capture()[0]))
    body.put_object(0, np.array(place))
    change = (view(to_images(body.capture()[0])) - without).abs().sum(dim=1)[0].numpy()
    change[change < 0.5 * change.max()] = 0.0
    seen = [(index * change).sum() / change.sum() for index in np.indices(change.shape)]
    x, y = body.truth.objects_in_robot_frame()[0][:2]
    return np.array(seen), np.array([(x - GRASP_X[0]) / CELL[0], (y - GRASP_Y[0]) / CELL[1]]) - 0.5


@pytest.mark.parametrize("place", [(0.31, 0.0), (0.31, -0.07), (0.38, 0.03), (0.45, 0.07), (0.46, -0.07), (0.40, 0.0)])
def test_ball_in_reach_is_shown_in_its_cell(body: SimBody, place: tuple[float, float]) -> None:
    seen, true = seen_at(body, FloorView(body.camera, 0, 0, GRID, GRID), place)
    assert np.abs(seen - true).max() < 1.0


@pytest.mark.parametrize("place", [(0.6, 0.2), (0.6, -0.2), (0.9, 0.0), (0.95, 0.3), (0.95, -0.3)])
def test_ball_out_of_reach_is_shown_within_a_pixel_of_the_navigation_map(body: SimBody, place) -> None:
    seen, true = seen_at(body, FloorView(body.camera, *WIDE), place)
    assert np.abs(seen + WIDE[:2] - true).max() < 2.5


def test_rows_go_away_from_the_robot_and_columns_to_its_left(body: SimBody) -> None:
    view = FloorView(body.camera, *WIDE)
    near, far, right, left = (seen_at(body, view, p)[0] for p in ((0.4, 0), (0.8, 0), (0.6, -0.15), (0.6, 0.15)))
    assert far[0] > near[0] + 20
    assert left[1] > right[1] + 20


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("rectangle", [(0, 0, GRID, GRID), (-4, -4, GRID + 8, GRID + 8), (0, -30, 60, 75)])
def test_cells_show_what_the_closed_form_says(camera: CameraGeometry, rectangle: tuple[int, int, int, int]) -> None:
    """A picture that tells each pixel's place: what a cell shows is then a pixel, and that is seen at the cell."""
    rows, columns = np.mgrid[0:100, 0:100]
    picture = torch.from_numpy(np.stack([columns, rows, rows * 0]) / 99).float()[None]
    view = FloorView(camera, *rectangle)
    pixels = ((view(picture)[0, :2] + 1) / 2 * 99).permute(1, 2, 0).double().numpy()
    inside = (view.grid.abs() < 0.98).all(dim=-1).numpy()
    starts = (range(first, first + count) for first, count in zip(rectangle[:2], rectangle[2:], strict=True))
    cells = np.stack(np.meshgrid(*starts, indexing="ij"), axis=-1)
    places = np.array([GRASP_X[0], GRASP_Y[0]]) + (cells + 0.5) * CELL
    assert inside.mean() > 0.5
    assert np.abs(camera.pixel_to_floor(pixels, OBJECT_HEIGHT) - places)[inside].max() < 1e-3


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_map_counts_as_the_grasp_cells_do(camera: CameraGeometry) -> None:
    grid = FloorView(camera, 0, 0, GRID, GRID).grid.reshape(-1, 2).double().numpy()
    pixels = (grid + 1) / 2 * np.array(camera.size) - 0.5
    places = camera.pixel_to_floor(pixels, OBJECT_HEIGHT)
    assert np.abs(places - cell_to_xy(np.arange(GRID**2))).max() < 1e-5
    assert [xy_to_cell(x, y) for x, y in places] == list(range(GRID**2))


def test_colours_are_scaled_and_what_is_out_of_view_is_grey() -> None:
    view = FloorView(CAMERAS["paper"], -60, -200, 100, 400)  # from behind the robot to far beside it
    picture = torch.tensor([0.0, 0.5, 1.0])[None, :, None, None].expand(2, 3, 100, 100)
    floor = view(picture)
    assert floor.shape == (2, 3, 100, 400)
    out = (view.grid.abs() > 1.02).any(dim=-1)
    inside = (view.grid.abs() < 0.98).all(dim=-1)
    assert out.any()
    assert inside.any()
    assert torch.equal(floor[:, :, out], torch.zeros_like(floor[:, :, out]))
    assert torch.allclose(floor[:, :, inside], torch.tensor([-1.0, 0.0, 1.0])[None, :, None], atol=1e-5)


def test_view_is_not_saved_with_the_weights() -> None:
    assert FloorView(CAMERAS["paper"], 0, 0, 2, 2).state_dict() == {}
