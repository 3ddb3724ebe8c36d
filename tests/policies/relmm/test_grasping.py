from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from relmm.features import GRASP_X, GRASP_Y, GRID, cell_to_xy
from relmm.geometry import CAMERAS
from relmm.policies.relmm.grasping import AREA, FIRST_COLUMN, FIRST_ROW, MARGIN, PATCH, GraspEnsemble
from relmm.policies.relmm.modeling_relmm import ReLMMPolicy

CELLS = GRID**2
# Where the grasp cells lie on the map.
REACH = slice(-FIRST_ROW, GRID - FIRST_ROW), slice(-FIRST_COLUMN, GRID - FIRST_COLUMN)

cameras = pytest.mark.parametrize("camera", CAMERAS)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def pictures(count: int, seed: int = 0) -> Tensor:
    """Pictures of nothing, 0..1."""
    return torch.rand(count, 3, 100, 100, generator=generator(seed))


def areas(count: int, seed: int = 0) -> Tensor:
    return torch.rand(count, 3, AREA, AREA, generator=generator(seed)) * 2 - 1


@pytest.fixture
def make_ensemble(make_config) -> Any:
    def make(**settings: Any) -> GraspEnsemble:
        torch.manual_seed(settings.pop("seed", 0))
        return GraspEnsemble(make_config(**settings)).eval()

    return make


def learn(ensemble: GraspEnsemble, floor: Tensor, cells: Tensor, successes: Tensor, updates: int = 150) -> None:
    optimizer = torch.optim.Adam(ensemble.learned(), lr=3e-3)
    for _ in range(updates):
        loss, _ = ensemble.loss(floor, cells, successes)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


# --- Networks ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("rows", "columns"), [(PATCH, PATCH), (AREA, AREA), (30, 41)])
def test_there_is_a_logit_for_each_place_whose_surroundings_are_shown(rows, columns, make_ensemble) -> None:
    ensemble, floor = make_ensemble(), torch.rand(2, 3, rows, columns)
    assert ensemble.logits(floor).shape == (3, 2, rows - 2 * MARGIN, columns - 2 * MARGIN)
    assert ensemble.logits(floor, members=2).shape[0] == 2


def test_the_same_floor_has_the_same_logit_wherever_it_is(make_ensemble) -> None:
    ensemble, patch = make_ensemble(), areas(1)[:, :, :PATCH, :PATCH]
    alone = ensemble.logits(patch)[:, 0, 0, 0]
    for row, column in ((0, 0), (7, 3), (14, 14)):
        floor = areas(1, seed=row)
        floor[:, :, row : row + PATCH, column : column + PATCH] = patch
        assert torch.allclose(ensemble.logits(floor)[:, 0, row, column], alone, atol=1e-4)


def test_a_logit_depends_on_all_of_its_patch_and_on_nothing_else(make_ensemble) -> None:
    ensemble, floor = make_ensemble(channels=16), areas(1).requires_grad_(True)
    ensemble.logits(floor)[:, 0, 6, 9].sum().backward()
    seen = floor.grad[0].abs().sum(dim=0) > 0
    inside = torch.zeros_like(seen)
    inside[6 : 6 + PATCH, 9 : 9 + PATCH] = True
    assert not (seen & ~inside).any()
    assert seen[inside].float().mean() > 0.9


def test_each_picture_of_a_batch_is_judged_alone(make_ensemble) -> None:
    ensemble, images = make_ensemble(), pictures(3)
    together = ensemble.look(images)
    for index in range(3):
        alone = ensemble.look(images[index : index + 1])
        assert torch.allclose(together.mean[index], alone.mean[0], atol=1e-5)
        assert torch.allclose(together.std[index], alone.std[0], atol=1e-5)


def test_members_share_nothing(make_ensemble) -> None:
    ensemble = make_ensemble()
    ensemble.logits(areas(1))[1].sum().backward()
    learned = [any(w.grad is not None and bool(w.grad.any()) for w in m.parameters()) for m in ensemble.members]
    assert learned == [False, True, False]


@pytest.mark.parametrize("logit", [-3.0, 0.5])
def test_a_fresh_ensemble_expects_what_it_is_told_to(logit: float, make_ensemble) -> None:
    ensemble = make_ensemble(initial_logit=logit, prior_scale=0.0, num_members=20)
    grey = torch.zeros(1, 3, AREA, AREA)
    assert ensemble.logits(grey).mean().item() == pytest.approx(logit, abs=0.3)


# --- Where it looks ------------------------------------------------------------------------------------------
@cameras
def test_grasp_cells_are_judged_by_the_same_floor_when_looking_and_when_learning(camera: str, make_ensemble) -> None:
    ensemble, images = make_ensemble(camera=camera), pictures(2)
    whole, area = ensemble.view(images), ensemble.area(images)
    rows, columns = (slice(each.start, each.start + AREA) for each in REACH)
    assert area.shape == (2, 3, AREA, AREA)
    assert torch.allclose(whole[:, :, rows, columns], area, atol=1e-5)
    mean, std = ensemble.look(images).cells
    chances = ensemble.logits(area).sigmoid().detach().numpy().reshape(3, 2, CELLS)
    known = ensemble.known[REACH].flatten().numpy()
    assert known.mean() > 0.7
    assert mean.numpy()[:, known] == pytest.approx(chances.mean(axis=0)[:, known], abs=1e-5)
    assert std.numpy()[:, known] == pytest.approx(chances.std(axis=0)[:, known], abs=1e-5)
    assert not mean[:, ~known].any()


def test_all_grasp_cells_are_known_to_the_camera_of_the_paper(make_ensemble) -> None:
    assert make_ensemble().known[REACH].all()


@cameras
def test_nothing_is_thought_of_floor_out_of_view(camera: str, make_ensemble) -> None:
    ensemble = make_ensemble(camera=camera)
    opinion, known = ensemble.look(pictures(1)), ensemble.known
    assert opinion.mean.shape == opinion.std.shape == (1, *known.shape)
    assert not opinion.mean[0, ~known].any()
    assert not opinion.std[0, ~known].any()
    assert (opinion.mean[0, known] > 0).all()
    assert not opinion.mean.requires_grad


@cameras
def test_what_is_known_is_what_the_camera_sees(camera: str, make_ensemble) -> None:
    """And no floor whose surroundings are cut off by the picture's edge, but for the grasp cells."""
    known = make_ensemble(camera=camera).known.numpy()
    rows, columns = np.indices(known.shape)
    pitch = (GRASP_X[1] - GRASP_X[0]) / GRID, (GRASP_Y[1] - GRASP_Y[0]) / GRID

    def in_view(down: int, right: int) -> np.ndarray:
        x = GRASP_X[0] + (FIRST_ROW + rows + down + 0.5) * pitch[0]
        y = GRASP_Y[0] + (FIRST_COLUMN + columns + right + 0.5) * pitch[1]
        pixels = CAMERAS[camera].project(np.stack([x, y, np.full(x.shape, 0.012)], axis=-1))
        return ((pixels > -0.5) & (pixels < 99.5)).all(axis=-1)

    corners = np.all([in_view(down, right) for down in (-MARGIN, MARGIN) for right in (-MARGIN, MARGIN)], axis=0)
    expected = corners.copy()
    expected[REACH] = in_view(0, 0)[REACH]
    assert np.mean(known != expected) < 1e-3


def test_floor_far_away_is_judged_by_the_first_members_only(make_ensemble, see_green) -> None:
    """All do so near by. The members' logits are the same everywhere, and known."""
    ensemble = make_ensemble(num_members=4)
    see_green(ensemble, [0.0] * 4)
    logits = torch.tensor([-1.0, 0.5, 1.0, 3.0])
    for member, logit in zip(ensemble.members, logits, strict=True):
        member.learned[-1].bias.data.fill_(logit)
    opinion, chances = ensemble.look(pictures(1)), logits.sigmoid()
    distance = GRASP_X[0] + (FIRST_ROW + np.arange(ensemble.known.shape[0])) * (GRASP_X[1] - GRASP_X[0]) / GRID
    for row, count in ((np.flatnonzero(distance > 0.9)[0], 4), (np.flatnonzero(distance > 1.9)[0], 2)):
        known = ensemble.known[row]
        assert known.any()
        mean, std = chances[:count].mean(), chances[:count].std(correction=0)
        assert torch.allclose(opinion.mean[0, row, known], mean.expand(int(known.sum())), atol=1e-6)
        assert torch.allclose(opinion.std[0, row, known], std.expand(int(known.sum())), atol=1e-6)


@cameras
@pytest.mark.parametrize("cell", [16, 37, 112, 130, 208])
def test_a_thing_is_promising_in_its_cell(camera: str, cell: int, make_ensemble, see_green, draw) -> None:
    ensemble = make_ensemble(camera=camera)
    see_green(ensemble, [6.0, 7.0, 8.0])
    image = ensemble.to_pictures(draw(cell_to_xy(cell), camera=camera))
    assert image.shape == (1, 3, 100, 100)
    mean = ensemble.look(image).cells[0][0].numpy()
    promising = mean * (mean > 0.3)
    middle = (promising[:, None] * cell_to_xy(np.arange(CELLS))).sum(axis=0) / promising.sum()
    assert mean.max() > 0.8
    assert np.median(mean) < 0.05
    assert np.linalg.norm(middle - cell_to_xy(cell)) < 0.02


# --- Loss ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("smoothing", [0.0, 0.03, 0.2])
def test_loss_is_the_smoothed_cross_entropy_of_the_attempted_cells(smoothing: float, make_ensemble) -> None:
    ensemble, floor = make_ensemble(smoothing=smoothing), areas(4)
    cells, successes = [3, 77, 77, 224], [1, 0, 1, 0]
    logits = ensemble.logits(floor).detach().numpy().astype(float)
    expected = 0.0
    for member in logits:
        for index, (cell, success) in enumerate(zip(cells, successes, strict=True)):
            chance = 1 / (1 + math.exp(-member[index, cell // GRID, cell % GRID]))
            target = 1 - smoothing if success else smoothing
            expected -= (target * math.log(chance) + (1 - target) * math.log(1 - chance)) / len(cells)
    loss, logs = ensemble.loss(floor, torch.tensor(cells), torch.tensor(successes))
    assert loss.item() == pytest.approx(expected, rel=1e-4)
    assert logs == {"grasp_loss": pytest.approx(expected / 3, rel=1e-4)}


def test_half_of_a_batch_is_mirrored_in_training_only(make_ensemble) -> None:
    ensemble, floor = make_ensemble(smoothing=0.0, recolor=0.0), areas(4)
    cells, successes = torch.tensor([7, 60, 112, 200]), torch.tensor([1, 0, 0, 1])
    mirrored = floor.clone()
    mirrored[:2] = floor[:2].flip(-1)
    elsewhere = cells.clone()
    elsewhere[:2] = cells[:2] // GRID * GRID + GRID - 1 - cells[:2] % GRID
    with torch.no_grad():
        expected = ensemble.loss(mirrored, elsewhere, successes)[0]
        plain = ensemble.loss(floor, cells, successes)[0]
        trained = ensemble.loss(floor, cells, successes, generator())[0]
    assert trained.item() == pytest.approx(expected.item(), rel=1e-5)
    assert trained.item() != pytest.approx(plain.item(), rel=1e-3)


def test_colours_of_every_second_attempt_change_places_and_strength(make_ensemble, monkeypatch) -> None:
    """Alike for all of a patch, so that what it shows keeps its shape."""
    ensemble, seen = make_ensemble(recolor=0.4), []
    logits = ensemble._patch_logits
    monkeypatch.setattr(ensemble, "_patch_logits", lambda patches: (seen.append(patches), logits(patches))[1])
    levels = torch.tensor([-0.5, 0.0, 0.5])[:, None, None]
    floor = (levels + 0.05 * torch.linspace(-1, 1, AREA)).expand(400, 3, AREA, AREA)
    cells = torch.full((400,), 112)
    ensemble.loss(floor, cells, torch.ones(400), generator())
    assert torch.equal(seen[0][201::2], floor[201::2, :, 7 : 7 + PATCH, 7 : 7 + PATCH])
    patches = seen[0][::2]
    middle = patches[:, :, MARGIN, MARGIN]
    assert len({tuple(order) for order in middle.argsort(dim=1).tolist()}) == 6
    assert (middle.std(dim=0) > 0.3).all()
    assert (patches.abs() <= 1).all()
    rising = patches[100:, :, 0, -1] > patches[100:, :, 0, 0]
    assert rising[middle[100:].abs() < 0.9].all()
    ensemble.loss(floor, cells, torch.ones(400), generator())
    assert torch.equal(seen[1], seen[0]), "the same noise gives the same colours"


def test_gradient_of_the_loss_agrees_with_finite_differences(make_ensemble) -> None:
    ensemble = make_ensemble().double()
    given = areas(3).double(), torch.tensor([0, 100, 224]), torch.tensor([1, 0, 1])
    ensemble.loss(*given)[0].backward()
    direction = [torch.randn(w.shape, dtype=w.dtype, generator=generator(1)) for w in ensemble.learned()]
    slope = sum((way * w.grad).sum().item() for way, w in zip(direction, ensemble.learned(), strict=True))

    @torch.no_grad()
    def moved(step: float) -> float:
        for way, w in zip(direction, ensemble.learned(), strict=True):
            w += step * way
        loss = ensemble.loss(*given)[0].item()
        for way, w in zip(direction, ensemble.learned(), strict=True):
            w -= step * way
        return loss

    assert slope == pytest.approx((moved(1e-7) - moved(-1e-7)) / 2e-7, rel=1e-3)


# --- Uncertainty ---------------------------------------------------------------------------------------------
def test_the_random_part_does_not_learn(make_ensemble) -> None:
    ensemble = make_ensemble()
    before = [weight.clone() for member in ensemble.members for weight in member.prior.parameters()]
    learn(ensemble, areas(8), torch.arange(8) * 25, torch.arange(8) % 2, updates=3)
    after = [weight for member in ensemble.members for weight in member.prior.parameters()]
    assert all(torch.equal(*each) for each in zip(before, after, strict=True))
    assert not any(weight.requires_grad for weight in after)
    given = {id(weight) for weight in ensemble.learned()}
    assert given == {id(weight) for member in ensemble.members for weight in member.learned.parameters()}


@pytest.mark.parametrize("seed", range(2))
def test_members_disagree_on_what_was_never_tried_and_agree_on_what_was(seed: int, make_ensemble) -> None:
    """Only even floor was tried, in vain; then there is something green."""
    ensemble = make_ensemble(seed=seed, num_members=6, channels=16)
    grey = torch.rand(24, 1, 1, 1, generator=generator(seed)).expand(-1, 3, AREA, AREA) * 0.2
    green = torch.tensor([-0.6, 0.8, -0.6])[None, :, None, None].expand(1, 3, AREA, AREA)
    fresh = ensemble.logits(grey[:1]).sigmoid().std(dim=0).mean()
    learn(ensemble, grey, torch.randint(CELLS, (24,), generator=generator(seed)), torch.zeros(24))
    tried, untried = ensemble.logits(grey[:1]).sigmoid(), ensemble.logits(green).sigmoid()
    assert tried.mean() < 0.1
    assert tried.std(dim=0).mean() < 0.5 * fresh
    assert untried.std(dim=0).mean() > 3 * tried.std(dim=0).mean()


@pytest.mark.parametrize("seed", range(1))
def test_without_its_random_part_an_ensemble_disagrees_less_on_what_was_never_tried(seed: int, make_ensemble) -> None:
    spreads = []
    for scale in (0.0, 6.0):
        ensemble = make_ensemble(seed=seed, num_members=6, channels=16, prior_scale=scale)
        learn(ensemble, torch.zeros(12, 3, AREA, AREA), torch.arange(12), torch.zeros(12), updates=80)
        spreads.append(ensemble.logits(areas(4, seed=9)).sigmoid().std(dim=0).mean().item())
    assert spreads[1] > 2 * spreads[0]


# --- Choice of a cell ----------------------------------------------------------------------------------------
@pytest.mark.parametrize(("alpha", "beta"), [(10.0, 10.0), (3.0, 0.0), (0.0, 5.0), (0.0, 0.0)])
def test_cells_are_drawn_in_proportion_to_the_exponential_of_their_scores(alpha, beta, make_ensemble) -> None:
    ensemble, draws = make_ensemble(mean_weight=alpha, std_weight=beta), 20_000
    mean, std = torch.rand(2, CELLS, generator=generator())
    std = 0.3 * std
    cells = ensemble.sample(mean.expand(draws, -1), std.expand(draws, -1), generator())
    weights = np.exp(alpha * mean.numpy() + beta * std.numpy())
    shares = weights / weights.sum()
    counts = np.bincount(cells.numpy(), minlength=CELLS)
    assert np.abs(counts - draws * shares).max() < 4.5 * math.sqrt(draws * shares.max())
    best = np.argsort(shares)[-75:]
    deviation = math.sqrt(draws * shares[best].sum() * (1 - shares[best].sum()))
    assert counts[best].sum() == pytest.approx(draws * shares[best].sum(), abs=4 * deviation)


def test_drawing_cells_is_repeatable_and_uses_its_own_random_numbers(make_ensemble) -> None:
    ensemble, state = make_ensemble(), torch.get_rng_state()
    mean, std = torch.rand(2, 1, CELLS, generator=generator(5)).expand(-1, 50, -1)
    first, second = (ensemble.sample(mean, std, generator(4)) for _ in range(2))
    assert torch.equal(first, second)
    assert len(set(first.tolist())) > 10
    assert torch.equal(torch.get_rng_state(), state)


# --- Seeds ---------------------------------------------------------------------------------------------------
def test_equal_seeds_give_equal_weights_and_leave_global_random_numbers_alone(make_config) -> None:
    def weights(seed: int | None) -> Tensor:
        ensemble = ReLMMPolicy(make_config(seed=seed)).grasping
        return torch.cat([weight.flatten() for weight in ensemble.parameters()])

    torch.manual_seed(1)
    state = torch.get_rng_state()
    first = weights(4)
    assert torch.equal(torch.get_rng_state(), state)
    torch.manual_seed(2)
    assert torch.equal(first, weights(4))
    assert not torch.equal(first, weights(5))


@cameras
def test_looking_at_the_cells_alone_gives_what_looking_at_all_floor_gives(make_ensemble, camera):
    ensemble = make_ensemble(camera=camera)
    for whole, alone in zip(ensemble.look(pictures(3)).cells, ensemble.look_at_cells(pictures(3)), strict=True):
        torch.testing.assert_close(alone, whole)
