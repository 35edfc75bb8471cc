import math
from dataclasses import dataclass

import pytest
import torch

from constraint_geodesics.geometry.analytic import Plane, Sphere, Torus
from constraint_geodesics.geometry.curves import CurveError, Curves, PinnedPolynomial, PinnedSpline
from constraint_geodesics.geometry.grid import GridManifold
from constraint_geodesics.geometry.length import (
    Collocation,
    Quadrature,
    chord_length,
    curve_energy,
    curve_length,
    estimate_length,
)
from constraint_geodesics.geometry.manifold import GeometryError, NonFiniteError

RULE = Quadrature.gauss_legendre(16)
CUBIC = PinnedPolynomial(2, 3)


def point(*coordinates: float) -> torch.Tensor:
    return torch.tensor(coordinates, dtype=torch.float64)


STRAIGHT = point(0, 0, 0, 0)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_gauss_legendre_is_exact_for_polynomials(count):
    rule = Quadrature.gauss_legendre(count)
    for power in range(2 * count):
        assert ((rule.nodes**power) @ rule.weights).item() == pytest.approx(
            1 / (power + 1), rel=1e-13
        )
    assert ((rule.nodes ** (2 * count)) @ rule.weights).item() != pytest.approx(
        1 / (2 * count + 1), rel=1e-13
    )


@pytest.mark.parametrize(
    ("manifold", "start", "goal", "length"),
    [
        (Plane(2), (1, 1), (4, 5), 5.0),
        (Sphere(2.0), (0, -1), (0, 1.5), 5.0),  # a quarter turn and more along the equator
        (Sphere(2.0), (-1.2, 0.3), (1.3, 0.3), 5.0),  # along a meridian
        (Sphere(2.0), (1, 0), (1, 1), 2 * math.cos(1)),  # along a parallel, which is no geodesic
        (Torus(2.0, 1.0), (0, 0), (1, 0), 3.0),  # along the outer equator
        (Torus(2.0, 1.0), (0, math.pi), (1, math.pi), 1.0),  # along the inner one
        (Torus(2.0, 1.0), (0.3, -1), (0.3, 1.5), 2.5),  # around the tube
    ],
)
def test_known_lengths(manifold, start, goal, length):
    found = curve_length(manifold, Curves(CUBIC, STRAIGHT, point(*start), point(*goal)), RULE)
    assert found.item() == pytest.approx(length, rel=1e-14)
    energy = curve_energy(manifold, Curves(CUBIC, STRAIGHT, point(*start), point(*goal)), RULE)
    assert energy.item() == pytest.approx(length**2, rel=1e-13)  # these run at constant speed
    if hasattr(manifold, "distance") and length != 2 * math.cos(1):
        assert manifold.distance(point(*start), point(*goal)).item() == pytest.approx(
            length, rel=1e-15
        )


def test_length_of_a_parabola():
    # y = 4x(1 − x) for 0 ≤ x ≤ 1: L = √17/2 + asinh(4)/8
    length = curve_length(
        Plane(2),
        Curves(PinnedPolynomial(2, 2), point(0, 4), point(0, 0), point(1, 0)),
        Quadrature.gauss_legendre(40),
    )
    assert length.item() == pytest.approx(math.sqrt(17) / 2 + math.asinh(4) / 8, rel=1e-10)


@pytest.mark.parametrize("count", [4, 8, 16, 32, 64, 128])
def test_error_where_a_curve_turns_back_falls_like_the_square_of_the_nodes(count):
    # x = 0.6t + 2t(1 − t) rises to 0.845 and comes back to 0.6.
    length = curve_length(
        Plane(1),
        Curves(PinnedPolynomial(1, 2), point(2), point(0), point(0.6)),
        Quadrature.gauss_legendre(count),
    )
    assert abs(length.item() - (2 * 0.845 - 0.6)) < 2 / count**2


def test_a_curve_that_stays_where_it_is_has_no_length_and_no_nan_gradient():
    phi = STRAIGHT.clone().requires_grad_()
    for measure in (curve_length, curve_energy):
        value = measure(Sphere(), Curves(CUBIC, phi, point(0.1, 0.2), point(0.1, 0.2)), RULE)
        (gradient,) = torch.autograd.grad(value, phi)
        assert value.item() == 0.0
        assert torch.equal(gradient, torch.zeros_like(phi))


def test_lengths_of_a_batch_are_those_of_its_members():
    generator = torch.Generator().manual_seed(0)
    phi = torch.randn(3, 4, generator=generator, dtype=torch.float64)
    goals = torch.rand(3, 2, generator=generator, dtype=torch.float64)
    batch = curve_length(Sphere(), Curves(CUBIC, phi, point(0, 0), goals), RULE)
    single = [
        curve_length(Sphere(), Curves(CUBIC, p, point(0, 0), g), RULE)
        for p, g in zip(phi, goals, strict=True)
    ]
    torch.testing.assert_close(batch, torch.stack(single), rtol=1e-14, atol=0)


def test_single_precision_curves_are_measured_in_single_precision():
    ends = torch.tensor([[0.0, 0.0], [0.0, 1.0]])
    length = curve_length(Sphere(), Curves(CUBIC, torch.zeros(4), *ends), RULE)
    assert length.dtype == torch.float32
    assert length.item() == pytest.approx(1.0, rel=1e-6)


def test_lengths_can_be_measured_without_a_graph():
    phi = STRAIGHT.clone().requires_grad_()
    with torch.no_grad():
        length = curve_length(Sphere(), Curves(CUBIC, phi, point(0, 0), point(0, 1)), RULE)
    assert not length.requires_grad
    assert length.item() == pytest.approx(1.0, rel=1e-14)


def test_gradient_descent_on_the_length_finds_the_great_circle():
    # A parallel at 1 rad is 1.7 times as long as it need be; a polynomial of degree 5 reaches the
    # arc within 1e-3.
    curve, start, goal = PinnedPolynomial(2, 5), point(1.0, 0.0), point(1.0, 2.0)
    phi = torch.zeros(curve.coefficients, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS([phi], max_iter=60, line_search_fn="strong_wolfe")

    def energy() -> torch.Tensor:
        optimiser.zero_grad()
        value = curve_energy(Sphere(), Curves(curve, phi, start, goal), RULE)
        value.backward()
        return value

    optimiser.step(energy)
    exact = Sphere().distance(start, goal).item()
    assert curve_length(
        Sphere(), Curves(curve, phi.detach(), start, goal), RULE
    ).item() == pytest.approx(exact, rel=1e-3)


def test_chord_length():
    square = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]])
    assert chord_length(square).item() == 4.0
    torch.testing.assert_close(
        chord_length(torch.stack([square, 2 * square])), torch.tensor([4.0, 8.0])
    )
    with pytest.raises(GeometryError, match=r"points has shape \(1, 2\)"):
        chord_length(square[:1])
    with pytest.raises(NonFiniteError, match=r"points\[0, 1\] = inf"):
        chord_length(torch.tensor([[0.0, math.inf], [0.0, 0.0]]))


@pytest.mark.parametrize("measure", [curve_length, curve_energy])
def test_bad_input_is_refused_by_name(measure):
    good, phi = point(0.1, 0.1), torch.zeros(2, 4)
    phi[1, 2] = math.nan
    with pytest.raises(NonFiniteError, match=r"phi\[1, 2\] = nan"):
        measure(Sphere(), Curves(CUBIC, phi, good, good), RULE)
    with pytest.raises(NonFiniteError, match=r"goal\[1\] = -inf"):
        measure(Sphere(), Curves(CUBIC, STRAIGHT, good, point(0, -math.inf)), RULE)
    with pytest.raises(GeometryError, match="the curve has dim 3: must be that of the manifold, 2"):
        measure(
            Sphere(),
            Curves(PinnedPolynomial(3, 3), torch.zeros(6), torch.zeros(3), torch.zeros(3)),
            RULE,
        )
    with pytest.raises(CurveError, match=r"phi has shape \(3,\)"):
        measure(Sphere(), Curves(CUBIC, torch.zeros(3), good, good), RULE)
    with pytest.raises(GeometryError, match="count = 0"):
        Quadrature.gauss_legendre(0)


@pytest.mark.parametrize("breaks", [(0.0, 1.0), (0.0, 0.3, 1.0)])
@pytest.mark.parametrize("degree", [2, 5, 8])
def test_collocation_differentiates_and_integrates_polynomials_exactly(degree, breaks):
    rule = Collocation.chebyshev(degree, breaks)
    assert rule.times[0].item() == 0.0
    assert rule.times[-1].item() == 1.0
    assert len(rule.times) == degree * (len(breaks) - 1) + 1
    for power in range(1, degree + 1):
        slopes = rule.slopes((rule.times**power)[:, None])[:, 0]
        assert (slopes @ rule.weights).item() == pytest.approx(1.0, rel=1e-12)
        assert ((slopes**2) @ rule.weights).item() == pytest.approx(
            power**2 / (2 * power - 1), rel=1e-11
        )
        assert ((rule.times**power) @ rule.own_weights).item() == pytest.approx(
            1 / (power + 1), rel=1e-12
        )


def test_the_rule_of_half_the_degree_stands_on_every_other_point():
    rule = Collocation.chebyshev(16, (0.0, 0.5, 1.0))
    torch.testing.assert_close(rule.half.times, rule.times[::2], rtol=0, atol=1e-15)
    assert Collocation.chebyshev(3).half is None


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-6])
def test_default_lengths_are_within_their_tolerance(tolerance):
    generator = torch.Generator().manual_seed(1)
    draw = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    exact = Quadrature.gauss_legendre(200, (0.0, 0.25, 0.5, 0.75, 1.0))
    for manifold in (Sphere(), Torus(), Plane(2)):
        for curve in (PinnedPolynomial(2, 7), PinnedSpline(2, 4)):
            phi, start, goal = draw(400, curve.coefficients), draw(400, 2), draw(400, 2)
            reference = curve_length(manifold, Curves(curve, phi, start, goal), exact)
            found = estimate_length(manifold, Curves(curve, phi, start, goal), tolerance)
            error = (found.length - reference).abs() / reference
            resolved = found.error <= tolerance * found.length
            assert tolerance < 1e-3 or resolved.double().mean() > 0.95
            # these are wild curves, a third of which turn back: there the estimate is no bound
            assert (error[resolved] > tolerance).double().mean() <= 0.02
            assert error[resolved].max() <= 20 * tolerance
            assert (error <= found.error / reference + 1e-9).double().mean() > 0.9


def test_default_lengths_on_a_learned_manifold_are_within_a_thousandth(trained):
    z = torch.from_numpy(trained.manifold.encode(trained.joints))
    generator = torch.Generator().manual_seed(3)
    rows = torch.randint(len(z), (2, 200), generator=generator)
    start, goal = z[rows[0]], z[rows[1]]
    for curve in (PinnedPolynomial(6, 3), PinnedSpline(6, 2)):
        bend = torch.randn(200, curve.coefficients, generator=generator, dtype=torch.float64)
        phi = 0.5 * bend * (goal - start).norm(dim=-1, keepdim=True)
        t = torch.linspace(0, 1, 2000, dtype=torch.float64)
        exact = trained.manifold.double()
        with torch.no_grad():
            points, _ = curve.evaluate(phi, start, goal, t)
            reference = torch.stack([chord_length(exact.embed(one)) for one in points])
            length = curve_length(trained.manifold, Curves(curve, phi, start, goal))
        error = ((length - reference).abs() / reference.clamp(min=1e-9)).max().item()
        assert error <= 1e-3, curve


def test_a_curve_that_no_rule_resolves_says_so():
    # it turns back sharply a dozen times, and 64 degrees are not enough for 1e-9
    curve = PinnedPolynomial(1, 14)
    phi = torch.zeros(13, dtype=torch.float64)
    phi[-1] = 50.0
    found = estimate_length(Plane(1), Curves(curve, phi, point(0), point(0.1)), tolerance=1e-9)
    assert math.isfinite(found.length.item())
    assert found.error > 1e-9 * found.length


def test_lengths_on_a_grid_agree_with_those_of_the_manifold_it_samples():
    # the sphere in Mercator's chart is conformal: g = sech² of the latitude's coordinate
    @dataclass(frozen=True)
    class Mercator:
        dim: int = 2

        def metric(self, z):
            factor = torch.cosh(z[..., 0]) ** -2
            return factor[..., None, None] * torch.eye(2, dtype=z.dtype)

    grid = GridManifold.from_manifold(Mercator(), (-1.5, -1.5), (1.5, 1.5), (601, 601))
    generator = torch.Generator().manual_seed(2)
    phi = 0.3 * torch.randn(20, 4, generator=generator, dtype=torch.float64)
    smooth, sampled = (
        curve_length(manifold, Curves(CUBIC, phi, point(-0.9, -0.8), point(0.7, 0.9)))
        for manifold in (Mercator(), grid)
    )
    torch.testing.assert_close(sampled, smooth, rtol=1e-3, atol=0)


def test_energy_and_length_of_a_grid_have_derivatives():
    grid = GridManifold(torch.ones(5, 5, dtype=torch.float64), (-2.0, -2.0), (2.0, 2.0))
    phi = STRAIGHT.clone().requires_grad_()
    for measure in (curve_length, curve_energy):
        (gradient,) = torch.autograd.grad(
            measure(grid, Curves(CUBIC, phi, point(0.5, 0.5), point(0.5, 0.5))), phi
        )
        assert torch.equal(gradient, torch.zeros_like(phi)), "standing still: no NaN"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Collocation.chebyshev(1), "degree = 1: must be at least 2"),
        (lambda: Collocation.chebyshev(4, (0.0, 0.5)), "must rise from 0 to 1"),
        (lambda: Quadrature.gauss_legendre(4, (0.0, 0.7, 0.3, 1.0)), "must rise from 0 to 1"),
        (
            lambda: estimate_length(
                Plane(2), Curves(CUBIC, STRAIGHT, point(0, 0), point(1, 0)), 0.0
            ),
            "tolerance = 0.0",
        ),
    ],
)
def test_impossible_rules_are_refused(make, message):
    with pytest.raises(GeometryError, match=message):
        make()


def test_no_curves_have_no_lengths():
    empty = torch.zeros(0, 4, dtype=torch.float64)
    assert curve_length(Sphere(), Curves(CUBIC, empty, point(0, 0), point(0, 1))).shape == (0,)
