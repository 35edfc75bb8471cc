import math
from dataclasses import dataclass

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from constraint_geodesics.geometry.analytic import Plane, Torus
from constraint_geodesics.geometry.curves import Curves, PinnedPolynomial
from constraint_geodesics.geometry.grid import WALL, GridError, GridManifold
from constraint_geodesics.geometry.length import Quadrature, curve_energy, curve_length
from constraint_geodesics.geometry.manifold import (
    BoundedManifold,
    EmbeddedManifold,
    GeometryError,
    Manifold,
    NonFiniteError,
    OutsideError,
    require_inside,
)

LOWER, UPPER = (-1.0, 2.0), (1.0, 5.0)
repeatable = settings(max_examples=20)
inside = st.tuples(st.floats(LOWER[0], UPPER[0]), st.floats(LOWER[1], UPPER[1]))


def tensor(values, dtype=torch.float64):
    return torch.tensor(values, dtype=dtype)


def constant(g=2.25, blocked=None):
    return GridManifold(torch.full((5, 7), g, dtype=torch.float64), LOWER, UPPER, blocked)


def wall(*places):
    blocked = torch.zeros(5, 7, dtype=torch.bool)
    for row, column in places:
        blocked[row, column] = True
    return blocked


@dataclass(frozen=True)
class HalfPlane:
    """The hyperbolic half plane: M = I / y² at (x, y)."""

    dim: int = 2

    def metric(self, z: Tensor) -> Tensor:
        return torch.eye(2, dtype=z.dtype) / z[..., 1, None, None] ** 2

    def distance(self, a: Tensor, b: Tensor) -> Tensor:
        return torch.acosh(1 + (b - a).square().sum(-1) / (2 * a[..., 1] * b[..., 1]))


# Metric


def test_a_grid_is_a_bounded_manifold_without_embedding():
    assert isinstance(constant(), Manifold)
    assert isinstance(constant(), BoundedManifold)
    assert not isinstance(constant(), EmbeddedManifold)
    assert constant().dim == 2


def test_a_constant_grid_is_the_scaled_plane():
    z = torch.rand(
        3, 4, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    ) * 2 + tensor(LOWER)
    torch.testing.assert_close(constant().metric(z), 2.25 * Plane(2).metric(z), rtol=1e-15, atol=0)
    line, rule = PinnedPolynomial(2, 3), Quadrature.gauss_legendre(8)
    length = curve_length(
        constant(), Curves(line, torch.zeros(4).double(), tensor([-1, 2]), tensor([0.5, 4])), rule
    )
    assert length.item() == pytest.approx(1.5 * 2.5, rel=1e-14)


@repeatable
@given(inside, st.tuples(*[st.floats(-1, 1)] * 3))
def test_bilinear_functions_are_reproduced(z, slopes):
    def g(z):
        x, y = z[..., 0], z[..., 1] - 3.5
        return 6 + slopes[0] * x + slopes[1] * y + slopes[2] * x * y

    grid = constant()
    grid = GridManifold(g(grid.nodes()).reshape(5, 7), LOWER, UPPER)
    z = tensor(z).requires_grad_()
    metric = grid.metric(z)
    torch.testing.assert_close(metric, g(z) * torch.eye(2, dtype=torch.float64), rtol=1e-14, atol=0)
    (gradient,) = torch.autograd.grad(metric[0, 0], z)
    (expected,) = torch.autograd.grad(g(z), z)
    torch.testing.assert_close(gradient, expected, rtol=0, atol=1e-12)


def test_nodes_lie_on_the_bounds_to_the_bit_and_carry_the_values():
    values = torch.rand(4, 9, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) + 0.1
    grid = GridManifold(values, (0.1, -0.7), (0.3, 1.9))
    nodes = grid.nodes().reshape(4, 9, 2)
    assert torch.equal(nodes[0, 0], tensor((0.1, -0.7)))
    assert torch.equal(nodes[-1, -1], tensor((0.3, 1.9)))
    torch.testing.assert_close(nodes[1, 1] - nodes[0, 0], tensor(grid.spacing))
    assert grid.contains(nodes).all()
    torch.testing.assert_close(grid.metric(nodes)[..., 0, 0], values, rtol=1e-13, atol=0)


def test_outside_the_metric_is_that_of_the_border():
    values = torch.arange(1.0, 13.0, dtype=torch.float64).reshape(3, 4)
    grid = GridManifold(values, LOWER, UPPER)
    for z, g in (((-9, 2), 1), ((9, 99), 12), ((0, -4), 5), ((1.0, 5.0), 12)):
        assert grid.metric(tensor(z))[1, 1].item() == pytest.approx(g, rel=1e-15)
    border = tensor([1.0, 3.5]).requires_grad_()
    (gradient,) = torch.autograd.grad(grid.metric(border)[0, 0], border)
    torch.testing.assert_close(gradient, tensor([4.0, 1.0]), rtol=1e-14, atol=0)


def test_single_precision_stays_single():
    grid = GridManifold(torch.ones(3, 3), (0.0, 0.0), (0.1, 0.7))
    assert grid.contains(grid.nodes()).all()
    assert grid.metric(grid.nodes()).dtype == torch.float32
    assert grid.metric(grid.nodes().double()).dtype == torch.float64


# What is blocked


def test_a_point_is_blocked_where_its_nearest_node_is():
    grid = constant(blocked=wall((2, 3)))  # the node at (0, 3.5); the spacing is 0.5
    points = tensor([[0, 3.5], [0.24, 3.5], [0.26, 3.5], [-0.24, 3.26], [-0.24, 3.24], [0, 3.76]])
    assert grid.contains(points).tolist() == [
        True ^ blocked for blocked in (True, True, False, True, False, False)
    ]


def test_points_off_the_grid_and_not_finite_are_not_contained():
    points = tensor(
        [[-1, 2], [1, 5], [1.0001, 3], [0, 1.9999], [math.nan, 3], [0, math.inf], [-math.inf, 3]]
    )
    assert constant().contains(points).tolist() == [True, True, *[False] * 5]
    with pytest.raises(OutsideError, match=r"z\[1\] = \[9\.0, 3\.0\]"):
        require_inside(constant(), tensor([[0, 3], [9, 3]]), "z")


def test_walls_rise_away_from_the_free_cells():
    everywhere = [(row, column) for row in range(5) for column in range(1, 7)]
    grid = constant(g=3.0, blocked=wall(*everywhere))
    depths = grid.metric(grid.nodes())[:, 0, 0].reshape(5, 7) / 3.0
    torch.testing.assert_close(depths[:, 0], torch.ones(5).double(), rtol=1e-14, atol=0)
    # the border of the free cells lies halfway between the first and the second column
    expected = 1 + WALL * (torch.arange(1, 7).double() - 0.5).expand(5, 6)
    torch.testing.assert_close(depths[:, 1:], expected, rtol=1e-14, atol=0)
    z = tensor([[0.1, 2.3], [0.3, 3.4], [-0.9, 4.9]]).requires_grad_()
    (gradient,) = torch.autograd.grad(grid.metric(z)[:, 0, 0].sum(), z)
    assert (gradient[:, 1] > 0).all()


def test_free_cells_are_measured_by_free_values_alone():
    grid = constant(g=3.0, blocked=wall((2, 3), (2, 4), (1, 1)))
    z = torch.rand(2000, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    z = tensor(LOWER) + z * (tensor(UPPER) - tensor(LOWER))
    free = grid.contains(z)
    assert 0 < (~free).sum() < 300
    factor = grid.metric(z)[:, 0, 0]
    torch.testing.assert_close(factor[free], torch.full((int(free.sum()),), 3.0).double())
    assert (factor[~free] > 3.0).all()


def test_infinite_values_block_as_named_nodes_do():
    values = torch.rand(5, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(3)) + 1
    named = GridManifold(values, LOWER, UPPER, wall((1, 2), (3, 3)))
    infinite = GridManifold(values.masked_fill(wall((1, 2), (3, 3)), math.inf), LOWER, UPPER)
    both = GridManifold(values.masked_fill(wall((1, 2)), math.inf), LOWER, UPPER, wall((3, 3)))
    z = (
        tensor(LOWER)
        + torch.rand(500, 2, generator=torch.Generator().manual_seed(4), dtype=torch.float64) * 3.0
    )
    for grid in (infinite, both):
        assert torch.equal(grid.contains(z), named.contains(z))
        torch.testing.assert_close(grid.metric(z), named.metric(z), rtol=0, atol=0)
        torch.testing.assert_close(grid.clearance(z), named.clearance(z), rtol=0, atol=0)


def test_clearance_is_the_distance_to_walls_and_edge_in_steps():
    grid = constant(blocked=wall(*[(row, 3) for row in range(5)]))  # cells from 3.25 to 3.75
    z = tensor([[0, 3.5], [0, 3.25], [0.3, 3.0], [0.1, 2.7], [-0.8, 4.4], [0.0, 5.2], [0.95, 2.5]])
    expected = tensor([-0.5, 0.0, 0.5, 1.1, 0.4, -0.4, 0.1])
    torch.testing.assert_close(grid.clearance(z), expected, rtol=0, atol=1e-12)
    shares = torch.rand(2000, 2, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    z = shares * tensor([2.2, 3.2]) + tensor([-1.1, 1.9])
    clear = grid.clearance(z)
    assert grid.contains(z[clear > 0]).all()
    assert not grid.contains(z[clear < 0]).any()


def test_a_fence_stands_before_the_border_and_leaves_its_doors_free():
    grid, door = constant(g=3.0, blocked=wall((2, 3))), tensor([[-1.0, 3.0]])
    fenced, open_at = grid.fenced(0.2, 1.0), grid.fenced(0.2, 1.0, door)
    z = tensor([[0.5, 2.5], [0.0, 3.2], [0.95, 2.5], [1.0, 4.0]])
    factor = fenced.metric(z)[:, 0, 0]
    assert (factor[:1] == 3.0).all(), "away from the border nothing changes"
    assert (factor[1:] > 3.0).all()
    torch.testing.assert_close(open_at.metric(z), fenced.metric(z), rtol=0, atol=0)
    assert open_at.metric(door)[0, 0, 0] == 3.0 < fenced.metric(door)[0, 0, 0]


def test_a_curve_relaxed_on_the_grid_goes_round_a_blocked_region():
    blocked = torch.zeros(41, 41, dtype=torch.bool)
    blocked[10:31, 15:26] = True
    grid = GridManifold(torch.ones(41, 41, dtype=torch.float64), (0.0, 0.0), (4.0, 4.0), blocked)
    curve, rule = PinnedPolynomial(2, 6), Quadrature.gauss_legendre(60)
    start, goal = tensor([0.4, 2.2]), tensor([3.6, 2.2])
    phi = torch.zeros(curve.coefficients, dtype=torch.float64, requires_grad=True)
    search = torch.optim.Adam([phi], lr=0.05)
    times = torch.linspace(0, 1, 200, dtype=torch.float64)
    assert not grid.contains(curve.evaluate(phi, start, goal, times)[0]).all()
    for _ in range(200):
        search.zero_grad()
        curve_energy(grid, Curves(curve, phi, start, goal), rule).backward()
        search.step()
    assert grid.contains(curve.evaluate(phi, start, goal, times)[0]).all()


# From another manifold


def half_plane_grid(count):
    return GridManifold.from_manifold(HalfPlane(), (-1.0, 0.5), (1.0, 2.0), (count, count))


def test_a_conformal_manifold_is_sampled_as_it_is():
    grid = half_plane_grid(31)
    torch.testing.assert_close(
        grid.metric(grid.nodes()), HalfPlane().metric(grid.nodes()), rtol=1e-12, atol=0
    )


def test_distances_of_the_hyperbolic_half_plane_are_approached():
    a, b = (
        tensor([[-0.8, 0.6], [0.2, 0.5], [-0.5, 1.5]]),
        tensor([[0.8, 0.8], [0.2, 2.0], [0.5, 1.0]]),
    )
    exact = HalfPlane().distance(a, b)
    curve, errors = PinnedPolynomial(2, 8), []
    for count in (21, 81):
        grid, rule = half_plane_grid(count), Quadrature.gauss_legendre(200)
        phi = torch.zeros(3, curve.coefficients, dtype=torch.float64, requires_grad=True)
        search = torch.optim.LBFGS([phi], max_iter=80, line_search_fn="strong_wolfe")

        def energy(grid=grid, phi=phi, search=search, rule=rule):
            search.zero_grad()
            total = curve_energy(grid, Curves(curve, phi, a, b), rule).sum()
            total.backward()
            return total

        search.step(energy)
        errors.append(
            (curve_length(grid, Curves(curve, phi.detach(), a, b), rule) / exact - 1)
            .abs()
            .max()
            .item()
        )
    assert errors[0] < 5e-3
    assert errors[1] < errors[0] / 8  # bilinear values are off by the square of the spacing


def test_a_metric_that_is_not_conformal_keeps_its_volume():
    torus = Torus(2.0, 0.5)
    grid = GridManifold.from_manifold(torus, (-3.0, -3.0), (3.0, 3.0), (7, 9))
    z = grid.nodes()
    volume = 0.5 * (2 + 0.5 * torch.cos(z[:, 1]))
    torch.testing.assert_close(grid.metric(z)[:, 0, 0], volume, rtol=1e-13, atol=0)


def test_what_a_bounded_manifold_does_not_contain_is_blocked():
    grid = constant(blocked=wall((0, 0), (2, 3)))
    again = GridManifold.from_manifold(grid, LOWER, UPPER, (5, 7))
    assert torch.equal(again.blocked, grid.blocked)
    torch.testing.assert_close(again.metric(again.nodes()), grid.metric(grid.nodes()))
    wider = GridManifold.from_manifold(constant(), (-2.0, 2.0), (2.0, 5.0), (9, 7), torch.float32)
    assert wider.blocked.sum() == 4 * 7
    assert wider.values.dtype == torch.float32


# What is refused


@pytest.mark.parametrize(
    ("values", "lower", "upper", "message"),
    [
        (torch.ones(4), LOWER, UPPER, r"values has shape \(4,\): must be \(rows, columns\)"),
        (torch.ones(1, 4), LOWER, UPPER, "at least 2 nodes an axis"),
        (torch.ones(2, 2, 2), LOWER, UPPER, r"shape \(2, 2, 2\)"),
        (
            torch.ones(3, 3),
            (0.0, 1.0),
            (1.0, 1.0),
            r"lower\[1\] = 1\.0: must be below upper\[1\] = 1\.0",
        ),
        (torch.ones(3, 3), (0.0, math.nan), (1.0, 1.0), "lower = .*must be two finite numbers"),
        (torch.ones(3, 3), (0.0, 0.0), (1.0, 1.0, 1.0), "upper = .*must be two finite numbers"),
        (
            torch.ones(3, 3, dtype=torch.int64),
            LOWER,
            UPPER,
            "dtype torch.int64: must be floating point",
        ),
        (
            tensor([[1, 1], [0, 1]]),
            LOWER,
            UPPER,
            r"values\[1, 0\] = 0\.0: must be positive and finite, or blocked",
        ),
        (tensor([[1, -2], [1, 1]]), LOWER, UPPER, r"values\[0, 1\] = -2\.0"),
        (tensor([[1, 1], [1, math.nan]]), LOWER, UPPER, r"values\[1, 1\] = nan"),
        (tensor([[-math.inf, 1], [1, 1]]), LOWER, UPPER, r"values\[0, 0\] = -inf"),
        (torch.full((2, 2), math.inf), LOWER, UPPER, "every node is, at least one must be free"),
    ],
)
def test_what_is_no_grid_is_refused(values, lower, upper, message):
    with pytest.raises(GridError, match=message):
        GridManifold(values, lower, upper)


def test_values_of_blocked_nodes_are_never_read():
    values = torch.ones(5, 7, dtype=torch.float64)
    values[1, 2], values[1, 3], values[1, 4] = math.nan, math.inf, -1.0
    grid = GridManifold(values, LOWER, UPPER, wall((1, 2), (1, 3), (1, 4)))
    torch.testing.assert_close(
        grid.metric(grid.nodes()), constant(1.0, grid.blocked).metric(grid.nodes())
    )
    with pytest.raises(GridError, match=r"values\[1, 4\] = -1\.0"):
        GridManifold(values, LOWER, UPPER, wall((1, 2), (1, 3)))


def test_what_blocks_nothing_sensible_is_refused():
    values = torch.ones(5, 7)
    with pytest.raises(GridError, match="every node is"):
        GridManifold(values, LOWER, UPPER, torch.ones(5, 7, dtype=torch.bool))
    for blocked in (torch.zeros(7, 5, dtype=torch.bool), torch.zeros(5, 7)):
        with pytest.raises(GridError, match="blocked has shape"):
            GridManifold(values, LOWER, UPPER, blocked)


def test_manifolds_that_have_no_grid_are_refused():
    with pytest.raises(GridError, match="manifold has dim 3: must be 2"):
        GridManifold.from_manifold(Plane(3), LOWER, UPPER, (3, 3))
    with pytest.raises(GridError, match=r"shape \(1, 3\)"):
        GridManifold.from_manifold(Plane(2), LOWER, UPPER, (1, 3))
    with pytest.raises(GridError, match=r"values\[0, 0\] = nan: must be positive and finite"):
        GridManifold.from_manifold(HalfPlane(), (0.0, 0.0), (1.0, 1.0), (3, 3))


def test_points_that_have_no_metric_are_refused():
    bad = constant().metric(tensor([[0, 3], [math.nan, 3]]))
    assert torch.isfinite(bad).flatten(1).all(1).tolist() == [True, False], (
        "no index out of range, and no made-up value"
    )
    with pytest.raises(NonFiniteError, match=r"goal\[0\] = nan"):
        curve_length(
            constant(),
            Curves(PinnedPolynomial(2, 3), torch.zeros(4), tensor([0, 3]), tensor([math.nan, 3])),
        )
    for function in (constant().metric, constant().contains):
        with pytest.raises(
            GeometryError, match=r"z has shape \(3,\): its last axis must have 2 entries"
        ):
            function(torch.zeros(3))
