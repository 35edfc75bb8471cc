"""What a manifold is to the rest of the project: a chart, its embedding, and the metric the embedding induces."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

Embedding = Callable[[Tensor], Tensor]


class GeometryError(ValueError):
    """The input has no geometric meaning; the message names it, its value and what is allowed."""


class NonFiniteError(GeometryError):
    """An entry is NaN or infinite.

    what: name of the array.  index: place of the first such entry in it.  value: the entry.
    """

    def __init__(self, what: str, index: tuple[int, ...], value: float) -> None:
        # The bare arguments go to the base class because an exception is copied between processes from them.
        super().__init__(what, index, value)
        self.what, self.index, self.value = what, index, value

    def __str__(self) -> str:
        place = ", ".join(str(i) for i in self.index)
        return f"{self.what}[{place}] = {self.value}: must be finite"


@runtime_checkable
class Manifold(Protocol):
    """A manifold of dimension N in one chart, embedded into R^A.

    Both functions take any batch shape.  A new manifold is one class with these four members; where no closed
    form of the metric is known, `metric` returns `pullback_metric(self.embed, z)`.
    """

    @property
    def dim(self) -> int:
        """Dimension N of the chart."""
        ...

    @property
    def ambient_dim(self) -> int:
        """Dimension A of the space the manifold is embedded into."""
        ...

    def embed(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch A"]:
        """The embedding f(z).  It acts on each point by itself and is differentiable in forward mode."""
        ...

    def metric(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch N N"]:
        """The metric M(z) = JᵀJ with the Jacobian J of the embedding, symmetric and positive."""
        ...


def pullback_metric(embed: Embedding, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch N N"]:
    """Metric M(z) = J_f(z)ᵀ J_f(z) that an embedding f induces, eq. 5.

    embed: (*batch, N) to (*batch, A), acting on each point by itself.  Differentiable in z.
    """

    def column(direction: Tensor) -> Tensor:
        product: Tensor = torch.func.jvp(embed, (z,), (direction.expand_as(z),))[1]
        return product

    # One forward product a chart direction over the whole batch: N of them, where a map over points would need B.
    directions = torch.eye(z.shape[-1], dtype=z.dtype, device=z.device)
    transposed = torch.func.vmap(column, out_dims=-2)(directions)
    return transposed @ transposed.mT


def require_finite(values: Float[Tensor, "..."], what: str) -> None:
    """Raise NonFiniteError with the first entry of `values`, called `what` in the message, that is not finite."""
    finite = torch.isfinite(values)
    if not finite.all():
        index = tuple(int(i) for i in torch.nonzero(~finite)[0])
        raise NonFiniteError(what, index, float(values[index]))


def require_dim(points: Float[Tensor, "..."], dim: int, what: str) -> None:
    """Raise GeometryError unless the last axis of `points`, called `what` in the message, has `dim` entries."""
    if points.ndim == 0 or points.shape[-1] != dim:
        raise GeometryError(f"{what} has shape {tuple(points.shape)}: its last axis must have {dim} entries")
