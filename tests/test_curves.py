import math

import numpy as np
import pytest
from scipy import stats

from jaxswarm.analysis import curves
from jaxswarm.analysis.curves import Curve


def make_curve(x, y):
    return Curve(np.array(x, float), np.array(y, float))


def make_rows(seed, steps, returns, **columns):
    return [
        {"update": i, "agent_steps": x, "seed": seed, "eval/return": y} | {name: z[i] for name, z in columns.items()}
        for i, (x, y) in enumerate(zip(steps, returns, strict=True))
    ]


def test_rows_of_several_seeds_are_a_curve_each():
    rows = make_rows(7, [0, 10, 20], [-3.0, -2.0, -1.0]) + make_rows(2, [0, 5], [-9.0, -8.0])
    found, num_left_out = curves.from_rows(rows[::-1], "agent_steps", "eval/return")
    assert list(found) == [2, 7]
    assert num_left_out == 0
    np.testing.assert_array_equal(found[7].x, [0, 10, 20])
    np.testing.assert_array_equal(found[7].y, [-3, -2, -1])


def test_what_is_not_finite_is_left_out_and_counted():
    rows = make_rows(0, [0, 1, 2, 3], [1.0, math.nan, math.inf, 4.0]) + make_rows(1, [0, 1], [math.nan, math.nan])
    found, num_left_out = curves.from_rows(rows, "agent_steps", "eval/return")
    assert list(found) == [0]
    assert num_left_out == 4
    np.testing.assert_array_equal(found[0].x, [0, 3])


def test_a_metric_of_training_has_no_value_before_the_first_update():
    loss = [math.nan, 2.0, math.nan, 1.0]
    rows = make_rows(0, range(4), [0.0] * 4, **{"learner/loss": loss})
    found, num_left_out = curves.from_rows(rows, "update", "learner/loss")
    assert num_left_out == 1
    np.testing.assert_array_equal(found[0].x, [1, 3])


def test_the_mean_over_earlier_evaluations_uses_no_later_ones():
    curve = make_curve(range(5), [1, 2, 6, 3, 0])
    np.testing.assert_allclose(curves.trailing_mean(curve, 3).y, [1, 1.5, 3, 11 / 3, 3])
    np.testing.assert_allclose(curves.trailing_mean(curve, 1).y, curve.y)


def test_seeds_are_interpolated_within_their_range_and_not_counted_outside():
    grid, values = curves.on_common_grid([make_curve([0, 10, 20], [0, 1, 0]), make_curve([5, 15], [4, 6])])
    np.testing.assert_array_equal(grid, [0, 5, 10, 15, 20])
    np.testing.assert_array_equal(values, [[0, 0.5, 1, 0.5, 0], [math.nan, 4, 5, 6, math.nan]])


def test_very_many_points_are_thinned_out_to_the_ends():
    grid, values = curves.on_common_grid([make_curve(np.arange(5000) + shift, np.arange(5000)) for shift in (0, 0.5)])
    assert values.shape == (2, curves.MAX_POINTS)
    assert (grid[0], grid[-1]) == (0, 4999.5)


@pytest.fixture
def seeds():
    """Return nine seeds on one grid; three of them end early."""
    key = np.random.default_rng(0)
    return [make_curve(range(n), key.normal(size=n)) for n in (4, 4, 6, 8, 8, 8, 8, 8, 8)]


def test_the_median_has_the_quartiles_of_the_seeds_that_are_there(seeds):
    line = curves.summarize(seeds, "median")
    np.testing.assert_array_equal(line.num_seeds, [9] * 4 + [7] * 2 + [6] * 2)
    for i in range(8):
        there = [seed.y[i] for seed in seeds if len(seed.y) > i]
        expected = np.percentile(there, [50, 25, 75])
        np.testing.assert_allclose([line.y[i], line.lower[i], line.upper[i]], expected)


def test_the_interquartile_mean_drops_a_quarter_on_either_side(seeds):
    line = curves.summarize(seeds, "iqm")
    for i in range(8):
        there = sorted(seed.y[i] for seed in seeds if len(seed.y) > i)
        cut = len(there) // 4
        np.testing.assert_allclose(line.y[i], np.mean(there[cut : len(there) - cut]))
    assert (line.lower < line.y).all()
    assert (line.y < line.upper).all()


def test_the_interval_is_that_of_bootstrapped_seeds():
    values = np.random.default_rng(1).normal(size=(10, 2))
    _, lower, upper = curves.interquartile_mean(values)
    bootstrapped = values[np.random.default_rng(2).integers(10, size=(20_000, 10))]
    expected = np.percentile(np.sort(bootstrapped, axis=1)[:, 2:8].mean(axis=1), [2.5, 97.5], axis=0)
    np.testing.assert_allclose([lower, upper], expected, atol=0.05)


@pytest.mark.parametrize("statistic", curves.STATISTICS)
def test_one_seed_is_its_own_statistic_without_a_band(statistic):
    line = curves.summarize([make_curve([0, 1], [2, 3])], statistic)
    np.testing.assert_array_equal(line.y, [2, 3])
    assert np.isnan([line.lower, line.upper]).all()


@pytest.mark.parametrize("statistic", curves.STATISTICS)
def test_the_order_of_seeds_does_not_matter(seeds, statistic):
    line, same = curves.summarize(seeds, statistic), curves.summarize(seeds[::-1], statistic)
    np.testing.assert_allclose(line.y, same.y)


def test_a_profile_is_the_fraction_above_each_value():
    finals = np.array([3.0, 1.0, 2.0, 2.0])
    line = curves.profile(finals, np.array([0.0, 1.0, 1.5, 2.0, 3.0]))
    np.testing.assert_array_equal(line.y, [1, 0.75, 0.75, 0.25, 0])
    np.testing.assert_array_equal(line.y, 1 - stats.ecdf(finals).cdf.evaluate(line.x))
    assert (line.lower[0], line.upper[0], line.lower[-1], line.upper[-1]) == (1, 1, 0, 0)
    assert line.lower[1] < 0.75 < line.upper[1]


def test_the_time_to_a_threshold_is_that_of_the_first_evaluation_there():
    seeds = [make_curve([0, 1, 2, 3], [0, 5, 4, 6]), make_curve([0, 1, 2], [0, 1, 2])]
    times, is_reached = curves.times_to(seeds, 5.0)
    assert times.tolist() == [1, 2]
    assert is_reached.tolist() == [True, False]


def test_seeds_that_end_early_count_as_long_as_they_last():
    """Compare with the product over events: 1 of 5 at time 1, one ends at 2, 1 of 3 at time 3, two end at 4."""
    ends = {1: True, 2: False, 3: True, 4: False}
    seeds = [make_curve([0, at], [0, 1 if is_event else 0]) for at, is_event in ends.items()]
    line = curves.reaching([*seeds, make_curve([0, 4], [0, 0])], 1.0)
    np.testing.assert_array_equal(line.x, [0, 1, 2, 3, 4])
    np.testing.assert_allclose(1 - line.y, [1, 4 / 5, 4 / 5, 4 / 5 * 2 / 3, 4 / 5 * 2 / 3])
    np.testing.assert_array_equal(line.num_seeds, [5, 5, 4, 3, 2])
    deviation = math.sqrt(1 / (5 * 4) + 1 / (3 * 2)) / abs(math.log(8 / 15))
    bounds = (8 / 15) ** np.exp(stats.norm.ppf([0.025, 0.975]) * deviation)
    np.testing.assert_allclose([line.lower[3], line.upper[3]], 1 - bounds)


@pytest.mark.parametrize(("threshold", "fraction"), [(-1.0, 1), (9.0, 0)])
def test_all_or_no_seeds_reach_a_threshold(threshold, fraction):
    line = curves.reaching([make_curve([0, 1], [0, 1])] * 3, threshold)
    assert line.y[-1] == fraction
    assert np.isnan(line.lower).all()
