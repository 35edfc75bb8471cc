import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.integrate import solve_ivp

from constraint_geodesics.geometry.analytic import Torus
from constraint_geodesics.geometry.curves import Curves, PinnedPolynomial
from constraint_geodesics.geometry.length import Quadrature, curve_energy
from constraint_geodesics.geometry.torus_distance import torus_distance

PI = math.pi
TORI = ((2.0, 1.0), (3.0, 0.2), (1.2, 1.0))

every_torus = pytest.mark.parametrize("radii", [*TORI, (50.0, 40.0)], ids=str)
any_points = arrays(np.float64, (32, 2), elements=st.floats(-3 * PI, 3 * PI))
repeatable = settings(max_examples=4)


def rows(*points):
    return np.array(points, dtype=np.float64)


def geodesics(radii, start, directions, length, count):
    """Points (count, n, 2) along geodesics of unit speed, v̈ = −ρ sin v u̇² / r, ü = 2 r sin v u̇
    v̇ / ρ, and the lengths (count, n) up to them.

    start: (2,) or (n, 2).  directions: (n,) angles to the parallel.  length: that of the whole, one
    or (n,).
    """
    major, minor = radii
    start, length = (
        np.broadcast_to(start, (len(directions), 2)),
        np.broadcast_to(length, len(directions)),
    )

    def slope(_, state):
        _, v, du, dv = state.reshape(4, -1)
        ring = major + minor * np.cos(v)
        ddu, ddv = 2 * minor * np.sin(v) * du * dv / ring, -ring * np.sin(v) * du**2 / minor
        return (length * np.stack([du, dv, ddu, ddv])).ravel()

    ring = major + minor * np.cos(start[:, 1])
    state = np.stack(
        [start[:, 0], start[:, 1], np.cos(directions) / ring, np.sin(directions) / minor]
    )
    times = np.linspace(0, 1, count + 1)[1:]
    found = solve_ivp(slope, (0, 1), state.ravel(), "DOP853", t_eval=times, rtol=1e-11, atol=1e-12)
    return found.y.reshape(4, len(directions), count)[:2].transpose(2, 1, 0), times[
        :, None
    ] * length


# Against geodesics


@pytest.mark.parametrize("radii", TORI, ids=str)
@pytest.mark.parametrize("tube_angle", [0.0, 0.6, -2.3, PI])
def test_a_geodesic_is_shortest_up_to_its_cut_point_and_never_again(radii, tube_angle):
    start = np.array([0.4, tube_angle])
    directions = np.linspace(-PI, PI, 24, endpoint=False)
    longest = PI * (radii[0] - radii[1]) + 2 * PI * radii[1]
    points, lengths = geodesics(radii, start, directions, longest, 40)
    found = torus_distance(
        *radii, np.broadcast_to(start, (points[..., 0].size, 2)), points.reshape(-1, 2)
    )
    excess = lengths - found.reshape(points.shape[:2])
    assert excess.min() > -1e-9
    shortest = excess < 1e-9
    assert shortest[0].all()
    assert not shortest[-1].any()
    assert (shortest[1:] <= shortest[:-1]).all()


@pytest.mark.parametrize("radii", [(2.0, 1.0), (1.2, 1.0), (5.0, 2.0)], ids=str)
def test_the_distance_is_the_length_of_a_geodesic_that_arrives(radii):
    rng = np.random.default_rng(2)
    a, b = rng.uniform(-PI, PI, (2, 40, 2))
    metric = np.stack([radii[0] + radii[1] * np.cos(a[:, 1]), np.full(40, radii[1])], axis=-1)
    step = 1e-6 * np.eye(2)
    ahead, behind = (
        np.stack([torus_distance(*radii, a + sign * s / metric, b) for s in step], axis=-1)
        for sign in (1, -1)
    )
    away = (ahead - behind) / 2e-6
    np.testing.assert_allclose(np.linalg.norm(away, axis=-1), 1.0, atol=1e-8)
    distances = torus_distance(*radii, a, b)
    points, _ = geodesics(radii, a, np.arctan2(-away[:, 1], -away[:, 0]), distances, 1)
    ends, goals = (Torus(*radii).embed(torch.from_numpy(z.copy())) for z in (points[0], b))
    assert (ends - goals).norm(dim=-1).max() < 1e-5


def relaxed_length(radii, a, b):
    """Length after the energy of polynomials to every image of b was relaxed."""
    torus, curve, rule = Torus(*radii), PinnedPolynomial(2, 14), Quadrature.gauss_legendre(40)
    turns = (
        2 * PI * torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)] * 2)
    )
    start, goal = torch.from_numpy(a), torch.from_numpy(b) + turns
    sides = torch.zeros(2, 1, curve.coefficients, dtype=torch.float64)
    sides[:, 0, curve.degree - 1] = torch.tensor([1.0, -1.0])
    phi = sides.repeat(1, len(turns), 1).requires_grad_()
    search = torch.optim.LBFGS(
        [phi], max_iter=500, tolerance_change=1e-14, line_search_fn="strong_wolfe"
    )

    def energy():
        search.zero_grad()
        total = curve_energy(torus, Curves(curve, phi, start, goal), rule).sum()
        total.backward()
        return total

    search.step(energy)
    return curve_energy(torus, Curves(curve, phi.detach(), start, goal), rule).min().sqrt().item()


@pytest.mark.parametrize(
    ("radii", "a", "b"),
    [
        ((2.0, 1.0), (0.3, 1.0), (2.9, -1.4)),
        ((2.0, 1.0), (0.0, 0.0), (2.6, 0.0)),  # past the conjugate point
        ((2.0, 1.0), (-1.0, 2.8), (1.5, -2.5)),
        ((3.0, 1.5), (2.0, 0.4), (-2.5, 0.9)),
    ],
)
def test_relaxed_curves_agree(radii, a, b):
    distance = torus_distance(*radii, rows(a), rows(b))[0]
    assert relaxed_length(radii, np.array(a), np.array(b)) == pytest.approx(distance, rel=1e-6)


# Exact cases


@every_torus
def test_meridians_and_the_inner_equator_are_shortest(radii):
    major, minor = radii
    angles = np.linspace(-PI, PI, 33)
    here = np.zeros_like(angles)
    meridian = torus_distance(
        major, minor, np.stack([here, here + 0.3], axis=-1), np.stack([here, angles], axis=-1)
    )
    turn = np.abs(angles - 0.3)
    np.testing.assert_allclose(
        meridian, minor * np.minimum(turn, 2 * PI - turn), rtol=0, atol=1e-14 * major
    )
    inner = torus_distance(
        major, minor, np.stack([here, here + PI], axis=-1), np.stack([angles, here - PI], axis=-1)
    )
    np.testing.assert_allclose(inner, (major - minor) * np.abs(angles), rtol=0, atol=1e-14 * major)


@every_torus
def test_the_outer_equator_is_shortest_up_to_its_conjugate_point(radii):
    major, minor = radii
    conjugate = PI * math.sqrt(minor / (major + minor))
    turn = conjugate * np.array([0.1, 0.7, 0.999, 1.0, 1.01, 1.1])
    turn = turn[turn <= PI]
    here = np.zeros((len(turn), 2))
    equator = (major + minor) * turn
    distances = torus_distance(major, minor, here, np.stack([turn, 0 * turn], axis=-1))
    np.testing.assert_allclose(distances[:4], equator[:4], rtol=1e-14)
    assert (distances[4:] < equator[4:] * (1 - 1e-5)).all()


@pytest.mark.parametrize("equator", [0.0, PI])
@every_torus
def test_nothing_is_lost_next_to_the_equators(radii, equator):
    major, minor = radii
    offsets, turns = (
        [1e-4, 1e-7, 1e-8, 1e-9, 1e-12, 1e-16, 1e-40, 1e-200],
        [1e-9, 0.5, 1.0, 2.5, PI],
    )
    offset, turn, shift = np.array(list(itertools.product(offsets, turns, [0.0, 1.0, -0.5]))).T
    on_a, on_b = (
        np.stack([0 * turn, 0 * turn + equator], axis=-1),
        np.stack([turn, 0 * turn + equator], axis=-1),
    )
    a, b = (
        on_a + np.stack([0 * turn, shift * offset], axis=-1),
        on_b + np.stack([0 * turn, offset], axis=-1),
    )
    difference = torus_distance(major, minor, a, b) - torus_distance(major, minor, on_a, on_b)
    assert (np.abs(difference) <= 2 * minor * offset + 1e-14 * major).all()


@pytest.mark.parametrize("size", [1e-7, 1e-9, 1e-11])
@every_torus
def test_near_points_keep_their_digits(radii, size):
    major, minor = radii
    directions = np.linspace(-PI, PI, 16, endpoint=False)
    a = np.stack([np.full(16, 0.5), np.linspace(-3, 3, 16)], axis=-1)
    b = a + size * np.stack([np.cos(directions), np.sin(directions)], axis=-1)
    step, ring = b - a, major + minor * np.cos((a[:, 1] + b[:, 1]) / 2)
    expected = np.hypot(ring * step[:, 0], minor * step[:, 1])
    np.testing.assert_allclose(torus_distance(major, minor, a, b), expected, rtol=1e-11)


# Laws


@every_torus
@given(any_points, any_points)
@repeatable
def test_symmetric_to_the_bit_and_zero_for_a_point_itself(radii, a, b):
    distances = torus_distance(*radii, a, b)
    assert np.array_equal(distances, torus_distance(*radii, b, a))
    assert np.array_equal(torus_distance(*radii, a, a), np.zeros(len(a)))
    assert (distances <= PI * (radii[0] + radii[1])).all()


@every_torus
@given(any_points, any_points)
@repeatable
def test_images_and_mirror_images_are_as_far_apart(radii, a, b):
    shift, turned = 2 * PI * np.array([[1, -2], [-3, 1]]), np.array([0.7, 0])
    as_a = np.stack([a, a + shift[0], a * [1, -1], a * [-1, 1], a + turned])
    as_b = np.stack([b, b + shift[1], b * [1, -1], b * [-1, 1], b + turned])
    distances = torus_distance(*radii, as_a.reshape(-1, 2), as_b.reshape(-1, 2)).reshape(5, -1)
    np.testing.assert_allclose(distances[1:], distances[[0] * 4], rtol=0, atol=1e-14 * sum(radii))


@pytest.mark.parametrize("radii", [*TORI, (1.001, 1.0), (1000.0, 1.0)], ids=str)
@given(any_points, any_points, any_points)
@repeatable
def test_no_detour_is_shorter(radii, a, b, c):
    ab, bc, ac = torus_distance(
        *radii, np.concatenate([a, b, a]), np.concatenate([b, c, c])
    ).reshape(3, -1)
    assert np.isfinite(ab).all()
    assert (ac <= ab + bc + 1e-13 * radii[0]).all()
