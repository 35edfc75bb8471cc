"""Shortest paths over a nearest-neighbour graph of configurations on the constraint, with the
lengths of the latent metric: latent_grid.py's search in any dimension.
"""

import itertools
import time
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int
from pydantic import Field

from constraint_geodesics.constraints.constraint import Constraint
from constraint_geodesics.constraints.projection import Retraction
from constraint_geodesics.fields import Count
from constraint_geodesics.geometry.graph import shortest_path
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.lift import corrected, retracted
from constraint_geodesics.learning.submanifold import (
    Free,
    GraphSubmanifold,
    Surface,
    check_edges,
    load_submanifold,
)
from constraint_geodesics.peers.baseline import GRAPH, BaselineError, BaselineSettings, Context
from constraint_geodesics.peers.elastic_band import answer
from constraint_geodesics.peers.latent_geodesic import executable, straight_lengths, turned_away
from constraint_geodesics.problem import SATISFIED, PathPlanner, PlanningProblem, Solution

TRIED, ENOUGH = 32, 4
"""Nodes of a graph that an end is tried to be joined to, the nearest first, and how many are
enough.
"""
EDGE_SPACING = 0.1
"""Distance of the points of a lifted edge at most [rad]."""
LEAST_GAIN = 1e-3
"""What a shortcut must save [rad]."""


class LatentGraphSettings(BaselineSettings):
    """shortcuts: tried; none leaves the graph's own path.  rounds: searches at most.  edge_points:
    looked at along an edge.
    """

    family: ClassVar = "latent"
    made_by: ClassVar = GRAPH

    shortcuts: Annotated[int, Field(ge=0)] = 100
    rounds: Count = 200
    edge_points: Count = 12

    def make(self, context: Context) -> PathPlanner:
        """On the constraint's graph on the manifold that the planner uses."""
        searched, constraint = context.searched, context.manifold.constraint
        found = load_submanifold(context.layout.submanifold(searched, context.constraint))
        if not isinstance(found, GraphSubmanifold):
            raise BaselineError(f"the manifold {searched!r} has a grid, not a graph")
        return LatentGraphSearch(context.learned(searched), constraint, found, self)


@dataclass(frozen=True)
class LatentGraphSearch:
    """Dijkstra over a sub-manifold's graph with the lengths of the latent metric, then shortcuts;
    in any dimension.

    An edge is the straight latent line between two nodes, its ends corrected and every point
    retracted.  The graph's own edges were checked when it was made; those of a path are checked
    again for the workcell of the problem, and a path with an edge that collides is given up for the
    next one.  Shortcuts join two random points of the path by such a line where that is shorter.

    graph: that of `constraint` on this chart.
    """

    chart: LearnedManifold
    constraint: Constraint
    graph: GraphSubmanifold
    settings: LatentGraphSettings = field(default_factory=LatentGraphSettings)
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
        early = turned_away(problem, self.chart, began, self.constraint, "graph")
        if early is not None:
            return early
        points, searched = self._searched(problem)
        rows = None
        if points is not None:
            shorter = self._shortened(problem, points, np.random.default_rng(seed))
            for candidate in (shorter, points):
                drawn = executable(problem.manifold, candidate)
                if drawn is not None and problem.keeps_clear(drawn):
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
        lines: dict[tuple[int, int], Float[np.ndarray, "k D"] | None] = {}
        for searched in range(1, self.settings.rounds + 1):
            route = shortest_path(n + 2, edges[kept], lengths[kept], n, n + 1).nodes
            if not len(route):
                return None, searched
            pieces = []
            for way in itertools.pairwise(map(int, route)):
                if way not in lines:  # most of a route is that of the round before
                    lines[way] = self._line(problem, joints[way[0]], joints[way[1]])
                pieces.append(lines[way])
                kept[numbers[min(way), max(way)]] = lines[way] is not None
            whole = [piece for piece in pieces if piece is not None]
            if len(whole) == len(pieces):
                return np.concatenate([whole[0][:1], *(piece[1:] for piece in whole)]), searched
        return None, self.settings.rounds

    def _joined(
        self, problem: PlanningProblem, joints: Float[np.ndarray, "n D"], end: int
    ) -> Int[np.ndarray, "k 2"]:
        """Edges from an end to nodes near it that hold."""
        nodes = len(self.graph.joints)
        near = np.argsort(np.linalg.norm(joints[:nodes] - joints[end], axis=1), kind="stable")[
            :TRIED
        ]
        found: list[int] = []
        surface = Surface(self.chart, problem.manifold, _all_free(problem))
        for block in np.array_split(near, max(len(near) // 8, 1)):
            starts = np.broadcast_to(joints[end], (len(block), joints.shape[1]))
            lengths = check_edges(surface, starts, joints[block], self.settings.edge_points)
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
        return joints if problem.keeps_clear(joints) else None

    def _shortened(
        self, problem: PlanningProblem, points: Float[np.ndarray, "k D"], rng: np.random.Generator
    ) -> Float[np.ndarray, "k D"]:
        for _ in range(self.settings.shortcuts):
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


def _all_free(problem: PlanningProblem) -> Free:
    def free(joints: Float[np.ndarray, "m D"]) -> Bool[np.ndarray, "m"]:
        return np.array([problem.is_free(q) for q in joints], dtype=bool)

    return free


BASELINE = LatentGraphSettings
