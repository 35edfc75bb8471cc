"""The configurations that a search may use: on the constraint, within the joint limits, clear of
the workcell.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numba import njit

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.kernels import COMPILE, excess_of, linearise, scratch
from constraint_geodesics.constraints.projection import normal_matrix, solve_normal
from constraint_geodesics.robot.kinematics import ChainArrays
from constraint_geodesics.scene.clearance import (
    ClearanceArrays,
    ClearanceModel,
    clearance_row,
    link_clearances,
    no_clearance,
)

NEAR = 0.05
"""Bounds so near [rad or m] are looked at."""
_REACHED = 1e-9
_LONGEST_STEP = 0.6
_RIDGE = 1e-9
_SMALLEST_PIVOT = 1e-12


class Space(NamedTuple):
    """As the compiled search takes it.  constraint: of `Constraint.arrays`; limits (2, D): lower
    and upper [rad or m]; margin: kept to the workcell's shapes [m].
    """

    chain: ChainArrays
    constraint: Any
    limits: Float[np.ndarray, "2 D"]
    clearance: ClearanceArrays
    margin: float


def space_of(
    manifold: ConstraintManifold, clearance: ClearanceModel | None = None, margin_m: float = 0.0
) -> Space:
    """The space of a constraint manifold, by default in an empty workcell."""
    robot = manifold.robot
    model = no_clearance(robot.dof) if clearance is None else clearance
    limits = np.stack([robot.lower, robot.upper])
    return Space(*manifold.arrays, limits, model.arrays, margin_m)


class Links(NamedTuple):
    """Of the links that each joint carries: distance (D,) [m] to the nearest shape, the direction
    (D, 3) away from it and the nearest point (D, 3), in the base frame; joint origins and axes (D,
    3).
    """

    distances: np.ndarray
    normals: np.ndarray
    nearest: np.ndarray
    origins: np.ndarray
    axes: np.ndarray


class Workspace(NamedTuple):
    """What the kernels write into, allocated once.

    constraint: what its kind needs; residual, excess, active, weights (m,) and jacobian (m, D) of
    its rows; links; rows, normal, left (D, D); right, squares (D,).
    """

    constraint: Any
    residual: np.ndarray
    excess: np.ndarray
    active: np.ndarray
    weights: np.ndarray
    jacobian: np.ndarray
    links: Links
    rows: np.ndarray
    normal: np.ndarray
    left: np.ndarray
    right: np.ndarray
    squares: np.ndarray


@njit(**COMPILE)
def workspace(space):
    """A workspace for the kernels of this space."""
    dof, count = space.limits.shape[1], space.constraint.rows.held.shape[0]
    links = Links(
        np.empty(dof),
        np.empty((dof, 3)),
        np.empty((dof, 3)),
        np.empty((dof, 3)),
        np.empty((dof, 3)),
    )
    return Workspace(
        scratch(space.constraint, dof),
        np.zeros(count),
        np.zeros(count),
        np.zeros(count, dtype=np.bool_),
        np.zeros(count),
        np.zeros((count, dof)),
        links,
        np.empty((dof, dof)),
        np.empty((dof, dof)),
        np.empty((dof, dof)),
        np.empty(dof),
        np.empty(dof),
    )


@njit(**COMPILE)
def measure_links(space, q, links):
    """The links of one configuration, as far as they are near."""
    link_clearances(
        space.chain,
        space.clearance,
        space.margin + NEAR,
        q,
        links.distances,
        links.normals,
        links.nearest,
        links.origins,
        links.axes,
    )


@njit(**COMPILE)
def link_row(space, link, links, row):
    """Gradient (D,) of the distance of the links that a joint carries."""
    clearance_row(
        space.chain.prismatic, link, links.normals, links.nearest, links.origins, links.axes, row
    )


@njit(**COMPILE)
def _broken(space, q, work):
    """What one configuration breaks, into `work.rows` and `work.right`: the number of rows, and the
    worst [rad or m].
    """
    dof, limits = q.shape[0], space.limits
    rows, right, links = work.rows, work.right, work.links
    residual, jacobian, excess, active = work.residual, work.jacobian, work.excess, work.active
    linearise(space, q, work.constraint, residual, jacobian)
    worst = excess_of(space.constraint.rows, residual, excess, active)
    size = 0
    for i in range(residual.shape[0]):
        if active[i] and size < dof:
            right[size] = excess[i]
            for d in range(dof):
                rows[size, d] = jacobian[i, d]
            size += 1
    for d in range(dof):
        over = q[d] - limits[1, d] if q[d] > limits[1, d] else min(q[d] - limits[0, d], 0.0)
        if over != 0.0:
            worst = max(worst, abs(over))
            if size < dof:
                right[size] = over
                rows[size] = 0.0
                rows[size, d] = 1.0
                size += 1
    if space.clearance.points.shape[0] > 0:
        measure_links(space, q, links)
        distances, margin = links.distances, space.margin
        for d in range(dof):
            short = margin - distances[d]
            if short > 0.0:
                worst = max(worst, short)
                if size < dof:
                    link_row(space, d, links, rows[size])
                    right[size] = -short
                    size += 1
    return size, worst


@njit(**COMPILE)
def project_node(space, q, iterations, work):
    """Gauss-Newton of one configuration onto constraint, joint limits and clearance together, in
    place; returns what remains [rad or m].
    """
    rows, right, normal, squares = work.rows, work.right, work.normal, work.squares
    worst = np.inf
    for iteration in range(iterations + 1):
        size, worst = _broken(space, q, work)
        if worst <= _REACHED or iteration == iterations:
            break
        trace = normal_matrix(rows, size, normal)
        for i in range(size):
            normal[i, i] += _RIDGE * trace
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
        scale = 1.0 if square <= _LONGEST_STEP**2 else _LONGEST_STEP / np.sqrt(square)
        for d in range(q.shape[0]):
            for i in range(size):
                q[d] -= scale * rows[i, d] * right[i]
    return worst


@njit(**COMPILE)
def project_each(space, points, iterations):
    """Project points (T, D) in place; returns what remains of the violation of the worst."""
    work = workspace(space)
    worst = 0.0
    for i in range(points.shape[0]):
        worst = max(worst, project_node(space, points[i], iterations, work))
    return worst
