"""What the compiled search asks of a constraint, whatever its kind.

A kind brings C functions by their addresses, and numbers that they take (`ConstraintArrays`), so
that the search is compiled once for all kinds.  Shapes: D joints, m rows of the residual.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from llvmlite import ir
from numba import carray, cfunc, njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.robot.kernels import LANES, Lanes
from constraint_geodesics.robot.kinematics import ChainArrays


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


LINEARISE_WORDS = 13
"""Addresses of the chain's arrays, then of data, q, room, residuals and Jacobians, the last 0 where
they are not asked for; D, m and how many configurations, LANES at most where room is asked for.
"""
CURVATURE_WORDS = 7
"""Addresses of the chain's prismatic, data, room, weights and of the matrix to fill; D; which of
the configurations.
"""


class ConstraintArrays(NamedTuple):
    """A constraint of any kind, as the kernels take it.

    data (n,): the kind's own numbers.  linearise, curvature: addresses of what `c_function` made of
    functions of LINEARISE_WORDS and CURVATURE_WORDS integers, which the functions of these names
    here call; the second 0 where there is no closed form, and its answer 0 where it finds none.
    room: how many numbers the two need to write into; what the first leaves there is the second's.
    """

    rows: Rows
    data: Float[np.ndarray, "n"]
    linearise: int
    curvature: int
    room: int


class Looked(NamedTuple):
    """What is known of up to LANES configurations: residuals (LANES, m), Jacobians (LANES, m, D),
    and the room of the constraint's kind.
    """

    residuals: np.ndarray
    jacobians: np.ndarray
    room: np.ndarray


def c_function(function: Callable[..., int], words: int, cache: bool = True) -> Any:
    """A C function of that many 64-bit integers that returns one; its `.address` is good while it
    lives.  cache: whether numba's cache keeps it, which a closure can't use.
    """
    options = {**COMPILE, "cache": cache}
    return cfunc(types.intp(*(types.intp,) * words), **options)(function)


@intrinsic
def floats(typing, address):
    """A pointer for `carray` to numbers at an address."""

    def generate(context, builder, signature, values):
        return builder.inttoptr(values[0], ir.DoubleType().as_pointer())

    return types.CPointer(types.float64)(types.intp), generate


@intrinsic
def flags(typing, address):
    """A pointer for `carray` to booleans at an address."""

    def generate(context, builder, signature, values):
        return builder.inttoptr(values[0], ir.IntType(8).as_pointer())

    return types.CPointer(types.boolean)(types.intp), generate


@intrinsic
def call(typing, address, words):
    """The answer of a C function at an address to a tuple of integers."""

    def generate(context, builder, signature, values):
        word = ir.IntType(64)
        own = cgutils.unpack_tuple(builder, values[1])
        function = ir.FunctionType(word, [word] * len(own)).as_pointer()
        return builder.call(builder.inttoptr(values[0], function), own)

    return types.intp(types.intp, words), generate


@njit(inline="always", **COMPILE)
def chain_at(origins, axes, prismatic, base, tool, dof):
    """A robot's chain from the addresses of its arrays."""
    return ChainArrays(
        carray(floats(origins), (dof, 4, 4)),
        carray(floats(axes), (dof, 3)),
        carray(flags(prismatic), (dof,)),
        carray(floats(base), (4, 4)),
        carray(floats(tool), (4, 4)),
    )


TOOL_WORDS, JOINT_WORDS = 12 * LANES, 8 * LANES
"""Numbers of the room that the tools' frames take in `lanes_at`, and each joint."""


@njit(inline="always", **COMPILE)
def lanes_at(room, dof):
    """Where the arm is in up to LANES configurations, at the head of a kind's room: TOOL_WORDS +
    JOINT_WORDS · D numbers.
    """
    origins = room + 8 * TOOL_WORDS
    axes, sines = origins + 24 * LANES * dof, origins + 48 * LANES * dof
    return Lanes(
        carray(floats(room), (3, 4, LANES)),
        carray(floats(origins), (dof, 3, LANES)),
        carray(floats(axes), (dof, 3, LANES)),
        carray(floats(sines), (dof, LANES)),
        carray(floats(sines + 8 * LANES * dof), (dof, LANES)),
    )


@njit(**COMPILE)
def new_look(constraint, dof):
    """What `linearise` writes into; rows that are not held are left zero."""
    count = constraint.rows.held.shape[0]
    residuals, jacobians = np.zeros((LANES, count)), np.zeros((LANES, count, dof))
    return Looked(residuals, jacobians, np.empty(constraint.room))


@njit(inline="always", **LEAF)
def linearise(manifold, q, looked):
    """Residuals and their Jacobians of at most LANES configurations (B, D), which lie one after
    another in memory, into the first of `looked`; rows that are not held are left alone.
    """
    _ask(manifold, q, looked.room, looked.residuals, looked.jacobians.ctypes.data)


@njit(inline="always", **LEAF)
def _ask(manifold, q, room, residuals, jacobians):
    chain, own = manifold.chain, manifold.constraint
    words = (
        chain.origins.ctypes.data,
        chain.axes.ctypes.data,
        chain.prismatic.ctypes.data,
        chain.base.ctypes.data,
        chain.tool.ctypes.data,
        own.data.ctypes.data,
        q.ctypes.data,
        room.ctypes.data,
        residuals.ctypes.data,
        jacobians,
        q.shape[1],
        residuals.shape[1],
        q.shape[0],
    )
    call(own.linearise, words)


@njit(inline="always", **LEAF)
def curvature(manifold, weights, looked, which, full):
    """Σ λ_j ∇²r_j (D, D) of one of the configurations that `looked` is of; False where there is no
    closed form.
    """
    chain, own = manifold.chain, manifold.constraint
    if own.curvature == 0:
        return False
    words = (
        chain.prismatic.ctypes.data,
        own.data.ctypes.data,
        looked.room.ctypes.data,
        weights.ctypes.data,
        full.ctypes.data,
        full.shape[0],
        which,
    )
    return call(own.curvature, words) != 0


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
    room = np.empty(manifold.constraint.room)
    residuals[:] = 0.0
    jacobians[:] = 0.0
    for b in range(0, q.shape[0], LANES):
        slopes = jacobians[b : b + LANES].ctypes.data
        _ask(manifold, q[b : b + LANES], room, residuals[b : b + LANES], slopes)


@njit(**COMPILE)
def violation_batch(manifold, q, worst):
    """The largest excess of each of q (B, D) into worst (B,)."""
    rows = manifold.constraint.rows
    count = rows.held.shape[0]
    room, residuals = np.empty(manifold.constraint.room), np.zeros((LANES, count))
    excess, active = np.empty(count), np.empty(count, dtype=np.bool_)
    for b in range(0, q.shape[0], LANES):
        part = q[b : b + LANES]
        _ask(manifold, part, room, residuals, 0)
        for n in range(part.shape[0]):
            worst[b + n] = excess_of(rows, residuals[n], excess, active)


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
