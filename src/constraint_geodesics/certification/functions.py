"""A constraint of two functions, bounded along straight joint lines by its second derivative.

With |d²r(q + t d)/dt²| ≤ K |d|² the residual differs from its chord over a piece with the
increments d by at most K |d|²/8, so that |r(t)| ≤ max(|r₀|, |r₁|) + K |d|²/8.  Segments are cut
into pieces until that is a small share of what is allowed.  K is the constraint's own promise.
"""

import numpy as np
from jaxtyping import Float

from constraint_geodesics.certification.kept import Asked, Kept
from constraint_geodesics.certification.pieces import SHARE, cut, kept_on


def kept(asked: Asked) -> Kept:
    """How well the constraint is kept at the rows and on the whole path."""
    bounds = asked.constraint.bounds
    second = np.array([row.second_derivative for row in bounds])
    added = 0.125 * second.max() * _squares(asked.rows)
    pieces = cut(asked.rows, added, SHARE * asked.limits.violation_tolerance)
    values = asked.constraint.values(pieces.stations)
    added = 0.125 * second * _squares(pieces.stations)[:, None]
    return kept_on(pieces, bounds, values, added, asked.limits)


def _squares(rows: Float[np.ndarray, "T D"]) -> Float[np.ndarray, "T-1"]:
    """Squared lengths of the steps [rad²]."""
    squares: np.ndarray = np.square(np.diff(rows, axis=0)).sum(axis=1)
    return squares
