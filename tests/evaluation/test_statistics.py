"""Intervals and averages against scipy and against what they must say of known cases."""

import numpy as np
import pytest
from scipy import stats

from cmrl_jax.evaluation.statistics import (
    interquartile_mean,
    mean_interval,
    seeds_band,
    seeds_interval,
    wilson_interval,
)


@pytest.mark.parametrize(("successes", "count"), [(0, 50), (50, 50), (7, 50), (1, 3), (20, 40)])
def test_wilson_is_scipys(successes, count):
    expected = stats.binomtest(successes, count).proportion_ci(method="wilson")
    assert wilson_interval(successes / count, count) == pytest.approx(tuple(expected), abs=1e-12)


def test_fifty_of_fifty_is_no_certainty():
    low, high = wilson_interval(1.0, 50)
    assert (round(low, 2), high) == (0.93, 1.0)


def test_the_interval_of_a_mean_covers_it_as_often_as_it_says():
    generator = np.random.default_rng(1)
    found = [mean_interval(generator.normal(3.0, 2.0, 50)) for _ in range(200)]
    covered = np.mean([low <= 3.0 <= high for low, high in found])
    assert 0.9 <= covered <= 0.99


def test_iqm_is_the_trimmed_mean_where_a_quarter_is_whole():
    values = np.random.default_rng(0).normal(size=(3, 8))
    np.testing.assert_allclose(interquartile_mean(values), stats.trim_mean(values, 0.25, axis=1))


def test_iqm_counts_edges_by_their_share():
    # Of five values a quarter is 1.25: the second and fourth count three quarters.
    expected = (0.75 * 1 + 2 + 0.75 * 5) / 2.5
    assert interquartile_mean(np.array([9.0, 2.0, 1.0, 5.0, -7.0])) == pytest.approx(expected)
    assert interquartile_mean(np.array([0.4])) == pytest.approx(0.4)


def test_seeds_that_differ_widen_the_interval_and_one_seed_is_its_goals():
    generator = np.random.default_rng(0)
    alike = (generator.random((5, 50)) < 0.5).astype(float)
    apart = np.repeat([[0.0], [0.25], [0.5], [0.75], [1.0]], 50, 1)
    middle, (low, high) = seeds_interval([alike])
    _, (wide_low, wide_high) = seeds_interval([apart])
    assert low < middle < high
    assert wide_high - wide_low > 2 * (high - low)
    one = alike[:1]
    _, found = seeds_interval([one])
    low, high = mean_interval(one[0])
    assert found == pytest.approx((low, high), abs=0.03)


def test_a_band_is_the_interval_of_every_point():
    curves = np.random.default_rng(0).random((5, 3))
    middle, low, high = seeds_band(curves)
    for point in range(3):
        iqm, interval = seeds_interval([curves[:, point, None]])
        assert middle[point] == pytest.approx(iqm)
        assert (low[point], high[point]) == pytest.approx(interval, abs=0.05)
    one = seeds_band(curves[:1])
    np.testing.assert_allclose(one, np.tile(curves[0], (3, 1)))


def test_strata_are_resampled_each_by_itself():
    """A task always solved and one never solved leave nothing to chance but which seeds count."""
    solved, failed = np.ones((4, 10)), np.zeros((4, 10))
    assert seeds_interval([solved, failed]) == (0.5, (0.5, 0.5))
