from __future__ import annotations

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

PIXEL = 7  # cells a side
REACH = slice(1, 3), slice(15, 16)  # pixels wholly in the grasp area
REACHED_CELLS = slice(0, 14), slice(4, 11)  # that they are made of
MIDDLE = (1 + GRID / 2 / PIXEL - 0.5, 15)  # pixel, of the grasp area


@pytest.fixture
def ensemble(make_config) -> GraspEnsemble:
    torch.manual_seed(0)
    return GraspEnsemble(make_config())


@pytest.fixture
def observer(make_config) -> FloorObserver:
    return FloorObserver(make_config())


def to_images(picture: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(picture).permute(2, 0, 1)[None] / 255


# --- The map -------------------------------------------------------------------------------------------------
def test_map_agrees_with_the_grasp_cells_where_the_arm_reaches(observer, ensemble, noise_pictures) -> None:
    """The map is drawn by the first member; a pixel shows the best of its 7x7 cells."""
    images = noise_pictures(2)
    cells = ensemble.logits(images)[0].sigmoid().reshape(2, GRID, GRID)[:, *REACHED_CELLS]
    drawn = observer(images, ensemble)[:, 0][:, *REACH]
    assert (drawn.float() - functional.max_pool2d(cells, PIXEL) * 255).abs().max() <= 1


@pytest.mark.parametrize("camera", ["paper", "d435"])
def test_map_shows_all_that_is_in_view(camera, make_config, noise_pictures) -> None:
    """Against the first member on the whole floor at once."""
    config, images = make_config(camera=camera), noise_pictures(2)
    observer, ensemble = FloorObserver(config), GraspEnsemble(config)
    everywhere = ensemble.backbone.on_map(observer.view(images))[0].sigmoid() * observer.known
    assert torch.allclose(ensemble.backbone.first_on_map(observer.view(images)).sigmoid() * observer.known, everywhere)
    drawn = observer(images, ensemble)[:, 0].float()
    assert (drawn - functional.max_pool2d(everywhere, PIXEL) * 255).abs().max() <= 1


def test_map_shows_the_mean_colours_of_the_floor(observer, ensemble, noise_pictures) -> None:
    images = noise_pictures(2)
    floor = ensemble.backbone.view(images)[:, :, 4:-4, 4:-4]
    colours = functional.avg_pool2d((floor[:, :, *REACHED_CELLS] + 1) / 2, PIXEL) * 255
    assert (observer(images, ensemble)[:, 1:][:, :, *REACH].float() - colours).abs().max() <= 1


@pytest.mark.parametrize(
    ("camera", "x", "y"),
    [
        ("paper", 2.0, 0.5),
        *((camera, *at) for camera in ("paper", "d435") for at in [(0.35, 0.05), (0.5, 0.2), (0.7, -0.25), (0.9, 0.0)]),
    ],
)
def test_thing_beyond_reach_is_judged_where_it_lies(camera, x, y, make_config, see_green, draw) -> None:
    config = make_config(camera=camera)
    ensemble = GraspEnsemble(config)
    see_green(ensemble, [30.0] * 3)
    picture = draw(camera=camera)
    column, row = camera_geometry(camera).project(np.array([x, y, OBJECT_HEIGHT])).round().astype(int)
    picture[row - 1 : row + 2, column - 1 : column + 2] = (0, 255, 0)
    graspable = FloorObserver(config)(to_images(picture), ensemble)[0, 0].float()
    rows, columns = torch.nonzero(graspable > 128, as_tuple=True)
    cell = (GRASP_X[1] - GRASP_X[0]) / GRID, (GRASP_Y[1] - GRASP_Y[0]) / GRID
    true_row = ((x - GRASP_X[0]) / cell[0] - GRID / 2) / PIXEL + MIDDLE[0]
    true_column = ((y - GRASP_Y[0]) / cell[1] - GRID / 2) / PIXEL + MIDDLE[1]
    assert rows.float().mean().item() == pytest.approx(true_row, abs=1.0)
    assert columns.float().mean().item() == pytest.approx(true_column, abs=1.0)


def test_mirrored_floor_gives_a_mirrored_map(observer, ensemble, see_green, noise_pictures) -> None:
    """The paper's camera looks straight ahead, so left and right of the map may be exchanged."""
    see_green(ensemble, [3.0] * 3)
    images = noise_pictures(1)
    seen, mirrored = observer(images, ensemble), observer(images.flip(-1), ensemble).flip(-1)
    assert (seen.int() - mirrored.int()).abs().max() <= 1


@pytest.mark.parametrize("camera", ["paper", "d435"])
def test_nothing_is_graspable_where_the_floor_round_it_is_out_of_view(camera, make_config) -> None:
    config = make_config(camera=camera, grasp_initial_logit=5.0, grasp_initial_spread=0.0)
    observer = FloorObserver(config)
    graspable = observer(torch.zeros(1, 3, 100, 100), GraspEnsemble(config))[0, 0]
    in_view = (observer.view.grid.abs() <= 1).all(-1)
    patches = in_view.unfold(0, 9, 1).unfold(1, 9, 1).all(-1).all(-1)
    first_row, first_column = PIXEL, (31 * PIXEL - GRID) // 2
    grasp_area = slice(first_row, first_row + GRID), slice(first_column, first_column + GRID)
    patches[grasp_area] = in_view[4:-4, 4:-4][grasp_area]
    expected = functional.max_pool2d(patches.float()[None], PIXEL)[0]
    assert torch.equal(graspable > 0, expected > 0)
    assert 0 < (graspable > 0).float().mean() < 1


def test_map_follows_what_the_ensemble_learns(observer, ensemble, see_green, draw) -> None:
    images = to_images(draw(112))
    see_green(ensemble, [0.0] * 3)
    assert observer(images, ensemble)[0, 0, 2, 15] < 10
    see_green(ensemble, [30.0] * 3)
    assert observer(images, ensemble)[0, 0, 2, 15] > 245


@pytest.mark.parametrize("offline", [False, True])
@pytest.mark.parametrize("camera", ["paper", "d435"])
def test_background_loss_is_that_of_the_map(camera, offline, make_config, noise_pictures) -> None:
    """Random places against every place: something to grasp costs its probability."""
    config = make_config(camera=camera)
    observer, ensemble = FloorObserver(config), GraspEnsemble(config)
    images = noise_pictures(1)
    logits = ensemble.backbone.on_map(observer.view(images))[:, 0]
    rows = torch.arange(logits.shape[1])[:, None].expand(logits.shape[1:])
    places = observer.known & (offline | (rows >= PIXEL + GRID))
    expected = (logits[:, places] if offline else logits[:1, places]).sigmoid().sum(dim=0)
    rng, pictures, draws = torch.Generator().manual_seed(0), 4000, 8 if offline else 1
    loss = observer.background_loss(images.expand(pictures, -1, -1, -1), ensemble, rng, offline).item() / draws
    assert loss == pytest.approx(expected.mean().item(), abs=4 * expected.std().item() / (pictures * draws) ** 0.5)


def test_background_teaches_only_the_member_that_draws_the_map(observer, ensemble, noise_pictures) -> None:
    observer.background_loss(noise_pictures(8), ensemble, torch.Generator().manual_seed(0)).backward()
    taught = [any(w.grad is not None for w in member.parameters()) for member in ensemble.backbone.members]
    assert taught == [True] + [False] * (len(taught) - 1)


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
    assert encoder(observations).shape == (2, encoder.features)


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
    encoder(torch.tensor([0, 255], dtype=torch.uint8)[:, None, None, None].expand(2, *FloorObserver.shape))
    assert [float(values.min()) for values in seen[0]] == [float(values.max()) for values in seen[0]] == [-1.0, 1.0]


# --- Keypoints -----------------------------------------------------------------------------------------------
def keypoints(*pixels: tuple[int, int]) -> torch.Tensor:
    """What fresh keypoints, (x, y, graspability) by head, make of a map with graspable pixels; (heads, 3)."""
    torch.manual_seed(0)
    maps = torch.full((1, *FloorObserver.shape), -1.0)
    for row, column in pixels:
        maps[0, 0, row, column] = 1.0
    return Keypoints()(maps).detach().reshape(-1, 3)


def place_of(pixel: tuple[int, int]) -> list[float]:
    """Of a pixel, in m from the middle of the grasp area, forward and left."""
    size = [PIXEL * (high - low) / GRID for low, high in (GRASP_X, GRASP_Y)]
    return [(index - middle) * side for index, middle, side in zip(pixel, MIDDLE, size, strict=True)]


@pytest.mark.parametrize("pixel", [(2, 15), (7, 10), (11, 23), (1, 14)])
def test_keypoints_tell_where_a_graspable_thing_lies(pixel: tuple[int, int]) -> None:
    farsighted = keypoints(pixel)[-1]
    assert farsighted[:2].tolist() == pytest.approx(place_of(pixel), abs=0.03)
    assert farsighted[2] > 0.9


def test_keypoints_prefer_the_nearest_thing() -> None:
    """The near-sighted ones see it alone; the others, ever less, lean to it."""
    near, far, both = keypoints((3, 12)), keypoints((13, 21)), keypoints((3, 12), (13, 21))
    to_near, to_far = ((both - one)[:, :2].norm(dim=1) for one in (near, far))
    assert to_near[:2].max() < 0.02
    assert (to_near.diff() > 0).all()
    assert (to_near < to_far).all()


@pytest.mark.parametrize("pixel", [(2, 15), (1, 14), (2, 16), (4, 15)])
def test_thing_nearby_is_found_by_all_keypoints(pixel: tuple[int, int]) -> None:
    assert (keypoints(pixel)[:, :2] - torch.tensor(place_of(pixel))).abs().max() < 0.03


@pytest.mark.parametrize("seed", range(3))
def test_fresh_keypoints_of_a_mirrored_map_are_mirrored(seed: int) -> None:
    torch.manual_seed(seed)
    points, maps = Keypoints(), torch.rand(1, *FloorObserver.shape) * 2 - 1
    seen, mirrored = (points(each).detach().reshape(-1, 3) for each in (maps, maps.flip(-1)))
    assert torch.allclose(mirrored, seen * torch.tensor([1.0, -1.0, 1.0]), atol=1e-5)
    assert seen[:, 1].abs().max() > 1e-3
