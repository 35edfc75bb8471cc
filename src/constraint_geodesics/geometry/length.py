"""Length and energy of curves on a manifold (eq. 2), batched and differentiable.

The default rule embeds a curve at few Chebyshev points and differentiates the polynomial through
them: one pass of the embedding a point, where a forward product costs four, at the accuracy of
Gauss-Legendre with as many nodes (`make measure STAGE=benchmark_geometry` measures both).  The
points of the rule of half the degree are among them, so the error estimate costs no further point,
and only curves whose estimate is too large are measured again with twice as many.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from constraint_geodesics.geometry.curves import CurveFamily, Curves
from constraint_geodesics.geometry.manifold import (
    EmbeddedManifold,
    GeometryError,
    Manifold,
    WalledManifold,
    require_finite,
)

TOLERANCE = 1e-3
"""Relative error of a length by default."""
DEGREES = (8, 16, 32, 64)
"""Degrees of the interpolating polynomial that are tried in turn on every piece of a curve."""
SAFETY = 2.0
"""Error estimate over the difference of a length to that by half the degree."""
ACCIDENT = 32.0
"""What a piecewise curve's change of length from a quarter of the degree to half counts less than
that to the whole: with many pieces two rules now and then agree by accident, three hardly ever.
"""
STEPS = 8
"""Steps of a manifold with walls that a piece of a curve measured at once may pass."""
COUNTED = 17
"""Points of a piece that its steps are counted by."""
LONGEST = 256
"""Parts that one piece of a curve is cut into at most."""
BLOCK = 4096
"""Points embedded at once: the temporaries of many more leave the processor's cache."""

Breaks = tuple[float, ...]
Objective = Callable[[Tensor, Tensor, Tensor], Tensor]
"""A function of (phi, start, goal)."""


@dataclass(frozen=True, eq=False)
class Quadrature:
    """A rule ∫₀¹ g dt ≈ Σ_i weights_i g(nodes_i): nodes inside [0, 1], weights that sum to 1."""

    nodes: Float[Tensor, "Q"]
    weights: Float[Tensor, "Q"]

    @classmethod
    def gauss_legendre(cls, count: int, breaks: Breaks = (0.0, 1.0)) -> "Quadrature":
        """Gauss-Legendre rule with `count` nodes between every two breaks: exact there up to degree
        2 count − 1.

        Raises GeometryError if count is below 1 or the breaks do not rise from 0 to 1.
        """
        if count < 1:
            raise GeometryError(f"count = {count}: a quadrature rule needs at least one node")
        _require_breaks(breaks)
        x, w = np.polynomial.legendre.leggauss(count)
        nodes = [low + (high - low) * (x + 1) / 2 for low, high in pairwise(breaks)]
        weights = [(high - low) * w / 2 for low, high in pairwise(breaks)]
        return cls(
            torch.from_numpy(np.concatenate(nodes)), torch.from_numpy(np.concatenate(weights))
        )


@dataclass(frozen=True, eq=False)
class Collocation:
    """Lengths from values at the Chebyshev-Lobatto points of every piece of a curve, both ends
    included.

    times: (S,) the points.  weights: (Q,) of the nodes of a Gauss-Legendre rule; twice as many
    nodes as the degree, since the norm of a polynomial is not one.  own_weights: (S,)
    Clenshaw-Curtis weights of the points themselves, for integrands that need no derivative.  half:
    the rule of half the degree, on every other point; None for an odd degree.
    """

    degree: int
    breaks: Breaks
    times: Float[Tensor, "S"]
    weights: Float[Tensor, "Q"]
    own_weights: Float[Tensor, "S"]
    half: "Collocation | None"

    @classmethod
    def chebyshev(cls, degree: int, breaks: Breaks = (0.0, 1.0)) -> "Collocation":
        """Polynomials of the given degree between every two breaks.

        Raises GeometryError if the degree is below 2 or the breaks do not rise from 0 to 1.
        """
        if degree < 2:
            raise GeometryError(f"degree = {degree}: must be at least 2")
        _require_breaks(breaks)
        half = cls.chebyshev(degree // 2, breaks) if degree % 2 == 0 and degree >= 4 else None
        times, weights, own = (torch.from_numpy(values) for values in _collocation(degree, breaks))
        return cls(degree, tuple(breaks), times, weights, own, half)

    @property
    def derivative(self) -> Float[Tensor, "Q S"]:
        """Takes values at `times` to the slopes of the polynomials through them, at the nodes of
        the Gauss-Legendre rule.
        """
        return torch.from_numpy(self._derivative)

    @cached_property
    def _derivative(self) -> Float[np.ndarray, "Q S"]:
        # Made where it is needed, as it grows with the square of the pieces; no tensor, since one
        # that is made while a function is transformed can't be kept.
        return _derivative(self.degree, self.breaks)

    def slopes(self, values: Float[Tensor, "*batch S A"]) -> Float[Tensor, "*batch Q A"]:
        """Slopes at the Gauss-Legendre nodes of the polynomials through values at `times`."""
        return self.derivative.to(values) @ values

    def length(self, values: Float[Tensor, "*batch S A"]) -> Float[Tensor, "*batch"]:
        """Length of the curve through embedded points at `times`, in their unit."""
        return torch.linalg.vector_norm(self.slopes(values), dim=-1) @ self.weights.to(values)


LengthRule = Quadrature | Collocation


@dataclass(frozen=True)
class LengthEstimate:
    """Lengths and their estimated absolute errors (*batch,), in the unit of the embedding."""

    length: Float[Tensor, "*batch"]
    error: Float[Tensor, "*batch"]


def curve_length(
    manifold: Manifold, curves: Curves, rule: LengthRule | None = None, tolerance: float = TOLERANCE
) -> Float[Tensor, "*batch"]:
    """Length of curves on a manifold, eq. 2: L = ∫₀¹ √(γ̇ᵀ M(γ) γ̇) dt = ∫₀¹ ‖d f(γ)/dt‖ dt.

    In the unit of the embedding; differentiable.  Without a rule the estimated relative error is
    brought below `tolerance`, as `estimate_length` does.
    Raises NonFiniteError with the first bad entry of phi, start, goal or the length, GeometryError
    if curves and manifold differ in dimension, CurveError on a wrong shape.
    """
    if rule is None:
        length = estimate_length(manifold, curves, tolerance).length
    else:
        _check(manifold, curves)
        length = _length(manifold, curves, rule)
    require_finite(length, "length")
    return length


def estimate_length(
    manifold: Manifold, curves: Curves, tolerance: float = TOLERANCE
) -> LengthEstimate:
    """Lengths whose estimated relative error is below `tolerance`, and the estimate.

    The estimate is twice the change from the rule of half the degree.  It is no bound: where a
    curve turns back both rules may err alike, and about one such curve in a hundred misses the
    tolerance.  On a manifold with walls, whose metric has kinks, pieces are cut to STEPS of its
    steps first.  Curves that no degree
    resolves keep the last length, and their estimate says so.  An embedding in single precision
    adds its rounding, about 1e-7 of its values.  Both are inf where a curve meets points at which
    the metric is not finite.
    Raises as `curve_length` does, and GeometryError unless tolerance is positive.
    """
    if not tolerance > 0:
        raise GeometryError(f"tolerance = {tolerance}: must be positive")
    _check(manifold, curves)
    batch, flat = curves.batch, curves.flat()
    ladder = rules(resolved(manifold, flat))
    length, error = _measured(manifold, flat, ladder[0])
    for rule in ladder[1:]:
        rows = torch.nonzero((error > tolerance * length) & length.isfinite()).squeeze(-1)
        if not len(rows):
            break
        finer, left = _measured(manifold, flat[rows], rule)
        length, error = length.index_copy(0, rows, finer), error.index_copy(0, rows, left)
    return LengthEstimate(length.reshape(batch), error.reshape(batch))


def resolved(manifold: Manifold, curves: Curves) -> Breaks:
    """The breaks of curves and, on a manifold with walls, what cuts their pieces to STEPS steps.

    As many parts to each piece, a power of 2: rules are made once for every such number.
    """
    breaks = tuple(curves.family.breaks)
    if not isinstance(manifold, WalledManifold) or not curves.batch.numel():
        return breaks
    inner = torch.linspace(0.0, 1.0, COUNTED)
    low = torch.tensor(breaks, dtype=curves.phi.dtype)
    times = low[:-1, None] + (low[1:] - low[:-1])[:, None] * inner.to(low)
    with torch.no_grad():
        points, _ = curves.at(times.flatten())
    sides = points.unflatten(-2, times.shape).diff(dim=-2)
    steps = float(torch.linalg.vector_norm(sides, dim=-1).sum(-1).max()) / manifold.step
    parts = 2 ** math.ceil(math.log2(min(max(steps / STEPS, 1.0), LONGEST)))
    cut = np.interp(np.arange(parts * (len(breaks) - 1) + 1) / parts, range(len(breaks)), breaks)
    return tuple(cut.tolist())


def curve_energy(
    manifold: Manifold, curves: Curves, rule: LengthRule | None = None
) -> Float[Tensor, "*batch"]:
    """Energy of curves on a manifold: E = ∫₀¹ γ̇ᵀ M(γ) γ̇ dt ≥ L², equal at constant speed only.

    In the square of the embedding's unit.  Smooth where the length is not; degree 16 for a curve of
    one piece by default.  Raises as `curve_length` does.
    """
    _check(manifold, curves)
    return _energy(manifold, curves, rule or rules(tuple(curves.family.breaks))[1])


def energy_function(manifold: Manifold, family: CurveFamily, rule: LengthRule) -> Objective:
    """(phi, start, goal) → `curve_energy`, free of checks, for torch.func to transform."""
    return lambda phi, start, goal: _energy(manifold, Curves(family, phi, start, goal), rule)


def length_function(manifold: Manifold, family: CurveFamily, rule: LengthRule) -> Objective:
    """(phi, start, goal) → `curve_length`, free of checks, for torch.func to transform."""
    return lambda phi, start, goal: _length(manifold, Curves(family, phi, start, goal), rule)


def _energy(manifold: Manifold, curves: Curves, rule: LengthRule) -> Tensor:
    squares, weights = _squared_speeds(manifold, curves, rule)
    return (squares @ weights.to(squares)).to(curves.phi)


def _length(manifold: Manifold, curves: Curves, rule: LengthRule) -> Tensor:
    squares, weights = _squared_speeds(manifold, curves, rule)
    return (_root(squares) @ weights.to(squares)).to(curves.phi)


def chord_length(points: Float[Tensor, "*batch T A"]) -> Float[Tensor, "*batch"]:
    """Length of the polygon through embedded points, Σ_i ‖x_{i+1} − x_i‖; never above the curve's.

    Raises GeometryError for fewer than two points, NonFiniteError with the first bad entry.
    """
    if points.ndim < 2 or points.shape[-2] < 2:
        raise GeometryError(
            f"points has shape {tuple(points.shape)}: must be (*batch, T, A) with T at least 2"
        )
    require_finite(points, "points")
    return torch.linalg.vector_norm(points.diff(dim=-2), dim=-1).sum(-1)


@cache
def rules(breaks: Breaks = (0.0, 1.0)) -> tuple[Collocation, ...]:
    """The rules tried in turn on curves with these breaks."""
    return tuple(Collocation.chebyshev(degree, breaks) for degree in DEGREES)


def _measured(manifold: Manifold, curves: Curves, rule: Collocation) -> tuple[Tensor, Tensor]:
    """Length by a rule and its error estimate: the difference to the rule of half the degree."""
    half = rule.half
    assert half is not None
    assert half.half is not None
    nested = ((rule, 1), (half, 2), (half.half, 4))
    if isinstance(manifold, EmbeddedManifold):
        values = _embedded(manifold, curves.at(rule.times.to(curves.phi))[0])
        lengths = [part.length(values[:, ::step]) for part, step in nested]
    else:
        speeds = _root(_squares_at(manifold, curves, rule.times))
        lengths = [speeds[:, ::step] @ part.own_weights.to(speeds) for part, step in nested]
    length, coarse, coarsest = (part.to(curves.phi) for part in lengths)
    length = torch.where(length.isfinite(), length, torch.inf)
    error = SAFETY * (length - coarse).abs()
    if len(curves.family.breaks) > 2:
        error = torch.maximum(error, (coarse - coarsest).abs() / ACCIDENT)
    return length, torch.where(error.isfinite(), error, torch.inf)


def _check(manifold: Manifold, curves: Curves) -> None:
    for name in ("phi", "start", "goal"):
        require_finite(getattr(curves, name), name)
    if curves.family.dim != manifold.dim:
        dim = curves.family.dim
        raise GeometryError(
            f"the curve has dim {dim}: must be that of the manifold, {manifold.dim}"
        )


def _squared_speeds(manifold: Manifold, curves: Curves, rule: LengthRule) -> tuple[Tensor, Tensor]:
    """γ̇ᵀ M(γ) γ̇ (*batch, Q) at the nodes of a rule, and the nodes' weights."""
    if isinstance(rule, Quadrature):
        return _squares_at(manifold, curves, rule.nodes), rule.weights
    if not isinstance(manifold, EmbeddedManifold):
        return _squares_at(manifold, curves, rule.times), rule.own_weights
    points, _ = curves.at(rule.times.to(curves.phi))
    return rule.slopes(_embedded(manifold, points)).square().sum(-1), rule.weights


def _squares_at(manifold: Manifold, curves: Curves, t: Tensor) -> Tensor:
    """γ̇ᵀ M(γ) γ̇ (*batch, T) at times t."""
    points, velocities = curves.at(t.to(curves.phi))
    if not isinstance(manifold, EmbeddedManifold):
        metric = manifold.metric(points).to(velocities)
        return (velocities * (metric @ velocities[..., None])[..., 0]).sum(-1)
    blocks = zip(_blocks(points), _blocks(velocities), strict=True)
    products = torch.cat([torch.func.jvp(manifold.embed, (z,), (v,))[1] for z, v in blocks])
    return products.square().sum(-1).reshape(points.shape[:-1])


def _embedded(
    manifold: EmbeddedManifold, points: Float[Tensor, "*batch S N"]
) -> Float[Tensor, "*batch S A"]:
    values = torch.cat([manifold.embed(block) for block in _blocks(points)])
    return values.reshape(*points.shape[:-1], values.shape[-1])


def _blocks(points: Float[Tensor, "*batch N"]) -> tuple[Tensor, ...]:
    return points.reshape(-1, points.shape[-1]).split(BLOCK)


def _root(squares: Tensor) -> Tensor:
    """Square roots, with slope 0 at 0: a curve that stands still must not give NaN gradients.

    What is no square, NaN or below zero, becomes NaN and is noticed; it must not pass for standing
    still.
    """
    moving = squares != 0
    return torch.where(moving, torch.where(moving, squares, 1.0).sqrt(), 0.0)


def _require_breaks(breaks: Breaks) -> None:
    if len(breaks) < 2 or (breaks[0], breaks[-1]) != (0.0, 1.0) or not (np.diff(breaks) > 0).all():
        raise GeometryError(f"breaks = {breaks}: must rise from 0 to 1")


def _collocation(degree: int, breaks: Breaks) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, weights and own weights of a Collocation; neighbouring pieces share a point."""
    x, to_coefficients = _chebyshev(degree)
    _, weights = np.polynomial.legendre.leggauss(2 * degree)
    # ∫ T_k over [−1, 1] is 2 / (1 − k²) for even k and 0 for odd k
    k = np.arange(degree + 1)
    own = np.where(k % 2 == 0, 2.0 / (1.0 - np.square(k) + (k == 1)), 0.0) @ to_coefficients
    count = len(breaks) - 1
    times, own_weights = np.empty(count * degree + 1), np.zeros(count * degree + 1)
    all_weights = []
    for piece, (low, high) in enumerate(pairwise(breaks)):
        points = slice(piece * degree, (piece + 1) * degree + 1)
        half = (high - low) / 2
        times[points] = low + half * (x + 1)
        own_weights[points] += half * own
        all_weights.append(half * weights)
    times[0], times[-1] = 0.0, 1.0
    return times, np.concatenate(all_weights), own_weights


def _derivative(degree: int, breaks: Breaks) -> np.ndarray:
    """Rows of slopes at a Collocation's Gauss-Legendre nodes."""
    chebyshev = np.polynomial.chebyshev
    _, to_coefficients = _chebyshev(degree)
    gauss, _ = np.polynomial.legendre.leggauss(2 * degree)
    slopes = np.stack(
        [chebyshev.chebval(gauss, chebyshev.chebder(unit)) for unit in np.eye(degree + 1)], axis=1
    )
    derivative, count = slopes @ to_coefficients, len(breaks) - 1
    rows = np.zeros((count * len(gauss), count * degree + 1))
    for piece, (low, high) in enumerate(pairwise(breaks)):
        points = slice(piece * degree, (piece + 1) * degree + 1)
        nodes = slice(piece * len(gauss), (piece + 1) * len(gauss))
        rows[nodes, points] = derivative / ((high - low) / 2)
    return rows


def _chebyshev(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Chebyshev-Lobatto points, and what takes values there to Chebyshev coefficients."""
    x = -np.cos(np.pi * np.arange(degree + 1) / degree)
    return x, np.linalg.inv(np.polynomial.chebyshev.chebvander(x, degree))
