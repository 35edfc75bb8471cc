"""The descent never makes a curve worse, and ends where nothing is shorter."""

import numpy as np

from constraint_geodesics.geodesics.descent import INFEASIBLE, beginning, descended, ranks, stepped
from constraint_geodesics.geodesics.problem import Costs
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.studies.geodesic_search import analytic_problem


def test_no_step_makes_a_curve_worse_and_strides_learn_from_it() -> None:
    problem = analytic_problem("torus", PinnedPolynomial(2, 3))
    rng = np.random.default_rng(0)
    ends = problem.sample_ends(64, rng)
    curves = beginning(problem, problem.sample_curves(ends, rng), ends)
    for _ in range(10):
        after = stepped(problem, curves, ends)
        assert (after.rank <= curves.rank).all()
        better = after.rank < curves.rank
        assert (after.stride[~better] < curves.stride[~better]).all()
        assert (after.stride[better] >= curves.stride[better]).all()
        np.testing.assert_array_equal(after.phi[~better], curves.phi[~better])
        curves = after
    np.testing.assert_allclose(
        curves.now.costs.cost, problem.evaluate(curves.phi, ends).cost, rtol=1e-12
    )


def test_in_the_plane_it_ends_on_the_straight_line() -> None:
    problem = analytic_problem("plane", PinnedPolynomial(2, 3))
    rng = np.random.default_rng(1)
    ends = problem.sample_ends(32, rng)
    start = beginning(problem, problem.sample_curves(ends, rng), ends)
    found = descended(problem, start, ends, 30)
    np.testing.assert_allclose(found.now.costs.length, ends.distance, rtol=1e-6)


def test_what_is_not_feasible_comes_last() -> None:
    costs = Costs(np.ones(2), np.array([5.0, 1.0]), np.array([True, False]))
    np.testing.assert_array_equal(ranks(costs), [5.0, 1.0 + INFEASIBLE])
