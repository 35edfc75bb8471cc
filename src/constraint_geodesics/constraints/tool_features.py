"""The features of a tool's pose that relations are made of: y = (p, R e_x, R e_y, R e_z) (12,)."""

import numpy as np
from jaxtyping import Float
from numba import njit

from constraint_geodesics.compiled import LEAF

FEATURES = 12
"""Numbers of y: position [m], then the columns of the rotation."""


def features(
    positions: Float[np.ndarray, "n 3"], rotations: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, "n 12"]:
    """The features y of tool poses."""
    columns = rotations.transpose(0, 2, 1).reshape(len(rotations), 9)
    return np.concatenate([positions, columns], axis=1)


@njit(**LEAF)
def into_joints(gradient, y, geometric, out):
    """∂r/∂q (D,) = (∂r/∂p) J_v + (Σ_k u_k × ∂r/∂u_k) J_ω, with the geometric Jacobian (6, D)."""
    t0, t1, t2 = 0.0, 0.0, 0.0
    for k in range(3):
        at = 3 + 3 * k
        t0 += y[at + 1] * gradient[at + 2] - y[at + 2] * gradient[at + 1]
        t1 += y[at + 2] * gradient[at] - y[at] * gradient[at + 2]
        t2 += y[at] * gradient[at + 1] - y[at + 1] * gradient[at]
    for d in range(out.shape[0]):
        value = t0 * geometric[3, d] + t1 * geometric[4, d] + t2 * geometric[5, d]
        for i in range(3):
            value += gradient[i] * geometric[i, d]
        out[d] = value
