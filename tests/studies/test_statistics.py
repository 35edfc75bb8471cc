"""Statistics of few runs against numbers worked out by hand, and against the project's others."""

from itertools import product

import numpy as np
import pytest

from constraint_geodesics.benchmark import statistics as of_queries
from constraint_geodesics.studies.statistics import (
    RESAMPLES,
    bootstrap_interval,
    interquartile_mean,
    probability_of_improvement,
)


def test_a_quarter_is_left_out_at_each_end() -> None:
    assert interquartile_mean(np.array([9.0, 1.0, 2.0, -50.0, 3.0, 4.0, 100.0, 5.0])) == 3.5
    assert interquartile_mean(np.array([1.0, 2.0, 6.0])) == 3.0, "of three values none is left out"
    assert interquartile_mean(np.array([[1.0, 2.0], [3.0, 100.0]])) == 2.5, "of all values together"
    assert np.isnan(interquartile_mean(np.array([])))


@pytest.mark.parametrize("count", [1, 4, 5, 11, 100])
def test_the_interquartile_mean_is_that_of_the_benchmark(count: int) -> None:
    values = np.random.default_rng(count).normal(size=count)
    assert interquartile_mean(values) == pytest.approx(of_queries.interquartile_mean(values)[1])


def test_the_interval_of_few_runs_is_exact() -> None:
    values = np.array([0.0, 1.0, 5.0])
    means = [np.mean(drawn) for drawn in product(values, repeat=3)]
    wanted = np.quantile(means, [0.05, 0.95])
    assert bootstrap_interval(values, np.mean, 0.9) == pytest.approx(tuple(wanted))
    assert bootstrap_interval(values, np.mean, 0.9, seed=5) == pytest.approx(tuple(wanted))


def test_the_interval_of_many_runs_is_near_the_normal_one_and_hangs_on_its_seed() -> None:
    values = np.random.default_rng(0).normal(2.0, 1.0, size=400)
    low, high = bootstrap_interval(values, np.mean)
    error = values.std() / 20.0
    assert low == pytest.approx(values.mean() - 1.96 * error, abs=0.2 * error)
    assert high == pytest.approx(values.mean() + 1.96 * error, abs=0.2 * error)
    assert bootstrap_interval(values, np.mean) == (low, high)
    assert bootstrap_interval(values, np.mean, seed=1) != (low, high)
    assert RESAMPLES < 400**400


def test_a_run_keeps_its_tasks_together() -> None:
    """Two tasks that add up to 1 in each run: their sum has no spread, drawn apart it would."""
    scores = np.array([[0.1, 0.9], [0.5, 0.5], [0.9, 0.1]])
    assert bootstrap_interval(scores, np.mean) == pytest.approx((0.5, 0.5))


def test_one_run_has_no_spread_and_none_no_interval() -> None:
    assert bootstrap_interval(np.array([3.0]), np.mean) == (3.0, 3.0)
    assert all(np.isnan(bootstrap_interval(np.array([]), np.mean)))
    with pytest.raises(ValueError, match=r"^level=95: must lie between 0 and 1$"):
        bootstrap_interval(np.array([3.0]), np.mean, level=95)


def test_ties_count_half() -> None:
    mine, others = np.array([1.0, 2.0]), np.array([1.0, 0.0])
    assert probability_of_improvement(mine, others) == (0.5 + 1 + 1 + 1) / 4
    assert probability_of_improvement(others, mine) == 1 - (0.5 + 1 + 1 + 1) / 4
    assert probability_of_improvement(mine, mine) == 0.5


def test_tasks_count_alike() -> None:
    mine, others = np.array([[1.0, 0.0]]), np.array([[0.0, 1.0], [0.0, 0.0]])
    assert probability_of_improvement(mine, others) == (1.0 + 0.25) / 2
    assert np.isnan(probability_of_improvement(mine, np.empty((0, 2))))
