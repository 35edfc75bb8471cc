import math

import pytest
import torch

from constraint_geodesics.geometry.analytic import Plane, Sphere, Torus
from constraint_geodesics.geometry.manifold import (
    GeometryError,
    MeasuredManifold,
    NonFiniteError,
    PeriodicManifold,
)

PI = math.pi


def point(*coordinates: float) -> torch.Tensor:
    return torch.tensor(coordinates, dtype=torch.float64)


def test_known_points():
    torch.testing.assert_close(Sphere(2.0).embed(point(0.0, PI / 2)), point(0, 2, 0))
    torch.testing.assert_close(Sphere(2.0).embed(point(PI / 2, 1.0)), point(0, 0, 2))
    torch.testing.assert_close(Torus(2.0, 0.5).embed(point(0.0, 0.0)), point(2.5, 0, 0))
    torch.testing.assert_close(Torus(2.0, 0.5).embed(point(PI / 2, PI)), point(0, 1.5, 0))
    torch.testing.assert_close(Torus(2.0, 0.5).embed(point(PI, PI / 2)), point(-2, 0, 0.5))


def test_plane_distance():
    assert Plane(2).distance(point(1, 1), point(4, 5)) == 5.0


@pytest.mark.parametrize(
    ("a", "b", "angle"),
    [
        ((0, 0), (0, PI / 2), PI / 2),  # along the equator
        ((-1, 0.4), (1.25, 0.4), 2.25),  # along a meridian
        ((0, -3), (0, 3), 2 * PI - 6),  # the short way, across the seam of the chart
        ((1, 0), (1, PI), PI - 2),  # over the pole
        ((0.3, 0.2), (-0.3, 0.2 + PI), PI),  # antipodal
        ((PI / 2, 0), (PI / 2, 2), 0),  # one pole, two names
        ((PI / 2, 0), (-PI / 2, 1), PI),
        ((0.5, 1), (0.5, 1 + 2 * PI), 0),
        ((PI - 0.2, 0), (0.2, PI), 0),  # beyond the pole
    ],
)
def test_sphere_distance(a, b, angle):
    assert Sphere(3.0).distance(point(*a), point(*b)).item() == pytest.approx(
        3 * angle, abs=3e-15 * 3, rel=1e-15
    )


@pytest.mark.parametrize("gap", [1e-3, 1e-6, 1e-9, 1e-12])
def test_sphere_distance_keeps_its_digits_near_zero_and_near_the_antipode(gap):
    sphere = Sphere()
    here = point(0.0, 0.0)
    assert sphere.distance(here, point(gap, 0)).item() == pytest.approx(gap, rel=1e-14)
    assert sphere.distance(here, point(0, gap)).item() == pytest.approx(gap, rel=1e-14)
    for short_of in (point(gap, PI), point(0, PI - gap)):
        assert PI - sphere.distance(here, short_of).item() == pytest.approx(gap, abs=1e-15)


def test_sphere_distance_holds_beyond_the_poles():
    elevation, azimuth = (
        torch.linspace(0.0, PI / 2, 201, dtype=torch.float64),
        torch.tensor(0.3, dtype=torch.float64),
    )
    here = torch.stack(torch.broadcast_tensors(elevation, azimuth), dim=-1)
    over_the_pole = torch.stack(torch.broadcast_tensors(PI - elevation, azimuth + PI), dim=-1)
    antipode = torch.stack(torch.broadcast_tensors(elevation - PI, azimuth), dim=-1)
    for there, distance in ((over_the_pole, 0.0), (antipode, PI)):
        found = Sphere().distance(here, there)
        torch.testing.assert_close(found, torch.full_like(found, distance), rtol=0, atol=5e-8)


def test_sphere_distance_broadcasts_and_differentiates():
    a = torch.zeros(3, 1, 2, dtype=torch.float64)
    b = torch.tensor([[0.1, 0.2], [0.3, 0.4]], dtype=torch.float64, requires_grad=True)
    distances = Sphere().distance(a, b)
    assert distances.shape == (3, 2)
    (gradient,) = torch.autograd.grad(distances[0, 0], b)
    # The gradient of a distance is a unit vector of the metric: gᵀ M⁻¹ g = 1.
    inverse = torch.linalg.inv(Sphere().metric(b.detach()[0]))
    assert (gradient[0] @ inverse @ gradient[0]).item() == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize(
    ("z", "elevation"),
    [((0.4, 9.0), 0.4), ((PI - 0.4, 0), 0.4), ((-PI / 2, 0), -PI / 2), ((2 * PI - 1, 0), -1)],
)
def test_elevation_is_that_of_the_embedded_point(z, elevation):
    sphere = Sphere(2.0)
    assert sphere.elevation(point(*z)).item() == pytest.approx(elevation, abs=1e-15)
    assert 2 * math.sin(elevation) == pytest.approx(sphere.embed(point(*z))[2].item(), abs=1e-15)


@pytest.mark.parametrize(
    ("angle", "wrapped"), [(0.4, 0.4), (PI + 0.5, 0.5 - PI), (-3 * PI / 2, PI / 2), (7 * PI, PI)]
)
def test_tube_angle_wraps(angle, wrapped):
    assert abs(Torus().tube_angle(point(1.0, angle)).item()) == pytest.approx(
        abs(wrapped), abs=1e-14
    )
    assert math.sin(Torus().tube_angle(point(1.0, angle)).item()) == pytest.approx(
        math.sin(wrapped), abs=1e-14
    )


@pytest.mark.parametrize(
    ("a", "b", "distance"),
    [
        ((0.3, -0.5), (0.3, 2.0), 2.5),  # along a meridian
        ((0.3, -2.5), (0.3, 2.0), 2 * PI - 4.5),  # through the inner equator
        ((0, PI), (2.5, -PI), 2.5),  # along the inner equator
        ((-3, PI), (3, PI), 2 * PI - 6),
        ((0, 0), (1.8, 0), 5.4),  # along the outer equator, short of the conjugate point at 1.81
        ((1, 2), (1 - 2 * PI, 2 + 4 * PI), 0),
    ],
)
def test_torus_distance(a, b, distance):
    for scale in (1.0, 5.0):
        found = Torus(2.0 * scale, scale).distance(point(*a), point(*b)).item()
        assert found == pytest.approx(scale * distance, abs=1e-14 * scale)


def test_torus_distance_broadcasts_and_keeps_the_type():
    a, b = torch.zeros(3, 1, 2), torch.tensor([[0.0, 1.0], [0.0, -2.0]])
    found = Torus().distance(a, b)
    torch.testing.assert_close(found, torch.tensor([[1.0, 2.0]]).expand(3, 2))
    assert Torus().distance(a.double(), b).dtype == torch.float64
    assert Torus().distance(torch.zeros(0, 2), torch.zeros(2)).shape == (0,)
    assert Torus().distance(torch.zeros(2), torch.tensor([0, 1])).shape == ()


@pytest.mark.parametrize("manifold", [Sphere(2.0), Torus()])
def test_a_whole_period_leads_back_to_the_same_point(manifold):
    assert isinstance(manifold, PeriodicManifold)
    assert isinstance(manifold, MeasuredManifold)
    z = point(0.3, -0.7)
    for k, period in enumerate(manifold.periods):
        if not math.isfinite(period):
            continue
        shift = torch.zeros(2, dtype=torch.float64)
        shift[k] = period
        torch.testing.assert_close(manifold.embed(z + shift), manifold.embed(z), rtol=0, atol=1e-14)
        assert not torch.allclose(manifold.embed(z + shift / 2), manifold.embed(z), atol=0.1)
    assert Sphere().periods == (math.inf, 2 * PI)
    assert Torus().periods == (2 * PI, 2 * PI)


@pytest.mark.parametrize("radius", [0.0, -1.0, math.inf, math.nan])
def test_radii_must_be_positive(radius):
    for make in (lambda: Sphere(radius), lambda: Torus(radius, 1.0), lambda: Torus(1.0, radius)):
        with pytest.raises(GeometryError, match=rf"= {radius}: must be positive and finite"):
            make()


def test_shapes_that_are_no_manifold_are_refused():
    with pytest.raises(GeometryError, match=r"minor = 2\.0: must be below major = 2\.0"):
        Torus(2.0, 2.0)
    with pytest.raises(GeometryError, match="dim = 0"):
        Plane(0)


@pytest.mark.parametrize("manifold", [Plane(2), Sphere(), Torus()])
def test_points_of_another_dimension_are_refused(manifold):
    for function in (manifold.embed, manifold.metric):
        with pytest.raises(
            GeometryError, match=r"z has shape \(4, 3\): its last axis must have 2 entries"
        ):
            function(torch.zeros(4, 3))


@pytest.mark.parametrize("manifold", [Plane(2), Sphere(), Torus()])
def test_distance_of_a_point_that_is_not_finite_is_refused(manifold):
    with pytest.raises(NonFiniteError, match=r"b\[1, 0\] = nan"):
        manifold.distance(point(0, 0), torch.tensor([[0.0, 0.0], [math.nan, math.inf]]))
    with pytest.raises(GeometryError, match=r"a has shape \(3,\)"):
        manifold.distance(point(0, 0, 0), point(0, 0))
