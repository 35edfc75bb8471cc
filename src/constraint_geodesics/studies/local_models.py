"""Baselines that keep rows of demonstrations instead of a constraint: local models of the rows'
tool poses, and a graph of the rows.
"""

import time
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import CubicSpline
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from constraint_geodesics.constraints.tool_features import features
from constraint_geodesics.robot.kinematics import SerialRobot

METRES = 0.3
"""Unit of positions among the features."""
NEIGHBOURS, LEAST_OF_A_QUADRIC = (12, 25, 50, 100, 200, 400, 1200), 50
"""Rows of a local model that are tried, and of a quadric at least."""
NODES, ROUNDS, SPACING_RAD = 33, 80, 0.02
"""Of the band between the ends, its shortening steps, and of the path's rows."""
LOOKED_AT, LONGEST_RAD = 200, 0.3
"""Rows left out that settings are chosen on, and the longest step of a projection."""
JOINED, OTHERS, ASKED = 12, 4, 200
"""Neighbours of a row in the graph, of these from other demonstrations, and how many are looked at
for them.
"""


Answer = tuple[str, np.ndarray | None, float]
"""Status, path (T, D) and milliseconds of a query."""
Look = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""What configurations (n, D) are looked at by: numbers (n, k) of order 1, and their slopes
(n, k, D).
"""


def poses_of(robot: SerialRobot) -> Look:
    """By the tool's position and the axes of its frame."""
    scale = np.array([METRES] * 3 + [1.0] * 9)

    def look(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        position, rotation = robot.forward(q)
        jacobian = robot.jacobian(q)
        y, slopes = features(position, rotation), [jacobian[:, :3]]
        for k in range(3):
            turned = rotation[:, :, k][:, :, None]
            slopes.append(np.cross(jacobian[:, 3:], turned, axisa=1, axisb=1, axisc=1))
        return y / scale, np.concatenate(slopes, axis=1) / scale[:, None]

    return look


def joints_of(robot: SerialRobot) -> Look:
    """By the joints themselves [rad]."""
    return lambda q: (q, np.broadcast_to(np.eye(robot.dof), (len(q), robot.dof, robot.dof)))


def halves(of: Int[np.ndarray, "n"]) -> tuple[Int[np.ndarray, "l"], Int[np.ndarray, "r"]]:
    """Rows of every fifth demonstration, some LOOKED_AT of them, and all rows of the others."""
    left = np.isin(of, np.unique(of)[::5])
    held_out, rest = np.flatnonzero(left), np.flatnonzero(~left)
    return held_out[:: max(len(held_out) // LOOKED_AT, 1)], rest


def band_between(
    projected: Callable[[np.ndarray, int], np.ndarray], start: np.ndarray, goal: np.ndarray
) -> Answer:
    """A band between two configurations that `projected`, with so many steps, keeps where the rows
    are.
    """
    began = time.perf_counter()
    t = np.linspace(0.0, 1.0, NODES)[:, None]
    nodes = projected(start + t * (goal - start), 6)
    for _ in range(ROUNDS):
        nodes[1:-1] = 0.5 * (nodes[:-2] + nodes[2:])
        nodes = projected(nodes, 1)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(nodes, axis=0), axis=1))])
    if not np.isfinite(way).all() or np.diff(way).min() < 1e-9:
        return "not_found", None, 1e3 * (time.perf_counter() - began)
    at = np.linspace(0.0, way[-1], max(int(way[-1] / SPACING_RAD), NODES))
    path = projected(CubicSpline(way, nodes)(at), 5)
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    jumps = steps.max() > 3.0 * steps.mean() + 1e-3
    ms = 1e3 * (time.perf_counter() - began)
    return ("jumps", None, ms) if jumps else ("solved", path, ms)


def moved(off: np.ndarray, slopes: np.ndarray) -> Float[np.ndarray, "n D"]:
    """The shortest step of the joints that takes away what is off to first order, at most
    LONGEST_RAD.
    """
    move = (np.linalg.pinv(slopes, rcond=1e-4) @ off[:, :, None])[:, :, 0]
    size = np.linalg.norm(move, axis=1, keepdims=True)
    return -move * np.minimum(1.0, LONGEST_RAD / np.maximum(size, 1e-12))


class LocalModels:
    """Near a row its neighbours span a plane, or a quadric over it, and what is across is held.

    of (n,): the demonstration of each row.  The rank is told, that of the hidden formula, and the
    number of neighbours and the degree are those that are best on demonstrations left out: the
    baseline's strongest settings.
    """

    def __init__(
        self, look: Look, rows: Float[np.ndarray, "n D"], of: Int[np.ndarray, "n"], codim: int
    ) -> None:
        self._look, self._codim = look, codim
        y, _ = self._look(rows)
        held_out, rest = halves(of)
        self._y, self._tree = y[rest], KDTree(y[rest])
        tried: dict[tuple[int, int], float] = {}
        for degree in (1, 2):
            for count in NEIGHBOURS:
                self._count, self._degree = min(count, len(rest)), degree
                if degree == 1 or count >= LEAST_OF_A_QUADRIC:
                    away = np.linalg.norm(moved(*self._residual(rows[held_out])), axis=1)
                    tried[self._count, degree] = float(np.median(away))
        self._count, self._degree = min(tried, key=lambda key: tried[key])
        self.left_out_rad = tried[self._count, self._degree]
        self._y, self._tree = y, KDTree(y)

    def answer(self, start: np.ndarray, goal: np.ndarray) -> Answer:
        """A band on the local models."""
        return band_between(self._projected, start, goal)

    def frames(
        self, y: Float[np.ndarray, "n k"], slopes: Float[np.ndarray, "n k D"]
    ) -> tuple[Float[np.ndarray, "n c k"], Float[np.ndarray, "n d k"]]:
        """Orthonormal directions across the model of each of some places, which are held, and along
        it.
        """
        _, normals, every = self._model(y, slopes)
        sides, _, _ = np.linalg.svd(every @ normals.transpose(0, 2, 1))
        turned = sides.transpose(0, 2, 1) @ every
        return turned[:, : self._codim], turned[:, self._codim :]

    def _residual(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far configurations are off the models, and the slopes of that."""
        y, slopes = self._look(q)
        off, normals, _ = self._model(y, slopes)
        return off, normals @ slopes

    def _model(self, y: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, ...]:
        """How far places are off the model of the rows near them (n, c), its normals there, and
        directions that span all poses.
        """
        near = self._y[np.asarray(self._tree.query(y, self._count)[1])]
        mean = near.mean(axis=1)
        away = near - mean[:, None]
        # poses have six dimensions: those of the twelve numbers that the joints can move
        basis = np.linalg.svd(slopes, full_matrices=False)[0][:, :, :6]
        flat = away @ basis
        _, directions = np.linalg.eigh(flat.transpose(0, 2, 1) @ flat)
        every = (basis @ directions).transpose(0, 2, 1)
        across, along = every[:, : self._codim], every[:, self._codim :]
        off = (across @ (y - mean)[:, :, None])[:, :, 0]
        if self._degree == 1 or not along.shape[1]:
            return off, across, every
        t = away @ along.transpose(0, 2, 1)
        first, second = np.triu_indices(along.shape[1])
        ones = np.ones((*t.shape[:2], 1))
        terms = np.concatenate([ones, t, t[:, :, first] * t[:, :, second]], axis=2)
        squares = terms.transpose(0, 2, 1) @ terms
        ridge = 1e-6 * np.trace(squares, axis1=1, axis2=2)[:, None, None] / terms.shape[2]
        sums = terms.transpose(0, 2, 1) @ (away @ across.transpose(0, 2, 1))
        fit = np.linalg.solve(squares + ridge * np.eye(terms.shape[2]), sums)
        here, count = (along @ (y - mean)[:, :, None])[:, :, 0], along.shape[1]
        own = np.concatenate([np.ones((len(y), 1)), here, here[:, first] * here[:, second]], axis=1)
        off = off - np.einsum("nm,nmk->nk", own, fit)
        steep = np.zeros((len(y), terms.shape[2], count))
        steep[:, 1 : 1 + count] = np.eye(count)
        for m, (i, j) in enumerate(zip(first, second, strict=True)):
            steep[:, 1 + count + m, i] += here[:, j]
            steep[:, 1 + count + m, j] += here[:, i]
        bent = np.einsum("nmk,nmd->nkd", fit, steep)
        return off, across - bent @ along, every

    def _projected(self, q: np.ndarray, steps: int) -> np.ndarray:
        q = q.copy()
        for _ in range(steps):
            q += moved(*self._residual(q))
        return q


class NearestRows:
    """The shortest way over a graph of the rows, each joined to its nearest ones."""

    def __init__(self, rows: Float[np.ndarray, "n D"], of: Int[np.ndarray, "n"]) -> None:
        self._rows, self._tree = rows, KDTree(rows)
        count = min(ASKED, len(rows))
        lengths, nearest = (np.asarray(own) for own in self._tree.query(rows, count))
        others = of[nearest] != of[:, None]
        others &= others.cumsum(axis=1) <= OTHERS
        kept = others | (np.arange(count) <= JOINED)
        kept[:, 0] = False
        begins, column = np.nonzero(kept)
        ends, values = nearest[begins, column], lengths[begins, column]
        self._graph = coo_matrix((values, (begins, ends)), shape=(len(rows),) * 2).tocsr()

    def answer(self, start: np.ndarray, goal: np.ndarray) -> Answer:
        """From the row nearest to the start to that nearest to the goal."""
        began = time.perf_counter()
        first, last = (int(np.asarray(self._tree.query(q)[1])) for q in (start, goal))
        lengths, before = dijkstra(  # type: ignore[call-overload]
            self._graph, directed=False, indices=first, return_predecessors=True
        )
        if not np.isfinite(lengths[last]):
            return "not_found", None, 1e3 * (time.perf_counter() - began)
        way = [last]
        while way[-1] != first:
            way.append(int(before[way[-1]]))
        corners = np.concatenate([[start], self._rows[way[::-1]], [goal]])
        steps = np.linalg.norm(np.diff(corners, axis=0), axis=1)
        pieces = np.maximum(np.ceil(steps / SPACING_RAD).astype(int), 1)
        parts = [
            a + np.arange(n)[:, None] / n * (b - a)
            for a, b, n in zip(corners[:-1], corners[1:], pieces, strict=True)
        ]
        path = np.concatenate([*parts, corners[-1:]])
        return "solved", path, 1e3 * (time.perf_counter() - began)
