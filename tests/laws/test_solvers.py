"""What every geodesic solver must satisfy on every manifold: exact ends, no curve below the
distance, honest statuses.

Which curve family can represent a geodesic to 1e-3 is said by `REACHES`: great circles near a pole
and geodesics that wind around the torus bend too much for one cubic in the chart.
"""

import math
import time
from contextlib import nullcontext
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from constraint_geodesics.geodesics.episodes import observation_size
from constraint_geodesics.geodesics.gradient import GradientSolver
from constraint_geodesics.geodesics.graph_search import CombinedSolver, GraphSolver
from constraint_geodesics.geodesics.policy_search import Actor, PolicySolver, TrainedPolicy
from constraint_geodesics.geodesics.problem import ChartBox, ChartProblem
from constraint_geodesics.geodesics.solver import geodesics_between
from constraint_geodesics.geometry.analytic import Plane, Sphere, Torus
from constraint_geodesics.geometry.curves import Curves, PinnedPolynomial, PinnedSpline
from constraint_geodesics.geometry.grid import GridManifold
from constraint_geodesics.geometry.length import curve_length
from constraint_geodesics.geometry.manifold import (
    GeometryError,
    NonFiniteError,
    OutsideError,
    pullback_metric,
)
from constraint_geodesics.studies.geodesic_search import AnalyticTask, curve_family, run_analytic

SEED = 3
CUBIC = PinnedPolynomial(2, 3)
WHOLE = {
    "plane": (Plane(), ChartBox((-1.5, -1.5), (1.5, 1.5))),
    "sphere": (Sphere(), ChartBox((-1.5, -math.pi), (1.5, math.pi))),
    "torus": (Torus(), ChartBox((-math.pi, -math.pi), (math.pi, math.pi))),
}
REACHES = {
    # manifold, family, box of the ends in which the family reaches every geodesic within 1e-3
    "plane, cubic": ("plane", CUBIC, ChartBox((-1.5, -1.5), (1.5, 1.5))),
    "sphere, cubic": ("sphere", CUBIC, ChartBox((-0.7, -1.0), (0.7, 1.0))),
    "sphere, degree 7": (
        "sphere",
        PinnedPolynomial(2, 7),
        ChartBox((-0.9, -math.pi), (0.9, math.pi)),
    ),
    "sphere, 8 segments": (
        "sphere",
        PinnedSpline(2, 8),
        ChartBox((-1.0, -math.pi), (1.0, math.pi)),
    ),
    "torus, degree 7": (
        "torus",
        PinnedPolynomial(2, 7),
        ChartBox((-math.pi, -math.pi), (math.pi, math.pi)),
    ),
    "torus, 4 segments": (
        "torus",
        PinnedSpline(2, 4),
        ChartBox((-math.pi, -math.pi), (math.pi, math.pi)),
    ),
}


def distance(manifold, start, goal) -> np.ndarray:
    return manifold.distance(
        torch.from_numpy(np.asarray(start)), torch.from_numpy(np.asarray(goal))
    ).numpy()


def solvers(name: str):
    manifold, box = WHOLE[name]
    graph = GraphSolver.over_points(manifold, box.sample(1500, np.random.default_rng(SEED)))
    grid = GraphSolver.over_grid(manifold, box.low, box.high, (40, 40))
    gradient = GradientSolver()
    return {
        "gradient": gradient,
        "graph": graph,
        "grid": grid,
        "combined": CombinedSolver(graph, gradient),
    }


ALL = {name: solvers(name) for name in WHOLE}


def law(test):
    return settings(max_examples=3)(given(st.integers(0, 10_000))(test))


@pytest.mark.parametrize("solver", ["gradient", "graph", "grid", "combined"])
@pytest.mark.parametrize("name", WHOLE)
@law
def test_ends_are_exact_and_no_curve_is_shorter_than_the_distance(name, solver, seed) -> None:
    manifold, box = WHOLE[name]
    problem = ChartProblem(manifold, CUBIC, box)
    ends = problem.sample_ends(2, np.random.default_rng(seed))
    exact = distance(manifold, ends.z_start, ends.z_goal)
    for row, found in enumerate(
        geodesics_between(ALL[name][solver], problem, ends.z_start, ends.z_goal)
    ):
        assert found.found
        points = found.points(np.array([0.0, 0.5, 1.0]))
        np.testing.assert_array_equal(points[0], ends.z_start[row])
        images = (points[-1] - ends.z_goal[row]) / (2 * math.pi)
        assert (
            np.array_equal(points[-1], ends.z_goal[row])
            or np.abs(images - images.round()).max() < 1e-9
        )
        assert found.length >= exact[row] * (1 - 1e-6)
        assert found.time_s >= 0
        assert found.iterations >= 1


@pytest.mark.parametrize("case", REACHES)
@pytest.mark.parametrize("solver", ["gradient", "combined"])
def test_solvers_reach_the_exact_distance_where_the_family_can(case, solver) -> None:
    name, curve, box = REACHES[case]
    manifold, _ = WHOLE[name]
    problem = ChartProblem(manifold, curve, box)
    ends = problem.sample_ends(20, np.random.default_rng(SEED))
    found = geodesics_between(ALL[name][solver], problem, ends.z_start, ends.z_goal)
    ratio = np.array([geodesic.length for geodesic in found]) / distance(
        manifold, ends.z_start, ends.z_goal
    )
    assert ratio.max() <= 1 + 1e-3
    assert {geodesic.status for geodesic in found} == {"converged"}


@pytest.mark.parametrize("near", [0.0, 1e-6, 1e-2])
@pytest.mark.parametrize("solver", ["gradient", "combined"])
@pytest.mark.parametrize("elevation", [0.0, 0.3, 0.6])
def test_antipodal_and_near_antipodal_pairs(elevation, solver, near) -> None:
    # half a great circle: many of one length where the pair is exactly antipodal
    problem = ChartProblem(Sphere(), PinnedPolynomial(2, 7), WHOLE["sphere"][1])
    start = np.array([[elevation, 0.4], [elevation, -1.0]])
    goal = np.stack([-start[:, 0] + near, start[:, 1] + math.pi - near], axis=-1)
    found = geodesics_between(ALL["sphere"][solver], problem, start, goal)
    exact = distance(Sphere(), start, goal)
    np.testing.assert_allclose([geodesic.length for geodesic in found], exact, rtol=1e-3)


@pytest.mark.parametrize("name", WHOLE)
@law
def test_solved_distances_satisfy_the_triangle_inequality(name, seed) -> None:
    manifold, box = WHOLE[name]
    curve = PinnedPolynomial(2, 5)
    problem = ChartProblem(manifold, curve, box)
    a, b, c = (problem.domain.sample(2, np.random.default_rng((seed, k))) * 0.6 for k in range(3))
    ab, bc, ac = (
        np.array([found.length for found in geodesics_between(GradientSolver(), problem, *pair)])
        for pair in ((a, b), (b, c), (a, c))
    )
    assert (ac <= (ab + bc) * (1 + 1e-3)).all(), "1e-3: what the family may miss"


@pytest.mark.parametrize("name", WHOLE)
def test_a_solved_curve_is_a_geodesic_both_ways(name) -> None:
    manifold, box = WHOLE[name]
    problem = ChartProblem(manifold, PinnedPolynomial(2, 5), box)
    ends = problem.sample_ends(10, np.random.default_rng(SEED))
    forth, back = (
        [found.length for found in geodesics_between(GradientSolver(), problem, *pair)]
        for pair in ((ends.z_start, ends.z_goal), (ends.z_goal, ends.z_start))
    )
    np.testing.assert_allclose(forth, back, rtol=1e-3)


def test_policy_search_is_a_solver_like_the_others(params, tmp_path) -> None:
    class Quiet:
        def log(self, step, metrics) -> None:
            pass

    small = params.geodesics.model_copy(update={"steps": 5120, "rollouts": 8})
    task = AnalyticTask("torus", curve_family(2, small), small, 0, tmp_path, nullcontext(Quiet()))
    result = run_analytic(task)
    solver = PolicySolver(result.policy.mean, small)
    problem = ChartProblem(Torus(), CUBIC, ChartBox((-1.0, -1.0), (1.0, 1.0)))
    ends = problem.sample_ends(4, np.random.default_rng(0))
    found = geodesics_between(solver, problem, ends.z_start, ends.z_goal)
    exact = distance(Torus(), ends.z_start, ends.z_goal)
    for geodesic, shortest in zip(found, exact, strict=True):
        assert geodesic.found
        assert shortest * (1 - 1e-6) <= geodesic.length <= geodesic.straight_length * (1 + 1e-12)
        np.testing.assert_array_equal(geodesic.points(np.array([0.0]))[0], geodesic.start)


def test_coincident_ends_have_length_zero_on_every_manifold() -> None:
    for name, (manifold, box) in WHOLE.items():
        problem = ChartProblem(manifold, CUBIC, box)
        points = box.sample(3, np.random.default_rng(0))
        image = points.copy()
        if name != "plane":
            image[1, 1] += 2 * math.pi
        for solver in ALL[name].values():
            found = geodesics_between(solver, problem, points, image)
            assert [geodesic.length for geodesic in found[:1]] == [0.0]
            assert found[0].status == "converged"
            assert np.isfinite([geodesic.length for geodesic in found]).all()
            assert max(geodesic.length for geodesic in found) < 1e-6


@pytest.mark.parametrize("name", WHOLE)
def test_bad_ends_are_refused_with_their_value(name) -> None:
    manifold, box = WHOLE[name]
    problem, good = ChartProblem(manifold, CUBIC, box), np.zeros((2, 2))
    bad = good.copy()
    bad[1, 0] = np.nan
    for solver in ALL[name].values():
        with pytest.raises(NonFiniteError, match=r"goal\[1, 0\] = nan"):
            geodesics_between(solver, problem, good, bad)
        with pytest.raises(
            GeometryError, match=r"shapes \(2, 3\) and \(2, 3\)|last axis must have 2"
        ):
            geodesics_between(solver, problem, np.zeros((2, 3)), np.zeros((2, 3)))
        with pytest.raises(GeometryError, match=r"\(2, 2\) and \(1, 2\)"):
            geodesics_between(solver, problem, good, good[:1])


def wall(gap: bool) -> GridManifold:
    """A flat square cut by a wall at the second coordinate 0, with or without a gap at one end."""
    blocked = torch.zeros(41, 41, dtype=torch.bool)
    blocked[:, 19:22] = True
    if gap:
        blocked[:8] = False
    values = torch.ones(41, 41, dtype=torch.float64)
    return GridManifold(values, (-1.0, -1.0), (1.0, 1.0), blocked)


def test_a_wall_is_walked_around() -> None:
    manifold, curve = wall(gap=True), PinnedSpline(2, 16)
    problem = ChartProblem(manifold, curve, ChartBox((-1.0, -1.0), (1.0, 1.0)))
    start, goal = np.array([[0.5, -0.5]]), np.array([[0.5, 0.5]])
    graph = GraphSolver.over_grid(manifold, (-1.0, -1.0), (1.0, 1.0), (41, 41))
    (found,) = geodesics_between(CombinedSolver(graph), problem, start, goal)
    assert found.found
    points = found.points(np.linspace(0, 1, 400))
    assert manifold.contains(torch.from_numpy(points)).all()
    # round the wall's corners at (-0.625, ±0.075) the shortest way is 2.555 long, that of the
    # grid's edges 2.689
    assert 2.555 < found.length < 2.689
    (alone,) = geodesics_between(GradientSolver(), replace(problem, curve=CUBIC), start, goal)
    assert alone.status == "not_found", "no cubic bends that far"


def test_what_a_wall_separates_is_not_connected() -> None:
    manifold = wall(gap=False)
    problem = ChartProblem(manifold, PinnedSpline(2, 4), ChartBox((-1.0, -1.0), (1.0, 1.0)))
    graph = GraphSolver.over_grid(manifold, (-1.0, -1.0), (1.0, 1.0), (41, 41))
    start, goal = np.array([[0.5, -0.5], [0.5, -0.5]]), np.array([[0.5, 0.5], [-0.5, -0.5]])
    for solver in (graph, CombinedSolver(graph)):
        apart, together = geodesics_between(solver, problem, start, goal)
        assert apart.status == "not_connected"
        assert not apart.found
        assert math.isnan(apart.length)
        assert np.isfinite(apart.phi).all()
        assert together.found
        assert together.length == pytest.approx(1.0, rel=1e-3)
    (through,) = geodesics_between(GradientSolver(), problem, start[:1], goal[:1])
    assert through.status == "not_found"


@pytest.mark.parametrize("shift", [0.0, 0.003, 0.006, 0.009, 0.012])
def test_a_long_edge_passes_no_thin_wall(shift) -> None:
    blocked = torch.zeros(201, 201, dtype=torch.bool)
    blocked[:, 100] = True
    values = torch.ones(201, 201, dtype=torch.float64)
    manifold = GridManifold(values, (-1.0, -1.0), (1.0, 1.0), blocked)
    problem = ChartProblem(manifold, PinnedSpline(2, 4), ChartBox((-1.0, -1.0), (1.0, 1.0)))
    graph = GraphSolver.over_grid(manifold, (-1.0, -1.0), (1.0, 1.0), (41, 41))
    start, goal = np.array([[0.5, -0.75 + shift]]), np.array([[0.5, 0.75 + shift]])
    (apart,) = geodesics_between(graph, problem, start, goal)
    assert apart.status == "not_connected"


def test_ends_in_a_blocked_cell_are_refused_with_their_place() -> None:
    manifold = wall(gap=True)
    problem = ChartProblem(manifold, CUBIC, ChartBox((-1.0, -1.0), (1.0, 1.0)))
    inside, blocked, beyond = (
        np.array([[0.5, -0.5]]),
        np.array([[0.5, 0.01]]),
        np.array([[0.5, 1.2]]),
    )
    with pytest.raises(OutsideError, match=r"goal\[0\] = \[0.5, 0.01\]"):
        geodesics_between(GradientSolver(), problem, inside, blocked)
    with pytest.raises(OutsideError, match=r"start\[0\] = \[0.5, 1.2\]"):
        geodesics_between(GradientSolver(), problem, beyond, inside)


def test_an_iteration_limit_is_said() -> None:
    problem = ChartProblem(Sphere(), CUBIC, WHOLE["sphere"][1])
    start, goal = np.array([[1.0, 0.0]]), np.array([[1.0, 2.0]])
    (short,) = geodesics_between(GradientSolver(iterations=1), problem, start, goal)
    (whole,) = geodesics_between(GradientSolver(), problem, start, goal)
    assert (short.status, whole.status) == ("iteration_limit", "converged")
    assert whole.length < short.length < short.straight_length
    assert short.iterations == 2, "one of each descent"


@dataclass(frozen=True)
class Holed:
    """The plane without a disc about its origin: nothing in its metric tells of the hole."""

    dim: int = 2
    ambient_dim: int = 2

    def embed(self, z):
        return z

    def metric(self, z):
        return torch.eye(2, dtype=z.dtype).expand(*z.shape, 2)

    def contains(self, z):
        return z.square().sum(-1) > 0.25


def test_what_a_graph_found_is_not_lost_to_a_descent_that_sees_no_border() -> None:
    manifold = Holed()
    problem = ChartProblem(manifold, PinnedSpline(2, 8), ChartBox((-1.5, -1.5), (1.5, 1.5)))
    points = problem.domain.sample(2000, np.random.default_rng(0))
    graph = GraphSolver.over_points(manifold, points[np.linalg.norm(points, axis=1) > 0.5])
    ends = np.array([[-1.0, 0.05]]), np.array([[1.0, 0.05]])
    (path,), (combined,) = (
        geodesics_between(solver, problem, *ends) for solver in (graph, CombinedSolver(graph))
    )
    assert path.found
    assert combined.found
    assert 2.0 < combined.length <= path.length * (1 + 1e-9)
    # two tangents of length √0.75 each and a sixth of the circle between them
    assert combined.length >= 2 * math.sqrt(0.75) + 0.5 * math.pi / 3 - 0.01


def test_a_policy_takes_the_near_image_of_a_goal(params) -> None:
    small = params.geodesics.model_copy(update={"rollouts": 2, "episode_steps": 1})
    problem = ChartProblem(Sphere(), CUBIC, WHOLE["sphere"][1])
    actor = Actor(observation_size(problem, small), (4,), CUBIC.coefficients)
    mean = TrainedPolicy(actor, []).mean
    (found,) = geodesics_between(
        PolicySolver(mean, small), problem, np.array([[0.0, 3.0]]), np.array([[0.0, -3.0]])
    )
    assert found.length == pytest.approx(2 * math.pi - 6, rel=1e-6)
    assert found.straight_length == pytest.approx(2 * math.pi - 6, rel=1e-6)
    with pytest.raises(
        GeometryError, match="the policy changes 4 coefficients: must be those of the curve, 8"
    ):
        PolicySolver(mean, small).solve(
            replace(problem, curve=PinnedPolynomial(2, 5)), problem.ends(*np.zeros((2, 1, 2)))
        )


@dataclass(frozen=True)
class Disc:
    """A metric that is real on the unit disc only."""

    dim: int = 2

    def metric(self, z):
        factor = (1 - z.square().sum(-1)).sqrt()
        return factor[..., None, None] * torch.eye(2, dtype=z.dtype)


def test_a_metric_that_is_not_finite_gives_no_short_curves() -> None:
    problem = ChartProblem(Disc(), CUBIC, ChartBox((-1.0, -1.0), (1.0, 1.0)))
    inside, outside = np.array([[0.1, 0.1]]), np.array([[2.0, 2.0]])
    with np.errstate(over="raise"):
        (lost,) = geodesics_between(GradientSolver(), problem, inside, outside)
    assert lost.status == "not_found"
    assert math.isnan(lost.length)
    (found,) = geodesics_between(GradientSolver(), problem, inside, -inside)
    assert found.found
    with pytest.raises(NonFiniteError, match="length"):
        curve_length(
            Disc(),
            Curves(
                CUBIC,
                torch.zeros(4, dtype=torch.float64),
                *torch.tensor([[0.1, 0.1], [2.0, 2.0]]).double(),
            ),
        )


def test_a_graph_has_no_edges_where_the_metric_is_not_finite() -> None:
    graph = GraphSolver.over_grid(Disc(), (-1.2, -1.2), (1.2, 1.2), (25, 25))
    problem = ChartProblem(Disc(), CUBIC, ChartBox((-1.0, -1.0), (1.0, 1.0)))
    start, goal = np.array([[0.1, 0.1], [0.1, 0.1]]), np.array([[-0.5, 0.4], [1.1, 1.1]])
    for solver in (graph, CombinedSolver(graph)):
        inside, outside = geodesics_between(solver, problem, start, goal)
        assert inside.found
        assert outside.status == "not_connected"


def test_a_straight_line_over_a_hill_is_left() -> None:
    @dataclass(frozen=True)
    class Hill:
        dim: int = 2
        ambient_dim: int = 3

        def embed(self, z):
            return torch.cat([z, 1.5 * torch.exp(-2.0 * z.square().sum(-1, keepdim=True))], dim=-1)

        def metric(self, z):
            return pullback_metric(self.embed, z)

    problem = ChartProblem(Hill(), PinnedSpline(2, 4), ChartBox((-1.5, -1.5), (1.5, 1.5)))
    (found,) = geodesics_between(
        GradientSolver(starts=1), problem, np.array([[-1.0, 0.0]]), np.array([[1.0, 0.0]])
    )
    assert found.length < 0.85 * found.straight_length


@pytest.mark.parametrize("settings", [{"starts": 0}, {"iterations": 0}])
def test_a_solver_without_work_is_refused(settings) -> None:
    with pytest.raises(GeometryError, match="must be at least 1"):
        GradientSolver(**settings)


def test_a_graph_of_bad_points_is_refused() -> None:
    with pytest.raises(NonFiniteError, match=r"points\[1, 0\] = inf"):
        GraphSolver.over_points(Sphere(), np.array([[0.0, 0.0], [np.inf, 0.0]]))
    with pytest.raises(GeometryError, match="dim = 3: a grid is for 2"):
        GraphSolver.over_grid(Plane(3), (0, 0), (1, 1), (5, 5))
    with pytest.raises(OutsideError):
        GraphSolver.over_points(wall(gap=True), np.array([[0.0, 0.0]]))


def test_solving_many_pairs_at_once_gives_what_one_at_a_time_does() -> None:
    problem = ChartProblem(Torus(), CUBIC, WHOLE["torus"][1])
    ends = problem.sample_ends(6, np.random.default_rng(1))
    for solver in (GradientSolver(starts=1), ALL["torus"]["combined"]):
        together = geodesics_between(solver, problem, ends.z_start, ends.z_goal)
        one = [
            geodesics_between(solver, problem, ends.z_start[k : k + 1], ends.z_goal[k : k + 1])[0]
            for k in range(6)
        ]
        np.testing.assert_allclose([a.length for a in together], [b.length for b in one], rtol=1e-6)


def test_time_is_shared_among_the_queries_of_a_batch() -> None:
    problem = ChartProblem(Sphere(), CUBIC, WHOLE["sphere"][1])
    ends = problem.sample_ends(20, np.random.default_rng(1))
    began = time.perf_counter()
    found = geodesics_between(GradientSolver(), problem, ends.z_start, ends.z_goal)
    spent = time.perf_counter() - began
    assert 0.5 * spent <= sum(geodesic.time_s for geodesic in found) <= spent
