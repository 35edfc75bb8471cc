"""Retraction of joint configurations onto a constraint manifold by Gauss-Newton on the true
kinematics.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from constraint_geodesics.constraints import kernels
from constraint_geodesics.constraints.pose import ConstraintManifold


@dataclass(frozen=True)
class Retraction:
    """Settings of the retraction: wanted accuracy [rad or m], steps at most, longest step [rad]."""

    accuracy: float = 1e-9
    iterations: int = 50
    largest_step: float = 0.6


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
    share = np.ones(len(joints)) if band is None else np.asarray(band, float).reshape(-1)
    worst = np.empty(len(joints))
    kernels.retract_batch(
        manifold.robot.chain.arrays,
        manifold.held,
        share[:, None] * manifold.tolerance,
        *manifold.reference_arrays,
        joints,
        settings.accuracy,
        settings.iterations,
        settings.largest_step,
        worst,
    )
    batch = q.shape[:-1]
    return Retracted(
        joints.reshape(q.shape), worst.reshape(batch), (worst <= settings.accuracy).reshape(batch)
    )
