from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from relmm.features import GRID, cell_to_xy, xy_to_cell
from relmm.policies.relmm_paper.configuration_relmm_paper import RelmmPaperConfig
from relmm.policies.relmm_paper.grasping import Estimate, GraspEnsemble, to_cells

CELLS = GRID**2


@pytest.fixture
def ensemble(make_config) -> GraspEnsemble:
    torch.manual_seed(0)
    return GraspEnsemble(make_config())


@pytest.fixture
def known(make_config, set_logits) -> tuple[GraspEnsemble, Tensor]:
    """An ensemble of three with logits that are known and differ everywhere."""
    ensemble = GraspEnsemble(make_config())
    logits = torch.randn(3, CELLS, generator=torch.Generator().manual_seed(1))
    set_logits(ensemble, logits)
    return ensemble, logits


def some_estimate(batch: int = 1) -> Estimate:
    mean, std = torch.rand(2, batch, CELLS, generator=torch.Generator().manual_seed(0))
    return Estimate(mean, 0.3 * std)


def places(cells: list[int]) -> Tensor:
    """Centres of cells, as robots are told them."""
    return torch.from_numpy(cell_to_xy(np.array(cells))).float()


def test_places_belong_to_the_cells_that_the_vocabulary_says() -> None:
    rng = np.random.default_rng(0)
    some = np.concatenate([cell_to_xy(np.arange(CELLS)), rng.uniform((0.2, -0.2), (0.6, 0.2), (500, 2))])
    expected = [xy_to_cell(*place) for place in some.tolist()]
    assert to_cells(torch.from_numpy(some)).tolist() == expected


# --- Networks ------------------------------------------------------------------------------------------------
def test_there_is_a_logit_for_each_member_picture_and_cell(ensemble: GraspEnsemble, noise_pictures) -> None:
    assert ensemble.logits(noise_pictures(2)).shape == (3, 2, CELLS)
    assert ensemble.estimate(noise_pictures(2)).mean.shape == (2, CELLS)


def test_networks_are_those_of_the_authors() -> None:
    ensemble = GraspEnsemble(RelmmPaperConfig(device="cpu"))
    counts = [sum(weight.numel() for weight in member.parameters()) for member in ensemble.members]
    assert counts == [2_551_393] * 6


def test_networks_begin_as_in_keras(ensemble: GraspEnsemble) -> None:
    """Glorot: uniform within sqrt(6 / (inputs + outputs)), without bias."""
    for layer in ensemble.members[0]:
        if isinstance(layer, nn.Conv2d | nn.Linear):
            taps = layer.weight[0, 0].numel() if isinstance(layer, nn.Conv2d) else 1
            limit = math.sqrt(6 / (taps * sum(layer.weight.shape[:2])))
            assert layer.weight.abs().max().item() == pytest.approx(limit, rel=0.1)
            assert layer.weight.abs().max() <= limit
            assert not layer.bias.any()


@pytest.mark.parametrize(("gain", "spread", "gate"), [(1.0, (0.0, 0.03), (0.5, 0.6)), (255.0, (0.35, 0.5), (0.99, 1))])
def test_members_disagree_at_first_as_far_as_their_inputs_are_large(gain, spread, gate) -> None:
    """Measured on the authors' networks: a spread of 0.43 and P[grasp] of 1 with pixels that are not divided by 255."""
    torch.manual_seed(0)
    ensemble = GraspEnsemble(RelmmPaperConfig(device="cpu", grasp_input_gain=gain))
    floor = torch.tensor([221, 204, 187], dtype=torch.uint8)[:, None, None].expand(2, 3, 100, 100)
    estimate = ensemble.estimate(floor)
    assert spread[0] < estimate.std.mean() < spread[1]
    assert gate[0] <= ensemble.grasp_probability(estimate).mean() <= gate[1]


def test_each_picture_of_a_batch_is_judged_alone(ensemble: GraspEnsemble, noise_pictures) -> None:
    pictures = noise_pictures(3)
    alone = torch.cat([ensemble.logits(picture[None]) for picture in pictures], dim=1)
    assert torch.allclose(ensemble.logits(pictures), alone, atol=1e-3), "of logits that reach 60"


def test_members_share_nothing(ensemble: GraspEnsemble, noise_pictures) -> None:
    logits = ensemble.logits(noise_pictures(1))
    assert not torch.allclose(logits[0], logits[1], atol=0.01)
    logits[0].sum().backward()
    learned = [any(w.grad is not None and bool(w.grad.any()) for w in m.parameters()) for m in ensemble.members]
    assert learned == [True, False, False]


def test_networks_see_the_crop_of_the_authors_alone(ensemble: GraspEnsemble, noise_pictures) -> None:
    picture = noise_pictures(1)
    logits = ensemble.logits(picture)
    outside = torch.ones(100, 100, dtype=torch.bool)
    outside[38:98, 20:80] = False
    assert torch.equal(ensemble.logits(torch.where(outside, 255 - picture, picture)), logits)
    for row, column in [(38, 20), (38, 79), (97, 20), (97, 79)]:
        other = picture.clone()
        other[:, :, row, column] = 255 - other[:, :, row, column]
        assert not torch.equal(ensemble.logits(other), logits)


# --- Loss (eq. 1) --------------------------------------------------------------------------------------------
def test_loss_is_the_cross_entropy_of_the_attempted_cells(known, noise_pictures) -> None:
    ensemble, logits = known
    cells, successes = [3, 77, 77, 224], [True, False, True, False]
    expected = 0.0
    for member in logits.tolist():
        for cell, success in zip(cells, successes, strict=True):
            chance = 1 / (1 + math.exp(-member[cell]))
            expected -= math.log(chance if success else 1 - chance) / len(cells)
    loss, logs = ensemble.loss(noise_pictures(4), places(cells), torch.tensor(successes))
    assert loss.item() == pytest.approx(expected, rel=1e-5)
    assert logs == {"grasp_loss": pytest.approx(expected / 3, rel=1e-5)}


def test_loss_of_certain_members_is_finite(known, set_logits, noise_pictures) -> None:
    ensemble, _ = known
    set_logits(ensemble, torch.full((3, CELLS), 500.0))
    assert ensemble.loss(noise_pictures(2), places([0, 1]), torch.tensor([True, False]))[0].item() == 750.0


def test_gradient_of_the_loss_agrees_with_finite_differences(
    ensemble: GraspEnsemble, noise_pictures: Callable[[int], Tensor], monkeypatch
) -> None:
    monkeypatch.setattr("relmm.policies.relmm_paper.grasping.scaled", lambda pictures, gain: pictures.double() / 127.5)
    ensemble, pictures, cells = ensemble.double(), noise_pictures(3), torch.tensor([0, 100, 224])
    successes = torch.tensor([True, False, True])
    ensemble.loss(pictures, places(cells.tolist()), successes)[0].backward()
    weights = list(ensemble.parameters())
    direction = [torch.randn_like(weight) for weight in weights]
    slope = sum((way * weight.grad).sum() for way, weight in zip(direction, weights, strict=True))

    def moved(step: float) -> Tensor:
        with torch.no_grad():
            for way, weight in zip(direction, weights, strict=True):
                weight += step * way
            probabilities = ensemble.logits(pictures)[:, range(3), cells].sigmoid()
            loss = functional.binary_cross_entropy(probabilities, successes.double().expand(3, 3), reduction="sum") / 3
            for way, weight in zip(direction, weights, strict=True):
                weight -= step * way
        return loss

    assert slope.item() == pytest.approx(((moved(1e-8) - moved(-1e-8)) / 2e-8).item(), rel=1e-4)


# --- Estimate, choice of a cell (eq. 2) and gate (eq. 3) -----------------------------------------------------
def test_estimate_is_mean_and_population_deviation_of_the_probabilities(known, noise_pictures) -> None:
    ensemble, logits = known
    estimate = ensemble.estimate(noise_pictures(2))
    chances = logits.sigmoid()
    mean = chances.sum(dim=0) / 3
    assert torch.allclose(estimate.mean, mean.expand(2, -1), atol=1e-6)
    assert torch.allclose(estimate.std, ((chances - mean) ** 2).mean(dim=0).sqrt().expand(2, -1), atol=1e-6)
    assert not estimate.mean.requires_grad


@pytest.mark.parametrize(("alpha", "beta"), [(10.0, 10.0), (3.0, 0.0), (0.0, 5.0), (0.0, 0.0)])
def test_cells_are_drawn_in_proportion_to_the_exponential_of_their_scores(alpha, beta, make_config) -> None:
    ensemble = GraspEnsemble(make_config(mean_weight=alpha, std_weight=beta))
    estimate, draws = some_estimate(), 40_000
    many = Estimate(estimate.mean.expand(draws, -1), estimate.std.expand(draws, -1))
    cells = ensemble.sample(many, np.random.default_rng(0))
    weights = (alpha * estimate.mean[0] + beta * estimate.std[0]).exp().numpy()
    expected = draws * weights / weights.sum()
    common = expected >= 5
    counts = np.bincount(cells, minlength=CELLS)
    chi_squared = ((counts - expected) ** 2 / expected)[common].sum()
    freedom = int(common.sum())
    assert chi_squared < freedom + 4 * math.sqrt(2 * freedom)
    assert counts[~common].sum() < 2 * expected[~common].sum() + 10


def test_drawing_cells_is_repeatable(ensemble: GraspEnsemble) -> None:
    first, second = (ensemble.sample(some_estimate(batch=50), np.random.default_rng(4)) for _ in range(2))
    assert first.tolist() == second.tolist()
    assert len(set(first.tolist())) > 10


@pytest.mark.parametrize(
    ("weights", "expected"),
    [((1.0, 1.0), [0.8, 1.0]), ((1.0, 0.0), [0.6, 0.95]), ((0.0, 2.0), [1.0, 0.8]), ((0.5, 0.0), [0.3, 0.475])],
)
def test_grasp_probability_is_the_highest_score_and_at_most_1(weights, expected, make_config) -> None:
    """The best cell by mean and the best by deviation are not the same; P[grasp] is the maximum of their sum."""
    config = make_config(gate_mean_weight=weights[0], gate_std_weight=weights[1])
    mean, std = torch.zeros(2, CELLS), torch.zeros(2, CELLS)
    mean[0, 10], std[0, 10], mean[0, 20], std[0, 20] = 0.6, 0.2, 0.1, 0.5
    mean[1, 30], std[1, 30] = 0.95, 0.4
    probability = GraspEnsemble(config).grasp_probability(Estimate(mean, std))
    assert probability.tolist() == pytest.approx(expected)
