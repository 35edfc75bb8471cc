"""Whole paths drawn by a diffusion model: noise is turned into a path step by step [Ho et al. 2020;
Janner et al. 2022], by a network that knows the ends and what the constraint does between them.

A path is its deviation from the straight joint line as a sine series,
    q(t) = (1 − t) start + t goal + Σₖ aₖ sin(kπt),
whose coefficients a, over their standard deviations, are what is drawn: x.  With the noise ε and
the time s from 1 to 0, xₛ = cos(πs/2) x + sin(πs/2) ε; the network estimates
    v = cos(πs/2) ε − sin(πs/2) x
[Salimans and Ho 2022], and DDIM [Song et al. 2021] follows it without further noise.

Nothing here imports the training library: path_diffusion_training.py does.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from constraint_geodesics.bundle import read_files, write_files
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.projection import Retraction, retract
from constraint_geodesics.formats import PATH_DIFFUSION
from constraint_geodesics.learning.inference import Arrays

Coefficients = Float[np.ndarray, "*batch k D"]
Curves = Float[np.ndarray, "*batch n D"]
Correction = Callable[[Curves], Curves]
"""Moves curves (B, n, D) to where they should be, their ends left alone."""

CARD, WEIGHTS = "path_diffusion.json", "path_diffusion.safetensors"
SHOWN = 7
"""Inner points of the retracted straight line that the network sees."""
FURTHEST = 3.0
"""By how much such a point differs from the straight line at most, as it is seen [rad]."""
FREQUENCIES = 8
"""Of the sines and cosines by which the network sees the time."""
_LINE = Retraction(accuracy=1e-3, iterations=12)


@cache
def sines(points: int, modes: int) -> Float[np.ndarray, "n k"]:
    """sin(kπt), k = 1 … modes, at so many even times from 0 to 1, both ends exactly 0."""
    t = np.linspace(0.0, 1.0, points)[:, None]
    waves = np.sin(np.pi * t * np.arange(1, modes + 1))
    waves[[0, -1]] = 0.0
    return waves


def straight(
    start: Float[np.ndarray, "*batch D"], goal: Float[np.ndarray, "*batch D"], points: int
) -> Curves:
    """Straight joint lines [rad]."""
    t = np.linspace(0.0, 1.0, points)[:, None]
    return (1.0 - t) * start[..., None, :] + t * goal[..., None, :]


def coefficients(curves: Curves, modes: int) -> Coefficients:
    """Of curves at even times, modes < n − 1: the sines are orthogonal on these, so that this is
    the least-squares fit [rad].
    """
    points = curves.shape[-2]
    deviation = curves - straight(curves[..., 0, :], curves[..., -1, :], points)
    return 2.0 / (points - 1) * (sines(points, modes).T @ deviation)


def conditions(
    manifold: ConstraintManifold, starts: Float[np.ndarray, "B D"], goals: Float[np.ndarray, "B D"]
) -> Float[np.ndarray, "B c"]:
    """What the network sees of B queries of one constraint: ends [π rad], their difference, sines
    and cosines; the tool's poses there; the constraint's context; and where SHOWN inner points of
    the straight line go when they are retracted [rad].  The latter tell what is held at which pose.
    """
    line = straight(starts, goals, SHOWN + 2)[:, 1:-1]
    bent = np.clip(retract(manifold, line, _LINE).joints - line, -FURTHEST, FURTHEST)
    poses = [manifold.robot.forward(ends) for ends in (starts, goals)]
    columns = [
        *(starts / np.pi, goals / np.pi, (goals - starts) / np.pi),
        *(wave(ends) for ends in (starts, goals) for wave in (np.sin, np.cos)),
        *(np.concatenate([2.0 * p, r.reshape(len(p), 9)], axis=1) for p, r in poses),
        np.broadcast_to(manifold.constraint.context, (len(starts), 12)),
        bent.reshape(len(starts), -1),
    ]
    return np.concatenate(columns, axis=1)


def seen_times(s: Float[np.ndarray, "*batch 1"]) -> Float[np.ndarray, "*batch f"]:
    """Sines and cosines of the diffusion's time."""
    angle = np.pi * s * np.arange(1, FREQUENCIES + 1)
    return np.concatenate([np.sin(angle), np.cos(angle)], axis=-1)


@dataclass(frozen=True)
class PathDiffusion:
    """A trained model, from the arrays of its network and the scales of what it sees and draws.

    In the network's own single precision inside; joints are rad outside.
    """

    arrays: Arrays

    @classmethod
    def load(cls, folder: Path) -> "PathDiffusion":
        """Read what `save` wrote.  Raises BundleError if a file is missing or altered."""
        _, arrays = read_files(folder / CARD, PATH_DIFFUSION, [WEIGHTS])
        return cls(arrays[WEIGHTS])

    def save(self, folder: Path) -> None:
        """Write the arrays (safetensors) and a card (JSON: sizes and their SHA-256)."""
        about = {"dof": self.dof, "modes": self.modes}
        write_files(folder / CARD, PATH_DIFFUSION, about, {WEIGHTS: self.arrays})

    @property
    def dof(self) -> int:
        """Number of joints."""
        return int(self.arrays["scale"].shape[1])

    @property
    def modes(self) -> int:
        """Number of sines for each joint."""
        return int(self.arrays["scale"].shape[0])

    def noise(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "count k D"]:
        """What so many paths begin as; the first is 0, from which the path in the middle of all
        those that the model knows is drawn.
        """
        drawn = rng.normal(size=(count, self.modes, self.dof))
        drawn[0] = 0.0
        return drawn

    def curves(
        self,
        seen: Float[np.ndarray, "c"],
        line: Float[np.ndarray, "n D"],
        noise: Float[np.ndarray, "B k D"],
        corrections: list[Correction | None],
    ) -> Float[np.ndarray, "B n D"]:
        """Curves that DDIM draws between the ends of a straight line, at its even times [rad].

        seen: `conditions` of the query.  corrections: one for each step of DDIM; where there is
        one, the path that the network expects is corrected before the step is taken.
        """
        x, steps = noise.reshape(len(noise), -1).astype(np.float32), len(corrections)
        known = self._seen(seen, len(noise))
        for k, correction in enumerate(corrections):
            cos, sin = _mix(1.0 - k / steps)
            v = self.estimate(x, np.full((len(x), 1), 1.0 - k / steps), known)
            expected, noise_left = cos * x - sin * v, sin * x + cos * v
            if correction is not None:
                expected = self._coded(correction(self._drawn(expected, line)))
            cos, sin = _mix(1.0 - (k + 1) / steps)
            x = (cos * expected + sin * noise_left).astype(np.float32)
        return self._drawn(x, line)

    def estimate(
        self,
        x: Float[np.ndarray, "B x"],
        s: Float[np.ndarray, "B 1"],
        known: Float[np.ndarray, "B c"],
    ) -> Float[np.ndarray, "B x"]:
        """The network's v, of x at the times s."""
        h = self._affine("first", np.concatenate([x, seen_times(s), known], axis=1, dtype="f4"))
        block = 0
        while f"blocks.{block}.inner.weight" in self.arrays:
            inner = self._affine(f"blocks.{block}.inner", _silu(h))
            h = h + self._affine(f"blocks.{block}.outer", _silu(inner))
            block += 1
        return self._affine("last", _silu(h))

    def _affine(self, layer: str, x: np.ndarray) -> np.ndarray:
        found: np.ndarray = x @ self.arrays[f"{layer}.weight"].T + self.arrays[f"{layer}.bias"]
        return found

    def _seen(self, seen: np.ndarray, count: int) -> np.ndarray:
        scaled = (seen - self.arrays["seen_mean"]) / self.arrays["seen_scale"]
        return np.broadcast_to(scaled.astype(np.float32), (count, len(seen)))

    def _drawn(self, x: np.ndarray, line: np.ndarray) -> np.ndarray:
        shape = (len(x), self.modes, self.dof)
        found: np.ndarray = line + sines(len(line), self.modes) @ (
            x.reshape(shape).astype(np.float64) * self.arrays["scale"]
        )
        return found

    def _coded(self, curves: np.ndarray) -> np.ndarray:
        coded = coefficients(curves, self.modes) / self.arrays["scale"]
        return coded.reshape(len(curves), -1).astype(np.float32)


def _mix(s: float) -> tuple[float, float]:
    """Shares of the path and the noise at the time s."""
    return float(np.cos(0.5 * np.pi * s)), float(np.sin(0.5 * np.pi * s))


def _silu(x: np.ndarray) -> np.ndarray:
    found: np.ndarray = x / (1.0 + np.exp(-np.clip(x, -80.0, 80.0)))
    return found
