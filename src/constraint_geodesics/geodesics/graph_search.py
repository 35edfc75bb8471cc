"""Geodesics by a shortest path on a graph over points of the manifold: data, or a grid for N = 2.

The path is fitted with one curve of the problem's family; `CombinedSolver` then lets it slide down
to a geodesic.  Among walls that family may not follow the path: there a spline with as many pieces
as the path has steps does (`taut`).
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from constraint_geodesics.geodesics.gradient import GradientSolver
from constraint_geodesics.geodesics.images import nearest_image, with_goals_bits
from constraint_geodesics.geodesics.problem import ChartProblem, Ends, Geodesic
from constraint_geodesics.geodesics.solver import LENGTH_TOLERANCE, Candidates, Work, shortest_of
from constraint_geodesics.geodesics.taut import LOOKED_UP, Corners, Taut, drawn_along, pulled_along
from constraint_geodesics.geometry.curves import CurveFamily, Curves, PinnedPolynomial
from constraint_geodesics.geometry.graph import nearest_neighbour_edges, shortest_path
from constraint_geodesics.geometry.length import estimate_length
from constraint_geodesics.geometry.manifold import (
    BoundedManifold,
    EmbeddedManifold,
    GeometryError,
    Manifold,
    WalledManifold,
    require_inside,
)

FITTED = 129
"""Points of a graph's path that a curve is fitted to."""
ON_EDGE = 65
"""Points of an edge that are looked up to tell whether it stays inside a bounded manifold."""
ROOM = 0.05
"""Distance to the walls that an edge keeps, in steps: one that touches a corner is no way."""
ROUNDING = 1e-9
"""What a distance to the walls may be off by rounding, in steps."""
EDGES = 8192
"""Edges looked up at once."""
NEAR_WALLS = 16
"""Nodes of a grid that an end among walls is joined to: the nearest may be blocked."""
REACH = 2
"""Rows and columns that a grid's edges lead over at most: with 1, to 8 neighbours, a path is up to
8 % too long, with 2, to 16, up to 3 %.
"""
Ways = dict[int, Float[np.ndarray, "k N"]]
"""Corners of a path for the queries that have one."""


@dataclass(frozen=True)
class GraphSolver:
    """Shortest paths along the edges of a graph whose nodes (n, N) lie in the chart.

    edges: (m, 2) pairs i < j.  lengths: (m,) on the manifold, of the straight chart lines the
    shorter way round.
    links: nodes that an end of a query is joined to.
    Build it by `over_points` or `over_grid`.
    """

    manifold: Manifold
    nodes: Float[np.ndarray, "n N"]
    edges: Int[np.ndarray, "m 2"]
    lengths: Float[np.ndarray, "m"]
    links: int

    @classmethod
    def over_points(
        cls, manifold: Manifold, points: Float[np.ndarray, "n N"], neighbours: int = 12
    ) -> "GraphSolver":
        """Nearest-neighbour graph: neighbours in the embedding where there is one, in the chart
        otherwise.

        Raises GeometryError on a wrong shape or fewer than one neighbour, NonFiniteError or
        OutsideError with the first point that does not belong to the manifold.
        """
        require_inside(manifold, torch.from_numpy(points), "points")
        edges = nearest_neighbour_edges(_position(manifold, points), neighbours)
        return cls._with_edges(manifold, points, edges, neighbours)

    @classmethod
    def over_grid(
        cls,
        manifold: Manifold,
        lower: Sequence[float],
        upper: Sequence[float],
        shape: tuple[int, int],
        reach: int = REACH,
    ) -> "GraphSolver":
        """Regular grid of a 2-D chart, every node joined to those around it that are up to `reach`
        rows and columns away, to 16 by default; its borders are joined to nothing, so that a
        periodic chart is better served by `over_points`.  Raises GeometryError unless N = 2.
        """
        if manifold.dim != 2:
            raise GeometryError(f"dim = {manifold.dim}: a grid is for 2; take over_points")
        axes = [
            np.linspace(low, high, count)
            for low, high, count in zip(lower, upper, shape, strict=True)
        ]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        links = NEAR_WALLS if isinstance(manifold, BoundedManifold) else 4
        return cls._with_edges(manifold, points, neighbours_on_grid(shape, reach), links)

    @classmethod
    def _with_edges(
        cls,
        manifold: Manifold,
        points: Float[np.ndarray, "n N"],
        edges: Int[np.ndarray, "m 2"],
        links: int,
    ) -> "GraphSolver":
        offsets = nearest_image(manifold, points[edges[:, 1]] - points[edges[:, 0]])
        lengths = _straight_lengths(manifold, points[edges[:, 0]], offsets)
        kept = np.isfinite(lengths)
        return cls(manifold, points, edges[kept], lengths[kept], links)

    def solve(self, problem: ChartProblem, ends: Ends) -> list[Geodesic]:
        """The shortest path of the graph between each start and goal, as the nearest curve of the
        problem's family.

        Among walls (WalledManifold) a path that the family cannot follow is drawn as a spline of
        many pieces, as `curve` of the record says.
        "not_connected" where there is no path, "not_found" where no curve tried follows it on the
        manifold.
        """
        return _answers(self, problem, ends, None)

    def candidates(self, problem: ChartProblem, ends: Ends) -> Candidates:
        """Fitted curves of the queries that have a path."""
        return self.fits(problem, ends, self.ways(ends))

    def ways(self, ends: Ends) -> Ways:
        """Corners of the shortest paths, of the queries that have one."""
        paths = map(self.path, ends.z_start, ends.z_goal)
        return {query: path for query, path in enumerate(paths) if path is not None}

    def fits(self, problem: ChartProblem, ends: Ends, ways: Ways) -> Candidates:
        """The paths as curves of the problem's family."""
        found = np.array(list(ways), dtype=np.int64)
        fits = [fitted(problem.curve, w, _sides(problem.manifold, w)) for w in ways.values()]
        phi = np.reshape(fits, (-1, problem.curve.coefficients))
        goals = np.reshape([way[-1] for way in ways.values()], (-1, problem.curve.dim))
        return Candidates(found, phi, ends.z_start[found], goals)

    def path(
        self, start: Float[np.ndarray, "N"], goal: Float[np.ndarray, "N"]
    ) -> Float[np.ndarray, "k N"] | None:
        """Corners of the shortest path from start to an image of goal; None if not joined.

        A coordinate of the last that is no turn away from the goal's has its bits.
        """
        n = len(self.nodes)
        tails, heads, lengths = self._links(start, goal)
        edges = np.concatenate([self.edges, np.stack([tails, heads], axis=-1)])
        route = shortest_path(n + 2, edges, np.concatenate([self.lengths, lengths]), n, n + 1).nodes
        if not len(route):
            return None
        points = np.concatenate([self.nodes, start[None], goal[None]])[route]
        steps = nearest_image(self.manifold, np.diff(points, axis=0))
        corners = start + np.concatenate([np.zeros((1, len(start))), np.cumsum(steps, axis=0)])
        corners[-1] = with_goals_bits(corners[-1], goal)
        return corners

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(_position(self.manifold, self.nodes))

    def _links(
        self, start: Float[np.ndarray, "N"], goal: Float[np.ndarray, "N"]
    ) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"], Float[np.ndarray, "k"]]:
        """Edges from both ends to the nodes near them and to each other: tails, heads, lengths."""
        n, count = len(self.nodes), min(self.links, len(self.nodes))
        points = np.stack([start, goal])
        places = np.concatenate([self.nodes, points])
        _, near = self._tree.query(_position(self.manifold, points), k=range(1, count + 1))
        tails = np.concatenate([np.repeat([n, n + 1], count), [n]])
        heads = np.concatenate([near.ravel(), [n + 1]])
        offsets = nearest_image(self.manifold, places[heads] - places[tails])
        lengths = _straight_lengths(self.manifold, places[tails], offsets)
        kept = np.isfinite(lengths)
        return tails[kept], heads[kept], lengths[kept]


@dataclass(frozen=True)
class CombinedSolver:
    """A graph's path made a geodesic by the gradient; the straight line competes.

    The graph decides what is connected.
    """

    graph: GraphSolver
    gradient: GradientSolver = field(default_factory=lambda: GradientSolver(starts=1))

    def solve(self, problem: ChartProblem, ends: Ends) -> list[Geodesic]:
        """The shortest minimum from the graph's path and from the gradient's own starts.

        Among walls (WalledManifold) it is the path pulled tight as a spline of many pieces, as
        `curve` of the record says, unless the path in the problem's family is as short.
        """
        return _answers(self.graph, problem, ends, self.gradient)


def _answers(
    graph: GraphSolver, problem: ChartProblem, ends: Ends, gradient: GradientSolver | None
) -> list[Geodesic]:
    began = time.perf_counter()
    ways = graph.ways(ends)
    results = [
        Geodesic.nothing("not_connected", problem.curve, start, goal)
        for start, goal in zip(ends.z_start, ends.z_goal, strict=True)
    ]
    if not ways:
        return results
    fitted = graph.fits(problem, ends, ways)
    own, among = replace(fitted, query=np.arange(len(ways))), ends[fitted.query]
    manifold = problem.manifold
    if gradient is None or isinstance(manifold, WalledManifold):
        work = Work(1, len(ways), time.perf_counter() - began)
        found = shortest_of(problem, among, own, np.ones(len(ways), dtype=bool), work)
    else:
        simpler = gradient.simpler(problem, among)
        starts = Candidates.join([own, *simpler, gradient.candidates(problem, among)])
        given = Candidates.join([own, *simpler])
        found = gradient.refine(problem, among, starts, given=given, began=began)
    if isinstance(manifold, WalledManifold):
        follow = _drawn if gradient is None else _tightened
        found = [follow(manifold, *pair) for pair in zip(found, ways.values(), strict=True)]
    for query, result in zip(ways, found, strict=True):
        results[query] = result
    return results


def _drawn(manifold: WalledManifold, fit: Geodesic, way: Corners) -> Geodesic:
    """The fitted curve where it stays on the manifold, a spline drawn along the path otherwise."""
    began = time.perf_counter()
    if fit.found:
        return fit
    return _with_spline(manifold, fit, drawn_along(manifold, way), began)


def _tightened(manifold: WalledManifold, fit: Geodesic, way: Corners) -> Geodesic:
    """The path pulled tight, or the fitted curve where that is as short."""
    began = time.perf_counter()
    taut = _with_spline(manifold, fit, pulled_along(manifold, way), began)
    if not fit.found or not fit.length <= taut.length * (1 + LENGTH_TOLERANCE):
        return taut
    return replace(taut, **{name: getattr(fit, name) for name in ("curve", "phi", "length")})


def _with_spline(
    manifold: WalledManifold, fit: Geodesic, spline: Taut | None, began: float
) -> Geodesic:
    """The record of a fitted curve with a spline in its place; "not_found" without one."""
    if spline is None:
        spent = fit.time_s + time.perf_counter() - began
        return replace(fit, status="not_found", length=np.nan, time_s=spent)
    with torch.no_grad():
        measured = estimate_length(manifold, spline.curves(), LENGTH_TOLERANCE)
    return replace(
        fit,
        status="converged" if spline.converged else "iteration_limit",
        curve=spline.curve,
        phi=spline.phi,
        length=float(measured.length),
        iterations=fit.iterations + spline.steps,
        evaluations=fit.evaluations + spline.steps + 1,
        time_s=fit.time_s + time.perf_counter() - began,
    )


def neighbours_on_grid(shape: tuple[int, int], reach: int = REACH) -> Int[np.ndarray, "m 2"]:
    """Every node of a grid, numbered row by row, and those up to `reach` rows and columns away that
    come after it and that no other node lies before.
    """
    numbers = np.arange(shape[0] * shape[1]).reshape(shape)
    steps = product(range(reach + 1), range(-reach, reach + 1))
    pairs = []
    for down, right in steps:
        if math.gcd(down, right) != 1 or (down, right) == (0, -1):
            continue
        near = numbers[: shape[0] - down, max(0, -right) : shape[1] - max(0, right)]
        far = numbers[down:, max(0, right) : shape[1] + min(0, right)]
        pairs.append(np.stack([near.ravel(), far.ravel()], axis=-1))
    return np.sort(np.concatenate(pairs), axis=1)


def fitted(
    curve: CurveFamily, corners: Float[np.ndarray, "k N"], lengths: Float[np.ndarray, "k-1"]
) -> Float[np.ndarray, "p"]:
    """Coefficients of the curve nearest to a polygon with sides of these lengths at constant
    speed.
    """
    passed = np.concatenate([[0.0], np.cumsum(lengths)])
    t = np.linspace(0.0, 1.0, FITTED)
    points = np.stack([np.interp(t * passed[-1], passed, column) for column in corners.T], axis=-1)
    points[0], points[-1] = corners[0], corners[-1]
    return curve.fit(torch.from_numpy(points), torch.from_numpy(t)).numpy()


def _sides(manifold: Manifold, corners: Float[np.ndarray, "k N"]) -> Float[np.ndarray, "k-1"]:
    """Lengths of a polygon's sides; 0 where one leaves the manifold."""
    lengths = _straight_lengths(manifold, corners[:-1], np.diff(corners, axis=0))
    return np.where(np.isfinite(lengths), lengths, 0.0)


def _straight_lengths(
    manifold: Manifold, start: Float[np.ndarray, "m N"], offset: Float[np.ndarray, "m N"]
) -> Float[np.ndarray, "m"]:
    """Length of straight chart lines; inf where one leaves the manifold or its metric."""
    parts = zip(
        torch.from_numpy(start).split(EDGES), torch.from_numpy(offset).split(EDGES), strict=True
    )
    with torch.no_grad():
        lengths = [_lengths_of_lines(manifold, first, first + step) for first, step in parts]
    return torch.cat(lengths).numpy()


def _lengths_of_lines(manifold: Manifold, first: Tensor, last: Tensor) -> Tensor:
    line = PinnedPolynomial(manifold.dim, 1)
    lines = Curves(line, first.new_zeros(len(first), 0), first, last)
    lengths = estimate_length(manifold, lines).length
    if not isinstance(manifold, BoundedManifold):
        return lengths
    count = ON_EDGE
    if isinstance(manifold, WalledManifold):  # a long line passes thin walls between few points
        longest = float(torch.linalg.vector_norm(last - first, dim=-1).max())
        count = max(count, math.ceil(LOOKED_UP * longest / manifold.step) + 1)
    t = torch.linspace(0.0, 1.0, count, dtype=first.dtype)[:, None]
    points = (1 - t) * first[:, None] + t * last[:, None]
    inside = manifold.contains(points).all(-1)
    if isinstance(manifold, WalledManifold):
        inside &= _have_room(manifold, points)
    return torch.where(inside, lengths, torch.inf)


def _have_room(manifold: WalledManifold, points: Float[Tensor, "m T N"]) -> Bool[Tensor, "m"]:
    """Whether lines keep ROOM to the walls, or what their ends have where that is less."""
    clear = manifold.clearance(points)
    ends = torch.minimum(clear[:, 0], clear[:, -1]).clamp(max=ROOM)
    return clear.amin(-1) >= ends - ROUNDING


def _position(manifold: Manifold, points: Float[np.ndarray, "n N"]) -> Float[np.ndarray, "n A"]:
    """Where neighbours are looked for."""
    if not isinstance(manifold, EmbeddedManifold):
        return points
    with torch.no_grad():
        return manifold.embed(torch.from_numpy(points)).double().numpy()
