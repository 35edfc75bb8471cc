"""What the compiled search asks of a constraint, whatever its kind, one configuration at a time.

A kind brings a NamedTuple of arrays whose first field is `rows` (Rows), and registers what is
compiled for it with `register`: `scratch`, `linearise` and, if it knows one, a closed form of the
`curvature`.  Calls are bound when a kernel is compiled, so a further kind changes nothing in the
search and costs nothing at run time.  Shapes: D joints, m rows of the residual.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit
from numba.extending import overload

from constraint_geodesics.compiled import COMPILE, LEAF


class Rows(NamedTuple):
    """How the m rows of a residual are bounded.

    held (m,): rows that count; the others are zero.  tolerance (m,): half-widths, in each row's
    unit; 0 holds exactly.  together (m,): rows that share one tolerance, which bounds the norm of
    them all (a cone, for angles) in place of each.
    """

    held: Bool[np.ndarray, "m"]
    tolerance: Float[np.ndarray, "m"]
    together: Bool[np.ndarray, "m"]

    @property
    def exact(self) -> Int[np.ndarray, "k"]:
        """The rows that are held exactly."""
        return np.flatnonzero(self.held & (self.tolerance == 0.0))

    @property
    def loose_groups(self) -> list[list[int]]:
        """The rows that have a tolerance, those that are bounded together in one list."""
        loose = self.held & (self.tolerance > 0.0)
        cone = np.flatnonzero(loose & self.together).tolist()
        return [[i] for i in np.flatnonzero(loose & ~self.together).tolist()] + [cone] * bool(cone)


class ManifoldArrays(NamedTuple):
    """A robot's chain and a constraint, as the kernels take them."""

    chain: Any
    constraint: Any


class _Kind(NamedTuple):
    scratch: Any
    linearise: Any
    curvature: Any


_KINDS: dict[type, _Kind] = {}


def scratch(constraint: Any, dof: int) -> Any:
    """What `linearise` of this kind writes besides its results, allocated once."""
    raise NotImplementedError("only inside compiled code")


def linearise(manifold: Any, q: Any, own: Any, residual: Any, jacobian: Any) -> None:
    """Residual (m,) and its Jacobian (m, D) of one configuration; rows that are not held are left
    alone.  own: of `scratch`.
    """
    raise NotImplementedError("only inside compiled code")


def curvature(manifold: Any, weights: Any, own: Any, full: Any) -> bool:
    """Σ λ_j ∇²r_j (D, D) where `linearise` was called last; False where there is no closed form."""
    raise NotImplementedError("only inside compiled code")


@njit(**LEAF)
def _no_closed_form(manifold, weights, own, full):
    return False


def register(arrays: type, scratch: Any, linearise: Any, curvature: Any = _no_closed_form) -> None:
    """Say what is compiled for constraints whose arrays are of this NamedTuple."""
    _KINDS[arrays] = _Kind(scratch, linearise, curvature)


def _kind(arrays: Any) -> _Kind:
    return _KINDS[arrays.instance_class]


def _field(arrays: Any, name: str) -> Any:
    """Numba's type of one field of a NamedTuple."""
    return arrays.types[arrays.fields.index(name)]


@overload(scratch)
def _scratch(constraint, dof):
    chosen = _kind(constraint).scratch
    return lambda constraint, dof: chosen(constraint, dof)


@overload(linearise, inline="always")  # a call counts the references of every array it is given
def _linearise(manifold, q, own, residual, jacobian):
    return _kind(_field(manifold, "constraint")).linearise.py_func


@overload(curvature, jit_options={"_nrt": False})
def _curvature(manifold, weights, own, full):
    chosen = _kind(_field(manifold, "constraint")).curvature
    return lambda manifold, weights, own, full: chosen(manifold, weights, own, full)


@njit(**LEAF)
def shared_tolerance(rows):
    """The tolerance of the rows that are bounded together; −1 if there are none."""
    _, tolerance, together = rows
    for i in range(together.shape[0]):
        if together[i]:
            return tolerance[i]
    return -1.0


@njit(**LEAF)
def excess_of(rows, residual, excess, active):
    """What of the residual (m,) lies outside the tolerance, signed, eq. 7; marks the rows a step
    must correct.  Returns the largest.
    """
    held, tolerance, together = rows
    worst = 0.0
    common = shared_tolerance(rows)
    square = 0.0
    for i in range(residual.shape[0]):
        excess[i] = 0.0
        active[i] = False
        if together[i]:
            square += residual[i] * residual[i]
    size = np.sqrt(square)
    for i in range(residual.shape[0]):
        if not held[i]:
            continue
        if together[i]:
            if size > common:
                excess[i] = residual[i] * (1.0 - common / size)
                active[i] = True
                worst = max(worst, size - common)
        else:
            over = abs(residual[i]) - tolerance[i]
            if over > 0.0:
                excess[i] = over if residual[i] > 0.0 else -over
                active[i] = True
                worst = max(worst, over)
    return worst


@njit(**COMPILE)
def residual_batch(manifold, q, residuals, jacobians):
    """Residuals (B, m) and their Jacobians (B, m, D) of q (B, D); rows that are not held are
    zero.
    """
    own = scratch(manifold.constraint, q.shape[1])
    residuals[:] = 0.0
    jacobians[:] = 0.0
    for b in range(q.shape[0]):
        linearise(manifold, q[b], own, residuals[b], jacobians[b])


@njit(**COMPILE)
def violation_batch(manifold, q, worst):
    """The largest excess of each of q (B, D) into worst (B,)."""
    dof, rows = q.shape[1], manifold.constraint.rows
    count = rows.held.shape[0]
    own, residual, excess = scratch(manifold.constraint, dof), np.zeros(count), np.empty(count)
    jacobian, active = np.empty((count, dof)), np.empty(count, dtype=np.bool_)
    for b in range(q.shape[0]):
        linearise(manifold, q[b], own, residual, jacobian)
        worst[b] = excess_of(rows, residual, excess, active)


@njit(**COMPILE)
def excess_batch(rows, residuals, excesses, worst):
    """Signed excesses (B, m) of residuals (B, m), and the largest of each row (B,)."""
    active = np.empty(residuals.shape[1], dtype=np.bool_)
    for b in range(residuals.shape[0]):
        worst[b] = excess_of(rows, residuals[b], excesses[b], active)


@njit(**LEAF)
def cholesky(matrix, size, smallest):
    """Lower Cholesky factor of the leading `size` rows, in place; False if a pivot is not above
    `smallest`.
    """
    for i in range(size):
        for j in range(i + 1):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not value > smallest:
                    return False
                matrix[i, i] = np.sqrt(value)
            else:
                matrix[i, j] = value / matrix[j, j]
    return True


@njit(**LEAF)
def forward(factor, size, right):
    """Solve L x = right in place, with the factor L of `cholesky`."""
    for i in range(size):
        for k in range(i):
            right[i] -= factor[i, k] * right[k]
        right[i] /= factor[i, i]


@njit(**LEAF)
def backward(factor, size, right):
    """Solve Lᵀ x = right in place, with the factor L of `cholesky`."""
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            right[i] -= factor[k, i] * right[k]
        right[i] /= factor[i, i]


@njit(**LEAF)
def append_normal(row, rows, size):
    """Gram-Schmidt: `row` (D,), made orthogonal to the first `size` of `rows`, becomes the next
    one; the new size.
    """
    dof = row.shape[0]
    before = 0.0
    for d in range(dof):
        before += row[d] * row[d]
    for j in range(size):
        value = 0.0
        for d in range(dof):
            value += row[d] * rows[j, d]
        for d in range(dof):
            row[d] -= value * rows[j, d]
    left = 0.0
    for d in range(dof):
        left += row[d] * row[d]
    if left <= 1e-8 * before or size >= dof:
        return size
    scale = 1.0 / np.sqrt(left)
    for d in range(dof):
        rows[size, d] = scale * row[d]
    return size + 1
