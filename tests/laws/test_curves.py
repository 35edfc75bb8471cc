"""What every curve family must satisfy, over all members, dimensions and batch shapes, in
float64.
"""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch import Tensor

from constraint_geodesics.geometry.curves import CurveFamily, PinnedPolynomial, PinnedSpline

FAMILIES: dict[str, Callable[[int], CurveFamily]] = {
    "straight": lambda dim: PinnedPolynomial(dim, 1),
    "parabola": lambda dim: PinnedPolynomial(dim, 2),
    "cubic": lambda dim: PinnedPolynomial(dim, 3),
    "degree_8": lambda dim: PinnedPolynomial(dim, 8),
    "spline_1": lambda dim: PinnedSpline(dim, 1),
    "spline_2": lambda dim: PinnedSpline(dim, 2),
    "spline_3": lambda dim: PinnedSpline(dim, 3),
    "spline_8": lambda dim: PinnedSpline(dim, 8),
}
EVEN = torch.linspace(0, 1, 25, dtype=torch.float64)
# Clear of every family's breaks, where a finite difference of the velocity would see the third
# derivative jump.
INNER = (torch.arange(1, 8, dtype=torch.float64) * (5**0.5 - 1) / 2) % 1
STEP = 1e-5

every_family = pytest.mark.parametrize("name", FAMILIES)
every_dim = pytest.mark.parametrize("dim", [1, 2, 6])
every_batch = pytest.mark.parametrize("batch", [(), (3,), (2, 4)], ids=str)


def law(test: Callable[..., None]) -> Callable[..., None]:
    """Cases are drawn, yet the same on every run, so that a red run can be repeated."""
    return settings(max_examples=4)(given(st.data())(test))


def tensors(shape: tuple[int, ...], size: float = 1.0) -> st.SearchStrategy[Tensor]:
    return arrays(np.float64, shape, elements=st.floats(-size, size, width=32)).map(
        torch.from_numpy
    )


def draw_curves(
    data: st.DataObject, curve: CurveFamily, batch: tuple[int, ...], size: float = 1.0
) -> tuple[Tensor, Tensor, Tensor]:
    phi = data.draw(tensors((*batch, curve.coefficients), size))
    start, goal = (data.draw(tensors((*batch, curve.dim), 10.0)) for _ in range(2))
    return phi, start, goal


@every_family
@every_dim
@every_batch
@law
def test_ends_are_exact_to_the_bit(name, dim, batch, data):
    curve = FAMILIES[name](dim)
    phi, start, goal = draw_curves(data, curve, batch, 1e3)
    for t in (EVEN, EVEN.expand(*batch, len(EVEN))):
        points, velocities = curve.evaluate(phi, start, goal, t)
        assert points.shape == velocities.shape == (*batch, len(EVEN), dim)
        assert torch.equal(points[..., 0, :], start)
        assert torch.equal(points[..., -1, :], goal)


@every_family
@every_dim
@every_batch
@law
def test_no_coefficients_or_zero_ones_give_the_straight_line(name, dim, batch, data):
    curve = FAMILIES[name](dim)
    phi, start, goal = draw_curves(data, curve, batch)
    points, velocities = curve.evaluate(torch.zeros_like(phi), start, goal, EVEN)
    line = start[..., None, :] + EVEN[:, None] * (goal - start)[..., None, :]
    torch.testing.assert_close(points, line, rtol=0, atol=1e-14)
    assert torch.equal(velocities, (goal - start)[..., None, :].expand_as(velocities))
    assert torch.equal(
        curve.acceleration(torch.zeros_like(phi), start, goal, EVEN), torch.zeros_like(points)
    )


@every_family
@every_dim
@every_batch
@law
def test_velocity_and_acceleration_agree_with_finite_differences(name, dim, batch, data):
    curve = FAMILIES[name](dim)
    phi, start, goal = draw_curves(data, curve, batch)
    (ahead, faster), (behind, slower) = (
        curve.evaluate(phi, start, goal, INNER + sign * STEP) for sign in (1, -1)
    )
    _, velocities = curve.evaluate(phi, start, goal, INNER)
    torch.testing.assert_close(velocities, (ahead - behind) / (2 * STEP), rtol=1e-6, atol=1e-6)
    acceleration = curve.acceleration(phi, start, goal, INNER)
    assert acceleration.shape == (*batch, len(INNER), dim)
    torch.testing.assert_close(acceleration, (faster - slower) / (2 * STEP), rtol=1e-6, atol=2e-5)


@every_family
@every_dim
@every_batch
@law
def test_rows_of_times_are_times_of_each_curve_alone(name, dim, batch, data):
    curve = FAMILIES[name](dim)
    phi, start, goal = draw_curves(data, curve, batch)
    rows = (data.draw(tensors((*batch, 5))) + 1) / 2
    points, velocities = curve.evaluate(phi, start, goal, rows)
    acceleration = curve.acceleration(phi, start, goal, rows)
    for index in np.ndindex(*batch):
        one = (phi[index], start[index], goal[index], rows[index])
        alone = (*curve.evaluate(*one), curve.acceleration(*one))
        for found, expected in zip((points, velocities, acceleration), alone, strict=True):
            torch.testing.assert_close(found[index], expected, rtol=0, atol=1e-12)


@every_family
@every_dim
@every_batch
@law
def test_fit_gives_back_the_coefficients_of_a_member(name, dim, batch, data):
    curve = FAMILIES[name](dim)
    phi, start, goal = draw_curves(data, curve, batch)
    points, _ = curve.evaluate(phi, start, goal, EVEN)
    found = curve.fit(points, EVEN)
    assert found.shape == phi.shape
    torch.testing.assert_close(found, phi, rtol=0, atol=1e-12)


@every_family
@every_dim
@law
def test_what_fit_leaves_over_is_orthogonal_to_the_basis(name, dim, data):
    curve, t = FAMILIES[name](dim), EVEN**2
    points = data.draw(tensors((3, len(t), dim)))
    phi = curve.fit(points, t)
    fitted, _ = curve.evaluate(phi, points[..., 0, :], points[..., -1, :], t)
    left = curve.basis(t).mT @ (points - fitted)
    torch.testing.assert_close(left, torch.zeros_like(left), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("part", "whole"),
    [(f"poly_{degree}", f"spline_{segments}") for degree in (1, 2, 3) for segments in (1, 2, 3, 8)]
    + [
        ("spline_1", "poly_3"),
        ("spline_1", "spline_3"),
        ("spline_2", "spline_4"),
        ("spline_4", "spline_8"),
    ]
    + [("spline_3", "spline_6"), ("spline_2", "spline_6"), ("poly_3", "poly_8")],
)
@every_dim
@law
def test_one_family_holds_another(part, whole, dim, data):
    """Splines hold all polynomials up to the cubics, and the splines whose knots are among
    theirs.
    """
    smaller, larger = _family(part, dim), _family(whole, dim)
    phi, start, goal = draw_curves(data, smaller, (3,))
    same = larger.fit(smaller.evaluate(phi, start, goal, EVEN)[0], EVEN)
    t = (INNER + 0.01) % 1
    for found, expected in zip(
        larger.evaluate(same, start, goal, t), smaller.evaluate(phi, start, goal, t), strict=True
    ):
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-10)
    torch.testing.assert_close(
        larger.acceleration(same, start, goal, t),
        smaller.acceleration(phi, start, goal, t),
        rtol=0,
        atol=1e-8,
    )


def _family(name: str, dim: int) -> CurveFamily:
    kind, size = name.split("_")
    return {"poly": PinnedPolynomial, "spline": PinnedSpline}[kind](dim, int(size))
