"""Compiled proof that an arm's pieces stay apart, from each other and from what stands around them,
on the whole of a path of straight joint lines.

Nothing here is shared with the search.  D joints, T rows of a path, N nodes: bodies and their
convex pieces, each carried by a frame.  Frame 0 is the base, frame j + 1 is joint j's.

Two bodies a and b, carried by the frames f_a < f_b, move relative to each other by the joints
f_a … f_b − 1 alone.  Seen from f_a, a stands still, and with ρ_j the furthest that b's points get
from the axis of joint j (1 for a prismatic joint), a point p of b moves by

    |∂p/∂q_j| ≤ ρ_j and, for i ≤ j, as ∂²p/∂q_i∂q_j = a_i × (a_j × (p − o_j)),  |∂²p/∂q_i∂q_j| ≤ ρ_j

Distance.  For a unit vector n the gap g = min_b n·p − max_a n·p bounds the distance of a and b from
below; the vectors that Gilbert, Johnson and Keerthi's method (1988) goes through make it the
distance itself.  A proof needs the gap alone, however the vector was found.

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

_COMPILE = {"cache": True, "fastmath": {"contract"}, "error_model": "numpy", "nogil": True}

# columns of a node
FRAME, ROUNDING = 0, 1
CORNER = 2
"""Where the corner of a piece that was furthest out last is among the hulls."""
BALL = 4
"""Centre (3) and radius of a ball around it."""
BOX = 8
"""Half edges (3) and turn (9) of the box that it is, rounding apart; half edges below 0: it is
none.
"""
PLACE = 20
"""Where the ball's centre is in the base frame (3)."""
REACH = 24
"""ρ (D,) of its points."""
# columns of a pair
VECTOR = 4
"""The last gap's, in the first's frame (3); 0 at first."""
PAIR = 8
"""How many columns a pair has."""
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
_ITERATIONS = 48
_CONVERGED = 1e-7
_DEEPEST = 64
# rows of what a distance writes into: four corners, the point nearest to the origin, another
_NEAREST, _SPARE = 4, 5


class Bodies(NamedTuple):
    """What may meet, on a chain as chain.py describes it.

    hulls (H,): of each corner of a piece x, y, z [m] in the frame that carries it, the number of
    corners beside it and where they are in `hulls`; nodes (N, REACH + D) and pairs (P, PAIR): the
    columns above, those of a pair begin with two nodes, that of the lower frame first, and the
    range of the pairs of their pieces, which is empty for pieces.  The first `top` pairs are of
    bodies.
    """

    chain: Any
    hulls: np.ndarray
    nodes: np.ndarray
    pairs: np.ndarray
    top: int


@njit(**_COMPILE)
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


@njit(inline="always", **_COMPILE)
def _into(frames, at, f, n0, n1, n2):
    """A direction of the base frame in frame f of a place."""
    return (
        n0 * frames[at, f, 3] + n1 * frames[at, f, 6] + n2 * frames[at, f, 9],
        n0 * frames[at, f, 4] + n1 * frames[at, f, 7] + n2 * frames[at, f, 10],
        n0 * frames[at, f, 5] + n1 * frames[at, f, 8] + n2 * frames[at, f, 11],
    )


@njit(inline="always", **_COMPILE)
def _turned(frames, at, f, x, y, z):
    """A direction of frame f in the base frame."""
    return (
        frames[at, f, 3] * x + frames[at, f, 4] * y + frames[at, f, 5] * z,
        frames[at, f, 6] * x + frames[at, f, 7] * y + frames[at, f, 8] * z,
        frames[at, f, 9] * x + frames[at, f, 10] * y + frames[at, f, 11] * z,
    )


@njit(**_COMPILE)
def _furthest(hulls, corner, x, y, z):
    """The corner of a piece that lies furthest along a direction of its frame, from any of its
    corners on from neighbour to neighbour, and how far.
    """
    most = x * hulls[corner] + y * hulls[corner + 1] + z * hulls[corner + 2]
    rises = True
    while rises:
        rises = False
        beside = corner + 4
        for e in range(beside, beside + int(hulls[corner + 3])):
            k = int(hulls[e])
            value = x * hulls[k] + y * hulls[k + 1] + z * hulls[k + 2]
            if value > most:
                most, corner, rises = value, k, True
    return corner, most


@njit(**_COMPILE)
def _gap(hulls, nodes, frames, at, pair, n):
    """How far the second piece lies beyond the first along a unit vector of the base frame; the
    corners that count into `nodes`.
    """
    gap, sign = 0.0, 1.0
    for node in pair:
        f = int(nodes[node, FRAME])
        x, y, z = _into(frames, at, f, sign * n[0], sign * n[1], sign * n[2])
        corner, most = _furthest(hulls, int(nodes[node, CORNER]), x, y, z)
        nodes[node, CORNER] = corner
        place = n[0] * frames[at, f, 0] + n[1] * frames[at, f, 1] + n[2] * frames[at, f, 2]
        gap -= most + sign * place
        sign = -1.0
    return gap


@njit(**_COMPILE)
def _nearest_of_triangle(s, i, j, k):
    """The point of a triangle that is nearest to the origin into row _SPARE; which corners it hangs
    on, as bits.  After Ericson's regions (Real-Time Collision Detection, 2005).
    """
    a0, a1, a2 = s[i, 0], s[i, 1], s[i, 2]
    u0, u1, u2 = s[j, 0] - a0, s[j, 1] - a1, s[j, 2] - a2
    v0, v1, v2 = s[k, 0] - a0, s[k, 1] - a1, s[k, 2] - a2
    ua, va = -(u0 * a0 + u1 * a1 + u2 * a2), -(v0 * a0 + v1 * a1 + v2 * a2)
    ub = -(u0 * s[j, 0] + u1 * s[j, 1] + u2 * s[j, 2])
    vb = -(v0 * s[j, 0] + v1 * s[j, 1] + v2 * s[j, 2])
    uc = -(u0 * s[k, 0] + u1 * s[k, 1] + u2 * s[k, 2])
    vc = -(v0 * s[k, 0] + v1 * s[k, 1] + v2 * s[k, 2])
    to_c, to_b, to_a = ua * vb - ub * va, uc * va - ua * vc, ub * vc - uc * vb
    # shares of the edges u and v; the corners' regions first, then the edges', then the face
    mask, share_u, share_v = 1 << i | 1 << j | 1 << k, 0.0, 0.0
    if ua <= 0.0 and va <= 0.0:
        mask = 1 << i
    elif ub >= 0.0 and vb <= ub:
        mask, share_u = 1 << j, 1.0
    elif vc >= 0.0 and uc <= vc:
        mask, share_v = 1 << k, 1.0
    elif to_c <= 0.0 and ua >= 0.0 and ub <= 0.0:
        mask, share_u = 1 << i | 1 << j, ua / max(ua - ub, 1e-300)
    elif to_b <= 0.0 and va >= 0.0 and vc <= 0.0:
        mask, share_v = 1 << i | 1 << k, va / max(va - vc, 1e-300)
    elif to_a <= 0.0 and vb >= ub and uc >= vc:
        mask, share_v = 1 << j | 1 << k, (vb - ub) / max((vb - ub) + (uc - vc), 1e-300)
        share_u = 1.0 - share_v
    else:
        total = max(to_a + to_b + to_c, 1e-300)
        share_u, share_v = to_b / total, to_c / total
    s[_SPARE, 0] = a0 + share_u * u0 + share_v * v0
    s[_SPARE, 1] = a1 + share_u * u1 + share_v * v1
    s[_SPARE, 2] = a2 + share_u * u2 + share_v * v2
    return mask


@njit(**_COMPILE)
def _lies_beyond(s, i, j, k, other):
    """Whether the origin lies on the other side of a triangle's plane than the fourth corner, or
    that lies in it.
    """
    u0, u1, u2 = s[j, 0] - s[i, 0], s[j, 1] - s[i, 1], s[j, 2] - s[i, 2]
    v0, v1, v2 = s[k, 0] - s[i, 0], s[k, 1] - s[i, 1], s[k, 2] - s[i, 2]
    n0, n1, n2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    origin = -(s[i, 0] * n0 + s[i, 1] * n1 + s[i, 2] * n2)
    fourth = (s[other, 0] - s[i, 0]) * n0 + (s[other, 1] - s[i, 1]) * n1
    fourth += (s[other, 2] - s[i, 2]) * n2
    return origin * fourth < 0.0 or abs(fourth) < 1e-18


@njit(**_COMPILE)
def _nearest_of_simplex(s, size):
    """The point of the leading corners' simplex that is nearest to the origin into row _NEAREST;
    only the corners that it hangs on stay.  Returns how many: 4 where the origin is inside.
    """
    mask = 1
    if size <= 2:
        k = size - 1
        d0, d1, d2 = s[k, 0] - s[0, 0], s[k, 1] - s[0, 1], s[k, 2] - s[0, 2]
        square = d0 * d0 + d1 * d1 + d2 * d2
        share = -(s[0, 0] * d0 + s[0, 1] * d1 + s[0, 2] * d2)
        if share >= square and size == 2:
            mask, share = 2, 1.0
        elif share > 0.0 and size == 2:
            mask, share = 3, share / square
        else:
            share = 0.0
        s[_NEAREST, 0] = s[0, 0] + share * d0
        s[_NEAREST, 1] = s[0, 1] + share * d1
        s[_NEAREST, 2] = s[0, 2] + share * d2
    else:
        least, mask = np.inf, 15
        for other in range(4 if size == 4 else 1):
            i, j, k = (other + 1) % size, (other + 2) % size, (other + 3) % size
            if size == 4 and not _lies_beyond(s, i, j, k, other):
                continue
            found = _nearest_of_triangle(s, i, j, k)
            square = s[_SPARE, 0] ** 2 + s[_SPARE, 1] ** 2 + s[_SPARE, 2] ** 2
            if square < least:
                least, mask = square, found
                for d in range(3):
                    s[_NEAREST, d] = s[_SPARE, d]
        if mask == 15:
            return 4
    kept = 0
    for i in range(size):
        if mask >> i & 1:
            s[kept, 0], s[kept, 1], s[kept, 2] = s[i, 0], s[i, 1], s[i, 2]
            kept += 1
    return kept


@njit(**_COMPILE)
def distance(bodies, frames, at, p, wanted, simplex):
    """Bounds (lower, upper) of the distance [m] of a pair of pieces at one place, without their
    roundings, both 0 or less where they overlap.

    It begins with the pair's vector, which becomes that of `lower`.  wanted: (enough, too little):
    it ends once lower is above the one or upper below the other.
    """
    hulls, nodes, pairs = bodies
    pair = (int(pairs[p, 0]), int(pairs[p, 1]))
    f, g = int(nodes[pair[0], FRAME]), int(nodes[pair[1], FRAME])
    x, y, z = pairs[p, VECTOR], pairs[p, VECTOR + 1], pairs[p, VECTOR + 2]
    if x == 0.0 and y == 0.0 and z == 0.0:
        z = 1.0
    d0, d1, d2 = _turned(frames, at, f, x, y, z)
    length = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    best = (d0 / length, d1 / length, d2 / length)
    n, size, lower, upper = best, 0, -np.inf, np.inf
    for _ in range(_ITERATIONS):
        gap = _gap(hulls, nodes, frames, at, pair, n)
        if gap > lower:
            lower, best = gap, n
        if lower > wanted[0] or upper < wanted[1] or upper - lower < _CONVERGED:
            break
        a, b = int(nodes[pair[0], CORNER]), int(nodes[pair[1], CORNER])
        x, y, z = _turned(frames, at, f, hulls[a], hulls[a + 1], hulls[a + 2])
        u, v, w = _turned(frames, at, g, hulls[b], hulls[b + 1], hulls[b + 2])
        simplex[size, 0] = u - x + frames[at, g, 0] - frames[at, f, 0]
        simplex[size, 1] = v - y + frames[at, g, 1] - frames[at, f, 1]
        simplex[size, 2] = w - z + frames[at, g, 2] - frames[at, f, 2]
        size = _nearest_of_simplex(simplex, size + 1)
        d0, d1, d2 = simplex[_NEAREST, 0], simplex[_NEAREST, 1], simplex[_NEAREST, 2]
        length = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        if size == 4 or length < _CONVERGED:
            upper = 0.0
            break
        if length >= upper:
            break
        upper, n = length, (d0 / length, d1 / length, d2 / length)
    x, y, z = _into(frames, at, f, best[0], best[1], best[2])
    pairs[p, VECTOR], pairs[p, VECTOR + 1], pairs[p, VECTOR + 2] = x, y, z
    return lower, upper


@njit(**_COMPILE)
def _attained(level, value):
    """A distance that two pieces have somewhere: no more than it can be proven, so a share of it is
    asked for, as long as that is above the margin.
    """
    level[HERE] = value
    if value < level[ATTAINED]:
        level[ATTAINED] = value
        level[ASKED] = max(level[MARGIN], SHARE * value)


@njit(**_COMPILE)
def _place_balls(nodes, frames, at):
    """The balls' centres into `nodes`."""
    for i in range(nodes.shape[0]):
        f = int(nodes[i, FRAME])
        x, y, z = _turned(frames, at, f, nodes[i, BALL], nodes[i, BALL + 1], nodes[i, BALL + 2])
        nodes[i, PLACE] = frames[at, f, 0] + x
        nodes[i, PLACE + 1] = frames[at, f, 1] + y
        nodes[i, PLACE + 2] = frames[at, f, 2] + z


@njit(inline="always", **_COMPILE)
def _roughly_apart(nodes, a, b):
    """How far two nodes are apart at least, roundings taken off: by balls around them, or by the
    box that the first is.
    """
    x = nodes[b, PLACE] - nodes[a, PLACE]
    y = nodes[b, PLACE + 1] - nodes[a, PLACE + 1]
    z = nodes[b, PLACE + 2] - nodes[a, PLACE + 2]
    if nodes[a, BOX] < 0.0:
        return np.sqrt(x * x + y * y + z * z) - nodes[a, BALL + 3] - nodes[b, BALL + 3]
    u = abs(x * nodes[a, BOX + 3] + y * nodes[a, BOX + 6] + z * nodes[a, BOX + 9])
    v = abs(x * nodes[a, BOX + 4] + y * nodes[a, BOX + 7] + z * nodes[a, BOX + 10])
    w = abs(x * nodes[a, BOX + 5] + y * nodes[a, BOX + 8] + z * nodes[a, BOX + 11])
    u, v, w = u - nodes[a, BOX], v - nodes[a, BOX + 1], w - nodes[a, BOX + 2]
    u, v, w = max(u, 0.0), max(v, 0.0), max(w, 0.0)
    return np.sqrt(u * u + v * v + w * w) - nodes[a, ROUNDING] - nodes[b, BALL + 3]


@njit(**_COMPILE)
def _nearest(bodies, top, frames, at, level, simplex):
    """The least distance of any pair at one place into `level`; returns that pair, −1 where another
    place has less.
    """
    _, nodes, pairs = bodies
    _place_balls(nodes, frames, at)
    nearest = -1
    for body in range(top):
        a, b = int(pairs[body, 0]), int(pairs[body, 1])
        if _roughly_apart(nodes, a, b) >= level[ATTAINED]:
            continue
        first, last = int(pairs[body, 2]), int(pairs[body, 3])
        if first == last:
            first, last = body, body + 1
        for p in range(first, last):
            a, b = int(pairs[p, 0]), int(pairs[p, 1])
            if _roughly_apart(nodes, a, b) >= level[ATTAINED]:
                continue
            rounding = nodes[a, ROUNDING] + nodes[b, ROUNDING]
            wanted = (level[ATTAINED] + rounding, -np.inf)
            lower, _ = distance(bodies, frames, at, p, wanted, simplex)
            if max(lower, 0.0) - rounding < level[ATTAINED]:
                nearest = p
            _attained(level, max(lower, 0.0) - rounding)
    return nearest


@njit(**_COMPILE)
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


@njit(**_COMPILE)
def _bounds_of_motion(nodes, a, b, steps):
    """How far b's points move from the middle of an interval at most, seen from a: Σ ρ_j v_j; and
    how far they get off their way's ends: ⅛ Σ |d_j| ρ_j (|d_j| + 2 Σ |d_h|) + Σ ρ_j e_j.
    """
    motion, bend, off, before = 0.0, 0.0, 0.0, 0.0
    for j in range(int(nodes[a, FRAME]), int(nodes[b, FRAME])):
        reach, step = nodes[b, REACH + j], steps[1, j]
        motion += reach * steps[0, j]
        bend += step * reach * (step + 2.0 * before)
        off += reach * steps[2, j]
        before += step
    return motion, 0.125 * bend + off


@njit(**_COMPILE)
def _is_proven(bodies, frames, places, p, level, steps, simplex):
    """Whether one pair of pieces is free on an interval; places: of its ends and its middle.  Where
    it is not, level[HERE] is a distance that it has in the middle, inf where that is not known.
    """
    hulls, nodes, pairs = bodies
    a, b = int(pairs[p, 0]), int(pairs[p, 1])
    f, rounding = int(nodes[a, FRAME]), nodes[a, ROUNDING] + nodes[b, ROUNDING]
    motion, bend = _bounds_of_motion(nodes, a, b, steps)
    level[HERE] = np.inf
    if min(motion, bend) > _CLOSE:
        return False
    for attempt in range(2):
        bound = -np.inf
        x, y, z = pairs[p, VECTOR], pairs[p, VECTOR + 1], pairs[p, VECTOR + 2]
        if bend < motion and (x != 0.0 or y != 0.0 or z != 0.0):
            gap, enough = np.inf, level[ASKED] + rounding + bend
            for end in range(2):
                if gap > enough:
                    n = _turned(frames, places[end], f, x, y, z)
                    gap = min(gap, _gap(hulls, nodes, frames, places[end], (a, b), n))
            if gap > enough:  # at both ends
                bound = gap - bend
        if attempt == 0 and bound - rounding <= level[ASKED]:
            too_little = level[MARGIN] + rounding + min(motion, bend)
            wanted = (level[ASKED] + rounding + motion, too_little)
            lower, upper = distance(bodies, frames, places[2], p, wanted, simplex)
            _attained(level, upper - rounding)
            bound = lower - motion
        if bound - rounding > level[ASKED]:
            level[PROVEN] = min(level[PROVEN], bound - rounding)
            return True
        if bend >= motion:
            break
    return False


@njit(**_COMPILE)
def _sift(bodies, frames, interval, todo, level, steps, simplex):
    """Leave the pairs of an interval of rows that are not proven free in todo (P + 1,), their
    number first; a pair of bodies that are close is replaced by the pairs of their pieces.
    """
    i, m, k = interval
    _, nodes, pairs = bodies
    _place_balls(nodes, frames, m)
    count, kept, c = todo[0], 0, 0
    while c < count:
        c += 1
        p = todo[c]
        a, b = int(pairs[p, 0]), int(pairs[p, 1])
        first, last = int(pairs[p, 2]), int(pairs[p, 3])
        motion, _ = _bounds_of_motion(nodes, a, b, steps)
        free = _roughly_apart(nodes, a, b) - motion
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


@njit(**_COMPILE)
def _place(chain, rows, i, share, frames):
    """Frames (D + 1, 12) on the line from row i to the next."""
    q = np.empty(rows.shape[1])
    for d in range(rows.shape[1]):
        q[d] = rows[i, d] + share * (rows[i + 1, d] - rows[i, d])
    joint_frames(chain, q, frames)


@njit(**_COMPILE)
def nearest_pair(bodies, q, most):
    """The least distance [m] of any two bodies that may meet at one configuration, and which pair
    it is: `most` and −1 where that is more.
    """
    frames, simplex, level = np.empty((1, q.shape[0] + 1, 12)), np.empty((6, 3)), np.empty(5)
    for i in range(5):
        level[i] = most
    joint_frames(bodies.chain, q, frames[0])
    own = (bodies.hulls, bodies.nodes.copy(), bodies.pairs.copy())
    nearest = _nearest(own, bodies.top, frames, 0, level, simplex)
    return level[ATTAINED], nearest


@njit(**_COMPILE)
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
    travelled, steps, simplex = np.zeros((count, dof + 1)), np.empty((3, dof)), np.empty((6, 3))
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
        _nearest(own, top, frames, i, level, simplex)
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
                _place(chain, rows, i, start, frames[count])
                _place(chain, rows, i, end, frames[count + 1])
                _place(chain, rows, i, middle, frames[count + 2])
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


@njit(**_COMPILE)
def never_meets(bodies, body, limits, margin, cells):
    """Whether a pair of bodies is proven to stay further apart than `margin` [m] at all joint
    values within limits (2, D), by halving the box of those that move it; False where that takes
    more than so many cells.
    """
    own = (bodies.hulls, bodies.nodes.copy(), bodies.pairs.copy())
    _, nodes, pairs = own
    dof = limits.shape[1]
    a, b = int(pairs[body, 0]), int(pairs[body, 1])
    first, last = int(pairs[body, 2]), int(pairs[body, 3])
    if first == last:
        first, last = body, body + 1
    lo, hi = int(nodes[a, FRAME]), int(nodes[b, FRAME])
    frames, simplex = np.empty((1, dof + 1, 12)), np.empty((6, 3))
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
        joint_frames(bodies.chain, q, frames[0])
        widest, most, motion = lo, -1.0, 0.0
        for j in range(lo, hi):
            share = (waiting[left, 1, j] - q[j]) * nodes[b, REACH + j]
            motion += share
            if share > most:
                widest, most = j, share
        free = True
        for p in range(first, last):
            c, d = int(pairs[p, 0]), int(pairs[p, 1])
            rounding = nodes[c, ROUNDING] + nodes[d, ROUNDING]
            wanted = (margin + rounding + motion, margin + rounding + motion)
            lower, upper = distance(own, frames, 0, p, wanted, simplex)
            if upper - rounding <= margin:
                return False
            if lower <= margin + rounding + motion:
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
