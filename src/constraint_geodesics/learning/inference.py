"""A learned manifold as plain arrays: encoder, decoder and samples without the training library.

The planner's networks are small; a user who plans a path need not wait for torch to be imported.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from constraint_geodesics.array_files import read_weights

Arrays = Mapping[str, np.ndarray]
SPREAD = 0.3
"""Standard deviation of samples around a centre, in its bandwidths: so wide, samples are as often
free of collision as the training data; wider, they leave it.
"""


@dataclass(frozen=True)
class FrozenManifold:
    """Encoder and decoder mean of a trained `JointVae`, from the arrays of its state.  Implements
    Chart.

    In the network's own single precision inside; joints are rad outside.
    """

    arrays: Arrays

    @classmethod
    def load(cls, folder: Path) -> "FrozenManifold":
        """From the weights that `LearnedManifold.save` wrote."""
        return cls(read_weights(folder / WEIGHTS))

    @property
    def dim(self) -> int:
        """Latent dimension N."""
        return int(self.arrays["decoder.linear.weight"].shape[1])

    def encode(self, q: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "*batch N"]:
        """Posterior mean of joint configurations [rad]."""
        scaled = (np.asarray(q, np.float32) - self.arrays["centre"]) / self.arrays["scale"]
        return perceptron(self.arrays, "encoder", scaled)[..., : self.dim].astype(np.float64)

    def decode(self, z: Float[np.ndarray, "*batch N"]) -> Float[np.ndarray, "*batch D"]:
        """Decoder mean μ(z) [rad]."""
        decoded = perceptron(self.arrays, "decoder", np.asarray(z, np.float32))
        return (self.arrays["centre"] + self.arrays["scale"] * decoded).astype(np.float64)

    def draw(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "count D"]:
        """Configurations spread like the training data [rad]."""
        return self.decode(self.sample(count, rng))

    def sample(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "count N"]:
        """Latent points spread like the training data, about the precision network's centres."""
        centres, width = self.arrays["precision.centres"], self.arrays["precision.bandwidth"]
        chosen = rng.integers(len(centres), size=count)
        return centres[chosen] + SPREAD * width[chosen, None] * rng.normal(size=(count, self.dim))


def perceptron(
    arrays: Arrays, name: str, x: Float[np.ndarray, "*batch I"]
) -> Float[np.ndarray, "*batch O"]:
    """Output of the `vae.Perceptron` called `name`: SiLU layers plus a linear path."""
    y, layer = x, 0
    while f"{name}.nonlinear.{layer + 2}.weight" in arrays:
        y = (
            y @ arrays[f"{name}.nonlinear.{layer}.weight"].T
            + arrays[f"{name}.nonlinear.{layer}.bias"]
        )
        y = y / (1.0 + np.exp(-np.clip(y, -80.0, 80.0)))
        layer += 2
    last = (
        y @ arrays[f"{name}.nonlinear.{layer}.weight"].T + arrays[f"{name}.nonlinear.{layer}.bias"]
    )
    return last + x @ arrays[f"{name}.linear.weight"].T


WEIGHTS, CARD = "weights.safetensors", "manifold.json"


class ManifoldFileError(ValueError):
    """A saved manifold that is missing, incomplete or altered; the message names the file."""
