"""Length of the shortest curve between two points of the torus T², over all its geodesics.

Along a geodesic Clairaut's constant c = ρ² u̇ (at unit speed) stays the same; ρ = R + r cos v is
the radius of the ring at tube angle v (do Carmo, Differential Geometry of Curves and Surfaces,
4-4).  A stretch of tube angles then gives the ring angle it advances, U(c) = ∫ r c / (ρ √(ρ² − c²))
dv, and its action W(c) = ∫ r √(ρ² − c²) / ρ dv.  A geodesic that has to advance by u solves U(c) =
u and has length c u + W(c).  As dW/dc = −U, an error of c is felt to second order.

Three reflections tell which geodesics can be shortest: each would turn a longer one into a curve of
the same length with a corner.  A shortest curve advances by at most half a ring (reflect its start
in the meridian opposite to it), meets the two equators at most once in all between its ends
(reflect the piece between two meetings), and swings about the outer equator for at most half a
period (there the geodesic that left in the mirrored direction arrives as well). With the end nearer
to the inner equator called the near end, this leaves two families:

- outward: from the near end away from the inner equator to the far end, beyond the outer equator
  where that lies between them; or first to a turning point ρ = c on the inner side of the near end,
  and then the same way;
- inward, where the ends lie on opposite sides of the tube: through the inner equator, c < R − r.

Along either family U grows from 0 without bound, so that it holds one geodesic; in the outward one
because curvature falls from the outer equator to the inner (Gravesen, Markvorsen, Sinclair, Tanaka,
The cut locus of a torus of revolution, Asian J. Math. 9, 2005).  Only where both ends lie on one
equator does U jump or stay at 0 instead; the family's member there, c = ρ, is that equator itself.

Within this file lengths are in units of the tube's diameter 2r: ρ = hole + cos²(v/2), hole = (R −
r) / 2r.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import elliprc, elliprf, elliprj

Numbers = Float[np.ndarray, "n"]

BISECTIONS = 64
"""Halvings of the range of c: as fine as float64 is next to its upper end."""

EPSILON = float(np.finfo(np.float64).eps)

POINT = 1e-60
"""Difference of cos²(v/2) below which two parallels are one: some 1e-30 rad, and its square is
still a float64.
"""


class Parallels(NamedTuple):
    """Circles of constant tube angle v: inner = cos²(v/2), 0 on the inner equator, and outer =
    sin²(v/2) = 1 − inner.

    Both are kept, since either loses its digits next to 1.
    """

    inner: Numbers
    outer: Numbers


class EndPair(NamedTuple):
    """Both ends of the curves sought: the one nearer to the inner equator, the other, and what lies
    between them.

    gap: cos²(v/2) of the farther less that of the nearer.  opposite: whether they lie on two sides
    of the tube.
    turn: the ring angle between them, 0 to π.
    """

    near: Parallels
    far: Parallels
    gap: Numbers
    opposite: Bool[np.ndarray, "n"]
    turn: Numbers


class Advance(NamedTuple):
    """What geodesics gain on a stretch of tube: ring angle `turn` = U [rad], `action` = W."""

    turn: Numbers
    action: Numbers


class Stretch(NamedTuple):
    """Tube angles from an inner parallel to an outer one, on one side of the tube.

    margin: ρ − c at the start.  gap: what ρ − c grows by.  Given, as differences of nearly equal
    numbers hold nothing.
    """

    start: Parallels
    end: Parallels
    margin: Numbers
    gap: Numbers


Family = Callable[[Numbers], Advance]


def torus_distance(
    major: float, minor: float, a: Float[np.ndarray, "n 2"], b: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n"]:
    """Geodesic distance between points (ring angle u, tube angle v) [rad] of the torus with radii R
    and r.

    a, b: finite; any image of a point under the periods 2π will do.  In the unit of the radii, with
    an error of a few 1e-15 R for R ≥ 1.1 r, which grows to 2e-13 R at R = 1.0001 r; near points
    keep 11 digits of their distance as well.  Symmetric to the bit, and 0 where a equals b.
    """
    hole, ends = (major - minor) / (2 * minor), _ends(a, b)
    # Integrals that diverge at the end of a family are bounds, not mistakes.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        outward = _outward_length(hole, ends)
        inward = np.where(ends.opposite, _inward_length(hole, ends), np.inf)
    return 2 * minor * np.minimum(outward, inward)


def _ends(a: Float[np.ndarray, "n 2"], b: Float[np.ndarray, "n 2"]) -> EndPair:
    tube = _wrapped(np.stack([a[:, 1], b[:, 1]]))
    near, far = np.abs(tube).max(axis=0), np.abs(tube).min(axis=0)
    return EndPair(
        near=Parallels(np.cos(near / 2) ** 2, np.sin(near / 2) ** 2),
        far=Parallels(np.cos(far / 2) ** 2, np.sin(far / 2) ** 2),
        gap=np.sin((near - far) / 2) * np.sin((near + far) / 2),
        opposite=np.sign(tube[0]) * np.sign(tube[1]) < 0,
        turn=np.abs(_wrapped(b[:, 0] - a[:, 0])),
    )


def _outward_length(hole: float, ends: EndPair) -> Numbers:
    """Lengths in the outward family.

    It is run through by one number t: c = ρ + t below the ring ρ of the nearer end, then c = ρ − t,
    with the turning point on the inner side of that end.
    """
    near, far, gap, opposite = ends.near, ends.far, ends.gap, ends.opposite
    equator = Parallels(np.ones_like(gap), np.zeros_like(gap))
    end = Parallels(*(np.where(opposite, *pair) for pair in zip(equator, far, strict=True)))
    rise, fall = np.where(opposite, near.outer, gap), np.where(opposite, far.outer, 0.0)
    ring = hole + near.inner

    def family(t: Numbers) -> Advance:
        margin = np.abs(t)
        c, turned = ring - margin, np.maximum(t, 0.0)
        turning = Parallels(near.inner - turned, near.outer + turned)
        away = _leg(hole, c, Stretch(near, end, margin, rise))
        across = _leg(hole, c, Stretch(far, equator, margin + gap, fall))
        swing = _leg(hole, c, Stretch(turning, near, np.zeros_like(t), turned))
        return _sum(away, across, swing, swing)

    t = _shortfall(family, ends.turn, -ring, near.inner)
    return (ring - np.abs(t)) * ends.turn + family(t).action


def _inward_length(hole: float, ends: EndPair) -> Numbers:
    """Lengths in the inward family, c = hole + t; no meaning unless opposite."""
    equator = Parallels(np.zeros_like(ends.turn), np.ones_like(ends.turn))
    stops = ends.near, ends.far
    gaps = [np.where(ends.opposite, end.inner, 0.0) for end in stops]

    def family(t: Numbers) -> Advance:
        legs = (Stretch(equator, end, -t, gap) for end, gap in zip(stops, gaps, strict=True))
        return _sum(*(_leg(hole, hole + t, leg) for leg in legs))

    t = _shortfall(family, ends.turn, np.full_like(ends.turn, -hole), np.zeros_like(ends.turn))
    return (hole + t) * ends.turn + family(t).action


def _shortfall(family: Family, turn: Numbers, low: Numbers, high: Numbers) -> Numbers:
    """The last member of a family, between two, that does not advance beyond `turn`."""
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        advance = family(middle).turn
        short = np.isfinite(advance) & (advance <= turn)
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return low


def _sum(*legs: Advance) -> Advance:
    return Advance(
        np.sum([leg.turn for leg in legs], axis=0), np.sum([leg.action for leg in legs], axis=0)
    )


def _leg(hole: float, c: Numbers, stretch: Stretch) -> Advance:
    """Gain on a stretch; 0 where its two parallels are one."""
    advance = Advance(np.zeros_like(c), np.zeros_like(c))
    some = stretch.gap > POINT
    if not some.any():
        return advance
    start, end = (Parallels(at.inner[some], at.outer[some]) for at in stretch[:2])
    part = Stretch(start, end, stretch.margin[some], stretch.gap[some])
    advance.turn[some], advance.action[some] = _elliptic(hole, c[some], part)
    return advance


def _elliptic(hole: float, c: Numbers, stretch: Stretch) -> Advance:
    """U and W as Carlson's integrals (DLMF 19.29.4 and 8): with y = cos²(v/2) and s² = (ρ + c) (ρ −
    c) y (1 − y),

    2 U = ∫ (ρ + c) / (ρ s) dy − ∫ dy / s,  2 W = ∫ (ρ + c) / s dy − c ∫ (ρ + c) / (ρ s) dy.
    """
    start, end, margin, gap = stretch
    x = [np.sqrt(factor) for factor in (hole + end.inner + c, margin + gap, end.inner, end.outer)]
    y = [np.sqrt(factor) for factor in (hole + start.inner + c, margin, start.inner, start.outer)]
    u, v, w = (
        ((x[0] * x[i] * y[j] * y[k] + y[0] * y[i] * x[j] * x[k]) / gap) ** 2
        for i, j, k in ((1, 2, 3), (2, 1, 3), (3, 1, 2))
    )
    product = (hole + c) * (hole + c + 1)

    def third(weight: Numbers, p: Numbers, pole_x: Numbers, pole_y: Numbers) -> Numbers:
        root = (x[1] * x[2] * x[3] / x[0] * pole_y + y[1] * y[2] * y[3] / y[0] * pole_x) / gap
        other = pole_x * pole_y * p / (x[0] * y[0]) ** 2
        return 4 / 3 * weight * elliprj(u, v, w, p) + 2 * elliprc(root**2, other)

    # Where p vanishes both functions of it grow without bound, and only their sum does not.
    p = u - product
    p = np.where(np.abs(p) < EPSILON * product, EPSILON * product, p)
    over_ring = third(-product, p, hole + end.inner, hole + start.inner)
    plain = third(c * product, u + product, np.ones_like(c), np.ones_like(c))
    return Advance(over_ring / 2 - elliprf(u, v, w), (plain - c * over_ring) / 2)


def _wrapped(angle: np.ndarray) -> np.ndarray:
    """An angle's image in [−π, π]; odd in it, so that swapped ends give the same bits."""
    return angle - 2 * np.pi * np.round(angle / (2 * np.pi))
