"""Projection of joint configurations onto a constraint manifold: Gauss-Newton on the true
kinematics.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.kernels import (
    Rows,
    backward,
    cholesky,
    excess_of,
    forward,
    linearise,
)


class Retraction(NamedTuple):
    """Settings of the projection: accuracy asked for [rad or m], steps at most, longest step
    [rad].

    last_step: a step shorter than this [rad] that corrects all rows is the last.  What Newton's
    method leaves after it is of its square, which is returned in place of a measured excess; 0 to
    measure always.
    """

    accuracy: float = 1e-9
    iterations: int = 50
    largest_step: float = 0.6
    last_step: float = 0.0


@dataclass(frozen=True)
class Retracted:
    """Configurations on the manifold, what of the violation remained [rad or m], and which reached
    the accuracy.
    """

    joints: Float[np.ndarray, "*batch D"]
    violation: Float[np.ndarray, "*batch"]
    converged: Bool[np.ndarray, "*batch"]


def retract(
    manifold: ConstraintManifold,
    q: Float[np.ndarray, "*batch D"],
    settings: Retraction | None = None,
    band: Float[np.ndarray, "*batch"] | None = None,
) -> Retracted:
    """Nearest point (to first order) of the constraint manifold to each configuration.

    Points inside the tolerance stay where they are; joint limits are not considered.
    band: the share of the tolerance, 0 to 1, that each configuration may use; all of it by default.
    """
    settings = settings or Retraction()
    joints = np.array(q, dtype=np.float64).reshape(-1, q.shape[-1])
    shares = np.ones(len(joints)) if band is None else np.asarray(band, float).reshape(-1)
    worst = np.empty(len(joints))
    retract_batch(manifold.arrays, shares, joints, settings, worst)
    batch = q.shape[:-1]
    return Retracted(
        joints.reshape(q.shape), worst.reshape(batch), (worst <= settings.accuracy).reshape(batch)
    )


@njit(**LEAF)
def normal_matrix(rows, size, normal):
    """Lower half of J Jᵀ of the leading `size` rows of J (m, D); returns its trace."""
    trace = 0.0
    for i in range(size):
        for j in range(i + 1):
            value = 0.0
            for d in range(rows.shape[1]):
                value += rows[i, d] * rows[j, d]
            normal[i, j] = value
        trace += normal[i, i]
    return trace


@njit(**LEAF)
def solve_normal(normal, size, right, smallest_pivot):
    """(J Jᵀ)⁻¹ right into `right` (m,): the weights of J's rows in the shortest step with J step =
    right; False where J Jᵀ, of `normal_matrix` and overwritten, is singular.
    """
    if not cholesky(normal, size, smallest_pivot):
        return False
    forward(normal, size, right)
    backward(normal, size, right)
    return True


class RetractionRoom(NamedTuple):
    """What the projection writes into: what the constraint's kind needs, residual, excess, right,
    active (m,), jacobian, rows (m, D), normal (m, m), step (D,).
    """

    own: Any
    residual: np.ndarray
    excess: np.ndarray
    right: np.ndarray
    active: np.ndarray
    jacobian: np.ndarray
    rows: np.ndarray
    normal: np.ndarray
    step: np.ndarray


@njit(**COMPILE)
def new_room(constraint, dof):
    """Room for the projections of one constraint."""
    count = constraint.rows.held.shape[0]
    return RetractionRoom(
        np.empty(constraint.room),
        np.zeros(count),
        np.empty(count),
        np.empty(count),
        np.empty(count, dtype=np.bool_),
        np.empty((count, dof)),
        np.empty((count, dof)),
        np.empty((count, count)),
        np.empty(dof),
    )


@njit(**LEAF)
def _gathered(active, excess, jacobian, right, rows):
    """The active rows with their excesses, one after another; returns how many."""
    size = 0
    for i in range(active.shape[0]):
        if active[i]:
            for d in range(jacobian.shape[1]):
                rows[size, d] = jacobian[i, d]
            right[size] = excess[i]
            size += 1
    return size


@njit(**LEAF)
def retract_one(manifold, bounds, q, settings, room):
    """Gauss-Newton onto the constraint, in place: q ← q − Jᵀ(JJᵀ)⁻¹ ι(q) until |ι| ≤ accuracy, for
    q (D,); returns the remaining excess.

    bounds: how the rows are bounded.  A step is never longer than `largest_step` [rad], so that a
    point far away walks to its own branch instead of jumping to another.
    """
    _, residual, excess, right, active, jacobian, rows, normal, step = room
    dof, worst, count = q.shape[0], np.inf, np.sum(bounds.held)
    for iteration in range(settings.iterations + 1):
        linearise(manifold, q, room.own, residual, jacobian)
        worst = excess_of(bounds, residual, excess, active)
        if not worst > settings.accuracy or iteration == settings.iterations:
            break
        size = _gathered(active, excess, jacobian, right, rows)
        trace = normal_matrix(rows, size, normal)
        for i in range(size):
            normal[i, i] += 1e-10 * trace + 1e-300
        if not solve_normal(normal, size, right, 0.0):
            break
        length = 0.0
        for d in range(dof):
            step[d] = 0.0
            for i in range(size):
                step[d] += rows[i, d] * right[i]
            length += step[d] * step[d]
        length = np.sqrt(length)
        scale = 1.0 if length <= settings.largest_step else settings.largest_step / length
        for d in range(dof):
            q[d] -= scale * step[d]
        if length < settings.last_step and size == count:
            return length * length
    return worst


@njit(**COMPILE)
def retract_batch(manifold, shares, q, settings, worst):
    """`retract_one` for each of q (B, D), in place.  shares (B,): of the tolerance, that each may
    use.  worst (B,) gets the remaining excesses.
    """
    bounds = manifold.constraint.rows
    room, tolerance = new_room(manifold.constraint, q.shape[1]), bounds.tolerance.copy()
    narrow = Rows(bounds.held, tolerance, bounds.together)
    for b in range(q.shape[0]):
        for i in range(tolerance.shape[0]):
            tolerance[i] = shares[b] * bounds.tolerance[i]
        worst[b] = retract_one(manifold, narrow, q[b], settings, room)
