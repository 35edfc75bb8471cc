"""The configurations that a search may use: on the constraint, within the joint limits, clear of
the workcell and of the arm itself.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numba import njit

from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.kernels import Looked, ManifoldArrays, excess_of, linearise
from constraint_geodesics.constraints.projection import (
    Retraction,
    RetractionRoom,
    left_by,
    new_room,
    normal_matrix,
    retract_all,
    solve_normal,
)
from constraint_geodesics.robot.kinematics import ChainArrays
from constraint_geodesics.scene.clearance import (
    DISTANCE,
    NO_CLEARANCE,
    ClearanceArrays,
    ClearanceModel,
    Contacts,
    contact_row,
    near_contacts,
    new_contacts,
    stays_clear,
)

NEAR = 0.05
"""Bounds so near [rad or m] are looked at."""
SHORT = 5e-7
"""What may lack of a margin [m]: the last of it would take as many steps again."""
STILL = 1e-9
"""A contact whose distance no joint changes by more [m/rad] is none to be kept."""
FLAT, TURNED = 0.5, 0.5
"""A row that changes by less a radian or metre of the joints has no direction to speak of; the
cosine of the angle by which that of others turns at most within an edge's step.
"""
_SMALLEST_PIVOT = 1e-12


class Space(NamedTuple):
    """As the compiled search takes it.  constraint: of `Constraint.arrays`; limits (2, D): lower
    and upper [rad or m]; margin: kept by bodies that may meet [m]; projection: onto all of them.
    """

    chain: ChainArrays
    constraint: Any
    limits: Float[np.ndarray, "2 D"]
    clearance: ClearanceArrays
    margin: float
    projection: Retraction = Retraction(iterations=12, damping=1e-9)


def space_of(
    manifold: ConstraintManifold, clearance: ClearanceModel | None = None, margin_m: float = 0.0
) -> Space:
    """The space of a constraint manifold, by default one in which nothing can meet."""
    robot = manifold.robot
    limits = np.stack([robot.lower, robot.upper])
    return Space(*manifold.arrays, limits, (clearance or NO_CLEARANCE).arrays, margin_m)


class Workspace(NamedTuple):
    """What the kernels write into, allocated once.

    retraction: of the constraint alone; looked: the same as its own, of which `look_at` overwrites
    the first configuration; place (1, D); excess, active, weights (m,); slopes (m, D); contacts;
    rows, normal (D, D); right, squares, before, point (D,).
    """

    retraction: RetractionRoom
    looked: Looked
    place: np.ndarray
    excess: np.ndarray
    active: np.ndarray
    weights: np.ndarray
    slopes: np.ndarray
    contacts: Contacts
    rows: np.ndarray
    normal: np.ndarray
    right: np.ndarray
    squares: np.ndarray
    before: np.ndarray
    point: np.ndarray


@njit(**COMPILE)
def workspace(space):
    """A workspace for the kernels of this space."""
    dof, count = space.limits.shape[1], space.constraint.rows.held.shape[0]
    retraction = new_room(space.constraint, dof)
    return Workspace(
        retraction,
        retraction.looked,
        np.empty((1, dof)),
        np.zeros(count),
        np.zeros(count, dtype=np.bool_),
        np.zeros(count),
        np.zeros((count, dof)),
        new_contacts(space.clearance, dof),
        np.empty((dof, dof)),
        np.empty((dof, dof)),
        np.empty(dof),
        np.empty(dof),
        np.empty(dof),
        np.empty(dof),
    )


@njit(inline="always", **LEAF)
def look_at(space, q, work):
    """Residual and Jacobian of one configuration, the first of `work.looked`."""
    for d in range(q.shape[0]):
        work.place[0, d] = q[d]
    linearise(space, work.place, work.looked)


@njit(**LEAF)
def _broken(space, q, work):
    """What one configuration breaks, into `work.rows` and `work.right`: the number of rows, the
    worst [rad or m], and how many of the rows are the constraint's.
    """
    dof, limits = q.shape[0], space.limits
    rows, right, contacts = work.rows, work.right, work.contacts
    jacobian, excess, active = work.looked.jacobians[0], work.excess, work.active
    look_at(space, q, work)
    worst = excess_of(space.constraint.rows, work.looked.residuals[0], excess, active)
    size = 0
    for i in range(active.shape[0]):
        if active[i] and size < dof:
            right[size] = excess[i]
            for d in range(dof):
                rows[size, d] = jacobian[i, d]
            size += 1
    own = size
    for d in range(dof):
        over = q[d] - limits[1, d] if q[d] > limits[1, d] else min(q[d] - limits[0, d], 0.0)
        if over != 0.0:
            worst = max(worst, abs(over))
            if size < dof:
                right[size] = over
                rows[size] = 0.0
                rows[size, d] = 1.0
                size += 1
    if space.clearance.top > 0:
        far = space.margin - SHORT
        near = near_contacts(space.chain, space.clearance, q, far, contacts)
        for c in range(near):
            short = space.margin - contacts.found[c, DISTANCE]
            worst = max(worst, short)
            if size < dof:
                if contact_row(space.chain.prismatic, contacts, c, rows[size]) < STILL:
                    continue
                right[size] = -short
                size += 1
    return size, worst, own


@njit(**LEAF)
def keep_slopes(space, q, work):
    """Keep what the constraint's rows change by at a configuration, for `turns_over`."""
    look_at(space, q, work)
    jacobian = work.looked.jacobians[0]
    for i in range(work.slopes.shape[0]):
        for d in range(q.shape[0]):
            work.slopes[i, d] = jacobian[i, d]


@njit(**LEAF)
def turns_over(space, q, work):
    """Whether a row changes in quite another direction than where the slopes were kept, and keep
    those of here.

    Between near configurations none does but over a place where it is undefined, as the turn about
    the vertical is for a tool that is upside down: no straight line keeps the constraint there.
    """
    look_at(space, q, work)
    held, jacobian, over = space.constraint.rows.held, work.looked.jacobians[0], False
    for i in range(work.slopes.shape[0]):
        along, first, second = 0.0, 0.0, 0.0
        for d in range(q.shape[0]):
            along += jacobian[i, d] * work.slopes[i, d]
            first += work.slopes[i, d] ** 2
            second += jacobian[i, d] ** 2
            work.slopes[i, d] = jacobian[i, d]
        if held[i] and max(first, second) > FLAT**2:
            over = over or along < TURNED * np.sqrt(first * second)
    return over


@njit(inline="always", **COMPILE)
def is_free(space, first, second, work):
    """Whether the straight joint line between two configurations touches nothing."""
    return space.clearance.top == 0 or stays_clear(
        space.chain, space.clearance, first, second, work.contacts
    )


@njit(**LEAF)
def project_node(space, q, settings, work):
    """Gauss-Newton of one configuration onto constraint, joint limits and clearance together, in
    place; returns what remains [rad or m].  settings: a Retraction.
    """
    rows, right, normal, squares = work.rows, work.right, work.normal, work.squares
    worst, held = np.inf, np.sum(space.constraint.rows.held)
    for iteration in range(settings.iterations + 1):
        size, worst, own = _broken(space, q, work)
        if worst <= settings.accuracy or size == 0 or iteration == settings.iterations:
            break
        ridge = settings.damping * normal_matrix(rows, size, normal)
        for i in range(size):
            normal[i, i] += ridge
        if not solve_normal(normal, size, right, _SMALLEST_PIVOT):
            break
        # stored, so that the sum's last bit does not hang on how the loop is compiled
        for d in range(q.shape[0]):
            value = 0.0
            for i in range(size):
                value += rows[i, d] * right[i]
            squares[d] = value * value
        square = 0.0
        for d in range(q.shape[0]):
            square += squares[d]
        longest = settings.largest_step
        scale = 1.0 if square <= longest**2 else longest / np.sqrt(square)
        for d in range(q.shape[0]):
            for i in range(size):
                q[d] -= scale * rows[i, d] * right[i]
        # what such a step moves bodies by, some 0.01 mm, is far below the margin and not looked at
        if square < settings.last_step**2 and size == own == held and _keeps_limits(space, q):
            left = left_by(square, ridge, right, size)
            if left <= settings.accuracy:
                return left
    return worst


@njit(**LEAF)
def _keeps_limits(space, q):
    for d in range(q.shape[0]):
        if q[d] < space.limits[0, d] or q[d] > space.limits[1, d]:
            return False
    return True


@njit(**LEAF)
def _is_within(space, q, work):
    """Whether a configuration keeps joint limits and clearance."""
    if not _keeps_limits(space, q):
        return False
    if space.clearance.top == 0:
        return True
    contacts = work.contacts
    near = near_contacts(space.chain, space.clearance, q, 2.0 * space.margin, contacts)
    return near == 0 or contacts.found[0, DISTANCE] >= space.margin - SHORT


@njit(**LEAF)
def project_all(space, points, shares, settings, left, work):
    """Project points (T, D) in place: onto the constraint alone, which is cheap, and onto limits
    and clearance together with it only where one of them is broken then; returns what remains of
    the violation of the worst [rad or m].

    shares, left (T,): as `retract_all` takes them.
    """
    manifold = ManifoldArrays(space.chain, space.constraint)
    retract_all(manifold, shares, points, settings, left, work.retraction)
    worst = 0.0
    for i in range(points.shape[0]):
        if shares[i] >= 0.0 and not _is_within(space, points[i], work):
            left[i] = project_node(space, points[i], space.projection, work)
        worst = max(worst, left[i])
    return worst


@njit(**COMPILE)
def project_points(space, points, open_ones, settings):
    """`project_all` of those points (T, D) that are marked (T,), in room of its own."""
    shares = np.where(open_ones, 1.0, -1.0)
    return project_all(space, points, shares, settings, np.empty(len(points)), workspace(space))
