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

import numpy as np
from jaxtyping import Float

from constraint_geodesics.certification import kernels
from constraint_geodesics.certification.certificate import CertificationError
from constraint_geodesics.certification.chain import Chain
from constraint_geodesics.certification.kept import Asked, Kept
from constraint_geodesics.certification.pieces import kept_by

_BLOCKS = tuple(slice(3 * k, 3 * k + 3) for k in range(4))


def kept(asked: Asked) -> Kept:
    """How well the relations are kept at the rows and on the whole path."""
    relations, joint = asked.constraint.relations, asked.constraint.joint
    return kept_by(asked, lambda stations: _bounds(asked.chain, stations, relations, joint))


def _bounds(
    chain: Chain, stations: Float[np.ndarray, "S D"], relations: tuple, joint: int | None
) -> tuple[Float[np.ndarray, "S m"], Float[np.ndarray, "S-1 m"]]:
    """Residuals at stations, and K/8 of the pieces between them."""
    if joint is not None:  # its origin is the tip of the chain before it
        if joint >= len(chain.prismatic):
            raise CertificationError(f"joint {joint} of the constraint: the arm has no such joint")
        ends = slice(joint + 1)
        chain = Chain(
            chain.turns[ends], chain.offsets[ends], chain.prismatic[:joint], chain.lengths[ends]
        )
        stations = stations[:, :joint]
    y = features(chain, stations)
    if joint is not None:
        y[:, 3:] = 0.0
    steps = np.abs(np.diff(stations, axis=0))
    turning = np.where(chain.prismatic, 0.0, steps).sum(axis=1)
    first, second = motions(chain, stations, steps)
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


def features(chain: Chain, q: Float[np.ndarray, "S D"]) -> Float[np.ndarray, "S 12"]:
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


def motions(
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
