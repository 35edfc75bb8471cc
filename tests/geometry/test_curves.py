import math

import numpy as np
import pytest
import torch

from constraint_geodesics.geometry.curves import (
    CurveError,
    CurveFamily,
    PinnedPolynomial,
    PinnedSpline,
)
from constraint_geodesics.geometry.manifold import NonFiniteError

T = torch.linspace(0, 1, 11, dtype=torch.float64)
FAMILIES = [PinnedPolynomial(2, 3), PinnedSpline(2, 3)]

every_family = pytest.mark.parametrize("curve", FAMILIES, ids=str)


def test_basis_of_low_degrees_is_the_known_one():
    basis = PinnedPolynomial(1, 4).basis(T)
    bump, x = T * (1 - T), 2 * T - 1
    torch.testing.assert_close(
        basis, torch.stack([bump, bump * x, bump * (1.5 * x**2 - 0.5)], dim=-1)
    )


@pytest.mark.parametrize("degree", [1, 2, 3, 6])
def test_number_of_coefficients(degree):
    curve = PinnedPolynomial(2, degree)
    assert curve.coefficients == 2 * (degree - 1)
    assert curve.basis(T).shape == curve.basis_derivative(T).shape == (11, degree - 1)


def test_basis_stays_well_conditioned_where_powers_of_t_do_not():
    curve, t = PinnedPolynomial(1, 10), torch.linspace(0, 1, 101, dtype=torch.float64)
    basis = curve.basis(t)
    powers = t[:, None] ** torch.arange(2, 11) - t[:, None]
    assert torch.linalg.cond(basis) < 50
    assert torch.linalg.cond(powers) > 1e6


def test_no_coefficients_or_zero_ones_give_the_straight_line():
    start, goal = torch.tensor([[1.0, -2.0]]), torch.tensor([[3.0, 5.0]])
    t = torch.tensor([0.0, 0.25, 1.0])
    for degree in (1, 3):
        curve = PinnedPolynomial(2, degree)
        points, velocities = curve.evaluate(torch.zeros(1, curve.coefficients), start, goal, t)
        torch.testing.assert_close(points[0], torch.tensor([[1.0, -2.0], [1.5, -0.25], [3.0, 5.0]]))
        torch.testing.assert_close(velocities[0], torch.tensor([[2.0, 7.0]]).expand(3, 2))


def test_coefficients_are_grouped_by_dimension():
    curve = PinnedPolynomial(2, 3)
    zero = torch.zeros(2, dtype=torch.float64)
    points, _ = curve.evaluate(torch.tensor([1.0, 0.5, 0, 2.0], dtype=torch.float64), zero, zero, T)
    torch.testing.assert_close(
        points, curve.basis(T) @ torch.tensor([[1.0, 0.0], [0.5, 2.0]], dtype=torch.float64)
    )


def test_ends_and_coefficients_broadcast():
    curve = PinnedPolynomial(2, 3)
    points, velocities = curve.evaluate(
        torch.zeros(4, 1, 4), torch.zeros(5, 2), torch.ones(2), torch.linspace(0, 1, 3)
    )
    assert points.shape == velocities.shape == (4, 5, 3, 2)
    assert curve.to_monomial(torch.zeros(4, 1, 4), torch.zeros(5, 2), torch.ones(2)).shape == (
        4,
        5,
        2,
        4,
    )


@every_family
def test_families_keep_the_protocol(curve):
    assert isinstance(curve, CurveFamily)
    assert curve.coefficients == curve.dim * curve.functions
    assert curve.basis(T).shape == curve.basis_derivative(T).shape == (11, curve.functions)
    assert curve.basis(T[:, None].float()).shape == (11, 1, curve.functions)
    assert curve.basis(T.float()).dtype == curve.basis_derivative(T.float()).dtype == torch.float32


@every_family
def test_curves_can_be_transformed_and_differentiated(curve):
    """Solvers map over curves and take second derivatives in φ."""
    ends = torch.zeros(4, 2, dtype=torch.float64)
    jacobian = torch.func.jacfwd(lambda phi, end: curve.evaluate(phi, end, end, T)[0])
    found = torch.func.vmap(jacobian)(torch.ones(4, curve.coefficients, dtype=torch.float64), ends)
    expected = torch.block_diag(*2 * [torch.eye(curve.functions, dtype=torch.float64)])
    blocks = expected.reshape(-1, 2, curve.functions)
    torch.testing.assert_close(
        found, torch.einsum("tk,pnk->tnp", curve.basis(T), blocks).expand(4, -1, -1, -1)
    )
    moving = (T[1:-1] + 0.01).requires_grad_()
    (slope,) = torch.autograd.grad(curve.basis(moving).sum(), moving)
    torch.testing.assert_close(slope, curve.basis_derivative(moving).sum(-1).detach())


# Splines


def test_a_spline_of_one_piece_has_the_bernstein_basis_of_the_cubics():
    expected = torch.stack([3 * T * (1 - T) ** 2, 3 * T**2 * (1 - T)], dim=-1)
    torch.testing.assert_close(PinnedSpline(1, 1).basis(T), expected, rtol=1e-15, atol=1e-16)


def test_spline_basis_has_the_known_values_at_its_knots():
    # At a knot two or more from the ends the three B-splines over it are 1/6, 2/3, 1/6.
    basis = PinnedSpline(1, 6).basis(torch.tensor([1 / 6, 1 / 2], dtype=torch.float64))
    expected = torch.tensor(
        [[1 / 4, 7 / 12, 1 / 6, 0, 0, 0, 0], [0, 0, 1 / 6, 2 / 3, 1 / 6, 0, 0]], dtype=torch.float64
    )
    torch.testing.assert_close(basis, expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("segments", [1, 2, 3, 5, 30])
def test_spline_basis_is_local_and_sums_to_one_with_the_end_functions(segments):
    curve, t = PinnedSpline(1, segments), torch.linspace(0, 1, 301, dtype=torch.float64)
    basis = curve.basis(t)
    ends = (1 - segments * t).clamp(min=0) ** 3 + (1 - segments * (1 - t)).clamp(min=0) ** 3
    torch.testing.assert_close(basis.sum(-1) + ends, torch.ones_like(t), rtol=0, atol=1e-13)
    assert (basis >= 0).all()
    assert ((basis > 0).sum(-1) <= 4).all()
    assert torch.linalg.cond(basis) < 6
    assert curve.breaks == tuple(k / segments for k in range(segments + 1))


@pytest.mark.parametrize("segments", [2, 3, 4, 7])
def test_splines_are_twice_continuously_differentiable_and_no_more(segments):
    """Jumps at the knots, from the cubics through the values inside each piece alone."""
    curve, inside = PinnedSpline(1, segments), np.array([0.1, 0.3, 0.5, 0.7, 0.9])
    at_ends = []
    for piece in range(segments):
        values = curve.basis(torch.from_numpy((piece + inside) / segments)).numpy()
        cubic = np.polynomial.Polynomial.fit
        pieces = [cubic(inside, column, 3, domain=[0, 1], window=[0, 1]) for column in values.T]
        at_ends.append(
            [[[p.deriv(order)(end) for p in pieces] for order in range(4)] for end in (0.0, 1.0)]
        )
    at_ends = np.array(at_ends)
    jumps = np.abs(at_ends[1:, 0] - at_ends[:-1, 1])
    assert jumps[:, :3].max() < 1e-12
    assert (jumps[:, 3].max(axis=-1) > 1).all()


@pytest.mark.parametrize("segments", [2, 3, 4, 7])
def test_derivatives_of_splines_do_not_jump_at_the_knots(segments):
    curve = PinnedSpline(1, segments)
    knots = torch.tensor(curve.breaks[1:-1], dtype=torch.float64)
    for function in (curve.basis, curve.basis_derivative, curve.basis_second_derivative):
        torch.testing.assert_close(
            function(knots - 1e-12), function(knots + 1e-12), rtol=0, atol=1e-8
        )


# Refusals


def test_wrong_shapes_are_refused():
    curve = PinnedPolynomial(2, 3)
    phi, end, t = torch.zeros(4), torch.zeros(2), torch.zeros(3)
    with pytest.raises(
        CurveError, match=r"phi has shape \(5,\): its last axis must have 4 entries"
    ):
        curve.evaluate(torch.zeros(5), end, end, t)
    with pytest.raises(
        CurveError, match=r"start has shape \(3, 3\): its last axis must have 2 entries"
    ):
        curve.evaluate(phi, torch.zeros(3, 3), end, t)
    with pytest.raises(CurveError, match=r"goal has shape \(\)"):
        curve.to_monomial(phi, end, torch.tensor(0.0))
    with pytest.raises(CurveError, match=r"t has shape \(3, 1\)"):
        curve.evaluate(phi, end, end, t[:, None])


@every_family
def test_times_must_fit_the_batch_of_the_curves(curve):
    phi, end = torch.zeros(4, curve.coefficients), torch.zeros(2)
    for t in (torch.zeros(3, 5), torch.zeros(2, 4, 5), torch.tensor(0.5)):
        for function in (curve.evaluate, curve.acceleration):
            with pytest.raises(
                CurveError, match=r"must be \(T,\), or \(\*batch, T\) for curves of batch \(4,\)"
            ):
                function(phi, end, end, t)
    assert curve.evaluate(phi, end, end, torch.zeros(1, 5))[0].shape == (4, 5, 2)


@every_family
def test_samples_that_no_curve_can_be_fitted_to_are_refused(curve):
    points, few = torch.zeros(11, 2, dtype=torch.float64), curve.functions + 1
    with pytest.raises(
        CurveError, match=rf"points has {few} points a curve: must be at least {few + 1}"
    ):
        curve.fit(points[:few], torch.linspace(0, 1, few, dtype=torch.float64))
    with pytest.raises(CurveError, match=r"points has shape \(11, 2\) and t \(10,\)"):
        curve.fit(points, T[:-1])
    with pytest.raises(CurveError, match=r"must be \(\*batch, T, 2\)"):
        curve.fit(points[:, :1], T)
    with pytest.raises(CurveError, match=r"t runs from 0.0 to 0.5: must run from 0 to 1"):
        curve.fit(points, T / 2)
    with pytest.raises(CurveError, match=r"t tells 1 basis functions apart: must tell all"):
        curve.fit(points, torch.tensor([0.0] + 9 * [0.4] + [1.0], dtype=torch.float64))
    points[3, 1] = math.nan
    with pytest.raises(NonFiniteError, match=r"points\[3, 1\] = nan"):
        curve.fit(points, T)


@pytest.mark.parametrize(("dim", "degree", "named"), [(0, 3, "dim = 0"), (2, 0, "degree = 0")])
def test_families_that_do_not_exist_are_refused(dim, degree, named):
    with pytest.raises(CurveError, match=named):
        PinnedPolynomial(dim, degree)


@pytest.mark.parametrize(("dim", "segments", "named"), [(0, 3, "dim = 0"), (2, 0, "segments = 0")])
def test_splines_that_do_not_exist_are_refused(dim, segments, named):
    with pytest.raises(CurveError, match=named):
        PinnedSpline(dim, segments)
