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


@njit(**LEAF)
def jacobian_of_origin(prismatic, posture, joint, out):
    """The geometric Jacobian (6, D) of a joint's origin, which only the joints before it move; its
    angular rows are zero.
    """
    here = posture.origins[joint]
    for d in range(out.shape[1]):
        for i in range(6):
            out[i, d] = 0.0
        if d >= joint:
            continue
        a = posture.axes[d]
        x = here[0] - posture.origins[d, 0]
        y = here[1] - posture.origins[d, 1]
        z = here[2] - posture.origins[d, 2]
        if prismatic[d]:
            out[0, d], out[1, d], out[2, d] = a[0], a[1], a[2]
        else:
            out[0, d] = a[1] * z - a[2] * y
            out[1, d] = a[2] * x - a[0] * z
            out[2, d] = a[0] * y - a[1] * x
