"""Compiled penalty that pushes an elastic band out of what may meet.

On the lines between the band's nodes lie samples q_s, each a share s of the way from node i to node
i + 1.  Where two bodies are nearer to each other than a margin m the penalty is

    P = κ / 2S Σ_s Σ_pairs (m − d(q_s))²,

S samples a line, κ the stiffness.  Its gradient and its Gauss-Newton Hessian κ/S ∇d ∇dᵀ are
shared out to the two nodes by 1 − s and s.  The margin is soft: a band that is pulled against an
edge comes a little nearer, and what is clear for good is told by looking at its lines.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.scene.clearance import DISTANCE, contact_row, near_again, new_nearby
from constraint_geodesics.search.space import STILL

SAMPLES = 2
"""Of each line: its first node and its middle."""
STIFFNESS = 1e3
"""κ [rad²/m²]."""


class Push(NamedTuple):
    """What the penalty adds: slopes (n + 1, D), curvatures (n + 1, D, D) of each node, crosses
    (n, D, D) between a node and the next; touched (n,): whether a line has any; sample, row (D,).
    """

    slopes: np.ndarray
    curvatures: np.ndarray
    crosses: np.ndarray
    touched: np.ndarray
    sample: np.ndarray
    row: np.ndarray


@njit(**COMPILE)
def new_push(nodes):
    """What the penalty of a band of these nodes writes into; nothing is pushed."""
    n, dof = nodes.shape[0] - 1, nodes.shape[1]
    return Push(
        np.zeros((n + 1, dof)),
        np.zeros((n + 1, dof, dof)),
        np.zeros((n, dof, dof)),
        np.zeros(n, dtype=np.bool_),
        np.empty(dof),
        np.empty(dof),
    )


@njit(**COMPILE)
def new_samples(around, nodes):
    """What is kept in mind of the samples of a band of these nodes."""
    return new_nearby(around.clearance, (nodes.shape[0] - 1) * SAMPLES, nodes.shape[1])


@njit(**LEAF)
def _share_out(push, i, share, slope, stiffness):
    """Add a sample's slope along `push.row` and its stiffness to the nodes of line i."""
    row, dof = push.row, push.row.shape[0]
    first, second = 1.0 - share, share
    push.touched[i] = True
    for d in range(dof):
        if row[d] == 0.0:
            continue
        push.slopes[i, d] += first * slope * row[d]
        push.slopes[i + 1, d] += second * slope * row[d]
        for e in range(dof):
            value = stiffness * row[d] * row[e]
            push.curvatures[i, d, e] += first * first * value
            push.curvatures[i + 1, d, e] += second * second * value
            push.crosses[i, d, e] += first * second * value


@njit(**LEAF)
def penalise(around, margin, nodes, push, contacts, samples, energy, most):
    """Energy and P of a band's nodes (n + 1, D), with the derivatives of P into `push`; any value
    from `most` on, and no derivatives, where it is no less.

    around: a Space with what may meet.  samples: of `new_samples`.  energy: of the nodes.
    """
    n, sample, total = nodes.shape[0] - 1, push.sample, 0.0
    push.slopes[:] = 0.0
    push.curvatures[:] = 0.0
    push.crosses[:] = 0.0
    push.touched[:] = False
    weight = STIFFNESS / SAMPLES
    for k in range(1, n * SAMPLES):
        i, share = k // SAMPLES, (k % SAMPLES) / SAMPLES
        for d in range(nodes.shape[1]):
            sample[d] = (1.0 - share) * nodes[i, d] + share * nodes[i + 1, d]
        near = near_again(around.chain, around.clearance, sample, margin, contacts, samples, k)
        for c in range(near):
            short = margin - contacts.found[c, DISTANCE]
            if contact_row(around.chain.prismatic, contacts, c, push.row) < STILL:
                continue
            total += 0.5 * weight * short * short
            _share_out(push, i, share, -weight * short, weight)
        if energy + total >= most:
            break
    return energy + total
