"""Compiled elastic band: Newton's method for the shortest chain of points on a constraint manifold.

With nodes q_0 … q_n, the ends fixed, the energy E = ½ Σ ‖q_{i+1} − q_i‖² is minimised subject to
c_j(q_i) = 0 for the rows that are held exactly and c_j(q_i) ≤ 0 for tolerances and joint limits.
At a node the rows C = ∂c/∂q that are active give an orthonormal basis N of their null space; with
e_i = 2 q_i − q_{i−1} − q_{i+1} and multipliers λ_i = −(C Cᵀ)⁻¹ C e_i, the reduced problem has the
gradient Nᵀe and the block-tridiagonal Hessian

    H_ii = Nᵀ (2 + Σ_j λ_j ∇²c_j) N,   H_i,i+1 = −N_iᵀ N_{i+1}.

The curvature term Σ λ_j ∇²c_j is what makes the step one of second order; it is taken by finite
differences of Cᵀλ along N, so that any residual with a Jacobian will do.
"""

import numpy as np
from numba import njit

from constraint_geodesics.constraints.kernels import (
    backward,
    cholesky,
    excess_of,
    forward,
    residual_of,
    residual_row,
    shared_tolerance,
)
from constraint_geodesics.robot.kernels import geometric_jacobian, pose_of
from constraint_geodesics.scene.clearance import clearance_row, link_clearances

_COMPILE = {"cache": True, "fastmath": {"contract"}, "error_model": "numpy", "nogil": True}
_TOUCHING = 1e-9
_DIFFERENCE = 1e-5
_SMALLEST_PIVOT = 1e-12
_BESIDE = 1e-6  # an inequality so near is on its bound
# an inequality so near [rad or m] is taken into the step, which then ends on it, not beyond
_NEAR = 0.05
_RESIDUAL, _EXCESS, _ACTIVE, _WEIGHTS = range(4)
(
    _DISTANCES,
    _KINDS,
    _SIGNS,
    _LET_GO,
    _MULTIPLIERS,
    _LINK_WEIGHTS,
    _HERE,
    _THERE,
    _MOVED,
    _ROW,
    _SLACK,
) = range(11)
_ROWS, _NORMAL, _LEFT = range(3)


@njit(**_COMPILE)
def workspace(dof):
    """What the kernels write into, allocated once: few arrays, since each costs time to compile and
    to pass on.

    The tool's position and rotation (4, 3); joint origins and axes (2, D, 3); ω to orientation
    residual (3, 3); residual, excess, active rows, weights (4, 6); geometric Jacobian and that of
    the residual (2, 6, D); normals and nearest points of the links (2, D, 3); vectors (11, D),
    named by the constants above; matrices (3, D, D).
    """
    return (
        np.empty((4, 3)),
        np.empty((2, dof, 3)),
        np.empty((3, 3)),
        np.empty((4, 6)),
        np.empty((2, 6, dof)),
        np.empty((2, dof, 3)),
        np.empty((11, dof)),
        np.empty((3, dof, dof)),
    )


@njit(**_COMPILE)
def _linearise(chain, held, reference_position, reference_rotation, q, work):
    """Residual (6,) and its Jacobian (6, D) of one configuration, into the workspace."""
    origins, axes, prismatic, base, tool = chain
    frame, carried, linear, sixes, jacobians = work[0], work[1], work[2], work[3], work[4]
    geometric, jacobian = jacobians[0], jacobians[1]
    pose_of(origins, axes, prismatic, base, tool, q, frame[0], frame[1:], carried[0], carried[1])
    residual_of(
        held, reference_position, reference_rotation, frame[0], frame[1:], sixes[_RESIDUAL], linear
    )
    geometric_jacobian(prismatic, frame[0], carried[0], carried[1], geometric)
    for i in range(6):
        if held[i]:
            residual_row(i, linear, geometric, jacobian, i)


@njit(**_COMPILE)
def project_node(space, q, iterations, work):
    """Gauss-Newton of one configuration onto constraint and joint limits together, in place;
    returns what remains.
    """
    dof = q.shape[0]
    chain, held, tolerance, reference_position, reference_rotation, limits, model, margin = space
    carried, sixes, links, vectors, matrices = work[1], work[3], work[5], work[6], work[7]
    excess, active, jacobian = sixes[_EXCESS], sixes[_ACTIVE], work[4][1]
    distances, right, rows, normal = (
        vectors[_DISTANCES],
        vectors[_MULTIPLIERS],
        matrices[_ROWS],
        matrices[_NORMAL],
    )
    worst = np.inf
    for iteration in range(iterations + 1):
        _linearise(chain, held, reference_position, reference_rotation, q, work)
        worst = excess_of(held, tolerance, sixes[_RESIDUAL], excess, active)
        size = 0
        for i in range(6):
            if active[i] != 0.0 and size < dof:
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
        if model[0].shape[0] > 0:
            link_clearances(
                chain,
                model,
                margin + _NEAR,
                q,
                distances,
                links[0],
                links[1],
                carried[0],
                carried[1],
            )
            for d in range(dof):
                short = margin - distances[d]
                if short > 0.0:
                    worst = max(worst, short)
                    if size < dof:
                        clearance_row(
                            chain[2], d, links[0], links[1], carried[0], carried[1], rows[size]
                        )
                        right[size] = -short
                        size += 1
        if worst <= _TOUCHING or iteration == iterations:
            break
        trace = 0.0
        for i in range(size):
            for j in range(i + 1):
                value = 0.0
                for d in range(dof):
                    value += rows[i, d] * rows[j, d]
                normal[i, j] = value
            trace += normal[i, i]
        for i in range(size):
            normal[i, i] += 1e-9 * trace
        if not cholesky(normal, size, _SMALLEST_PIVOT):
            break
        forward(normal, size, right)
        backward(normal, size, right)
        length = 0.0
        for d in range(dof):
            value = 0.0
            for i in range(size):
                value += rows[i, d] * right[i]
            length += value * value
        scale = 1.0 if length <= 0.36 else 0.6 / np.sqrt(length)
        for d in range(dof):
            for i in range(size):
                q[d] -= scale * rows[i, d] * right[i]
    return worst


@njit(**_COMPILE)
def _weighted_gradient(space, q, weights, cone_weight, link_weights, work, out):
    """Σ_j λ_j ∇c_j of one configuration: weights (6,) of the residual's rows, of the cone's size,
    and (D,) of the links' clearances.
    """
    chain, held, _, reference_position, reference_rotation, _, model, margin = space
    _linearise(chain, held, reference_position, reference_rotation, q, work)
    residual, jacobian = work[3][_RESIDUAL], work[4][1]
    out[:] = 0.0
    size = np.sqrt(residual[3] ** 2 + residual[4] ** 2 + residual[5] ** 2)
    for i in range(6):
        if not held[i]:
            continue
        weight = weights[i]
        if i >= 3 and cone_weight != 0.0 and size > 0.0:
            weight += cone_weight * residual[i] / size
        if weight != 0.0:
            for d in range(q.shape[0]):
                out[d] += weight * jacobian[i, d]
    if not link_weights.any():
        return
    carried, links, distances, row = work[1], work[5], work[6][_DISTANCES], work[6][_ROW]
    link_clearances(
        chain, model, margin + _NEAR, q, distances, links[0], links[1], carried[0], carried[1]
    )
    for link in range(q.shape[0]):
        if link_weights[link] != 0.0:
            clearance_row(chain[2], link, links[0], links[1], carried[0], carried[1], row)
            for d in range(q.shape[0]):
                out[d] -= link_weights[link] * row[d]


@njit(**_COMPILE)
def _has_closed_form(held, tolerance, prismatic, weights):
    """Whether `_closed_curvature` knows all rows that count: positions, and two or three angles
    held exactly.
    """
    angles, exact = 0, True
    for i in range(3, 6):
        if held[i]:
            angles += 1
            exact = exact and tolerance[i] == 0.0
    if (weights[3] != 0.0 or weights[4] != 0.0 or weights[5] != 0.0) and (angles < 2 or not exact):
        return False
    return not prismatic.any()


@njit(**_COMPILE)
def _closed_curvature(held, weights, dof, count, basis, hessian, work):
    """Add Nᵀ (Σ λ_j ∇²c_j) N on the constraint, with the joints' axes a and origins o in the base
    frame, i ≤ j: ∂²p/∂q_i∂q_j = a_i × (a_j × (p − o_j)); of a rotation vector ½ a_i × a_j; of the
    swing e_k × (a_i × (a_j × e_k)).
    """
    position, joint_origins, joint_axes, full = work[0][0], work[1][0], work[1][1], work[7][_NORMAL]
    l0, l1, l2 = weights[3], weights[4], weights[5]
    free = -1
    for i in range(3, 6):
        if not held[i]:
            free = i - 3
    angles = held[3] or held[4] or held[5]
    w0, w1, w2 = 1.0 * (free == 0), 1.0 * (free == 1), 1.0 * (free == 2)
    # λ·(e_k × v) = (λ × e_k)·v
    c0, c1, c2 = l1 * w2 - l2 * w1, l2 * w0 - l0 * w2, l0 * w1 - l1 * w0
    for j in range(dof):
        b0, b1, b2 = joint_axes[j, 0], joint_axes[j, 1], joint_axes[j, 2]
        x, y, z = (
            position[0] - joint_origins[j, 0],
            position[1] - joint_origins[j, 1],
            position[2] - joint_origins[j, 2],
        )
        p0, p1, p2 = b1 * z - b2 * y, b2 * x - b0 * z, b0 * y - b1 * x
        s0, s1, s2 = b1 * w2 - b2 * w1, b2 * w0 - b0 * w2, b0 * w1 - b1 * w0
        for i in range(j + 1):
            a0, a1, a2 = joint_axes[i, 0], joint_axes[i, 1], joint_axes[i, 2]
            value = (
                weights[0] * (a1 * p2 - a2 * p1)
                + weights[1] * (a2 * p0 - a0 * p2)
                + weights[2] * (a0 * p1 - a1 * p0)
            )
            if angles and free >= 0:
                value += (
                    c0 * (a1 * s2 - a2 * s1) + c1 * (a2 * s0 - a0 * s2) + c2 * (a0 * s1 - a1 * s0)
                )
            elif angles and i < j:
                value += 0.5 * (
                    l0 * (a1 * b2 - a2 * b1) + l1 * (a2 * b0 - a0 * b2) + l2 * (a0 * b1 - a1 * b0)
                )
            full[i, j] = full[j, i] = value
    for k in range(count):
        for i in range(dof):
            value = 0.0
            for d in range(dof):
                value += full[i, d] * basis[d, k]
            for j in range(k + 1):
                add = value * basis[i, j]
                hessian[k, j] += add
                if j < k:
                    hessian[j, k] += add


@njit(**_COMPILE)
def _node(space, q, pull, basis, hessian, onto, work):
    """Null space `basis` (D, k) of the active rows at q and the reduced Hessian (k, k); returns k.

    pull: e = 2 q_i − q_{i−1} − q_{i+1} (D,).  An inequality whose multiplier would hold the node
    back is let go.
    onto (D,): the shortest step that ends on the inequalities that are kept.
    """
    dof = q.shape[0]
    chain, held, tolerance, reference_position, reference_rotation, limits, model, margin = space
    carried, sixes, links, vectors, matrices = work[1], work[3], work[5], work[6], work[7]
    residual, jacobian = sixes[_RESIDUAL], work[4][1]
    common = shared_tolerance(held, tolerance)
    cone = common > 0.0  # the size of the angles' vector is bounded, not each angle
    # kinds: 0-5 a residual's row, 6 the cone, 7 a joint limit, 8 + d a link; free: an inequality,
    # which may be let go
    kinds, signs, free, multipliers = (
        vectors[_KINDS],
        vectors[_SIGNS],
        vectors[_LET_GO],
        vectors[_MULTIPLIERS],
    )
    rows, normal, slack = matrices[_ROWS], matrices[_NORMAL], vectors[_SLACK]
    here = vectors[_HERE]
    onto[:] = 0.0
    _linearise(chain, held, reference_position, reference_rotation, q, work)
    size = 0
    for i in range(6):
        if not held[i] or (cone and i >= 3):
            continue
        if tolerance[i] > 0.0 and abs(residual[i]) < tolerance[i] - _NEAR:
            continue
        sign = -1.0 if tolerance[i] > 0.0 and residual[i] < 0.0 else 1.0
        if size < dof:
            for d in range(dof):
                rows[size, d] = sign * jacobian[i, d]
            kinds[size], signs[size], free[size] = i, sign, tolerance[i] > 0.0
            slack[size] = tolerance[i] - abs(residual[i]) if tolerance[i] > 0.0 else 0.0
            size += 1
    if cone:
        length = np.sqrt(residual[3] ** 2 + residual[4] ** 2 + residual[5] ** 2)
        if length >= common - _NEAR and length > 1e-3 and size < dof:
            rows[size] = 0.0
            for i in range(3, 6):
                if held[i]:
                    for d in range(dof):
                        rows[size, d] += residual[i] / length * jacobian[i, d]
            kinds[size], signs[size], free[size], slack[size] = 6, 1.0, True, common - length
            size += 1
    for d in range(dof):
        side = (
            1.0 if q[d] >= limits[1, d] - _NEAR else (-1.0 if q[d] <= limits[0, d] + _NEAR else 0.0)
        )
        if side != 0.0 and size < dof:
            rows[size] = 0.0
            rows[size, d] = side
            kinds[size], signs[size], free[size] = 7, side, True
            slack[size] = limits[1, d] - q[d] if side > 0.0 else q[d] - limits[0, d]
            size += 1
    if model[0].shape[0] > 0:
        distances = vectors[_DISTANCES]
        link_clearances(
            chain, model, margin + _NEAR, q, distances, links[0], links[1], carried[0], carried[1]
        )
        for d in range(dof):
            if size < dof and distances[d] <= margin + _NEAR:
                clearance_row(chain[2], d, links[0], links[1], carried[0], carried[1], rows[size])
                for j in range(dof):
                    rows[size, j] = -rows[size, j]
                kinds[size], signs[size], free[size] = 8 + d, 1.0, True
                slack[size] = distances[d] - margin
                size += 1
    while size > 0:
        for i in range(size):
            value = 0.0
            for d in range(dof):
                value -= rows[i, d] * pull[d]
            multipliers[i] = value
            for j in range(i + 1):
                value = 0.0
                for d in range(dof):
                    value += rows[i, d] * rows[j, d]
                normal[i, j] = value
            normal[i, i] += 1e-9
        if not cholesky(normal, size, _SMALLEST_PIVOT):
            break
        forward(normal, size, multipliers)
        backward(normal, size, multipliers)
        # one that is near is kept only if the pull leads beyond it; on its bound, unless the pull
        # leads away
        worst, weakest = -1, -1e-12
        for i in range(size):
            surplus = multipliers[i] - (slack[i] if slack[i] > _BESIDE else 0.0)
            if free[i] != 0.0 and surplus < weakest:
                worst, weakest = i, surplus
        if worst < 0:
            for i in range(size):
                here[i] = slack[i]
            forward(normal, size, here)
            backward(normal, size, here)
            for d in range(dof):
                for i in range(size):
                    onto[d] += rows[i, d] * here[i]
            break
        for i in range(worst, size - 1):
            for d in range(dof):
                rows[i, d] = rows[i + 1, d]
            kinds[i], signs[i], free[i], slack[i] = (
                kinds[i + 1],
                signs[i + 1],
                free[i + 1],
                slack[i + 1],
            )
        size -= 1
    # null space: orthonormal rows first, then what is left of the unit vectors, the longest first
    rank = 0
    for i in range(size):
        for j in range(rank):
            value = 0.0
            for d in range(dof):
                value += rows[i, d] * rows[j, d]
            for d in range(dof):
                rows[i, d] -= value * rows[j, d]
        length = 0.0
        for d in range(dof):
            length += rows[i, d] ** 2
        length = np.sqrt(length)
        if length > 1e-7:
            for d in range(dof):
                rows[rank, d] = rows[i, d] / length
            rank += 1
    left = matrices[_LEFT]
    left[:, :] = 0.0
    for a in range(dof):
        left[a, a] = 1.0
    for i in range(rank):
        for a in range(dof):
            value = rows[i, a]
            for d in range(dof):
                left[a, d] -= value * rows[i, d]
    count = dof - rank
    for k in range(count):
        best, longest = 0, -1.0
        for a in range(dof):
            value = 0.0
            for d in range(dof):
                value += left[a, d] ** 2
            if value > longest:
                best, longest = a, value
        scale = 1.0 / np.sqrt(longest)
        for d in range(dof):
            basis[d, k] = left[best, d] * scale
        for a in range(dof):
            value = 0.0
            for d in range(dof):
                value += left[a, d] * basis[d, k]
            for d in range(dof):
                left[a, d] -= value * basis[d, k]
    weights, link_weights = sixes[_WEIGHTS], vectors[_LINK_WEIGHTS]
    there, moved = vectors[_THERE], vectors[_MOVED]
    weights[:] = 0.0
    link_weights[:] = 0.0
    cone_weight = 0.0
    curved = False
    for i in range(size):
        kind = int(kinds[i])
        if kind < 6:
            weights[kind] = multipliers[i] * signs[i]
            curved = True
        elif kind == 6:
            cone_weight = multipliers[i]
            curved = True
        elif kind >= 8:
            link_weights[kind - 8] = multipliers[i]
            curved = True
    for k in range(count):
        for j in range(count):
            hessian[k, j] = 2.0 if k == j else 0.0
    if not curved:
        return count
    if (
        cone_weight == 0.0
        and not link_weights.any()
        and _has_closed_form(held, tolerance, chain[2], weights)
    ):
        _closed_curvature(held, weights, dof, count, basis, hessian, work)
        return count
    _weighted_gradient(space, q, weights, cone_weight, link_weights, work, here)
    for k in range(count):
        for d in range(dof):
            moved[d] = q[d] + _DIFFERENCE * basis[d, k]
        _weighted_gradient(space, moved, weights, cone_weight, link_weights, work, there)
        for j in range(count):
            value = 0.0
            for d in range(dof):
                value += (there[d] - here[d]) * basis[d, j]
            # half to either side: the matrix is symmetric but for rounding and the differences'
            # error
            hessian[k, j] += 0.5 * value / _DIFFERENCE
            hessian[j, k] += 0.5 * value / _DIFFERENCE
    return count


@njit(**_COMPILE)
def _newton(bases, counts, hessians, gradients, shift, steps):
    """Solve the block-tridiagonal system for `steps` (m, D); False where it is not positive
    definite.

    bases (m, D, D), counts (m,), hessians (m, D, D), gradients (m, D) of the m inner nodes.
    """
    m, dof = gradients.shape
    factors = np.empty((m, dof, dof))
    couplings = np.zeros((m, dof, dof))  # L_{i+1,i}: of node i + 1 to node i
    right = -gradients
    for i in range(m):
        size = counts[i]
        for a in range(size):
            for b in range(size):
                factors[i, a, b] = hessians[i, a, b]
            factors[i, a, a] += shift
        if i > 0:
            before = counts[i - 1]
            for a in range(size):
                for b in range(before):
                    value = 0.0
                    for d in range(dof):
                        value -= bases[i, d, a] * bases[i - 1, d, b]
                    couplings[i, a, b] = value
                forward(factors[i - 1], before, couplings[i, a])
            for a in range(size):
                for b in range(size):
                    value = 0.0
                    for c in range(before):
                        value += couplings[i, a, c] * couplings[i, b, c]
                    factors[i, a, b] -= value
                for c in range(before):
                    right[i, a] -= couplings[i, a, c] * right[i - 1, c]
        if not cholesky(factors[i], size, _SMALLEST_PIVOT):
            return False
        forward(factors[i], size, right[i])
    for i in range(m - 1, -1, -1):
        size = counts[i]
        if i < m - 1:
            for a in range(size):
                for b in range(counts[i + 1]):
                    right[i, a] -= couplings[i + 1, b, a] * right[i + 1, b]
        backward(factors[i], size, right[i])
        for d in range(dof):
            value = 0.0
            for a in range(size):
                value += bases[i, d, a] * right[i, a]
            steps[i, d] = value
    return True


@njit(**_COMPILE)
def band_energy(nodes):
    """E = ½ Σ ‖q_{i+1} − q_i‖²."""
    total = 0.0
    for i in range(nodes.shape[0] - 1):
        for d in range(nodes.shape[1]):
            total += 0.5 * (nodes[i + 1, d] - nodes[i, d]) ** 2
    return total


@njit(**_COMPILE)
def pull_of(nodes, i, d):
    """Component d of e_i = 2 q_i − q_{i−1} − q_{i+1}."""
    return 2.0 * nodes[i, d] - nodes[i - 1, d] - nodes[i + 1, d]


@njit(**_COMPILE)
def relax_band(space, nodes, iterations, accuracy, largest):
    """Shorten a band (n + 1, D) in place; returns (what remains of the violation, iterations used,
    converged).

    accuracy: relative decrease of the energy predicted by Newton's step below which the band has
    converged.
    largest: longest step of a node [rad].
    """
    n, dof = nodes.shape[0] - 1, nodes.shape[1]
    m = n - 1
    work = workspace(dof)
    bases, hessians = np.zeros((m, dof, dof)), np.zeros((m, dof, dof))
    counts = np.zeros(m, dtype=np.int64)
    gradients, steps, onto = np.zeros((m, dof)), np.zeros((m, dof)), np.zeros((m, dof))
    pull = np.empty(dof)
    trial = nodes.copy()
    worst = 0.0
    for i in range(1, n):
        left = project_node(space, nodes[i], 8, work)
        worst = max(worst, left)
    energy = band_energy(nodes)
    used = 0
    converged = False
    for _ in range(iterations):
        used += 1
        for i in range(m):
            for d in range(dof):
                pull[d] = 2.0 * nodes[i + 1, d] - nodes[i, d] - nodes[i + 2, d]
            counts[i] = _node(space, nodes[i + 1], pull, bases[i], hessians[i], onto[i], work)
        for i in range(m):
            for d in range(dof):
                pull[d] = 2.0 * (nodes[i + 1, d] + onto[i, d]) - nodes[i, d] - nodes[i + 2, d]
                if i > 0:
                    pull[d] -= onto[i - 1, d]
                if i < m - 1:
                    pull[d] -= onto[i + 1, d]
            for a in range(counts[i]):
                value = 0.0
                for d in range(dof):
                    value += bases[i, d, a] * pull[d]
                gradients[i, a] = value
        shift = 0.0
        while not _newton(bases, counts, hessians, gradients, shift, steps):
            shift = 0.02 if shift == 0.0 else 4.0 * shift
            if shift > 1e4:
                return worst, used, False
        promised = 0.0
        longest = 0.0
        for i in range(m):
            square = 0.0
            for a in range(counts[i]):
                value = 0.0
                for d in range(dof):
                    value += bases[i, d, a] * steps[i, d]
                promised -= 0.5 * gradients[i, a] * value
            for d in range(dof):
                steps[i, d] += onto[i, d]
                square += steps[i, d] ** 2
                promised += abs(pull_of(nodes, i + 1, d) * onto[i, d])
            longest = max(longest, np.sqrt(square))
        if promised <= accuracy * energy:
            converged = True
            if longest > 0.05:
                break
        scale = 1.0 if longest <= largest else largest / longest
        improved = False
        for _ in range(6):
            left_over = 0.0
            for i in range(1, n):
                for d in range(dof):
                    trial[i, d] = nodes[i, d] + scale * steps[i - 1, d]
                left = project_node(space, trial[i], 6, work)
                left_over = max(left_over, left)
            after = band_energy(trial)
            if after < energy and left_over <= max(worst, 1e-6):
                improved = True
                break
            scale *= 0.4
        if not improved:
            break
        nodes[:, :] = trial
        energy = after
        worst = left_over
        if converged:
            break
    return worst, used, converged


@njit(**_COMPILE)
def project_rows(space, rows, iterations):
    """Project rows (T, D) in place; returns what remains of the violation of the worst."""
    work = workspace(rows.shape[1])
    worst = 0.0
    for i in range(rows.shape[0]):
        worst = max(worst, project_node(space, rows[i], iterations, work))
    return worst


@njit(**_COMPILE)
def spline_moments(knots, nodes):
    """Second derivatives (n + 1, D) of the cubic spline through nodes at rising knots, not-a-knot
    at both ends.
    """
    n, dof = nodes.shape[0] - 1, nodes.shape[1]
    moments = np.zeros((n + 1, dof))
    if n < 3:
        return moments
    above, below = np.empty(n), np.empty(n)
    h = np.diff(knots)
    # h_{i−1} M_{i−1} + 2 (h_{i−1} + h_i) M_i + h_i M_{i+1} = 6 (slope_i − slope_{i−1}) for 0 < i <
    # n, with M_0 and M_n from the third derivative's continuity at knots 1 and n − 1
    for i in range(1, n):
        diagonal, lower, upper = 2.0 * (h[i - 1] + h[i]), h[i - 1], h[i]
        if i == 1:
            diagonal += h[0] * (1.0 + h[0] / h[1])
            upper -= h[0] * h[0] / h[1]
            lower = 0.0
        if i == n - 1:
            diagonal += h[n - 1] * (1.0 + h[n - 1] / h[n - 2])
            lower -= h[n - 1] * h[n - 1] / h[n - 2]
            upper = 0.0
        factor = lower / below[i - 1] if i > 1 else 0.0
        below[i] = diagonal - (factor * above[i - 1] if i > 1 else 0.0)
        above[i] = upper
        for d in range(dof):
            right = 6.0 * (
                (nodes[i + 1, d] - nodes[i, d]) / h[i] - (nodes[i, d] - nodes[i - 1, d]) / h[i - 1]
            )
            moments[i, d] = right - (factor * moments[i - 1, d] if i > 1 else 0.0)
    for i in range(n - 1, 0, -1):
        for d in range(dof):
            if i < n - 1:
                moments[i, d] -= above[i] * moments[i + 1, d]
            moments[i, d] /= below[i]
    for d in range(dof):
        moments[0, d] = moments[1, d] + h[0] / h[1] * (moments[1, d] - moments[2, d])
        moments[n, d] = moments[n - 1, d] + h[n - 1] / h[n - 2] * (
            moments[n - 1, d] - moments[n - 2, d]
        )
    return moments


@njit(**_COMPILE)
def spline_points(knots, nodes, moments, at, points):
    """Points (T, D) of the spline at rising parameters (T,)."""
    i = 0
    for k in range(at.shape[0]):
        while i < knots.shape[0] - 2 and at[k] > knots[i + 1]:
            i += 1
        h = knots[i + 1] - knots[i]
        b = (at[k] - knots[i]) / h
        a = 1.0 - b
        for d in range(nodes.shape[1]):
            bend = (a * a * a - a) * moments[i, d] + (b * b * b - b) * moments[i + 1, d]
            points[k, d] = a * nodes[i, d] + b * nodes[i + 1, d] + bend * h * h / 6.0
