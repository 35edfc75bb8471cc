"""Compiled tangential pull: which way every point of a curve on a constraint manifold wants to move
to shorten it.
"""

import numpy as np
from numba import njit

from constraint_geodesics.constraints.kernels import residual_of, residual_row, shared_tolerance
from constraint_geodesics.robot.kernels import geometric_jacobian, pose_of

_COMPILE = {"cache": True, "fastmath": {"contract"}, "error_model": "numpy", "nogil": True}


@njit(**_COMPILE)
def _append_normal(row, rows, size):
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


@njit(**_COMPILE)
def tangential_pull(
    chain,
    held,
    tolerance,
    reference_position,
    reference_rotation,
    lower,
    upper,
    touching,
    times,
    joints,
    pulls,
):
    """Pull of every inner point of curves into pulls (B, S, D), zero at both ends: minus the
    gradient of the energy E = ½ Σ_i ‖q_{i+1} − q_i‖² / (t_{i+1} − t_i) with respect to q_i, on the
    tangent space of the constraint there.

    joints (B, S, D) [rad] on the constraint at times (S,).  Rows held exactly are always projected
    out; tolerances and joint limits only where the point lies within `touching` [rad or m] of the
    bound and is pulled across it.
    """
    origins, axes, prismatic, base, tool = chain
    dof = joints.shape[2]
    last = joints.shape[1] - 1
    position = np.empty(3)
    rotation = np.empty((3, 3))
    joint_origins = np.empty((dof, 3))
    joint_axes = np.empty((dof, 3))
    geometric = np.empty((6, dof))
    linear = np.empty((3, 3))
    residual = np.empty(6)
    jacobian = np.empty((6, dof))
    rows = np.empty((dof, dof))
    row = np.empty(dof)
    any_held = held.any()
    common = shared_tolerance(held, tolerance)
    cone = common > 0.0
    for b in range(joints.shape[0]):
        for d in range(dof):
            pulls[b, 0, d] = 0.0
            pulls[b, last, d] = 0.0
        for s in range(1, last):
            q = joints[b, s]
            pull = pulls[b, s]
            for d in range(dof):
                ahead = (joints[b, s + 1, d] - q[d]) / (times[s + 1] - times[s])
                pull[d] = ahead - (q[d] - joints[b, s - 1, d]) / (times[s] - times[s - 1])
            size = 0
            if any_held:
                pose_of(
                    origins,
                    axes,
                    prismatic,
                    base,
                    tool,
                    q,
                    position,
                    rotation,
                    joint_origins,
                    joint_axes,
                )
                residual_of(
                    held,
                    reference_position,
                    reference_rotation,
                    position,
                    rotation,
                    residual,
                    linear,
                )
                geometric_jacobian(prismatic, position, joint_origins, joint_axes, geometric)
                square = 0.0
                for i in range(6):
                    if not held[i]:
                        continue
                    residual_row(i, linear, geometric, jacobian, i)
                    if i >= 3:
                        square += residual[i] * residual[i]
                    if tolerance[i] == 0.0:
                        for d in range(dof):
                            row[d] = jacobian[i, d]
                        size = _append_normal(row, rows, size)
                for i in range(7):
                    # an inequality: a tolerance, or in the seventh place the cone
                    if i == 6:
                        angle = np.sqrt(square)
                        if not cone or angle < common - touching or angle == 0.0:
                            continue
                        for d in range(dof):
                            row[d] = 0.0
                            for k in range(3, 6):
                                if held[k]:
                                    row[d] += residual[k] / angle * jacobian[k, d]
                    elif (not held[i] or tolerance[i] == 0.0 or (cone and i >= 3)) or (
                        abs(residual[i]) < tolerance[i] - touching
                    ):
                        continue
                    else:
                        for d in range(dof):
                            row[d] = jacobian[i, d] if residual[i] > 0.0 else -jacobian[i, d]
                    across = 0.0
                    for d in range(dof):
                        across += row[d] * pull[d]
                    if across > 0.0:
                        size = _append_normal(row, rows, size)
            for d in range(dof):
                if (q[d] >= upper[d] - touching and pull[d] > 0.0) or (
                    q[d] <= lower[d] + touching and pull[d] < 0.0
                ):
                    for k in range(dof):
                        row[k] = 1.0 if k == d else 0.0
                    size = _append_normal(row, rows, size)
            for j in range(size):
                value = 0.0
                for d in range(dof):
                    value += rows[j, d] * pull[d]
                for d in range(dof):
                    pull[d] -= value * rows[j, d]
