"""The fast bootstrap against rliable's own, and against what is known by hand."""

import sys

import numpy as np
import pytest

from giril_rl.errors import UserError
from giril_rl.experiments.report.statistics import (
    band,
    iqm,
    load_rliable,
    mean_and_iqm,
    probability_of_improvement,
)

SCORES = [8907.3, 9222.6, 8501.7, 9008.1, 8303.4]
OTHER = [8511.0, 9358.0, 8900.0, 9222.6]


def test_interquartile_mean_is_that_of_rliable():
    metrics = load_rliable().metrics
    generator = np.random.default_rng(0)
    for count in (1, 2, 3, 4, 5, 8, 11):
        scores = generator.normal(size=(count, 1))
        assert iqm(scores[:, 0]) == pytest.approx(metrics.aggregate_iqm(scores))
    assert iqm(np.array([9.0, 1.0, 2.0, 6.0, -50.0])) == 3.0  # (1 + 2 + 6) / 3


@pytest.mark.parametrize("tasks", [1, 3])
def test_intervals_are_those_of_rliable(tasks):
    library = load_rliable()
    scores = np.random.default_rng(0).normal(100, 10, (5, tasks))
    mean, middle = mean_and_iqm(scores)
    np.random.seed(1)
    _, expected = library.get_interval_estimates(
        {"x": scores},
        lambda x: np.array([library.metrics.aggregate_mean(x), library.metrics.aggregate_iqm(x)]),
        reps=4000,
    )
    found = np.array([[mean.low, middle.low], [mean.high, middle.high]])
    np.testing.assert_allclose(found, expected["x"], atol=0.6)  # An interval is some 10 wide.


def test_with_many_seeds_the_interval_is_the_normal_one(monkeypatch):
    monkeypatch.setattr("giril_rl.experiments.report.statistics.RESAMPLES", 4_000)
    values = np.random.default_rng(1).normal(100, 10, 400)
    mean, _ = mean_and_iqm(values)
    assert mean.low < values.mean() < mean.high
    assert mean.high - mean.low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.05)


def test_seeds_are_resampled_in_each_task_by_themselves():
    # Seed 0 is 0 on one task and 1 on the other: together, resampling would leave 1/2 alone.
    mean, _ = mean_and_iqm(np.array([[0.0, 1.0], [1.0, 0.0]]))
    assert (mean.low, mean.value, mean.high) == (0.0, 0.5, 1.0)


def test_one_seed_has_no_interval_and_equal_seeds_have_none_to_speak_of():
    assert mean_and_iqm([3.0])[0] == (3.0, None, None)
    assert mean_and_iqm([3.0, 3.0])[0] == (3.0, 3.0, 3.0)


def test_probability_of_improvement():
    estimate = probability_of_improvement(SCORES, OTHER)
    # Wins of each score over the four others; the draw counts one half.
    assert estimate.value == pytest.approx((2 + 2 + 0.5 + 0 + 2 + 0 + 1) / 20, abs=0.06)
    wins = sum((x > y) + 0.5 * (x == y) for x in SCORES for y in OTHER) / 20
    assert estimate.value == pytest.approx(wins)
    library = load_rliable()
    np.random.seed(1)
    _, expected = library.get_interval_estimates(
        {"x": [np.array(SCORES)[:, None], np.array(OTHER)[:, None]]},
        lambda x, y: np.array([library.metrics.probability_of_improvement(x, y)]),
        reps=1000,
    )
    np.testing.assert_allclose([[estimate.low], [estimate.high]], expected["x"], atol=0.06)


def test_probability_of_improvement_at_its_ends():
    assert probability_of_improvement([2.0, 3.0], [0.0, 1.0]) == (1.0, 1.0, 1.0)
    assert probability_of_improvement([0.0, 1.0], [2.0, 3.0]) == (0.0, 0.0, 0.0)
    assert probability_of_improvement([1.0, 1.0], [1.0, 1.0, 1.0]) == (0.5, 0.5, 0.5)
    assert probability_of_improvement([1.0], [0.0, 0.0]) == (1.0, None, None)


def test_the_band_is_at_each_point_the_interval_of_the_mean():
    curves = np.random.default_rng(2).normal(size=(5, 3))
    low, high = band(curves)
    for point in range(3):
        mean, _ = mean_and_iqm(curves[:, point])
        assert (low[point], high[point]) == pytest.approx((mean.low, mean.high), abs=0.1)


def test_the_same_scores_give_the_same_interval_and_numpys_generator_is_left_alone():
    np.random.seed(7)
    expected = np.random.rand()
    np.random.seed(7)
    assert mean_and_iqm(SCORES) == mean_and_iqm(SCORES)
    assert np.random.rand() == expected


def test_without_rliable_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "rliable", None)
    with pytest.raises(UserError, match=r'needs rliable: pip install "giril-rl\[report\]"\.'):
        load_rliable()
