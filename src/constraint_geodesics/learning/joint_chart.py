"""Joint space in place of a learned manifold: what is left of a search when nothing is learned."""

import numpy as np
import torch
from jaxtyping import Float

from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.vae import JointVae

PRECISION = 1e12
"""Precision of every joint [1/rad²], the same everywhere: the deviation adds nothing to a length.
"""


class JointChart(LearnedManifold):
    """The chart z = (q − c) / s of joint space: a learned manifold whose networks are the identity,
    in float64.

    dim N = D.  Straight chart lines are straight joint lines, and the metric is s² I.
    """

    @classmethod
    def of(cls, joints: Float[np.ndarray, "n D"]) -> "JointChart":
        """The chart in which the given configurations [rad] have mean 0 and, over the joints, mean
        variance 1.

        That is the size of the latent coordinates of a trained manifold.  Raises ValueError unless
        they differ.
        """
        joints = np.asarray(joints, np.float64)
        if joints.ndim != 2 or not (np.isfinite(joints).all() and np.ptp(joints, axis=0).any()):
            raise ValueError(
                f"joints has shape {joints.shape}: must be (n, D), finite, and not one "
                f"configuration"
            )
        dof = joints.shape[1]
        vae = JointVae(dof, dof, (), 0).double().requires_grad_(False)
        for weight in vae.parameters():
            weight.zero_()
        vae.centre.copy_(torch.from_numpy(joints.mean(axis=0)))
        vae.scale.fill_(float(np.sqrt(joints.var(axis=0).mean())))
        vae.encoder.linear.weight[:dof].copy_(torch.eye(dof))
        vae.decoder.linear.weight.copy_(torch.eye(dof))
        vae.precision.floor.fill_(PRECISION)
        vae.precision.spread.fill_(torch.inf)  # the floor never falls
        return cls(vae.eval())
