"""Compiled constraint residual, its Jacobian and the Gauss-Newton retraction, one configuration at
a time.

The orientation residual neither wraps nor locks.  With E = R R_refᵀ the rotation away from the
reference: three held axes: the rotation vector of E; two held axes, axis k free: the swing that
turns e_k back, i.e. the angle θ between R R_refᵀ e_k and e_k times its direction; one held axis k:
the twist of E about e_k. The swing keeps its size up to θ = π, where the horizontal part of the
axis alone would vanish upside down too.
"""

import numpy as np
from numba import njit

from constraint_geodesics.robot.kernels import geometric_jacobian, pose_of

_COMPILE = {"cache": True, "fastmath": {"contract"}, "error_model": "numpy", "nogil": True}
_SMALL = 1e-9


@njit(**_COMPILE)
def _quaternion(a, b):
    """Unit quaternion (w ≥ 0, x, y, z) of the rotation E = A Bᵀ, by Shepperd's branch with the
    largest component.
    """
    e00 = a[0, 0] * b[0, 0] + a[0, 1] * b[0, 1] + a[0, 2] * b[0, 2]
    e01 = a[0, 0] * b[1, 0] + a[0, 1] * b[1, 1] + a[0, 2] * b[1, 2]
    e02 = a[0, 0] * b[2, 0] + a[0, 1] * b[2, 1] + a[0, 2] * b[2, 2]
    e10 = a[1, 0] * b[0, 0] + a[1, 1] * b[0, 1] + a[1, 2] * b[0, 2]
    e11 = a[1, 0] * b[1, 0] + a[1, 1] * b[1, 1] + a[1, 2] * b[1, 2]
    e12 = a[1, 0] * b[2, 0] + a[1, 1] * b[2, 1] + a[1, 2] * b[2, 2]
    e20 = a[2, 0] * b[0, 0] + a[2, 1] * b[0, 1] + a[2, 2] * b[0, 2]
    e21 = a[2, 0] * b[1, 0] + a[2, 1] * b[1, 1] + a[2, 2] * b[1, 2]
    e22 = a[2, 0] * b[2, 0] + a[2, 1] * b[2, 1] + a[2, 2] * b[2, 2]
    trace = e00 + e11 + e22
    if trace > 0.0:
        s = 2.0 * np.sqrt(trace + 1.0)
        w, x, y, z = 0.25 * s, (e21 - e12) / s, (e02 - e20) / s, (e10 - e01) / s
    elif e00 >= e11 and e00 >= e22:
        s = 2.0 * np.sqrt(1.0 + e00 - e11 - e22)
        w, x, y, z = (e21 - e12) / s, 0.25 * s, (e01 + e10) / s, (e02 + e20) / s
    elif e11 >= e22:
        s = 2.0 * np.sqrt(1.0 + e11 - e00 - e22)
        w, x, y, z = (e02 - e20) / s, (e01 + e10) / s, 0.25 * s, (e12 + e21) / s
    else:
        s = 2.0 * np.sqrt(1.0 + e22 - e00 - e11)
        w, x, y, z = (e10 - e01) / s, (e02 + e20) / s, (e12 + e21) / s, 0.25 * s
    if w < 0.0:
        return -w, -x, -y, -z
    return w, x, y, z


@njit(**_COMPILE)
def _swing(w, k, residual, linear):
    """Swing from e_k to the unit vector w into residual[3:], and its derivative (3, 3) to ω, where
    ẇ = ω × w.
    """
    i, j = (k + 1) % 3, (k + 2) % 3
    # e_k × w has the components (−w_j, w_i) along (e_i, e_j)
    si, sj, c = -w[j], w[i], w[k]
    s = np.sqrt(si * si + sj * sj)
    theta = np.arctan2(s, c)
    if s > _SMALL:
        g = theta / s
        dg = (s - theta * c) / (s * s)
    else:
        # upside down the direction is lost: lean towards e_i, so that a step is still taken
        g = 1.0 if c > 0.0 else np.pi / _SMALL
        dg = 0.0
        if c < 0.0:
            si = _SMALL
    residual[3 + i], residual[3 + j] = g * si, g * sj
    for a in range(3):
        # ω = e_a gives ẇ = e_a × w
        w0 = 0.0 if a == 0 else (w[2] if a == 1 else -w[1])
        w1 = -w[2] if a == 0 else (0.0 if a == 1 else w[0])
        w2 = w[1] if a == 0 else (-w[0] if a == 1 else 0.0)
        dw = (w0, w1, w2)
        dsi, dsj, dc = -dw[j], dw[i], dw[k]
        dtheta = (c * (si * dsi + sj * dsj) / s - s * dc) if s > _SMALL else 0.0
        linear[k, a] = 0.0
        linear[i, a] = g * dsi + dg * dtheta * si
        linear[j, a] = g * dsj + dg * dtheta * sj


@njit(**_COMPILE)
def _rotation_vector(quaternion, residual, linear):
    """Rotation vector of a unit quaternion into residual[3:], and the inverse left Jacobian of
    SO(3), its derivative to ω.
    """
    w, x, y, z = quaternion
    n = np.sqrt(x * x + y * y + z * z)
    theta = 2.0 * np.arctan2(n, w)
    scale = theta / n if n > _SMALL else 2.0
    r0, r1, r2 = x * scale, y * scale, z * scale
    residual[3], residual[4], residual[5] = r0, r1, r2
    if theta > 1e-4:
        half = 0.5 * theta
        b = (1.0 - half * np.cos(half) / np.sin(half)) / (theta * theta)
    else:
        b = 1.0 / 12.0
    rest = 1.0 - b * (r0 * r0 + r1 * r1 + r2 * r2)
    linear[0, 0], linear[0, 1], linear[0, 2] = (
        rest + b * r0 * r0,
        b * r0 * r1 + 0.5 * r2,
        b * r0 * r2 - 0.5 * r1,
    )
    linear[1, 0], linear[1, 1], linear[1, 2] = (
        b * r1 * r0 - 0.5 * r2,
        rest + b * r1 * r1,
        b * r1 * r2 + 0.5 * r0,
    )
    linear[2, 0], linear[2, 1], linear[2, 2] = (
        b * r2 * r0 + 0.5 * r1,
        b * r2 * r1 - 0.5 * r0,
        rest + b * r2 * r2,
    )


@njit(**_COMPILE)
def _twist(quaternion, k, residual, linear):
    """Twist about e_k into residual[3 + k], and its derivative to ω into row k of `linear`."""
    w, i, j = quaternion[0], (k + 1) % 3, (k + 2) % 3
    vk, vi, vj = quaternion[1 + k], quaternion[1 + i], quaternion[1 + j]
    residual[3 + k] = 2.0 * np.arctan2(vk, w)
    square = max(w * w + vk * vk, _SMALL)
    # q̇ = ½ ω ⊗ q, so ẇ = −½ ω·v and v̇_k = ½ (w ω_k + (ω × v)_k) with (ω × v)_k = ω_i v_j − ω_j
    # v_i
    linear[k, k] = (w * w + vk * vk) / square
    linear[k, i] = (w * vj + vk * vi) / square
    linear[k, j] = (-w * vi + vk * vj) / square


@njit(**_COMPILE)
def residual_of(held, reference_position, reference_rotation, position, rotation, residual, linear):
    """Residual (6,) [m, rad] of one tool pose, and the (3, 3) matrix that turns ω into its
    orientation part.

    Entries of axes that are not held are zero.
    """
    for i in range(3):
        residual[i] = position[i] - reference_position[i] if held[i] else 0.0
        residual[3 + i] = 0.0
    linear[:, :] = 0.0
    count = 0
    for i in range(3):
        count += held[3 + i]
    if count == 0:
        return
    if count == 2:
        free = 0
        for i in range(3):
            if not held[3 + i]:
                free = i
        v0, v1, v2 = (
            reference_rotation[free, 0],
            reference_rotation[free, 1],
            reference_rotation[free, 2],
        )
        w = (
            rotation[0, 0] * v0 + rotation[0, 1] * v1 + rotation[0, 2] * v2,
            rotation[1, 0] * v0 + rotation[1, 1] * v1 + rotation[1, 2] * v2,
            rotation[2, 0] * v0 + rotation[2, 1] * v1 + rotation[2, 2] * v2,
        )
        _swing(w, free, residual, linear)
        return
    quaternion = _quaternion(rotation, reference_rotation)
    if count == 3:
        _rotation_vector(quaternion, residual, linear)
        return
    axis = 0
    for i in range(3):
        if held[3 + i]:
            axis = i
    _twist(quaternion, axis, residual, linear)


@njit(**_COMPILE)
def shared_tolerance(held, tolerance):
    """The tolerance [rad] that all held angles have; −1 if they differ, or none is held."""
    common = -1.0
    for i in range(3, 6):
        if held[i]:
            if common < 0.0:
                common = tolerance[i]
            elif tolerance[i] != common:
                return -1.0
    return common


@njit(**_COMPILE)
def excess_of(held, tolerance, residual, excess, active):
    """What of the residual lies outside the tolerance, signed, eq. 7; marks the rows a step must
    correct.

    Held angles that share one tolerance form a cone (a ball, for three of them): the size of their
    vector counts.
    """
    worst = 0.0
    common = shared_tolerance(held, tolerance)
    square = 0.0
    for i in range(6):
        excess[i] = 0.0
        active[i] = False
        if i >= 3 and held[i]:
            square += residual[i] * residual[i]
    size = np.sqrt(square)
    for i in range(6):
        if not held[i]:
            continue
        if i >= 3 and common >= 0.0:
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


@njit(**_COMPILE, inline="always")
def residual_row(i, linear, geometric, rows, k):
    """Row i of the residual's Jacobian into row k, from the matrix of `residual_of` and the
    geometric Jacobian.
    """
    for d in range(rows.shape[1]):
        value = 0.0
        if i < 3:
            value = geometric[i, d]
        else:
            for a in range(3):
                value += linear[i - 3, a] * geometric[3 + a, d]
        rows[k, d] = value


@njit(**_COMPILE)
def residual_batch(chain, held, reference_position, reference_rotation, q, residuals, jacobians):
    """Residuals (B, 6) and their Jacobians (B, 6, D) of q (B, D); rows of axes that are not held
    are zero.
    """
    origins, axes, prismatic, base, tool = chain
    dof = q.shape[1]
    position = np.empty(3)
    rotation = np.empty((3, 3))
    joint_origins = np.empty((dof, 3))
    joint_axes = np.empty((dof, 3))
    geometric = np.empty((6, dof))
    linear = np.empty((3, 3))
    jacobians[:] = 0.0
    for b in range(q.shape[0]):
        pose_of(
            origins,
            axes,
            prismatic,
            base,
            tool,
            q[b],
            position,
            rotation,
            joint_origins,
            joint_axes,
        )
        residual_of(
            held, reference_position, reference_rotation, position, rotation, residuals[b], linear
        )
        geometric_jacobian(prismatic, position, joint_origins, joint_axes, geometric)
        for i in range(6):
            if held[i]:
                residual_row(i, linear, geometric, jacobians[b], i)


@njit(**_COMPILE)
def excess_batch(held, tolerance, residuals, excesses, worst):
    """Signed excesses (B, 6) of residuals (B, 6), and the largest of each row (B,)."""
    active = np.empty(6, dtype=np.bool_)
    for b in range(residuals.shape[0]):
        worst[b] = excess_of(held, tolerance, residuals[b], excesses[b], active)


@njit(**_COMPILE)
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


@njit(**_COMPILE)
def forward(factor, size, right):
    """Solve L x = right in place, with the factor L of `cholesky`."""
    for i in range(size):
        for k in range(i):
            right[i] -= factor[i, k] * right[k]
        right[i] /= factor[i, i]


@njit(**_COMPILE)
def backward(factor, size, right):
    """Solve Lᵀ x = right in place, with the factor L of `cholesky`."""
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            right[i] -= factor[k, i] * right[k]
        right[i] /= factor[i, i]


@njit(**_COMPILE)
def retract_batch(
    chain,
    held,
    tolerances,
    reference_position,
    reference_rotation,
    q,
    accuracy,
    iterations,
    largest_step,
    worst,
):
    """Gauss-Newton onto the constraint, in place: q ← q − Jᵀ(JJᵀ)⁻¹ ι(q) until |ι| ≤ accuracy, for
    q (B, D).

    tolerances: (B, 6), one band a configuration.  A step is never longer than `largest_step` [rad],
    so that a point far away walks to its own branch instead of jumping to another.  worst (B,) gets
    the remaining excess.
    """
    origins, axes, prismatic, base, tool = chain
    dof = q.shape[1]
    position = np.empty(3)
    rotation = np.empty((3, 3))
    joint_origins = np.empty((dof, 3))
    joint_axes = np.empty((dof, 3))
    geometric = np.empty((6, dof))
    linear = np.empty((3, 3))
    residual = np.empty(6)
    excess = np.empty(6)
    active = np.empty(6, dtype=np.bool_)
    rows = np.empty((6, dof))
    normal = np.empty((6, 6))
    right = np.empty(6)
    step = np.empty(dof)
    for b in range(q.shape[0]):
        for iteration in range(iterations + 1):
            pose_of(
                origins,
                axes,
                prismatic,
                base,
                tool,
                q[b],
                position,
                rotation,
                joint_origins,
                joint_axes,
            )
            residual_of(
                held, reference_position, reference_rotation, position, rotation, residual, linear
            )
            worst[b] = excess_of(held, tolerances[b], residual, excess, active)
            if not worst[b] > accuracy or iteration == iterations:
                break
            geometric_jacobian(prismatic, position, joint_origins, joint_axes, geometric)
            size = 0
            for i in range(6):
                if not active[i]:
                    continue
                residual_row(i, linear, geometric, rows, size)
                right[size] = excess[i]
                size += 1
            trace = 0.0
            for i in range(size):
                for j in range(i + 1):
                    value = 0.0
                    for d in range(dof):
                        value += rows[i, d] * rows[j, d]
                    normal[i, j] = value
                trace += normal[i, i]
            for i in range(size):
                normal[i, i] += 1e-10 * trace + 1e-300
            if not cholesky(normal, size, 0.0):
                break
            forward(normal, size, right)
            backward(normal, size, right)
            length = 0.0
            for d in range(dof):
                step[d] = 0.0
                for i in range(size):
                    step[d] += rows[i, d] * right[i]
                length += step[d] * step[d]
            length = np.sqrt(length)
            scale = 1.0 if length <= largest_step else largest_step / length
            for d in range(dof):
                q[b, d] -= scale * step[d]
