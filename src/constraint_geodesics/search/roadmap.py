"""Paths over a constraint's graph: where a straight start jumps, or goes through the table, the
graph leads round.

The graph with a query's two ends joined to it, searched by
A* [Hart et al. 1968] with the straight joint distance as the bound from below.  Compiled; PyBullet
checked the graph's own edges when it was made; the edges to a query's ends, and those of the way
that is found, are checked here for jumps, limits and what they touch.
"""

import heapq
from dataclasses import dataclass
from functools import cached_property
from itertools import count

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.geometry.graph import components, nearest_neighbour_edges
from constraint_geodesics.search.space import (
    Space,
    is_free,
    keep_slopes,
    project_node,
    turns_over,
    workspace,
)

NEAREST = 32
"""Nodes that an end is tried to be joined to, the nearest first."""
JOINED = 4
"""Nodes that are enough for an end."""
LOOKED_AT = 8
"""Nodes, the nearest, that a way may begin or end with whose edges are looked at only then."""
EDGE_STEP = 0.15
"""Distance of the points that an edge is checked at [rad]."""
_NO_EDGES = np.empty((0, 2), dtype=np.int64)


@dataclass(frozen=True)
class Roadmap:
    """A graph in joint space: nodes (n, D) [rad], undirected edges (m, 2) with lengths (m,) [rad],
    components (n,).
    """

    joints: Float[np.ndarray, "n D"]
    edges: Int[np.ndarray, "m 2"]
    lengths: Float[np.ndarray, "m"]
    labels: Int[np.ndarray, "n"]

    @cached_property
    def neighbours(
        self,
    ) -> tuple[Int[np.ndarray, "n1"], Int[np.ndarray, "m2"], Float[np.ndarray, "m2"]]:
        """Each node's edges one after another: where they begin, where they lead, their lengths
        [rad].
        """
        both = np.concatenate([self.edges, self.edges[:, ::-1]]).astype(np.int64)
        order = np.argsort(both[:, 0], kind="stable")
        begins = np.searchsorted(both[order, 0], np.arange(len(self.joints) + 1))
        return (
            begins.astype(np.int64),
            both[order, 1],
            np.concatenate([self.lengths, self.lengths])[order],
        )


@dataclass(frozen=True)
class Joined:
    """The nodes that a configuration can be joined to, and the lengths of these edges [rad]."""

    nodes: Int[np.ndarray, "k"]
    lengths: Float[np.ndarray, "k"]

    def components(self, roadmap: Roadmap) -> set[int]:
        """Components of the graph that the configuration belongs to; empty where it could not be
        joined to any.
        """
        return {int(roadmap.labels[node]) for node in self.nodes}


def nearest(roadmap: Roadmap, q: Float[np.ndarray, "D"], most: int = LOOKED_AT) -> Joined:
    """The nearest nodes and how far they are, straight; nothing is known of the edges to them."""
    distances = np.linalg.norm(roadmap.joints - q, axis=1)
    count = min(most, len(distances))
    nodes = np.argpartition(distances, count - 1)[:count]
    nodes = nodes[np.argsort(distances[nodes], kind="stable")]
    return Joined(nodes, distances[nodes])


def join(roadmap: Roadmap, space: Space, q: Float[np.ndarray, "D"]) -> Joined:
    """The edges from a configuration to the graph."""
    tried = nearest(roadmap, q, NEAREST).nodes
    lengths = np.empty(len(tried))
    _edges(space, q, roadmap.joints, tried, lengths, JOINED)
    holds = np.isfinite(lengths)
    return Joined(tried[holds], lengths[holds])


def shortest_way(
    roadmap: Roadmap,
    start: Float[np.ndarray, "D"],
    goal: Float[np.ndarray, "D"],
    at_start: Joined,
    at_goal: Joined,
    space: Space | None = None,
    most: int | None = None,
) -> Float[np.ndarray, "k D"] | None:
    """Corners of the shortest way over the graph, both ends included; None where the graph does not
    join them.

    space: the edges to the ends of a way that was found are looked at in it, then its nodes, then
    its edges, since the graph may be of a workcell with less in it.  Nodes that touch something are
    left out, else the first edge that fails, and the search is begun again [lazy shortest paths,
    Dellin and Srinivasa 2016].  most: so often at most.
    """
    if not len(at_start.nodes) or not len(at_goal.nodes):
        return None
    begins, leads, lengths = roadmap.neighbours
    own, looked_at = lengths.copy(), np.zeros(len(lengths), bool)
    known_free = np.zeros(len(roadmap.joints), bool)
    ends = _End(start, at_start), _End(goal, at_goal)
    for _ in count() if most is None else range(most):
        nodes = _a_star(
            roadmap.joints,
            begins,
            leads,
            own,
            goal,
            at_start.nodes,
            ends[0].lengths,
            at_goal.nodes,
            ends[1].lengths,
        )
        if not len(nodes):
            return None
        if space is None or (
            ends[0].holds(space, roadmap, nodes[0])
            and ends[1].holds(space, roadmap, nodes[-1])
            and _holds(space, roadmap.joints, begins, leads, own, known_free, looked_at, nodes)
        ):
            return np.concatenate([start[None], roadmap.joints[nodes], goal[None]])
    return None


class _End:
    """The edges between an end and the graph, looked at when a way has one."""

    def __init__(self, q: Float[np.ndarray, "D"], joined: Joined) -> None:
        self._q, self._nodes, self.lengths = q, joined.nodes, joined.lengths.copy()
        self._looked_at = np.zeros(len(joined.nodes), bool)

    def holds(self, space: Space, roadmap: Roadmap, node: int) -> bool:
        """Whether the edge to a node does; one that does not becomes infinitely long."""
        at = int(np.flatnonzero(self._nodes == node)[0])
        if not self._looked_at[at]:
            _edges(space, self._q, roadmap.joints, self._nodes[at:], self.lengths[at : at + 1], 1)
            self._looked_at[at] = True
        return bool(np.isfinite(self.lengths[at]))


def build_roadmap(space: Space, joints: Float[np.ndarray, "n D"], neighbours: int) -> Roadmap:
    """A graph over configurations of the space, each joined to its nearest neighbours where the
    edge holds.
    """
    edges = (
        nearest_neighbour_edges(joints, min(neighbours, len(joints) - 1))
        if len(joints) > 1
        else _NO_EDGES
    )
    lengths = np.empty(len(edges))
    edge_lengths(space, joints, edges, lengths)
    holds = np.isfinite(lengths)
    return Roadmap(joints, edges[holds], lengths[holds], components(len(joints), edges[holds]))


def resample(corners: Float[np.ndarray, "k D"], count: int) -> Float[np.ndarray, "count D"]:
    """Points spaced evenly along the straight lines between corners."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.linspace(0.0, way[-1], count)
    points = np.stack([np.interp(at, way, column) for column in corners.T], axis=1)
    points[0], points[-1] = corners[0], corners[-1]
    return points


@njit(**LEAF)
def distance(first, second):
    """Of two configurations [rad]."""
    square = 0.0
    for d in range(first.shape[0]):
        square += (first[d] - second[d]) ** 2
    return np.sqrt(square)


@njit(**LEAF)
def edge_length(space, first, second, work):
    """Length [rad] of the straight joint line between two configurations, projected; inf where it
    jumps or touches something.
    """
    dof = first.shape[0]
    direct = distance(first, second)
    pieces = int(np.ceil(direct / EDGE_STEP)) + 1
    allowed = 0.05 + 3.0 * direct / pieces
    before, point, total = work.before, work.point, 0.0
    keep_slopes(space, first, work)
    for d in range(dof):
        before[d] = first[d]
    for k in range(1, pieces + 1):
        for d in range(dof):
            point[d] = first[d] + k / pieces * (second[d] - first[d])
        if k < pieces and project_node(space, point, space.projection, work) > 1e-6:
            return np.inf
        step = distance(point, before)
        if not step <= allowed or turns_over(space, point, work):
            return np.inf
        if not is_free(space, before, point, work):
            return np.inf
        total += step
        for d in range(dof):
            before[d] = point[d]
    return total


@njit(**COMPILE)
def points_along(space, corners):
    """The points (n, D) of a way over corners (k, D) at which `edge_length` looked at its edges,
    corners included: no straight line between two neighbours touches anything.
    """
    count, dof, work = 1, corners.shape[1], workspace(space)
    for c in range(corners.shape[0] - 1):
        count += int(np.ceil(distance(corners[c], corners[c + 1]) / EDGE_STEP)) + 1
    points, i = np.empty((count, dof)), 0
    for c in range(corners.shape[0] - 1):
        first, second = corners[c], corners[c + 1]
        pieces = int(np.ceil(distance(first, second) / EDGE_STEP)) + 1
        for k in range(pieces):
            for d in range(dof):
                points[i, d] = first[d] + k / pieces * (second[d] - first[d])
            if k > 0:
                project_node(space, points[i], space.projection, work)
            i += 1
    points[i] = corners[-1]
    return points


@njit(**COMPILE)
def _edges(space, q, nodes, tried, lengths, enough):
    """Lengths of the edges from q to the nodes named by `tried`, until `enough` of them hold; inf
    for the others.
    """
    work = workspace(space)
    lengths[:] = np.inf
    found = 0
    for k in range(lengths.shape[0]):
        lengths[k] = edge_length(space, q, nodes[tried[k]], work)
        if lengths[k] < np.inf:
            found += 1
            if found >= enough:
                return


@njit(**COMPILE)
def edge_lengths(space, nodes, edges, lengths):
    """Lengths of many edges (m, 2) between nodes (n, D) into lengths (m,); inf where one does not
    hold.
    """
    work = workspace(space)
    for k in range(edges.shape[0]):
        lengths[k] = edge_length(space, nodes[edges[k, 0]], nodes[edges[k, 1]], work)


@njit(**COMPILE)
def _holds(space, joints, begins, leads, lengths, known_free, looked_at, way):
    """Whether all nodes and edges of a way hold in the space; its first and last node are known to.
    Nodes that do not, which cost least to look at, lose all their edges; else the first edge that
    does not becomes infinitely long, in either direction.
    """
    work = workspace(space)
    sound = True
    for k in range(1, way.shape[0] - 1):
        here = way[k]
        if not known_free[here]:
            known_free[here] = is_free(space, joints[here], joints[here], work)
            if not known_free[here]:
                sound = False
                for e in range(begins[here], begins[here + 1]):
                    _leave_out(begins, leads, lengths, here, leads[e])
    for k in range(way.shape[0] - 1 if sound else 0):
        here, there = way[k], way[k + 1]
        for e in range(begins[here], begins[here + 1]):
            if leads[e] != there or looked_at[e]:
                continue
            if edge_length(space, joints[here], joints[there], work) == np.inf:
                _leave_out(begins, leads, lengths, here, there)
                return False
            looked_at[e] = True
            for back in range(begins[there], begins[there + 1]):
                if leads[back] == here:
                    looked_at[back] = True
    return sound


@njit(**LEAF)
def _leave_out(begins, leads, lengths, first, second):
    """Make the edge between two nodes infinitely long, in either direction."""
    for e in range(begins[first], begins[first + 1]):
        if leads[e] == second:
            lengths[e] = np.inf
    for e in range(begins[second], begins[second + 1]):
        if leads[e] == first:
            lengths[e] = np.inf


@njit(**COMPILE)
def _a_star(nodes, begins, leads, lengths, goal, sources, source_lengths, targets, target_lengths):
    """Nodes of the shortest way from the sources to the targets, with the lengths at either end;
    empty for none.
    """
    n = nodes.shape[0]
    cost = np.full(n + 1, np.inf)  # entry n stands for the goal itself
    before = np.full(n + 1, -1, dtype=np.int64)
    closed = np.zeros(n + 1, dtype=np.bool_)
    last = np.full(n, np.inf)
    for k in range(targets.shape[0]):
        last[targets[k]] = target_lengths[k]
    heap = [(0.0, np.int64(0))]
    heap.pop()
    for k in range(sources.shape[0]):
        node = sources[k]
        if source_lengths[k] < cost[node]:
            cost[node] = source_lengths[k]
            heapq.heappush(heap, (cost[node] + distance(nodes[node], goal), np.int64(node)))
    while len(heap) > 0:
        node = heapq.heappop(heap)[1]
        if closed[node]:
            continue
        closed[node] = True
        if node == n:
            break
        if cost[node] + last[node] < cost[n]:
            cost[n] = cost[node] + last[node]
            before[n] = node
            heapq.heappush(heap, (cost[n], np.int64(n)))
        for e in range(begins[node], begins[node + 1]):
            other = leads[e]
            through = cost[node] + lengths[e]
            if through < cost[other]:
                cost[other] = through
                before[other] = node
                heapq.heappush(heap, (through + distance(nodes[other], goal), np.int64(other)))
    if not np.isfinite(cost[n]):
        return np.empty(0, dtype=np.int64)
    count = 0
    node = before[n]
    while node >= 0:
        count += 1
        node = before[node]
    way = np.empty(count, dtype=np.int64)
    node = before[n]
    while node >= 0:
        count -= 1
        way[count] = node
        node = before[node]
    return way
