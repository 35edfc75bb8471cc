"""Compiled kinematics by unit quaternions, and a proven bound of a constraint along straight joint
lines.

Nothing here is shared with the search.  Shapes: D joints, S stations (configurations along a path),
one piece between each two; a piece is the straight line q(t) = q₀ + t d, 0 ≤ t ≤ 1, with the
increments d.

The chain: frame j is joint j's, its z axis the joint axis; `turns` (D + 1, 4) quaternions (w, x, y,
z) and `offsets` (D + 1, 3) [m] lead from frame j − 1 (the base, for j = 0) to frame j at zero, the
last ones from the last joint to the tool, `lengths` (D + 1,) are theirs; `prismatic` (D,) bool.

What is held is read off a curve x(t) in at most four dimensions, whose first axis e is where x
should point:

- swing (two held angles, axis k free): x = u, the unit vector R R_refᵀ e_k, with e = e_k; the size
  is θ = ∠(x, e);
- rotation (three held): x = s, the unit quaternion of R R_refᵀ, with e = ±1; the size is 2θ, the
  angle of rotation;
- twist (one held, k): x = (s_w, s_k), the part of s that keeps e_k; the size is 2θ, the twist;
- position: x_c = p_c − p_ref,c; the size is |x_c|.

Held angles of unequal tolerance have entries instead: the components of 1 or 2 times the vector
log_e(x) of length θ.

Derivatives.  With W = Σ|d_j| over the revolute joints, u is a product of rotations exp(q_j(t) â_j)
and constant ones, applied to a constant unit vector.  A derivative of one factor by t multiplies it
by d_j â_j, of norm |d_j|, so by Leibniz's rule and the multinomial theorem |u⁽ⁿ⁾| ≤ Wⁿ.  The
quaternions of the factors turn half as fast: |s⁽ⁿ⁾| ≤ (W/2)ⁿ.  The position is a sum of such
products, one for each link's offset l_i, which the joints before it turn: |p⁗| ≤ Σ_i W_i⁴|l_i|; a
prismatic joint adds W_i⁴ max|q_i| + 4 W_i³|d_i|.  Let ω be W or W/2.

Bound.  Between two stations let H be the cubic with x's values and derivatives at both; then |x −
H| ≤ max|x⁗| t²(1 − t)²/24 ≤ max|x⁗|/384 =: ε, along every direction and so in norm.  Over an
interval [a, b] of length h, H differs from its chord by at most max(|H″(a)|, |H″(b)|) h²/8, for H″
is linear.  Hence x(t) lies within δ = max|H″| h²/8 + ε of a point L of the chord.

- Angles: the vectors within α ≤ π/2 of e form a convex cone, so ∠(L, e) is at most its value at the
  chord's ends, and ∠(x, L) ≤ asin(δ/|x|) for |x| = 1, ≤ asin(δ/|L|) for the twist, whose |L| ≥
  max(|H(a)|, |H(b)|) − |H(b) − H(a)|. Beyond π/2 the angle changes by at most ωh/2 from the nearer
  end.
- Positions: |x_c| ≤ max(|H_c(a)|, |H_c(b)|) + δ_c.
- Entries: in polar coordinates about e, with r = θn, |x′| ≤ ω and |x″| ≤ ω², |r″| ≤ ω²(θ/sin θ + (θ
  − sin θ cos θ)/sin²θ + (sin θ − θ cos θ)/sin²θ), which grows with θ; and log_e stretches by at
  most θ/sin θ.  So |r_c| ≤ max(|r_c(a)|, |r_c(b)|) + max|r″| h²/8 + (θ/sin θ) asin ε with θ's
  largest value.

Intervals are halved until their bound is within a hundredth of the excess of a value that is
attained. Rounding is not proven; `ROUNDING` is a thousand times what it amounts to.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from constraint_geodesics.compiled import COMPILE, LEAF

SWING, ROTATION, TWIST, POSITION = 0, 1, 2, 3
SIZE = 0
"""The entry that stands for the size of the whole vector."""
ROUNDING = 1e-12
# how far a bound may lie above an attained value [rad or m], and as a share of the excess
_SHARPNESS = 2e-7
_RELATIVE_SHARPNESS = 0.01
_SHORTEST = 1.0 / 1024.0
_VELOCITY_SLACK = 1e-9
_ACCELERATION_SLACK = 1e-6
_MOST_PIECES = 64
_NEARLY_A_HALF_TURN = 3.0
BASE = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""The base's frame, as `next_frame` takes it."""


# inlined, and with few arrays: each one that is passed counts references in every turn of a loop
@njit(inline="always", **COMPILE)
def next_frame(turns, offsets, j, angle, slide, frame):
    """Frame j, turned by an angle about its z axis and moved along it, from the frame before, both
    as quaternion (w, x, y, z) and position; then its z axis.
    """
    w, x, y, z, p0, p1, p2 = frame
    # v + 2 s × (s × v + w v) for the offset v
    v0, v1, v2 = offsets[j, 0], offsets[j, 1], offsets[j, 2]
    c0, c1, c2 = y * v2 - z * v1 + w * v0, z * v0 - x * v2 + w * v1, x * v1 - y * v0 + w * v2
    p0 += v0 + 2.0 * (y * c2 - z * c1)
    p1 += v1 + 2.0 * (z * c0 - x * c2)
    p2 += v2 + 2.0 * (x * c1 - y * c0)
    tw, tx, ty, tz = turns[j, 0], turns[j, 1], turns[j, 2], turns[j, 3]
    c, s = np.cos(0.5 * angle), np.sin(0.5 * angle)
    tw, tx, ty, tz = c * tw - s * tz, c * tx + s * ty, c * ty - s * tx, c * tz + s * tw
    w, x, y, z = (
        w * tw - x * tx - y * ty - z * tz,
        w * tx + x * tw + y * tz - z * ty,
        w * ty - x * tz + y * tw + z * tx,
        w * tz + x * ty - y * tx + z * tw,
    )
    a0, a1, a2 = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), w * w - x * x - y * y + z * z
    return w, x, y, z, p0 + slide * a0, p1 + slide * a1, p2 + slide * a2, a0, a1, a2


@njit(**LEAF)
def _pose(chain, q, axes, origins):
    """Tool quaternion (w, x, y, z) and position in the base frame; every joint's axis and origin
    (D, 3).
    """
    turns, offsets, prismatic, _ = chain
    frame, dof = BASE, q.shape[0]
    for j in range(dof + 1):
        angle, slide = 0.0, 0.0  # the tool's
        if j < dof:
            angle, slide = (0.0, q[j]) if prismatic[j] else (q[j], 0.0)
        w, x, y, z, p0, p1, p2, a0, a1, a2 = next_frame(turns, offsets, j, angle, slide, frame)
        frame = (w, x, y, z, p0, p1, p2)
        if j < dof:
            axes[j, 0], axes[j, 1], axes[j, 2] = a0, a1, a2
            origins[j, 0], origins[j, 1], origins[j, 2] = p0, p1, p2
    return frame


@njit(**COMPILE)
def poses(chain, q, out):
    """Tool poses of q (n, D) into out (n, 7): position [m], then quaternion (x, y, z, w)."""
    axes, origins = np.empty((q.shape[1], 3)), np.empty((q.shape[1], 3))
    for n in range(q.shape[0]):
        w, x, y, z, p0, p1, p2 = _pose(chain, q[n], axes, origins)
        out[n, 0], out[n, 1], out[n, 2] = p0, p1, p2
        out[n, 3], out[n, 4], out[n, 5], out[n, 6] = x, y, z, w


@njit(**LEAF)
def measure(rows, limits, steps, margins):
    """The lengths (T − 1,) of a path's steps, and the distance (T,) of each of its rows (T, D) to
    the nearest of the limits (2, D); returns the first row that is not finite, or −1, the path's
    length, its longest step, and the smallest distance.
    """
    length, longest, least = 0.0, 0.0, np.inf
    for i in range(rows.shape[0]):
        margins[i] = np.inf
        for j in range(rows.shape[1]):
            if not np.isfinite(rows[i, j]):
                return i, np.nan, np.nan, np.nan
            margins[i] = min(margins[i], rows[i, j] - limits[0, j], limits[1, j] - rows[i, j])
        least = min(least, margins[i])
    # the search has this loop too (curve_kernels.py): what judges it takes none of its code
    for i in range(rows.shape[0] - 1):
        square = 0.0
        for j in range(rows.shape[1]):
            square += (rows[i + 1, j] - rows[i, j]) ** 2
        steps[i] = np.sqrt(square)
        length += steps[i]
        longest = max(longest, steps[i])
    return -1, length, longest, least


@njit(**LEAF)
def not_rising(times):
    """The first row whose time is not before the next one's; −1 for none."""
    for i in range(times.shape[0] - 1):
        if not times[i + 1] - times[i] > 0.0:
            return i
    return -1


@njit(**LEAF)
def too_fast(rows, times, most):
    """The first line and joint whose velocity passes `most` (D,), and that velocity; −1, 0, 0 for
    none.
    """
    for i in range(times.shape[0] - 1):
        for j in range(rows.shape[1]):
            value = abs((rows[i + 1, j] - rows[i, j]) / (times[i + 1] - times[i]))
            if not value <= most[j] * (1.0 + _VELOCITY_SLACK):
                return i, j, value
    return -1, 0, 0.0


@njit(**LEAF)
def too_sudden(rows, times, most, start):
    """The first row and joint whose acceleration passes `most` (D,), and that acceleration; −1, 0,
    0 for none.  Before the first row the arm has the velocity `start` (D,), after the last one it
    rests.
    """
    last = times.shape[0] - 1
    for i in range(last + 1):
        before = times[i] - times[i - 1] if i > 0 else 0.0
        after = times[i + 1] - times[i] if i < last else 0.0
        for j in range(rows.shape[1]):
            arriving = (rows[i, j] - rows[i - 1, j]) / before if i > 0 else start[j]
            leaving = (rows[i + 1, j] - rows[i, j]) / after if i < last else 0.0
            value = abs((leaving - arriving) / (0.5 * (before + after)))
            if not value <= most[j] * (1.0 + _ACCELERATION_SLACK):
                return i, j, value
    return -1, 0, 0.0


@njit(**LEAF)
def _derivative_bounds(chain, q0, q1):
    """W [rad] of one piece, and the bound of |p⁗| [m]."""
    _, _, prismatic, lengths = chain
    turned, fourth = 0.0, 0.0
    for j in range(q0.shape[0] + 1):
        fourth += turned**4 * lengths[j]
        if j == q0.shape[0]:
            break
        d = abs(q1[j] - q0[j])
        if prismatic[j]:
            fourth += turned**4 * max(abs(q0[j]), abs(q1[j])) + 4.0 * turned**3 * d
        else:
            turned += d
    return turned, fourth


@njit(**LEAF)
def count_pieces(chain, rows, wanted, most, counts):
    """Pieces (T − 1,) each segment is cut into, so that ε stays below `wanted` [rad and m]; `most`
    at most.
    """
    total = 0
    for i in range(counts.shape[0]):
        turned, fourth = _derivative_bounds(chain, rows[i], rows[i + 1])
        error = max(turned**4, fourth) / 384.0
        counts[i] = 1
        if error > wanted:
            pieces = np.ceil((error / wanted) ** 0.25)
            counts[i] = int(pieces) if pieces < most else most
        total += counts[i]
    return total


class _Pieces(NamedTuple):
    """A path cut up: segment, W [rad] and bound of |p⁗| [m] of each piece, (S − 1,) each."""

    segments: np.ndarray
    turned: np.ndarray
    fourth: np.ndarray


@njit(**LEAF)
def cut(chain, rows, counts, stations, pieces):
    """The stations (S, D), rows among them, and the pieces between them."""
    segments, turned, fourth = pieces
    s = 0
    for i in range(counts.shape[0]):
        for k in range(counts[i]):
            share = k / counts[i]
            for j in range(rows.shape[1]):
                stations[s, j] = rows[i, j] + share * (rows[i + 1, j] - rows[i, j])
            segments[s] = i
            s += 1
    for j in range(rows.shape[1]):
        stations[s, j] = rows[-1, j]
    for n in range(s):
        turned[n], fourth[n] = _derivative_bounds(chain, stations[n], stations[n + 1])


@njit(**LEAF)
def _turned(kind, k, s, w, out):
    """The derivative of x to an angular velocity w, for the x that `_curve_point` writes."""
    if kind == SWING:
        i, j = (k + 1) % 3, (k + 2) % 3
        out[0] = w[i] * s[j] - w[j] * s[i]
        out[1] = w[j] * s[k] - w[k] * s[j]
        out[2] = w[k] * s[i] - w[i] * s[k]
        out[3] = 0.0
        return
    d1 = 0.5 * (w[0] * s[0] + w[1] * s[3] - w[2] * s[2])
    d2 = 0.5 * (w[1] * s[0] + w[2] * s[1] - w[0] * s[3])
    d3 = 0.5 * (w[2] * s[0] + w[0] * s[2] - w[1] * s[1])
    out[0] = -0.5 * (w[0] * s[1] + w[1] * s[2] + w[2] * s[3])
    if kind == ROTATION:
        out[1], out[2], out[3] = d1, d2, d3
    else:
        out[1] = d1 if k == 0 else (d2 if k == 1 else d3)
        out[2] = out[3] = 0.0


@njit(**LEAF)
def _curve_point(kind, k, anchor, w, x, y, z, s, out):
    """Write x of one tool quaternion; s (4,) gets the vector or quaternion that it is read from.

    anchor (4,): for a swing, e_k turned back into the tool's frame by the reference, and 0; else
    the conjugate of the reference's quaternion.
    """
    if kind == SWING:
        v0, v1, v2 = anchor[0], anchor[1], anchor[2]
        c0, c1, c2 = y * v2 - z * v1 + w * v0, z * v0 - x * v2 + w * v1, x * v1 - y * v0 + w * v2
        s[0] = v0 + 2.0 * (y * c2 - z * c1)
        s[1] = v1 + 2.0 * (z * c0 - x * c2)
        s[2] = v2 + 2.0 * (x * c1 - y * c0)
        out[0], out[1], out[2], out[3] = s[k], s[(k + 1) % 3], s[(k + 2) % 3], 0.0
        return
    aw, ax, ay, az = anchor[0], anchor[1], anchor[2], anchor[3]
    s[0] = w * aw - x * ax - y * ay - z * az
    s[1] = w * ax + x * aw + y * az - z * ay
    s[2] = w * ay - x * az + y * aw + z * ax
    s[3] = w * az + x * ay - y * ax + z * aw
    out[0] = s[0]
    if kind == ROTATION:
        out[1], out[2], out[3] = s[1], s[2], s[3]
    else:
        out[1], out[2], out[3] = s[1 + k], 0.0, 0.0


class Held(NamedTuple):
    """What a constraint holds.  kind: of its angles, < 0 for none; k: their axis; anchor (4,): for
    a swing, e_k turned back into the tool's frame by the reference, and 0, else the conjugate of
    the reference's quaternion; positions: whether any is held; place (3,): the reference's [m].
    """

    kind: int
    k: int
    anchor: np.ndarray
    positions: bool
    place: np.ndarray


class _Room(NamedTuple):
    """What the kernels write into: joint axes and origins (D, 3), vectors, and the ends of the
    intervals that wait.
    """

    axes: np.ndarray
    origins: np.ndarray
    s: np.ndarray
    angular: np.ndarray
    linear: np.ndarray
    left: np.ndarray
    right: np.ndarray
    xa: np.ndarray
    xb: np.ndarray
    middle: np.ndarray


@njit(**COMPILE)
def _new_room(dof):
    return _Room(
        np.empty((dof, 3)),
        np.empty((dof, 3)),
        np.empty(4),
        np.empty(3),
        np.empty(3),
        np.empty(64),
        np.empty(64),
        np.empty(4),
        np.empty(4),
        np.empty(4),
    )


@njit(**LEAF)
def _trace(chain, held, q, turn, shift, room):
    """Write x and its derivatives at stations q (S, D): angles into turn, positions into shift, (3,
    S, 4) each, or (3, 0, 4) for what is not held.

    The second is the derivative along the piece that leaves a station, the third along the one that
    arrives; t runs from 0 to 1 over each.
    """
    kind, k, anchor, positions, place = held
    dof, axes, origins, s, angular, linear = (
        q.shape[1],
        room.axes,
        room.origins,
        room.s,
        room.angular,
        room.linear,
    )
    prismatic, last = chain[2], q.shape[0] - 1
    for n in range(q.shape[0]):
        w, x, y, z, p0, p1, p2 = _pose(chain, q[n], axes, origins)
        if kind >= 0:
            _curve_point(kind, k, anchor, w, x, y, z, s, turn[0, n])
        if positions:
            shift[0, n, 0] = 0.0
            shift[0, n, 1], shift[0, n, 2] = p0 - place[0], p1 - place[1]
            shift[0, n, 3] = p2 - place[2]
        for side in range(2):
            if (side == 0 and n == last) or (side == 1 and n == 0):
                continue
            other = n + 1 if side == 0 else n - 1
            angular[:] = 0.0
            linear[:] = 0.0
            for j in range(dof):
                d = q[other, j] - q[n, j] if side == 0 else q[n, j] - q[other, j]
                a0, a1, a2 = d * axes[j, 0], d * axes[j, 1], d * axes[j, 2]
                if prismatic[j]:
                    linear[0] += a0
                    linear[1] += a1
                    linear[2] += a2
                    continue
                angular[0] += a0
                angular[1] += a1
                angular[2] += a2
                if positions:
                    v0, v1, v2 = p0 - origins[j, 0], p1 - origins[j, 1], p2 - origins[j, 2]
                    linear[0] += a1 * v2 - a2 * v1
                    linear[1] += a2 * v0 - a0 * v2
                    linear[2] += a0 * v1 - a1 * v0
            if kind >= 0:
                _turned(kind, k, s, angular, turn[1 + side, n])
            if positions:
                shift[1 + side, n, 0] = 0.0
                for i in range(3):
                    shift[1 + side, n, 1 + i] = linear[i]


@njit(**LEAF)
def _angle(x, sign):
    """Angle [rad] between x (4,) and the first axis times `sign`; either way along it, for sign
    0.
    """
    first = abs(x[0]) if sign == 0.0 else sign * x[0]
    return np.arctan2(np.sqrt(x[1] * x[1] + x[2] * x[2] + x[3] * x[3]), first)


@njit(**LEAF)
def _value(kind, entry, x, sign):
    """The size [rad or m] of what is held, or of one of its entries 1 to 3."""
    if kind == POSITION:
        return abs(x[entry])
    theta = _angle(x, sign)
    if entry != SIZE:
        across = np.sqrt(x[1] * x[1] + x[2] * x[2] + x[3] * x[3])
        theta = 0.0 if across == 0.0 else theta * abs(x[entry]) / across
    return theta if kind == SWING else 2.0 * theta


@njit(**LEAF)
def _interval_bound(kind, entry, xa, xb, sign, curvature, h, omega, error):
    """The module's bound over one interval, from H at its ends, max|H″|, its length h, ω and ε."""
    if kind == POSITION:
        bound = max(abs(xa[entry]), abs(xb[entry])) + 0.125 * curvature * h * h + error
        return bound if bound >= 0.0 else np.inf  # where joint values overflow it is not a number
    factor = 1.0 if kind == SWING else 2.0
    cap = np.pi
    theta = max(_angle(xa, sign), _angle(xb, sign))
    if entry != SIZE:
        arc = np.arcsin(min(error, 1.0))
        largest = theta + 0.5 * omega * h + 2.0 * arc
        if not largest < _NEARLY_A_HALF_TURN:
            return cap
        stretch, bend = 1.0, 1.0
        if largest > 1e-3:
            sine, cosine = np.sin(largest), np.cos(largest)
            stretch = largest / sine
            bend = stretch + (largest - sine * cosine + sine - largest * cosine) / (sine * sine)
        else:
            # the first terms and what the next ones can add
            stretch, bend = 1.0 + 0.2 * largest, 1.0 + 1.1 * largest
        ends = max(_value(kind, entry, xa, sign), _value(kind, entry, xb, sign))
        return min(cap, ends + factor * (bend * omega * omega * h * h * 0.125 + stretch * arc))
    bound = np.inf
    if theta <= 0.5 * np.pi:
        within = 0.125 * curvature * h * h + error
        if kind == TWIST:
            length_a, length_b = np.sqrt(xa[0] ** 2 + xa[1] ** 2), np.sqrt(xb[0] ** 2 + xb[1] ** 2)
            length = max(length_a, length_b) - np.sqrt((xb[0] - xa[0]) ** 2 + (xb[1] - xa[1]) ** 2)
            within = within / length if length > 0.0 else np.inf
        if within < 1.0:
            bound = theta + np.arcsin(within)
    elif kind == SWING:
        bound = theta + 0.5 * omega * h + np.arcsin(min(error, 1.0))
    bound *= factor
    return bound if bound < cap else cap


@njit(**LEAF)
def _cubic(x0, x1, m0, m1, t, out):
    """H(t) (4,) from values and derivatives at both ends."""
    u = 1.0 - t
    a0, a1 = u * u * (1.0 + 2.0 * t), t * t * (1.0 + 2.0 * u)
    b0, b1 = t * u * u, -t * t * u
    for i in range(4):
        out[i] = a0 * x0[i] + a1 * x1[i] + b0 * m0[i] + b1 * m1[i]


@njit(**LEAF)
def _curvature(kind, entry, x0, x1, m0, m1, t):
    """|H″(t)|, or of one coordinate for a position."""
    square = 0.0
    for i in range(4):
        if kind == POSITION and i != entry:
            continue
        second = (
            (6.0 - 12.0 * t) * (x1[i] - x0[i]) + (6.0 * t - 4.0) * m0[i] + (6.0 * t - 2.0) * m1[i]
        )
        square += second * second
    return np.sqrt(square)


@njit(**LEAF)
def _enough(best, tolerance, limit):
    """A bound that need not be improved, given a value that is attained; it never decides that
    `limit` is passed.
    """
    enough = best + _SHARPNESS + _RELATIVE_SHARPNESS * max(best - tolerance, 0.0)
    return limit if best <= limit < enough else enough


@njit(**LEAF)
def _bound_pieces(channel, x, pieces, room):
    """Bound of what is held over all pieces, by the module's equations.

    channel: kind, entry, tolerance and limit; x (3, S, 4) from `_trace`.
    Returns the bound, the piece and t where the interpolant is largest, and the first segment whose
    bound passes the limit (−1: none does) with its bound; all sizes in rad or m, the tolerance not
    taken off.
    """
    kind, entry, tolerance, limit = int(channel[0]), int(channel[1]), channel[2], channel[3]
    limit -= ROUNDING
    segments, turned, fourth = pieces
    left, right, xa, xb, middle = room.left, room.right, room.xa, room.xb, room.middle
    top, best = 0.0, -1.0
    worst_piece, worst_t = 0, 0.0
    first, first_bound = -1, 0.0
    either = 1.0 if kind == SWING else 0.0
    for i in range(segments.shape[0]):
        x0, x1, m0, m1 = x[0, i], x[0, i + 1], x[1, i], x[2, i + 1]
        sign = 1.0 if kind == SWING or x0[0] + x1[0] >= 0.0 else -1.0
        omega = turned[i] if kind == SWING else 0.5 * turned[i]
        error = (fourth[i] if kind == POSITION else omega**4) / 384.0
        for end in range(2):
            attained = _value(kind, entry, x1 if end else x0, either)
            if attained > best:
                best, worst_piece, worst_t = attained, i, float(end)
        left[0], right[0], waiting = 0.0, 1.0, 1
        while waiting > 0:
            waiting -= 1
            a, b = left[waiting], right[waiting]
            h = b - a
            curvature = max(
                _curvature(kind, entry, x0, x1, m0, m1, a),
                _curvature(kind, entry, x0, x1, m0, m1, b),
            )
            _cubic(x0, x1, m0, m1, a, xa)
            _cubic(x0, x1, m0, m1, b, xb)
            bound = _interval_bound(kind, entry, xa, xb, sign, curvature, h, omega, error)
            if bound <= max(top, _enough(best, tolerance, limit)):
                continue
            undecided = best <= limit < bound
            if h <= _SHORTEST or (
                not undecided and bound <= _enough(best, tolerance, limit) + 3.0 * error
            ):
                top = max(top, bound)
                continue
            t = 0.5 * (a + b)
            _cubic(x0, x1, m0, m1, t, middle)
            attained = _value(kind, entry, middle, either)
            if attained > best:
                best, worst_piece, worst_t = attained, i, t
            left[waiting], right[waiting] = a, t
            left[waiting + 1], right[waiting + 1] = t, b
            waiting += 2
        so_far = max(top, _enough(best, tolerance, limit))
        if first < 0 and so_far > limit:
            first, first_bound = segments[i], so_far + ROUNDING
    highest = max(top, _enough(best, tolerance, limit)) + ROUNDING
    return highest, worst_piece, worst_t, first, first_bound


# columns of what is found of a channel
ATTAINED, BOUND = 0, 1
"""The largest size [rad or m] at the rows and where the path is worst; proven for all of it."""
ROW, AT_ROW, SEGMENT, ON_SEGMENT = 2, 3, 4, 5
"""The first row and the first segment beyond the limit (−1: none is), and the sizes there."""
FOUND = 6


@njit(**LEAF)
def _judge(channels, counts, curves, pieces, room, found):
    """`found` but for what is attained between the rows; the worst places (C, 2), piece and t, into
    the first two columns.
    """
    turn, shift, worst = curves
    for c in range(channels.shape[0]):
        channel, own = channels[c], found[c]
        kind, entry, limit = int(channel[0]), int(channel[1]), channel[3]
        x = shift if kind == POSITION else turn
        own[ATTAINED], own[ROW], station = 0.0, -1.0, 0
        for i in range(counts.shape[0] + 1):
            size = _value(kind, entry, x[0, station], 1.0 if kind == SWING else 0.0)
            if np.isnan(size):  # of joint values that overflow
                size = np.inf
            own[ATTAINED] = max(own[ATTAINED], size)
            if own[ROW] < 0.0 and not size <= limit:
                own[ROW], own[AT_ROW] = i, size
            if i < counts.shape[0]:
                station += counts[i]
        own[BOUND], piece, t, segment, bound = _bound_pieces(channel, x, pieces, room)
        own[SEGMENT], own[ON_SEGMENT] = segment, bound
        worst[c, 0], worst[c, 1] = piece, t


@njit(**COMPILE)
def keep(chain, held, channels, rows, wanted, found):
    """How well the straight joint lines between rows (T, D) keep what is held, into found (C,
    FOUND).

    channels (C, 4): kind, entry, tolerance and limit [rad or m] of each number that is held.
    wanted: ε, below which pieces are short enough.
    """
    dof, count = rows.shape[1], channels.shape[0]
    room, counts = _new_room(dof), np.empty(rows.shape[0] - 1, dtype=np.int64)
    size = count_pieces(chain, rows, wanted, _MOST_PIECES, counts)
    stations = np.empty((size + 1, dof))
    pieces = _Pieces(np.empty(size, dtype=np.int64), np.empty(size), np.empty(size))
    cut(chain, rows, counts, stations, pieces)
    turn = np.empty((3, size + 1 if held.kind >= 0 else 0, 4))
    shift = np.empty((3, size + 1 if held.positions else 0, 4))
    _trace(chain, held, stations, turn, shift, room)
    worst = np.empty((count, 2))
    _judge(channels, counts, (turn, shift, worst), pieces, room, found)
    # the interpolant says where the path is worst; what counts as attained is the true value there
    place, turn, shift = np.empty((1, dof)), np.empty((3, 1, 4)), np.empty((3, 1, 4))
    for c in range(count):
        piece, t = int(worst[c, 0]), worst[c, 1]
        for d in range(dof):
            first = stations[piece, d]
            place[0, d] = first + t * (stations[piece + 1, d] - first)
        _trace(chain, held, place, turn, shift, room)
        kind = int(channels[c, 0])
        x = shift[0, 0] if kind == POSITION else turn[0, 0]
        size = _value(kind, int(channels[c, 1]), x, 1.0 if kind == SWING else 0.0)
        found[c, ATTAINED] = np.inf if np.isnan(size) else max(found[c, ATTAINED], size)
