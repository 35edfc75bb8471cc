"""What the solvers must satisfy on grids with walls: never through one, exact ends, never longer
than the graph's path, and a richer family no worse than a poorer one.
"""

import math
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from constraint_geodesics.geodesics.gradient import GradientSolver
from constraint_geodesics.geodesics.graph_search import CombinedSolver, GraphSolver
from constraint_geodesics.geodesics.problem import ChartBox, ChartProblem
from constraint_geodesics.geodesics.solver import geodesics_between
from constraint_geodesics.geodesics.taut import drawn_along, pulled, pulled_along
from constraint_geodesics.geometry.curves import PinnedPolynomial, PinnedSpline
from constraint_geodesics.geometry.grid import GridManifold
from constraint_geodesics.geometry.length import estimate_length
from constraint_geodesics.geometry.manifold import WalledManifold

SIZE = 32
LOW, HIGH = (0.0, 0.0), (float(SIZE - 1), float(SIZE - 1))
CUBIC = PinnedPolynomial(2, 3)
GRIDS = ("comb", "boxes", "flat")


def comb() -> torch.Tensor:
    """Teeth of one and two nodes, from both sides in turn, with openings of two nodes."""
    blocked = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    for k, row in enumerate(range(5, SIZE - 3, 6)):
        blocked[row : row + 1 + k % 2] = True
        blocked[row : row + 1 + k % 2, slice(0, 2) if k % 2 else slice(SIZE - 2, SIZE)] = False
    return blocked


def boxes() -> torch.Tensor:
    rng, blocked = np.random.default_rng(4), torch.zeros(SIZE, SIZE, dtype=torch.bool)
    for row, column, rows, columns in rng.integers((0, 0, 2, 2), (SIZE, SIZE, 9, 9), (9, 4)):
        blocked[row : row + rows, column : column + columns] = True
    return blocked


@cache
def grid(name: str) -> GridManifold:
    rng = np.random.default_rng(2)
    field = ndimage.gaussian_filter(rng.normal(size=(SIZE, SIZE)), 4.0)
    varied = torch.from_numpy(np.exp(field / field.std()))
    blocked = {"comb": comb, "boxes": boxes, "flat": boxes}[name]()
    values = torch.ones_like(varied) if name == "flat" else varied
    return GridManifold(values.masked_fill(blocked, math.inf), LOW, HIGH)


@cache
def graph(name: str) -> GraphSolver:
    return GraphSolver.over_grid(grid(name), LOW, HIGH, (SIZE, SIZE))


def problem(name: str, curve=CUBIC) -> ChartProblem:
    return ChartProblem(grid(name), curve, ChartBox(LOW, HIGH))


def ends(name: str, seed: int, count: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Random points of the free cells."""
    points = np.random.default_rng(seed).uniform(LOW, HIGH, (60 * count, 2))
    free = points[grid(name).contains(torch.from_numpy(points)).numpy()]
    return free[:count], free[count : 2 * count]


def law(test):
    return settings(max_examples=4)(given(st.integers(0, 10_000))(test))


def looked_at(name: str, geodesic) -> tuple[float, bool]:
    """Length by 20 000 chords, and whether all their points are inside."""
    points = torch.from_numpy(geodesic.points(np.linspace(0.0, 1.0, 20_001)))
    speeds = grid(name).metric((points[1:] + points[:-1]) / 2)[:, 0, 0].sqrt()
    sides = torch.linalg.vector_norm(points.diff(dim=0), dim=-1)
    return float(speeds @ sides), bool(grid(name).contains(points).all())


@pytest.mark.parametrize("name", GRIDS)
@pytest.mark.parametrize("solver", ["graph", "combined", "gradient"])
@law
def test_no_curve_leads_through_a_wall_and_its_length_is_true(name, solver, seed) -> None:
    solvers = {"graph": graph(name), "combined": CombinedSolver(graph(name))}
    solvers["gradient"] = GradientSolver(starts=1, iterations=8)
    start, goal = ends(name, seed, 1)
    for row, found in enumerate(geodesics_between(solvers[solver], problem(name), start, goal)):
        if not found.found:
            assert math.isnan(found.length)
            continue
        length, inside = looked_at(name, found)
        assert inside
        assert found.length == pytest.approx(length, rel=1e-4)
        np.testing.assert_array_equal(found.points(np.array([0.0]))[0], start[row])
        np.testing.assert_array_equal(found.points(np.array([1.0]))[0], goal[row])


@pytest.mark.parametrize("name", GRIDS)
@law
def test_what_is_joined_is_found_and_pulled_tight(name, seed) -> None:
    start, goal = ends(name, seed)
    drawn = geodesics_between(graph(name), problem(name), start, goal)
    tight = geodesics_between(CombinedSolver(graph(name)), problem(name), start, goal)
    for a, b, rough, found in zip(start, goal, drawn, tight, strict=True):
        way = graph(name).path(a, b)
        if way is None:
            assert rough.status == found.status == "not_connected"
            continue
        assert rough.found
        assert found.found
        assert rough.length <= 1.02 * along(name, way), "drawn along the path"
        assert found.length <= along(name, way) * (1 + 1e-6)
        assert found.length <= rough.length * (1 + 1e-3)


def along(name: str, way: np.ndarray) -> float:
    """Length of a polygon, by chords."""
    t = np.linspace(0.0, len(way) - 1.0, 100 * (len(way) - 1) + 1)
    points = np.stack([np.interp(t, np.arange(len(way)), column) for column in way.T], axis=-1)
    points = torch.from_numpy(points)
    speeds = grid(name).metric((points[1:] + points[:-1]) / 2)[:, 0, 0].sqrt()
    return float(speeds @ torch.linalg.vector_norm(points.diff(dim=0), dim=-1))


def test_the_way_does_not_depend_on_the_family_asked_for() -> None:
    start, goal = ends("comb", 1)
    cubic, spline = (
        geodesics_between(CombinedSolver(graph("comb")), problem("comb", curve), start, goal)
        for curve in (CUBIC, PinnedSpline(2, 6))
    )
    for one, other in zip(cubic, spline, strict=True):
        assert one.length == pytest.approx(other.length, rel=1e-6)
        assert one.curve.functions > CUBIC.functions, "no cubic passes the comb"


@pytest.mark.parametrize("name", ["boxes", "flat"])
def test_a_spline_ends_no_worse_than_the_cubic_it_starts_from(name) -> None:
    start, goal = ends(name, 3, 3)
    solver = GradientSolver(starts=1, iterations=12)
    cubic, spline = (
        geodesics_between(solver, problem(name, curve), start, goal)
        for curve in (CUBIC, PinnedSpline(2, 3))
    )
    assert any(found.found for found in cubic)
    for poor, rich in zip(cubic, spline, strict=True):
        if poor.found:
            assert rich.length <= poor.length * (1 + 1e-5)


def test_a_corner_is_rounded_at_its_distance() -> None:
    """A flat square with one block: the shortest way touches one corner of it."""
    blocked = torch.zeros(41, 41, dtype=torch.bool)
    blocked[10:31, :21] = True
    manifold = GridManifold(torch.full((41, 41), 4.0).double(), (0.0, 0.0), (40.0, 40.0), blocked)
    start, goal = np.array([[3.0, 4.0]]), np.array([[20.0, 33.0]])
    corner = np.array([9.5, 20.5])
    exact = 2.0 * (np.linalg.norm(corner - start) + np.linalg.norm(goal - corner))
    lattice = GraphSolver.over_grid(manifold, (0.0, 0.0), (40.0, 40.0), (41, 41))
    case = ChartProblem(manifold, CUBIC, ChartBox((0.0, 0.0), (40.0, 40.0)))
    (found,) = geodesics_between(CombinedSolver(lattice), case, start, goal)
    assert exact <= found.length <= 1.003 * exact


def test_pulling_never_lengthens_and_leaves_the_ends() -> None:
    manifold = grid("boxes")
    assert isinstance(manifold, WalledManifold)
    start, goal = ends("boxes", 11, 3)
    ways = [graph("boxes").path(*pair) for pair in zip(start, goal, strict=True)]
    for way in (way for way in ways if way is not None):
        drawn = drawn_along(manifold, way)
        assert drawn is not None
        fence = manifold.fenced(0.2, 0.2, torch.from_numpy(way[[0, -1]]))
        lengths = [
            float(estimate_length(fence, pulled(fence, drawn, count, 1e-9).curves(), 1e-5).length)
            for count in (0, 3, 30)
        ]
        assert lengths[2] <= lengths[1] * (1 + 1e-3) <= lengths[0] * (1 + 2e-3)
        taut = pulled_along(manifold, way)
        assert taut is not None
        np.testing.assert_array_equal(taut.start, way[0])
        np.testing.assert_array_equal(taut.goal, way[-1])


@pytest.mark.parametrize("seed", range(3))
def test_ends_on_the_edge_are_left_inwards(seed) -> None:
    rng = np.random.default_rng(seed)
    start = np.array([[0.0, rng.uniform(*np.array(HIGH) / 3)], [rng.uniform(20, 30), 0.0]])
    goal = np.array([[0.0, HIGH[1] - 1.0], [HIGH[0], HIGH[1]]])
    values = grid("comb").values.masked_fill(comb(), 1.0)
    manifold = GridManifold(values, LOW, HIGH)
    lattice = GraphSolver.over_grid(manifold, LOW, HIGH, (SIZE, SIZE))
    case = ChartProblem(manifold, CUBIC, ChartBox(LOW, HIGH))
    for found in geodesics_between(CombinedSolver(lattice), case, start, goal):
        assert found.found
        points = torch.from_numpy(found.points(np.linspace(0.0, 1.0, 10_001)))
        assert manifold.contains(points).all()


def test_a_way_of_one_node_along_the_edge_is_found() -> None:
    blocked = torch.zeros(16, 16, dtype=torch.bool)
    blocked[7:9, 1:] = True
    manifold = GridManifold(torch.ones(16, 16).double(), (0.0, 0.0), (15.0, 15.0), blocked)
    lattice = GraphSolver.over_grid(manifold, (0.0, 0.0), (15.0, 15.0), (16, 16))
    case = ChartProblem(manifold, CUBIC, ChartBox((0.0, 0.0), (15.0, 15.0)))
    for solver in (lattice, CombinedSolver(lattice)):
        (found,) = geodesics_between(solver, case, np.array([[2.0, 9.0]]), np.array([[13.0, 9.0]]))
        assert found.found
        points = torch.from_numpy(found.points(np.linspace(0.0, 1.0, 10_001)))
        assert manifold.contains(points).all()


@pytest.mark.parametrize("low", [-3.0, 0.1])
def test_a_goal_on_the_edge_is_reached_to_the_bit(low) -> None:
    """A sum of steps over such bounds ends a rounding beyond the edge."""
    lower, upper = (low, low), (3.0, 3.0)
    blocked = torch.zeros(30, 30, dtype=torch.bool)
    blocked[10:12, :26] = True
    manifold = GridManifold(torch.ones(30, 30).double(), lower, upper, blocked)
    lattice = GraphSolver.over_grid(manifold, lower, upper, (30, 30))
    nodes = manifold.nodes().numpy().reshape(30, 30, 2)
    start, goal = nodes[[2, 3, 5, 7], [5, 9, 2, 8]], nodes[[29, 20, 23, 16], [3, 0, 0, 0]]
    case = ChartProblem(manifold, CUBIC, ChartBox(lower, upper))
    for solver in (lattice, CombinedSolver(lattice)):
        for found, last in zip(geodesics_between(solver, case, start, goal), goal, strict=True):
            assert found.found
            np.testing.assert_array_equal(found.points(np.array([1.0]))[0], last)


def test_what_only_touches_at_a_corner_is_not_joined() -> None:
    blocked = torch.zeros(8, 8, dtype=torch.bool)
    blocked[:4, 4:] = True
    blocked[4:, :4] = True
    manifold = GridManifold(torch.ones(8, 8).double(), (0.0, 0.0), (7.0, 7.0), blocked)
    lattice = GraphSolver.over_grid(manifold, (0.0, 0.0), (7.0, 7.0), (8, 8))
    case = ChartProblem(manifold, CUBIC, ChartBox((0.0, 0.0), (7.0, 7.0)))
    for solver in (lattice, CombinedSolver(lattice)):
        (found,) = geodesics_between(solver, case, np.array([[1.0, 1.0]]), np.array([[6.0, 6.0]]))
        assert found.status == "not_connected"
