"""Baselines that keep rows of demonstrations instead of a constraint: tangent planes of the rows'
tool poses, and a graph of the rows.
"""

import time

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from constraint_geodesics.constraints.tool_features import features
from constraint_geodesics.robot.kinematics import SerialRobot

METRES = 0.3
"""Unit of positions among the features."""
NEIGHBOURS = (12, 25, 50, 100, 200)
"""Rows of a tangent plane, of which the best on rows left out is taken."""
NODES, ROUNDS, SPACING_RAD = 33, 80, 0.02
"""Of the band between the ends, its shortening steps, and of the path's rows."""
JOINED = 12
"""Neighbours of a row in the graph."""


class PoseTangents:
    """Local PCA on tool poses: the rows near a pose span a plane, and what is across it is held.

    The rank is told, that of the hidden formula: this is the baseline's strongest setting.
    """

    def __init__(self, robot: SerialRobot, rows: Float[np.ndarray, "n D"], codim: int) -> None:
        self._robot, self._codim = robot, codim
        y, _ = self._look(rows)
        held_out = np.random.default_rng(0).permutation(len(rows))[: min(len(rows) // 5, 200)]
        rest = np.setdiff1d(np.arange(len(rows)), held_out)
        self._y, self._tree = y[rest], KDTree(y[rest])
        off = []
        for count in NEIGHBOURS:
            self._count = min(count, len(rest))
            off.append(np.median(np.linalg.norm(self._residual(rows[held_out])[0], axis=1)))
        self._count = min(NEIGHBOURS[int(np.argmin(off))], len(rest))
        self._y, self._tree = y, KDTree(y)

    def answer(self, start: np.ndarray, goal: np.ndarray) -> tuple[str, np.ndarray | None, float]:
        """A band on the tangent planes."""
        began = time.perf_counter()
        t = np.linspace(0.0, 1.0, NODES)[:, None]
        nodes = self._projected(start + t * (goal - start), 6)
        for _ in range(ROUNDS):
            nodes[1:-1] = 0.5 * (nodes[:-2] + nodes[2:])
            nodes = self._projected(nodes, 1)
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(nodes, axis=0), axis=1))])
        if not np.isfinite(way).all() or np.diff(way).min() < 1e-9:
            return "not_found", None, 0.0
        at = np.linspace(0.0, way[-1], max(int(way[-1] / SPACING_RAD), NODES))
        path = self._projected(CubicSpline(way, nodes)(at), 5)
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
        jumps = steps.max() > 3.0 * steps.mean() + 1e-3
        ms = 1e3 * (time.perf_counter() - began)
        return ("jumps", None, ms) if jumps else ("solved", path, ms)

    def _look(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        position, rotation = self._robot.forward(q)
        jacobian = self._robot.jacobian(q)
        y, slopes = features(position, rotation), [jacobian[:, :3]]
        for k in range(3):
            turned = rotation[:, :, k][:, :, None]
            slopes.append(np.cross(jacobian[:, 3:], turned, axisa=1, axisb=1, axisc=1))
        scale = np.array([METRES] * 3 + [1.0] * 9)
        return y / scale, np.concatenate(slopes, axis=1) / scale[:, None]

    def _residual(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Across the tangent plane of the poses' own tangent space, and its slopes."""
        y, slopes = self._look(q)
        near = self._y[np.asarray(self._tree.query(y, self._count)[1])]
        mean = near.mean(axis=1)
        away = near - mean[:, None]
        # poses have six dimensions: those of the twelve numbers that the joints can move
        basis = np.linalg.svd(slopes, full_matrices=False)[0][:, :, :6]
        flat = away @ basis
        _, directions = np.linalg.eigh(flat.transpose(0, 2, 1) @ flat)
        across = (basis @ directions[:, :, : self._codim]).transpose(0, 2, 1)
        return (across @ (y - mean)[:, :, None])[:, :, 0], across @ slopes

    def _projected(self, q: np.ndarray, steps: int) -> np.ndarray:
        q = q.copy()
        for _ in range(steps):
            off, slopes = self._residual(q)
            move = (np.linalg.pinv(slopes, rcond=1e-4) @ off[:, :, None])[:, :, 0]
            size = np.linalg.norm(move, axis=1, keepdims=True)
            q -= move * np.minimum(1.0, 0.3 / np.maximum(size, 1e-12))
        return q


class NearestRows:
    """The shortest way over a graph of the rows, each joined to its nearest ones."""

    def __init__(self, rows: Float[np.ndarray, "n D"]) -> None:
        self._rows, self._tree = rows, KDTree(rows)
        count = min(JOINED + 1, len(rows))
        lengths, nearest = (np.asarray(own) for own in self._tree.query(rows, count))
        begins = np.repeat(np.arange(len(rows)), count - 1)
        ends, values = nearest[:, 1:].ravel(), lengths[:, 1:].ravel()
        self._graph = coo_matrix((values, (begins, ends)), shape=(len(rows),) * 2).tocsr()

    def answer(self, start: np.ndarray, goal: np.ndarray) -> tuple[str, np.ndarray | None, float]:
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
