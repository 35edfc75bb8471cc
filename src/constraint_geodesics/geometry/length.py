"""Length and energy of curves on a manifold (eq. 2), batched and differentiable."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from constraint_geodesics.geometry.curves import CurveFamily
from constraint_geodesics.geometry.manifold import GeometryError, Manifold, require_finite


@dataclass(frozen=True, eq=False)
class Quadrature:
    """A rule ∫₀¹ g dt ≈ Σ_i weights_i g(nodes_i): nodes (Q,) inside [0, 1], weights (Q,) that sum to 1."""

    nodes: Float[Tensor, "Q"]
    weights: Float[Tensor, "Q"]

    @classmethod
    def gauss_legendre(cls, count: int) -> "Quadrature":
        """Gauss-Legendre rule with `count` nodes: exact for polynomials of degree 2 count − 1.

        Raises GeometryError if count is below 1.
        """
        if count < 1:
            raise GeometryError(f"count = {count}: a quadrature rule needs at least one node")
        x, w = np.polynomial.legendre.leggauss(count)
        return cls(torch.from_numpy((x + 1) / 2), torch.from_numpy(w / 2))


def curve_length(
    manifold: Manifold,
    curve: CurveFamily,
    phi: Float[Tensor, "*#batch p"],
    start: Float[Tensor, "*#batch N"],
    goal: Float[Tensor, "*#batch N"],
    rule: Quadrature,
) -> Float[Tensor, "*batch"]:
    """Length of curves on a manifold, eq. 2: L = ∫₀¹ √(γ̇ᵀ M(γ) γ̇) dt = ∫₀¹ ‖J_f(γ) γ̇‖ dt.

    In the unit of the embedding.  The error falls exponentially with the nodes while the speed stays above zero,
    and like 1/nodes² where a curve turns back on itself.  Differentiable in phi, start and goal.
    Raises NonFiniteError with the place of the first entry of phi, start or goal that is not finite, GeometryError
    if the curves and the manifold differ in dimension, CurveError on a wrong shape.
    """
    velocities = _embedded_velocities(manifold, curve, phi, start, goal, rule)
    return torch.linalg.vector_norm(velocities, dim=-1) @ rule.weights.to(velocities)


def curve_energy(
    manifold: Manifold,
    curve: CurveFamily,
    phi: Float[Tensor, "*#batch p"],
    start: Float[Tensor, "*#batch N"],
    goal: Float[Tensor, "*#batch N"],
    rule: Quadrature,
) -> Float[Tensor, "*batch"]:
    """Energy of curves on a manifold: E = ∫₀¹ γ̇ᵀ M(γ) γ̇ dt ≥ L², equal at constant speed only.

    In the square of the embedding's unit.  Smooth where the length is not; raises as `curve_length` does.
    """
    velocities = _embedded_velocities(manifold, curve, phi, start, goal, rule)
    return velocities.square().sum(-1) @ rule.weights.to(velocities)


def chord_length(points: Float[Tensor, "*batch T A"]) -> Float[Tensor, "*batch"]:
    """Length of the polygon through embedded points: Σ_i ‖x_{i+1} − x_i‖, in their unit.

    It is never longer than the curve the points lie on, and blind to what that curve does between them.
    Raises GeometryError for fewer than two points, NonFiniteError with the place of the first entry that is not finite.
    """
    if points.ndim < 2 or points.shape[-2] < 2:
        raise GeometryError(f"points has shape {tuple(points.shape)}: must be (*batch, T, A) with T at least 2")
    require_finite(points, "points")
    return torch.linalg.vector_norm(points.diff(dim=-2), dim=-1).sum(-1)


def _embedded_velocities(
    manifold: Manifold, curve: CurveFamily, phi: Tensor, start: Tensor, goal: Tensor, rule: Quadrature
) -> Tensor:
    """J_f(γ) γ̇ at the nodes of the rule (*batch, Q, A): one forward-mode product a node, never the full Jacobian."""
    for name, values in (("phi", phi), ("start", start), ("goal", goal)):
        require_finite(values, name)
    if curve.dim != manifold.dim:
        raise GeometryError(f"the curve has dim {curve.dim}: must be that of the manifold, {manifold.dim}")
    points, velocities = curve.evaluate(phi, start, goal, rule.nodes.to(phi))
    embedded: Tensor = torch.func.jvp(manifold.embed, (points,), (velocities,))[1]
    return embedded
