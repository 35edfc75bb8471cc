"""A plane with a conformal metric known at the nodes of a regular grid."""

import math
from dataclasses import dataclass, field

import numpy as np
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
"""How steeply g rises into blocked cells: in multiples of the largest free value, a step."""

OPENING = 0.3
"""How much of the distance from a door a fence takes back of its margin."""


class GridError(GeometryError):
    """Arrays or bounds that are no grid of a metric; names the input and what is allowed."""


@dataclass(frozen=True, eq=False)
class GridManifold:
    """The metric M(z) = g(z) I on a rectangle, g given at the nodes of a grid and bilinear between.

    values: g (rows, columns), rows along the first coordinate, positive; +inf blocks a node.
    lower, upper: chart coordinates of the first and last node of both axes.
    blocked: nodes that don't belong to the manifold, beside those of infinite value, None for no
    other; what `values` holds there is never read.  A point is blocked where its nearest node is.
    For the points in between a blocked node carries the value of the free node nearest to it, so
    that free cells are measured by free values alone.  Inside blocked cells g leads out: WALL times
    the largest free value is added for each step of depth, a step being that of the finer axis.
    Raises GridError on a shape that is no grid, bounds that don't rise, values that aren't positive
    at the free nodes, or if every node is blocked.
    """

    values: Float[Tensor, "rows columns"]
    lower: Bounds
    upper: Bounds
    blocked: Bool[Tensor, "rows columns"] | None = None
    _filled: Float[Tensor, "rows columns"] = field(init=False, repr=False)
    _clearance: Float[Tensor, "rows2 columns2"] | None = field(init=False, repr=False)

    def __post_init__(self) -> None:
        _require_grid(self.values.shape, self.lower, self.upper)
        _require_values(self.values, self.blocked)
        walls = self._walls
        # A frozen dataclass has no other way to keep what it derives.
        object.__setattr__(self, "_filled", _without_walls(self.values, walls, self.spacing))
        object.__setattr__(self, "_clearance", _clearance(walls, self.spacing))

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

    @property
    def step(self) -> float:
        """The finer axis's distance of neighbouring nodes."""
        return min(self.spacing)

    def metric(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch N N"]:
        """The matrix g(z) I, differentiable in z; finite and positive everywhere.

        Outside the grid it is that of the grid's nearest point, its gradient across the border 0.
        At a coordinate that is not finite it is not either, as on the other manifolds: values are
        checked once, by who measures.
        """
        require_dim(z, self.dim, "z")
        factor = self._free(z)
        if self._clearance is not None:
            factor = factor + self._slope * (-self._room(z)).clamp(min=0)
        return _conformal(factor)

    def fenced(
        self, margin: float, height: float, doors: Float[Tensor, "k N"] | None = None
    ) -> "FencedGrid":
        """The same metric with a fence that begins `margin` steps before walls and edge, and leaves
        the doors free.
        """
        return FencedGrid(self, margin, height, doors)

    def clearance(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch"]:
        """Distance of each point to walls and edge in steps, negative beyond them; 0 on the border.

        Between the nodes and the points halfway between them it is bilinear.
        """
        require_dim(z, self.dim, "z")
        lower, upper = (
            torch.tensor(bound, dtype=z.dtype, device=z.device)
            for bound in (self.lower, self.upper)
        )
        edge = torch.minimum(z - lower, upper - z).amin(-1) / self.step
        return edge if self._clearance is None else torch.minimum(edge, self._room(z))

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
        infinite = self.values == torch.inf
        return infinite if self.blocked is None else infinite | self.blocked

    @property
    def _slope(self) -> Tensor:
        """Rise of g a step into a wall."""
        return WALL * self._filled.max()

    def _free(self, z: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
        """The free values between the nodes."""
        return _bilinear(self._filled, self._place(z))

    def _room(self, z: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
        """Distance to the walls in steps, negative inside them."""
        assert self._clearance is not None
        return _bilinear(self._clearance, 2 * self._place(z))

    def _place(self, z: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Position in steps of the grid, clamped to it."""
        lower, spacing, last = (
            torch.tensor(pair, dtype=z.dtype, device=z.device)
            for pair in (self.lower, self.spacing, [count - 1 for count in self.values.shape])
        )
        return ((z - lower) / spacing).clamp(torch.zeros_like(last), last)


@dataclass(frozen=True, eq=False)
class FencedGrid:
    """The metric of a grid with a fence before its walls and its edge, for descents that must not
    touch them.

    margin: steps from the border at which the fence begins.  height: how steep it is, in multiples
    of the grid's own walls; it rises with the square of the depth, so that its foot has no kink.
    doors: points at which it stands back as far as they do, and returns to the margin with OPENING
    of the distance from them: an end on the border would be thrown off it, and a spline swing out.
    """

    grid: GridManifold
    margin: float
    height: float
    doors: Float[Tensor, "k 2"] | None = None

    dim = 2

    def metric(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch N N"]:
        """The matrix g(z) I, differentiable in z; finite and positive everywhere."""
        require_dim(z, self.dim, "z")
        grid = self.grid
        depth = (self._foot(z) - grid.clearance(z)).clamp(min=0)
        return _conformal(grid._free(z) + self.height * grid._slope * depth.square())

    def _foot(self, z: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*#batch"]:
        """Steps from the border at which the fence begins at each point."""
        foot = torch.tensor(self.margin, dtype=z.dtype, device=z.device)
        for door in () if self.doors is None else self.doors.to(z):
            far = torch.linalg.vector_norm(z - door, dim=-1) / self.grid.step
            foot = torch.minimum(foot, self.grid.clearance(door).clamp(min=0) + OPENING * far)
        return foot


def _nodes(
    shape: tuple[int, int], lower: Bounds, upper: Bounds, like: Tensor
) -> Float[Tensor, "rows*columns 2"]:
    lines = [
        torch.linspace(low, high, count, dtype=like.dtype, device=like.device)
        for low, high, count in zip(lower, upper, shape, strict=True)
    ]
    return torch.cartesian_prod(*lines)


def _bilinear(
    values: Float[Tensor, "rows columns"], place: Float[Tensor, "*batch 2"]
) -> Float[Tensor, "*batch"]:
    """Values between the nodes at positions in steps."""
    last_cell = torch.tensor([count - 2 for count in values.shape], device=place.device)
    corner = torch.minimum(torch.nan_to_num(place.detach()).floor().long(), last_cell)
    row, column = corner.unbind(-1)
    across, along = (place - corner).unbind(-1)
    g = values.to(place)
    low = (1 - along) * g[row, column] + along * g[row, column + 1]
    high = (1 - along) * g[row + 1, column] + along * g[row + 1, column + 1]
    return (1 - across) * low + across * high


def _conformal(factor: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 2 2"]:
    return factor[..., None, None] * torch.eye(2, dtype=factor.dtype, device=factor.device)


def _without_walls(
    values: Float[Tensor, "rows columns"], walls: Bool[Tensor, "rows columns"], spacing: Bounds
) -> Float[Tensor, "rows columns"]:
    """The values, with those of blocked nodes taken from the free node nearest to each."""
    row, column = ndimage.distance_transform_edt(
        walls.cpu().numpy(), sampling=spacing, return_distances=False, return_indices=True
    )
    return values[torch.from_numpy(row).long(), torch.from_numpy(column).long()]


def _clearance(
    walls: Bool[Tensor, "rows columns"], spacing: Bounds
) -> Float[Tensor, "rows2 columns2"] | None:
    """Distance to the walls in steps, negative inside them, at the nodes and halfway between.

    Those halfway are the borders and corners of the nodes' cells, so that it is 0 exactly there,
    and between four of them nowhere of both signs.  None without walls.
    """
    if not walls.any():
        return None
    blocked = walls.cpu().numpy()
    step, sampling = min(spacing), tuple(width / 2 for width in spacing)
    to_wall, to_free = (
        ndimage.distance_transform_edt(~_closed(cells), sampling=sampling) / step
        for cells in (blocked, ~blocked)
    )
    return torch.from_numpy(to_wall - to_free)


def _closed(cells: Bool[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows2 columns2"]:
    """Which nodes and points halfway lie in some of the cells or on their border."""
    rows, columns = (2 * count - 1 for count in cells.shape)
    closed = np.zeros((rows, columns), dtype=bool)
    closed[::2, ::2] = cells
    closed[1::2, ::2] = cells[:-1] | cells[1:]
    closed[:, 1::2] = closed[:, :-1:2] | closed[:, 2::2]
    return closed


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


def _require_values(values: Tensor, blocked: Tensor | None) -> None:
    if not values.is_floating_point():
        raise GridError(f"values has dtype {values.dtype}: must be floating point")
    if blocked is not None and (blocked.dtype != torch.bool or blocked.shape != values.shape):
        raise GridError(
            f"blocked has shape {tuple(blocked.shape)} and dtype {blocked.dtype}: "
            f"must have that of values, {tuple(values.shape)}, and torch.bool"
        )
    free = values != torch.inf
    if blocked is not None:
        free = free & ~blocked
    if not free.any():
        raise GridError("blocked: every node is, at least one must be free")
    bad = torch.nonzero(free & ~(torch.isfinite(values) & (values > 0)))
    if len(bad):
        row, column = bad[0].tolist()
        raise GridError(
            f"values[{row}, {column}] = {values[row, column]}: must be positive and finite, "
            f"or blocked (+inf blocks a node)"
        )
