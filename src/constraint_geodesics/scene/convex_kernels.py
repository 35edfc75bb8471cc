"""Compiled distance of two convex pieces, of which a table holds many: for the search, which wants
the direction as well, and for the proof that they stay apart.

A piece is all points within a rounding r of the hull of its corners, carried by a frame.  For a
unit vector n the gap g = min_b n·p − max_a n·p of the pieces a and b bounds the distance of their
hulls from below; the vectors that Gilbert, Johnson and Keerthi's method (1988) goes through make it
the distance itself.  A proof needs the gap alone, however the vector was found.

Frames (F, 12): position [m], then rotation by rows.
Hulls (H,): of each corner x, y, z [m] in its frame, the number of corners beside it, and how much
further on each of these is, so that a hull is the same wherever it stands among others.
"""

import numpy as np
from numba import njit

from constraint_geodesics.compiled import COMPILE, LEAF

# columns of a node
FRAME, ROUNDING = 0, 1
CORNER = 2
"""Where a piece's first corner is among the hulls."""
MARGIN = 3
"""How much of the rounding is no matter [m]."""
BALL = 4
"""Centre (3) and radius of a ball around it."""
BOX = 8
"""Half edges (3) and turn (9) of the box that it is, rounding apart; half edges below 0: it is
none.
"""
PLACE = 20
"""Where the ball's centre is in the base frame (3)."""
REACH = 24
"""How far its points get from the axis of each joint at most (D) [m], 1 for a prismatic joint."""
# columns of a pair
VECTOR = 4
"""The last gap's, in the first's frame (3); 0 at first."""
CORNERS = 7
"""Where the two pieces' corners (2) that were furthest out last are among the hulls."""
PAIR = 9
"""How many columns a pair has."""

_CLEARLY = -1e-3
"""A vector that takes less than that of an edge lies outside their cone."""
_ITERATIONS = 48
_CONVERGED = 1e-7
# rows of what a distance writes into: four corners, the point nearest to the origin, another
NEAREST, _SPARE = 4, 5
SIMPLEX = (6, 6)
"""Shape of that: each point is a difference (3) of one of the second piece, which follows (3), and
one of the first, in the base frame [m].
"""


@njit(inline="always", **COMPILE)
def into(frames, f, n0, n1, n2):
    """A direction of the base frame in frame f of a place."""
    return (
        n0 * frames[f, 3] + n1 * frames[f, 6] + n2 * frames[f, 9],
        n0 * frames[f, 4] + n1 * frames[f, 7] + n2 * frames[f, 10],
        n0 * frames[f, 5] + n1 * frames[f, 8] + n2 * frames[f, 11],
    )


@njit(inline="always", **COMPILE)
def turned(frames, f, x, y, z):
    """A direction of frame f in the base frame."""
    return (
        frames[f, 3] * x + frames[f, 4] * y + frames[f, 5] * z,
        frames[f, 6] * x + frames[f, 7] * y + frames[f, 8] * z,
        frames[f, 9] * x + frames[f, 10] * y + frames[f, 11] * z,
    )


@njit(**LEAF)
def furthest(hulls, corner, x, y, z):
    """The corner of a piece that lies furthest along a direction of its frame, from any of its
    corners on from neighbour to neighbour, and how far.
    """
    most = x * hulls[corner] + y * hulls[corner + 1] + z * hulls[corner + 2]
    rises = True
    while rises:
        rises, here = False, corner
        for e in range(here + 4, here + 4 + int(hulls[here + 3])):
            k = here + int(hulls[e])
            value = x * hulls[k] + y * hulls[k + 1] + z * hulls[k + 2]
            if value > most:
                most, corner, rises = value, k, True
    return corner, most


@njit(**LEAF)
def gap_along(bodies, frames, p, n):
    """How far the second piece of a pair lies beyond the first along a unit vector of the base
    frame; the corners that count become the pair's.
    """
    hulls, nodes, pairs = bodies
    gap, sign = 0.0, 1.0
    for side in range(2):
        f = int(nodes[int(pairs[p, side]), FRAME])
        x, y, z = into(frames, f, sign * n[0], sign * n[1], sign * n[2])
        corner, most = furthest(hulls, int(pairs[p, CORNERS + side]), x, y, z)
        pairs[p, CORNERS + side] = corner
        place = n[0] * frames[f, 0] + n[1] * frames[f, 1] + n[2] * frames[f, 2]
        gap -= most + sign * place
        sign = -1.0
    return gap


@njit(**LEAF)
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
    for d in range(6):
        own = s[i, d]
        s[_SPARE, d] = own + share_u * (s[j, d] - own) + share_v * (s[k, d] - own)
    return mask


@njit(**LEAF)
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


@njit(**LEAF)
def _nearest_of_simplex(s, size):
    """The point of the leading corners' simplex that is nearest to the origin into row NEAREST;
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
        for d in range(6):
            s[NEAREST, d] = s[0, d] + share * (s[k, d] - s[0, d])
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
                for d in range(6):
                    s[NEAREST, d] = s[_SPARE, d]
        if mask == 15:
            return 4
    kept = 0
    for i in range(size):
        if mask >> i & 1:
            for d in range(6):
                s[kept, d] = s[i, d]
            kept += 1
    return kept


@njit(**LEAF)
def distance(bodies, frames, p, wanted, simplex):
    """Bounds (lower, upper) of the distance [m] of a pair of pieces at one place, without their
    roundings, both 0 or less where they overlap.

    It begins with the pair's vector, which becomes that of `lower`.  wanted: (enough, too little):
    it ends once lower is above the one or upper below the other.
    """
    hulls, nodes, pairs = bodies
    f, g = int(nodes[int(pairs[p, 0]), FRAME]), int(nodes[int(pairs[p, 1]), FRAME])
    x, y, z = pairs[p, VECTOR], pairs[p, VECTOR + 1], pairs[p, VECTOR + 2]
    if x == 0.0 and y == 0.0 and z == 0.0:
        z = 1.0
    d0, d1, d2 = turned(frames, f, x, y, z)
    length = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    best = (d0 / length, d1 / length, d2 / length)
    n, size, lower, upper = best, 0, -np.inf, np.inf
    for _ in range(_ITERATIONS):
        gap = gap_along(bodies, frames, p, n)
        if gap > lower:
            lower, best = gap, n
        if lower > wanted[0] or upper < wanted[1] or upper - lower < _CONVERGED:
            break
        a, b = int(pairs[p, CORNERS]), int(pairs[p, CORNERS + 1])
        x, y, z = turned(frames, f, hulls[a], hulls[a + 1], hulls[a + 2])
        u, v, w = turned(frames, g, hulls[b], hulls[b + 1], hulls[b + 2])
        u, v, w = u + frames[g, 0], v + frames[g, 1], w + frames[g, 2]
        simplex[size, 0] = u - x - frames[f, 0]
        simplex[size, 1] = v - y - frames[f, 1]
        simplex[size, 2] = w - z - frames[f, 2]
        simplex[size, 3], simplex[size, 4], simplex[size, 5] = u, v, w
        size = _nearest_of_simplex(simplex, size + 1)
        d0, d1, d2 = simplex[NEAREST, 0], simplex[NEAREST, 1], simplex[NEAREST, 2]
        length = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        if size == 4 or length < _CONVERGED:
            upper = 0.0
            break
        if length >= upper:
            break
        upper, n = length, (d0 / length, d1 / length, d2 / length)
    x, y, z = into(frames, f, best[0], best[1], best[2])
    pairs[p, VECTOR], pairs[p, VECTOR + 1], pairs[p, VECTOR + 2] = x, y, z
    return lower, upper


@njit(inline="always", **COMPILE)
def pieces_of(pairs, body):
    """Where the pairs of pieces of a pair of bodies are: the first, and the one after the last."""
    first, last = int(pairs[body, 2]), int(pairs[body, 3])
    return (first, last) if first < last else (body, body + 1)


@njit(inline="always", **LEAF)
def place_ball(nodes, frames, i):
    """The centre of a node's ball into `nodes`."""
    f = int(nodes[i, FRAME])
    x, y, z = turned(frames, f, nodes[i, BALL], nodes[i, BALL + 1], nodes[i, BALL + 2])
    nodes[i, PLACE] = frames[f, 0] + x
    nodes[i, PLACE + 1] = frames[f, 1] + y
    nodes[i, PLACE + 2] = frames[f, 2] + z


@njit(**LEAF)
def place_balls(nodes, frames):
    """The balls' centres into `nodes`."""
    for i in range(nodes.shape[0]):
        place_ball(nodes, frames, i)


@njit(inline="always", **COMPILE)
def roughly_apart(nodes, a, b):
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


@njit(**COMPILE)
def pair_table(ends, begins, counts, nodes):
    """Rows (P, PAIR) of pairs of bodies (n, 2), and behind them those of their pieces.  begins,
    counts: of each body's nodes, of which the first is the whole's where it has several pieces.
    """
    last = ends.shape[0]
    for body in range(ends.shape[0]):
        a, b = counts[ends[body, 0]], counts[ends[body, 1]]
        if a > 1 or b > 1:
            last += max(a - 1, 1) * max(b - 1, 1)
    rows, last = np.zeros((last, PAIR)), ends.shape[0]
    for body in range(ends.shape[0]):
        a, b = counts[ends[body, 0]], counts[ends[body, 1]]
        first, second = begins[ends[body, 0]], begins[ends[body, 1]]
        rows[body, 0], rows[body, 1] = first, second
        if a > 1 or b > 1:
            rows[body, 2] = last
            for i in range(min(a - 1, 1), max(a, 1)):
                for k in range(min(b - 1, 1), max(b, 1)):
                    rows[last, 0], rows[last, 1] = first + i, second + k
                    last += 1
            rows[body, 3] = last
    for row in range(rows.shape[0]):
        for side in range(2):
            rows[row, CORNERS + side] = nodes[int(rows[row, side]), CORNER]
    return rows


@njit(**COMPILE)
def leads_furthest(corners, faces, begins, around, tolerance):
    """Whether the way from neighbour to neighbour ends at a corner that is furthest out but for the
    tolerance [m], in every direction.

    corners (m, 3); faces (f, 3) of the surface; around: the faces of corner v are those from
    begins[v] to begins[v + 1].  Proven for each corner v and each other w: w - v is a sum of
    vectors from v to its neighbours, none taken a negative number of times, and of a rest no longer
    than the tolerance; so a direction along which no neighbour lies further than v leads to w no
    further than by that rest.  The cones over v's faces and its first neighbour are tried.
    """
    most = 0
    for v in range(corners.shape[0]):
        most = max(most, begins[v + 1] - begins[v])
    edges, duals, w = np.empty((most, 3, 3)), np.empty((most, 3, 3)), np.empty(3)
    for v in range(corners.shape[0]):
        count = _cones(corners, faces, around[begins[v] : begins[v + 1]], v, edges, duals)
        last = 0
        for other in range(corners.shape[0]):
            for i in range(3):
                w[i] = corners[other, i] - corners[v, i]
            is_held = other == v
            for turn in range(count):
                if is_held:
                    break
                # the cone that held the corner before comes first
                k = last if turn == 0 else turn - 1 if turn <= last else turn
                if _rest(edges[k], duals[k], w) <= tolerance:
                    is_held, last = True, k
            if not is_held:
                return False
    return True


@njit(**LEAF)
def _cones(corners, faces, own, v, edges, duals):
    """The three edges of each cone of a corner, and what of a vector each of them takes (3, 3).
    Returns how many cones there are: flat ones are none.
    """
    apex = faces[own[0], 1] if faces[own[0], 0] == v else faces[own[0], 0]
    count = 0
    for face in own:
        a = faces[face, 2] if faces[face, 0] == v else faces[face, 0]
        b = faces[face, 2] if faces[face, 1] == v else faces[face, 1]
        for i in range(3):
            edges[count, 0, i] = corners[a, i] - corners[v, i]
            edges[count, 1, i] = corners[b, i] - corners[v, i]
            edges[count, 2, i] = corners[apex, i] - corners[v, i]
        for k in range(3):
            u, x = edges[count, (k + 1) % 3], edges[count, (k + 2) % 3]
            duals[count, k, 0] = u[1] * x[2] - u[2] * x[1]
            duals[count, k, 1] = u[2] * x[0] - u[0] * x[2]
            duals[count, k, 2] = u[0] * x[1] - u[1] * x[0]
        volume = 0.0
        for i in range(3):
            volume += edges[count, 0, i] * duals[count, 0, i]
        if volume != 0.0:
            for k in range(3):
                for i in range(3):
                    duals[count, k, i] /= volume
            count += 1
    return count


@njit(**LEAF)
def _rest(edges, duals, w):
    """How much of a vector a cone leaves [m]: computed from what its edges take, however well that
    was found.
    """
    x, y, z = w[0], w[1], w[2]
    for k in range(3):
        share = duals[k, 0] * w[0] + duals[k, 1] * w[1] + duals[k, 2] * w[2]
        if share < _CLEARLY:
            return np.inf
        share = max(share, 0.0)
        x -= share * edges[k, 0]
        y -= share * edges[k, 1]
        z -= share * edges[k, 2]
    return np.sqrt(x * x + y * y + z * z)
