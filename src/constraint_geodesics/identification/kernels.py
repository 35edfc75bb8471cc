"""The normal equations of splines, compiled."""

import numpy as np
from numba import njit

from constraint_geodesics.compiled import COMPILE
from constraint_geodesics.constraints.spline import HEAD, ORDER, basis_at
from constraint_geodesics.constraints.tool_features import jacobian_of_origin
from constraint_geodesics.robot.kernels import new_posture, pose_of


@njit(**COMPILE)
def joint_origins(chain, q, joint, places, jacobians):
    """Places (n, 3) [m] of a joint's origin at q (n, D), and their Jacobians (n, 6, D)."""
    posture = new_posture(q.shape[1])
    for n in range(q.shape[0]):
        pose_of(chain, q[n], posture)
        places[n] = posture.origins[joint]
        jacobian_of_origin(chain.prismatic, posture, joint, jacobians[n])


@njit(**COMPILE)
def add_up(numbers, places, omega, target, extra, matrix, right):
    """Add the normal equations of whitened rows: see `freeform._System`; unknowns are the splines'
    coefficients, one spline after another, then the axis's two.
    """
    count, rows, splines, _ = omega.shape
    head, more = numbers[:HEAD], extra.shape[2]
    n1, n2, n3 = int(head[18]) + 1, int(head[19]) + 1, int(head[20]) + 1
    c2, c3 = int(head[22]), int(head[23])
    size = int(head[21]) * c2 * c3
    own = n1 * n2 * n3
    basis, cells = np.empty((3, 3, ORDER)), np.empty(3, np.int64)
    at, row = np.empty(splines * own + more, np.int64), np.empty(splines * own + more)
    for n in range(count):
        for k in range(3):
            x = 0.0
            for i in range(3):
                x += head[3 * k + i] * (places[n, i] - head[9 + i])
            at_cells, scale = (x - head[12 + k]) * head[15 + k], head[15 + k]
            cells[k] = basis_at(int(head[18 + k]), at_cells, int(head[21 + k]), scale, basis[k])
        for r in range(rows):
            m = 0
            for s in range(splines):
                o0, o1, o2, o3 = omega[n, r, s]
                for i in range(n1):
                    for j in range(n2):
                        a, a1 = basis[0, 0, i] * basis[1, 0, j], basis[0, 1, i] * basis[1, 0, j]
                        a2 = basis[0, 0, i] * basis[1, 1, j]
                        for k in range(n3):
                            b = basis[2, 0, k]
                            row[m] = (o0 * a + o1 * a1 + o2 * a2) * b + o3 * a * basis[2, 1, k]
                            place = ((cells[0] + i) * c2 + cells[1] + j) * c3 + cells[2] + k
                            at[m] = s * size + place
                            m += 1
            for e in range(more):
                row[m], at[m] = extra[n, r, e], splines * size + e
                m += 1
            for i in range(m):
                right[at[i]] += row[i] * target[n, r]
                for j in range(m):
                    matrix[at[i], at[j]] += row[i] * row[j]
