"""Graphs over points of a manifold: neighbours, components, shortest paths; nodes count from 0."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import KDTree

from constraint_geodesics.geometry.errors import GeometryError, NonFiniteError

Edges = Int[np.ndarray, "m 2"]
OUTSIDE = -1


class GraphError(GeometryError):
    """A graph can't be built or searched; names the input, its value and what is allowed."""


class ShortestPath(NamedTuple):
    """Nodes from source to target (k,) and the length; no nodes and inf where there is none."""

    nodes: Int[np.ndarray, "k"]
    length: float


def nearest_neighbour_edges(points: Float[np.ndarray, "n d"], neighbours: int) -> Edges:
    """Undirected edges from every point to its `neighbours` nearest: unique pairs i < j, in order.

    Raises NonFiniteError with the first bad coordinate, GraphError if neighbours < 1.
    """
    if neighbours < 1:
        raise GraphError(f"neighbours = {neighbours}: must be at least 1")
    if not np.isfinite(points).all():
        i, d = np.argwhere(~np.isfinite(points))[0]
        raise NonFiniteError("points", (int(i), int(d)), float(points[i, d]))
    # One more than asked for, since each point finds itself as well; a list of ranks keeps two axes
    # in the answer.
    ranks = np.arange(1, min(neighbours + 1, len(points)) + 1)
    if not len(ranks):
        return np.empty((0, 2), dtype=np.int64)
    _, found = KDTree(points).query(points, k=ranks)
    pairs = np.stack(
        [np.broadcast_to(np.arange(len(points))[:, None], found.shape), found], axis=-1
    ).reshape(-1, 2)
    return np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0).astype(np.int64)


def components(n: int, edges: Edges) -> Int[np.ndarray, "n"]:
    """Connected component of each of n nodes, numbered by size: the largest is 0, of equals the one
    met first.

    Raises GraphError with the first edge that names no node.
    """
    _check(n, edges)
    adjacency = sparse.coo_array((np.ones(len(edges)), edges.T), shape=(n, n))
    return _largest_first(csgraph.connected_components(adjacency, directed=False)[1])


def shortest_path(
    n: int, edges: Edges, weights: Float[np.ndarray, "m"], source: int, target: int
) -> ShortestPath:
    """Shortest path between two of n nodes along undirected edges, by Dijkstra's method.

    edges: unique pairs.  weights: length of each, not negative.  Without a connection the path is
    empty and its length inf.  Raises GraphError with the first bad edge, weight or end.
    """
    bad = np.flatnonzero(~(np.isfinite(weights) & (weights >= 0)))
    if len(bad):
        raise GraphError(f"weights[{bad[0]}] = {weights[bad[0]]}: must be finite and not negative")
    for name, node in (("source", source), ("target", target)):
        if not 0 <= node < n:
            raise GraphError(f"{name} = {node}: the nodes are 0 to {n - 1}")
    _check(n, edges)
    adjacency = sparse.csr_array((weights, (edges[:, 0], edges[:, 1])), shape=(n, n))
    if adjacency.nnz != len(edges):
        raise GraphError(f"edges name {len(edges) - adjacency.nnz} pairs twice: must be unique")
    lengths, before = csgraph.dijkstra(
        adjacency, directed=False, indices=[source], return_predecessors=True
    )
    length = float(lengths[0, target])
    if not np.isfinite(length):
        return ShortestPath(np.empty(0, dtype=np.int64), np.inf)
    path = [target]
    while path[-1] != source:
        path.append(int(before[0, path[-1]]))
    return ShortestPath(np.array(path[::-1], dtype=np.int64), length)


def components_on_grid(
    inside: Bool[np.ndarray, "rows columns"], wrap: tuple[bool, bool]
) -> Int[np.ndarray, "rows columns"]:
    """Connected components of the cells inside a set on a regular 2-D grid of the chart.

    Cells that share a side are joined; wrap says along which axes the last cell is also next to the
    first. Components are numbered by size as in `components`, cells outside the set are OUTSIDE.
    """
    from scipy import ndimage  # planning needs none of it

    pieces, count = ndimage.label(inside)
    seams = [
        np.stack([np.take(pieces, 0, axis), np.take(pieces, -1, axis)], axis=-1)
        for axis in (0, 1)
        if wrap[axis]
    ]
    touching = np.concatenate([np.empty((0, 2), dtype=np.int64), *seams])
    merged = components(count, touching[(touching > 0).all(axis=1)] - 1)
    labels = np.full(inside.shape, OUTSIDE, dtype=np.int64)
    labels[inside] = _largest_first(merged[pieces[inside] - 1])
    return labels


def _check(n: int, edges: Edges) -> None:
    """Raises GraphError with the first edge that names no node."""
    bad = np.flatnonzero(((edges < 0) | (edges >= n)).any(axis=1))
    if len(bad):
        raise GraphError(f"edges[{bad[0]}] = {edges[bad[0]].tolist()}: the nodes are 0 to {n - 1}")


def _largest_first(labels: np.ndarray) -> np.ndarray:
    """The same partition with its parts numbered by size, equals in the order they are met."""
    _, first, parts, sizes = np.unique(
        labels, return_index=True, return_inverse=True, return_counts=True
    )
    rank = np.empty(len(sizes), dtype=np.int64)
    rank[np.lexsort((first, -sizes))] = np.arange(len(sizes))
    return rank[parts]
