"""The shortest curve of a family: no start is shorter, and exact where the answer is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.geodesics.learned_problem import LearnedProblem
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.learning.learned_manifold import JointManifold
from constraint_geodesics.studies import optimum as bench

SMALL = bench.OptimumSettings(
    random_starts=4, drawn=16, descent_steps=6, polished=2, polish_steps=8
)


def constrained(chart, manifold, trained) -> LearnedProblem:
    """Data by retraction alone: no constraint needs a training set."""
    found = retract(manifold, trained.joints[:600])
    inside = found.converged & (manifold.robot.limit_distance(found.joints) > 0)
    return LearnedProblem(
        chart, manifold, PinnedPolynomial(6, 3), found.joints[inside], 16, True, 1.0
    )


@pytest.fixture(scope="module")
def level(scene, params, trained) -> LearnedProblem:
    return constrained(
        trained.manifold, constraint_manifold(scene.robot, params.constraints["level_cup"]), trained
    )


def test_the_optimum_without_constraint_is_the_straight_joint_line(scene, params, trained) -> None:
    chart = JointManifold.of(trained.joints)
    free = constraint_manifold(scene.robot, params.constraints["free"])
    problem = LearnedProblem(chart, free, PinnedPolynomial(6, 3), trained.joints, 16, True, 1.0)
    rng = np.random.default_rng(2)
    ends = problem.sample_ends(12, rng)
    bent = 0.2 * rng.normal(size=(12, 2, problem.curve.coefficients))
    exact = np.linalg.norm(ends.q_goal - ends.q_start, axis=1)
    for changed in (
        {"polish_steps": 0, "descent_steps": 12},
        {"polish_steps": 30, "descent_steps": 0},
    ):
        found = bench.family_optimum(problem, ends, bent, replace(SMALL, **changed))
        assert found.feasible.all()
        assert (found.length >= exact * (1 - 1e-6)).all()
        np.testing.assert_allclose(found.length, exact, rtol=1e-4)


def test_the_optimum_is_sound_and_no_longer_than_any_start(level) -> None:
    rng = np.random.default_rng(7)
    ends = level.sample_ends(12, rng)
    each = np.repeat(np.arange(12), 4)
    starts = level.sample_curves(ends[each], rng)
    costs = bench.measured(level, starts, ends[each])
    length = np.where(costs.feasible, costs.length, np.inf).reshape(12, 4).min(axis=1)
    found = bench.family_optimum(level, ends, starts.reshape(12, 4, -1), SMALL)
    started = np.isfinite(length)
    assert started.sum() > 3
    assert found.feasible[started].all()
    assert (found.length <= length * (1 + 1e-4))[started].all()
    assert (found.length < 0.99 * length)[started].any()
    again = bench.measured(level, found.phi, ends)
    np.testing.assert_array_equal(again.feasible, found.feasible)
    np.testing.assert_allclose(
        again.length[found.feasible], found.length[found.feasible], rtol=1e-4
    )
    assert np.isnan(found.length[~found.feasible]).all()


def test_the_optimum_is_no_longer_than_another_optimiser_finds(level) -> None:
    ends = level.sample_ends(40, np.random.default_rng(3))
    zero = np.zeros((40, level.curve.coefficients))
    ends = ends[np.flatnonzero(bench.measured(level, zero, ends).feasible)[:3]]
    found = bench.family_optimum(
        level, ends, zero[: len(ends), None], replace(SMALL, polish_steps=30)
    )
    finer, shorter = replace(level, degree=bench.POLISH_DEGREE, retraction=bench.EXACT), 0
    for row in range(len(ends)):
        one = ends[np.array([row])]
        theirs = minimize(
            lambda phi, one=one: float(finer.evaluate(phi[None], one).cost[0]),
            zero[0],
            method="BFGS",
            options={"eps": 1e-3, "maxiter": 20},
        )
        costs = bench.measured(level, theirs.x[None], one)
        assert costs.feasible[0]
        assert found.length[row] <= costs.length[0] * (1 + 1e-4)
        shorter += int(costs.length[0] < 0.999 * bench.measured(level, zero[:1], one).length[0])
    assert len(ends) == 3
    assert shorter > 0


def test_polishing_makes_no_curve_worse(level) -> None:
    rng = np.random.default_rng(4)
    ends = level.sample_ends(30, rng)
    phi = level.sample_curves(ends, rng)
    before = level.evaluate(phi, ends)
    after = level.evaluate(bench.polished(level, phi, ends, 15), ends)
    assert 5 < before.feasible.sum() < 30
    assert after.feasible[before.feasible].all()
    # batches of another size round differently in single precision
    assert (after.cost <= before.cost * (1 + 1e-3)).all()
    gain = (1 - after.cost / before.cost)[before.feasible]
    assert np.median(gain) > 0.01


def test_a_jump_between_the_points_of_a_length_does_not_go_unseen(level) -> None:
    ends = level.sample_ends(60, np.random.default_rng(5))
    phi = np.zeros((60, level.curve.coefficients))
    coarse, fine = replace(level, degree=4).evaluate(phi, ends), bench.measured(level, phi, ends)
    assert (coarse.feasible & ~fine.feasible).sum() > 5
    each = [ends[np.array([row])] for row in range(60)]
    paths = [level.path(phi[0], one, 0.02) for one in each]
    steps = np.array([np.linalg.norm(np.diff(path, axis=0), axis=1).max() for path in paths])
    assert (steps[fine.feasible] <= 0.1).all()
    sound = np.array([bench.is_sound(level, phi[0], one) for one in each])
    np.testing.assert_array_equal(sound & (steps > 0.1), False)
    assert (coarse.feasible & ~sound).sum() > 5
