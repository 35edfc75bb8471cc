"""Curves in a chart that start and end exactly where they must (eqs. 9-11)."""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from constraint_geodesics.geometry.manifold import GeometryError


class CurveError(GeometryError):
    """A curve can't be built from the input; the message names it, its shape or value and what is allowed."""


@runtime_checkable
class CurveFamily(Protocol):
    """All curves γ_φ in N dimensions between two given ends, one for each vector of free numbers φ."""

    @property
    def dim(self) -> int:
        """Dimension N of the chart the curves live in."""
        ...

    @property
    def coefficients(self) -> int:
        """Number p of free numbers in φ; φ = 0 is the straight line in the chart."""
        ...

    def evaluate(
        self,
        phi: Float[Tensor, "*#batch p"],
        start: Float[Tensor, "*#batch N"],
        goal: Float[Tensor, "*#batch N"],
        t: Float[Tensor, "T"],
    ) -> tuple[Float[Tensor, "*batch T N"], Float[Tensor, "*batch T N"]]:
        """Points γ(t) and velocities γ̇(t) at times t in [0, 1]; γ(0) = start and γ(1) = goal to the bit."""
        ...


@dataclass(frozen=True)
class PinnedPolynomial:
    """Polynomials of degree K in N dimensions with both ends given, eqs. 9-11, in a well-conditioned basis:

    γ(t) = (1 − t) start + t goal + Σ_k φ_{n,k} b_k(t),  b_k(t) = t (1 − t) P*_k(t),  k = 0 … K − 2,

    with P*_k the Legendre polynomials shifted to [0, 1].  The space is that of eq. 11 with the goal pinned as well
    (`to_monomial` gives its coefficients), but no two b_k are nearly alike, as powers of t are.
    φ holds the K − 1 numbers of the first dimension, then those of the next: N (K − 1) in all, 4 for a planar cubic.

    dim: N, at least 1.  degree: K, at least 1 (the straight line).  Raises CurveError otherwise.
    """

    dim: int
    degree: int = 3

    def __post_init__(self) -> None:
        for name, value in (("dim", self.dim), ("degree", self.degree)):
            if value < 1:
                raise CurveError(f"{name} = {value}: must be at least 1")

    @property
    def coefficients(self) -> int:
        """Number of free numbers, p = N (K − 1)."""
        return self.dim * (self.degree - 1)

    def evaluate(
        self,
        phi: Float[Tensor, "*#batch p"],
        start: Float[Tensor, "*#batch N"],
        goal: Float[Tensor, "*#batch N"],
        t: Float[Tensor, "T"],
    ) -> tuple[Float[Tensor, "*batch T N"], Float[Tensor, "*batch T N"]]:
        """Points γ(t) and velocities γ̇(t).

        Batches of phi, start and goal broadcast.  Raises CurveError on a wrong shape.
        """
        self._check(phi, start, goal)
        if t.ndim != 1:
            raise CurveError(f"t has shape {tuple(t.shape)}: must be (T,)")
        free = self._by_dimension(phi)
        start, goal, time = start[..., None, :], goal[..., None, :], t[:, None]
        # Weighting both ends, not start + t (goal − start), is what makes the goal exact in floating point.
        points = (1 - time) * start + time * goal + (free @ self.basis(t).mT).mT
        velocities = (goal - start) + (free @ self.basis_derivative(t).mT).mT
        return points, velocities

    def basis(self, t: Float[Tensor, "*times"]) -> Float[Tensor, "*times {self.degree}-1"]:
        """Basis b_k(t) = t (1 − t) P*_k(t), zero at t = 0 and t = 1."""
        legendre, _ = _shifted_legendre(t, self.degree - 1)
        return (t * (1 - t))[..., None] * legendre

    def basis_derivative(self, t: Float[Tensor, "*times"]) -> Float[Tensor, "*times {self.degree}-1"]:
        """Derivatives ḃ_k(t) = (1 − 2t) P*_k(t) + t (1 − t) Ṗ*_k(t)."""
        legendre, derivative = _shifted_legendre(t, self.degree - 1)
        return (1 - 2 * t)[..., None] * legendre + (t * (1 - t))[..., None] * derivative

    def to_monomial(
        self, phi: Float[Tensor, "*#batch p"], start: Float[Tensor, "*#batch N"], goal: Float[Tensor, "*#batch N"]
    ) -> Float[Tensor, "*batch N {self.degree}+1"]:
        """Coefficients φ_{n,k} of t^k in eq. 9: φ_{n,0} = start_n and Σ_{k≥1} φ_{n,k} = goal_n − start_n."""
        self._check(phi, start, goal)
        powers = _basis_in_powers(self.degree).to(phi)
        bent = self._by_dimension(phi) @ powers
        start, line = start[..., None], (goal - start)[..., None]
        straight = torch.cat([start.expand_as(line), line, line.new_zeros(*line.shape[:-1], self.degree - 1)], dim=-1)
        return straight + bent

    def _by_dimension(self, phi: Tensor) -> Tensor:
        return phi.reshape(*phi.shape[:-1], self.dim, self.degree - 1)

    def _check(self, phi: Tensor, start: Tensor, goal: Tensor) -> None:
        for name, value, size in (
            ("phi", phi, self.coefficients),
            ("start", start, self.dim),
            ("goal", goal, self.dim),
        ):
            if value.ndim == 0 or value.shape[-1] != size:
                raise CurveError(
                    f"{name} has shape {tuple(value.shape)}: its last axis must have {size} entries "
                    f"(dim {self.dim}, degree {self.degree})"
                )


def _shifted_legendre(t: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """P*_k(t) = P_k(2t − 1) and derivatives to t for k < count, (*times, count) each, by Bonnet's recurrence."""
    x = 2 * t - 1
    values, slopes = [torch.ones_like(t), x], [torch.zeros_like(t), torch.ones_like(t)]
    for k in range(1, count - 1):
        values.append(((2 * k + 1) * x * values[k] - k * values[k - 1]) / (k + 1))
        slopes.append((2 * k + 1) * values[k] + slopes[k - 1])
    if count == 0:
        return t.new_zeros(*t.shape, 0), t.new_zeros(*t.shape, 0)
    return torch.stack(values[:count], dim=-1), 2 * torch.stack(slopes[:count], dim=-1)


def _basis_in_powers(degree: int) -> Tensor:
    """Coefficients of t^0 … t^K in b_k(t), (K − 1, K + 1), each rounded once from the exact integer."""
    rows = torch.zeros(degree - 1, degree + 1, dtype=torch.float64)
    for k in range(degree - 1):
        legendre = [(-1) ** (k + j) * math.comb(k, j) * math.comb(k + j, j) for j in range(k + 1)]
        for j, (lower, higher) in enumerate(zip([*legendre, 0], [0, *legendre], strict=True)):
            rows[k, j + 1] = lower - higher
    return rows
