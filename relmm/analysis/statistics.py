"""The statistics of the report: intervals of shares and rates, calibration, and what one more attempt would teach."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, norm

from relmm.features import FloatArray

LEVEL = 0.95  # of all intervals
_Z = float(norm.ppf((1 + LEVEL) / 2))
_RESAMPLES = 1000
_BINS = 10


def wilson(successes: Any, attempts: Any) -> tuple[FloatArray, FloatArray]:
    """Wilson's score interval of a share (Wilson 1927); NaN where there was no attempt.

    Args:
        successes: how many, any shape.
        attempts: of how many, the same shape.

    Returns:
        Low and high ends of the 95 % interval.
    """
    n = np.where(np.asarray(attempts) > 0, attempts, np.nan).astype(float)
    share = np.asarray(successes) / n
    middle = (share + _Z**2 / (2 * n)) / (1 + _Z**2 / n)
    half = _Z / (1 + _Z**2 / n) * np.sqrt(share * (1 - share) / n + _Z**2 / (4 * n**2))
    return middle - half, middle + half


def difference(before: tuple[int, int], after: tuple[int, int]) -> tuple[float, float, float]:
    """How much larger a share is than another, with Newcombe's interval (1998, method 10).

    Args:
        before: successes and attempts, at least one.
        after: likewise.

    Returns:
        after - before, and the low and high ends of its 95 % interval.
    """
    (low0, high0), (low1, high1) = wilson(*before), wilson(*after)
    share0, share1 = before[0] / before[1], after[0] / after[1]
    d = share1 - share0
    low, high = np.hypot(share1 - low1, high0 - share0), np.hypot(high1 - share1, share0 - low0)
    return d, float(d - low), float(d + high)


def poisson_rate(events: int, exposure: float) -> tuple[float, float]:
    """Exact 95 % interval of a rate (Garwood 1936) of `events` in `exposure`, per unit of exposure."""
    tail = (1 - LEVEL) / 2
    low = chi2.ppf(tail, 2 * events) / 2 if events else 0.0
    return float(low / exposure), float(chi2.ppf(1 - tail, 2 * events + 2) / 2 / exposure)


@dataclass(frozen=True)
class Reliability:
    """Bins of about equally many predictions, in order of the prediction.

    Attributes:
        predicted, observed: mean prediction and share of successes of each bin, (bins,).
        counts: predictions in each, (bins,).
        low, high: Wilson's interval of `observed`, (bins,).
    """

    predicted: FloatArray
    observed: FloatArray
    counts: NDArray[np.int64]
    low: FloatArray
    high: FloatArray

    @property
    def ece(self) -> float:
        """Expected calibration error: the mean distance of prediction and outcome, weighted by counts."""
        return float(np.average(np.abs(self.predicted - self.observed), weights=self.counts))


def reliability(predictions: FloatArray, outcomes: NDArray[np.bool_], bins: int = _BINS) -> Reliability:
    """Predictions against outcomes in bins of equal counts, fewer where there are fewer than ten to a bin.

    Args:
        predictions: probabilities, (n,), n >= 1.
        outcomes: (n,).
        bins: at most.
    """
    order = np.argsort(predictions, kind="stable")
    parts = np.split(order, _bin_begins(len(order), bins)[1:])
    counts = np.array([len(part) for part in parts])
    successes = np.array([outcomes[part].sum() for part in parts])
    low, high = wilson(successes, counts)
    predicted = np.array([predictions[part].mean() for part in parts])
    return Reliability(predicted, successes / counts, counts, low, high)


def ece_interval(predictions: FloatArray, outcomes: NDArray[np.bool_]) -> tuple[float, float]:
    """95 % interval of the expected calibration error: attempts drawn again with replacement, 1000 times.

    A perfectly calibrated robot has an error above zero, too, because its bins are finite; see `ece_if_calibrated`.
    """
    rng, count = np.random.default_rng(0), len(predictions)
    order = np.argsort(predictions, kind="stable")
    predicted, observed = predictions[order], outcomes[order].astype(float)
    errors = []
    for _ in range(_RESAMPLES):
        draw = np.sort(rng.integers(count, size=count))  # in order of the prediction
        errors.append(_ece(predicted[draw], observed[draw]))
    return _ends(errors)


def ece_if_calibrated(predictions: FloatArray) -> float:
    """The error that 95 % of perfectly calibrated robots with these predictions would stay below."""
    rng, predicted = np.random.default_rng(0), np.sort(predictions)
    chances = np.clip(predicted, 0, 1)
    errors = [_ece(predicted, (rng.random(len(chances)) < chances).astype(float)) for _ in range(_RESAMPLES)]
    return float(np.quantile(errors, LEVEL))


def brier(predictions: FloatArray, outcomes: NDArray[np.bool_]) -> dict[str, float]:
    """The Brier score and its parts (Murphy 1973): score = reliability - resolution + uncertainty + within bins.

    Returns:
        `score`; `reliability`, lower is better; `resolution`, higher is better; `uncertainty`, of the task;
        `within_bins`, what the bins hide (Stephenson et al. 2008).
    """
    table = reliability(predictions, outcomes)
    weights, rate = table.counts / table.counts.sum(), float(np.mean(outcomes))
    parts = {
        "score": float(np.mean((predictions - outcomes) ** 2)),
        "reliability": float(weights @ (table.predicted - table.observed) ** 2),
        "resolution": float(weights @ (table.observed - rate) ** 2),
        "uncertainty": rate * (1 - rate),
    }
    rest = parts["score"] - parts["reliability"] + parts["resolution"] - parts["uncertainty"]
    return parts | {"within_bins": rest}


def thresholds(predictions: FloatArray, outcomes: NDArray[np.bool_]) -> list[dict[str, float]]:
    """What would have happened to the attempts if those below a threshold had not been made, for 0, 0.1 ... 0.9.

    Returns:
        For each: `threshold`, `attempts` left, their `success` share, and `missed` successes.
    """
    rows = []
    for threshold in np.arange(10) / 10:
        kept = predictions >= threshold
        share = float(outcomes[kept].mean()) if kept.any() else float("nan")
        missed = int(outcomes[~kept].sum())
        rows.append({"threshold": float(threshold), "attempts": int(kept.sum()), "success": share, "missed": missed})
    return rows


def surprise(predictions: FloatArray, outcomes: NDArray[np.bool_]) -> FloatArray:
    """How unexpected each outcome was, in bits: -log2 of the probability that it was given, at most 10."""
    given = np.where(outcomes, predictions, 1 - predictions)
    return -np.log2(np.clip(given, 2.0**-10, 1))


def teaches(successes: Any, attempts: Any) -> FloatArray:
    """By how much one more attempt shrinks the variance of a success rate, on average.

    The rate has a Beta(1 + successes, 1 + failures) distribution, flat without attempts. With n = attempts + 2, its
    variance is, on average over how the next attempt may end, n / (n + 1) of what it was.
    """
    a, n = np.asarray(successes) + 1.0, np.asarray(attempts) + 2.0
    return a * (n - a) / (n**2 * (n + 1)) / (n + 1)


def _bin_begins(count: int, bins: int = _BINS) -> NDArray[np.int64]:
    """Where each of so many bins of equal counts begins; they have ten predictions each, at least."""
    bins = max(1, min(bins, count // 10))
    sizes = np.full(bins, count // bins) + (np.arange(bins) < count % bins)
    return np.cumsum(sizes) - sizes


def _ece(predicted: FloatArray, observed: FloatArray) -> float:
    """As `Reliability.ece`, of predictions in order: a thousand are drawn for an interval."""
    sums = np.add.reduceat(predicted - observed, _bin_begins(len(predicted)))
    return float(np.abs(sums).sum() / len(predicted))


def unlikely_failures(attempts: int, success: float) -> float:
    """The probability that none of so many attempts succeeds by chance."""
    return float((1 - success) ** attempts)


def _ends(values: list[float]) -> tuple[float, float]:
    low, high = np.quantile(values, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)
