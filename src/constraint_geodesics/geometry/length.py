"""Length and energy of curves on a manifold (eq. 2), batched and differentiable, and equal pace.

The default rule embeds a curve at few Chebyshev points and differentiates the polynomial through
them: one pass of the embedding a point, where a forward product costs four, at the accuracy of
Gauss-Legendre with as many nodes (`make bench-geometry` measures both).  The points of the rule of
half the degree are among them, so the error estimate costs no further point, and only curves whose
estimate is too large are measured again with twice as many.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from constraint_geodesics.geometry.curves import CurveFamily, Curves, shifted_legendre
from constraint_geodesics.geometry.manifold import (
    EmbeddedManifold,
    GeometryError,
    Manifold,
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

    times: (S,) the points.  derivative: (Q, S) takes values there to the slopes of the polynomials
    through them, at the nodes of a Gauss-Legendre rule with `weights` (Q,); twice as many nodes as
    the degree, since the norm of a polynomial is not one.  own_weights: (S,) Clenshaw-Curtis
    weights of the points themselves, for integrands that need no derivative.  half: the rule of
    half the degree, on every other point; None for an odd degree.
    """

    degree: int
    times: Float[Tensor, "S"]
    derivative: Float[Tensor, "Q S"]
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
        times, derivative, weights, own = (
            torch.from_numpy(values) for values in _collocation(degree, breaks)
        )
        return cls(degree, times, derivative, weights, own, half)

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
    tolerance; on grids with walls, whose metric has kinks, far more do.  Curves that no degree
    resolves keep the last length, and their estimate says so.  An embedding in single precision
    adds its rounding, about 1e-7 of its values.  Both are inf where a curve meets points at which
    the metric is not finite.
    Raises as `curve_length` does, and GeometryError unless tolerance is positive.
    """
    if not tolerance > 0:
        raise GeometryError(f"tolerance = {tolerance}: must be positive")
    _check(manifold, curves)
    batch, flat = curves.batch, curves.flat()
    ladder = rules(tuple(curves.family.breaks))
    length, error = _measured(manifold, flat, ladder[0])
    for rule in ladder[1:]:
        rows = torch.nonzero((error > tolerance * length) & length.isfinite()).squeeze(-1)
        if not len(rows):
            break
        finer, left = _measured(manifold, flat[rows], rule)
        length, error = length.index_copy(0, rows, finer), error.index_copy(0, rows, left)
    return LengthEstimate(length.reshape(batch), error.reshape(batch))


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


def curve_speeds(
    manifold: Manifold, curves: Curves, t: Float[Tensor, "*#batch T"]
) -> Float[Tensor, "*batch T"]:
    """Speed √(γ̇ᵀ M(γ) γ̇) of curves at times t, shared or one row a curve, in the unit of length.

    One forward product J_f(γ) γ̇ a point where there is an embedding f, never its Jacobian.  Raises
    as `curve_length` does.
    """
    _check(manifold, curves)
    return _root(_squares_at(manifold, curves, t)).to(curves.phi)


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


def _collocation(
    degree: int, breaks: Breaks
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Arrays of a Collocation; neighbouring pieces share the point between them."""
    chebyshev = np.polynomial.chebyshev
    x = -np.cos(np.pi * np.arange(degree + 1) / degree)
    gauss, weights = np.polynomial.legendre.leggauss(2 * degree)
    to_coefficients = np.linalg.inv(chebyshev.chebvander(x, degree))
    slopes = np.stack(
        [chebyshev.chebval(gauss, chebyshev.chebder(unit)) for unit in np.eye(degree + 1)], axis=1
    )
    derivative = slopes @ to_coefficients
    # ∫ T_k over [−1, 1] is 2 / (1 − k²) for even k and 0 for odd k
    k = np.arange(degree + 1)
    own = np.where(k % 2 == 0, 2.0 / (1.0 - np.square(k) + (k == 1)), 0.0) @ to_coefficients
    count, span = len(breaks) - 1, degree
    times, own_weights = np.empty(count * span + 1), np.zeros(count * span + 1)
    rows = np.zeros((count * len(gauss), count * span + 1))
    all_weights = np.empty(count * len(gauss))
    for piece, (low, high) in enumerate(pairwise(breaks)):
        points = slice(piece * span, (piece + 1) * span + 1)
        nodes = slice(piece * len(gauss), (piece + 1) * len(gauss))
        half = (high - low) / 2
        times[points] = low + half * (x + 1)
        own_weights[points] += half * own
        rows[nodes, points] = derivative / half
        all_weights[nodes] = half * weights
    times[0], times[-1] = 0.0, 1.0
    return times, rows, all_weights, own_weights


SPACING_TOLERANCE = 1e-6
"""Relative error of a spacing by default."""
NODES = 12
"""Gauss-Legendre nodes on each panel."""
FIRST_PANELS = 2
"""Panels that each piece of a curve is cut into before any is halved."""
HALVINGS = 40
"""Times a panel is halved at most: it is then shorter than any spacing."""
CROWD = 256
"""Panels of one curve halved at once at most; where more are rough it is the rounding of the
embedding.
"""
NEWTON_STEPS = 40


@dataclass(frozen=True, eq=False)
class _Panels:
    """Spans of time of a batch of curves, and the speed there.

    row: which curve.  low, high: when.  speed: Legendre series over [low, high] of the speed times
    high − low.
    """

    row: Int[Tensor, "K"]
    low: Float[Tensor, "K"]
    high: Float[Tensor, "K"]
    speed: Float[Tensor, "K n"]

    def __getitem__(self, which: Tensor) -> "_Panels":
        return _Panels(self.row[which], self.low[which], self.high[which], self.speed[which])

    @classmethod
    def in_order(cls, parts: list["_Panels"]) -> "_Panels":
        """All panels of several, by curve and time."""
        row, low, high, speed = (
            torch.cat([vars(part)[name] for part in parts]) for name in cls.__dataclass_fields__
        )
        by_time = low.argsort()
        return cls(row, low, high, speed)[by_time[row[by_time].argsort(stable=True)]]


def constant_speed(
    manifold: Manifold, curves: Curves, count: int, tolerance: float = SPACING_TOLERANCE
) -> Float[Tensor, "*batch {count}"]:
    """Times, from 0 to 1 exactly, of points equally spaced along curves in the manifold's length.

    Each length between neighbours differs from their mean by less than `tolerance` of it: panels of
    time are halved until the speed is a polynomial on each.  A curve of no length gets even times.
    The times are constants, without gradient.
    Raises as `curve_length` does, GeometryError unless count is at least 2 and tolerance positive.
    """
    if count < 2:
        raise GeometryError(f"count = {count}: must be at least 2")
    if not tolerance > 0:
        raise GeometryError(f"tolerance = {tolerance}: must be positive")
    with torch.no_grad():
        edges = _first_edges(tuple(curves.family.breaks))
        speeds = curve_speeds(manifold, curves, _nodes(edges[:-1], edges[1:]).flatten())
        require_finite(speeds, "speeds")
        batch = speeds.shape[:-1]
        if not speeds.numel():
            return curves.phi.new_zeros(*batch, count)
        row = torch.arange(batch.numel()).repeat_interleave(len(edges) - 1)
        low, high = (ends.repeat(batch.numel()) for ends in (edges[:-1], edges[1:]))
        panels = _panels(row, low, high, speeds.reshape(-1, NODES))
        panels = _refined(manifold, curves.flat(), panels, count, tolerance)
        return _inverted(panels, batch.numel(), count).reshape(*batch, count).to(curves.phi)


def _refined(
    manifold: Manifold, curves: Curves, panels: _Panels, count: int, tolerance: float
) -> _Panels:
    """Panels, by curve and time, on which the series of the speed is good enough."""
    length = panels.low.new_zeros(len(curves.phi)).index_add(0, panels.row, panels.speed[:, 0])
    # Standing still is run through as a straight line would be.
    panels.speed[:, 0] += torch.where(length[panels.row] > 0, 0.0, panels.high - panels.low)
    done = []
    for _ in range(HALVINGS):
        rough = _rough(panels, length / (count - 1), tolerance)
        done.append(panels[~rough])
        panels = panels[rough]
        if not len(panels.row):
            break
        row, middle = panels.row.repeat(2), (panels.low + panels.high) / 2
        low, high = torch.cat([panels.low, middle]), torch.cat([middle, panels.high])
        speeds = curve_speeds(manifold, curves[row], _nodes(low, high))
        require_finite(speeds, "speeds")
        panels = _panels(row, low, high, speeds)
    return _Panels.in_order([*done, panels])


def _panels(row: Tensor, low: Tensor, high: Tensor, speeds: Float[Tensor, "K n"]) -> _Panels:
    """Panels from speeds at their nodes."""
    return _Panels(
        row, low, high, (high - low)[:, None] * (speeds.double() @ torch.from_numpy(_to_series()))
    )


def _nodes(low: Float[Tensor, "K"], high: Float[Tensor, "K"]) -> Float[Tensor, "K n"]:
    """Gauss-Legendre nodes on panels."""
    x = torch.from_numpy(np.polynomial.legendre.leggauss(NODES)[0])
    return low[:, None] + (high - low)[:, None] * (x + 1) / 2


def _rough(panels: _Panels, spacing: Float[Tensor, "B"], tolerance: float) -> Bool[Tensor, "K"]:
    """Which panels must be halved."""
    # The last two terms are about as large as all that follow.  What they leave out is small enough
    # either against a spacing, or against the lowest speed of the panel and so against any part of
    # it; half, for a spacing's two ends.
    sizes = panels.speed.abs()
    lowest = panels.speed[:, 0] - sizes[:, 1:].sum(-1)
    rough = sizes[:, -2:].sum(-1) > tolerance / 2 * torch.maximum(spacing[panels.row], lowest)
    crowd = panels.row[rough].bincount(minlength=len(spacing))
    return rough & (crowd <= CROWD)[panels.row]


def _inverted(panels: _Panels, curves: int, count: int) -> Float[Tensor, "{curves} {count}"]:
    """Times at which the share of the length that is passed reaches 0, 1/(count − 1) … 1."""
    ends, first = _lengths_passed(panels, curves)
    length = ends[:, -1:]
    target = torch.linspace(0, 1, count, dtype=ends.dtype) * length
    place = torch.searchsorted(ends[:, 1:-1].contiguous(), target, right=True)
    # Behind its last panel a row repeats the whole length, and rounding may lead there.
    last = panels.row.bincount(minlength=curves)[:, None] - 1
    place = torch.minimum(place, last)
    chosen = panels[first[:, None] + place]
    series = chosen.speed @ torch.from_numpy(_integral())
    inside = _reached(series / length[..., None], (target - ends.gather(-1, place)) / length)
    times = chosen.low + (chosen.high - chosen.low) * inside
    times[:, 0], times[:, -1] = 0.0, 1.0
    # Next to a speed of zero the polynomial may dip below it.
    return times.cummax(-1).values


def _lengths_passed(
    panels: _Panels, curves: int
) -> tuple[Float[Tensor, "{curves} P+1"], Int[Tensor, "{curves}"]]:
    """Length passed at the panels' edges, the whole beyond; and each curve's first panel."""
    many = panels.row.bincount(minlength=curves)
    first = many.cumsum(0) - many
    place = torch.arange(len(panels.row)) - first[panels.row]
    lengths = panels.speed.new_zeros(curves, int(many.max()) + 1)
    return lengths.index_put((panels.row, place + 1), panels.speed[:, 0]).cumsum(-1), first


def _reached(
    series: Float[Tensor, "*batch k"], target: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch"]:
    """Where rising Legendre series on [0, 1] reach their targets: Newton within a bracket."""
    low, high = torch.zeros_like(target), torch.ones_like(target)
    u = (target / series.sum(-1)).nan_to_num(nan=0.5).clamp(0.0, 1.0)
    for _ in range(NEWTON_STEPS):
        values, slopes = shifted_legendre(u, series.shape[-1])
        excess = (series * values).sum(-1) - target
        low, high = torch.where(excess < 0, u, low), torch.where(excess < 0, high, u)
        newton = u - excess / (series * slopes).sum(-1)
        moved = torch.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
        step, u = (moved - u).abs().max(), moved
        if step < 1e-14:
            break
    return u


@cache
def _first_edges(breaks: tuple[float, ...]) -> Float[Tensor, "P+1"]:
    pieces = len(breaks) - 1
    places = np.arange(FIRST_PANELS * pieces + 1) / FIRST_PANELS
    return torch.from_numpy(np.interp(places, np.arange(pieces + 1), breaks))


@cache
def _to_series() -> Float[np.ndarray, "n n"]:
    """From values at the Gauss-Legendre nodes to the Legendre series through them."""
    x, weights = np.polynomial.legendre.leggauss(NODES)
    return (
        np.polynomial.legendre.legvander(x, NODES - 1) * weights[:, None] * (np.arange(NODES) + 0.5)
    )


@cache
def _integral() -> Float[np.ndarray, "n n+1"]:
    """Takes a Legendre series shifted to [0, 1] to that of its integral from 0."""
    return np.stack([np.polynomial.legendre.legint(unit, lbnd=-1) / 2 for unit in np.eye(NODES)])
