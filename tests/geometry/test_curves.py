import pytest
import torch

from constraint_geodesics.geometry.curves import CurveError, PinnedPolynomial

T = torch.linspace(0, 1, 11, dtype=torch.float64)


def test_basis_of_low_degrees_is_the_known_one():
    basis = PinnedPolynomial(1, 4).basis(T)
    bump, x = T * (1 - T), 2 * T - 1
    torch.testing.assert_close(basis, torch.stack([bump, bump * x, bump * (1.5 * x**2 - 0.5)], dim=-1))


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
    torch.testing.assert_close(points, curve.basis(T) @ torch.tensor([[1.0, 0.0], [0.5, 2.0]], dtype=torch.float64))


def test_ends_and_coefficients_broadcast():
    curve = PinnedPolynomial(2, 3)
    points, velocities = curve.evaluate(torch.zeros(4, 1, 4), torch.zeros(5, 2), torch.ones(2), torch.linspace(0, 1, 3))
    assert points.shape == velocities.shape == (4, 5, 3, 2)
    assert curve.to_monomial(torch.zeros(4, 1, 4), torch.zeros(5, 2), torch.ones(2)).shape == (4, 5, 2, 4)


def test_wrong_shapes_are_refused():
    curve = PinnedPolynomial(2, 3)
    phi, end, t = torch.zeros(4), torch.zeros(2), torch.zeros(3)
    with pytest.raises(CurveError, match=r"phi has shape \(5,\): its last axis must have 4 entries"):
        curve.evaluate(torch.zeros(5), end, end, t)
    with pytest.raises(CurveError, match=r"start has shape \(3, 3\): its last axis must have 2 entries"):
        curve.evaluate(phi, torch.zeros(3, 3), end, t)
    with pytest.raises(CurveError, match=r"goal has shape \(\)"):
        curve.to_monomial(phi, end, torch.tensor(0.0))
    with pytest.raises(CurveError, match=r"t has shape \(3, 1\)"):
        curve.evaluate(phi, end, end, t[:, None])


@pytest.mark.parametrize(("dim", "degree", "named"), [(0, 3, "dim = 0"), (2, 0, "degree = 0")])
def test_families_that_do_not_exist_are_refused(dim, degree, named):
    with pytest.raises(CurveError, match=named):
        PinnedPolynomial(dim, degree)
