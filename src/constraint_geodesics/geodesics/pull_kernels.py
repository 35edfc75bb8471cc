"""Compiled tangential gradient: which way every point of a curve on a constraint manifold moves to
shorten it.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.constraints.kernels import (
    append_normal,
    linearise,
    new_look,
    shared_tolerance,
)
from constraint_geodesics.robot.kernels import LANES


class Bounds(NamedTuple):
    """Joint limits (D,) [rad or m], and how near [rad or m] a bound counts as touched."""

    lower: np.ndarray
    upper: np.ndarray
    touching: float


@njit(**LEAF)
def _append_across(row, gradient, rows, size):
    """The inequality's `row` becomes a normal if the gradient leads across it; the new size."""
    across = 0.0
    for d in range(row.shape[0]):
        across += row[d] * gradient[d]
    return append_normal(row, rows, size) if across > 0.0 else size


@njit(**COMPILE)
def _constraint_normals(bounds, touching, residual, jacobian, gradient, row, rows):
    """Normals of the constraint's rows that are held exactly, and of the tolerances that are
    touched and would be crossed; returns how many.
    """
    count, dof = jacobian.shape
    common = shared_tolerance(bounds)
    cone = common > 0.0
    square = 0.0
    size = 0
    for i in range(count):
        if bounds.together[i]:
            square += residual[i] * residual[i]
        if bounds.held[i] and bounds.tolerance[i] == 0.0:
            row[:] = jacobian[i]
            size = append_normal(row, rows, size)
    for i in range(count):
        tolerance = bounds.tolerance[i]
        if not bounds.held[i] or tolerance == 0.0 or (cone and bounds.together[i]):
            continue
        if abs(residual[i]) < tolerance - touching:
            continue
        for d in range(dof):
            row[d] = jacobian[i, d] if residual[i] > 0.0 else -jacobian[i, d]
        size = _append_across(row, gradient, rows, size)
    angle = np.sqrt(square)
    if cone and angle >= common - touching and angle != 0.0:
        row[:] = 0.0
        for i in range(count):
            if bounds.together[i]:
                for d in range(dof):
                    row[d] += residual[i] / angle * jacobian[i, d]
        size = _append_across(row, gradient, rows, size)
    return size


@njit(**COMPILE)
def tangential_gradient(manifold, limits, times, joints, gradients):
    """For every inner point of curves into gradients (B, S, D), zero at both ends: minus the
    gradient of the energy E = ½ Σ_i ‖q_{i+1} − q_i‖² / (t_{i+1} − t_i) with respect to q_i, on the
    tangent space of the constraint there.

    joints (B, S, D) [rad] on the constraint at times (S,).  limits: Bounds.  Rows held exactly are
    always projected out; tolerances and joint limits only where the point touches the bound and
    would be moved across it.
    """
    dof = joints.shape[2]
    last = joints.shape[1] - 1
    bounds, touching = manifold.constraint.rows, limits.touching
    looked = new_look(manifold.constraint, dof)
    rows, row = np.empty((dof, dof)), np.empty(dof)
    any_held = bounds.held.any()
    for b in range(joints.shape[0]):
        for d in range(dof):
            gradients[b, 0, d] = 0.0
            gradients[b, last, d] = 0.0
        for s in range(1, last):
            q = joints[b, s]
            gradient = gradients[b, s]
            for d in range(dof):
                ahead = (joints[b, s + 1, d] - q[d]) / (times[s + 1] - times[s])
                gradient[d] = ahead - (q[d] - joints[b, s - 1, d]) / (times[s] - times[s - 1])
            size, n = 0, (s - 1) % LANES
            if any_held:
                if n == 0:
                    linearise(manifold, joints[b, s : min(s + LANES, last)], looked)
                residual, jacobian = looked.residuals[n], looked.jacobians[n]
                size = _constraint_normals(
                    bounds, touching, residual, jacobian, gradient, row, rows
                )
            for d in range(dof):
                if (q[d] >= limits.upper[d] - touching and gradient[d] > 0.0) or (
                    q[d] <= limits.lower[d] + touching and gradient[d] < 0.0
                ):
                    for k in range(dof):
                        row[k] = 1.0 if k == d else 0.0
                    size = append_normal(row, rows, size)
            for j in range(size):
                value = 0.0
                for d in range(dof):
                    value += rows[j, d] * gradient[d]
                for d in range(dof):
                    gradient[d] -= value * rows[j, d]
