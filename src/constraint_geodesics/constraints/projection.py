"""Projection of joint configurations onto a constraint manifold: Gauss-Newton on the true
kinematics.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.kernels import (
    Looked,
    Rows,
    backward,
    cholesky,
    excess_of,
    forward,
    linearise,
    new_look,
)
from constraint_geodesics.robot.kernels import LANES


class Retraction(NamedTuple):
    """Settings of the projection: accuracy asked for [rad or m], steps at most, longest step
    [rad].

    damping: what is added to the diagonal of J Jᵀ, as a share of its trace.  Beside a singular
    configuration a small violation can take a long step to mend; with more damping the step is
    shorter, and leaves more.
    last_step: a step shorter than this [rad] that corrects all rows is the last, and what it leaves
    is estimated (`left_by`) in place of measured; 0 to measure always.
    """

    accuracy: float = 1e-9
    iterations: int = 50
    largest_step: float = 0.6
    last_step: float = 0.0
    damping: float = 1e-10


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
    """Nearest point (to first order) of the constraint manifold to each configuration; one that is
    not finite does not converge.

    Points inside the tolerance stay where they are; joint limits are not considered.
    band: the share of the tolerance, 0 to 1, that each configuration may use; all of it by default.
    """
    settings = settings or Retraction()
    joints = np.array(q, dtype=np.float64).reshape(-1, q.shape[-1])
    shares = np.ones(len(joints)) if band is None else np.asarray(band, float).reshape(-1)
    worst = np.empty(len(joints))
    retract_batch(manifold.arrays, shares, joints, settings, worst)
    worst[~np.isfinite(joints).all(axis=1)] = np.inf
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
    """What the projection writes into: LANES configurations and which they are; excess, right (m,),
    active, tolerance (m,), rows (m, D), normal (m, m), step (D,).
    """

    looked: Looked
    places: np.ndarray
    order: np.ndarray
    excess: np.ndarray
    right: np.ndarray
    active: np.ndarray
    tolerance: np.ndarray
    rows: np.ndarray
    normal: np.ndarray
    step: np.ndarray


@njit(**COMPILE)
def new_room(constraint, dof):
    """Room for the projections of one constraint."""
    count = constraint.rows.held.shape[0]
    return RetractionRoom(
        new_look(constraint, dof),
        np.empty((LANES, dof)),
        np.empty(LANES, dtype=np.int64),
        np.empty(count),
        np.empty(count),
        np.empty(count, dtype=np.bool_),
        np.empty(count),
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
def left_by(square, ridge, weights, size):
    """What a step of Newton's method leaves of the rows that it corrects [rad or m], about: the
    square of its length [rad], for second derivatives of order 1, and what the ridge on J Jᵀ takes
    from it, by the rows' weights (m,).
    """
    largest = 0.0
    for i in range(size):
        largest = max(largest, abs(weights[i]))
    return square + ridge * largest


@njit(**LEAF)
def _step(q, jacobian, held, settings, room):
    """One step of Gauss-Newton of q (D,) in place, of the excesses in the room and their Jacobian
    (m, D); held: how many rows there are.  Returns what is left [rad or m], inf where that is to be
    measured, and −1 where there is no step.
    """
    excess, right, active = room.excess, room.right, room.active
    rows, normal, step = room.rows, room.normal, room.step
    size = _gathered(active, excess, jacobian, right, rows)
    ridge = settings.damping * normal_matrix(rows, size, normal) + 1e-300
    for i in range(size):
        normal[i, i] += ridge
    if not solve_normal(normal, size, right, 0.0):
        return -1.0
    square = 0.0
    for d in range(q.shape[0]):
        step[d] = 0.0
        for i in range(size):
            step[d] += rows[i, d] * right[i]
        square += step[d] * step[d]
    length = np.sqrt(square)
    scale = 1.0 if length <= settings.largest_step else settings.largest_step / length
    for d in range(q.shape[0]):
        q[d] -= scale * step[d]
    if length < settings.last_step and size == held:
        left = left_by(square, ridge, right, size)
        if left <= settings.accuracy:
            return left
    return np.inf


@njit(**COMPILE)
def retract_batch(manifold, shares, q, settings, worst):
    """`retract_all` of q (B, D), in room of its own."""
    retract_all(manifold, shares, q, settings, worst, new_room(manifold.constraint, q.shape[1]))


@njit(**LEAF)
def retract_all(manifold, shares, q, settings, worst, room):
    """Gauss-Newton onto the constraint, in place: q ← q − Jᵀ(JJᵀ)⁻¹ ι(q) until |ι| ≤ accuracy, for
    each of q (B, D).  shares (B,): of the tolerance, that each may use; those below 0 are left
    alone.  worst (B,) gets the remaining excesses, 0 for these.

    A step is never longer than `largest_step` [rad], so that a point far away walks to its own
    branch instead of jumping to another.
    """
    bounds, order = manifold.constraint.rows, room.order
    held, begin = np.sum(bounds.held), 0
    while begin < q.shape[0]:
        count = 0
        while begin < q.shape[0] and count < LANES:
            worst[begin] = 0.0
            if shares[begin] >= 0.0:
                order[count] = begin
                count += 1
            begin += 1
        for iteration in range(settings.iterations + 1):
            if count == 0:
                break
            may = iteration < settings.iterations
            count = _stepped(manifold, shares, q, count, held, may, settings, worst, room)


@njit(**LEAF)
def _stepped(manifold, shares, q, count, held, may, settings, worst, room):
    """Look at the first `count` of `room.order` and, if they may, take a step; those that go on
    become the first, and their number is returned.
    """
    bounds, order, tolerance = manifold.constraint.rows, room.order, room.tolerance
    narrow, left = Rows(bounds.held, tolerance, bounds.together), 0
    for k in range(count):
        for d in range(q.shape[1]):
            room.places[k, d] = q[order[k], d]
    linearise(manifold, room.places[:count], room.looked)
    for k in range(count):
        b = order[k]
        for i in range(tolerance.shape[0]):
            tolerance[i] = shares[b] * bounds.tolerance[i]
        worst[b] = excess_of(narrow, room.looked.residuals[k], room.excess, room.active)
        if not (worst[b] > settings.accuracy and may):
            continue
        after = _step(q[b], room.looked.jacobians[k], held, settings, room)
        if after == np.inf:
            order[left] = b
            left += 1
        elif after >= 0.0:
            worst[b] = after
    return left
