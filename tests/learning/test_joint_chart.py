import numpy as np
import pytest
import torch

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.geodesics.learned_problem import LearnedProblem
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.learning.learned_manifold import JointManifold


@pytest.fixture(scope="module")
def chart(trained) -> JointManifold:
    return JointManifold.of(trained.joints)


@pytest.fixture(scope="module")
def problem(scene, params, chart, trained) -> LearnedProblem:
    free = constraint_manifold(scene.robot, params.constraints["free"])
    return LearnedProblem(chart, free, PinnedPolynomial(6, 3), trained.joints, 16, True, 1.0)


def test_encoding_is_undone_and_of_the_size_of_latent_coordinates(chart, trained) -> None:
    z = chart.encode(trained.joints)
    assert z.shape == trained.joints.shape
    np.testing.assert_allclose(chart.decode(z), trained.joints, atol=1e-12)
    np.testing.assert_allclose(z.mean(axis=0), 0.0, atol=1e-12)
    assert z.var(axis=0).mean() == pytest.approx(1.0, abs=1e-12)
    between = np.diff(z[[0, 1, 2]], axis=0)
    np.testing.assert_allclose(
        between * float(chart.vae.scale[0]), np.diff(trained.joints[:3], axis=0), atol=1e-12
    )


def test_its_metric_is_one_everywhere_and_its_deviation_adds_nothing(chart, trained) -> None:
    z = chart.encode(trained.joints[:50])
    square = float(chart.vae.scale[0]) ** 2
    metric = chart.metric(chart.tensor(10 * z))
    torch.testing.assert_close(
        metric, (square * torch.eye(6, dtype=torch.float64)).expand(50, 6, 6)
    )
    embedded = chart.embed_points(10 * z)
    assert embedded.shape == (50, 12)
    assert np.ptp(embedded[:, 6:]) == 0.0
    assert embedded[0, 6] <= 1e-6


def test_a_straight_line_without_constraint_is_the_joint_line(problem) -> None:
    ends = problem.sample_ends(60, np.random.default_rng(0))
    look = problem.observed(np.zeros((60, problem.curve.coefficients)), ends)
    assert look.costs.feasible.all()
    np.testing.assert_allclose(
        look.costs.length, np.linalg.norm(ends.q_goal - ends.q_start, axis=1), rtol=1e-5
    )
    assert (np.linalg.norm(look.descent, axis=1) / ends.distance).max() < 1e-9


def test_one_step_of_the_descent_straightens_a_curve_without_constraint(problem) -> None:
    rng = np.random.default_rng(1)
    ends = problem.sample_ends(60, rng)
    phi = 0.05 * ends.distance[:, None] * rng.normal(size=(60, problem.curve.coefficients))
    look = problem.observed(phi, ends)
    inside = look.costs.feasible
    assert inside.sum() > 20
    left = np.linalg.norm(phi + look.descent, axis=1) / np.linalg.norm(phi, axis=1)
    assert left[inside].max() < 0.05, (
        "the energy is quadratic in the coefficients and the descent is Newton's step"
    )


def test_the_fingerprint_tells_charts_apart(problem, trained) -> None:
    def on(chart) -> str:
        return LearnedProblem(
            chart, problem.manifold, problem.curve, problem.joints, problem.degree, True, 1.0
        ).fingerprint()

    assert problem.fingerprint() == on(JointManifold.of(trained.joints.copy()))
    assert problem.fingerprint() not in (
        on(trained.manifold),
        on(JointManifold.of(trained.joints[:100])),
    )


@pytest.mark.parametrize("joints", [np.zeros((5, 6)), np.ones(6), np.full((3, 6), np.nan)])
def test_joints_that_span_nothing_are_refused(joints) -> None:
    with pytest.raises(ValueError, match=r"joints has shape"):
        JointManifold.of(joints)
