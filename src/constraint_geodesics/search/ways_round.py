"""Lines bent round what they lead through: to either side of where they are deepest in it.

The side is that of the distance's gradient in joint space, or the opposite one; how far is tried
until nothing is near there.  What comes of it is the beginning of a band.
"""

import numpy as np
from jaxtyping import Float
from numba import njit

from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.constraints.projection import Retraction
from constraint_geodesics.scene.clearance import DISTANCE, contact_row, near_contacts, new_contacts
from constraint_geodesics.search.space import STILL, Space, project_all, workspace

SIDES = (1.0, -1.0)
"""Along the gradient, and against it."""
FIRST_RAD, WIDENED, WIDENINGS = 0.1, 1.5, 9
"""How far the deepest node is moved at first; what that is multiplied by, and how often: up to
2.6 rad.
"""


def bent_round(
    space: Space, around: Space, nodes: Float[np.ndarray, "n D"], side: float, settings: Retraction
) -> Float[np.ndarray, "n D"] | None:
    """The nodes of a line that leads through something, bent to one side of it; None where that is
    not to be had.

    space: without what may meet; around: with it; settings: of the projection onto the former.
    """
    bent = nodes.copy()
    return bent if _bend(space, around, bent, side, settings) else None


@njit(**LEAF)
def _deepest(around, nodes, contacts):
    """The node (0 for none) at which bodies are nearest to each other, or overlap most."""
    worst, least = 0, around.margin
    for i in range(1, nodes.shape[0] - 1):
        if near_contacts(around.chain, around.clearance, nodes[i], least, contacts) > 0:
            worst, least = i, contacts.found[0, DISTANCE]
    return worst


@njit(**COMPILE)
def _bend(space, around, nodes, side, settings):
    """Bend the nodes (n, D) in place; False where there is no such bend."""
    count, dof = nodes.shape
    contacts, work = new_contacts(around.clearance, dof), workspace(space)
    way, moved, share, left = np.empty(dof), np.empty((1, dof)), np.ones(1), np.empty(1)
    deepest = _deepest(around, nodes, contacts)
    if deepest == 0:
        return False
    near_contacts(around.chain, around.clearance, nodes[deepest], around.margin, contacts)
    length = contact_row(around.chain.prismatic, contacts, 0, way)
    if length < STILL:
        return False
    far, near = FIRST_RAD, 1
    for _ in range(WIDENINGS):
        for d in range(dof):
            moved[0, d] = nodes[deepest, d] + side * far * way[d] / length
        if project_all(space, moved, share, settings, left, work) <= settings.accuracy:
            near = near_contacts(around.chain, around.clearance, moved[0], around.margin, contacts)
        if near == 0:
            break
        far *= WIDENED
    if near > 0:
        return False
    for d in range(dof):
        way[d] = moved[0, d] - nodes[deepest, d]
    for i in range(1, count - 1):
        part = i / deepest if i <= deepest else (count - 1 - i) / (count - 1 - deepest)
        for d in range(dof):
            nodes[i, d] += part * way[d]
    return True
