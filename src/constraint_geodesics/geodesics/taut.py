"""Curves pulled tight among walls: a spline with as many pieces as a path has steps.

Newton's method on a weighted energy of the spline, before a fence that keeps off the walls.  Each
coefficient acts on four pieces, so the second derivatives are sparse and a step costs what grows
with the path's length, not with its cube.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from constraint_geodesics.geometry.curves import CurveFamily, Curves, PinnedSpline
from constraint_geodesics.geometry.length import Quadrature
from constraint_geodesics.geometry.manifold import Manifold, WalledManifold

Corners = Float[np.ndarray, "k N"]
NODES = 4
"""Points of a piece at which metric and fence are looked up."""
SMOOTHING = 8.0
"""Nodes that the pace is smoothed over: it needs to follow the metric, not its kinks."""
HALVINGS = 12
"""Times that a step which does not lower the value is halved."""
RIDGE = 1e-9
"""What is added to the second derivatives, relative to the largest."""
ATTEMPTS = ((1, 0.2, 0.2), (2, 0.25, 1.0))
"""Pieces a step, and margin [steps] and height of the fence, tried until a curve is inside."""
ITERATIONS = 60
"""Newton steps at most."""
TOLERANCE = 2e-5
"""Share of its value that a settled curve's last step gained at most."""
LOOKED_UP = 32
"""Points a step that are looked up to tell whether a curve stays inside."""
BLOCK = 4096
"""Points looked up at once."""


@dataclass(frozen=True)
class Taut:
    """A curve along a path: family, coefficients, ends, whether it settled, and Newton steps."""

    curve: CurveFamily
    phi: Float[np.ndarray, "p"]
    start: Float[np.ndarray, "N"]
    goal: Float[np.ndarray, "N"]
    converged: bool
    steps: int

    def curves(self) -> Curves:
        """The one curve as a batch of none."""
        arrays = (torch.from_numpy(values) for values in (self.phi, self.start, self.goal))
        return Curves(self.curve, *arrays)


class _Nodes(NamedTuple):
    """Basis and slopes of a family (T, m) at the nodes of a rule, the times and weights (T,)."""

    basis: sparse.csr_array
    slopes: sparse.csr_array
    times: Float[np.ndarray, "T"]
    weights: Float[np.ndarray, "T"]


def drawn_along(manifold: WalledManifold, corners: Corners) -> Taut | None:
    """The spline of fewest pieces drawn along a polygon that stays on the manifold; where none
    does, one pulled tight, if that does.
    """
    return _first_inside(manifold, chain(_drawings(manifold, corners), _pulls(manifold, corners)))


def pulled_along(manifold: WalledManifold, corners: Corners) -> Taut | None:
    """A spline pulled tight from a polygon, with pieces and fence of the first attempt that ends
    on the manifold; what is drawn along it where none does.
    """
    return _first_inside(manifold, chain(_pulls(manifold, corners), _drawings(manifold, corners)))


def _first_inside(manifold: WalledManifold, curves: Iterable[Taut]) -> Taut | None:
    return next((taut for taut in curves if stays_inside(manifold, taut.curves())), None)


def _drawings(manifold: WalledManifold, corners: Corners) -> Iterator[Taut]:
    return (_drawn(manifold, corners, pieces) for pieces, _, _ in ATTEMPTS)


def _pulls(manifold: WalledManifold, corners: Corners) -> Iterator[Taut]:
    doors = torch.from_numpy(corners[[0, -1]])
    for pieces, margin, height in ATTEMPTS:
        fenced = manifold.fenced(margin, height, doors)
        yield pulled(fenced, _drawn(manifold, corners, pieces), ITERATIONS, TOLERANCE)


def stays_inside(manifold: WalledManifold, curves: Curves) -> bool:
    """Whether LOOKED_UP points a step of one curve all belong to the manifold."""
    coarse = torch.linspace(0.0, 1.0, 2 * len(curves.family.breaks) + 1, dtype=torch.float64)
    sides = torch.linalg.vector_norm(curves.at(coarse)[0].diff(dim=0), dim=-1)
    # as many times between every two as the longest of them needs
    count = math.ceil(LOOKED_UP * float(sides.max()) / manifold.step) * len(sides)
    t = torch.linspace(0.0, 1.0, count + 1, dtype=torch.float64)
    return all(bool(manifold.contains(curves.at(part)[0]).all()) for part in t.split(BLOCK))


def _drawn(manifold: WalledManifold, corners: Corners, pieces: int) -> Taut:
    """A spline along a polygon with about so many pieces a step, the next power of 2 in number:
    few families are made for many paths.
    """
    steps = np.linalg.norm(np.diff(corners, axis=0), axis=1).sum() / manifold.step
    count = pieces * 2 ** max(2, round(math.log2(max(steps, 1.0))))
    curve = PinnedSpline(manifold.dim, count)
    return Taut(curve, _nearest(curve, corners), corners[0], corners[-1], converged=True, steps=0)


def _nearest(curve: CurveFamily, corners: Corners) -> Float[np.ndarray, "p"]:
    """Coefficients of the curve nearest to a polygon walked at constant speed in the chart."""
    nodes = _nodes(curve)
    passed = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    t = nodes.times
    points = np.stack([np.interp(t * passed[-1], passed, column) for column in corners.T], axis=-1)
    line = (1 - t)[:, None] * corners[0] + t[:, None] * corners[-1]
    gram = (nodes.basis.T @ nodes.basis).tocsc()
    free = splu(gram).solve(nodes.basis.T @ (points - line))
    return free.T.ravel()


def pulled(manifold: Manifold, taut: Taut, iterations: int, tolerance: float) -> Taut:
    """The curve after Newton steps down ∫ γ̇ᵀ M(γ) γ̇ / s dt, with s the speed at the start.

    By 2 |γ̇| ≤ |γ̇|²/s + s a lower value is a shorter curve, and the minimum keeps the pace s:
    pieces stay where they are along the curve, however much the metric varies.
    converged: the last step lowered the value by less than `tolerance` of it.
    """
    descent = _Descent.of(manifold, taut)
    phi, steps, done = taut.phi, 0, False
    value = descent.value(phi)
    while not done and steps < iterations:
        steps += 1
        step = descent.newton_step(phi)
        tried = (phi + step / 2**k for k in range(HALVINGS))
        better = ((found, descent.value(found)) for found in tried)
        phi, lower = next((pair for pair in better if pair[1] < value), (phi, value))
        done, value = lower >= value * (1 - tolerance), lower
    return replace(taut, phi=phi, converged=done, steps=steps)


@dataclass(frozen=True)
class _Descent:
    """∫ γ̇ᵀ M(γ) γ̇ / s dt as a function of the coefficients, by a rule with weights that hold 1/s.

    fixed: (T, 2N) points and velocities of the straight line.
    """

    manifold: Manifold
    nodes: _Nodes
    fixed: Float[np.ndarray, "T 2N"]
    weights: Float[np.ndarray, "T"]
    jacobian: sparse.csr_array

    @classmethod
    def of(cls, manifold: Manifold, taut: Taut) -> "_Descent":
        nodes = _nodes(taut.curve)
        t = nodes.times[:, None]
        line = (1 - t) * taut.start + t * taut.goal
        fixed = np.concatenate([line, np.broadcast_to(taut.goal - taut.start, line.shape)], axis=1)
        jacobian = _jacobian(nodes, taut.curve.dim)
        even = cls(manifold, nodes, fixed, nodes.weights, jacobian)
        speed = np.sqrt(_squares(manifold, even.states(taut.phi)))
        pace = ndimage.gaussian_filter1d(speed, SMOOTHING, mode="nearest")
        return replace(even, weights=nodes.weights / pace)

    def states(self, phi: Float[np.ndarray, "p"]) -> Float[np.ndarray, "T 2N"]:
        """Points and velocities side by side."""
        free = phi.reshape(self.fixed.shape[1] // 2, -1).T
        return self.fixed + np.concatenate(
            [self.nodes.basis @ free, self.nodes.slopes @ free], axis=1
        )

    def value(self, phi: Float[np.ndarray, "p"]) -> float:
        """The integral."""
        return float(self.weights @ _squares(self.manifold, self.states(phi)))

    def newton_step(self, phi: Float[np.ndarray, "p"]) -> Float[np.ndarray, "p"]:
        """Newton's step, with no account of what bends down."""
        states = self.states(phi)
        gradient, hessian = _expansion(self.manifold, states, self.weights, self.jacobian)
        return -_solved(hessian, gradient, states.shape[1] // 2)


def _squares(manifold: Manifold, state: Float[np.ndarray, "T 2N"]) -> Float[np.ndarray, "T"]:
    """γ̇ᵀ M(γ) γ̇ of points and velocities side by side."""
    z, v = np.split(state, 2, axis=1)
    with torch.no_grad():
        metric = manifold.metric(torch.from_numpy(z)).numpy()
    return np.einsum("ti,tij,tj->t", v, metric, v)


def _expansion(
    manifold: Manifold,
    state: Float[np.ndarray, "T 2N"],
    weights: Float[np.ndarray, "T"],
    jacobian: sparse.csr_array,
) -> tuple[Float[np.ndarray, "p"], sparse.csc_array]:
    """Slope, and second derivatives without what bends down, to the coefficients."""
    gradient, hessian = _derivatives(manifold, state)
    curvature, axes = np.linalg.eigh(hessian)
    local = (axes * (curvature.clip(min=0) * weights[:, None])[:, None]) @ axes.transpose(0, 2, 1)
    blocks = [
        [sparse.diags_array(local[:, i, j]) for j in range(len(row))]
        for i, row in enumerate(local[0])
    ]
    full = (jacobian.T @ sparse.block_array(blocks, format="csr") @ jacobian).tocsc()
    ridge = RIDGE * full.diagonal().max() * sparse.eye_array(full.shape[0], format="csc")
    return jacobian.T @ (gradient * weights[:, None]).T.ravel(), full + ridge


def _solved(
    hessian: sparse.csc_array, gradient: Float[np.ndarray, "p"], size: int
) -> Float[np.ndarray, "p"]:
    """Solution of the system, which is banded once the dimensions of a coefficient lie together."""
    order = np.arange(len(gradient)).reshape(size, -1).T.ravel()
    factors = splu(
        hessian[:, order][order],
        permc_spec="NATURAL",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    solution = np.empty_like(gradient)
    solution[order] = factors.solve(gradient[order])
    return solution


def _derivatives(
    manifold: Manifold, state: Float[np.ndarray, "T 2N"]
) -> tuple[Float[np.ndarray, "T 2N"], Float[np.ndarray, "T 2N 2N"]]:
    """First and second derivatives of γ̇ᵀ M(γ) γ̇ to point and velocity, at each node."""
    size = state.shape[1] // 2
    states = torch.from_numpy(state).requires_grad_()
    z, v = states.split(size, dim=-1)
    metric = manifold.metric(z)
    squares = (v * (metric @ v[..., None])[..., 0]).sum()
    # every node's value is its own, so that one pass serves all of them
    (gradient,) = torch.autograd.grad(squares, states, create_graph=True)
    rows = [
        torch.autograd.grad(gradient[:, k].sum(), states, retain_graph=True)[0] for k in range(size)
    ]
    hessian = torch.zeros(*state.shape, state.shape[1], dtype=states.dtype)
    hessian[:, :size] = torch.stack(rows, dim=1)
    hessian[:, size:, :size] = hessian[:, :size, size:].mT
    hessian[:, size:, size:] = 2 * metric.detach()
    return gradient.detach().numpy(), hessian.numpy()


def _jacobian(nodes: _Nodes, size: int) -> sparse.csr_array:
    one = sparse.eye_array(size)
    return sparse.vstack([sparse.kron(one, nodes.basis), sparse.kron(one, nodes.slopes)], "csr")


@cache
def _nodes(curve: CurveFamily) -> _Nodes:
    rule = Quadrature.gauss_legendre(NODES, tuple(curve.breaks))
    basis, slopes = curve.basis(rule.nodes), curve.basis_derivative(rule.nodes)
    return _Nodes(
        sparse.csr_array(basis.numpy()),
        sparse.csr_array(slopes.numpy()),
        rule.nodes.numpy(),
        rule.weights.numpy(),
    )
