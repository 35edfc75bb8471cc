"""What a manifold is to the rest of the project: a chart with a metric, and what some add."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from constraint_geodesics.geometry.errors import GeometryError, NonFiniteError, OutsideError

__all__ = [
    "BoundedManifold",
    "EmbeddedManifold",
    "GeometryError",
    "Manifold",
    "MeasuredManifold",
    "NonFiniteError",
    "OutsideError",
    "PeriodicManifold",
    "WalledManifold",
    "pullback_metric",
    "require_dim",
    "require_finite",
    "require_inside",
]

Embedding = Callable[[Tensor], Tensor]


@runtime_checkable
class Manifold(Protocol):
    """A manifold of dimension N in one chart.  These two members are all that lengths and solvers
    need.

    Where the manifold is embedded, add `ambient_dim` and `embed` (EmbeddedManifold): lengths then
    need no metric at all, and `metric` may return `pullback_metric(self.embed, z)`.
    """

    @property
    def dim(self) -> int:
        """Dimension N of the chart."""
        ...

    def metric(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch N N"]:
        """The metric M(z), symmetric and positive, for any batch shape."""
        ...


@runtime_checkable
class EmbeddedManifold(Manifold, Protocol):
    """A manifold embedded into R^A, with the metric M = JᵀJ of the embedding's Jacobian J."""

    @property
    def ambient_dim(self) -> int:
        """Dimension A of the space the manifold is embedded into."""
        ...

    def embed(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch A"]:
        """The embedding f(z), of each point by itself, differentiable in forward mode."""
        ...


@runtime_checkable
class MeasuredManifold(Manifold, Protocol):
    """A manifold whose geodesic distance is known: the oracle of the solvers."""

    def distance(
        self, a: Float[Tensor, "*#batch N"], b: Float[Tensor, "*#batch N"]
    ) -> Float[Tensor, "*batch"]:
        """Length of the shortest curve between two points."""
        ...


@runtime_checkable
class PeriodicManifold(Manifold, Protocol):
    """A manifold whose chart repeats: z and z + k period are one point for every whole k."""

    @property
    def periods(self) -> tuple[float, ...]:
        """Period of each of the N coordinates, inf where it does not repeat."""
        ...


@runtime_checkable
class BoundedManifold(Manifold, Protocol):
    """A manifold that does not fill its chart."""

    def contains(self, z: Float[Tensor, "*batch N"]) -> Bool[Tensor, "*batch"]:
        """Whether each point belongs to the manifold."""
        ...


@runtime_checkable
class WalledManifold(BoundedManifold, Protocol):
    """A bounded manifold whose metric and walls are known to a step of the chart."""

    @property
    def step(self) -> float:
        """Size in the chart of the least thing in the metric and its walls."""
        ...

    def clearance(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch"]:
        """Distance of each point to the border in steps, negative beyond it."""
        ...

    def fenced(
        self, margin: float, height: float, doors: Float[Tensor, "k N"] | None = None
    ) -> Manifold:
        """The manifold with a fence that begins `margin` steps before its border, for descents that
        must not touch it; `height` times as steep as a plain one, and smooth.

        doors: points that it leaves free, ends of curves that lie nearer to the border.
        """
        ...


def pullback_metric(embed: Embedding, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch N N"]:
    """Metric M(z) = J_f(z)ᵀ J_f(z) that an embedding f induces, eq. 5.

    embed: (*batch, N) to (*batch, A), acting on each point by itself.  Differentiable in z.
    """

    def column(direction: Tensor) -> Tensor:
        product: Tensor = torch.func.jvp(embed, (z,), (direction.expand_as(z),))[1]
        return product

    # One forward product a chart direction over the whole batch: N of them, where a map over points
    # would need B.
    directions = torch.eye(z.shape[-1], dtype=z.dtype, device=z.device)
    transposed = torch.func.vmap(column, out_dims=-2)(directions)
    return transposed @ transposed.mT


def require_finite(values: Float[Tensor, "..."], what: str) -> None:
    """Raise NonFiniteError with the first entry of `values`, called `what`, that is not finite."""
    finite = torch.isfinite(values)
    if not finite.all():
        index = tuple(int(i) for i in torch.nonzero(~finite)[0])
        raise NonFiniteError(what, index, float(values[index]))


def require_dim(points: Float[Tensor, "..."], dim: int, what: str) -> None:
    """Raise GeometryError unless the last axis of `points`, called `what`, has `dim` entries."""
    if points.ndim == 0 or points.shape[-1] != dim:
        raise GeometryError(
            f"{what} has shape {tuple(points.shape)}: its last axis must have {dim} entries"
        )


def require_inside(manifold: Manifold, points: Float[Tensor, "*batch N"], what: str) -> None:
    """Raise unless `points`, called `what` in the message, are points of the manifold.

    Raises GeometryError on a wrong last axis, NonFiniteError with the first entry that is not
    finite, OutsideError with the first point a BoundedManifold does not contain.
    """
    require_dim(points, manifold.dim, what)
    require_finite(points, what)
    if isinstance(manifold, BoundedManifold):
        outside = ~manifold.contains(points)
        if outside.any():
            index = tuple(int(i) for i in torch.nonzero(outside)[0])
            raise OutsideError(what, index, tuple(float(x) for x in points[index]))
