"""A path cut into pieces so short that what a residual may add between their ends is small.

A residual whose second derivative along a piece is at most K differs from its chord by at most K/8
there, so that |r(t)| ≤ max(|r₀|, |r₁|) + K/8; K falls with the square of a piece's length.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from constraint_geodesics.certification.certificate import Limits
from constraint_geodesics.certification.kept import Asked, Broken, Kept, nothing_exceeds, summed_up
from constraint_geodesics.certification.kernels import ROUNDING

SHARE = 0.05
"""Share of what is allowed that K/8 should be at most."""
_MOST_PIECES = 2048
Bounds = Callable[[Float[np.ndarray, "S D"]], tuple[np.ndarray, np.ndarray]]
"""Residuals (S, m) at stations, and K/8 (S − 1, m) of the pieces between them."""


class Pieces(NamedTuple):
    """A path cut up: its stations (S, D), where the path's rows are among them, and the segment of
    each piece.
    """

    stations: Float[np.ndarray, "S D"]
    rows: Int[np.ndarray, "T"]
    segments: Int[np.ndarray, "S-1"]


def cut(rows: Float[np.ndarray, "T D"], added: Float[np.ndarray, "T-1"], wanted: float) -> Pieces:
    """Pieces so many that K/8 of each segment, `added`, becomes `wanted`; _MOST_PIECES a segment at
    most.
    """
    needed = np.ceil(np.sqrt(added / max(wanted, 1e-12)))
    counts = np.clip(np.nan_to_num(needed, nan=_MOST_PIECES), 1, _MOST_PIECES).astype(np.int64)
    segments = np.repeat(np.arange(len(counts)), counts)
    ends = np.concatenate([[0], np.cumsum(counts)])
    share = ((np.arange(len(segments)) - ends[segments]) / counts[segments])[:, None]
    steps = np.diff(rows, axis=0)
    stations = np.concatenate([rows[segments] + share * steps[segments], rows[-1:]])
    return Pieces(stations, ends, segments)


def kept_by(asked: Asked, bounds: Bounds) -> Kept:
    """How well the relations of a constraint are kept at the rows and on the whole path."""
    _, added = bounds(asked.rows)
    wanted = SHARE * asked.limits.violation_tolerance
    pieces = cut(asked.rows, added.max(axis=1), wanted)
    return kept_on(pieces, asked.constraint.relations, *bounds(pieces.stations), asked.limits)


def kept_on(
    pieces: Pieces,
    bounds: Sequence[Any],
    values: Float[np.ndarray, "S m"],
    added: Float[np.ndarray, "S-1 m"],
    limits: Limits,
) -> Kept:
    """How well residuals with these values at the stations, and K/8 on the pieces, are kept.

    bounds: of each residual its name, unit and tolerance.
    """
    attained, bound = nothing_exceeds()
    at_rows, between = [], []
    sizes, allowed = np.abs(values), limits.violation_tolerance
    sizes[np.isnan(sizes)] = np.inf
    for row_bound, size, more in zip(bounds, sizes.T, added.T, strict=True):
        name, unit, tolerance = row_bound.name, row_bound.unit, row_bound.tolerance
        proven = np.maximum(size[1:], size[:-1]) + more + ROUNDING
        limit, own = tolerance + allowed, size[pieces.rows]
        if not own.max() <= limit:
            row = int(np.argmax(own > limit))
            at_rows.append(Broken(row, float(own[row]) - tolerance, name, unit, tolerance))
        if not proven.max(initial=0.0) <= limit:
            piece = int(np.argmax(proven > limit))
            row = int(pieces.segments[piece])
            between.append(Broken(row, float(proven[piece]) - tolerance, name, unit, tolerance))
        attained[unit] = max(attained[unit], float(size.max()) - tolerance)
        largest = float(max(proven.max(initial=0.0), size.max()))
        bound[unit] = max(bound[unit], largest - tolerance)
    return summed_up(attained, bound, at_rows, between, limits)
