"""What every manifold, curve family and length must satisfy, over all members and batch shapes, in
float64.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch import Tensor

from constraint_geodesics.geometry.analytic import LevelSet, Plane, Sphere, Torus
from constraint_geodesics.geometry.curves import Curves, PinnedPolynomial
from constraint_geodesics.geometry.grid import GridManifold
from constraint_geodesics.geometry.length import (
    Quadrature,
    chord_length,
    curve_energy,
    curve_length,
)
from constraint_geodesics.geometry.manifold import (
    EmbeddedManifold,
    MeasuredManifold,
    pullback_metric,
)

BATCHES = ((), (3,), (2, 4))
RULE = Quadrature.gauss_legendre(64)


@dataclass(frozen=True)
class Graph:
    """A user's own manifold: the graph of a function over R³, its metric left to
    `pullback_metric`.
    """

    dim: int = 3
    ambient_dim: int = 4

    def embed(self, z: Tensor) -> Tensor:
        height = torch.sin(z[..., 0]) * z[..., 1] + 0.5 * z[..., 2] ** 2
        return torch.cat([z, height[..., None]], dim=-1)

    def metric(self, z: Tensor) -> Tensor:
        return pullback_metric(self.embed, z)


@dataclass(frozen=True)
class Member:
    """A manifold with the box of its chart, clear of the chart's singular points, that cases are
    drawn from.
    """

    manifold: EmbeddedManifold
    lower: tuple[float, ...]
    upper: tuple[float, ...]


MEMBERS = {
    "line": Member(Plane(1), (-3.0,), (3.0,)),
    "plane": Member(Plane(2), (-3.0, -3.0), (3.0, 3.0)),
    "space": Member(Plane(5), (-3.0,) * 5, (3.0,) * 5),
    "sphere": Member(Sphere(), (-1.4, -math.pi), (1.4, math.pi)),
    "large_sphere": Member(Sphere(7.0), (-1.4, -math.pi), (1.4, math.pi)),
    "torus": Member(Torus(2.0, 1.0), (-math.pi, -math.pi), (math.pi, math.pi)),
    "thin_torus": Member(Torus(3.0, 0.2), (-math.pi, -math.pi), (math.pi, math.pi)),
    "parallel": Member(LevelSet(Sphere(), 0, (0.7,)).components()[0], (-math.pi,), (math.pi,)),
    "meridian_of_torus": Member(
        LevelSet(Torus(), 0, (0.4,)).components()[0], (-math.pi,), (math.pi,)
    ),
    "user": Member(Graph(), (-2.0, -2.0, -2.0), (2.0, 2.0, 2.0)),
}
DISTANCES = [name for name in MEMBERS if isinstance(MEMBERS[name].manifold, MeasuredManifold)]

every_member = pytest.mark.parametrize("name", MEMBERS)
every_distance = pytest.mark.parametrize("name", DISTANCES)
every_batch = pytest.mark.parametrize("batch", BATCHES, ids=str)


def law(test: Callable[..., None]) -> Callable[..., None]:
    """Cases are drawn, yet the same on every run, so that a red run can be repeated."""
    return settings(max_examples=8)(given(st.data())(test))


def tensors(
    shape: tuple[int, ...], low: float = -1.0, high: float = 1.0
) -> st.SearchStrategy[Tensor]:
    return arrays(np.float64, shape, elements=st.floats(low, high, width=32)).map(torch.from_numpy)


def draw_points(data: st.DataObject, member: Member, batch: tuple[int, ...]) -> Tensor:
    lower, upper = (
        torch.tensor(member.lower, dtype=torch.float64),
        torch.tensor(member.upper, dtype=torch.float64),
    )
    return lower + (upper - lower) * data.draw(tensors((*batch, len(lower)), low=0.0))


def draw_curve(
    data: st.DataObject, member: Member, batch: tuple[int, ...]
) -> tuple[PinnedPolynomial, Tensor, Tensor, Tensor]:
    """A curve whose first coordinate moves one way from the lower half of the box to the upper
    half.

    Its speed is nowhere zero, so the integrand is smooth and `RULE` exact; |ḃ_k| ≤ 1 keeps the
    bends below the line.
    """
    start, goal = draw_points(data, member, batch), draw_points(data, member, batch)
    lower, upper = member.lower[0], member.upper[0]
    start[..., 0] = (start[..., 0] - lower) * 0.4 + lower
    goal[..., 0] = (goal[..., 0] - upper) * 0.4 + upper
    curve = PinnedPolynomial(len(member.lower), data.draw(st.integers(1, 4)))
    largest = 0.3 * (goal - start)[..., 0].abs().min() / max(curve.degree - 1, 1)
    return curve, float(largest) * data.draw(tensors((*batch, curve.coefficients))), start, goal


# Manifolds


@every_member
@every_batch
@law
def test_embedding_and_metric_have_the_promised_shapes(name, batch, data):
    manifold = MEMBERS[name].manifold
    z = draw_points(data, MEMBERS[name], batch)
    assert manifold.embed(z).shape == (*batch, manifold.ambient_dim)
    assert manifold.metric(z).shape == (*batch, manifold.dim, manifold.dim)
    assert manifold.metric(z).dtype == torch.float64


@every_member
@every_batch
@law
def test_metric_is_the_pullback_of_the_embedding(name, batch, data):
    manifold = MEMBERS[name].manifold
    z = draw_points(data, MEMBERS[name], batch)
    torch.testing.assert_close(
        manifold.metric(z), pullback_metric(manifold.embed, z), rtol=1e-12, atol=1e-12
    )


@every_member
@every_batch
@law
def test_metric_agrees_with_finite_differences_of_the_embedding(name, batch, data):
    manifold, step = MEMBERS[name].manifold, 1e-5
    z = draw_points(data, MEMBERS[name], batch)
    shifts = step * torch.eye(manifold.dim, dtype=torch.float64)
    columns = (
        manifold.embed(z[..., None, :] + shifts) - manifold.embed(z[..., None, :] - shifts)
    ) / (2 * step)
    torch.testing.assert_close(manifold.metric(z), columns @ columns.mT, rtol=1e-7, atol=1e-7)


@every_member
@every_batch
@law
def test_metric_is_symmetric_and_positive(name, batch, data):
    metric = MEMBERS[name].manifold.metric(draw_points(data, MEMBERS[name], batch))
    torch.testing.assert_close(metric, metric.mT, rtol=1e-14, atol=0)
    assert (torch.linalg.eigvalsh(metric) > 1e-3).all()


@every_batch
@law
def test_metric_of_any_grid_is_symmetric_and_positive(batch, data):
    values = torch.exp(data.draw(tensors((4, 5), -5.0, 5.0)))
    blocked = data.draw(arrays(np.bool_, (4, 5))) & ~np.eye(4, 5, dtype=bool)
    grid = GridManifold(values, (-1.0, 0.0), (2.0, 1.0), torch.from_numpy(blocked))
    metric = grid.metric(data.draw(tensors((*batch, 2), -3.0, 3.0)))
    assert metric.shape == (*batch, 2, 2)
    assert torch.equal(metric, metric.mT)
    assert (torch.linalg.eigvalsh(metric) > 1e-3).all()
    assert torch.isfinite(metric).all()


@every_distance
@every_batch
@law
def test_distance_is_a_metric(name, batch, data):
    manifold = MEMBERS[name].manifold
    a, b, c = (draw_points(data, MEMBERS[name], batch) for _ in range(3))
    ab, bc, ac = manifold.distance(a, b), manifold.distance(b, c), manifold.distance(a, c)
    assert ab.shape == batch
    assert torch.equal(ab, manifold.distance(b, a))
    assert torch.equal(manifold.distance(a, a), torch.zeros(batch, dtype=torch.float64))
    assert (ac <= ab + bc + 1e-12).all()


@every_distance
@every_batch
@law
def test_distance_of_near_points_is_that_of_the_metric(name, batch, data):
    manifold = MEMBERS[name].manifold
    z, direction = (
        draw_points(data, MEMBERS[name], batch),
        data.draw(tensors((*batch, MEMBERS[name].manifold.dim))),
    )
    direction[..., 0] += 2.0
    step = (z + 1e-6 * direction) - z
    expected = torch.einsum("...i,...ij,...j->...", step, manifold.metric(z), step).sqrt()
    torch.testing.assert_close(manifold.distance(z, z + step), expected, rtol=2e-5, atol=0)


# Curves


@pytest.mark.parametrize("dim", [1, 2, 6])
@every_batch
@law
def test_curve_ends_are_exact_to_the_bit(dim, batch, data):
    curve = PinnedPolynomial(dim, data.draw(st.integers(1, 8)))
    phi = data.draw(tensors((*batch, curve.coefficients), -1e3, 1e3))
    start, goal = (data.draw(tensors((*batch, dim), -10.0, 10.0)) for _ in range(2))
    points, velocities = curve.evaluate(
        phi, start, goal, torch.linspace(0, 1, 5, dtype=torch.float64)
    )
    assert points.shape == velocities.shape == (*batch, 5, dim)
    assert torch.equal(points[..., 0, :], start)
    assert torch.equal(points[..., -1, :], goal)


@pytest.mark.parametrize("dim", [1, 2, 6])
@every_batch
@law
def test_curve_velocity_is_the_derivative_of_its_points(dim, batch, data):
    curve = PinnedPolynomial(dim, data.draw(st.integers(1, 8)))
    phi, start, goal = (
        data.draw(tensors((*batch, size))) for size in (curve.coefficients, dim, dim)
    )
    t, step = torch.linspace(0.1, 0.9, 7, dtype=torch.float64), 1e-5
    (ahead, _), (behind, _) = (
        curve.evaluate(phi, start, goal, t + sign * step) for sign in (1, -1)
    )
    _, velocities = curve.evaluate(phi, start, goal, t)
    torch.testing.assert_close(velocities, (ahead - behind) / (2 * step), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("dim", [1, 2, 6])
@every_batch
@law
def test_curve_is_the_polynomial_of_equation_9(dim, batch, data):
    curve = PinnedPolynomial(dim, data.draw(st.integers(1, 8)))
    phi, start, goal = (
        data.draw(tensors((*batch, size))) for size in (curve.coefficients, dim, dim)
    )
    monomial = curve.to_monomial(phi, start, goal)
    assert monomial.shape == (*batch, dim, curve.degree + 1)
    assert torch.equal(monomial[..., 0], start)
    torch.testing.assert_close(monomial[..., 1:].sum(-1), goal - start, rtol=0, atol=1e-10)
    t = torch.linspace(0, 1, 9, dtype=torch.float64)
    points, velocities = curve.evaluate(phi, start, goal, t)
    powers = torch.arange(curve.degree + 1)
    torch.testing.assert_close(
        points, (monomial @ (t[:, None] ** powers).mT).mT, rtol=0, atol=1e-10
    )
    slopes = powers[1:] * t[:, None] ** (powers[1:] - 1)
    torch.testing.assert_close(velocities, (monomial[..., 1:] @ slopes.mT).mT, rtol=0, atol=1e-9)


# Lengths


@dataclass(frozen=True)
class Reparametrised:
    """The same curves run through at another pace: γ(s(t)) with s(t) = t (1 + t) / 2."""

    curve: PinnedPolynomial

    @property
    def dim(self) -> int:
        return self.curve.dim

    @property
    def coefficients(self) -> int:
        return self.curve.coefficients

    def evaluate(
        self, phi: Tensor, start: Tensor, goal: Tensor, t: Tensor
    ) -> tuple[Tensor, Tensor]:
        points, velocities = self.curve.evaluate(phi, start, goal, t * (1 + t) / 2)
        return points, velocities * (0.5 + t)[:, None]


@every_member
@every_batch
@law
def test_length_is_that_of_the_metric(name, batch, data):
    manifold = MEMBERS[name].manifold
    curve, phi, start, goal = draw_curve(data, MEMBERS[name], batch)
    z, velocity = curve.evaluate(phi, start, goal, RULE.nodes)
    square = torch.einsum("...i,...ij,...j->...", velocity, manifold.metric(z), velocity)
    length = curve_length(manifold, Curves(curve, phi, start, goal), RULE)
    assert length.shape == batch
    torch.testing.assert_close(length, (square.sqrt() * RULE.weights).sum(-1), rtol=1e-12, atol=0)
    energy = curve_energy(manifold, Curves(curve, phi, start, goal), RULE)
    torch.testing.assert_close(energy, (square * RULE.weights).sum(-1), rtol=1e-12, atol=0)


@every_member
@every_batch
@law
def test_length_is_invariant_under_reparametrisation(name, batch, data):
    manifold = MEMBERS[name].manifold
    curve, phi, start, goal = draw_curve(data, MEMBERS[name], batch)
    length = curve_length(manifold, Curves(curve, phi, start, goal), RULE)
    slower = curve_length(manifold, Curves(Reparametrised(curve), phi, start, goal), RULE)
    torch.testing.assert_close(slower, length, rtol=1e-7, atol=0)
    signs = (-1.0) ** torch.arange(curve.degree - 1).repeat(curve.dim)
    backwards = curve_length(manifold, Curves(curve, signs * phi, goal, start), RULE)
    torch.testing.assert_close(backwards, length, rtol=1e-12, atol=0)


@every_distance
@every_batch
@law
def test_no_curve_is_shorter_than_the_distance(name, batch, data):
    manifold = MEMBERS[name].manifold
    curve, phi, start, goal = draw_curve(data, MEMBERS[name], batch)
    length = curve_length(manifold, Curves(curve, phi, start, goal), RULE)
    assert (length >= manifold.distance(start, goal) * (1 - 1e-9)).all()


@every_member
@every_batch
@law
def test_chords_are_never_longer_than_the_curve_and_approach_it(name, batch, data):
    manifold = MEMBERS[name].manifold
    curve, phi, start, goal = draw_curve(data, MEMBERS[name], batch)
    length = curve_length(manifold, Curves(curve, phi, start, goal), RULE)
    for chords, shortfall in ((8, None), (512, 1e-3)):
        t = torch.linspace(0, 1, chords + 1, dtype=torch.float64)
        chord = chord_length(manifold.embed(curve.evaluate(phi, start, goal, t)[0]))
        assert chord.shape == batch
        assert (chord <= length * (1 + 1e-7)).all()
        assert shortfall is None or (chord >= length * (1 - shortfall)).all()


@every_member
@every_batch
@law
def test_energy_is_at_least_the_square_of_the_length(name, batch, data):
    manifold = MEMBERS[name].manifold
    start, goal = draw_points(data, MEMBERS[name], batch), draw_points(data, MEMBERS[name], batch)
    curve = PinnedPolynomial(manifold.dim, 4)
    phi = data.draw(tensors((*batch, curve.coefficients), -5.0, 5.0))
    length = curve_length(manifold, Curves(curve, phi, start, goal), RULE)
    assert (
        curve_energy(manifold, Curves(curve, phi, start, goal), RULE) >= length**2 * (1 - 1e-12)
    ).all()


@every_member
@every_batch
@law
def test_gradients_of_length_and_energy_agree_with_finite_differences(name, batch, data):
    manifold, step = MEMBERS[name].manifold, 1e-6
    start, goal = torch.full((2, *batch, manifold.dim), -0.5, dtype=torch.float64)
    goal = goal + 1.0
    curve = PinnedPolynomial(manifold.dim, 3)
    phi, direction = (0.3 * data.draw(tensors((*batch, curve.coefficients))) for _ in range(2))
    rule = Quadrature.gauss_legendre(8)
    for measure in (curve_length, curve_energy):
        moving = phi.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(
            measure(manifold, Curves(curve, moving, start, goal), rule).sum(), moving
        )
        ahead, behind = (
            measure(manifold, Curves(curve, phi + s * step * direction, start, goal), rule)
            for s in (1, -1)
        )
        slope = ((ahead - behind) / (2 * step)).sum()
        torch.testing.assert_close((gradient * direction).sum(), slope, rtol=1e-6, atol=1e-7)
