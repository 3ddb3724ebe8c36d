from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from relmm.features import GRID
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.policies.relmm.grasping import Estimate, GraspEnsemble

CELLS = GRID**2


@pytest.fixture(params=["rectified", "dense"])
def ensemble(request: pytest.FixtureRequest, make_config) -> GraspEnsemble:
    torch.manual_seed(0)
    return GraspEnsemble(make_config(request.param)).eval()


@pytest.fixture
def dense(make_config, set_logits) -> tuple[GraspEnsemble, Tensor]:
    """An ensemble of three with logits that are known and differ everywhere."""
    ensemble = GraspEnsemble(make_config("dense"))
    logits = torch.randn(3, CELLS, generator=torch.Generator().manual_seed(1))
    set_logits(ensemble, logits)
    return ensemble, logits


def some_estimate(seed: int = 0, batch: int = 1) -> Estimate:
    mean, std = torch.rand(2, batch, CELLS, generator=torch.Generator().manual_seed(seed))
    return Estimate(mean, 0.3 * std)


# --- Networks ------------------------------------------------------------------------------------------------
def test_there_is_a_logit_for_each_member_picture_and_cell(ensemble: GraspEnsemble, noise_pictures) -> None:
    assert ensemble.logits(noise_pictures(2)).shape == (3, 2, CELLS)
    assert ensemble.backbone.attempted(noise_pictures(2), torch.tensor([0, 224])).shape == (3, 2)
    assert ensemble.estimate(noise_pictures(2)).mean.shape == (2, CELLS)


def test_attempted_cell_has_the_logit_of_the_whole_map(ensemble: GraspEnsemble, noise_pictures) -> None:
    image = noise_pictures(1)
    every = ensemble.backbone.attempted(image.expand(CELLS, -1, -1, -1), torch.arange(CELLS))
    assert torch.allclose(every, ensemble.logits(image)[:, 0], atol=1e-5)
    assert every.std(dim=1).min() > 1e-3


def test_each_picture_of_a_batch_is_judged_alone(ensemble: GraspEnsemble, noise_pictures) -> None:
    images = noise_pictures(3)
    alone = torch.cat([ensemble.logits(image[None]) for image in images], dim=1)
    assert torch.allclose(ensemble.logits(images), alone, atol=1e-5)


def test_members_share_nothing(ensemble: GraspEnsemble, noise_pictures) -> None:
    ensemble.logits(noise_pictures(1))[0].sum().backward()
    learned = [any(bool(w.grad.any()) for w in member.parameters()) for member in ensemble.backbone.members]
    assert learned == [True, False, False]


@pytest.mark.parametrize("seed", range(5))
def test_fresh_members_disagree(seed: int, noise_pictures) -> None:
    torch.manual_seed(seed)
    ensemble = GraspEnsemble(ReLMMConfig(device="cpu"))
    even = torch.rand(6, 3, 1, 1).expand(-1, -1, 100, 100)
    assert ensemble.estimate(noise_pictures(4)).std.mean() > 0.02
    assert ensemble.estimate(even).std.mean() > 0.02


def test_fresh_members_expect_failure_and_their_spread_can_be_set(make_config, noise_pictures) -> None:
    logits = GraspEnsemble(make_config(grasp_initial_spread=0.0, grasp_initial_logit=-3.0)).logits(noise_pictures(1))
    assert torch.equal(logits, torch.full_like(logits, -3.0))


@pytest.mark.parametrize(("mirror", "training", "mirrored"), [(True, True, 2), (True, False, 0), (False, True, 0)])
def test_half_of_a_batch_is_mirrored_in_training_only(
    mirror: bool, training: bool, mirrored: int, make_config, noise_pictures
) -> None:
    ensemble = GraspEnsemble(make_config(mirror=mirror)).train(training)
    images, cells = noise_pictures(1).expand(4, -1, -1, -1), torch.tensor([7, 60, 112, 200])
    logits = ensemble.backbone.attempted(images, cells)
    floor = ensemble.backbone.view(images)
    patches = torch.stack([floor[0, :, c // GRID : c // GRID + 9, c % GRID : c % GRID + 9] for c in cells.tolist()])
    expected = ensemble.backbone.on_map(torch.cat([patches[:mirrored].flip(-1), patches[mirrored:]])).flatten(1)
    assert torch.allclose(logits, expected, atol=1e-5)


def test_dense_networks_see_the_crop_of_the_authors_alone(make_config, noise_pictures) -> None:
    ensemble, images = GraspEnsemble(make_config("dense")), noise_pictures(1)
    images.requires_grad_(True)
    ensemble.logits(images).abs().sum().backward()
    row, column = torch.nonzero(images.grad[0].abs().sum(dim=0), as_tuple=True)
    assert (row.min(), row.max(), column.min(), column.max()) == (38, 97, 20, 79)


# --- Loss (eq. 1) --------------------------------------------------------------------------------------------
def test_loss_is_the_cross_entropy_of_the_attempted_cells(dense, noise_pictures) -> None:
    ensemble, logits = dense
    cells, successes = [3, 77, 77, 224], [1.0, 0.0, 1.0, 0.0]
    expected = 0.0
    for member in logits.tolist():
        for cell, success in zip(cells, successes, strict=True):
            chance = 1 / (1 + math.exp(-member[cell]))
            expected -= (success * math.log(chance) + (1 - success) * math.log(1 - chance)) / len(cells)
    loss = ensemble.loss(noise_pictures(4), torch.tensor(cells), torch.tensor(successes))
    assert loss.item() == pytest.approx(expected, rel=1e-5)


def test_loss_of_certain_members_is_finite(dense, set_logits, noise_pictures) -> None:
    ensemble, _ = dense
    set_logits(ensemble, torch.full((3, CELLS), 500.0))
    assert ensemble.loss(noise_pictures(2), torch.tensor([0, 1]), torch.tensor([1.0, 0.0])).item() == 750.0


def test_gradient_of_the_loss_agrees_with_finite_differences(ensemble: GraspEnsemble, noise_pictures) -> None:
    ensemble = ensemble.double()
    images, cells = noise_pictures(3).double(), torch.tensor([0, 100, 224])
    successes = torch.tensor([1, 0, 1])
    ensemble.loss(images, cells, successes).backward()
    weights = list(ensemble.parameters())
    direction = [torch.randn_like(weight) for weight in weights]
    slope = sum((way * weight.grad).sum() for way, weight in zip(direction, weights, strict=True))

    def moved(step: float) -> Tensor:
        with torch.no_grad():
            for way, weight in zip(direction, weights, strict=True):
                weight += step * way
            probabilities = ensemble.logits(images)[:, range(3), cells].sigmoid()
            loss = functional.binary_cross_entropy(probabilities, successes.double().expand(3, 3), reduction="sum") / 3
            for way, weight in zip(direction, weights, strict=True):
                weight -= step * way
        return loss

    assert slope.item() == pytest.approx(((moved(1e-8) - moved(-1e-8)) / 2e-8).item(), rel=1e-4)


# --- Estimate, choice of a cell (eq. 2) and gate (eq. 3) -----------------------------------------------------
def test_estimate_is_mean_and_population_deviation_of_the_probabilities(dense, noise_pictures) -> None:
    ensemble, logits = dense
    estimate = ensemble.estimate(noise_pictures(2))
    chances = logits.sigmoid()
    mean = chances.sum(dim=0) / 3
    assert torch.allclose(estimate.mean, mean.expand(2, -1), atol=1e-6)
    assert torch.allclose(estimate.std, ((chances - mean) ** 2).mean(dim=0).sqrt().expand(2, -1), atol=1e-6)
    assert not estimate.mean.requires_grad


@pytest.mark.parametrize(("alpha", "beta"), [(10.0, 10.0), (3.0, 0.0), (0.0, 5.0), (0.0, 0.0)])
def test_cells_are_drawn_in_proportion_to_the_exponential_of_their_scores(alpha, beta, make_config) -> None:
    ensemble = GraspEnsemble(make_config("dense", mean_weight=alpha, std_weight=beta))
    estimate, draws = some_estimate(), 40_000
    many = Estimate(estimate.mean.expand(draws, -1), estimate.std.expand(draws, -1))
    cells = ensemble.sample(many, torch.Generator().manual_seed(0))
    weights = (alpha * estimate.mean[0] + beta * estimate.std[0]).exp()
    expected = draws * weights / weights.sum()
    common = expected >= 5
    counts = torch.bincount(cells, minlength=CELLS)
    chi_squared = ((counts - expected) ** 2 / expected)[common].sum().item()
    freedom = int(common.sum())
    assert chi_squared < freedom + 4 * math.sqrt(2 * freedom)
    assert counts[~common].sum() < 2 * expected[~common].sum() + 10


def test_drawing_cells_is_repeatable_and_uses_its_own_random_numbers(ensemble: GraspEnsemble) -> None:
    state = torch.get_rng_state()
    first, second = (ensemble.sample(some_estimate(batch=50), torch.Generator().manual_seed(4)) for _ in range(2))
    assert torch.equal(first, second)
    assert len(set(first.tolist())) > 10
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize(
    ("weights", "expected"),
    [((1.0, 1.0), [0.8, 1.0]), ((1.0, 0.0), [0.6, 0.95]), ((0.0, 2.0), [1.0, 0.8]), ((0.5, 0.0), [0.3, 0.475])],
)
def test_grasp_probability_is_the_highest_score_and_at_most_1(weights, expected, make_config) -> None:
    """The best cell by mean and the best by deviation are not the same; P[grasp] is the maximum of their sum."""
    config = make_config("dense", gate_mean_weight=weights[0], gate_std_weight=weights[1])
    mean, std = torch.zeros(2, CELLS), torch.zeros(2, CELLS)
    mean[0, 10], std[0, 10], mean[0, 20], std[0, 20] = 0.6, 0.2, 0.1, 0.5
    mean[1, 30], std[1, 30] = 0.95, 0.4
    probability = GraspEnsemble(config).grasp_probability(Estimate(mean, std))
    assert probability.tolist() == pytest.approx(expected)
