"""Clearance of an arm to the shapes of its workcell and to itself, compiled: what keeps curves out
of a collision.

It is the distance of the convex pieces that the certificate knows too, on the search's own
kinematics, with the direction in which it grows; where pieces overlap, how deep they do.
"""

from collections.abc import Collection
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.robot.kernels import joint_frame, line_of
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene import convex_kernels as convex
from constraint_geodesics.scene.bodies import BodyTable, Pair
from constraint_geodesics.scene.pieces import Piece
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.world import BodyKey

# columns of a contact
DISTANCE, PAIR = 0, 1
"""Distance [m], and which pair of pieces it is."""
NORMAL, POINT = 2, 5
"""Unit vector (3) from the first body to the second, and the second's nearest point (3), in the
base frame.
"""
_CONTACT = 8
_OVERLAPPING = 1e-7
FINEST_M = 0.001
"""Motion over which a line is looked at no closer: the certificate does."""
SLACK_M = 0.1
"""How much further away pairs are kept in mind, at configurations that are asked about again."""
_DEEPEST = 32
_SIGNS = [(x, y, z) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0) for z in (-1.0, 0.0, 1.0)]
_TRIED = np.array([np.divide(s, np.linalg.norm(s)) for s in _SIGNS if any(s)])
"""Directions (26, 3) in which overlapping pieces are looked at."""


class ClearanceArrays(NamedTuple):
    """What may meet, as convex_kernels.py takes it: hulls (H,), nodes (N, REACH + D) and pairs
    (P, PAIR), of which the first `top` are of bodies.
    """

    hulls: np.ndarray
    nodes: np.ndarray
    pairs: np.ndarray
    top: int


class Contacts(NamedTuple):
    """What the kernels write into: nodes and pairs of their own, frames (D + 1, 12), joint
    origins and axes (D, 3), and `found` (P, 8), the contacts by the columns above; a point (D,) of
    a line, and its parts that are still looked at.  all_pairs (P,): of bodies, in their order.
    """

    nodes: np.ndarray
    pairs: np.ndarray
    frames: np.ndarray
    origins: np.ndarray
    axes: np.ndarray
    simplex: np.ndarray
    found: np.ndarray
    point: np.ndarray
    parts: np.ndarray
    all_pairs: np.ndarray


@dataclass(frozen=True)
class ClearanceModel:
    """A scene's convex pieces, and the pairs of them that may meet."""

    arrays: ClearanceArrays

    def clearance(
        self, robot: SerialRobot, q: Float[np.ndarray, "*batch D"], far: float = np.inf
    ) -> Float[np.ndarray, "*batch"]:
        """Smallest distance of any two bodies that must not touch [m], negative where they overlap;
        `far` where nothing is nearer, which with a small one takes a small part of the time.
        """
        flat = np.ascontiguousarray(q, np.float64).reshape(-1, robot.dof)
        smallest = np.empty(len(flat))
        clearance_batch(robot.chain, self.arrays, far, flat, smallest)
        return smallest.reshape(q.shape[:-1])


_NOTHING = np.empty(0), np.empty((0, convex.REACH)), np.empty((0, convex.PAIR))
NO_CLEARANCE = ClearanceModel(ClearanceArrays(*_NOTHING, 0))
"""Where nothing can meet."""


class Clearances:
    """The model of a scene that changes.  apart: pairs that are known never to meet, which need no
    look.  Raises RobotError where a collision shape can't be bounded, naming it.
    """

    def __init__(self, scene: Scene, apart: Collection[Pair] = ()) -> None:
        robot = scene.robot
        frames = _frames(robot.chain, np.zeros(robot.dof))
        self._table = BodyTable(scene, frames, partial(_reach, robot))
        self._apart = frozenset(apart)

    def change(self, scene: Scene) -> None:
        """Follow the scene; nothing has changed where it raises."""
        self._table.change(scene)

    @property
    def state(self) -> tuple[Any, ...]:
        """To be taken back by `restore`."""
        return self._table.state

    def restore(self, state: tuple[Any, ...]) -> None:
        """Be as before."""
        self._table.restore(state)

    def model(
        self, apart: Collection[Pair] | None = None, without: Collection[str] = ()
    ) -> ClearanceModel:
        """Of the scene as it is now.  apart: as above, where others are known by now.  without:
        names of shapes that are left out.
        """
        ends = self._ends(self._apart if apart is None else apart, without)
        if not len(ends):
            return NO_CLEARANCE
        return ClearanceModel(ClearanceArrays(*self._table.arrays(ends), len(ends)))

    def pairs(self, apart: Collection[Pair], without: Collection[str]) -> frozenset[Pair]:
        """What that model looks at."""
        keys = list(self._table.bodies)
        return frozenset((keys[a], keys[b]) for a, b in self._ends(apart, without))

    def _ends(self, apart: Collection[Pair], without: Collection[str]) -> Int[np.ndarray, "n 2"]:
        """The pairs that may meet, by the places of their bodies."""
        table, frames = self._table, self._table.frames
        kept = (frames[:, 0] != frames[:, 1]) & ~table.named(apart)
        if without:
            left_out = {BodyKey(name, True) for name in without}
            kept &= ~np.array([key in left_out for key in table.bodies])[table.ends].any(axis=1)
        found: Int[np.ndarray, "n 2"] = table.ends[kept]
        return found


def clearance_model(scene: Scene, apart: Collection[Pair] = ()) -> ClearanceModel:
    """The model of a scene, as `Clearances` makes it."""
    return Clearances(scene, apart).model()


def _reach(robot: SerialRobot, piece: Piece, frame: int) -> Float[np.ndarray, "D"]:
    """How far a piece's points get from each axis at most: along the links, stretched out."""
    reach, prismatic = np.zeros(robot.dof), robot.chain.prismatic
    extents = np.abs(np.stack([robot.lower, robot.upper])).max(axis=0) * prismatic
    lengths = np.linalg.norm(robot.chain.origins[:, :3, 3], axis=1)
    away = np.linalg.norm(piece.corners, axis=1).max() + piece.rounding
    for j in range(frame - 1, -1, -1):
        away += extents[j]
        reach[j] = 1.0 if prismatic[j] else away
        away += lengths[j]
    return reach


@njit(**COMPILE)
def new_contacts(model, dof):
    """What the kernels write into."""
    return Contacts(
        model.nodes.copy(),
        model.pairs.copy(),
        np.empty((dof + 1, 12)),
        np.empty((dof, 3)),
        np.empty((dof, 3)),
        np.empty(convex.SIMPLEX),
        np.empty((max(model.pairs.shape[0], 1), _CONTACT)),
        np.empty(dof),
        np.empty((_DEEPEST, 2)),
        np.arange(model.top),
    )


class Nearby(NamedTuple):
    """Pairs of bodies that may be near at K configurations: where these were when the pairs were
    sought, seen (K, D), nan for never; how many there are, counts (K,), and which, listed (K, P).
    reach (D,): how far anything gets from each axis at most [m], 1 for a prismatic joint.
    """

    seen: np.ndarray
    counts: np.ndarray
    listed: np.ndarray
    reach: np.ndarray


@njit(**COMPILE)
def new_nearby(model, count, dof):
    """Of so many configurations, for `near_again`."""
    reach = np.zeros(dof)
    for node in model.nodes:
        for j in range(dof):
            reach[j] = max(reach[j], node[convex.REACH + j])
    return Nearby(
        np.full((count, dof), np.nan),
        np.zeros(count, np.int64),
        np.empty((count, model.top), np.int64),
        reach,
    )


@njit(**LEAF)
def _place_frames(chain, q, frames, joint_origins, joint_axes):
    """Frames (D + 1, 12) of one configuration, joint origins and axes (D, 3)."""
    origins, axes, prismatic, base, _ = chain
    # the base's frame is where its links are read
    frames[0] = 0.0
    frames[0, 3] = frames[0, 7] = frames[0, 11] = 1.0
    frame = line_of(base, 0), line_of(base, 1), line_of(base, 2)
    for j in range(q.shape[0]):
        frame = joint_frame(origins, axes, prismatic, q, j, frame, joint_origins, joint_axes)
        own = frames[j + 1]
        own[0], own[3], own[4], own[5] = frame[0]
        own[1], own[6], own[7], own[8] = frame[1]
        own[2], own[9], own[10], own[11] = frame[2]


@njit(**COMPILE)
def _frames(chain, q):
    frames, dof = np.empty((q.shape[0] + 1, 12)), q.shape[0]
    _place_frames(chain, q, frames, np.empty((dof, 3)), np.empty((dof, 3)))
    return frames


@njit(**LEAF)
def _place(chain, q, room):
    """Frames, joint origins, axes and the nodes' balls of one configuration into `room`."""
    _place_frames(chain, q, room.frames, room.origins, room.axes)
    convex.place_balls(room.nodes, room.frames)


@njit(**LEAF)
def _shallowest(bodies, frames, p, simplex):
    """How deep a pair of pieces overlaps, as a distance below 0, in the direction in which it is
    least of those that are tried, which becomes the pair's; the second's deepest point into
    `simplex`.  Directions along which the middle of the second alone is deeper are not tried.
    """
    hulls, nodes, pairs = bodies
    a, b = int(pairs[p, 0]), int(pairs[p, 1])
    f, g = int(nodes[a, convex.FRAME]), int(nodes[b, convex.FRAME])
    x = nodes[b, convex.PLACE] - nodes[a, convex.PLACE]
    y = nodes[b, convex.PLACE + 1] - nodes[a, convex.PLACE + 1]
    z = nodes[b, convex.PLACE + 2] - nodes[a, convex.PLACE + 2]
    length = np.sqrt(x * x + y * y + z * z)
    # the vector that they touched along first, so that the depth begins at 0
    u, v, w = pairs[p, convex.VECTOR], pairs[p, convex.VECTOR + 1], pairs[p, convex.VECTOR + 2]
    best = convex.turned(frames, f, u, v, w)
    most = convex.gap_along(bodies, frames, p, best)
    box = nodes[a, convex.BOX] >= 0.0
    count = _TRIED.shape[0]
    for k in range(-1, count + 6 if box else count):
        if k < 0:
            if length < _OVERLAPPING:
                continue
            n = (x / length, y / length, z / length)
        elif k < count:
            n = (_TRIED[k, 0], _TRIED[k, 1], _TRIED[k, 2])
        else:
            at, sign = convex.BOX + 3 + (k - count) // 2, 1.0 if k % 2 == 0 else -1.0
            n = (sign * nodes[a, at], sign * nodes[a, at + 3], sign * nodes[a, at + 6])
        beyond = n[0] * x + n[1] * y + n[2] * z
        if box:
            for i in range(3):
                at = convex.BOX + 3 + i
                along = n[0] * nodes[a, at] + n[1] * nodes[a, at + 3] + n[2] * nodes[a, at + 6]
                beyond -= nodes[a, convex.BOX + i] * abs(along)
        if beyond <= most:
            continue
        value = convex.gap_along(bodies, frames, p, n)
        if value > most:
            best, most = n, value
    most = convex.gap_along(bodies, frames, p, best)  # once more, for its corners
    corner = int(pairs[p, convex.CORNERS + 1])
    x, y, z = convex.turned(frames, g, hulls[corner], hulls[corner + 1], hulls[corner + 2])
    simplex[convex.NEAREST, 3] = x + frames[g, 0]
    simplex[convex.NEAREST, 4] = y + frames[g, 1]
    simplex[convex.NEAREST, 5] = z + frames[g, 2]
    x, y, z = convex.into(frames, f, best[0], best[1], best[2])
    pairs[p, convex.VECTOR], pairs[p, convex.VECTOR + 1], pairs[p, convex.VECTOR + 2] = x, y, z
    return most


@njit(**LEAF)
def _measure(bodies, frames, simplex, p, far, contact):
    """The contact (8,) of one pair of pieces; False where they are further apart than `far` [m]."""
    _, nodes, pairs = bodies
    a, b = int(pairs[p, 0]), int(pairs[p, 1])
    if convex.roughly_apart(nodes, a, b) >= far:
        return False
    rounding = nodes[a, convex.ROUNDING] + nodes[b, convex.ROUNDING]
    lower, upper = convex.distance(bodies, frames, p, (far + rounding, -np.inf), simplex)
    if lower - rounding >= far:
        return False
    if upper < _OVERLAPPING:
        lower = _shallowest(bodies, frames, p, simplex)
        if lower - rounding >= far:
            return False
    x, y, z = pairs[p, convex.VECTOR], pairs[p, convex.VECTOR + 1], pairs[p, convex.VECTOR + 2]
    x, y, z = convex.turned(frames, int(nodes[a, convex.FRAME]), x, y, z)
    contact[DISTANCE], contact[PAIR] = lower - rounding, p
    contact[NORMAL], contact[NORMAL + 1], contact[NORMAL + 2] = x, y, z
    for d in range(3):
        contact[POINT + d] = simplex[convex.NEAREST, 3 + d]
    return True


@njit(**LEAF)
def near_contacts(chain, model, q, far, room):
    """The contacts of one configuration that are nearer than `far` [m] into `room`, the nearest
    first, one for each pair of bodies; returns how many.
    """
    _place(chain, q, room)
    return _near_of(model, far, room, room.all_pairs)


@njit(**LEAF)
def near_again(chain, model, q, far, room, nearby, k):
    """The same for the k-th of configurations that are asked about again and again, a little moved,
    with the same `far`: only pairs are looked at that were within SLACK_M of it where they were
    sought last, until a body may have moved by as much.
    """
    seen, moved = nearby.seen[k], 0.0
    for d in range(q.shape[0]):
        moved += abs(q[d] - seen[d]) * nearby.reach[d]
    _place(chain, q, room)
    listed = nearby.listed[k]
    if not moved < SLACK_M:  # nan where they never were
        nodes, pairs, count = room.nodes, room.pairs, 0
        for d in range(q.shape[0]):
            seen[d] = q[d]
        for body in range(model.top):
            a, b = int(pairs[body, 0]), int(pairs[body, 1])
            if convex.roughly_apart(nodes, a, b) < far + SLACK_M:
                listed[count] = body
                count += 1
        nearby.counts[k] = count
    return _near_of(model, far, room, listed[: nearby.counts[k]])


@njit(**LEAF)
def _near_of(model, far, room, listed):
    """The contacts of those pairs of bodies (k,) at the place that `room` has."""
    nodes, pairs, frames, found = room.nodes, room.pairs, room.frames, room.found
    simplex, bodies = room.simplex, (model.hulls, room.nodes, room.pairs)
    count = 0
    for body in listed:
        if convex.roughly_apart(nodes, int(pairs[body, 0]), int(pairs[body, 1])) >= far:
            continue
        least = far
        first, last = convex.pieces_of(pairs, body)
        for p in range(first, last):
            if _measure(bodies, frames, simplex, p, least, found[count]):
                least = found[count, DISTANCE]
        if least >= far:
            continue
        at = count
        while at > 0 and found[at, DISTANCE] < found[at - 1, DISTANCE]:
            for d in range(_CONTACT):
                found[at, d], found[at - 1, d] = found[at - 1, d], found[at, d]
            at -= 1
        count += 1
    return count


@njit(**LEAF)
def _motion(nodes, pairs, p, first, second):
    """How far the second of a pair moves at most, seen from the first [m], over half a line."""
    a, b = int(pairs[p, 0]), int(pairs[p, 1])
    motion = 0.0
    for j in range(int(nodes[a, convex.FRAME]), int(nodes[b, convex.FRAME])):
        motion += abs(second[j] - first[j]) * nodes[b, convex.REACH + j]
    return 0.5 * motion


@njit(**LEAF)
def _apart(bodies, frames, simplex, p, motion):
    """Whether a pair of pieces is further apart than `motion` [m]: 1 for yes, −1 if it overlaps, 0
    else.
    """
    _, nodes, pairs = bodies
    a, b = int(pairs[p, 0]), int(pairs[p, 1])
    if convex.roughly_apart(nodes, a, b) > motion:
        return 1
    rounding = nodes[a, convex.ROUNDING] + nodes[b, convex.ROUNDING]
    lower, upper = convex.distance(bodies, frames, p, (motion + rounding, rounding), simplex)
    if lower - rounding > motion:
        return 1
    return -1 if upper <= rounding else 0


@njit(**LEAF)
def stays_clear(chain, model, first, second, room):
    """Whether nothing overlaps on the straight joint line between two configurations, but for parts
    over which nothing moves by more than FINEST_M from their middle.
    """
    nodes, pairs, frames, simplex = room.nodes, room.pairs, room.frames, room.simplex
    bodies, found, dof = (model.hulls, room.nodes, room.pairs), room.found, first.shape[0]
    q, parts = room.point, room.parts
    for d in range(dof):
        q[d] = 0.5 * (first[d] + second[d])
    _place(chain, q, room)
    count = 0
    for body in range(model.top):
        a, b = int(pairs[body, 0]), int(pairs[body, 1])
        if convex.roughly_apart(nodes, a, b) > _motion(nodes, pairs, body, first, second):
            continue
        begin, end = convex.pieces_of(pairs, body)
        for p in range(begin, end):
            motion = _motion(nodes, pairs, p, first, second)
            apart = _apart(bodies, frames, simplex, p, motion)
            if apart < 0:
                return False
            if apart == 0 and motion > FINEST_M:
                found[count, PAIR] = p
                count += 1
    for c in range(count):
        p, left = int(found[c, PAIR]), 2
        motion = _motion(nodes, pairs, p, first, second)
        parts[0, 0], parts[0, 1], parts[1, 0], parts[1, 1] = 0.0, 0.5, 0.5, 1.0
        while left > 0:
            left -= 1
            start, end = parts[left, 0], parts[left, 1]
            middle, moves = 0.5 * (start + end), motion * (end - start)
            for d in range(dof):
                q[d] = first[d] + middle * (second[d] - first[d])
            _place_frames(chain, q, frames, room.origins, room.axes)
            for side in range(2):
                convex.place_ball(nodes, frames, int(pairs[p, side]))
            apart = _apart(bodies, frames, simplex, p, moves)
            if apart < 0:
                return False
            if apart == 0 and moves > FINEST_M and left + 2 <= _DEEPEST:
                parts[left, 0], parts[left, 1] = start, middle
                parts[left + 1, 0], parts[left + 1, 1] = middle, end
                left += 2
    return True


@njit(inline="always", **COMPILE)
def frames_of(room, c):
    """The frames that carry the two bodies of a contact; joint j carries frame j + 1."""
    p = int(room.found[c, PAIR])
    a, b = int(room.pairs[p, 0]), int(room.pairs[p, 1])
    return int(room.nodes[a, convex.FRAME]), int(room.nodes[b, convex.FRAME])


@njit(**LEAF)
def contact_row(prismatic, room, c, row):
    """Gradient (D,) of a contact's distance into `row`; returns its length."""
    found, axes, origins = room.found, room.axes, room.origins
    first, last = frames_of(room, c)
    n0, n1, n2 = found[c, NORMAL], found[c, NORMAL + 1], found[c, NORMAL + 2]
    p0, p1, p2 = found[c, POINT], found[c, POINT + 1], found[c, POINT + 2]
    row[:] = 0.0
    for j in range(first, last):
        a0, a1, a2 = axes[j, 0], axes[j, 1], axes[j, 2]
        if prismatic[j]:
            row[j] = n0 * a0 + n1 * a1 + n2 * a2
            continue
        x, y, z = p0 - origins[j, 0], p1 - origins[j, 1], p2 - origins[j, 2]
        row[j] = n0 * (a1 * z - a2 * y) + n1 * (a2 * x - a0 * z) + n2 * (a0 * y - a1 * x)
    square = 0.0
    for j in range(first, last):
        square += row[j] ** 2
    return np.sqrt(square)


@njit(**COMPILE)
def clearance_batch(chain, model, far, q, smallest):
    """Smallest distance of any two bodies that must not touch, of q (B, D) into smallest (B,), at
    most `far`.
    """
    room = new_contacts(model, q.shape[1])
    for b in range(q.shape[0]):
        smallest[b] = far
        if near_contacts(chain, model, q[b], far, room) > 0:
            smallest[b] = room.found[0, DISTANCE]


@njit(**COMPILE)
def path_stays_clear(chain, model, q):
    """Whether nothing overlaps on the straight joint lines between configurations (T, D)."""
    room, lines = new_contacts(model, q.shape[1]), q.shape[0] - 1
    clear = True
    for b in range(lines // 2, lines):  # what meets something mostly does in the middle
        clear = clear and stays_clear(chain, model, q[b], q[b + 1], room)
    for b in range(lines // 2 - 1, -1, -1):
        clear = clear and stays_clear(chain, model, q[b], q[b + 1], room)
    return clear
