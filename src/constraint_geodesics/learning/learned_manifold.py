"""A trained manifold: embedding f(z) = (μ(z), σ(z)), pullback metric (eq. 5), and its files."""

import copy
import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import save
from torch import Tensor

from constraint_geodesics.array_files import read_weights
from constraint_geodesics.geometry.manifold import pullback_metric
from constraint_geodesics.learning.inference import CARD, WEIGHTS, ManifoldFileError
from constraint_geodesics.learning.vae import JointVae, network_of
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.text_files import read_json, write_bytes, write_text

PIECE = 1024
"""Points embedded at once: the temporaries of many more leave the processor's cache."""


@dataclass(frozen=True)
class LearnedManifold:
    """The latent space of a trained VAE as a Riemannian manifold.  Implements the Manifold
    protocol.

    dim N latent dimensions; ambient_dim 2D: every joint's mean and standard deviation [rad].
    """

    vae: JointVae

    @property
    def dim(self) -> int:
        """Latent dimension N."""
        return self.vae.latent_dim

    @property
    def ambient_dim(self) -> int:
        """2D: mean and standard deviation of each joint."""
        return 2 * self.vae.dof

    def embed(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch A"]:
        """f(z) = (μ(z), σ(z)) [rad], in the network's own precision."""
        z = z.to(self.vae.centre.dtype)
        return torch.cat([self.vae.mean(z), self.vae.deviation(z)], dim=-1)

    def metric(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch N N"]:
        """M(z) = JμᵀJμ + JσᵀJσ, eq. 5."""
        return pullback_metric(self.embed, z)

    def encode(self, q: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "*batch N"]:
        """Posterior mean of joint configurations [rad]."""
        with torch.no_grad():
            return self.vae.encode(self.tensor(q))[0].numpy().astype(np.float64)

    def decode(self, z: Float[np.ndarray, "*batch N"]) -> Float[np.ndarray, "*batch D"]:
        """Decoder mean μ(z) [rad]."""
        with torch.no_grad():
            return self.vae.mean(self.tensor(z)).numpy().astype(np.float64)

    def embed_points(self, z: Float[np.ndarray, "*batch N"]) -> Float[np.ndarray, "*batch A"]:
        """f(z) of many points [rad], in pieces that stay in the processor's cache."""
        with torch.no_grad():
            pieces = self.tensor(z).reshape(-1, self.dim).split(PIECE)
            return (
                torch.cat([self.embed(piece) for piece in pieces])
                .numpy()
                .reshape(*z.shape[:-1], -1)
            )

    def decode_all(
        self, z: Float[np.ndarray, "*batch N"]
    ) -> tuple[Float[np.ndarray, "*batch D"], Float[np.ndarray, "*batch A"]]:
        """Decoder mean and, where it is not the same everywhere, deviation [rad] of many points."""
        embedded = self.embed_points(z).astype(np.float64)
        return embedded[..., : self.vae.dof], embedded[..., self.vae.dof :]

    def embed_joints(self, q: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "*batch A"]:
        """The embedding of encoded configurations: where a joint path lies on the manifold."""
        with torch.no_grad():
            return self.embed(self.vae.encode(self.tensor(q))[0]).numpy().astype(np.float64)

    def double(self) -> "LearnedManifold":
        """The same manifold with its network in double precision, for references."""
        return LearnedManifold(copy.deepcopy(self.vae).double())

    def tensor(self, values: np.ndarray) -> Tensor:
        """An array in the network's own precision."""
        return torch.tensor(values, dtype=self.vae.centre.dtype)

    def save(self, folder: Path) -> None:
        """Write weights (safetensors) and a card (JSON: sizes and the weights' SHA-256)."""
        weights = save(self.vae.state_dict())
        card = {
            "dof": self.vae.dof,
            "latent_dim": self.dim,
            "hidden": [
                layer.out_features
                for layer in self.vae.encoder.nonlinear
                if hasattr(layer, "out_features")
            ][:-1],
            "variance_centres": len(self.vae.precision.centres),
            "sha256": hashlib.sha256(weights).hexdigest(),
        }
        write_bytes(folder / WEIGHTS, weights)
        write_text(folder / CARD, json.dumps(card, indent=2, sort_keys=True) + "\n")

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> "LearnedManifold":
        """From the arrays of a network's state, whose shapes say how large it is.  Raises
        KeyError, TypeError or ValueError where these do not fit each other.
        """
        layers = sorted(
            int(name.split(".")[2])
            for name in arrays
            if re.fullmatch(r"encoder\.nonlinear\.\d+\.bias", name)
        )
        hidden = [len(arrays[f"encoder.nonlinear.{layer}.bias"]) for layer in layers[:-1]]
        centres, latent_dim = arrays["precision.centres"].shape
        sizes = len(arrays["centre"]), latent_dim, hidden, centres
        vae = network_of(lambda: JointVae(*sizes), arrays)
        return cls(vae.eval().requires_grad_(False))

    @classmethod
    def load(cls, folder: Path) -> "LearnedManifold":
        """Read what `save` wrote.  Raises ManifoldFileError if a file is missing or altered."""
        try:
            card = read_json(folder / CARD)
            return cls.from_arrays(read_weights(folder / WEIGHTS, card["sha256"]))
        except (OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
            raise ManifoldFileError(f"{folder}: not a saved manifold: {error}") from None


JOINT_SPACE = "joint_space"
"""Name of the chart that is not learned."""
SPREAD_OVER = 1000
"""Random configurations that its centre and scale are taken from."""
PRECISION = 1e12
"""Precision of every joint [1/rad²], the same everywhere: the deviation adds nothing to a length.
"""


class JointManifold(LearnedManifold):
    """The chart z = (q − c) / s of joint space: a learned manifold whose networks are the identity,
    in float64.

    dim N = D.  Straight chart lines are straight joint lines, and the metric is s² I.
    """

    @classmethod
    def of(cls, joints: Float[np.ndarray, "n D"]) -> "JointManifold":
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

    def decode(self, z: Float[np.ndarray, "*batch N"]) -> Float[np.ndarray, "*batch D"]:
        """Joints [rad], without a network."""
        joints: np.ndarray = z * self.vae.scale.numpy() + self.vae.centre.numpy()
        return joints

    def decode_all(
        self, z: Float[np.ndarray, "*batch N"]
    ) -> tuple[Float[np.ndarray, "*batch D"], Float[np.ndarray, "*batch A"]]:
        """Decoder mean [rad]; the deviation is the same everywhere."""
        return self.decode(z), np.empty((*z.shape[:-1], 0))


def chart_named(name: str, folder: Path, robot: SerialRobot) -> LearnedManifold:
    """The robot's joint space for JOINT_SPACE, else the learned manifold saved in `folder`."""
    return joint_space(robot) if name == JOINT_SPACE else LearnedManifold.load(folder)


def joint_space(robot: SerialRobot) -> JointManifold:
    """The chart of all configurations within the robot's limits."""
    return JointManifold.of(robot.sample(SPREAD_OVER, np.random.default_rng(0)))
