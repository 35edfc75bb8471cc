"""A constraint of two functions, bounded along straight joint lines by its second derivative.

With |d²r(q + t d)/dt²| ≤ K |d|² the residual differs from its chord over a piece with the
increments d by at most K |d|²/8, so that |r(t)| ≤ max(|r₀|, |r₁|) + K |d|²/8.  Segments are cut
into pieces until that is a small share of what is allowed.  K is the constraint's own promise.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from constraint_geodesics.certification.kept import Asked, Broken, Kept, nothing_exceeds, summed_up
from constraint_geodesics.certification.kernels import ROUNDING

_SHARE = 0.05
_MOST_PIECES = 2048


class _Pieces(NamedTuple):
    """A path cut up: its stations (S, D), where the path's rows are among them, the segment of each
    piece and its squared length [rad²].
    """

    stations: Float[np.ndarray, "S D"]
    rows: Int[np.ndarray, "T"]
    segments: Int[np.ndarray, "S-1"]
    squares: Float[np.ndarray, "S-1"]


def kept(asked: Asked) -> Kept:
    """How well the constraint is kept at the rows and on the whole path."""
    attained, bound = nothing_exceeds()
    at_rows, between = [], []
    bounds, allowed = asked.constraint.bounds, asked.limits.violation_tolerance
    pieces = _cut(asked.rows, max(row.second_derivative for row in bounds), _SHARE * allowed)
    sizes = np.abs(asked.constraint.values(pieces.stations))
    sizes[np.isnan(sizes)] = np.inf
    for size, (name, unit, second, tolerance) in zip(sizes.T, bounds, strict=True):
        proven = np.maximum(size[1:], size[:-1]) + 0.125 * second * pieces.squares + ROUNDING
        limit = tolerance + allowed
        own = size[pieces.rows]
        if not own.max() <= limit:
            row = int(np.argmax(own > limit))
            at_rows.append(Broken(row, float(own[row]) - tolerance, name, unit, tolerance))
        if not proven.max() <= limit:
            piece = int(np.argmax(proven > limit))
            row = int(pieces.segments[piece])
            between.append(Broken(row, float(proven[piece]) - tolerance, name, unit, tolerance))
        attained[unit] = max(attained[unit], float(size.max()) - tolerance)
        bound[unit] = max(bound[unit], float(proven.max()) - tolerance)
    return summed_up(attained, bound, at_rows, between, asked.limits)


def _cut(rows: Float[np.ndarray, "T D"], second: float, wanted: float) -> _Pieces:
    """Pieces so short that K |d|²/8 stays below `wanted` [rad or m]; _MOST_PIECES a segment at
    most.
    """
    steps = np.diff(rows, axis=0)
    squares = np.square(steps).sum(axis=1)
    needed = np.ceil(np.sqrt(0.125 * second * squares / max(wanted, 1e-12)))
    counts = np.clip(np.nan_to_num(needed, nan=_MOST_PIECES), 1, _MOST_PIECES).astype(np.int64)
    segments = np.repeat(np.arange(len(steps)), counts)
    ends = np.concatenate([[0], np.cumsum(counts)])
    share = (np.arange(len(segments)) - ends[segments]) / counts[segments]
    stations = np.concatenate([rows[segments] + share[:, None] * steps[segments], rows[-1:]])
    return _Pieces(stations, ends, segments, squares[segments] / counts[segments] ** 2)
