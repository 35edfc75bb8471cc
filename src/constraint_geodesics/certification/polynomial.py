"""Polynomial relations of the tool's pose, bounded along straight joint lines.

With r = c + wᵀy + ½ yᵀA y, y = (p, u₁, u₂, u₃), on a piece q(t) = q₀ + t d of a straight joint line

    r″ = (w + A y)ᵀ y″ + y′ᵀ A y′.

The parts of y move by at most |p′| ≤ P = Σ_j g_j |d_j| and |p″| ≤ Q = Σ_ij g_max(i,j) |d_i d_j|,
with g_j the length of the chain behind joint j (1 for a prismatic one, whose second derivatives
with a prismatic i before it vanish), and |u′| ≤ W = Σ_j |d_j|, |u″| ≤ W² over the revolute joints.
The gradient on the piece differs from that at its first row by at most Σ_b ‖A_ab‖ (P or W) in block
a.  So |r″| has a bound K, and |r(t)| ≤ max(|r₀|, |r₁|) + K/8, with pieces short enough for a small
K/8.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from constraint_geodesics.certification import kernels
from constraint_geodesics.certification.chain import Chain
from constraint_geodesics.certification.kept import Asked, Broken, Kept, nothing_exceeds, summed_up

_SHARE = 0.05
"""Share of what is allowed that the bound may add to the values at the pieces' ends."""
_MOST_PIECES = 1024
_BLOCKS = tuple(slice(3 * k, 3 * k + 3) for k in range(4))


class _Pieces(NamedTuple):
    """A path cut up: its stations (S, D), where the path's rows are among them, and the segment of
    each piece.
    """

    stations: Float[np.ndarray, "S D"]
    rows: Int[np.ndarray, "T"]
    segments: Int[np.ndarray, "S-1"]


def kept(asked: Asked) -> Kept:
    """How well the relations are kept at the rows and on the whole path."""
    attained, bound = nothing_exceeds()
    at_rows, between = [], []
    relations, allowed = asked.constraint.relations, asked.limits.violation_tolerance
    whole = _Pieces(asked.rows, np.arange(len(asked.rows)), np.arange(len(asked.rows) - 1))
    _, added = _bounds(asked.chain, whole, relations)
    pieces = _cut(asked.rows, added.max(axis=1), _SHARE * allowed)
    values, added = _bounds(asked.chain, pieces, relations)
    for own, value, more in zip(relations, values.T, added.T, strict=True):
        size = np.abs(value)
        size[np.isnan(size)] = np.inf
        proven = np.maximum(size[1:], size[:-1]) + more + kernels.ROUNDING
        limit, at = own.tolerance + allowed, size[pieces.rows]
        if not at.max() <= limit:
            row = int(np.argmax(at > limit))
            excess = float(at[row]) - own.tolerance
            at_rows.append(Broken(row, excess, own.name, own.unit, own.tolerance))
        if not proven.max(initial=0.0) <= limit:
            piece = int(np.argmax(proven > limit))
            excess = float(proven[piece]) - own.tolerance
            segment = int(pieces.segments[piece])
            between.append(Broken(segment, excess, own.name, own.unit, own.tolerance))
        attained[own.unit] = max(attained[own.unit], float(size.max()) - own.tolerance)
        largest = float(max(proven.max(initial=0.0), size.max()))
        bound[own.unit] = max(bound[own.unit], largest - own.tolerance)
    return summed_up(attained, bound, at_rows, between, asked.limits)


def _bounds(
    chain: Chain, pieces: _Pieces, relations: tuple
) -> tuple[Float[np.ndarray, "S m"], Float[np.ndarray, "S-1 m"]]:
    """Residuals at the stations, and K/8 of each piece."""
    y = _features(chain, pieces.stations)
    steps = np.abs(np.diff(pieces.stations, axis=0))
    turning = np.where(chain.prismatic, 0.0, steps).sum(axis=1)
    first, second = _motions(chain, pieces.stations, steps)
    ones, twos = [first, *[turning] * 3], [second, *[turning**2] * 3]
    values, added = [], []
    for own in relations:
        matrix = own.matrix
        slopes = own.linear + y @ matrix
        values.append(own.constant + y @ own.linear + 0.5 * ((y @ matrix) * y).sum(axis=1))
        norms = [[np.linalg.norm(matrix[a, b], 2) for b in _BLOCKS] for a in _BLOCKS]
        most = np.zeros(len(steps))
        for a, block in enumerate(_BLOCKS):
            moved = sum(norms[a][b] * ones[b] for b in range(4))
            here = np.linalg.norm(slopes[:-1, block], axis=1)
            most += (here + moved) * twos[a] + moved * ones[a]
        added.append(0.125 * most)
    return np.stack(values, axis=1), np.stack(added, axis=1)


def _features(chain: Chain, q: Float[np.ndarray, "S D"]) -> Float[np.ndarray, "S 12"]:
    """Position and the axes of the tool's frame, by the certificate's own kinematics."""
    poses = np.empty((len(q), 7))
    kernels.poses(chain, np.ascontiguousarray(q), poses)
    x, y, z, w = poses[:, 3:].T
    columns = (
        (1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)),
        (2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)),
        (2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.column_stack([poses[:, :3], *(entry for column in columns for entry in column)])


def _motions(
    chain: Chain, q: Float[np.ndarray, "S D"], steps: Float[np.ndarray, "S-1 D"]
) -> tuple[Float[np.ndarray, "S-1"], Float[np.ndarray, "S-1"]]:
    """P and Q of each piece [m]."""
    strokes = np.where(chain.prismatic, np.abs(q).max(axis=0), 0.0)
    lengths = np.asarray(chain.lengths[1:]) + np.append(strokes[1:], 0.0)
    behind = np.cumsum(lengths[::-1])[::-1]
    reach = np.where(chain.prismatic, 1.0, behind)
    index = np.arange(len(reach))
    second = reach[np.maximum(index[:, None], index)]
    second[chain.prismatic[np.minimum(index[:, None], index)]] = 0.0
    return steps @ reach, np.einsum("ti,ij,tj->t", steps, second, steps)


def _cut(rows: Float[np.ndarray, "T D"], added: Float[np.ndarray, "T-1"], wanted: float) -> _Pieces:
    """Pieces so many that what is added to each segment, which falls with their square, becomes
    `wanted`; _MOST_PIECES at most.
    """
    needed = np.ceil(np.sqrt(added / max(wanted, 1e-12)))
    counts = np.clip(np.nan_to_num(needed, nan=_MOST_PIECES), 1, _MOST_PIECES).astype(np.int64)
    segments = np.repeat(np.arange(len(counts)), counts)
    ends = np.concatenate([[0], np.cumsum(counts)])
    share = ((np.arange(len(segments)) - ends[segments]) / counts[segments])[:, None]
    steps = np.diff(rows, axis=0)
    stations = np.concatenate([rows[segments] + share * steps[segments], rows[-1:]])
    return _Pieces(stations, ends, segments)
