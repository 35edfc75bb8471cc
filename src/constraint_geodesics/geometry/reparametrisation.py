"""Curves run through at constant speed: the times at which a curve has covered equal shares of its
length.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from constraint_geodesics.geometry.curves import Curves, shifted_legendre
from constraint_geodesics.geometry.length import curve_speeds
from constraint_geodesics.geometry.manifold import GeometryError, Manifold, require_finite

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
    """Times, from 0 to 1 exactly, at which points lie equally spaced along curves in the manifold's
    length.

    Row by row they are times for `curve.evaluate`.  Each length between neighbours differs from
    their mean by less than `tolerance` of it, up to the rounding of the embedding: panels of time
    are halved until the speed is a polynomial on each, which takes more of them next to points
    where a curve turns back.  A curve of no length gets even times.  No gradient: the times are
    constants.
    Raises as `curve_length` does, GeometryError unless count is at least 2 and tolerance positive,
    and NonFiniteError where a speed overflows.
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
    inside = _root(series / length[..., None], (target - ends.gather(-1, place)) / length)
    times = chosen.low + (chosen.high - chosen.low) * inside
    times[:, 0], times[:, -1] = 0.0, 1.0
    # Next to a speed of zero the polynomial may dip below it.
    return times.cummax(-1).values


def _lengths_passed(
    panels: _Panels, curves: int
) -> tuple[Float[Tensor, "{curves} P+1"], Int[Tensor, "{curves}"]]:
    """Length passed at the panels' edges, the shorter rows filled with the whole, and each curve's
    first panel.
    """
    many = panels.row.bincount(minlength=curves)
    first = many.cumsum(0) - many
    place = torch.arange(len(panels.row)) - first[panels.row]
    lengths = panels.speed.new_zeros(curves, int(many.max()) + 1)
    return lengths.index_put((panels.row, place + 1), panels.speed[:, 0]).cumsum(-1), first


def _root(
    series: Float[Tensor, "*batch k"], target: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch"]:
    """Where in [0, 1] rising Legendre series reach their targets, by Newton's method kept within a
    bracket.
    """
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
    """Takes values at the Gauss-Legendre nodes to the Legendre series of the polynomial through
    them.
    """
    x, weights = np.polynomial.legendre.leggauss(NODES)
    return (
        np.polynomial.legendre.legvander(x, NODES - 1) * weights[:, None] * (np.arange(NODES) + 0.5)
    )


@cache
def _integral() -> Float[np.ndarray, "n n+1"]:
    """Takes a Legendre series shifted to [0, 1] to that of its integral from 0."""
    return np.stack([np.polynomial.legendre.legint(unit, lbnd=-1) / 2 for unit in np.eye(NODES)])
