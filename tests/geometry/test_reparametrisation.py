import math
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from constraint_geodesics.geometry.analytic import Plane, Sphere, Torus
from constraint_geodesics.geometry.curves import (
    CurveError,
    CurveFamily,
    Curves,
    PinnedPolynomial,
    PinnedSpline,
)
from constraint_geodesics.geometry.length import (
    CROWD,
    NODES,
    SPACING_TOLERANCE,
    Quadrature,
    constant_speed,
    curve_speeds,
)
from constraint_geodesics.geometry.manifold import (
    EmbeddedManifold,
    GeometryError,
    Manifold,
    NonFiniteError,
)

CUBIC = PinnedPolynomial(2, 3)
FAMILIES = [CUBIC, PinnedPolynomial(2, 6), PinnedSpline(2, 2), PinnedSpline(2, 5)]
STRAIGHT = torch.zeros(4, dtype=torch.float64)


@dataclass(frozen=True)
class HalfPlane:
    """The hyperbolic plane in Poincaré's chart y > 0, M = I / y²: a metric and nothing else."""

    dim: int = 2

    def metric(self, z: Tensor) -> Tensor:
        return torch.eye(2, dtype=z.dtype) / z[..., 1, None, None].square()


@dataclass(frozen=True)
class MetricOnly:
    """A manifold whose embedding is not known."""

    manifold: Manifold

    @property
    def dim(self) -> int:
        return self.manifold.dim

    def metric(self, z: Tensor) -> Tensor:
        return self.manifold.metric(z)


class Counted(Plane):
    """The plane, which counts the points that it embeds."""

    points = 0

    def embed(self, z: Tensor) -> Tensor:
        type(self).points += z[..., 0].numel()
        return super().embed(z)


def point(*coordinates: float) -> Tensor:
    return torch.tensor(coordinates, dtype=torch.float64)


def random_curves(
    curve: CurveFamily, count: int, size: float, seed: int = 0
) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    numbers = (curve.coefficients, curve.dim, curve.dim)
    phi, start, goal = (
        torch.randn(count, n, generator=generator, dtype=torch.float64) for n in numbers
    )
    return size * phi, 0.3 * start, 0.3 * goal


def spacings(
    manifold: Manifold, curve: CurveFamily, phi: Tensor, start: Tensor, goal: Tensor, times: Tensor
) -> Tensor:
    """Lengths between neighbouring times by 16 nodes on each of 1000 parts and more, ended at every
    break.
    """
    rule, parts = Quadrature.gauss_legendre(16), math.ceil(1000 / (times.shape[-1] - 1))
    share = torch.linspace(0, 1, parts + 1, dtype=times.dtype)[:-1]
    edges = times[..., :-1, None] + times.diff(dim=-1)[..., None] * share
    edges = torch.cat([edges.flatten(-2), times[..., -1:]], dim=-1)
    total = torch.zeros_like(times[..., 1:])
    for low, high in zip(curve.breaks[:-1], curve.breaks[1:], strict=True):
        ends = edges.clamp(low, high)
        width = ends.diff(dim=-1)[..., None]
        nodes = ends[..., :-1, None] + width * rule.nodes
        speeds = curve_speeds(manifold, Curves(curve, phi, start, goal), nodes.flatten(-2)).reshape(
            nodes.shape
        )
        total += (width * speeds @ rule.weights[:, None])[..., 0].unflatten(-1, (-1, parts)).sum(-1)
    return total


# Exact answers


def test_arc_length_of_a_parabola():
    # y = 4x(1 − x): with w = 4(2x − 1) the length from the vertex is (w √(1 + w²) + asinh w) / 16
    times = constant_speed(
        Plane(2), Curves(PinnedPolynomial(2, 2), point(0, 4), point(0, 0), point(1, 0)), 41
    )
    w = 4 * (2 * times - 1)
    passed = (w * (1 + w**2).sqrt() + torch.asinh(w)) / 16
    mean = (math.sqrt(17) / 2 + math.asinh(4) / 8) / 40
    assert (times[0], times[-1]) == (0.0, 1.0)
    torch.testing.assert_close(
        passed.diff(), torch.full((40,), mean, dtype=torch.float64), rtol=1e-8, atol=0
    )


def test_a_great_circle_run_through_at_an_uneven_pace():
    # azimuth = 2.5t − t² along the equator: equal shares of 1.5 are reached at t = (2.5 − √(6.25 −
    # 4 azimuth)) / 2
    times = constant_speed(
        Sphere(3.0), Curves(PinnedPolynomial(2, 2), point(0, 1), point(0, 0), point(0, 1.5)), 31
    )
    azimuth = torch.linspace(0, 1.5, 31, dtype=torch.float64)
    torch.testing.assert_close(times, (2.5 - (6.25 - 4 * azimuth).sqrt()) / 2, rtol=0, atol=1e-12)


def test_a_manifold_with_a_metric_only():
    # straight up from y = 1 to y = e the hyperbolic length is ln y
    times = constant_speed(
        HalfPlane(), Curves(CUBIC, STRAIGHT, point(0.3, 1), point(0.3, math.e)), 21
    )
    share = torch.linspace(0, 1, 21, dtype=torch.float64)
    torch.testing.assert_close(times, (share.exp() - 1) / (math.e - 1), rtol=0, atol=1e-10)


def test_a_curve_that_turns_back():
    # x = 0.6t + 2t(1 − t) rises to 0.845 at t = 0.65 and comes back to 0.6
    curve, ends = PinnedPolynomial(1, 2), (point(2), point(0), point(0.6))
    times = constant_speed(Plane(1), Curves(curve, *ends), 101)
    x = curve.evaluate(*ends, times)[0][:, 0]
    passed = torch.where(times < 0.65, x, 2 * 0.845 - x)
    torch.testing.assert_close(
        passed.diff(), torch.full((100,), 0.0109, dtype=torch.float64), rtol=1e-6, atol=0
    )


def test_a_curve_that_already_runs_at_constant_speed_keeps_its_times():
    times = constant_speed(Sphere(), Curves(CUBIC, STRAIGHT, point(0, -1), point(0, 1.5)), 11)
    torch.testing.assert_close(
        times, torch.linspace(0, 1, 11, dtype=torch.float64), rtol=0, atol=1e-15
    )


# What holds for all


@pytest.mark.parametrize("manifold", [Plane(2), Sphere(), Torus()], ids=str)
@pytest.mark.parametrize("curve", FAMILIES, ids=str)
@pytest.mark.parametrize("count", [2, 12, 100])
def test_spacings_are_equal_within_the_tolerance(manifold, curve, count):
    case = random_curves(curve, 5, 0.1)
    times = constant_speed(manifold, Curves(curve, *case), count)
    assert times.shape == (5, count)
    assert torch.equal(times[:, [0, -1]], point(0, 1).expand(5, 2))
    assert (times.diff() > 0).all()
    found = spacings(manifold, curve, *case, times)
    torch.testing.assert_close(
        found, found.mean(-1, keepdim=True).expand_as(found), rtol=SPACING_TOLERANCE, atol=0
    )


@pytest.mark.parametrize("curve", FAMILIES, ids=str)
def test_so_they_are_on_curves_with_near_cusps(curve):
    case = random_curves(curve, 8, 3.0, seed=1)
    speeds = curve_speeds(
        Torus(), Curves(curve, *case), torch.linspace(0, 1, 1000, dtype=torch.float64)
    )
    assert (speeds.amin(-1) / speeds.mean(-1)).min() < 0.1
    times = constant_speed(Torus(), Curves(curve, *case), 16)
    found = spacings(Torus(), curve, *case, times)
    torch.testing.assert_close(
        found, found.mean(-1, keepdim=True).expand_as(found), rtol=SPACING_TOLERANCE, atol=0
    )


def test_a_tighter_tolerance_is_kept_and_takes_more_points():
    case, needed = random_curves(CUBIC, 20, 1.0), []
    for tolerance in (1e-2, 1e-9):
        Counted.points = 0
        times = constant_speed(Counted(2), Curves(CUBIC, *case), 24, tolerance)
        needed.append(Counted.points)
        found = spacings(Plane(2), CUBIC, *case, times)
        torch.testing.assert_close(
            found, found.mean(-1, keepdim=True).expand_as(found), rtol=tolerance, atol=0
        )
    assert 20 * NODES <= needed[0] < needed[1]


@pytest.mark.parametrize("curve", FAMILIES, ids=str)
def test_embedding_and_metric_give_the_same_times(curve):
    case = random_curves(curve, 4, 0.3)
    assert not isinstance(MetricOnly(Torus()), EmbeddedManifold)
    found = constant_speed(MetricOnly(Torus()), Curves(curve, *case), 9)
    torch.testing.assert_close(
        found, constant_speed(Torus(), Curves(curve, *case), 9), rtol=0, atol=1e-8
    )


def test_times_do_not_depend_on_the_direction():
    phi, start, goal = random_curves(CUBIC, 10, 1.0)
    there, back = (phi, start, goal), (phi * point(1, -1, 1, -1), goal, start)
    points = [
        CUBIC.evaluate(*case, constant_speed(Torus(), Curves(CUBIC, *case), 15))[0]
        for case in (there, back)
    ]
    torch.testing.assert_close(points[0], points[1].flip(-2), rtol=0, atol=1e-6)


def test_batches_broadcast_and_are_their_members():
    phi, start, _ = random_curves(CUBIC, 6, 1.0)
    phi, start = phi.reshape(3, 2, 1, 4), start[:5]
    times = constant_speed(Sphere(), Curves(CUBIC, phi, start, point(0.2, 0.1)), 8)
    assert times.shape == (3, 2, 5, 8)
    for index in ((0, 0, 0), (2, 1, 4), (1, 0, 3)):
        one = constant_speed(
            Sphere(), Curves(CUBIC, phi[index[:2]][0], start[index[2]], point(0.2, 0.1)), 8
        )
        assert one.shape == (8,)
        torch.testing.assert_close(times[index], one, rtol=0, atol=1e-12)
    assert constant_speed(Sphere(), Curves(CUBIC, phi[:0], start, start), 8).shape == (0, 2, 5, 8)


# What has no length, no precision or no meaning


def test_a_curve_of_no_length_gets_even_times_beside_others():
    start, goal = point(0.1, 0.2), torch.stack([point(0.1, 0.2), point(0.4, 1.2)])
    times = constant_speed(Sphere(), Curves(CUBIC, STRAIGHT, start, goal), 6)
    torch.testing.assert_close(
        times[0], torch.linspace(0, 1, 6, dtype=torch.float64), rtol=0, atol=1e-15
    )
    assert not torch.allclose(times[1], times[0], atol=1e-3)


def test_single_precision_gives_single_precision_times():
    phi, start, goal = random_curves(CUBIC, 10, 0.1)
    times = constant_speed(Torus(), Curves(CUBIC, phi.float(), start.float(), goal.float()), 12)
    assert times.dtype == torch.float32
    torch.testing.assert_close(
        times.double(),
        constant_speed(Torus(), Curves(CUBIC, phi, start, goal), 12),
        rtol=0,
        atol=3e-6,
    )


def test_rounding_is_not_chased_for_ever():
    case = (values.float() for values in random_curves(CUBIC, 3, 0.1))
    Counted.points = 0
    times = constant_speed(Counted(2), Curves(CUBIC, *case), 12, tolerance=1e-14)
    assert (times.diff() > 0).all()
    assert Counted.points <= 3 * 4 * CROWD * NODES


def test_no_graph_is_built():
    moving = STRAIGHT.clone().requires_grad_()
    assert not constant_speed(
        Sphere(), Curves(CUBIC, moving, point(0, 0), point(0, 1)), 5
    ).requires_grad


def test_bad_input_is_refused_by_name():
    end, phi = point(0.1, 0.1), torch.zeros(2, 4)
    phi[1, 2] = math.nan
    with pytest.raises(NonFiniteError, match=r"phi\[1, 2\] = nan"):
        constant_speed(Sphere(), Curves(CUBIC, phi, end, end), 5)
    with pytest.raises(NonFiniteError, match=r"speeds\[0\] = inf"):
        constant_speed(Plane(2), Curves(CUBIC, STRAIGHT, end, 1e200 * end), 5)
    with pytest.raises(GeometryError, match="count = 1: must be at least 2"):
        constant_speed(Sphere(), Curves(CUBIC, STRAIGHT, end, end), 1)
    for tolerance in (0.0, math.nan):
        with pytest.raises(GeometryError, match="tolerance = .*: must be positive"):
            constant_speed(Sphere(), Curves(CUBIC, STRAIGHT, end, end), 5, tolerance)
    with pytest.raises(GeometryError, match="the curve has dim 2: must be that of the manifold, 3"):
        constant_speed(Plane(3), Curves(CUBIC, STRAIGHT, end, end), 5)
    with pytest.raises(CurveError, match=r"phi has shape \(3,\)"):
        constant_speed(Sphere(), Curves(CUBIC, torch.zeros(3), end, end), 5)
