"""A way between two configurations that needs no graph: two trees grown towards each other on the
constraint.

Constrained bidirectional rapidly-exploring random trees [Berenson et al. 2009; Kuffner and LaValle
2000], compiled.  Every step of a tree is projected onto the constraint, into the limits and out of
what it overlaps, and looked at as a whole; the way that is found is shortened by random shortcuts
and left to the elastic band.  The same seed gives the same way.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numba import njit

from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.search.roadmap import distance, edge_length
from constraint_geodesics.search.space import (
    Space,
    is_free,
    keep_slopes,
    project_node,
    turns_over,
    workspace,
)

_LEFT = 1e-6
"""Violation [rad or m] of a node, at most."""
_PROGRESS = 0.2
"""A step that brings a tree nearer to its target by less than this share of the step ends the
extension.
"""


@dataclass(frozen=True)
class TreeSettings:
    """step_rad: between two nodes.  iterations: random configurations that the trees are grown
    towards, at most.
    nodes: of one tree, at most.  shortcuts: tried on the way that is found.
    """

    step_rad: float = 0.15
    iterations: int = 400
    nodes: int = 3000
    shortcuts: int = 30


def tree_way(
    space: Space,
    start: Float[np.ndarray, "D"],
    goal: Float[np.ndarray, "D"],
    seed: int,
    settings: TreeSettings | None = None,
) -> Float[np.ndarray, "k D"] | None:
    """Corners of a way from start to goal [rad], both included, or None where the trees did not
    meet.

    """
    settings = settings or TreeSettings()
    corners = _grown(
        space,
        start,
        goal,
        seed,
        settings.step_rad,
        settings.iterations,
        settings.nodes,
        settings.shortcuts,
    )
    return corners if len(corners) else None


@njit(**LEAF)
def _nearest(nodes, count, q):
    best, smallest = 0, np.inf
    for n in range(count):
        distance = 0.0
        for d in range(q.shape[0]):
            distance += (nodes[n, d] - q[d]) ** 2
        if distance < smallest:
            best, smallest = n, distance
    return best


@njit(**LEAF)
def _extended(space, nodes, parents, count, node, target, step, work, point):
    """Grow a tree from one of its nodes towards a configuration as far as it gets.

    Returns how many nodes it has then, the last of them, and whether that is the target to the bit.
    """
    dof = target.shape[0]
    keep_slopes(space, nodes[node], work)
    while count < nodes.shape[0]:
        before = distance(target, nodes[node])
        share = 1.0 if before <= step else step / before
        for d in range(dof):
            point[d] = nodes[node, d] + share * (target[d] - nodes[node, d])
        if project_node(space, point, space.projection, work) > _LEFT:
            return count, node, False
        after, moved = distance(target, point), distance(point, nodes[node])
        reached = share == 1.0 and after < _LEFT
        if moved > 2.0 * step or (not reached and before - after < _PROGRESS * step):
            return count, node, False
        if turns_over(space, point, work):
            return count, node, False
        if not is_free(space, nodes[node], target if reached else point, work):
            return count, node, False
        for d in range(dof):
            nodes[count, d] = target[d] if reached else point[d]
        parents[count] = node
        node = count
        count += 1
        if reached:
            return count, node, True
    return count, node, False


@njit(**COMPILE)
def _chain(nodes, parents, node):
    """The nodes from one of a tree's back to its root."""
    length, n = 0, node
    while n >= 0:
        length += 1
        n = parents[n]
    way = np.empty((length, nodes.shape[1]))
    n = node
    for k in range(length):
        way[k] = nodes[n]
        n = parents[n]
    return way


@njit(**COMPILE)
def _grown(space, start, goal, seed, step, iterations, capacity, shortcuts):
    dof = start.shape[0]
    limits, work, point, drawn = space.limits, workspace(space), np.empty(dof), np.empty(dof)
    nodes, parents = np.empty((2, capacity, dof)), np.full((2, capacity), -1, dtype=np.int64)
    counts = np.ones(2, dtype=np.int64)
    nodes[0, 0], nodes[1, 0] = start, goal
    np.random.seed(seed)  # the compiled generator, which is none of numpy's  # noqa: NPY002
    a = 0
    for iteration in range(iterations):
        b = 1 - a
        if iteration == 0:
            drawn[:] = nodes[b, 0]
        else:
            for d in range(dof):
                drawn[d] = np.random.uniform(limits[0, d], limits[1, d])  # noqa: NPY002
        near = _nearest(nodes[a], counts[a], drawn)
        counts[a], last, _ = _extended(
            space, nodes[a], parents[a], counts[a], near, drawn, step, work, point
        )
        near = _nearest(nodes[b], counts[b], nodes[a, last])
        counts[b], other, met = _extended(
            space, nodes[b], parents[b], counts[b], near, nodes[a, last].copy(), step, work, point
        )
        if met or (counts[b] == 1 and np.array_equal(nodes[a, last], nodes[b, 0])):
            first, second = (last, other) if a == 0 else (other, last)
            there, back = _chain(nodes[0], parents[0], first), _chain(nodes[1], parents[1], second)
            way = np.empty((len(there) + len(back) - 1, dof))
            for k in range(len(there)):
                way[k] = there[len(there) - 1 - k]
            way[len(there) :] = back[1:]
            return _shortened(space, way, shortcuts, work)
        if counts[0] == capacity or counts[1] == capacity:
            break
        a = b if counts[b] <= counts[a] else a  # the smaller tree grows
    return np.empty((0, dof))


@njit(**COMPILE)
def _shortened(space, way, shortcuts, work):
    """The way without the corners that random shortcuts leave out."""
    count = len(way)
    length = np.empty(max(count - 1, 1))
    for k in range(count - 1):
        length[k] = distance(way[k + 1], way[k])
    for tried in range(shortcuts + 1):
        if count < 3:
            break
        first, last = 0, count - 1
        if tried > 0:
            first = np.random.randint(0, count - 2)  # noqa: NPY002
            last = np.random.randint(first + 2, count)  # noqa: NPY002
        between = 0.0
        for k in range(first, last):
            between += length[k]
        direct = edge_length(space, way[first], way[last], work)
        if direct < between:
            gone = last - first - 1
            length[first] = direct
            for k in range(last, count):
                way[k - gone] = way[k]
            for k in range(last, count - 1):
                length[k - gone] = length[k]
            count -= gone
    return way[:count].copy()
