"""Bootstrap intervals and statistics against values that are known."""

import numpy as np
import pytest

from giril_rl.experiments.report.statistics import band, mean_and_iqm, probability_of_improvement

SCORES = [8907.3, 9222.6, 8501.7, 9008.1, 8303.4]
OTHER = [8511.0, 9358.0, 8900.0, 9222.6]


def test_the_interquartile_mean_cuts_the_lowest_and_the_highest_quarter():
    assert mean_and_iqm([9.0, 1.0, 2.0, 6.0, -50.0])[1].value == 3.0  # (1 + 2 + 6) / 3
    assert mean_and_iqm([1.0, 2.0, 9.0])[1].value == 4.0  # A quarter of three is rounded down.


def test_intervals_are_the_percentiles_of_all_resamples():
    resamples = np.sort(np.array(SCORES)[np.indices((5,) * 5).reshape(5, -1)], 0)  # All 3,125.
    mean, middle = mean_and_iqm(SCORES)
    for estimate, values in ((mean, resamples.mean(0)), (middle, resamples[1:4].mean(0))):
        assert estimate[1:] == pytest.approx(np.percentile(values, [2.5, 97.5]), abs=5.0)


def test_with_many_seeds_the_interval_is_the_normal_one(monkeypatch):
    monkeypatch.setattr("giril_rl.experiments.report.statistics.RESAMPLES", 4_000)
    values = np.random.default_rng(1).normal(100, 10, 400)
    mean, _ = mean_and_iqm(values)
    assert mean.low < values.mean() < mean.high
    assert mean.high - mean.low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.05)


def test_seeds_are_resampled_within_each_task():
    # Seed 0 is 0 on one task and 1 on the other: resampled together, the mean would always be 1/2.
    mean, _ = mean_and_iqm([0.0, 1.0], [1.0, 0.0])
    assert (mean.low, mean.value, mean.high) == (0.0, 0.5, 1.0)


def test_one_seed_has_no_interval_and_equal_seeds_have_an_empty_one():
    assert mean_and_iqm([3.0])[0] == (3.0, None, None)
    assert mean_and_iqm([3.0, 3.0])[0] == (3.0, 3.0, 3.0)


def test_probability_of_improvement():
    estimate = probability_of_improvement(SCORES, OTHER)
    wins = sum((x > y) + 0.5 * (x == y) for x in SCORES for y in OTHER) / 20
    assert estimate.value == pytest.approx(wins)
    generator = np.random.default_rng(1)
    resamples = [
        np.mean([(x > y) + 0.5 * (x == y) for x in one for y in two])
        for one, two in (
            (generator.choice(SCORES, 5), generator.choice(OTHER, 4)) for _ in range(1000)
        )
    ]
    assert estimate[1:] == pytest.approx(np.percentile(resamples, [2.5, 97.5]), abs=0.06)


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
