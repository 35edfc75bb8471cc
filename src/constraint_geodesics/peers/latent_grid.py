"""Shortest paths over a graph in the latent space: what most work on geodesics of learned manifolds
does.

In a latent plane the graph is a regular grid whose edges have the lengths of the pullback metric
(Beik-Mohammadi et al., Learning Riemannian manifolds for geodesic motion skills, R:SS 2021), of
which those nodes are kept that satisfy the constraint within the grid's resolution; in more
dimensions see latent_graph.py.
"""

import time
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int
from pydantic import Field
from scipy.spatial import KDTree

from constraint_geodesics.constraints.constraint import Constraint
from constraint_geodesics.constraints.projection import Retraction
from constraint_geodesics.fields import Count, Name
from constraint_geodesics.geodesics.graph_search import fitted, neighbours_on_grid
from constraint_geodesics.geodesics.learned_problem import LearnedProblem
from constraint_geodesics.geodesics.problem import Ends
from constraint_geodesics.geometry.curves import PinnedSpline
from constraint_geodesics.geometry.errors import GeometryError
from constraint_geodesics.geometry.graph import OUTSIDE, shortest_path
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.lift import allowed_steps, corrected, retracted
from constraint_geodesics.learning.submanifold import GridSubmanifold, load_submanifold
from constraint_geodesics.peers.baseline import BaselineError, BaselineSettings, Context
from constraint_geodesics.peers.elastic_band import answer
from constraint_geodesics.peers.latent_geodesic import (
    executable,
    retracted_problem,
    straight_lengths,
    turned_away,
)
from constraint_geodesics.problem import SATISFIED, PathPlanner, PlanningProblem, Solution

LOOKED_AT = 129
"""Points at which a curve over the grid is looked at for what is wrong with it."""
BLOCKED_CELLS = 3.0
"""Radius around a place where a curve fails that the next search avoids, in cells of the grid."""
EDGE_SPACING = 0.1
"""Distance of the points of a lifted edge at most [rad]."""


class LatentGridSettings(BaselineSettings):
    """manifold: of two latent dimensions.  retracted: whether every point of the curve is retracted
    onto the constraint; without, it is what decoder and end correction make of it, which is a path
    only where the constraint holds by itself.
    inclusion_weight: an edge costs its length times 1 + this weight times the mean of ι_C at its
    nodes; inf admits no edges outside the sub-manifold but those that join an end to it; 0 leaves
    the constraint to the retraction.
    segments: of the spline.  rounds: searches at most.  links: nodes that an end is joined to,
    apart from the nearest of every component.
    """

    family: ClassVar = "latent"
    random: ClassVar = False

    manifold: Name = "paper"
    retracted: bool = True
    inclusion_weight: Annotated[float, Field(ge=0.0)] = 0.0
    segments: Count = 8
    rounds: Count = 20
    links: Count = 8

    def make(self, context: Context) -> PathPlanner:
        """On the constraint's grid."""
        found = load_submanifold(context.layout.submanifold(self.manifold, context.constraint))
        if not isinstance(found, GridSubmanifold):
            raise BaselineError(
                f"manifold = {self.manifold!r} has no grid: only one of two dimensions has"
            )
        learned = context.learned(self.manifold)
        return GridSearch(learned, context.manifold.constraint, found, self)

    @property
    def trained(self) -> tuple[str, ...]:
        """The manifold and the grids on it."""
        own = (f"train_manifold {self.manifold}", f"extract_submanifold {self.manifold}")
        return ("label_joints", *own)


@dataclass(frozen=True)
class GridSearch:
    """Dijkstra over a grid of the latent plane, a spline through the path, its ends corrected, then
    retracted.

    Where that curve jumps, leaves the limits or collides, the nodes around the place are blocked
    and the search goes on without them.

    chart: a manifold of two latent dimensions; grid: its nodes with the inclusion map of
    `constraint`.
    Raises GeometryError unless the chart has two dimensions, and if its grid is not on it.
    """

    chart: LearnedManifold
    constraint: Constraint
    grid: GridSubmanifold
    settings: LatentGridSettings = field(default_factory=LatentGridSettings)
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
        early = turned_away(problem, self.chart, began, self.constraint, "grid")
        if early is not None:
            return early
        learned = retracted_problem(
            self.chart, problem.manifold, PinnedSpline(2, self.settings.segments)
        )
        if not self.settings.retracted:
            learned = replace(learned, retract=False)
        ends = learned.ends(problem.start[None], problem.goal[None])
        joints, rounds, why = self._searched(problem, learned, ends)
        return answer(joints, problem, began, rounds, why)

    def _searched(
        self, problem: PlanningProblem, learned: LearnedProblem, ends: Ends
    ) -> tuple[Float[np.ndarray, "T D"] | None, int, str]:
        """Rows of the first path found, the searches it took, and why there is none."""
        radius = BLOCKED_CELLS * max(
            np.diff(axis)[0] for axis in (self.grid.first_axis, self.grid.second_axis)
        )
        open_nodes, costs = self.grid.labels.ravel() != OUTSIDE, self._lengths
        if np.isfinite(self.settings.inclusion_weight):
            open_nodes, costs = (
                np.full_like(open_nodes, True),
                costs * (1.0 + self.settings.inclusion_weight * self._inclusion),
            )
        why = "the grid does not join the ends"
        for searched in range(1, self.settings.rounds + 1):
            corners = self._way(ends, open_nodes, costs)
            if corners is None:
                return None, searched, why
            sides = straight_lengths(self.chart, corners[:-1], corners[1:])
            phi = fitted(learned.curve, corners, sides)
            rows = self._rows(problem, learned, phi, ends)
            if not isinstance(rows, str):
                return rows, searched, ""
            why = rows
            place = self._failure(problem, learned, phi, ends)
            open_nodes = open_nodes & (np.linalg.norm(self._nodes - place, axis=1) > radius)
        return None, self.settings.rounds, why

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
            self._nodes[joined], self.grid.labels.ravel()[joined], points, self.settings.links
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
        return rows if problem.keeps_clear(rows) else "the path collides"

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
        retraction = Retraction() if self.settings.retracted else None
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


BASELINE = LatentGridSettings
