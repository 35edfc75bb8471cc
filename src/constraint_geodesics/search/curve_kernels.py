"""Compiled curves: the spline through a band, its points on the constraint, and rows along it so
close together that the straight lines between them keep the constraint.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.constraints.kernels import ManifoldArrays, violation_batch
from constraint_geodesics.geometry.timing import write_steps
from constraint_geodesics.search.band_kernels import relax_band
from constraint_geodesics.search.space import project_points

CHECK_STEP = 0.1
"""Distance of the points at which a relaxed curve is first looked at [rad]."""
FEWEST = 3
"""Steps between them at least: a spline through fewer is straight."""
JUMP = 3.0
"""A step between two of these points longer than so many times CHECK_STEP is a jump to another
branch.
"""
MOST_LINES = 1000.0
"""Of the lines between two points, whatever the constraint is there."""
HALVINGS = 8
"""Times that rows are drawn closer where the lines between them still leave the constraint."""
LONGEST_ROW_STEP = 0.08
"""Distance of two rows at most [rad], however flat the path."""
FILLED = 0.95
"""Share of what is allowed that a line's length is to use: what it is off changes along the way."""
_LEFT = 1e-6
_COINCIDENT = 1e-12


class Spline(NamedTuple):
    """A cubic spline over arc length through nodes (n + 1, D) at knots (n + 1,), with its second
    derivatives there.
    """

    knots: np.ndarray
    nodes: np.ndarray
    moments: np.ndarray


@njit(**LEAF)
def _spline(nodes, h, moments, above, below):
    """Second derivatives (n + 1, D) of the cubic spline through nodes whose knots are h (n,) apart,
    not-a-knot at both ends.
    """
    n, dof = nodes.shape[0] - 1, nodes.shape[1]
    moments[:, :] = 0.0
    if n < 3:
        return
    # h_{i−1} M_{i−1} + 2 (h_{i−1} + h_i) M_i + h_i M_{i+1} = 6 (slope_i − slope_{i−1}) for 0 < i <
    # n, with M_0 and M_n from the third derivative's continuity at knots 1 and n − 1
    for i in range(1, n):
        diagonal, lower, upper = 2.0 * (h[i - 1] + h[i]), h[i - 1], h[i]
        if i == 1:
            diagonal += h[0] * (1.0 + h[0] / h[1])
            upper -= h[0] * h[0] / h[1]
            lower = 0.0
        if i == n - 1:
            diagonal += h[n - 1] * (1.0 + h[n - 1] / h[n - 2])
            lower -= h[n - 1] * h[n - 1] / h[n - 2]
            upper = 0.0
        factor = lower / below[i - 1] if i > 1 else 0.0
        below[i] = diagonal - (factor * above[i - 1] if i > 1 else 0.0)
        above[i] = upper
        for d in range(dof):
            right = 6.0 * (
                (nodes[i + 1, d] - nodes[i, d]) / h[i] - (nodes[i, d] - nodes[i - 1, d]) / h[i - 1]
            )
            moments[i, d] = right - (factor * moments[i - 1, d] if i > 1 else 0.0)
    for i in range(n - 1, 0, -1):
        for d in range(dof):
            if i < n - 1:
                moments[i, d] -= above[i] * moments[i + 1, d]
            moments[i, d] /= below[i]
    for d in range(dof):
        moments[0, d] = moments[1, d] + h[0] / h[1] * (moments[1, d] - moments[2, d])
        moments[n, d] = moments[n - 1, d] + h[n - 1] / h[n - 2] * (
            moments[n - 1, d] - moments[n - 2, d]
        )


@njit(**LEAF)
def _along(curve, shares, points):
    """Points (T, D) of the spline at rising shares (T,) of its length."""
    knots, nodes, moments = curve
    i, last = 0, knots.shape[0] - 1
    for k in range(shares.shape[0]):
        at = shares[k] * knots[last]
        while i < last - 1 and at > knots[i + 1]:
            i += 1
        h = knots[i + 1] - knots[i]
        b = (at - knots[i]) / h
        a = 1.0 - b
        for d in range(nodes.shape[1]):
            bend = (a * a * a - a) * moments[i, d] + (b * b * b - b) * moments[i + 1, d]
            points[k, d] = a * nodes[i, d] + b * nodes[i + 1, d] + bend * h * h / 6.0


@njit(**COMPILE)
def spline_through(nodes):
    """The spline through nodes, and whether there is one: not where nodes coincide or are not
    finite.
    """
    n = nodes.shape[0] - 1
    h, knots, moments = np.empty(n), np.zeros(n + 1), np.empty(nodes.shape)
    write_steps(nodes, h)
    curve = Spline(knots, nodes, moments)
    for i in range(n):
        if not (np.isfinite(h[i]) and h[i] > _COINCIDENT):
            return curve, False
        knots[i + 1] = knots[i] + h[i]
    _spline(nodes, h, moments, np.empty(n), np.empty(n))
    return curve, True


@njit(**COMPILE)
def curve_points(space, curve, shares, settings):
    """Points (T, D) at rising shares of the way, from 0 to 1, projected onto the space, but for
    both ends, which are the nodes' to the bit; and what remains of the violation of the worst.
    """
    points, inner = (
        np.empty((shares.shape[0], curve.nodes.shape[1])),
        np.empty(shares.shape[0], np.bool_),
    )
    _along(curve, shares, points)
    for k in range(shares.shape[0]):
        inner[k] = 0.0 < shares[k] < 1.0
        if not inner[k]:
            points[k] = curve.nodes[0] if shares[k] == 0.0 else curve.nodes[-1]
    return points, project_points(space, points, inner, settings)


@njit(**COMPILE)
def relaxed_curve(space, around, nodes, steps, settings):
    """The curve through a relaxed band, as points about CHECK_STEP apart.

    around, steps: of `relax_band`; settings: of the projection.  Returns whether it is sound: its
    points are on the space, and none jumps; the band's nodes, the points, their length and the
    iterations.
    """
    moved = nodes.copy()
    _, used, _ = relax_band(space, around, moved, steps)
    curve, sound = spline_through(moved)
    if not sound:
        return False, moved, moved, 0.0, used
    length = curve.knots[-1]
    count = max(int(np.ceil(length / CHECK_STEP)), FEWEST)
    shares = np.empty(count + 1)
    for k in range(count + 1):
        shares[k] = k / count
    points, left = curve_points(space, curve, shares, settings)
    total, longest, _ = write_steps(points, np.empty(count))
    sound = not (left > _LEFT or longest > JUMP * length / count)
    return sound, moved, points, total, used


@njit(**COMPILE)
def _halfway(space, points):
    """The violation of the middle of each line between points (T, D)."""
    worst = np.empty(points.shape[0] - 1)
    manifold = ManifoldArrays(space.chain, space.constraint)
    violation_batch(manifold, 0.5 * (points[1:] + points[:-1]), worst)
    return worst


@njit(**COMPILE)
def rows_along(space, points, allowed, settings):
    """Rows (T, D) on the curve through points of the space, so close that straight joint lines
    between them leave the constraint by at most `allowed` [rad or m] halfway; the points alone
    where two of them coincide.

    The curve is the spline through the points, projected: so close to the constraint that a step or
    two do.  Between two points h apart a straight line is off by r''h²/8; halfway it is measured,
    and the rows are spread by it.  Near a singular configuration r'' changes faster than that:
    lines that are still off are halved.
    """
    curve, sound = spline_through(points)
    if not sound:
        return points.copy()
    shares = _spread(curve, _halfway(space, points), allowed)
    rows, _ = curve_points(space, curve, shares, settings)
    for _ in range(HALVINGS):
        steps, halfway = np.empty(rows.shape[0] - 1), _halfway(space, rows)
        write_steps(rows, steps)
        off, extra = np.empty(steps.shape[0], np.bool_), 0
        for i in range(steps.shape[0]):
            off[i] = halfway[i] > allowed or steps[i] > 1.1 * LONGEST_ROW_STEP
            extra += off[i]
        if extra == 0:
            break
        between, k = np.empty(extra), 0
        for i in range(off.shape[0]):
            if off[i]:
                between[k] = 0.5 * (shares[i] + shares[i + 1])
                k += 1
        inserted, _ = curve_points(space, curve, between, settings)
        shares, rows = _inserted(off, shares, rows, between, inserted)
    return rows


@njit(**COMPILE)
def _spread(curve, halfway, allowed):
    """Shares (T,) of the way from 0 to 1 whose lines are as long as is allowed: by the constraint,
    which those between the curve's knots leave by `halfway`, and by LONGEST_ROW_STEP.
    """
    knots, last = curve.knots, halfway.shape[0]
    wanted = np.zeros(last + 1)  # lines up to each of the knots
    for i in range(last):
        step = knots[i + 1] - knots[i]
        lines = max(np.sqrt(halfway[i] / allowed), step / LONGEST_ROW_STEP)
        wanted[i + 1] = wanted[i] + (lines if lines < MOST_LINES else MOST_LINES)
    count = int(np.ceil(wanted[last] / FILLED))
    shares, i = np.empty(count + 1), 0
    for k in range(count + 1):
        at = k / count * wanted[last]
        while i < last - 1 and at > wanted[i + 1]:
            i += 1
        within = (at - wanted[i]) / (wanted[i + 1] - wanted[i])
        shares[k] = (knots[i] + within * (knots[i + 1] - knots[i])) / knots[last]
    shares[0], shares[count] = 0.0, 1.0
    return shares


@njit(**COMPILE)
def _inserted(off, shares, rows, between, new):
    """Shares and rows with the new ones on the lines that are off."""
    size = shares.shape[0] + between.shape[0]
    all_shares, all_rows = np.empty(size), np.empty((size, rows.shape[1]))
    k, n = 0, 0
    for i in range(shares.shape[0]):
        all_shares[k], all_rows[k] = shares[i], rows[i]
        k += 1
        if i < off.shape[0] and off[i]:
            all_shares[k], all_rows[k] = between[n], new[n]
            k, n = k + 1, n + 1
    return all_shares, all_rows
