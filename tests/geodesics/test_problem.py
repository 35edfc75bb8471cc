from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.geodesics.learned_problem import LearnedProblem
from constraint_geodesics.geodesics.problem import repeated
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.learning.dataset import ShardTask, draw_free
from constraint_geodesics.studies.geodesic_search import MANIFOLDS, analytic_problem


@pytest.fixture(scope="module")
def problem(scene, params, trained):
    level = constraint_manifold(scene.robot, params.constraints["level_cup"])
    joints = draw_free(ShardTask(scene, level, 4000, (1,)))
    return LearnedProblem(trained.manifold, level, PinnedPolynomial(6, 3), joints, 16, True, 1.0)


def test_paths_keep_the_constraint_and_both_ends(problem) -> None:
    rng = np.random.default_rng(0)
    ends = problem.sample_ends(40, rng)
    phi = np.zeros((40, problem.curve.coefficients))
    feasible = np.flatnonzero(problem.evaluate(phi, ends).feasible)
    assert 10 < len(feasible) < 40, "some straight latent lines jump between branches, most do not"
    for row in feasible[:5]:
        one = ends[np.array([row])]
        path = problem.path(phi[row], one, 0.05)
        np.testing.assert_array_equal(path[[0, -1]], np.concatenate([one.q_start, one.q_goal]))
        assert problem.manifold.violation(path).max() <= 1e-9
        assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() <= 0.05


def test_a_jump_costs_more_than_it_saves(problem) -> None:
    rng = np.random.default_rng(1)
    ends = problem.sample_ends(60, rng)
    costs = problem.evaluate(np.zeros((60, problem.curve.coefficients)), ends)
    assert (costs.cost >= costs.length).all()
    assert np.median(costs.cost[costs.feasible] - costs.length[costs.feasible]) < 1e-2
    assert np.median(costs.cost[~costs.feasible] - costs.length[~costs.feasible]) > 0.5


def test_a_curve_does_not_look_shorter_than_it_is(problem) -> None:
    rng = np.random.default_rng(4)
    ends = problem.sample_ends(300, rng)
    phi = problem.sample_curves(ends, rng)
    costs, exact = (replace(problem, degree=degree).evaluate(phi, ends) for degree in (16, 256))
    both = costs.feasible & exact.feasible
    assert both.sum() > 100
    short = costs.cost[both] < exact.length[both] * (1 - 1e-3)
    assert short.mean() < 0.02, "the error estimate is part of the cost"
    assert (costs.length[both] < exact.length[both] * (1 - 1e-3)).mean() > short.mean()


def test_random_curves_find_a_way_where_the_straight_line_does_not(problem) -> None:
    rng = np.random.default_rng(2)
    ends = problem.sample_ends(30, rng)
    straight = problem.evaluate(np.zeros((30, problem.curve.coefficients)), ends).feasible
    found = 0
    for row in np.flatnonzero(~straight):
        many = repeated(ends[np.array([row])], 200)
        found += problem.evaluate(problem.sample_curves(many, rng), many).feasible.any()
    assert found >= 0.5 * (~straight).sum()


def test_the_fingerprint_knows_its_inputs(problem, scene, params) -> None:
    relaxed = constraint_manifold(scene.robot, params.constraints["level_cup_relaxed"])
    other = LearnedProblem(problem.chart, relaxed, problem.curve, problem.joints, 16, True, 1.0)
    same = LearnedProblem(
        problem.chart, problem.manifold, problem.curve, problem.joints.copy(), 16, True, 1.0
    )
    assert problem.fingerprint() == same.fingerprint() != other.fingerprint()


@pytest.mark.parametrize("name", sorted(MANIFOLDS))
def test_a_descent_shortens_curves_and_leads_to_the_line_in_the_plane(name: str) -> None:
    problem, rng = analytic_problem(name, PinnedPolynomial(2, 3)), np.random.default_rng(3)
    ends = problem.sample_ends(64, rng)
    phi = 0.3 * problem.sample_curves(ends, rng)
    step, before = problem.descent(phi, ends), problem.lengths(phi, ends)
    assert (np.linalg.norm(step, axis=1) <= 0.5 * ends.distance * (1 + 1e-9)).all()
    assert (problem.lengths(phi + 0.05 * step, ends) < before).all()
    for _ in range(60):
        phi = phi + 0.5 * problem.descent(phi, ends)
    if name == "plane":
        np.testing.assert_allclose(problem.lengths(phi, ends), ends.distance, rtol=1e-4)


def test_points_of_the_whole_sphere_are_uniform_by_area() -> None:
    """The height is uniform from −1 to 1 (Archimedes)."""
    points = analytic_problem("sphere", PinnedPolynomial(2, 3)).domain.sample(
        20_000, np.random.default_rng(0)
    )
    height = np.sort(np.sin(points[:, 0]))
    expected = np.linspace(-1.0, 1.0, len(height))
    assert np.abs(height - expected).max() / 2 < 1.63 / np.sqrt(len(height)), "Kolmogorov, 1 %"


def test_ends_are_trained_on_to_all_images_of_their_goals() -> None:
    problem = analytic_problem("torus", PinnedPolynomial(2, 3))
    ends = problem.sample_ends(2000, np.random.default_rng(0))
    turned = np.abs(ends.z_goal - ends.z_start) > np.pi
    shares = [(turned == choice).all(axis=1).mean() for choice in product([False, True], repeat=2)]
    assert min(shares) > 0.2
