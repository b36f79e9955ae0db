"""Statistics over seeds, by rliable (Agarwal et al., NeurIPS 2021)."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import NamedTuple

import numpy as np

from giril_rl.errors import UserError

RESAMPLES = 50_000  # rliable's own default
CURVE_RESAMPLES = 2_000


class Estimate(NamedTuple):
    """A statistic and its 95% interval; the bounds are None where one value says nothing of it."""

    value: float
    low: float | None
    high: float | None


def load_rliable() -> ModuleType:
    """The library ``rliable``, loaded when first needed.

    Raises:
        UserError: where it is missing, or does not work with what is installed beside it.
    """
    try:
        from rliable import library, metrics
    except ImportError:
        raise UserError('giril report needs rliable: pip install "giril-rl[report]".') from None
    except Exception as error:
        # rliable asks for arch below 8, which fails at its import beside pandas 3.
        raise UserError(
            f"rliable cannot be imported here ({error}): the versions that fit together are those "
            'of pip install "giril-rl[report]".'
        ) from error
    library.metrics = metrics
    return library


def iqm(scores: np.ndarray, axis: int = 0) -> np.ndarray:
    """Interquartile mean: the mean without the lowest and the highest quarter, rounded down.

    Equal to ``rliable.metrics.aggregate_iqm`` where that is of one axis, and faster.

    Examples:
        >>> float(iqm(np.array([0.0, 1.0, 2.0, 3.0, 100.0])))
        2.0
    """
    ordered = np.sort(scores, axis)
    count = ordered.shape[axis]
    cut = count // 4
    return np.take(ordered, np.arange(cut, count - cut), axis).mean(axis)


def mean_and_iqm(scores: Sequence[float] | np.ndarray) -> tuple[Estimate, Estimate]:
    """Mean and interquartile mean of scores, each with its 95% stratified bootstrap interval.

    Args:
        scores: one score a seed, shape ``(seeds,)``; or ``(seeds, tasks)``, normalised, whose
            seeds are resampled in each task by themselves, and whose statistics are over all.

    Examples:
        >>> mean, middle = mean_and_iqm([10.0, 20.0, 30.0])
        >>> mean.value, middle.value, mean.low, mean.high
        (20.0, 20.0, 10.0, 30.0)
        >>> mean_and_iqm([3.0])[0]
        Estimate(value=3.0, low=None, high=None)
    """
    table = np.asarray(scores, dtype=np.float64)
    table = table[:, None] if table.ndim == 1 else table

    flat = table.reshape(-1)
    value, middle = float(flat.mean()), float(iqm(flat))
    if len(table) == 1:
        return Estimate(value, None, None), Estimate(middle, None, None)
    (drawn,) = _resampled(table, resamples=RESAMPLES)
    drawn = drawn.reshape(-1, RESAMPLES)
    return Estimate(value, *_interval(drawn.mean(0))), Estimate(middle, *_interval(iqm(drawn)))


def probability_of_improvement(scores: Sequence[float], other: Sequence[float]) -> Estimate:
    """Probability that a run of one method scores above a run of another, with its 95% interval.

    Draws count one half (the Mann-Whitney statistic), as in
    ``rliable.metrics.probability_of_improvement``.

    Args:
        scores: one score a seed, of the method.
        other: one score a seed, of the one that it is compared with.

    Examples:
        >>> probability_of_improvement([1.0, 2.0], [0.0, 2.0]).value
        0.625
    """
    one, two = (np.asarray(values, dtype=np.float64)[:, None] for values in (scores, other))
    value = float(load_rliable().metrics.probability_of_improvement(one, two))
    if len(one) == 1 or len(two) == 1:
        return Estimate(value, None, None)

    drawn, against = (each[:, 0] for each in _resampled(one, two, resamples=RESAMPLES))
    # The library's own statistic for all resamples at once, without its p-value.
    wins = np.zeros(RESAMPLES)
    for score in drawn:
        wins += (score > against).sum(0) + 0.5 * (score == against).sum(0)
    return Estimate(value, *_interval(wins / (len(one) * len(two))))


def band(curves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """95% bootstrap interval over seeds of the mean curve, at each point.

    Args:
        curves: shape ``(seeds, points)``, at least two seeds.

    Returns:
        Lower and upper bound, each of shape ``(points,)``.
    """
    (drawn,) = _resampled(curves, resamples=CURVE_RESAMPLES)
    low, high = np.percentile(drawn.mean(0), [2.5, 97.5], axis=-1)
    return low, high


def _interval(estimates: np.ndarray) -> tuple[float, float]:
    low, high = np.percentile(estimates, [2.5, 97.5])
    return float(low), float(high)


def _resampled(*tables: np.ndarray, resamples: int) -> list[np.ndarray]:
    """Stratified resamples of score tables ``(seeds, ...)``, each ``(seeds, ..., resamples)``.

    ``rliable.library.get_interval_estimates`` draws one resample after another, thousands of times
    for each number. Its bootstrap resamples the seeds in every other entry of a table by itself, so
    that a table repeated along a last dimension gives all of them in one draw.
    """
    library = load_rliable()
    tiled = [np.repeat(table[..., None], resamples, axis=-1) for table in tables]
    kind = (
        library.StratifiedBootstrap if len(tables) == 1 else library.StratifiedIndependentBootstrap
    )
    with _seeded():
        ((drawn, _),) = kind(*tiled).bootstrap(1)
    return list(drawn)


@contextlib.contextmanager
def _seeded() -> Iterator[None]:
    """The same runs give the same report: rliable draws from numpy's global generator."""
    state = np.random.get_state()
    np.random.seed(0)
    try:
        yield
    finally:
        np.random.set_state(state)
