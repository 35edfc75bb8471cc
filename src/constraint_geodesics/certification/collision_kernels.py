"""Compiled proof that an arm's pieces stay apart, from each other and from what stands around them,
on the whole of a path of straight joint lines.

Shared with the search is the distance of two pieces (scene/convex_kernels.py), which is compared
with PyBullet's, and nothing else.  D joints, T rows of a path, N nodes: bodies and their
convex pieces, each carried by a frame.  Frame 0 is the base, frame j + 1 is joint j's.

Two bodies a and b, carried by the frames f_a < f_b, move relative to each other by the joints
f_a … f_b − 1 alone.  Seen from f_a, a stands still, and with ρ_j the furthest that b's points get
from the axis of joint j (1 for a prismatic joint), a point p of b moves by

    |∂p/∂q_j| ≤ ρ_j and, for i ≤ j, as ∂²p/∂q_i∂q_j = a_i × (a_j × (p − o_j)),  |∂²p/∂q_i∂q_j| ≤ ρ_j

An interval of the path, between the rows i and k, is free if one of two bounds says so for each
pair, both for the distance without the pieces' roundings r_a + r_b and the margin:

- at the row m between them: distance − Σ_j ρ_j v_j, with v_j how far joint j travels from m at
  most;
- at both ends: min(g_i, g_k) − ⅛ Σ_j |d_j| ρ_j (|d_j| + 2 Σ_{h<j} |d_h|) − Σ_j ρ_j e_j, with n
  fixed in f_a's frame, d the increments from row i to row k, and e_j how far joint j is off the
  straight line between them, since a function whose second derivative is at most M lies no further
  than M/8 below its values at both ends.

Intervals that neither decides are halved, those between two rows as well.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from constraint_geodesics.certification.kernels import BASE, next_frame
from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.scene import convex_kernels as convex

# entries of a level
PROVEN, ATTAINED, ASKED, MARGIN, HERE = 0, 1, 2, 3, 4
"""Distances [m]: the least that is proven so far, the least that is attained somewhere, what is
asked for, what must be proven, and one that the last pair has at the last place.
"""

SHARE = 0.5
"""Of the least distance that is attained somewhere, so much is proven to be kept everywhere."""
_CLOSE = 0.3
"""Motion [m] over which two bodies are not looked at closer: halving the interval costs less."""
_SHORTEST = 1e-6
"""Increment of a joint [rad or m] below which nothing is halved any more."""
_DEEPEST = 64


class Bodies(NamedTuple):
    """What may meet, on a chain as chain.py describes it.

    hulls (H,), nodes (N, REACH + D) and pairs (P, PAIR): those of convex_kernels.py.  The columns
    of a pair begin with two nodes, that of the lower frame first, and the range of the pairs of
    their pieces, which is empty for pieces.  The first `top` pairs are of bodies.
    """

    chain: Any
    hulls: np.ndarray
    nodes: np.ndarray
    pairs: np.ndarray
    top: int


@njit(**LEAF)
def joint_frames(chain, q, frames):
    """Frames (D + 1, 12) of one configuration: position [m], then rotation by rows."""
    turns, offsets, prismatic, _ = chain
    w, x, y, z, p0, p1, p2 = BASE
    a0, a1, a2 = 0.0, 0.0, 1.0
    for f in range(q.shape[0] + 1):
        if f > 0:
            j = f - 1
            angle, slide = (0.0, q[j]) if prismatic[j] else (q[j], 0.0)
            w, x, y, z, p0, p1, p2, a0, a1, a2 = next_frame(
                turns, offsets, j, angle, slide, (w, x, y, z, p0, p1, p2)
            )
        frames[f, 0], frames[f, 1], frames[f, 2] = p0, p1, p2
        frames[f, 3] = w * w + x * x - y * y - z * z
        frames[f, 4] = 2.0 * (x * y - w * z)
        frames[f, 6] = 2.0 * (x * y + w * z)
        frames[f, 7] = w * w - x * x + y * y - z * z
        frames[f, 9] = 2.0 * (x * z - w * y)
        frames[f, 10] = 2.0 * (y * z + w * x)
        frames[f, 5], frames[f, 8], frames[f, 11] = a0, a1, a2


@njit(**LEAF)
def _attained(level, value):
    """A distance that two pieces have somewhere: no more than it can be proven, so a share of it is
    asked for, as long as that is above the margin.
    """
    level[HERE] = value
    if value < level[ATTAINED]:
        level[ATTAINED] = value
        level[ASKED] = max(level[MARGIN], SHARE * value)


@njit(**LEAF)
def _nearest(bodies, top, frames, level, simplex):
    """The least distance of any pair at one place into `level`; returns that pair, −1 where another
    place has less.
    """
    _, nodes, pairs = bodies
    convex.place_balls(nodes, frames)
    nearest = -1
    for body in range(top):
        a, b = int(pairs[body, 0]), int(pairs[body, 1])
        if convex.roughly_apart(nodes, a, b) >= level[ATTAINED]:
            continue
        first, last = convex.pieces_of(pairs, body)
        for p in range(first, last):
            a, b = int(pairs[p, 0]), int(pairs[p, 1])
            if convex.roughly_apart(nodes, a, b) >= level[ATTAINED]:
                continue
            rounding = nodes[a, convex.ROUNDING] + nodes[b, convex.ROUNDING]
            wanted = (level[ATTAINED] + rounding, -np.inf)
            lower, _ = convex.distance(bodies, frames, p, wanted, simplex)
            if max(lower, 0.0) - rounding < level[ATTAINED]:
                nearest = p
            _attained(level, max(lower, 0.0) - rounding)
    return nearest


@njit(**LEAF)
def _measure(rows, travelled, interval, steps):
    """What an interval of rows (first, middle, last) amounts to, into steps (3, D): how far each
    joint travels from the middle at most, its increment, and how far it gets off the straight line.
    """
    i, m, k = interval
    dof = rows.shape[1]
    whole = travelled[k, dof] - travelled[i, dof]
    for d in range(dof):
        steps[0, d] = max(travelled[m, d] - travelled[i, d], travelled[k, d] - travelled[m, d])
        steps[1, d] = abs(rows[k, d] - rows[i, d])
        steps[2, d] = 0.0
    for r in range(i + 1, k):
        share = (travelled[r, dof] - travelled[i, dof]) / whole if whole > 0.0 else 0.0
        for d in range(dof):
            off = abs(rows[r, d] - rows[i, d] - share * (rows[k, d] - rows[i, d]))
            steps[2, d] = max(steps[2, d], off)


@njit(**LEAF)
def _bounds_of_motion(nodes, a, b, steps):
    """How far b's points move from the middle of an interval at most, seen from a: Σ ρ_j v_j; and
    how far they get off their way's ends: ⅛ Σ |d_j| ρ_j (|d_j| + 2 Σ |d_h|) + Σ ρ_j e_j.
    """
    motion, bend, off, before = 0.0, 0.0, 0.0, 0.0
    for j in range(int(nodes[a, convex.FRAME]), int(nodes[b, convex.FRAME])):
        reach, step = nodes[b, convex.REACH + j], steps[1, j]
        motion += reach * steps[0, j]
        bend += step * reach * (step + 2.0 * before)
        off += reach * steps[2, j]
        before += step
    return motion, 0.125 * bend + off


@njit(**LEAF)
def _is_proven(bodies, frames, places, p, level, steps, simplex):
    """Whether one pair of pieces is free on an interval; places: of its ends and its middle.  Where
    it is not, level[HERE] is a distance that it has in the middle, inf where that is not known.
    """
    _, nodes, pairs = bodies
    a, b = int(pairs[p, 0]), int(pairs[p, 1])
    f, rounding = int(nodes[a, convex.FRAME]), nodes[a, convex.ROUNDING] + nodes[b, convex.ROUNDING]
    motion, bend = _bounds_of_motion(nodes, a, b, steps)
    level[HERE] = np.inf
    if min(motion, bend) > _CLOSE:
        return False
    for attempt in range(2):
        bound = -np.inf
        x, y, z = pairs[p, convex.VECTOR], pairs[p, convex.VECTOR + 1], pairs[p, convex.VECTOR + 2]
        if bend < motion and (x != 0.0 or y != 0.0 or z != 0.0):
            gap, enough = np.inf, level[ASKED] + rounding + bend
            for end in range(2):
                if gap > enough:
                    n = convex.turned(frames[places[end]], f, x, y, z)
                    gap = min(gap, convex.gap_along(bodies, frames[places[end]], p, n))
            if gap > enough:  # at both ends
                bound = gap - bend
        if attempt == 0 and bound - rounding <= level[ASKED]:
            too_little = level[MARGIN] + rounding + min(motion, bend)
            wanted = (level[ASKED] + rounding + motion, too_little)
            lower, upper = convex.distance(bodies, frames[places[2]], p, wanted, simplex)
            _attained(level, upper - rounding)
            bound = lower - motion
        if bound - rounding > level[ASKED]:
            level[PROVEN] = min(level[PROVEN], bound - rounding)
            return True
        if bend >= motion:
            break
    return False


@njit(**LEAF)
def _sift(bodies, frames, interval, todo, level, steps, simplex):
    """Leave the pairs of an interval of rows that are not proven free in todo (P + 1,), their
    number first; a pair of bodies that are close is replaced by the pairs of their pieces.
    """
    i, m, k = interval
    _, nodes, pairs = bodies
    convex.place_balls(nodes, frames[m])
    count, kept, c = todo[0], 0, 0
    while c < count:
        c += 1
        p = todo[c]
        a, b = int(pairs[p, 0]), int(pairs[p, 1])
        first, last = int(pairs[p, 2]), int(pairs[p, 3])
        motion, _ = _bounds_of_motion(nodes, a, b, steps)
        free = convex.roughly_apart(nodes, a, b) - motion
        if free > level[ASKED]:
            level[PROVEN] = min(level[PROVEN], free)
            continue
        if first < last and (motion < _CLOSE or k - i <= 1):
            for child in range(first, last):
                count += 1
                todo[count] = child
            continue
        if (
            first == last
            and k - i > 1
            and _is_proven(bodies, frames, (i, k, m), p, level, steps, simplex)
        ):
            continue
        kept += 1
        todo[kept] = p
    todo[0] = kept


@njit(**LEAF)
def _place(chain, rows, i, share, q, frames):
    """Configuration (D,) and frames (D + 1, 12) on the line from row i to the next."""
    for d in range(rows.shape[1]):
        q[d] = rows[i, d] + share * (rows[i + 1, d] - rows[i, d])
    joint_frames(chain, q, frames)


@njit(**COMPILE)
def nearest_pair(bodies, q, most):
    """The least distance [m] of any two bodies that may meet at one configuration, and which pair
    it is: `most` and −1 where that is more.
    """
    frames, simplex = np.empty((q.shape[0] + 1, 12)), np.empty(convex.SIMPLEX)
    level = np.empty(5)
    for i in range(5):
        level[i] = most
    joint_frames(bodies.chain, q, frames)
    own = (bodies.hulls, bodies.nodes.copy(), bodies.pairs.copy())
    nearest = _nearest(own, bodies.top, frames, level, simplex)
    return level[ATTAINED], nearest


@njit(**COMPILE)
def prove_apart(bodies, rows, margin, undecided):
    """Prove that all pairs of bodies stay further apart than `margin` [m] on the lines between rows
    (T, D).

    Returns what is proven to be the least distance, the parts that are, one that is attained,
    and how many parts are not: into undecided (M, 4) row, from, to [share of the line to the next]
    and pair.  The search ends with the (M + 1)th.
    """
    count, dof = rows.shape
    chain, top = bodies.chain, bodies.top
    own = (bodies.hulls, bodies.nodes.copy(), bodies.pairs.copy())
    # after the rows' frames come those of three places on a line
    frames, known = np.empty((count + 3, dof + 1, 12)), np.zeros(count, dtype=np.bool_)
    travelled, steps = np.zeros((count, dof + 1)), np.empty((3, dof))
    simplex, q = np.empty(convex.SIMPLEX), np.empty(dof)
    level = np.array([np.inf, np.inf, margin, margin, np.inf])
    for i in range(1, count):
        travelled[i, dof] = travelled[i - 1, dof]
        for d in range(dof):
            step = abs(rows[i, d] - rows[i - 1, d])
            travelled[i, d] = travelled[i - 1, d] + step
            travelled[i, dof] += step
    for i in (0, count - 1):
        joint_frames(chain, rows[i], frames[i])
        known[i] = True
        _nearest(own, top, frames[i], level, simplex)
    lists = np.empty((_DEEPEST, own[2].shape[0] + 1), dtype=np.int64)
    spans, parts = np.empty((_DEEPEST, 2), dtype=np.int64), np.empty((_DEEPEST, 2))
    spans[0, 0], spans[0, 1], lists[0, 0] = 0, count - 1, top
    for p in range(top):
        lists[0, p + 1] = p
    waiting, missing = 1, 0
    while waiting > 0 and missing <= undecided.shape[0]:
        waiting -= 1
        i, k = spans[waiting, 0], spans[waiting, 1]
        m, todo = (i + k) // 2, lists[waiting]
        if not known[m]:
            joint_frames(chain, rows[m], frames[m])
            known[m] = True
        _measure(rows, travelled, (i, m, k), steps)
        _sift(own, frames, (i, m, k), todo, level, steps, simplex)
        if k - i > 1:
            if todo[0] > 0:
                for c in range(todo[0] + 1):
                    lists[waiting + 1, c] = todo[c]
                spans[waiting, 0], spans[waiting, 1] = m, k
                spans[waiting + 1, 0], spans[waiting + 1, 1] = i, m
                waiting += 2
            continue
        for c in range(1, todo[0] + 1):
            p, left = todo[c], 1
            parts[0, 0], parts[0, 1] = 0.0, 1.0
            while left > 0 and missing <= undecided.shape[0]:
                left -= 1
                start, end = parts[left, 0], parts[left, 1]
                middle, shortest = 0.5 * (start + end), True
                _place(chain, rows, i, start, q, frames[count])
                _place(chain, rows, i, end, q, frames[count + 1])
                _place(chain, rows, i, middle, q, frames[count + 2])
                for d in range(dof):
                    steps[1, d] = (end - start) * abs(rows[k, d] - rows[i, d])
                    steps[0, d], steps[2, d] = 0.5 * steps[1, d], 0.0
                    shortest = shortest and steps[1, d] < _SHORTEST
                places = (count, count + 1, count + 2)
                if _is_proven(own, frames, places, p, level, steps, simplex):
                    continue
                if level[HERE] > margin and not shortest and left + 2 <= _DEEPEST:
                    parts[left, 0], parts[left, 1] = middle, end
                    parts[left + 1, 0], parts[left + 1, 1] = start, middle
                    left += 2
                    continue
                if missing < undecided.shape[0]:
                    undecided[missing, 0], undecided[missing, 1] = i, start
                    undecided[missing, 2], undecided[missing, 3] = end, p
                missing += 1
    return level[PROVEN], level[ATTAINED], missing


@njit(**COMPILE)
def never_meets(bodies, body, limits, margin, cells):
    """Whether a pair of bodies is proven to stay further apart than `margin` [m] at all joint
    values within limits (2, D), by halving the box of those that move it; False where that takes
    more than so many cells.
    """
    own = (bodies.hulls, bodies.nodes.copy(), bodies.pairs.copy())
    _, nodes, pairs = own
    dof = limits.shape[1]
    a, b = int(pairs[body, 0]), int(pairs[body, 1])
    first, last = convex.pieces_of(pairs, body)
    lo, hi = int(nodes[a, convex.FRAME]), int(nodes[b, convex.FRAME])
    frames, simplex = np.empty((dof + 1, 12)), np.empty(convex.SIMPLEX)
    waiting = np.empty((_DEEPEST, 2, dof))
    q = np.empty(dof)
    for j in range(dof):
        waiting[0, 0, j], waiting[0, 1, j] = limits[0, j], limits[1, j]
    left, seen = 1, 0
    while left > 0:
        left -= 1
        seen += 1
        if seen > cells or left + 2 > _DEEPEST:
            return False
        for j in range(dof):
            q[j] = 0.5 * (waiting[left, 0, j] + waiting[left, 1, j])
        joint_frames(bodies.chain, q, frames)
        widest, most, motion = lo, -1.0, 0.0
        for j in range(lo, hi):
            share = (waiting[left, 1, j] - q[j]) * nodes[b, convex.REACH + j]
            motion += share
            if share > most:
                widest, most = j, share
        free = True
        for p in range(first, last):
            c, d = int(pairs[p, 0]), int(pairs[p, 1])
            rounding = nodes[c, convex.ROUNDING] + nodes[d, convex.ROUNDING]
            wanted = (margin + rounding + motion, margin + rounding + motion)
            lower, upper = convex.distance(own, frames, p, wanted, simplex)
            if upper - rounding <= margin:
                return False
            if not lower > margin + rounding + motion:  # nor where it is no number
                free = False
                break
        if free:
            continue
        for j in range(dof):
            waiting[left + 1, 0, j] = waiting[left, 0, j]
            waiting[left + 1, 1, j] = waiting[left, 1, j]
        waiting[left, 1, widest] = waiting[left + 1, 0, widest] = q[widest]
        left += 2
    return True
