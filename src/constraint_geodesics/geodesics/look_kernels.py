"""Compiled look at decoded curves: brought onto their constraint, measured, and what would mend
them.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.constraints.projection import new_room, retract_all
from constraint_geodesics.geodesics.pull_kernels import tangential_gradient
from constraint_geodesics.scene.clearance import DISTANCE, contact_row, near_contacts, new_contacts

# columns of `figures`
LENGTH, ERROR = 0, 1
"""Length [rad], and its difference to that by the rule of half the degree."""
JUMP, OUTSIDE, LEFT = 2, 3, 4
"""Sum of what steps exceed the allowed ones by [rad], of what lies outside the limits [rad], and
the largest violation that the projection left.
"""
DEEP, DEEPEST = 5, 6
"""Sum and largest of what the clearance falls short of the margin by [m]."""
FIGURES = 7

STEP_RAD, STEP_SHARE = 0.05, 4.0
"""Longest step that is no jump: so many rad, and so many times an even pace."""
_CLEARED_EVERY = 2
"""Of the inner points, so many apart are asked what is near them: that is the dearest question."""
_LEAST_MOVE = 0.02
"""Motion [m/rad] below which joints hardly change a clearance."""


class Rule(NamedTuple):
    """Times (S,) at which curves are looked at; what takes points there to slopes at the nodes of
    a quadrature (Q, S), its weights (Q,), and both for every other point.
    """

    times: np.ndarray
    derivative: np.ndarray
    weights: np.ndarray
    half_derivative: np.ndarray
    half_weights: np.ndarray


class Bases(NamedTuple):
    """What turns motions of a curve's points into coefficients: at the times (S, m), halfway
    between them (S − 1, m), and from joints to the chart (N, D).
    """

    points: np.ndarray
    steps: np.ndarray
    to_chart: np.ndarray


class Surroundings(NamedTuple):
    """What may be in the way: joint limits, clearance, and the margin [m] that it has to keep."""

    limits: tuple
    clearance: tuple
    margin: float


class Looked(NamedTuple):
    """What a look writes: curves (B, S, D) [rad], `figures` (B, FIGURES), the descent's step and
    jumps, what lies outside the limits and what is too close to something as the coefficients
    (B, p) that would follow them or lead away; no rows where only the figures are wanted.
    """

    joints: np.ndarray
    figures: np.ndarray
    descent: np.ndarray
    jump: np.ndarray
    outside: np.ndarray
    push: np.ndarray


@njit(**COMPILE)
def look_along(manifold, around, retraction, rule, bases, deviation, looked):
    """Look at curves, whose decoded points are in looked.joints, their ends in place.

    Inner points are clipped to the joint limits, then retracted; ends stay.  deviation (B, S, A):
    of the decoder, part of the length.  Curves that jump are not asked for their clearance: that
    takes the longest, and they can't be used anyhow.
    """
    joints, figures = looked.joints, looked.figures
    batch, points, dof = joints.shape
    wanted = looked.descent.shape[0] > 0
    left = np.empty(batch * points)
    shares = np.ones(batch * points)
    shares[::points] = -1.0
    shares[points - 1 :: points] = -1.0
    flat = joints.reshape(batch * points, dof)
    _clip(around.limits, flat)
    retract_all(manifold, shares, flat, retraction, left, new_room(manifold.constraint, dof))
    pushes = np.zeros((batch, points, dof))
    room, row = new_contacts(around.clearance, dof), np.empty(dof)
    for b in range(batch):
        own = left[b * points : (b + 1) * points]
        _measure(around, rule, joints[b], deviation[b], own, figures[b])
        if around.clearance.top > 0 and figures[b, JUMP] == 0.0:
            _keep_away(manifold.chain, around, joints[b], room, row, pushes[b], figures[b])
    if not wanted:
        return
    pulls = np.empty_like(joints)
    tangential_gradient(manifold, around.limits, rule.times, joints, pulls)
    over, excess = np.empty((points, dof)), np.empty((points - 1, dof))
    sums = np.empty((bases.points.shape[1], dof))
    for b in range(batch):
        _exceed(around.limits, rule.times, joints[b], over, excess)
        _into_coefficients(pulls[b], bases.points, bases.to_chart, sums, looked.descent[b])
        _into_coefficients(excess, bases.steps, bases.to_chart, sums, looked.jump[b])
        _into_coefficients(over, bases.points, bases.to_chart, sums, looked.outside[b])
        _into_coefficients(pushes[b], bases.points, bases.to_chart, sums, looked.push[b])


@njit(**LEAF)
def _clip(limits, q):
    for b in range(q.shape[0]):
        for d in range(q.shape[1]):
            q[b, d] = min(max(q[b, d], limits.lower[d]), limits.upper[d])


@njit(**LEAF)
def _square(slopes, values, every):
    """Squared length of Σ_k slopes_k values_k over every so many rows of values."""
    square = 0.0
    for d in range(values.shape[1]):
        slope = 0.0
        for k in range(slopes.shape[0]):
            slope += slopes[k] * values[every * k, d]
        square += slope * slope
    return square


@njit(**LEAF)
def _length(derivative, weights, q, deviation, every):
    """Length of the polynomial through every so many points of a curve and its deviation."""
    length = 0.0
    for i in range(weights.shape[0]):
        square = _square(derivative[i], q, every) + _square(derivative[i], deviation, every)
        length += weights[i] * np.sqrt(square)
    return length


@njit(**LEAF)
def _beyond(limits, d, value):
    """How far a joint is above its upper limit, or (negative) below its lower one; 0 inside."""
    return max(value - limits.upper[d], 0.0) + min(value - limits.lower[d], 0.0)


@njit(**LEAF)
def _distance(a, b):
    square = 0.0
    for d in range(a.shape[0]):
        square += (a[d] - b[d]) ** 2
    return np.sqrt(square)


@njit(**LEAF)
def _measure(around, rule, q, deviation, left, figures):
    """All figures of one curve but those of its clearance, which become 0."""
    figures[:] = 0.0
    length = _length(rule.derivative, rule.weights, q, deviation, 1)
    half = _length(rule.half_derivative, rule.half_weights, q, deviation, 2)
    figures[LENGTH], figures[ERROR] = length, abs(length - half)
    last = q.shape[0] - 1
    pace = STEP_SHARE * _distance(q[last], q[0])
    for s in range(q.shape[0]):
        figures[LEFT] = max(figures[LEFT], left[s])
        for d in range(q.shape[1]):
            figures[OUTSIDE] += abs(_beyond(around.limits, d, q[s, d]))
        if s < last:
            allowed = STEP_RAD + pace * (rule.times[s + 1] - rule.times[s])
            figures[JUMP] += max(_distance(q[s + 1], q[s]) - allowed, 0.0)


@njit(**LEAF)
def _keep_away(chain, around, q, room, row, push, figures):
    """What brings inner points of one curve to the margin of all that is near, to first order,
    summed over their contacts, into push (S, D); the clearance's figures.
    """
    for s in range(_CLEARED_EVERY, q.shape[0] - 1, _CLEARED_EVERY):
        count, deepest = near_contacts(chain, around.clearance, q[s], around.margin, room), 0.0
        for c in range(count):
            short = around.margin - room.found[c, DISTANCE]
            deepest = max(deepest, short)
            size = contact_row(chain.prismatic, room, c, row)
            if size > _LEAST_MOVE:
                for d in range(q.shape[1]):
                    push[s, d] += short / (size * size) * row[d]
        figures[DEEP] += deepest
        figures[DEEPEST] = max(figures[DEEPEST], deepest)


@njit(**LEAF)
def _exceed(limits, times, q, over, excess):
    """What of each point (S, D) lies outside the limits, and of each step (S − 1, D) beyond the
    allowed one.
    """
    last = q.shape[0] - 1
    pace = STEP_SHARE * _distance(q[last], q[0])
    for s in range(q.shape[0]):
        for d in range(q.shape[1]):
            over[s, d] = _beyond(limits, d, q[s, d])
        if s < last:
            step = _distance(q[s + 1], q[s])
            allowed = STEP_RAD + pace * (times[s + 1] - times[s])
            share = max(step - allowed, 0.0) / max(step, 1e-12)
            for d in range(q.shape[1]):
                excess[s, d] = share * (q[s + 1, d] - q[s, d])


@njit(**LEAF)
def _into_coefficients(motions, basis, to_chart, sums, coefficients):
    """Σ_s J̄⁺ q_s b_k(t_s) of motions (S, D) of a curve's points into coefficients (N m,)."""
    functions = basis.shape[1]
    for k in range(functions):
        for d in range(motions.shape[1]):
            value = 0.0
            for s in range(motions.shape[0]):
                value += motions[s, d] * basis[s, k]
            sums[k, d] = value
    for n in range(to_chart.shape[0]):
        for k in range(functions):
            value = 0.0
            for d in range(motions.shape[1]):
                value += to_chart[n, d] * sums[k, d]
            coefficients[n * functions + k] = value
