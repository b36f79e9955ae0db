"""Statistics over seeds and their bootstrap intervals, as Agarwal et al. (2021) recommend them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import bootstrap, trim_mean

RESAMPLES = 50_000
CURVE_RESAMPLES = 2_000


class Estimate(NamedTuple):
    """A statistic and its 95% interval; the bounds are None where there is only one seed."""

    value: float
    low: float | None
    high: float | None


def mean_and_iqm(*scores: Sequence[float] | np.ndarray) -> tuple[Estimate, Estimate]:
    """Mean and interquartile mean with 95% stratified bootstrap intervals.

    Args:
        scores: one score a seed, shape ``(seeds,)``, for each task. The statistics are over all
            tasks; seeds are resampled within each.

    Examples:
        >>> mean, middle = mean_and_iqm([10.0, 20.0, 30.0])
        >>> mean.value, middle.value, mean.low, mean.high
        (20.0, 20.0, 10.0, 30.0)
        >>> mean_and_iqm([3.0])[0]
        Estimate(value=3.0, low=None, high=None)
    """
    mean, middle = _estimate(_mean_and_iqm, *scores)
    return mean, middle


def probability_of_improvement(scores: Sequence[float], other: Sequence[float]) -> Estimate:
    """Probability that a run of one method scores above a run of another, with its 95% interval.

    A tie counts one half: this is the Mann-Whitney statistic divided by the number of pairs.

    Examples:
        >>> probability_of_improvement([1.0, 2.0], [0.0, 2.0]).value
        0.625
    """
    return _estimate(_wins, scores, other)[0]


def band(curves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds ``(points,)`` of the mean's 95% interval over curves ``(seeds, points)``."""
    interval = _interval((curves,), np.mean, CURVE_RESAMPLES, axis=0)
    return interval.low, interval.high


def _mean_and_iqm(*scores: np.ndarray, axis: int = -1) -> np.ndarray:
    every = np.concatenate(scores, axis)
    return np.stack([every.mean(axis), trim_mean(every, 0.25, axis)])


def _wins(scores: np.ndarray, other: np.ndarray, axis: int = -1) -> np.ndarray:
    pairs = np.sign(scores[..., :, None] - other[..., None, :])
    return (0.5 + 0.5 * pairs).mean((-2, -1))[None]


def _estimate(statistic: Callable[..., np.ndarray], *samples: Any) -> list[Estimate]:
    arrays = [np.asarray(sample, dtype=np.float64) for sample in samples]
    values = statistic(*arrays).tolist()
    if min(map(len, arrays)) == 1:
        return [Estimate(value, None, None) for value in values]
    low, high = _interval(arrays, statistic, RESAMPLES)
    return [Estimate(*each) for each in zip(values, low.tolist(), high.tolist(), strict=True)]


def _interval(
    samples: Sequence[np.ndarray], statistic: Callable[..., Any], resamples: int, axis: int = -1
) -> Any:
    found = bootstrap(
        samples,
        statistic,
        n_resamples=resamples,
        batch=5_000,  # Bounds the memory.
        axis=axis,
        vectorized=True,
        method="percentile",
        rng=np.random.default_rng(0),  # The same runs give the same report.
    )
    return found.confidence_interval
