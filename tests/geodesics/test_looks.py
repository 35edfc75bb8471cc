"""The compiled look at curves against plain numpy, and spheres on the way."""

from dataclasses import replace

import numpy as np
import pytest

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.geodesics import look_kernels as kernels
from constraint_geodesics.geodesics.learned_problem import MARGIN_M, LearnedProblem
from constraint_geodesics.geodesics.obstacles import met_by, with_spheres
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.geometry.length import Collocation
from constraint_geodesics.learning.dataset import ShardTask, draw_free
from constraint_geodesics.learning.learned_manifold import joint_space
from constraint_geodesics.learning.lift import closely, jump_excess
from constraint_geodesics.scene.clearance import clearance_model

DEGREE = 16


@pytest.fixture(scope="module")
def problem(scene, params):
    manifold = constraint_manifold(scene.robot, params.constraints["level_cup"])
    joints = draw_free(ShardTask(scene, manifold, 600, (1,)))
    clearance = clearance_model(scene)
    space = joint_space(scene.robot), manifold, PinnedPolynomial(6, 3), joints
    return LearnedProblem(*space, DEGREE, True, 0.0, clearance=clearance)


@pytest.fixture(scope="module")
def looked(problem):
    rng = np.random.default_rng(0)
    ends = problem.sample_ends(60, rng)
    phi = problem.sample_curves(ends, rng)
    return phi, ends, problem.looked(problem.decoded(phi, ends), ends, 60)


def test_curves_are_clipped_and_retracted_between_their_ends(problem, looked) -> None:
    phi, ends, look = looked
    decoded, _ = problem.decoded(phi, ends)
    robot = problem.manifold.robot
    inner = decoded[:, 1:-1].clip(robot.lower, robot.upper)
    expected = retract(problem.manifold, inner, problem.retraction)
    np.testing.assert_allclose(look.joints[:, 1:-1], expected.joints, atol=1e-12)
    np.testing.assert_array_equal(look.joints[:, [0, -1]], decoded[:, [0, -1]])
    left = look.figures[:, kernels.LEFT]
    np.testing.assert_allclose(left, expected.violation.max(axis=1), atol=1e-15)


def test_figures_are_those_of_numpy(problem, looked) -> None:
    _, _, look = looked
    rule, robot = Collocation.chebyshev(DEGREE), problem.manifold.robot
    slopes = rule.derivative.numpy() @ look.joints
    length = np.linalg.norm(slopes, axis=-1) @ rule.weights.numpy()
    np.testing.assert_allclose(look.figures[:, kernels.LENGTH], length, rtol=1e-12)
    half = rule.half.derivative.numpy() @ look.joints[:, ::2]
    coarse = np.linalg.norm(half, axis=-1) @ rule.half.weights.numpy()
    np.testing.assert_allclose(
        look.figures[:, kernels.ERROR], np.abs(length - coarse), rtol=1e-9, atol=1e-12
    )
    jumps = jump_excess(look.joints, rule.times.numpy())
    np.testing.assert_allclose(look.figures[:, kernels.JUMP], jumps, rtol=1e-9, atol=1e-12)
    outside = -np.minimum(robot.limit_distance(look.joints), 0.0)
    assert (look.figures[:, kernels.OUTSIDE] >= outside.max(axis=1) - 1e-12).all()
    some = look.joints[:, 2:-2:2]
    short = np.maximum(MARGIN_M - problem.clearance.clearance(robot, some, MARGIN_M), 0.0)
    short[jumps > 0.0] = 0.0  # what jumps is not asked
    np.testing.assert_allclose(look.figures[:, kernels.DEEP], short.sum(axis=1), atol=1e-9)
    np.testing.assert_allclose(look.figures[:, kernels.DEEPEST], short.max(axis=1), atol=1e-9)
    assert (short > MARGIN_M).any(), "some of them touch something"


def test_a_push_leads_away_from_what_is_too_close(problem) -> None:
    rng = np.random.default_rng(3)
    ends = problem.sample_ends(800, rng)
    phi = 0.3 * problem.sample_curves(ends, rng)
    look = problem.looked(problem.decoded(phi, ends), ends, 800)
    close = np.flatnonzero(
        (look.figures[:, kernels.DEEPEST] > 0.0)
        & (look.figures[:, kernels.DEEPEST] < 0.02)
        & (look.figures[:, kernels.JUMP] == 0.0)
    )
    assert len(close) >= 3
    better = 0
    for row in close:
        one, push = ends[np.array([row])], look.push[row][None]
        moved = phi[row][None] + push
        before, after = (
            problem.looked(problem.decoded(p, one), one, 0).figures[0, kernels.DEEP]
            for p in (phi[row][None], moved)
        )
        better += after < before
    assert better >= 0.7 * len(close)


def test_figures_alone_cost_the_same(problem, looked) -> None:
    phi, ends, look = looked
    full = problem.costs_of(look.figures)
    alone = problem.evaluate(phi, ends)
    np.testing.assert_array_equal(alone.feasible, full.feasible)
    np.testing.assert_array_equal(alone.cost, full.cost)
    assert full.feasible.any()


def test_spheres_are_on_the_way_of_their_pairs(problem, scene) -> None:
    found = with_spheres(problem, scene, 3, (0.06, 0.1), np.random.default_rng(2))
    assert len(found) == 3
    robot = problem.manifold.robot
    for member in found:
        assert len(member.pairs) >= 3
        assert (member.clearance.clearance(robot, member.pairs) > 0.0).all()
        ends = member.ends(member.pairs[:, 0], member.pairs[:, 1])
        phi = np.zeros((len(ends), problem.curve.coefficients))
        alone, beset = (
            replace(member, clearance=c).evaluate(phi, ends).feasible
            for c in (problem.clearance, member.clearance)
        )
        assert not (beset & ~alone).any(), "a sphere frees no curve"
        curves = problem.looked(problem.decoded(phi, ends), ends, 0).joints
        assert not beset[met_by(problem, member.clearance, curves[:, ::2])].any()
        drawn = member.sample_ends(20, np.random.default_rng(0))
        known = {pair.tobytes() for pair in member.pairs[:, 0]}
        assert all(q.tobytes() in known for q in drawn.q_start)


def test_a_steep_curve_is_looked_at_where_it_is_steep() -> None:
    def steep(t: np.ndarray) -> np.ndarray:
        return np.stack([np.tanh(4000.0 * (t - 0.3)), t], axis=1)

    times, points = closely(steep, 0.1)
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).max() <= 0.1
    assert (np.diff(times) > 0).all()
    assert len(times) < 400
    np.testing.assert_array_equal(points, steep(times))


def test_a_jump_stays_one() -> None:
    times, points = closely(lambda t: (t > 0.4)[:, None] * np.ones((1, 3)), 0.1)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert (steps > 0.1).sum() == 1
    assert len(times) < 400
