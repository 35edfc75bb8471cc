"""Shortest paths over a graph in the latent space: what most work on geodesics of learned manifolds
does.

In a latent plane the graph is a regular grid whose edges have the lengths of the pullback metric
(Beik-Mohammadi et al., Learning Riemannian manifolds for geodesic motion skills, R:SS 2021), of
which those nodes are kept that satisfy the constraint within the grid's resolution; in more
dimensions it is the nearest-neighbour graph over configurations on the constraint
(`constraints/submanifold.py`), with the same lengths.
"""

import itertools
import time
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from constraint_geodesics.constraints.constraint import Constraint
from constraint_geodesics.constraints.projection import Retraction
from constraint_geodesics.geodesics.graph_search import KNIGHT
from constraint_geodesics.geodesics.problem import Ends, LearnedProblem
from constraint_geodesics.geometry.curves import PinnedSpline
from constraint_geodesics.geometry.errors import GeometryError
from constraint_geodesics.geometry.graph import OUTSIDE, shortest_path
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.lift import allowed_steps, corrected, retracted
from constraint_geodesics.learning.submanifold import (
    Free,
    GraphSubmanifold,
    GridSubmanifold,
    Surface,
    check_edges,
)
from constraint_geodesics.peers.latent_geodesic import (
    answer,
    executable,
    is_clear,
    retracted_problem,
    turned_away,
    without_path,
)
from constraint_geodesics.problem import SATISFIED, PlanningProblem, Solution

EDGE_CHORDS = 8
"""Chords that the length of a straight latent line is measured by; between two neighbours of a grid
one does.
"""
LOOKED_AT = 129
"""Points at which a curve over the grid is looked at for what is wrong with it."""
BLOCKED_CELLS = 3.0
"""Radius around a place where a curve fails that the next search avoids, in cells of the grid."""
TRIED, ENOUGH = 32, 4
"""Nodes of a graph that an end is tried to be joined to, the nearest first, and how many are
enough.
"""
EDGE_SPACING = 0.1
"""Distance of the points of a lifted edge at most [rad]."""
LEAST_GAIN = 1e-3
"""What a shortcut must save [rad]."""


@dataclass(frozen=True)
class GridSearch:
    """Dijkstra over a grid of the latent plane, a spline through the path, its ends corrected, then
    retracted.

    Where that curve jumps, leaves the limits or collides, the nodes around the place are blocked
    and the search goes on without them.

    chart: a manifold of two latent dimensions; grid: its nodes with the inclusion map of
    `constraint`.
    retracted: whether every point of the curve is retracted onto the constraint.  Without, it is
    what decoder and end correction make of it, which is a path only where the constraint holds by
    itself.
    inclusion_weight: an edge costs its length times 1 + this weight times the mean of ι_C at its
    nodes; inf admits no edges outside the sub-manifold but those that join an end to it; 0 leaves
    the constraint to the retraction.
    segments: of the spline.  rounds: searches at most.
    links: nodes that an end is joined to, beside the nearest of every component.
    Raises GeometryError unless the chart has two dimensions, and if its grid is not on it.
    """

    chart: LearnedManifold
    constraint: Constraint
    grid: GridSubmanifold
    retracted: bool = True
    inclusion_weight: float = 0.0
    segments: int = 8
    rounds: int = 20
    links: int = 8
    name: str = "latent grid"
    _nodes: Float[np.ndarray, "n 2"] = field(init=False, repr=False, compare=False)
    _edges: Int[np.ndarray, "m 2"] = field(init=False, repr=False, compare=False)
    _lengths: Float[np.ndarray, "m"] = field(init=False, repr=False, compare=False)
    _inclusion: Float[np.ndarray, "m"] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.chart.dim != 2:
            raise GeometryError(f"dim = {self.chart.dim}: a grid is for 2; take LatentGraphSearch")
        axes = (self.grid.first_axis, self.grid.second_axis)
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        edges = neighbours_on_grid(self.grid.labels.shape)
        places = self.chart.embed_points(nodes).astype(np.float64)
        lengths = np.linalg.norm(places[edges[:, 0]] - places[edges[:, 1]], axis=1)
        inclusion = self.grid.inclusion.ravel()[edges].mean(axis=1)
        for name, values in {
            "_nodes": nodes,
            "_edges": edges,
            "_lengths": lengths,
            "_inclusion": inclusion,
        }.items():
            object.__setattr__(self, name, values)

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """The path over the grid, if it can be made one that is executed; the seed plays no
        part.
        """
        began = time.perf_counter()
        refused = turned_away(problem, self.chart)
        if refused is not None:
            return without_path(problem, *refused, began)
        if not same_constraint(problem.manifold.constraint, self.constraint):
            return without_path(
                problem, "not_applicable", "the grid is that of another constraint", began
            )
        learned = retracted_problem(self.chart, problem.manifold, PinnedSpline(2, self.segments))
        if not self.retracted:
            learned = replace(learned, retract=False)
        ends = learned.ends(problem.start[None], problem.goal[None])
        joints, rounds, why = self._searched(problem, learned, ends)
        if joints is None:
            return without_path(problem, "not_found", why, began, rounds)
        return answer(joints, problem, began, rounds)

    def _searched(
        self, problem: PlanningProblem, learned: LearnedProblem, ends: Ends
    ) -> tuple[Float[np.ndarray, "T D"] | None, int, str]:
        """Rows of the first path found, the searches it took, and why there is none."""
        radius = BLOCKED_CELLS * max(
            np.diff(axis)[0] for axis in (self.grid.first_axis, self.grid.second_axis)
        )
        open_nodes, costs = self.grid.labels.ravel() != OUTSIDE, self._lengths
        if np.isfinite(self.inclusion_weight):
            open_nodes, costs = (
                np.full_like(open_nodes, True),
                costs * (1.0 + self.inclusion_weight * self._inclusion),
            )
        why = "the grid does not join the ends"
        for searched in range(1, self.rounds + 1):
            corners = self._way(ends, open_nodes, costs)
            if corners is None:
                return None, searched, why
            phi = fitted(learned, corners)
            rows = self._rows(problem, learned, phi, ends)
            if not isinstance(rows, str):
                return rows, searched, ""
            why = rows
            place = self._failure(problem, learned, phi, ends)
            open_nodes = open_nodes & (np.linalg.norm(self._nodes - place, axis=1) > radius)
        return None, self.rounds, why

    def _way(
        self, ends: Ends, open_nodes: Bool[np.ndarray, "n"], costs: Float[np.ndarray, "m"]
    ) -> Float[np.ndarray, "k 2"] | None:
        """Corners of the shortest way in the plane; None where the open nodes do not join the
        ends.
        """
        n, points = len(self._nodes), np.concatenate([ends.z_start, ends.z_goal])
        joined = np.flatnonzero(open_nodes)
        if not len(joined):
            return None
        kept = open_nodes[self._edges].all(axis=1)
        tails, heads = _links(
            self._nodes[joined], self.grid.labels.ravel()[joined], points, self.links
        )
        heads = joined[heads]
        lengths = straight_lengths(self.chart, points[tails], self._nodes[heads])
        edges = np.concatenate([self._edges[kept], np.stack([heads, n + tails], axis=1)])
        route = shortest_path(n + 2, edges, np.concatenate([costs[kept], lengths]), n, n + 1).nodes
        return np.concatenate([self._nodes, points])[route] if len(route) else None

    def _rows(
        self,
        problem: PlanningProblem,
        learned: LearnedProblem,
        phi: Float[np.ndarray, "p"],
        ends: Ends,
    ) -> Float[np.ndarray, "T D"] | str:
        """Rows of a curve as they are executed, or why it is no path."""
        path = learned.path(phi, ends, EDGE_SPACING)
        violation = problem.manifold.violation(path).max()
        if violation > SATISFIED:
            return f"the path leaves the constraint by {violation:.3g} rad or m"
        rows = executable(problem.manifold, path)
        if rows is None:
            return "the path jumps or leaves the limits"
        return rows if is_clear(problem, rows) else "the path collides"

    def _failure(
        self,
        problem: PlanningProblem,
        learned: LearnedProblem,
        phi: Float[np.ndarray, "p"],
        ends: Ends,
    ) -> Float[np.ndarray, "2"]:
        """Where in the plane a curve first fails to be a path; halfway where no point looked at
        shows it.
        """
        t = np.linspace(0.0, 1.0, LOOKED_AT)
        z = learned.latent_points(phi[None], ends, t)
        retraction = Retraction() if self.retracted else None
        line = corrected(self.chart.decode(z), t, ends.q_start, ends.q_goal)
        joints = retracted(problem.manifold, line, retraction).joints
        jumps = np.linalg.norm(np.diff(joints[0], axis=0), axis=1) > allowed_steps(joints, t)[0]
        wrong = np.concatenate([jumps, [False]]) | (
            problem.manifold.robot.limit_distance(joints[0]) < 0.0
        )
        wrong |= problem.manifold.violation(joints[0]) > SATISFIED
        if not wrong[1:-1].any():
            wrong = np.array([not problem.is_free(q) for q in joints[0]])
        places = np.flatnonzero(wrong[1:-1]) + 1
        return z[0, places[0] if len(places) else LOOKED_AT // 2]


@dataclass(frozen=True)
class LatentGraphSearch:
    """Dijkstra over a sub-manifold's graph with the lengths of the latent metric, then shortcuts;
    in any dimension.

    An edge is the straight latent line between two nodes, its ends corrected and every point
    retracted.  The graph's own edges were checked when it was made; those of a path are checked
    again for the workcell of the problem, and a path with an edge that collides is given up for the
    next one.  Shortcuts join two random points of the path by such a line where that is shorter.

    graph: that of `constraint` on this chart.  shortcuts: tried; none leaves the graph's own path.
    rounds: searches at most.
    """

    chart: LearnedManifold
    constraint: Constraint
    graph: GraphSubmanifold
    shortcuts: int = 100
    rounds: int = 200
    edge_points: int = 12
    name: str = "latent graph"
    _lengths: Float[np.ndarray, "m"] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        first, last = (self.graph.latent[self.graph.edges[:, k]] for k in (0, 1))
        object.__setattr__(self, "_lengths", straight_lengths(self.chart, first, last))

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """The shortest way over the graph that is free, shortened at random places that depend on
        the seed.
        """
        began = time.perf_counter()
        refused = turned_away(problem, self.chart)
        if refused is not None:
            return without_path(problem, *refused, began)
        if not same_constraint(problem.manifold.constraint, self.constraint):
            return without_path(
                problem, "not_applicable", "the graph is that of another constraint", began
            )
        points, searched = self._searched(problem)
        rows = None
        if points is not None:
            shorter = self._shortened(problem, points, np.random.default_rng(seed))
            for candidate in (shorter, points):
                drawn = executable(problem.manifold, candidate)
                if drawn is not None and is_clear(problem, drawn):
                    rows = drawn
                    break
        return answer(rows, problem, began, searched)

    def _searched(self, problem: PlanningProblem) -> tuple[Float[np.ndarray, "k D"] | None, int]:
        """Points of the shortest way whose edges are free, and the searches it took."""
        n, ends = len(self.graph.joints), np.stack([problem.start, problem.goal])
        joints = np.concatenate([self.graph.joints, ends])
        latent = np.concatenate([self.graph.latent, self.chart.encode(ends)])
        links = np.concatenate(
            [self._joined(problem, joints, n + k) for k in (0, 1)] + [[[n, n + 1]]]
        )
        edges = np.concatenate([self.graph.edges, links]).astype(np.int64)
        link_lengths = straight_lengths(self.chart, latent[links[:, 0]], latent[links[:, 1]])
        lengths = np.concatenate([self._lengths, link_lengths])
        numbers = {(int(a), int(b)): row for row, (a, b) in enumerate(edges)}
        kept = np.ones(len(edges), dtype=bool)
        for searched in range(1, self.rounds + 1):
            route = shortest_path(n + 2, edges[kept], lengths[kept], n, n + 1).nodes
            if not len(route):
                return None, searched
            pieces = [
                self._line(problem, joints[a], joints[b]) for a, b in itertools.pairwise(route)
            ]
            for a, b, piece in zip(route[:-1], route[1:], pieces, strict=True):
                kept[numbers[min(a, b), max(a, b)]] = piece is not None
            whole = [piece for piece in pieces if piece is not None]
            if len(whole) == len(pieces):
                return np.concatenate([whole[0][:1], *(piece[1:] for piece in whole)]), searched
        return None, self.rounds

    def _joined(
        self, problem: PlanningProblem, joints: Float[np.ndarray, "n D"], end: int
    ) -> Int[np.ndarray, "k 2"]:
        """Edges from an end to nodes near it that hold."""
        nodes = len(self.graph.joints)
        near = np.argsort(np.linalg.norm(joints[:nodes] - joints[end], axis=1), kind="stable")[
            :TRIED
        ]
        surface = Surface(self.chart, problem.manifold, _all_free(problem))
        found: list[int] = []
        for block in np.array_split(near, max(len(near) // 8, 1)):
            starts = np.broadcast_to(joints[end], (len(block), joints.shape[1]))
            lengths = check_edges(surface, starts, joints[block], self.edge_points)
            found += [int(node) for node in block[np.isfinite(lengths)]]
            if len(found) >= ENOUGH:
                break
        return np.array([(node, end) for node in found], dtype=np.int64).reshape(-1, 2)

    def _line(
        self, problem: PlanningProblem, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"]
    ) -> Float[np.ndarray, "k D"] | None:
        """Points of the lifted latent line between two configurations; None if it is no path or
        touches something.
        """
        t = np.linspace(0.0, 1.0, int(np.ceil(np.linalg.norm(goal - start) / EDGE_SPACING)) + 2)
        z_start, z_goal = self.chart.encode(np.stack([start, goal]))
        z = (1.0 - t[:, None]) * z_start + t[:, None] * z_goal
        line = corrected(self.chart.decode(z[None]), t, start[None], goal[None])
        lifted = retracted(problem.manifold, line, Retraction())
        joints = lifted.joints[0]
        longest = np.linalg.norm(np.diff(joints, axis=0), axis=1).max()
        if longest > 3.0 * EDGE_SPACING or lifted.violation.max() > SATISFIED:
            return None
        if problem.manifold.robot.limit_distance(joints[1:-1]).min(initial=np.inf) < 0.0:
            return None
        return joints if all(problem.is_free(q) for q in joints[1:-1]) else None

    def _shortened(
        self, problem: PlanningProblem, points: Float[np.ndarray, "k D"], rng: np.random.Generator
    ) -> Float[np.ndarray, "k D"]:
        for _ in range(self.shortcuts):
            if len(points) < 3:
                break
            first, last = np.sort(rng.integers(len(points), size=2))
            if last - first < 2:
                continue
            way = np.linalg.norm(np.diff(points[first : last + 1], axis=0), axis=1).sum()
            if np.linalg.norm(points[last] - points[first]) > way - LEAST_GAIN:
                continue
            line = self._line(problem, points[first], points[last])
            if (
                line is not None
                and np.linalg.norm(np.diff(line, axis=0), axis=1).sum() < way - LEAST_GAIN
            ):
                points = np.concatenate([points[:first], line, points[last + 1 :]])
        return points


def neighbours_on_grid(shape: tuple[int, int]) -> Int[np.ndarray, "m 2"]:
    """Every node of a grid, numbered row by row, and those of the 16 around it that come after
    it.
    """
    numbers = np.arange(shape[0] * shape[1]).reshape(shape)
    pairs = []
    for down, right in KNIGHT:
        near = numbers[: shape[0] - down, max(0, -right) : shape[1] - max(0, right)]
        far = numbers[down:, max(0, right) : shape[1] + min(0, right)]
        pairs.append(np.stack([near.ravel(), far.ravel()], axis=-1))
    return np.sort(np.concatenate(pairs), axis=1)


def straight_lengths(
    chart: LearnedManifold, first: Float[np.ndarray, "m N"], last: Float[np.ndarray, "m N"]
) -> Float[np.ndarray, "m"]:
    """Lengths of straight latent lines on the manifold, eq. 2, as sums of EDGE_CHORDS chords of the
    embedding.
    """
    t = np.linspace(0.0, 1.0, EDGE_CHORDS + 1)[:, None]
    places = chart.embed_points((1.0 - t) * first[:, None] + t * last[:, None]).astype(np.float64)
    return np.linalg.norm(np.diff(places, axis=1), axis=-1).sum(axis=1)


def fitted(learned: LearnedProblem, corners: Float[np.ndarray, "k N"]) -> Float[np.ndarray, "p"]:
    """Coefficients of the curve nearest to a polygon that is run through at the manifold's constant
    speed.
    """
    passed = np.concatenate(
        [[0.0], np.cumsum(straight_lengths(learned.chart, corners[:-1], corners[1:]))]
    )
    t = np.linspace(0.0, 1.0, LOOKED_AT)
    points = np.stack([np.interp(t * passed[-1], passed, column) for column in corners.T], axis=-1)
    return learned.curve.fit(torch.from_numpy(points), torch.from_numpy(t)).numpy()


def same_constraint(first: Constraint, second: Constraint) -> bool:
    """Whether two constraints hold the same axes, as tightly, at the same pose."""
    return first.is_placed and second.is_placed and first.key == second.key


def _links(
    nodes: Float[np.ndarray, "n 2"],
    labels: Int[np.ndarray, "n"],
    points: Float[np.ndarray, "2 2"],
    links: int,
) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]:
    """Which of the two ends, and the nodes it is joined to: the nearest of all, and the nearest of
    every component.
    """
    pairs: set[tuple[int, int]] = set()
    everywhere = np.arange(len(nodes))
    for rows, count in [(everywhere, links)] + [
        (np.flatnonzero(labels == k), 1) for k in np.unique(labels)
    ]:
        near = np.asarray(
            KDTree(nodes[rows]).query(points, k=range(1, min(count, len(rows)) + 1))[1]
        )
        pairs |= {(end, int(rows[node])) for end in (0, 1) for node in near[end]}
    both = np.array(sorted(pairs), dtype=np.int64)
    return both[:, 0], both[:, 1]


def _all_free(problem: PlanningProblem) -> Free:
    def free(joints: Float[np.ndarray, "m D"]) -> Bool[np.ndarray, "m"]:
        return np.array([problem.is_free(q) for q in joints], dtype=bool)

    return free
