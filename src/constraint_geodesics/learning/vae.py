"""The variational autoencoder of joint configurations: modules and pure losses, no training loop.

Phase one trains the encoder and the decoder mean (eq. 4), phase two the variance network alone.
Joints are scaled to [−1, 1] by the robot's limits inside.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

Network = TypeVar("Network", bound=nn.Module)


class Perceptron(nn.Module):
    """Smooth multilayer perceptron plus a linear path: a linear map needs no hidden unit."""

    def __init__(self, inputs: int, hidden: Sequence[int], outputs: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        width = inputs
        for size in hidden:
            layers += [nn.Linear(width, size), nn.SiLU()]
            width = size
        self.nonlinear = nn.Sequential(*layers, nn.Linear(width, outputs))
        self.linear = nn.Linear(inputs, outputs, bias=False)

    def forward(self, x: Float[Tensor, "*batch I"]) -> Float[Tensor, "*batch O"]:
        """Sum of the two paths."""
        return self.linear(x) + self.nonlinear(x)


class RbfPrecision(nn.Module):
    """Precision network β(z) = Σ_k w_k exp(−½‖z − c_k‖²/h²) + ζ(z), one precision a joint; σ =
    β^(−½).

    A constant floor ζ would make σ flat, and the metric zero, far away from the data.  The floor
    falls instead, ζ(z) = σ_max⁻² (1 + ‖z‖²/s²)⁻², so that σ grows like ‖z‖² for ever, without the
    explosion of a tiny floor.
    """

    centres: Tensor
    bandwidth: Tensor
    floor: Tensor
    spread: Tensor

    def __init__(self, latent_dim: int, centres: int, outputs: int) -> None:
        super().__init__()
        self.register_buffer("centres", torch.zeros(centres, latent_dim))
        self.register_buffer("bandwidth", torch.ones(centres))
        self.register_buffer("floor", torch.ones(()))
        self.register_buffer("spread", torch.ones(()))
        self.log_weights = nn.Parameter(torch.zeros(centres, outputs))

    def place(
        self, centres: Tensor, bandwidth: Tensor, floor: float, spread: float, precision: float
    ) -> None:
        """Set centres (K, N), bandwidths (K,), the floor's height and spread, first weights."""
        self.centres.copy_(centres)
        self.bandwidth.copy_(bandwidth)
        self.floor.fill_(floor)
        self.spread.fill_(spread)
        nn.init.constant_(self.log_weights, math.log(precision))

    def forward(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch D"]:
        """Precision of each joint [1/rad²]."""
        square = z.square().sum(-1, keepdim=True)
        # −½‖z − c‖²/h² as one matrix product of (z, ‖z‖², 1): every further pass over (B, K) costs
        # as much again
        narrow = -0.5 / self.bandwidth.square()
        weights = torch.cat(
            [
                -2.0 * narrow * self.centres.T,
                narrow[None],
                (narrow * self.centres.square().sum(-1))[None],
            ]
        )
        exponent = torch.cat([z, square, torch.ones_like(square)], dim=-1) @ weights
        # cut where it no longer counts: denormal numbers would make the product ten times slower
        near = torch.exp(exponent.clamp(-40.0, 0.0))
        floor = self.floor / (1.0 + square / self.spread.square()).square()
        return near @ self.log_weights.exp() + floor


class JointVae(nn.Module):
    """Encoder, decoder mean μ(z) and standard deviation σ(z), in radians on the outside."""

    centre: Tensor
    scale: Tensor

    def __init__(
        self, dof: int, latent_dim: int, hidden: Sequence[int], variance_centres: int
    ) -> None:
        super().__init__()
        self.dof, self.latent_dim = dof, latent_dim
        self.register_buffer("centre", torch.zeros(dof))
        self.register_buffer("scale", torch.ones(dof))
        self.encoder = Perceptron(dof, hidden, 2 * latent_dim)
        self.decoder = Perceptron(latent_dim, list(reversed(hidden)), dof)
        self.precision = RbfPrecision(latent_dim, variance_centres, dof)

    def encode(
        self, q: Float[Tensor, "*batch D"]
    ) -> tuple[Float[Tensor, "*batch N"], Float[Tensor, "*batch N"]]:
        """Mean and log variance of the posterior q_ζ(z | ω)."""
        mean, log_variance = self.encoder((q - self.centre) / self.scale).chunk(2, dim=-1)
        return mean, log_variance.clamp(-14.0, 2.0)

    def mean(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch D"]:
        """Decoder mean μ(z) [rad]."""
        return self.centre + self.scale * self.decoder(z)

    def deviation(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch D"]:
        """Decoder standard deviation σ(z) [rad]."""
        return self.precision(z).rsqrt()


def evidence_loss(
    vae: JointVae, q: Float[Tensor, "b D"], beta: float, noise: Float[Tensor, "b N"]
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Negative ELBO of eq. 4 in scaled joints, reconstruction + β KL; and the reconstruction."""
    mean, log_variance = vae.encode(q)
    z = mean + noise * torch.exp(0.5 * log_variance)
    error = (vae.mean(z) - q) / vae.scale
    reconstruction = error.square().sum(-1).mean()
    divergence = 0.5 * (mean.square() + log_variance.exp() - 1.0 - log_variance).sum(-1).mean()
    return reconstruction + beta * divergence, reconstruction


def variance_loss(vae: JointVae, q: Float[Tensor, "b D"]) -> Float[Tensor, ""]:
    """Negative log likelihood of the joints under the decoder's mean (frozen) and variance."""
    with torch.no_grad():
        z, _ = vae.encode(q)
        error = (vae.mean(z) - q).square()
    precision = vae.precision(z)
    return 0.5 * (error * precision - precision.log()).sum(-1).mean()


def network_of(make: Callable[[], Network], arrays: Mapping[str, np.ndarray]) -> Network:
    """The network that `make` makes, with the weights of a file.  Raises ValueError where these are
    of other names or sizes, before memory is taken for the network: a file may name any size.
    """
    with torch.device("meta"):
        wanted = {name: tuple(own.shape) for name, own in make().state_dict().items()}
    for name in sorted(wanted.keys() | arrays.keys()):
        shape = arrays[name].shape if name in arrays else None
        if shape != wanted.get(name):
            raise ValueError(f"weights {name!r} are {shape}: must be {wanted.get(name)}")
    network = make()
    network.load_state_dict({n: torch.from_numpy(np.array(v)) for n, v in arrays.items()})
    return network
