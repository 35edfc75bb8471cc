"""Curves in a chart that start and end exactly where they must (eqs. 9-11).

Every family is the straight line between the ends plus a basis that vanishes there.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from constraint_geodesics.geometry.manifold import GeometryError, require_finite

Coefficients = Float[Tensor, "*#batch p"]
Points = Float[Tensor, "*#batch N"]
Times = Float[Tensor, "*#batch T"]


class CurveError(GeometryError):
    """A curve can't be built from the input; names it, its shape or value and what is allowed."""


class CurveFamily(ABC):
    """All curves γ_φ(t) = (1 − t) start + t goal + Σ_k φ_{n,k} b_k(t) in N dimensions.

    A new family brings its dimension N, its basis b_k and two derivatives.  φ holds the m numbers
    of the first dimension, then those of the next; φ = 0 is the straight line in the chart.
    """

    dim: int

    @property
    @abstractmethod
    def functions(self) -> int:
        """Number m of basis functions, the same for every dimension."""

    @property
    @abstractmethod
    def breaks(self) -> tuple[float, ...]:
        """Rising times from 0 to 1 between which the basis is polynomial; C² at the inner ones."""

    @abstractmethod
    def basis(self, t: Float[Tensor, "*times"]) -> Float[Tensor, "*times m"]:
        """Basis functions b_k(t), zero to the bit at t = 0 and t = 1."""

    @abstractmethod
    def basis_derivative(self, t: Float[Tensor, "*times"]) -> Float[Tensor, "*times m"]:
        """Derivatives ḃ_k(t)."""

    @abstractmethod
    def basis_second_derivative(self, t: Float[Tensor, "*times"]) -> Float[Tensor, "*times m"]:
        """Second derivatives b̈_k(t)."""

    @property
    def coefficients(self) -> int:
        """Number of free numbers in φ, p = N m."""
        return self.dim * self.functions

    def evaluate(
        self, phi: Coefficients, start: Points, goal: Points, t: Times
    ) -> tuple[Float[Tensor, "*batch T N"], Float[Tensor, "*batch T N"]]:
        """Points γ(t) and velocities γ̇(t); γ(0) = start and γ(1) = goal to the bit.

        Batches of phi, start and goal broadcast; t is (T,) for all curves, or has a row for each.
        Raises CurveError on a wrong shape.
        """
        self._check(phi, start, goal)
        if t.ndim != 1:
            self._batch(t, phi, start, goal)
        start, goal, time = start[..., None, :], goal[..., None, :], t[..., None]
        # Weighting both ends, not start + t (goal − start), makes the goal exact.
        points = (1 - time) * start + time * goal + self._bend(phi, self.basis(t))
        velocities = (goal - start) + self._bend(phi, self.basis_derivative(t))
        return points, velocities

    def acceleration(
        self, phi: Coefficients, start: Points, goal: Points, t: Times
    ) -> Float[Tensor, "*batch T N"]:
        """Second derivatives γ̈(t); the ends only give their batch.  Raises as `evaluate` does."""
        self._check(phi, start, goal)
        batch = self._batch(t, phi, start, goal)
        bend = self._bend(phi, self.basis_second_derivative(t))
        return bend.expand(*batch, t.shape[-1], self.dim)

    def fit(
        self, points: Float[Tensor, "*batch T N"], t: Float[Tensor, "T"]
    ) -> Float[Tensor, "*batch p"]:
        """Coefficients of the curves nearest to sampled ones, by least squares over the samples.

        The first and last points are the ends, t[0] = 0 and t[-1] = 1.  Members of the family come
        back as they were.
        Raises CurveError on a wrong shape, other first and last times, or times too few or too
        close to tell the basis functions apart; NonFiniteError with the first bad entry.
        """
        self._check_samples(points, t)
        time = t.to(points)
        # One pseudo-inverse serves the whole batch.
        basis = self.basis(time)
        self._require_full_rank(basis)
        line = (1 - time)[:, None] * points[..., :1, :] + time[:, None] * points[..., -1:, :]
        free = torch.linalg.pinv(basis) @ (points - line)
        return free.mT.reshape(*points.shape[:-2], self.coefficients)

    def _by_dimension(self, phi: Tensor) -> Tensor:
        return phi.reshape(*phi.shape[:-1], self.dim, self.functions)

    def _bend(self, phi: Tensor, basis: Tensor) -> Tensor:
        return (self._by_dimension(phi) @ basis.mT).mT

    def _check(self, phi: Tensor, start: Tensor, goal: Tensor) -> None:
        for name, value, size in (
            ("phi", phi, self.coefficients),
            ("start", start, self.dim),
            ("goal", goal, self.dim),
        ):
            if value.ndim == 0 or value.shape[-1] != size:
                raise CurveError(
                    f"{name} has shape {tuple(value.shape)}: its last axis must have {size} "
                    f"entries ({self})"
                )

    def _batch(self, t: Tensor, phi: Tensor, start: Tensor, goal: Tensor) -> tuple[int, ...]:
        """The curves' batch, which rows of times must not enlarge."""
        batch = tuple(torch.broadcast_shapes(phi.shape[:-1], start.shape[:-1], goal.shape[:-1]))
        sizes = zip(reversed(t.shape[:-1]), reversed(batch), strict=False)
        if not 1 <= t.ndim <= len(batch) + 1 or any(rows not in (1, size) for rows, size in sizes):
            raise CurveError(
                f"t has shape {tuple(t.shape)}: must be (T,), or (*batch, T) for curves of "
                f"batch {batch}"
            )
        return batch

    def _check_samples(self, points: Tensor, t: Tensor) -> None:
        if t.ndim != 1 or points.ndim < 2 or points.shape[-2:] != (len(t), self.dim):
            shapes = f"points has shape {tuple(points.shape)} and t {tuple(t.shape)}"
            raise CurveError(f"{shapes}: must be (*batch, T, {self.dim}) and (T,)")
        needed = self.functions + 2
        if len(t) < needed:
            raise CurveError(
                f"points has {len(t)} points a curve: must be at least {needed} ({self})"
            )
        require_finite(points, "points")
        require_finite(t, "t")
        if (float(t[0]), float(t[-1])) != (0.0, 1.0):
            raise CurveError(f"t runs from {float(t[0])} to {float(t[-1])}: must run from 0 to 1")

    def _require_full_rank(self, basis: Tensor) -> None:
        rank = int(torch.linalg.matrix_rank(basis)) if self.functions else 0
        if rank < self.functions:
            raise CurveError(
                f"t tells {rank} basis functions apart: must tell all {self.functions} ({self})"
            )


@dataclass(frozen=True, eq=False)
class Curves:
    """Curves γ_φ of one family: coefficients phi, ends start and goal; their batches broadcast."""

    family: CurveFamily
    phi: Coefficients
    start: Points
    goal: Points

    def __getitem__(self, rows: Tensor | slice | int) -> "Curves":
        return Curves(self.family, self.phi[rows], self.start[rows], self.goal[rows])

    @property
    def batch(self) -> torch.Size:
        """The batch that coefficients and ends share."""
        ends = self.start.shape[:-1], self.goal.shape[:-1]
        return torch.broadcast_shapes(self.phi.shape[:-1], *ends)

    def flat(self) -> "Curves":
        """The same curves in a batch of one axis."""
        batch, arrays = self.batch, (self.phi, self.start, self.goal)
        return Curves(
            self.family,
            *(x.expand(*batch, x.shape[-1]).reshape(batch.numel(), x.shape[-1]) for x in arrays),
        )

    def at(self, t: Times) -> tuple[Float[Tensor, "*batch T N"], Float[Tensor, "*batch T N"]]:
        """Points and velocities, as `CurveFamily.evaluate`."""
        return self.family.evaluate(self.phi, self.start, self.goal, t)


@dataclass(frozen=True)
class PinnedPolynomial(CurveFamily):
    """Polynomials of degree K in N dimensions with both ends given, eqs. 9-11.

    b_k(t) = t (1 − t) P*_k(t), k = 0 … K − 2, with P*_k the Legendre polynomials shifted to [0, 1].
    The space is that of eq. 11 with the goal pinned as well (`to_monomial` gives its coefficients),
    but no two b_k are nearly alike, as powers of t are.  p = N (K − 1), 4 for a planar cubic.

    dim: N, at least 1.  degree: K, at least 1 (the straight line).  Raises CurveError otherwise.
    """

    dim: int
    degree: int = 3

    def __post_init__(self) -> None:
        _require_at_least_one(dim=self.dim, degree=self.degree)

    @property
    def functions(self) -> int:
        """K − 1."""
        return self.degree - 1

    breaks = (0.0, 1.0)

    def basis(self, t: Float[Tensor, "*times"]) -> Float[Tensor, "*times m"]:
        """Basis b_k(t) = t (1 − t) P*_k(t), zero at t = 0 and t = 1."""
        legendre, _ = shifted_legendre(t, self.functions)
        return (t * (1 - t))[..., None] * legendre

    def basis_derivative(self, t: Float[Tensor, "*times"]) -> Float[Tensor, "*times m"]:
        """Derivatives ḃ_k(t) = (1 − 2t) P*_k(t) + t (1 − t) Ṗ*_k(t)."""
        legendre, derivative = shifted_legendre(t, self.functions)
        return (1 - 2 * t)[..., None] * legendre + (t * (1 - t))[..., None] * derivative

    def basis_second_derivative(self, t: Float[Tensor, "*times"]) -> Float[Tensor, "*times m"]:
        """b̈_k(t) = (1 − 2t) Ṗ*_k(t) − (k² + k + 2) P*_k(t), by Legendre's differential equation."""
        legendre, derivative = shifted_legendre(t, self.functions)
        k = torch.arange(self.functions, dtype=t.dtype, device=t.device)
        return (1 - 2 * t)[..., None] * derivative - (k * k + k + 2) * legendre

    def to_monomial(
        self, phi: Coefficients, start: Points, goal: Points
    ) -> Float[Tensor, "*batch N {self.degree}+1"]:
        """Coefficients of t^k in eq. 9: φ_{n,0} = start_n, Σ_{k≥1} φ_{n,k} = goal_n − start_n."""
        self._check(phi, start, goal)
        powers = _basis_in_powers(self.degree).to(phi)
        bent = self._by_dimension(phi) @ powers
        start, line = start[..., None], (goal - start)[..., None]
        straight = torch.cat(
            [start.expand_as(line), line, line.new_zeros(*line.shape[:-1], self.degree - 1)], dim=-1
        )
        return straight + bent


@dataclass(frozen=True)
class PinnedSpline(CurveFamily):
    """Cubic C² splines on S equal pieces in N dimensions with both ends given.

    The basis is that of the clamped cubic B-splines (de Boor, A Practical Guide to Splines, ch.
    IX), S + 3 in number; the first and last, which alone are not zero at the ends, give way to the
    straight line.  One piece spans the cubics of PinnedPolynomial(N, 3).  A coefficient acts on
    four pieces at most.  p = N (S + 1).

    dim: N, at least 1.  segments: S, at least 1.  Raises CurveError otherwise.
    """

    dim: int
    segments: int = 4

    def __post_init__(self) -> None:
        _require_at_least_one(dim=self.dim, segments=self.segments)

    @property
    def functions(self) -> int:
        """S + 1."""
        return self.segments + 1

    @property
    def breaks(self) -> tuple[float, ...]:
        """Knots 0, 1/S … 1; the third derivative jumps at the inner ones."""
        return tuple(k / self.segments for k in range(self.segments + 1))

    def basis(self, t: Float[Tensor, "*times"]) -> Float[Tensor, "*times m"]:
        """Inner B-splines b_k(t), zero at t = 0 and t = 1."""
        return self._derivative(t, 0)

    def basis_derivative(self, t: Float[Tensor, "*times"]) -> Float[Tensor, "*times m"]:
        """Derivatives ḃ_k(t), quadratic on each piece."""
        return self._derivative(t, 1)

    def basis_second_derivative(self, t: Float[Tensor, "*times"]) -> Float[Tensor, "*times m"]:
        """Second derivatives b̈_k(t), linear on each piece."""
        return self._derivative(t, 2)

    def _derivative(self, t: Tensor, order: int) -> Tensor:
        scaled = t * self.segments
        piece = scaled.detach().long().clamp(0, self.segments - 1)
        ordinates = torch.from_numpy(_bezier_ordinates(self.segments, order)).to(t)
        # In Bernstein form the zeros at both ends, and the values that pieces share, are exact.
        values = (_bernstein(scaled - piece, 3 - order)[..., None] * ordinates[piece]).sum(-2)
        columns = piece[..., None] + torch.arange(4, device=t.device)
        whole = values.new_zeros(*t.shape, self.segments + 3).scatter(-1, columns, values)
        return whole[..., 1:-1]


def shifted_legendre(
    t: Float[Tensor, "*times"], count: int
) -> tuple[Float[Tensor, "*times {count}"], Float[Tensor, "*times {count}"]]:
    """P*_k(t) = P_k(2t − 1) and derivatives to t for k < count, by Bonnet's recurrence."""
    x = 2 * t - 1
    values, slopes = [torch.ones_like(t), x], [torch.zeros_like(t), torch.ones_like(t)]
    for k in range(1, count - 1):
        values.append(((2 * k + 1) * x * values[k] - k * values[k - 1]) / (k + 1))
        slopes.append((2 * k + 1) * values[k] + slopes[k - 1])
    if count == 0:
        return t.new_zeros(*t.shape, 0), t.new_zeros(*t.shape, 0)
    return torch.stack(values[:count], dim=-1), 2 * torch.stack(slopes[:count], dim=-1)


def _basis_in_powers(degree: int) -> Tensor:
    """Coefficients of t^0 … t^K in b_k(t), (K − 1, K + 1), each an exact integer."""
    rows = torch.zeros(degree - 1, degree + 1, dtype=torch.float64)
    for k in range(degree - 1):
        legendre = [(-1) ** (k + j) * math.comb(k, j) * math.comb(k + j, j) for j in range(k + 1)]
        for j, (lower, higher) in enumerate(zip([*legendre, 0], [0, *legendre], strict=True)):
            rows[k, j + 1] = lower - higher
    return rows


def _bernstein(u: Tensor, degree: int) -> Tensor:
    """Bernstein polynomials of u in [0, 1], (*times, degree + 1)."""
    values = [math.comb(degree, j) * u**j * (1 - u) ** (degree - j) for j in range(degree + 1)]
    return torch.stack(values, dim=-1)


@cache
def _bezier_ordinates(segments: int, order: int) -> Float[np.ndarray, "S d 4"]:
    """Bézier ordinates (S, 4 − order, 4) of the derivatives of the four B-splines on each piece,
    of which the first is the piece's own number of all S + 3.

    Ordinate j of the piece [k, k + 1] is the blossom at 3 − j times k and j times k + 1 (Ramshaw,
    Blossoms are polar forms, 1989), in units of the pieces.  Each derivative of a Bézier curve of
    degree d is d times its differences.
    """
    ordinates = np.array(
        [
            [_blossom(segments, k, [k] * (3 - j) + [k + 1] * j) for j in range(4)]
            for k in range(segments)
        ]
    )
    for degree in range(3, 3 - order, -1):
        ordinates = segments * degree * np.diff(ordinates, axis=1)
    return ordinates


def _blossom(segments: int, piece: int, arguments: list[int]) -> Float[np.ndarray, "4"]:
    """Blossom at three arguments of the cubic B-splines on one piece, by de Boor's algorithm."""
    knots = [0, 0, 0, *range(segments + 1), segments, segments, segments]
    control = list(np.eye(4))
    for r, x in enumerate(arguments, start=1):
        for j in range(3, r - 1, -1):
            left, right = knots[piece + j], knots[piece + j + 4 - r]
            share = (x - left) / (right - left)
            control[j] = (1 - share) * control[j - 1] + share * control[j]
    return control[3]


def _require_at_least_one(**values: int) -> None:
    for name, value in values.items():
        if value < 1:
            raise CurveError(f"{name} = {value}: must be at least 1")
