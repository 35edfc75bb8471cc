"""A plane with a conformal metric known at the nodes of a regular grid."""

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from constraint_geodesics.geometry.manifold import (
    BoundedManifold,
    GeometryError,
    Manifold,
    require_dim,
)

Bounds = tuple[float, float]

WALL = 100.0
"""Metric of a blocked node next to a free one, in multiples of the largest free value."""


class GridError(GeometryError):
    """Arrays or bounds that are no grid of a metric; names the input and what is allowed."""


@dataclass(frozen=True, eq=False)
class GridManifold:
    """The metric M(z) = g(z) I on a rectangle, g given at the nodes of a grid and bilinear between.

    values: g (rows, columns), rows along the first coordinate, positive.  lower, upper: chart
    coordinates of the first and last node of both axes.
    blocked: nodes that don't belong to the manifold, None for none; what `values` holds there is
    never read.  A point is blocked where its nearest node is.  There g still leads out: a blocked
    node carries WALL times the largest free value, times its distance to the nearest free node in
    steps of the finer axis.
    Raises GridError on a shape that is no grid, bounds that don't rise, values that aren't positive
    and finite at the free nodes, or if every node is blocked.
    """

    values: Float[Tensor, "rows columns"]
    lower: Bounds
    upper: Bounds
    blocked: Bool[Tensor, "rows columns"] | None = None
    _filled: Float[Tensor, "rows columns"] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        _require_grid(self.values.shape, self.lower, self.upper)
        _require_values(self.values, self._walls)
        # A frozen dataclass has no other way to keep what it derives.
        object.__setattr__(self, "_filled", _with_walls(self.values, self._walls, self.spacing))

    @classmethod
    def from_manifold(
        cls,
        manifold: Manifold,
        lower: Bounds,
        upper: Bounds,
        shape: tuple[int, int],
        dtype: torch.dtype = torch.float64,
    ) -> "GridManifold":
        """The volume √det M of another manifold's metric at the nodes of a grid, as the factor g.

        For a conformal metric M = g I distances agree as the grid gets finer; of any other only the
        volume of small regions is kept.
        shape: nodes along both axes.  dtype: what the manifold computes in.  Nodes that a
        BoundedManifold doesn't contain are blocked.  Raises GridError unless dim is 2 and the
        volume positive.
        """
        if manifold.dim != 2:
            raise GridError(f"manifold has dim {manifold.dim}: must be 2")
        _require_grid(shape, lower, upper)
        nodes = _nodes(shape, lower, upper, torch.zeros((), dtype=dtype))
        volume = torch.linalg.det(manifold.metric(nodes).detach()).clamp(min=0).sqrt()
        blocked = ~manifold.contains(nodes) if isinstance(manifold, BoundedManifold) else None
        return cls(
            volume.reshape(shape), lower, upper, None if blocked is None else blocked.reshape(shape)
        )

    dim = 2

    @property
    def spacing(self) -> Bounds:
        """Distance of neighbouring nodes along both axes, in the unit of the chart."""
        first, second = (
            (high - low) / (count - 1)
            for low, high, count in zip(self.lower, self.upper, self.values.shape, strict=True)
        )
        return first, second

    def nodes(self) -> Float[Tensor, "rows*columns 2"]:
        """Chart points of the nodes, row by row; first and last lie on the bounds to the bit."""
        rows, columns = self.values.shape
        return _nodes((rows, columns), self.lower, self.upper, self.values)

    def metric(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch N N"]:
        """The matrix g(z) I, differentiable in z; finite and positive everywhere.

        Outside the grid it is that of the grid's nearest point, its gradient across the border 0.
        At a coordinate that is not finite it is not either, as on the other manifolds: values are
        checked once, by who measures.
        """
        require_dim(z, self.dim, "z")
        place = self._place(z)
        last_cell = torch.tensor([count - 2 for count in self.values.shape], device=z.device)
        corner = torch.minimum(torch.nan_to_num(place.detach()).floor().long(), last_cell)
        row, column = corner.unbind(-1)
        across, along = (place - corner).unbind(-1)
        g = self._filled.to(place)
        low = (1 - along) * g[row, column] + along * g[row, column + 1]
        high = (1 - along) * g[row + 1, column] + along * g[row + 1, column + 1]
        factor = (1 - across) * low + across * high
        return factor[..., None, None] * torch.eye(self.dim, dtype=factor.dtype, device=z.device)

    def contains(self, z: Float[Tensor, "*batch N"]) -> Bool[Tensor, "*batch"]:
        """Whether each point is finite, on the grid or its border, and nearest to a free node."""
        require_dim(z, self.dim, "z")
        lower, upper = (
            torch.tensor(bound, dtype=z.dtype, device=z.device)
            for bound in (self.lower, self.upper)
        )
        inside = ((z >= lower) & (z <= upper)).all(-1)
        row, column = (
            self._place(torch.where(inside[..., None], z, lower)).round().long().unbind(-1)
        )
        return inside & ~self._walls.to(z.device)[row, column]

    @property
    def _walls(self) -> Bool[Tensor, "rows columns"]:
        return (
            torch.zeros_like(self.values, dtype=torch.bool)
            if self.blocked is None
            else self.blocked
        )

    def _place(self, z: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Position in steps of the grid, clamped to it."""
        lower, spacing, last = (
            torch.tensor(pair, dtype=z.dtype, device=z.device)
            for pair in (self.lower, self.spacing, [count - 1 for count in self.values.shape])
        )
        return ((z - lower) / spacing).clamp(torch.zeros_like(last), last)


def _nodes(
    shape: tuple[int, int], lower: Bounds, upper: Bounds, like: Tensor
) -> Float[Tensor, "rows*columns 2"]:
    lines = [
        torch.linspace(low, high, count, dtype=like.dtype, device=like.device)
        for low, high, count in zip(lower, upper, shape, strict=True)
    ]
    return torch.cartesian_prod(*lines)


def _with_walls(
    values: Float[Tensor, "rows columns"], blocked: Bool[Tensor, "rows columns"], spacing: Bounds
) -> Float[Tensor, "rows columns"]:
    """The values, with blocked nodes as walls that rise with the distance to the free ones."""
    depth = ndimage.distance_transform_edt(blocked.cpu().numpy(), sampling=spacing) / min(spacing)
    walls = WALL * values[~blocked].max() * torch.from_numpy(depth).to(values)
    return torch.where(blocked, walls, values)


def _require_grid(shape: tuple[int, ...], lower: Bounds, upper: Bounds) -> None:
    if len(shape) != 2 or min(shape) < 2:
        raise GridError(
            f"values has shape {tuple(shape)}: must be (rows, columns) with at least 2 nodes "
            f"an axis"
        )
    for name, bound in (("lower", lower), ("upper", upper)):
        if len(bound) != 2 or not all(math.isfinite(x) for x in bound):
            raise GridError(f"{name} = {bound}: must be two finite numbers")
    for k, (low, high) in enumerate(zip(lower, upper, strict=True)):
        if low >= high:
            raise GridError(f"lower[{k}] = {low}: must be below upper[{k}] = {high}")


def _require_values(values: Tensor, blocked: Tensor) -> None:
    if not values.is_floating_point():
        raise GridError(f"values has dtype {values.dtype}: must be floating point")
    if blocked.dtype != torch.bool or blocked.shape != values.shape:
        raise GridError(
            f"blocked has shape {tuple(blocked.shape)} and dtype {blocked.dtype}: "
            f"must have that of values, {tuple(values.shape)}, and torch.bool"
        )
    if blocked.all():
        raise GridError("blocked: every node is, at least one must be free")
    bad = torch.nonzero(~blocked & ~(torch.isfinite(values) & (values > 0)))
    if len(bad):
        row, column = bad[0].tolist()
        raise GridError(
            f"values[{row}, {column}] = {values[row, column]}: must be positive and finite, "
            f"or blocked"
        )
