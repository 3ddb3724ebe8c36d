"""Every statistic against an independent computation."""

import numpy as np
import pytest
from scipy.stats import binomtest

from relmm.analysis import statistics


@pytest.mark.parametrize(("successes", "attempts"), [(0, 1), (1, 1), (0, 20), (7, 20), (500, 1000)])
def test_wilson_is_that_of_scipy(successes, attempts):
    interval = binomtest(successes, attempts).proportion_ci(method="wilson")
    assert np.allclose(statistics.wilson(successes, attempts), [interval.low, interval.high])


def test_no_attempt_has_no_interval():
    assert np.isnan(statistics.wilson(0, 0)).all()


def test_newcombe_interval_is_that_of_the_paper():
    # Newcombe 1998, table II, contrast (a): 56/70 - 48/80.
    d, low, high = statistics.difference((48, 80), (56, 70))
    assert np.allclose([d, low, high], [0.2, 0.0524, 0.3339], atol=5e-5)


def test_poisson_interval_is_exact():
    # Garwood's table: 10 events, 95 %.
    assert np.allclose(statistics.poisson_rate(10, 2.0), [4.795 / 2, 18.39 / 2], atol=5e-3)
    assert statistics.poisson_rate(0, 1.0) == pytest.approx((0.0, -np.log(0.025)))


def test_reliability_counts_what_is_in_the_bins():
    chances = np.repeat([0.1, 0.9], 50)
    outcomes = np.concatenate([np.arange(50) < 20, np.arange(50) < 30])
    table = statistics.reliability(chances, outcomes, bins=2)
    assert table.counts.tolist() == [50, 50]
    assert np.allclose(table.observed, [0.4, 0.6])
    assert table.ece == pytest.approx(0.3)


def test_brier_score_adds_up():
    rng = np.random.default_rng(1)
    chances = rng.random(2000)
    outcomes = rng.random(2000) < chances
    parts = statistics.brier(chances, outcomes)
    assert parts["score"] == pytest.approx(np.mean((chances - outcomes) ** 2))
    rebuilt = parts["reliability"] - parts["resolution"] + parts["uncertainty"] + parts["within_bins"]
    assert rebuilt == pytest.approx(parts["score"])
    # A calibrated forecast that is uniform: E[p(1 - p)] = 1/6, resolution Var[p] = 1/12, uncertainty 1/4.
    assert parts["score"] == pytest.approx(1 / 6, abs=0.01)
    assert parts["resolution"] == pytest.approx(1 / 12, abs=0.01)
    assert abs(parts["within_bins"]) < 0.005


def test_calibrated_robot_is_not_accused_and_an_overconfident_one_is():
    rng = np.random.default_rng(2)
    chances = rng.random(1000) * 0.8
    bound = statistics.ece_if_calibrated(chances)
    assert statistics.reliability(chances, rng.random(1000) < chances).ece < bound
    planted = statistics.reliability(chances + 0.2, rng.random(1000) < chances)
    low, high = statistics.ece_interval(chances + 0.2, rng.random(1000) < chances)
    assert planted.ece == pytest.approx(0.2, abs=0.03)
    assert low < 0.2 < high


def test_interval_is_that_of_robots_with_attempts_drawn_again():
    """Against the table of each draw; 207 attempts do not fill ten bins equally."""
    rng = np.random.default_rng(5)
    chances = np.sort(rng.random(207))
    outcomes = rng.random(207) < chances**2
    draws = np.random.default_rng(0)
    errors = []
    for _ in range(1000):
        draw = draws.integers(207, size=207)
        errors.append(statistics.reliability(chances[draw], outcomes[draw]).ece)
    assert statistics.ece_interval(chances, outcomes) == pytest.approx(tuple(np.quantile(errors, [0.025, 0.975])))


def test_bound_holds_for_about_95_of_100_calibrated_robots():
    rng = np.random.default_rng(3)
    chances = rng.random(200)
    bound = statistics.ece_if_calibrated(chances)
    below = [statistics.reliability(chances, rng.random(200) < chances).ece <= bound for _ in range(1000)]
    assert 0.92 < np.mean(below) < 0.98


def test_threshold_leaves_what_is_above_it():
    rows = statistics.thresholds(np.array([0.05, 0.35, 0.95]), np.array([True, False, True]))
    assert rows[0] == {"threshold": 0.0, "attempts": 3, "success": pytest.approx(2 / 3), "missed": 0}
    assert rows[4] == {"threshold": 0.4, "attempts": 1, "success": 1.0, "missed": 1}


def test_surprise_is_in_bits():
    assert statistics.surprise(np.array([0.25, 0.5, 1.0]), np.array([True, False, False])).tolist() == [2, 1, 10]


def test_teaches_is_the_mean_loss_of_variance():
    """Against the variance of a Beta distribution after either outcome, weighted by how likely it is."""
    from scipy.stats import beta

    for successes, attempts in [(0, 0), (3, 4), (10, 100)]:
        a, b = 1 + successes, 1 + attempts - successes
        chance = a / (a + b)
        after = chance * beta(a + 1, b).var() + (1 - chance) * beta(a, b + 1).var()
        assert statistics.teaches(successes, attempts) == pytest.approx(beta(a, b).var() - after)
