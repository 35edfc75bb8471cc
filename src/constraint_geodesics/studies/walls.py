"""Solvers on grids of metric values with walls, against Dijkstra's paths over the same nodes.

Two metrics of 150 × 150 nodes: a smooth one, as latent variances give, with two walls that have a
gap each; and a labyrinth of rooms in a factor that varies by more than two orders of magnitude.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from constraint_geodesics.geodesics.gradient import GradientSolver
from constraint_geodesics.geodesics.graph_search import (
    CombinedSolver,
    GraphSolver,
    neighbours_on_grid,
)
from constraint_geodesics.geodesics.problem import ChartBox, ChartProblem, Geodesic, GeodesicSolver
from constraint_geodesics.geodesics.solver import geodesics_between
from constraint_geodesics.geodesics.taut import drawn_along, pulled
from constraint_geodesics.geometry.curves import CurveFamily, Curves, PinnedPolynomial, PinnedSpline
from constraint_geodesics.geometry.grid import GridManifold
from constraint_geodesics.geometry.length import estimate_length

NODES = 150
"""Nodes along each axis."""
LOW, HIGH = (-3.0, -3.0), (3.0, 3.0)
QUERIES = 100
SHARE = 10
"""Queries to one that the gradient is asked as well: it has no graph, and takes long."""
SEEDS = {"gaps": 0, "labyrinth": 5}
"""Of the metrics; their queries have the next."""
SHAPE = PinnedPolynomial(2, 3)
"""The family asked for; what a wall needs beyond it the solvers choose."""
CHORDS = 64
"""Points a step that a curve is judged at."""
FINE = (0.05, 5.0, 200, 1e-7)
"""Margin and height of the fence, Newton steps and tolerance of the reference."""
WIDE = 4
"""Reach of the edges of the reference's graph: to 48 neighbours, a path is up to 0.8 % too long."""

Nodes = Int[np.ndarray, "B"]


@dataclass(frozen=True)
class WalledGrid:
    """A metric with walls, and Dijkstra's method on its nodes, 8-connected."""

    manifold: GridManifold

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = self.manifold.values.shape
        return rows, columns

    @cached_property
    def points(self) -> Float[np.ndarray, "n 2"]:
        """The nodes."""
        return self.manifold.nodes().numpy()

    @cached_property
    def free(self) -> Bool[np.ndarray, "n"]:
        """Which nodes belong to the manifold."""
        return self.manifold.contains(self.manifold.nodes()).numpy()

    @cached_property
    def steps(self) -> sparse.csr_array:
        """Lengths on the manifold of the steps between free neighbours, past corners as well.

        That makes it the shortest that is called 8-connected: a solver's curve keeps off corners.
        """
        edges = neighbours_on_grid(self.shape, reach=1)
        edges = edges[self.free[edges].all(axis=1)]
        ends = (torch.from_numpy(self.points[edges[:, k]]) for k in (0, 1))
        lines = Curves(PinnedPolynomial(2, 1), torch.zeros(len(edges), 0).double(), *ends)
        lengths = estimate_length(self.manifold, lines).length.numpy()
        return sparse.csr_array((lengths, edges.T), shape=(len(self.free),) * 2)

    def dijkstra(self, start: int) -> Float[np.ndarray, "n"]:
        """Lengths of the shortest paths over neighbours from one node; inf where there is none."""
        return csgraph.dijkstra(self.steps, directed=False, indices=[start])[0]

    def queries(
        self, count: int, rng: np.random.Generator
    ) -> tuple[Nodes, Nodes, Float[np.ndarray, "B"]]:
        """Random free nodes that are joined, and the lengths of their 8-connected paths."""
        found: list[tuple[int, int, float]] = []
        places = np.flatnonzero(self.free)
        while len(found) < count:
            start, goal = rng.choice(places, size=2, replace=False)
            length = float(self.dijkstra(start)[goal])
            if np.isfinite(length):
                found.append((start, goal, length))
        starts, goals, lengths = zip(*found, strict=True)
        return np.array(starts), np.array(goals), np.array(lengths)


def gaps(seed: int) -> GridManifold:
    """A smooth metric, exp of a random field, with two walls of a gap each."""
    blocked = torch.zeros(NODES, NODES, dtype=torch.bool)
    blocked[48:52], blocked[100:103] = True, True
    blocked[48:52, 100:108], blocked[100:103, 25:33] = False, False
    return _walled(_field(np.random.default_rng(seed), 10.0, 0.8), blocked)


def labyrinth(seed: int, rooms: int = 10) -> GridManifold:
    """Square rooms joined to a tree by openings of 1 to 4 nodes in walls of 2."""
    rng, size = np.random.default_rng(seed), NODES // rooms
    values, blocked = _field(rng, 6.0, 1.0), torch.zeros(NODES, NODES, dtype=torch.bool)
    for k in range(1, rooms):
        blocked[k * size - 1 : k * size + 1] = True
        blocked[:, k * size - 1 : k * size + 1] = True
    for (row, column), down in _tree(rng, rooms):
        first = rng.integers(1, size - 5)
        opening = slice(first, first + rng.integers(1, 5))
        door = slice(size - 1, size + 1)
        room = blocked[row * size :, column * size :]
        room[(door, opening) if down else (opening, door)] = False
    return _walled(values, blocked)


METRICS: dict[str, Callable[[int], GridManifold]] = {"gaps": gaps, "labyrinth": labyrinth}


def walls_figures(count: int = QUERIES) -> dict[str, dict[str, Any]]:
    """Every solver on both metrics: what it found, inside or not, and its lengths."""
    return {
        name: _figures(WalledGrid(make(SEEDS[name])), count, SEEDS[name] + 1)
        for name, make in METRICS.items()
    }


def _figures(grid: WalledGrid, count: int, seed: int) -> dict[str, Any]:
    manifold = grid.manifold
    start, goal, dijkstra = grid.queries(count, np.random.default_rng(seed))
    box, graph = ChartBox(LOW, HIGH), GraphSolver.over_grid(manifold, LOW, HIGH, grid.shape)
    gradient = GradientSolver()
    solvers: dict[str, tuple[GeodesicSolver, CurveFamily, int]] = {
        "combined": (CombinedSolver(graph), SHAPE, count),
        "graph": (graph, SHAPE, count),
        "gradient, cubic": (gradient, SHAPE, count // SHARE),
        "gradient, 4 segments": (gradient, PinnedSpline(2, 4), count // SHARE),
    }
    found: dict[str, list[Geodesic]] = {}
    for name, (solver, family, asked) in solvers.items():
        if not asked:
            continue
        problem = ChartProblem(manifold, family, box)
        ends = zip(grid.points[start[:asked]], grid.points[goal[:asked]], strict=True)
        found[name] = [geodesics_between(solver, problem, a[None], b[None])[0] for a, b in ends]
    reference = _references(grid, start, goal, found["combined"])
    return {name: judged(manifold, curves, dijkstra, reference) for name, curves in found.items()}


def judged(
    manifold: GridManifold,
    found: list[Geodesic],
    dijkstra: Float[np.ndarray, "B"],
    reference: Float[np.ndarray, "B"],
) -> dict[str, Any]:
    """What a solver found of the first queries, over the lengths of two others."""
    usable = np.array([geodesic.found for geodesic in found])
    curves = [geodesic for geodesic in found if geodesic.found]
    chords, inside = _looked_at(manifold, curves)
    lengths = np.array([geodesic.length for geodesic in curves])
    asked = slice(len(found))
    return {
        "queries": len(found),
        "found": float(usable.mean()),
        "converged": float(np.mean([geodesic.status == "converged" for geodesic in found])),
        "inside": float(np.mean(inside)) if curves else None,
        "over_dijkstra": _spread(lengths / dijkstra[asked][usable]),
        "over_reference": _spread(lengths / reference[asked][usable]),
        "largest_error_of_length": float(np.abs(chords / lengths - 1).max()) if curves else None,
        "milliseconds": 1e3 * float(np.median([geodesic.time_s for geodesic in found])),
    }


def _looked_at(
    manifold: GridManifold, found: list[Geodesic]
) -> tuple[Float[np.ndarray, "B"], Bool[np.ndarray, "B"]]:
    """Lengths by CHORDS chords a step, the metric at their middles, and whether all is inside."""
    lengths, inside = [], []
    for geodesic in found:
        rough = np.diff(geodesic.points(np.linspace(0.0, 1.0, 2001)), axis=0)
        longest = 2000 * np.linalg.norm(rough, axis=1).max() / manifold.step
        t = np.linspace(0.0, 1.0, int(CHORDS * longest) + 2)
        points = torch.from_numpy(geodesic.points(t))
        speeds = manifold.metric((points[1:] + points[:-1]) / 2)[:, 0, 0].sqrt()
        sides = torch.linalg.vector_norm(points.diff(dim=0), dim=-1)
        lengths.append(float(speeds @ sides))
        inside.append(bool(manifold.contains(points).all()))
    return np.array(lengths), np.array(inside, dtype=bool)


def _references(
    grid: WalledGrid, start: Nodes, goal: Nodes, found: list[Geodesic]
) -> Float[np.ndarray, "B"]:
    """Converged lengths: the shorter of what was found and of another graph's path, of edges to 48
    neighbours, pulled tight before a lower fence by smaller steps.
    """
    manifold = grid.manifold
    margin, height, iterations, tolerance = FINE
    wide = GraphSolver.over_grid(manifold, LOW, HIGH, grid.shape, WIDE)
    lengths = []
    for a, b, geodesic in zip(grid.points[start], grid.points[goal], found, strict=True):
        way = wide.path(a, b)
        assert way is not None
        drawn = drawn_along(manifold, way)
        assert drawn is not None
        fenced = manifold.fenced(margin, height, torch.from_numpy(way[[0, -1]]))
        taut = pulled(fenced, drawn, iterations, tolerance)
        own = float(estimate_length(manifold, taut.curves()).length)
        inside = manifold.contains(taut.curves().at(torch.linspace(0, 1, 20001).double())[0]).all()
        lengths.append(np.nanmin([own if inside else np.nan, geodesic.length]))
    return np.array(lengths)


def _spread(ratio: Float[np.ndarray, "B"]) -> Mapping[str, float | None]:
    if not len(ratio):
        return dict.fromkeys(("mean", "p95", "max"))
    return {
        "mean": float(ratio.mean()),
        "p95": float(np.quantile(ratio, 0.95)),
        "max": float(ratio.max()),
    }


def _walled(values: Float[np.ndarray, "r c"], blocked: Bool[torch.Tensor, "r c"]) -> GridManifold:
    return GridManifold(torch.from_numpy(values).masked_fill(blocked, torch.inf), LOW, HIGH)


def _field(rng: np.random.Generator, width: float, spread: float) -> Float[np.ndarray, "r c"]:
    """Exp of a smooth random field of the given deviation."""
    field = ndimage.gaussian_filter(rng.normal(size=(NODES, NODES)), width, mode="reflect")
    return np.exp(spread * (field - field.mean()) / field.std())


def _tree(rng: np.random.Generator, rooms: int) -> list[tuple[tuple[int, int], bool]]:
    """A random tree over a square of rooms, by a depth-first walk: the upper left room of each door
    and whether it leads down, not right.
    """
    doors, seen, stack = [], {(0, 0)}, [(0, 0)]
    while stack:
        row, column = stack[-1]
        near = [(row, column + 1), (row + 1, column), (row, column - 1), (row - 1, column)]
        new = [room for room in near if min(room) >= 0 and max(room) < rooms and room not in seen]
        if not new:
            stack.pop()
            continue
        room = new[rng.integers(len(new))]
        seen.add(room)
        stack.append(room)
        first, second = sorted([(row, column), room])
        doors.append((first, second[0] > first[0]))
    return doors
