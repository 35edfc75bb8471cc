import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from constraint_geodesics.geometry.analytic import (
    LevelCircle,
    LevelSet,
    LevelSetError,
    Sphere,
    Torus,
)
from constraint_geodesics.geometry.graph import OUTSIDE, components_on_grid
from constraint_geodesics.geometry.manifold import (
    EmbeddedManifold,
    GeometryError,
    MeasuredManifold,
    NonFiniteError,
    PeriodicManifold,
    pullback_metric,
)

PI = math.pi
CIRCLES = [
    LevelCircle(Sphere(2.0), 0, 0.4),
    LevelCircle(Sphere(), 0, -1.5),
    LevelCircle(Torus(2.0, 0.5), 1, 2.0),
    LevelCircle(Torus(2.0, 0.5), 1, PI),
    LevelCircle(Torus(2.0, 0.5), 0, -3.0),
]
every_circle = pytest.mark.parametrize("circle", CIRCLES, ids=str)
repeatable = settings(max_examples=60)


def points(*rows):
    return torch.tensor(rows, dtype=torch.float64)


# Circles


@every_circle
def test_a_circle_is_embedded_with_the_metric_it_says(circle):
    for protocol in (EmbeddedManifold, MeasuredManifold, PeriodicManifold):
        assert isinstance(circle, protocol)
    u = torch.linspace(-4, 4, 12, dtype=torch.float64).reshape(3, 4, 1)
    assert circle.embed(u).shape == (3, 4, circle.ambient_dim)
    torch.testing.assert_close(
        circle.metric(u), pullback_metric(circle.embed, u), rtol=1e-12, atol=1e-15
    )
    torch.testing.assert_close(
        circle.metric(u), torch.full((3, 4, 1, 1), circle.radius**2).double()
    )
    torch.testing.assert_close(
        circle.embed(u + circle.periods[0]), circle.embed(u), rtol=0, atol=1e-14
    )
    centre = circle.embed(points([0.0], [PI])).mean(0)
    distances = (circle.embed(u) - centre).norm(dim=-1)
    torch.testing.assert_close(
        distances, torch.full_like(distances, circle.radius), rtol=1e-13, atol=0
    )


@pytest.mark.parametrize(
    ("circle", "radius"),
    [
        (LevelCircle(Sphere(2.0), 0, PI / 3), 1.0),
        (LevelCircle(Torus(2.0, 0.5), 1, 0.0), 2.5),
        (LevelCircle(Torus(2.0, 0.5), 1, PI), 1.5),
        (LevelCircle(Torus(2.0, 0.5), 0, 0.7), 0.5),
    ],
)
def test_radii(circle, radius):
    assert circle.radius == pytest.approx(radius, rel=1e-15)


@every_circle
def test_distance_on_a_circle_is_the_shorter_arc(circle):
    for a, b, angle in (
        (0, 1, 1),
        (-3, 3, 2 * PI - 6),
        (0.5, 0.5 + 2 * PI, 0),
        (0, PI, PI),
        (9, 9, 0),
    ):
        for ends in ((a, b), (b, a)):
            found = circle.distance(*points(*[[end] for end in ends])).item()
            assert found == pytest.approx(circle.radius * angle, abs=4e-15)
    chord = (circle.embed(points([0.3])) - circle.embed(points([1.5]))).norm().item()
    arc = circle.distance(points([0.3]), points([1.5])).item()
    assert chord == pytest.approx(2 * circle.radius * math.sin(arc / circle.radius / 2), rel=1e-13)


@every_circle
def test_the_way_across_the_manifold_is_never_longer(circle):
    a, b = (
        torch.zeros(9, 1, dtype=torch.float64),
        torch.linspace(-PI, PI, 9, dtype=torch.float64)[:, None],
    )
    across = circle.manifold.distance(circle.point(a), circle.point(b))
    assert (across <= circle.distance(a, b) + 1e-14).all()
    tight = isinstance(circle.manifold, Torus) and (circle.coordinate == 0 or circle.level == PI)
    assert tight == torch.allclose(across, circle.distance(a, b), rtol=1e-13, atol=0)


def test_bad_coordinates_on_a_circle_are_refused():
    with pytest.raises(NonFiniteError, match=r"b\[1, 0\] = inf"):
        CIRCLES[0].distance(points([0.0]), points([0.0], [math.inf]))
    for function in (CIRCLES[0].point, CIRCLES[0].embed, CIRCLES[0].metric):
        with pytest.raises(
            GeometryError, match=r"u has shape \(5, 2\): its last axis must have 1 entries"
        ):
            function(torch.zeros(5, 2))


# Level sets


def test_fig_2_the_sphere_has_one_circle_and_the_torus_a_set_of_them():
    assert LevelSet(Sphere(), 0, (PI / 6,)).components() == (LevelCircle(Sphere(), 0, PI / 6),)
    torus = LevelSet(Torus(), 1, (PI / 6, -PI / 6))
    assert [circle.level for circle in torus.components()] == [-PI / 6, PI / 6]


@pytest.mark.parametrize(
    ("levels", "tolerance", "named"),
    [
        ((0.1, 0.1), 0.0, [0.1]),
        ((0.1, 0.1 + 2 * PI), 0.0, [0.1]),
        ((2 * PI - 0.1, -0.1), 0.0, [2 * PI - 0.1]),
        ((PI, -PI), 0.0, [PI]),
        ((1.0, -2.0, 0.5), 0.0, [-2.0, 0.5, 1.0]),
        ((0.1, 0.3), 0.1, [0.1]),  # the bands touch
        ((0.1, 0.3), 0.0999, [0.1, 0.3]),
        ((0.0, 0.5, 1.0), 0.3, [0.0]),  # one overlaps the next
        ((3.0, -3.0, 0.0), 0.2, [0.0, 3.0]),  # across the seam
        ((3.0, -3.0), 0.1, [-3.0, 3.0]),
        ((0.0, PI / 2, PI, -PI / 2), 0.8, [0.0]),  # all the way round
        ((0.0, PI / 2, PI, -PI / 2), 0.7, [-PI / 2, 0.0, PI / 2, PI]),
        ((1.0,), 9.0, [1.0]),
    ],
)
def test_levels_of_one_band_are_one_component(levels, tolerance, named):
    found = LevelSet(Torus(), 1, levels, tolerance)
    assert [circle.level for circle in found.components()] == named
    on = found.component_of(
        torch.stack([circle.point(torch.ones(1)) for circle in found.components()])
    )
    assert on.tolist() == list(range(len(named)))


def test_elevations_do_not_wrap():
    sphere = LevelSet(Sphere(), 0, (1.5, -1.5), 0.2)
    assert len(sphere.components()) == 2
    assert sphere.component_of(points([-1.6, 0.0], [1.6, 3.0], [0.0, 0.0])).tolist() == [
        0,
        1,
        OUTSIDE,
    ]
    assert sphere.inclusion(points([PI - 1.2, 0.0])).item() == pytest.approx(0.1, abs=1e-15)


def test_inclusion_is_the_distance_to_the_nearest_level_beyond_the_tolerance():
    torus = LevelSet(Torus(), 1, (0.5, 3.0), 0.1)
    z = points([9.0, 0.5], [9.0, 0.45], [0.0, 0.8], [0.0, -3.0], [0.0, 1.7], [0.0, 0.5 - 4 * PI])
    expected = points([0, 0, 0.2, 2 * PI - 6.1, 1.1, 0])[0]
    torch.testing.assert_close(torus.inclusion(z), expected, rtol=0, atol=1e-15)
    assert torus.inclusion(z)[0] == 0
    assert torus.component_of(z).tolist() == [0, 0, OUTSIDE, OUTSIDE, OUTSIDE, 0]
    ring = LevelSet(Torus(), 0, (0.5,))
    assert ring.inclusion(points([0.7, 0.5])).item() == pytest.approx(0.2, abs=1e-15)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("manifold", "coordinate"), [(Sphere(), 0), (Torus(), 0), (Torus(), 1)])
def test_inclusion_is_zero_to_the_bit_on_every_component(manifold, coordinate, dtype):
    levels = (0.1, -1.3, 1.57)
    found = LevelSet(manifold, coordinate, levels)
    u = torch.linspace(-7, 7, 50, dtype=dtype)[:, None]
    for number, circle in enumerate(found.components()):
        z = circle.point(u)
        assert z.dtype == dtype
        assert torch.equal(found.inclusion(z), torch.zeros(50, dtype=dtype))
        assert (found.component_of(z) == number).all()


@pytest.mark.parametrize(
    ("manifold", "coordinate", "low"),
    [(Sphere(), 0, -PI / 2), (Torus(), 1, -PI), (Torus(), 0, -PI)],
)
@given(data=st.data())
@repeatable
def test_components_are_those_of_the_grid(manifold, coordinate, low, data):
    steps, others = 48, 5
    step = -2 * low / steps
    wraps = math.isfinite(manifold.periods[coordinate])
    nodes = data.draw(st.lists(st.integers(1, steps - 1), min_size=1, max_size=6))
    half_width = data.draw(st.integers(0, 6)) + 0.5
    found = LevelSet(
        manifold, coordinate, tuple(low + step * node for node in nodes), half_width * step
    )
    held = low + step * np.arange(steps + (not wraps))
    free = np.linspace(-PI, PI, others, endpoint=False)
    lines = (held, free) if coordinate == 0 else (free, held)
    z = torch.from_numpy(np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1))
    # The bands end half a step off the nodes, so that none of them is inside or outside by
    # rounding.
    inside = (found.inclusion(z) == 0).numpy()
    labels = components_on_grid(inside, (wraps, True) if coordinate == 0 else (True, wraps))
    assert len(found.components()) == labels.max() + 1
    pairs = set(zip(labels.ravel().tolist(), found.component_of(z).ravel().tolist(), strict=True))
    assert (
        len(pairs)
        == len({label for label, _ in pairs})
        == len({component for _, component in pairs})
    )
    assert {component for label, component in pairs if label >= 0} == set(
        range(len(found.components()))
    )


@pytest.mark.parametrize(
    ("manifold", "coordinate", "levels", "tolerance", "message"),
    [
        (Sphere(), 1, (0.0,), 0.0, "coordinate = 1: the other one doesn't repeat"),
        (Torus(), 2, (0.0,), 0.0, "coordinate = 2: must be 0 or 1"),
        (Torus(), -1, (0.0,), 0.0, "coordinate = -1"),
        (Torus(), 1, (), 0.0, r"levels = \(\): must hold at least one"),
        (Torus(), 1, (0.0, math.nan), 0.0, r"levels\[1\] = nan: must be finite"),
        (Sphere(), 0, (PI / 2,), 0.0, r"levels\[0\] = 1\.57.*must lie between the poles"),
        (Sphere(), 0, (0.0, -PI / 2), 0.0, r"levels\[1\] = -1\.57"),
        (Sphere(), 0, (2.0,), 0.0, r"levels\[0\] = 2\.0"),
        (Torus(), 1, (0.0,), -0.1, r"tolerance = -0\.1: must be finite and at least 0"),
        (Torus(), 1, (0.0,), math.inf, "tolerance = inf"),
    ],
)
def test_what_cuts_out_no_circles_is_refused(manifold, coordinate, levels, tolerance, message):
    with pytest.raises(LevelSetError, match=message):
        LevelSet(manifold, coordinate, levels, tolerance)
    if len(levels) == 1 and tolerance == 0:
        with pytest.raises(LevelSetError, match=message.replace(r"levels\[0\]", "level")):
            LevelCircle(manifold, coordinate, levels[0])


def test_points_that_are_not_finite_are_refused():
    for function in (
        LevelSet(Torus(), 1, (0.0,)).inclusion,
        LevelSet(Torus(), 1, (0.0,)).component_of,
    ):
        with pytest.raises(NonFiniteError, match=r"z\[0, 1\] = nan"):
            function(points([0.0, math.nan]))
        with pytest.raises(GeometryError, match=r"z has shape \(3,\)"):
            function(torch.zeros(3))
