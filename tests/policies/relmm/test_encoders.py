from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.nn import functional

from relmm.features import GRASP_X, GRASP_Y, GRID
from relmm.geometry import camera_geometry
from relmm.policies.relmm.configuration_relmm import NAVIGATION_ENCODERS
from relmm.policies.relmm.encoders import Encoder, FloorObserver, Keypoints, PictureObserver, make_observer
from relmm.policies.relmm.floor import OBJECT_HEIGHT
from relmm.policies.relmm.grasping import GraspEnsemble
from relmm.policies.relmm.trail import TRAIL_FEATURES

REACH = (slice(1, 4), slice(15, 18))  # pixels of the map that the grasp cells make up
PIXEL = 5  # cells a side


@pytest.fixture
def ensemble(make_config) -> GraspEnsemble:
    torch.manual_seed(0)
    return GraspEnsemble(make_config())


@pytest.fixture
def observer(make_config) -> FloorObserver:
    return FloorObserver(make_config())


def no_trails(count: int) -> torch.Tensor:
    return torch.zeros(count, TRAIL_FEATURES)


def to_images(picture: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(picture).permute(2, 0, 1)[None] / 255


# --- The map -------------------------------------------------------------------------------------------------
def test_map_agrees_with_the_grasp_cells_where_the_arm_reaches(observer, ensemble, noise_pictures) -> None:
    """The map is drawn by the first two members; a pixel shows the best of its 5x5 cells."""
    images = noise_pictures(2)
    chances = ensemble.logits(images)[:2].mean(dim=0).sigmoid()
    cells = chances.reshape(2, GRID // PIXEL, PIXEL, GRID // PIXEL, PIXEL)
    drawn = observer(images, ensemble)[:, 0][:, *REACH]
    assert (drawn.float() - cells.amax(dim=(2, 4)) * 255).abs().max() <= 1


def test_map_shows_the_mean_colours_of_the_floor(observer, ensemble, noise_pictures) -> None:
    images = noise_pictures(2)
    floor = ensemble.backbone.view(images)[:, :, 4:-4, 4:-4]
    colours = functional.avg_pool2d((floor + 1) / 2, PIXEL) * 255
    assert (observer(images, ensemble)[:, 1:][:, :, *REACH].float() - colours).abs().max() <= 1


@pytest.mark.parametrize("camera", ["paper", "d435"])
@pytest.mark.parametrize(("x", "y"), [(0.35, 0.05), (0.5, 0.2), (0.7, -0.25), (0.9, 0.0)])
def test_thing_beyond_reach_is_judged_where_it_lies(x, y, camera, make_config, see_green, draw) -> None:
    config = make_config(camera=camera)
    ensemble = GraspEnsemble(config)
    see_green(ensemble, [30.0] * 3)
    picture = draw(camera=camera)
    column, row = camera_geometry(camera).project(np.array([x, y, OBJECT_HEIGHT])).round().astype(int)
    picture[row - 1 : row + 2, column - 1 : column + 2] = (0, 255, 0)
    graspable = FloorObserver(config)(to_images(picture), ensemble)[0, 0].float()
    rows, columns = torch.nonzero(graspable > 128, as_tuple=True)
    cell = (GRASP_X[1] - GRASP_X[0]) / GRID, (GRASP_Y[1] - GRASP_Y[0]) / GRID
    true_row = ((x - GRASP_X[0]) / cell[0] + PIXEL) / PIXEL - 0.5
    true_column = ((y - GRASP_Y[0]) / cell[1] + 75) / PIXEL - 0.5
    assert rows.float().mean().item() == pytest.approx(true_row, abs=1.0)
    assert columns.float().mean().item() == pytest.approx(true_column, abs=1.0)


def test_mirrored_floor_gives_a_mirrored_map(observer, ensemble, see_green, noise_pictures) -> None:
    """The paper's camera looks straight ahead, so left and right of the map may be exchanged."""
    see_green(ensemble, [3.0] * 3)
    images = noise_pictures(1)
    seen, mirrored = observer(images, ensemble), observer(images.flip(-1), ensemble).flip(-1)
    assert (seen.int() - mirrored.int()).abs().max() <= 1


@pytest.mark.parametrize("camera", ["paper", "d435"])
def test_nothing_is_graspable_out_of_view_or_farther_off_than_is_judged(camera, make_config) -> None:
    config = make_config(camera=camera, grasp_initial_logit=5.0, grasp_initial_spread=0.0)
    observer = FloorObserver(config)
    graspable = observer(torch.zeros(1, 3, 100, 100), GraspEnsemble(config))[0, 0]
    visible = functional.max_pool2d((observer.view.grid.abs() <= 1).all(-1)[4:-4, 4:-4].float()[None], PIXEL)[0]
    visible[20:] = 0
    assert torch.equal(graspable > 0, visible > 0)
    assert 0 < (graspable > 0).float().mean() < 1


def test_map_follows_what_the_ensemble_learns(observer, ensemble, see_green, draw) -> None:
    images = to_images(draw(112))
    see_green(ensemble, [0.0] * 3)
    assert observer(images, ensemble)[0, 0, 2, 16] < 10
    see_green(ensemble, [30.0] * 3)
    assert observer(images, ensemble)[0, 0, 2, 16] > 245


# --- Observers and encoders ----------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", NAVIGATION_ENCODERS)
def test_observation_and_features_have_the_promised_shapes(kind: str, make_config, noise_pictures) -> None:
    config = make_config("rectified" if kind == "floor" else "dense", navigation_encoder=kind)
    observer = make_observer(config)
    observations = observer(noise_pictures(2), GraspEnsemble(config))
    assert isinstance(observer, FloorObserver if kind == "floor" else PictureObserver)
    assert observations.dtype == torch.uint8
    assert observations.shape == (2, *observer.shape)
    encoder = Encoder(kind)
    assert encoder(observations, no_trails(2)).shape == (2, encoder.features)


def test_paper_encoder_is_that_of_the_authors() -> None:
    encoder = Encoder("paper")
    assert encoder.features == 9216
    assert sum(weight.numel() for weight in encoder.parameters()) == 75_648


def test_picture_observer_gives_back_the_stored_picture(ensemble) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (100, 100, 3), np.uint8)
    assert torch.equal(PictureObserver()(to_images(picture), ensemble)[0].permute(1, 2, 0), torch.from_numpy(picture))


def test_encoder_scales_its_input_to_plus_and_minus_1() -> None:
    encoder = Encoder("floor")
    seen: list[torch.Tensor] = []
    encoder.layers[0].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    encoder(torch.tensor([0, 255], dtype=torch.uint8)[:, None, None, None].expand(2, 4, 32, 33), no_trails(2))
    assert [float(values.min()) for values in seen[0]] == [float(values.max()) for values in seen[0]] == [-1.0, 1.0]


@pytest.mark.parametrize(("kind", "matters"), [("floor", True), ("paper", False), ("paper_small", False)])
def test_trail_matters_beside_a_map_of_the_floor_only(kind: str, matters: bool) -> None:
    encoder = Encoder(kind)
    shape = FloorObserver.shape if kind == "floor" else PictureObserver.shape
    observations = torch.zeros(1, *shape, dtype=torch.uint8)
    here, moved = (encoder(observations, trails) for trails in (no_trails(1), no_trails(1) + 1))
    assert torch.equal(here, moved) != matters


# --- Keypoints -----------------------------------------------------------------------------------------------
def points_of(keypoints: Keypoints, maps: torch.Tensor) -> torch.Tensor:
    """x, y and graspability of the point that each head finds in one map, (heads, 3)."""
    with torch.no_grad():
        return keypoints(maps[None]).reshape(-1, 3)


def map_of(*pixels: tuple[int, int]) -> torch.Tensor:
    """A grey map with nothing to grasp but at these pixels, -1..1."""
    maps = torch.zeros(FloorObserver.shape)
    maps[0] = -1.0
    for row, column in pixels:
        maps[0, row, column] = 1.0
    return maps


def pixel_at(x: float, y: float) -> tuple[int, int]:
    """The pixel of the map that shows a point of the floor (m, robot frame)."""
    size_x, size_y = ((high - low) / GRID * PIXEL for low, high in (GRASP_X, GRASP_Y))
    return math.floor((x - GRASP_X[0]) / size_x) + 1, math.floor((y - GRASP_Y[0]) / size_y) + 15


@pytest.mark.parametrize(("x", "y"), [(0.38, 0.0), (0.38, 0.05), (0.44, -0.05), (0.5, 0.1)])
def test_every_head_finds_the_only_graspable_pixel_nearby(x: float, y: float) -> None:
    middle = sum(GRASP_X) / 2
    for found_x, found_y, graspable in points_of(Keypoints(), map_of(pixel_at(x, y))).tolist():
        assert found_x == pytest.approx(x - middle, abs=0.04)
        assert found_y == pytest.approx(y, abs=0.04)
        assert graspable > 0.8


@pytest.mark.parametrize(("x", "y"), [(0.6, 0.3), (0.9, -0.4), (1.3, 0.0), (1.2, 0.7)])
def test_farsighted_head_finds_the_only_graspable_pixel_farther_off(x: float, y: float) -> None:
    found_x, found_y, graspable = points_of(Keypoints(), map_of(pixel_at(x, y)))[-1].tolist()
    assert found_x == pytest.approx(x - sum(GRASP_X) / 2, abs=0.08)
    assert found_y == pytest.approx(y, abs=0.08)
    assert graspable > 0.8


def test_nearer_of_two_graspable_pixels_is_preferred() -> None:
    """The more, the shorter a head's sight."""
    near, far = pixel_at(0.45, 0.1), pixel_at(1.3, -0.4)
    left = points_of(Keypoints(), map_of(near, far))[:, 1]
    assert left[:2].tolist() == pytest.approx([0.108] * 2, abs=0.01)
    assert (left[:-1] > left[1:]).all()
    assert left[-1] > (0.1 - 0.4) / 2, "nearer to the near one than to the far one"


def test_point_is_a_mean_of_places_on_the_map() -> None:
    keypoints = Keypoints()
    maps = torch.rand(5, *FloorObserver.shape, generator=torch.Generator().manual_seed(0)) * 2 - 1
    places = keypoints.places
    for found in (points_of(keypoints, each) for each in maps):
        assert ((found[:, :2] >= places.amin(dim=1)) & (found[:, :2] <= places.amax(dim=1))).all()
        assert (found[:, 2].abs() <= 1).all()


@pytest.mark.parametrize("seed", range(3))
def test_fresh_keypoints_of_a_mirrored_map_are_mirrored(seed: int) -> None:
    torch.manual_seed(seed)
    keypoints, maps = Keypoints(), torch.rand(FloorObserver.shape) * 2 - 1
    seen, mirrored = points_of(keypoints, maps), points_of(keypoints, maps.flip(-1))
    assert torch.allclose(mirrored, seen * torch.tensor([1.0, -1.0, 1.0]), atol=1e-5)
    assert seen[:, 1].abs().max() > 1e-3


def test_places_are_not_saved_but_what_is_preferred_is() -> None:
    assert set(Keypoints().state_dict()) == {"look.weight", "prefer"}
