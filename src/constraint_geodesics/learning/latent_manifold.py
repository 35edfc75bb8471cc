"""What the learned manifolds beside the VAE's have in common: latent coordinates of joints, the
pulled-back metric of eq. 5, and their files.
"""

import hashlib
import json
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import save
from torch import Tensor, nn

from constraint_geodesics.array_files import read_weights
from constraint_geodesics.geometry.manifold import pullback_metric
from constraint_geodesics.learning.inference import CARD, WEIGHTS, ManifoldFileError
from constraint_geodesics.learning.learned_manifold import PIECE
from constraint_geodesics.learning.vae import network_of
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.text_files import read_json, write_bytes, write_text


class JointDecoder(nn.Module, ABC):
    """A map from N latent coordinates to D joints [rad], and back.

    Joints are scaled to [−1, 1] by the robot's limits inside: (q − centre) / scale.
    """

    centre: Tensor
    scale: Tensor

    def __init__(self, dof: int, latent_dim: int) -> None:
        super().__init__()
        self.dof, self.latent_dim = dof, latent_dim
        self.register_buffer("centre", torch.zeros(dof))
        self.register_buffer("scale", torch.ones(dof))

    @property
    @abstractmethod
    def sizes(self) -> dict[str, Any]:
        """What the constructor was called with."""

    @property
    @abstractmethod
    def ambient_dim(self) -> int:
        """Entries A of the embedding."""

    @abstractmethod
    def embed(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch A"]:
        """The embedding f(z) [rad], whose first D entries are the joints."""

    @abstractmethod
    def encode(self, q: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch N"]:
        """Latent coordinates of configurations [rad]."""

    @abstractmethod
    def sample(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "count N"]:
        """Latent points whose joints are spread like the data that it was trained on."""

    def mean(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch D"]:
        """The joints of latent points [rad]."""
        return self.embed(z)[..., : self.dof]

    def scale_to(self, robot: SerialRobot) -> None:
        """Take centre and scale from the robot's limits."""
        self.centre.copy_(torch.as_tensor(0.5 * (robot.lower + robot.upper)))
        self.scale.copy_(torch.as_tensor(0.5 * (robot.upper - robot.lower)))


@dataclass(frozen=True)
class LatentManifold:
    """The latent space of a decoder as a Riemannian manifold, in the decoder's own precision.
    Implements EmbeddedManifold and Chart.
    """

    decoder: JointDecoder

    @property
    def dim(self) -> int:
        """Latent dimension N."""
        return self.decoder.latent_dim

    @property
    def ambient_dim(self) -> int:
        """Entries A of the embedding."""
        return self.decoder.ambient_dim

    def embed(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch A"]:
        """f(z) [rad]."""
        return self.decoder.embed(z.to(self.decoder.centre.dtype))

    def metric(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch N N"]:
        """M(z) = J_fᵀ J_f, eq. 5."""
        return pullback_metric(self.embed, z.to(self.decoder.centre.dtype))

    def encode(self, q: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "*batch N"]:
        """Latent coordinates of configurations [rad]."""
        with torch.no_grad():
            return self.decoder.encode(self.tensor(q)).numpy().astype(np.float64)

    def decode(self, z: Float[np.ndarray, "*batch N"]) -> Float[np.ndarray, "*batch D"]:
        """Configurations [rad] at latent coordinates."""
        return self.embed_points(z)[..., : self.decoder.dof]

    def embed_points(self, z: Float[np.ndarray, "*batch N"]) -> Float[np.ndarray, "*batch A"]:
        """f(z) of many points [rad], in pieces that stay in the processor's cache."""
        with torch.no_grad():
            pieces = self.tensor(z).reshape(-1, self.dim).split(PIECE)
            values = torch.cat([self.decoder.embed(piece) for piece in pieces])
        return values.numpy().astype(np.float64).reshape(*z.shape[:-1], self.ambient_dim)

    def embed_joints(self, q: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "*batch A"]:
        """The embedding of encoded configurations: where a joint path lies on the manifold."""
        return self.embed_points(self.encode(q))

    def sample(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "count N"]:
        """Latent points whose joints are spread like the data that it was trained on."""
        return self.decoder.sample(count, rng)

    def tensor(self, values: np.ndarray) -> Tensor:
        """An array in the decoder's own precision."""
        return torch.tensor(values, dtype=self.decoder.centre.dtype)

    def save(self, folder: Path) -> None:
        """Write weights (safetensors) and a card (JSON: kind, sizes and the weights' SHA-256)."""
        state = {name: values.contiguous() for name, values in self.decoder.state_dict().items()}
        weights = save(state)
        card = {
            "kind": type(self.decoder).__name__,
            "sizes": self.decoder.sizes,
            "sha256": hashlib.sha256(weights).hexdigest(),
        }
        write_bytes(folder / WEIGHTS, weights)
        write_text(folder / CARD, json.dumps(card, indent=2, sort_keys=True) + "\n")

    @classmethod
    def load(cls, folder: Path, kind: type[JointDecoder]) -> "LatentManifold":
        """Read what `save` wrote of a manifold of this kind.

        Raises ManifoldFileError if a file is missing or altered, or it is of another kind.
        """
        try:
            card = read_json(folder / CARD)
            weights = read_weights(folder / WEIGHTS, card["sha256"])
            if card["kind"] != kind.__name__:
                raise ManifoldFileError(
                    f"{folder}: kind = {card['kind']!r}: must be {kind.__name__!r}"
                )
            decoder = network_of(lambda: kind(**card["sizes"]).double(), weights)
        except ManifoldFileError:
            raise
        except (OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
            raise ManifoldFileError(f"{folder}: not a saved manifold: {error}") from None
        return cls(decoder.eval().requires_grad_(False))


def frozen(decoder: JointDecoder) -> LatentManifold:
    """The manifold of a decoder that is trained no further, in double precision."""
    return LatentManifold(decoder.double().eval().requires_grad_(False))
