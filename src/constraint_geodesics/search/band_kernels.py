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

from typing import NamedTuple

import numpy as np
from numba import njit

from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.constraints.kernels import (
    Looked,
    backward,
    cholesky,
    curvature,
    forward,
    linearise,
    new_look,
    shared_tolerance,
)
from constraint_geodesics.constraints.projection import normal_matrix
from constraint_geodesics.robot.kernels import LANES
from constraint_geodesics.scene.clearance import Contacts, Nearby, new_contacts
from constraint_geodesics.search.push_kernels import Push, new_push, new_samples, penalise
from constraint_geodesics.search.space import (
    NEAR,
    Workspace,
    is_free,
    look_at,
    project_all,
    workspace,
)

_DIFFERENCE = 1e-5
_SMALLEST_PIVOT = 1e-12
_ON_BOUND = 1e-6  # an inequality so near is on its bound; one that is NEAR is taken into the step,
# which then ends on it, not beyond
_LEAST_CONE = 1e-3
_DEPENDENT = 1e-7
"""A row so short beside those before it adds nothing to them."""


class _Active(NamedTuple):
    """The rows (D, D) of a node that count: what each is of, its sign, whether it is an inequality,
    which may be let go, how far its bound is away, and its multiplier; (D,) each.

    of: i < m a row of the residual, m the rows that are bounded together, m + 1 a joint limit.
    """

    rows: np.ndarray
    of: np.ndarray
    signs: np.ndarray
    loose: np.ndarray
    slack: np.ndarray
    multipliers: np.ndarray


class _BandWork(NamedTuple):
    """What the kernels of a band write into: what is known of LANES nodes; here, there, moved,
    gradient (D,); the second derivatives full (D, D).
    """

    node: Workspace
    looked: Looked
    active: _Active
    here: np.ndarray
    there: np.ndarray
    moved: np.ndarray
    gradient: np.ndarray
    full: np.ndarray


@njit(**COMPILE)
def new_work(space):
    """What the kernels of a band in this space write into."""
    dof = space.limits.shape[1]
    node = workspace(space)
    active = _Active(
        node.rows,
        np.empty(dof, dtype=np.int64),
        np.empty(dof),
        np.empty(dof, dtype=np.bool_),
        np.empty(dof),
        np.empty(dof),
    )
    return _BandWork(
        node,
        new_look(space.constraint, dof),
        active,
        np.empty(dof),
        np.empty(dof),
        np.empty(dof),
        np.empty(dof),
        np.empty((dof, dof)),
    )


@njit(**LEAF)
def _size_together(bounds, residual):
    square = 0.0
    for i in range(residual.shape[0] - 1, -1, -1):
        if bounds.together[i]:
            square += residual[i] * residual[i]
    return np.sqrt(square)


@njit(**LEAF)
def _weighted_gradient(space, q, cone_weight, work, out):
    """Σ_j λ_j ∇c_j (D,) of one configuration: of the residual's rows, and of the size of those that
    are bounded together.
    """
    node, bounds = work.node, space.constraint.rows
    look_at(space, q, node)
    residual, jacobian = node.looked.residuals[0], node.looked.jacobians[0]
    out[:] = 0.0
    size = _size_together(bounds, residual)
    for i in range(residual.shape[0]):
        if not bounds.held[i]:
            continue
        weight = node.weights[i]
        if bounds.together[i] and cone_weight != 0.0 and size > 0.0:
            weight += cone_weight * residual[i] / size
        if weight != 0.0:
            for d in range(q.shape[0]):
                out[d] += weight * jacobian[i, d]


@njit(**LEAF)
def _gather(space, q, which, work):
    """The rows at q that count into `work.active`: exact ones, and inequalities that are near;
    returns how many.
    """
    dof, active, bounds = q.shape[0], work.active, space.constraint.rows
    residual, jacobian = work.looked.residuals[which], work.looked.jacobians[which]
    limits = space.limits
    rows, of, signs, loose, slack = (
        active.rows,
        active.of,
        active.signs,
        active.loose,
        active.slack,
    )
    count = residual.shape[0]
    common = shared_tolerance(bounds)
    cone = common > 0.0  # the size of the vector is bounded, not each entry
    size = 0
    for i in range(count):
        if not bounds.held[i] or (cone and bounds.together[i]):
            continue
        tolerance = bounds.tolerance[i]
        if tolerance > 0.0 and abs(residual[i]) < tolerance - NEAR:
            continue
        sign = -1.0 if tolerance > 0.0 and residual[i] < 0.0 else 1.0
        if size < dof:
            for d in range(dof):
                rows[size, d] = sign * jacobian[i, d]
            of[size], signs[size], loose[size] = i, sign, tolerance > 0.0
            slack[size] = tolerance - abs(residual[i]) if tolerance > 0.0 else 0.0
            size += 1
    if cone:
        length = _size_together(bounds, residual)
        if length >= common - NEAR and length > _LEAST_CONE and size < dof:
            rows[size] = 0.0
            for i in range(count):
                if bounds.together[i]:
                    for d in range(dof):
                        rows[size, d] += residual[i] / length * jacobian[i, d]
            of[size], signs[size], loose[size], slack[size] = count, 1.0, True, common - length
            size += 1
    for d in range(dof):
        side = (
            1.0 if q[d] >= limits[1, d] - NEAR else (-1.0 if q[d] <= limits[0, d] + NEAR else 0.0)
        )
        if side != 0.0 and size < dof:
            rows[size] = 0.0
            rows[size, d] = side
            of[size], signs[size], loose[size] = count + 1, side, True
            slack[size] = limits[1, d] - q[d] if side > 0.0 else q[d] - limits[0, d]
            size += 1
    return size


@njit(**LEAF)
def _let_go(active, size, gradient, normal, here, onto):
    """Drop inequalities, the worst first, until no multiplier would hold the node back; returns how
    many rows are left.

    onto (D,): the shortest step that ends on the inequalities that are kept.
    """
    dof = gradient.shape[0]
    rows, multipliers, slack, loose = (active.rows, active.multipliers, active.slack, active.loose)
    onto[:] = 0.0
    while size > 0:
        normal_matrix(rows, size, normal)
        for i in range(size):
            value = 0.0
            for d in range(dof):
                value -= rows[i, d] * gradient[d]
            multipliers[i] = value
            normal[i, i] += 1e-9
        if not cholesky(normal, size, _SMALLEST_PIVOT):
            break
        forward(normal, size, multipliers)
        backward(normal, size, multipliers)
        # one that is near is kept only if the gradient leads beyond it; on its bound, unless the
        # gradient leads away
        worst, weakest = -1, -1e-12
        for i in range(size):
            surplus = multipliers[i] - (slack[i] if slack[i] > _ON_BOUND else 0.0)
            if loose[i] and surplus < weakest:
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
            active.of[i], active.signs[i] = active.of[i + 1], active.signs[i + 1]
            loose[i], slack[i] = loose[i + 1], slack[i + 1]
        size -= 1
    return size


@njit(**LEAF)
def null_space(rows, size, basis):
    """Orthonormal basis (D, k) of the null space of the leading rows, which are overwritten;
    returns k.  By Householder's reflections I − v vᵀ with |v|² = 2.
    """
    dof, rank = rows.shape[1], 0
    for i in range(size):
        for j in range(rank):
            _reflect(rows[j], j, rows[i])
        square = 0.0
        for d in range(rank, dof):
            square += rows[i, d] * rows[i, d]
        length = np.sqrt(square)
        if length <= _DEPENDENT:
            continue
        head = abs(rows[i, rank]) + length
        scale = 1.0 / np.sqrt(length * head)
        first = scale * (head if rows[i, rank] > 0.0 else -head)
        for d in range(dof):
            rows[rank, d] = scale * rows[i, d] if d > rank else 0.0
        rows[rank, rank] = first
        rank += 1
    for k in range(dof - rank):
        column = basis[:, k]
        for d in range(dof):
            column[d] = 1.0 if d == rank + k else 0.0
        for j in range(rank - 1, -1, -1):
            _reflect(rows[j], j, column)
    return dof - rank


@njit(**LEAF)
def _reflect(v, first, x):
    """(I − v vᵀ) x in place, for v whose entries before the first are zero."""
    value = 0.0
    for d in range(first, x.shape[0]):
        value += v[d] * x[d]
    for d in range(first, x.shape[0]):
        x[d] -= value * v[d]


@njit(**LEAF)
def _weigh(active, size, work):
    """The multipliers as weights of the constraint's rows; returns the weight of the rows bounded
    together, and whether anything is curved.
    """
    weights, count = work.node.weights, work.node.weights.shape[0]
    weights[:] = 0.0
    cone_weight, curved = 0.0, False
    for i in range(size):
        of = active.of[i]
        if of < count:
            weights[of] = active.multipliers[i] * active.signs[i]
            curved = True
        elif of == count:
            cone_weight = active.multipliers[i]
            curved = True
    return cone_weight, curved


@njit(**LEAF)
def _add_reduced(full, basis, count, hessian, here):
    """Add Nᵀ F N to the leading (k, k) of `hessian`, F (D, D) symmetric, N the leading k columns of
    `basis`.
    """
    dof = full.shape[0]
    for k in range(count):
        for i in range(dof):
            here[i] = 0.0
            for d in range(dof):
                here[i] += full[i, d] * basis[d, k]
        for j in range(k + 1):
            value = 0.0
            for i in range(dof):
                value += here[i] * basis[i, j]
            hessian[k, j] += value
            if j < k:
                hessian[j, k] += value


@njit(**LEAF)
def _add_curvature(space, q, which, cone_weight, basis, count, hessian, work):
    """Add Nᵀ (Σ λ_j ∇²c_j) N to the leading (k, k) of `hessian`, N the leading k columns of
    `basis`: in closed form where the kind knows one, else by finite differences.  cone_weight: of
    the rows bounded together.
    """
    dof, node = q.shape[0], work.node
    full, here, there, moved = work.full, work.here, work.there, work.moved
    if cone_weight == 0.0 and curvature(space, node.weights, work.looked, which, full):
        _add_reduced(full, basis, count, hessian, here)
        return
    _weighted_gradient(space, q, cone_weight, work, here)
    for k in range(count):
        for d in range(dof):
            moved[d] = q[d] + _DIFFERENCE * basis[d, k]
        _weighted_gradient(space, moved, cone_weight, work, there)
        for j in range(count):
            value = 0.0
            for d in range(dof):
                value += (there[d] - here[d]) * basis[d, j]
            # half to either side: the matrix is symmetric but for rounding and the differences'
            # error
            hessian[k, j] += 0.5 * value / _DIFFERENCE
            hessian[j, k] += 0.5 * value / _DIFFERENCE


@njit(**LEAF)
def reduced(space, q, which, gradient, basis, hessian, onto, work):
    """Null space `basis` (D, k) of the active rows at q and the reduced Hessian (k, k); returns k.

    which: of the configurations in `work.looked` q is.  gradient (D,): e = 2 q_i − q_{i−1} −
    q_{i+1} and what pushes.  An inequality whose multiplier would hold the node back is let go.
    onto (D,): the shortest step that ends on the inequalities that are kept.
    """
    node = work.node
    size = _gather(space, q, which, work)
    size = _let_go(work.active, size, gradient, node.normal, work.here, onto)
    count = null_space(work.active.rows, size, basis)
    cone_weight, curved = _weigh(work.active, size, work)
    for k in range(count):
        for j in range(count):
            hessian[k, j] = 2.0 if k == j else 0.0
    if curved:
        _add_curvature(space, q, which, cone_weight, basis, count, hessian, work)
    return count


@njit(**LEAF)
def _couple(band, i):
    """The block between node i and the one before, N_iᵀ (X − 1) N_{i−1} with what pushes their line
    in X, into `band.couplings`.
    """
    bases, cross, size, before = band.bases, band.cross, band.counts[i], band.counts[i - 1]
    dof, touched, crosses = bases.shape[1], band.push.touched[i], band.push.crosses[i]
    for d in range(dof):
        for b in range(before):
            cross[d, b] = -bases[i - 1, d, b]
        if touched:
            for e in range(dof):
                for b in range(before):
                    cross[d, b] += crosses[d, e] * bases[i - 1, e, b]
    for a in range(size):
        for b in range(before):
            band.couplings[i, a, b] = 0.0
        for d in range(dof):
            for b in range(before):
                band.couplings[i, a, b] += bases[i, d, a] * cross[d, b]


@njit(**LEAF)
def _newton(band, m, shift):
    """Solve the block-tridiagonal system for `band.steps` of the m inner nodes; False where it is
    not positive definite.
    """
    bases, counts, hessians, gradients = band.bases, band.counts, band.hessians, band.gradients
    factors, couplings, right, steps = band.factors, band.couplings, band.right, band.steps
    dof = gradients.shape[1]
    for i in range(m):
        size = counts[i]
        for a in range(size):
            right[i, a] = -gradients[i, a]
            for b in range(size):
                factors[i, a, b] = hessians[i, a, b]
            factors[i, a, a] += shift
        if i > 0:
            # couplings[i]: L_{i,i−1}, of node i to node i − 1
            before = counts[i - 1]
            _couple(band, i)
            for a in range(size):
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


@njit(**LEAF)
def band_energy(nodes):
    """E = ½ Σ ‖q_{i+1} − q_i‖²."""
    total = 0.0
    for i in range(nodes.shape[0] - 1):
        for d in range(nodes.shape[1]):
            total += 0.5 * (nodes[i + 1, d] - nodes[i, d]) ** 2
    return total


@njit(**LEAF)
def gradient_of(nodes, i, d):
    """Component d of e_i = 2 q_i − q_{i−1} − q_{i+1}."""
    return 2.0 * nodes[i, d] - nodes[i - 1, d] - nodes[i + 1, d]


class _Band(NamedTuple):
    """What the m inner nodes of a band have: bases, hessians, factors, couplings (m, D, D), counts
    (m,), gradients, right, steps, onto (m, D); shares, left (m,) of `project_all`; trial (m + 2, D)
    with what pushes it, and what pushes the band; held (m + 2,); blocked, still (m + 1,): the lines
    that touch something, and those of the trial; samples: of what pushes; cross (D, D).
    """

    bases: np.ndarray
    hessians: np.ndarray
    factors: np.ndarray
    couplings: np.ndarray
    counts: np.ndarray
    gradients: np.ndarray
    right: np.ndarray
    steps: np.ndarray
    onto: np.ndarray
    shares: np.ndarray
    left: np.ndarray
    trial: np.ndarray
    pushed: Push
    push: Push
    held: np.ndarray
    blocked: np.ndarray
    still: np.ndarray
    contacts: Contacts
    samples: Nearby
    cross: np.ndarray


@njit(**COMPILE)
def _new_band(around, nodes):
    """What a band of these nodes needs."""
    m, dof = nodes.shape[0] - 2, nodes.shape[1]
    return _Band(
        np.empty((m, dof, dof)),
        np.empty((m, dof, dof)),
        np.empty((m, dof, dof)),
        np.empty((m, dof, dof)),
        np.zeros(m, dtype=np.int64),
        np.empty((m, dof)),
        np.empty((m, dof)),
        np.empty((m, dof)),
        np.empty((m, dof)),
        np.ones(m),
        np.empty(m),
        nodes.copy(),
        new_push(nodes),
        new_push(nodes),
        np.zeros(m + 2, dtype=np.bool_),
        np.zeros(m + 1, dtype=np.bool_),
        np.zeros(m + 1, dtype=np.bool_),
        new_contacts(around.clearance, dof),
        new_samples(around, nodes),
        np.empty((dof, dof)),
    )


@njit(inline="always", **LEAF)
def _hold_back(around, nodes, band):
    """Leave nodes where they were, `nodes`, if a line that touched nothing would from or to where
    they would be, `band.trial`; tells which lines touch something still.
    """
    n, trial, held = nodes.shape[0] - 1, band.trial, band.held
    for k in range(n + 1):
        held[k] = k == 0 or k == n
    i = 0
    while i < n:
        # the line between two nodes that are held is one of before, whatever it touches
        both = held[i] and held[i + 1]
        clear = not both and is_free(around, trial[i], trial[i + 1], band)
        band.still[i] = band.blocked[i] and not clear
        if both or clear or band.blocked[i]:
            i += 1
            continue
        back = not held[i] and i > 0
        for k in (i, i + 1):
            held[k] = True
            for d in range(nodes.shape[1]):
                trial[k, d] = nodes[k, d]
        # the line before ends elsewhere now
        i = i - 1 if back else i + 1


@njit(inline="always", **COMPILE)
def _linearise_band(space, nodes, band, work):
    """The reduced problem of all inner nodes: bases, Hessians, and gradients where all steps onto
    bounds are taken.
    """
    n, dof = nodes.shape[0] - 1, nodes.shape[1]
    onto, gradient, push = band.onto, work.gradient, band.push
    for i in range(n - 1):
        which = i % LANES
        if which == 0:
            linearise(space, nodes[i + 1 : min(i + 1 + LANES, n)], work.looked)
        for d in range(dof):
            gradient[d] = gradient_of(nodes, i + 1, d) + push.slopes[i + 1, d]
        band.counts[i] = reduced(
            space, nodes[i + 1], which, gradient, band.bases[i], band.hessians[i], onto[i], work
        )
        if push.touched[i] or push.touched[i + 1]:
            _add_reduced(
                push.curvatures[i + 1], band.bases[i], band.counts[i], band.hessians[i], work.here
            )
    for i in range(n - 1):
        for d in range(dof):
            gradient[d] = 2.0 * (nodes[i + 1, d] + onto[i, d]) - nodes[i, d] - nodes[i + 2, d]
            gradient[d] += push.slopes[i + 1, d]
            if i > 0:
                gradient[d] -= onto[i - 1, d]
            if i < n - 2:
                gradient[d] -= onto[i + 1, d]
        for a in range(band.counts[i]):
            value = 0.0
            for d in range(dof):
                value += band.bases[i, d, a] * gradient[d]
            band.gradients[i, a] = value


@njit(inline="always", **LEAF)
def _promise(nodes, band):
    """Add the steps onto bounds to Newton's; returns by how much the energy is to decrease, and the
    longest step.
    """
    n, dof = nodes.shape[0] - 1, nodes.shape[1]
    promised, longest = 0.0, 0.0
    for i in range(n - 1):
        square = 0.0
        for a in range(band.counts[i]):
            value = 0.0
            for d in range(dof):
                value += band.bases[i, d, a] * band.steps[i, d]
            promised -= 0.5 * band.gradients[i, a] * value
        for d in range(dof):
            band.steps[i, d] += band.onto[i, d]
            square += band.steps[i, d] ** 2
            gradient = gradient_of(nodes, i + 1, d) + band.push.slopes[i + 1, d]
            promised += abs(gradient * band.onto[i, d])
        longest = max(longest, np.sqrt(square))
    return promised, longest


@njit(**LEAF)
def _valued(around, margin, nodes, push, band, most):
    """Energy and penalty of a band, whose derivatives are written into `push`; any value from
    `most` on where it is no less.
    """
    energy = band_energy(nodes)
    if around.clearance.top == 0:
        return energy
    return penalise(around, margin, nodes, push, band.contacts, band.samples, energy, most)


@njit(inline="always", **COMPILE)
def _moved(space, around, nodes, scale, settings, band, work, most):
    """The nodes after a share of the steps, projected, into `band.trial`; returns what remains of
    the violation, and the value, or any from `most` on.
    """
    trial, n = band.trial, nodes.shape[0] - 1
    _, projection, _, _, margin, guarded = settings
    for i in range(1, n):
        for d in range(nodes.shape[1]):
            trial[i, d] = nodes[i, d] + scale * band.steps[i - 1, d]
    left = project_all(space, trial[1:n], band.shares, projection, band.left, work)
    if guarded:
        _hold_back(around, nodes, band)
    return left, _valued(around, margin, trial, band.pushed, band, most)


@njit(inline="always", **COMPILE)
def _accept(nodes, band):
    """Go on from the trial."""
    nodes[:, :] = band.trial
    band.blocked[:] = band.still
    band.push.slopes[:] = band.pushed.slopes
    band.push.curvatures[:] = band.pushed.curvatures
    band.push.crosses[:] = band.pushed.crosses
    band.push.touched[:] = band.pushed.touched


@njit(**COMPILE)
def relax_band(space, around, nodes, settings):
    """Shorten a band (n + 1, D) in place; returns (what remains of the violation, iterations used,
    converged).

    space: without what may meet; around: with it, where the band is to be pushed clear of it.
    settings: iterations at most; a node's projection after a step; relative decrease of the value,
    predicted by Newton's step or made, below which it has converged; longest step of a node [rad];
    margin within which bodies are pushed apart [m]; whether lines that touch nothing keep that.
    """
    most, projection, accuracy, largest, margin, guarded = settings
    n = nodes.shape[0] - 1
    work, band = new_work(space), _new_band(around, nodes)
    used, converged, reach = 0, False, largest
    worst = project_all(space, nodes[1:n], band.shares, projection, band.left, work.node)
    value = _valued(around, margin, nodes, band.push, band, np.inf)
    if guarded:
        for i in range(n):
            band.blocked[i] = not is_free(around, nodes[i], nodes[i + 1], band)
    for _ in range(most):
        used += 1
        _linearise_band(space, nodes, band, work)
        shift = 0.0
        while not _newton(band, n - 1, shift):
            shift = 0.02 if shift == 0.0 else 4.0 * shift
            if shift > 1e4:
                return worst, used, False
        promised, longest = _promise(nodes, band)
        if promised <= accuracy * value:
            converged = True
            if longest > 0.05:
                break
        scale, improved, at_once = min(1.0, reach / longest) if longest > 0.0 else 1.0, False, True
        enough = max(worst, 1e-6)
        for _ in range(6):
            left, after = _moved(space, around, nodes, scale, settings, band, work.node, value)
            if after < value and left <= enough:
                improved = True
                break
            scale, at_once = 0.4 * scale, False
        if not improved:
            break
        # what was too far once is so again a little further on
        reach = min(largest, 2.5 * reach) if at_once else scale * longest
        _accept(nodes, band)
        # between two kinks of a contact no step promises little, and none gains much
        converged = converged or value - after <= scale * accuracy * value
        # nodes that were held back are as far off as before
        value, worst = after, max(worst, left) if guarded else left
        if converged:
            break
    return worst, used, converged
