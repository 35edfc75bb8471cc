"""The nearest configurations of a constraint: what one is projected to, and to where the end of a
path moves that may end anywhere on it.

Projected gradient descent of the distance: a step towards the place, without what leaves the
constraint to first order, and back onto it.  It ends where the distance is least among all
configurations beside, which from several seeds are several.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numba import njit

from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.projection import normal_matrix, retract, solve_normal
from constraint_geodesics.search.roadmap import distance
from constraint_geodesics.search.space import look_at, project_node, space_of, workspace

SAME_RAD = 1e-2
"""Configurations that differ by less in every joint are one."""
_STEPS, _HALVES = 60, 8
_LONGEST = 0.5
_STILL = 1e-6
"""A step so short [rad] is the last."""
_GAIN = 1e-9
"""So is one that brings it nearer by less [rad]."""
_ENOUGH = 0.1
"""Share of the gain that the distance's slope promises, which a step must bring [Armijo 1966]."""
_LEAST, _MOST = 0.02, 20.0
_LEFT = 1e-8
"""Violation [rad or m] of a configuration, at most."""
_RIDGE = 1e-10
_FIRST_AT, _CLOSER, _LAST_AT = 1e-2, 1e-2, 1e-5
"""So near to a bound, as a share of it or [rad], is at it at first; it is taken less and less
loosely until it is exact: a step that leads out of a bound nearby gains nothing.
"""
_SLACK = 1e-9


@dataclass(frozen=True, eq=False)
class Projection:
    """The nearest configuration that keeps a constraint (D,) [rad], how far away it is [rad], and
    by how much the one asked for violates it [rad or m].
    """

    configuration: Float[np.ndarray, "D"]
    distance_rad: float
    violation_before: float


def projection(manifold: ConstraintManifold, q: Float[np.ndarray, "D"]) -> Projection | None:
    """Of q [rad], as far as the descent from there finds it; None where nothing near keeps the
    constraint.
    """
    found = nearest_on(manifold, q, q[None])
    if not len(found):
        return None
    away = float(np.linalg.norm(found[0] - q))
    return Projection(found[0], away, float(manifold.violation(q)))


def nearest_on(
    manifold: ConstraintManifold, q: Float[np.ndarray, "D"], seeds: Float[np.ndarray, "n D"]
) -> Float[np.ndarray, "m D"]:
    """Configurations within the joint limits that keep the constraint and are nearer to q [rad]
    than all beside them, each once, the nearest first; those that these seeds lead to.
    """
    found, away = np.array(seeds, float), np.empty(len(seeds))
    _descend(space_of(manifold), np.ascontiguousarray(q, float), found, away)
    robot = manifold.robot
    order = np.argsort(away, kind="stable")[: int(np.isfinite(away).sum())]
    kept: list[np.ndarray] = []
    for own in np.clip(found[order], robot.lower, robot.upper):
        if all(np.abs(own - other).max() > SAME_RAD for other in kept):
            kept.append(own)
    return np.array(kept).reshape(-1, robot.dof)


def members_of(
    manifold: ConstraintManifold, seeds: Float[np.ndarray, "n D"]
) -> Float[np.ndarray, "m D"]:
    """Configurations within the joint limits that keep the constraint, near these seeds."""
    robot = manifold.robot
    result = retract(manifold, seeds)
    good = result.converged & (robot.limit_distance(result.joints) >= 0.0)
    return result.joints[good]


@njit(**LEAF)
def _exact_rows(space, work):
    """Rows of the constraint that leave no freedom, into `work.rows`; returns how many."""
    own, jacobian, size = space.constraint.rows, work.looked.jacobians[0], 0
    for i in range(own.held.shape[0]):
        if own.held[i] and own.tolerance[i] == 0.0 and size < jacobian.shape[1]:
            for d in range(jacobian.shape[1]):
                work.rows[size, d] = jacobian[i, d]
            size += 1
    return size


@njit(**LEAF)
def _towards_bound(space, q, step, bound, work, normal):
    """How far a configuration is from a bound, as a share of the tolerance or in rad, how fast the
    step comes nearer to it, not above 0 where it does not, and the way out there into `normal`.

    Bounds are the constraint's rows by their tolerance, those that are bounded together by the
    first of them, and then the joints' limits.
    """
    own, residual = space.constraint.rows, work.looked.residuals[0]
    jacobian, count = work.looked.jacobians[0], own.held.shape[0]
    normal[:] = 0.0
    if bound >= count:
        d = bound - count
        if step[d] > 0.0:
            normal[d] = 1.0
            return space.limits[1, d] - q[d], step[d]
        normal[d] = -1.0
        return q[d] - space.limits[0, d], -step[d]
    if not own.held[bound] or own.tolerance[bound] == 0.0:
        return np.inf, 0.0
    square = 0.0
    for i in range(count):
        together = own.together[bound] and own.together[i]
        if together and i < bound:
            return np.inf, 0.0
        if together or i == bound:
            square += residual[i] ** 2
            for d in range(normal.shape[0]):
                normal[d] += residual[i] * jacobian[i, d]
    rate, size, tolerance = 0.0, np.sqrt(square), own.tolerance[bound]
    for d in range(normal.shape[0]):
        rate += normal[d] * step[d]
    return 1.0 - size / tolerance, rate / max(size * tolerance, 1e-300)


@njit(**LEAF)
def _along(q, target, size, work, step):
    """The way from q to the target without what leads along the leading rows, into `step`; returns
    its length, 0 where the rows can't be told apart.
    """
    rows, right, normal = work.rows, work.right, work.normal
    for d in range(q.shape[0]):
        step[d] = target[d] - q[d]
    for i in range(size):
        right[i] = 0.0
        for d in range(q.shape[0]):
            right[i] += rows[i, d] * step[d]
    ridge = _RIDGE * normal_matrix(rows, size, normal)
    for i in range(size):
        normal[i, i] += ridge
    if size and not solve_normal(normal, size, right, 1e-14):
        return 0.0
    square = 0.0
    for d in range(q.shape[0]):
        for i in range(size):
            step[d] -= rows[i, d] * right[i]
        square += step[d] ** 2
    return np.sqrt(square)


@njit(**LEAF)
def _tangent(space, q, target, at, work, step):
    """The way from q to the target without what leaves the constraint or a bound that is as near as
    `at`, into `step` (D,); returns its length, and the share of it that comes to the next bound.
    """
    dof, count, normal = q.shape[0], space.constraint.rows.held.shape[0], work.before
    look_at(space, q, work)
    size = _exact_rows(space, work)
    length = _along(q, target, size, work, step)
    while length > 0.0:
        # of the bounds that the step would break, the one that it leads out of most directly
        worst, last, most = _SLACK * length, -1, np.inf
        for bound in range(count + dof):
            gap, rate = _towards_bound(space, q, step, bound, work, normal)
            if rate <= 0.0:
                continue
            if gap >= at:
                most = min(most, gap / rate)
                continue
            ahead, square = 0.0, 0.0
            for d in range(dof):
                ahead += normal[d] * step[d]
                square += normal[d] ** 2
            ahead /= np.sqrt(square)
            if ahead > worst:
                worst, last = ahead, bound
        if last < 0 or size == dof:
            return length, most
        _towards_bound(space, q, step, last, work, work.rows[size])
        size += 1
        length = _along(q, target, size, work, step)
    return 0.0, np.inf


@njit(**LEAF)
def _share_of(q, before, step, last, share):
    """The share of a step to be tried, by how the way changed with the one before [Barzilai and
    Borwein 1988].
    """
    moved, turned = 0.0, 0.0
    for d in range(q.shape[0]):
        off = q[d] - before[d]
        moved += off * off
        turned += off * (last[d] - step[d])
    if turned <= 0.0:
        return min(2.0 * share, _MOST)
    return min(max(moved / turned, _LEAST), _MOST)


@njit(**COMPILE)
def _descend(space, target, places, away):
    """Move places (n, D) to where they are nearest to the target; away (n,): how far that is [rad],
    inf where none was found.
    """
    dof, work = target.shape[0], workspace(space)
    step, trial, settings = np.empty(dof), np.empty(dof), space.projection
    last, before = np.empty(dof), np.empty(dof)
    for n in range(places.shape[0]):
        q = places[n]
        away[n] = np.inf
        if not project_node(space, q, settings, work) <= _LEFT:
            continue
        least, share, at, begun = distance(q, target), 1.0, _FIRST_AT, 0
        for iteration in range(_STEPS):
            length, most = _tangent(space, q, target, at, work, step)
            moved, capped = 0.0, False
            if length > _STILL:
                if iteration > begun:
                    share = _share_of(q, before, step, last, share)
                share = min(share, _LONGEST / length)
                if share > most:
                    share, capped = most, True
                for _ in range(_HALVES):
                    for d in range(dof):
                        trial[d] = q[d] + share * step[d]
                    if project_node(space, trial, settings, work) <= _LEFT:
                        now = distance(trial, target)
                        if now < least - _ENOUGH * share * length * length / least:
                            moved, least = least - now, now
                            break
                    share *= 0.5
            if moved > 0.0:
                for d in range(dof):
                    before[d], last[d], q[d] = q[d], step[d], trial[d]
            if moved < _GAIN and not (capped and moved > 0.0):
                if at < _LAST_AT:
                    break
                at, share, begun = _CLOSER * at, 1.0, iteration + 1
        away[n] = least
