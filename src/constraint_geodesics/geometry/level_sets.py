"""Sub-manifolds that a level of one chart coordinate cuts out of the sphere and the torus, eqs. 7-8
and Fig. 2.
"""

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from constraint_geodesics.geometry.analytic import Sphere, Torus
from constraint_geodesics.geometry.graph import OUTSIDE
from constraint_geodesics.geometry.manifold import GeometryError, require_dim, require_finite

TOUCH = 1e-12
"""Bands this close [rad] touch: levels and tolerances written as decimals meet only up to rounding.
"""


class LevelSetError(GeometryError):
    """No circle is cut out by the input; the message names it, its value and what is allowed."""


@dataclass(frozen=True)
class LevelCircle:
    """The circle S¹ on which one chart coordinate of a sphere or torus is held, charted by the
    other one, u [rad].

    coordinate: index of the one held.  level: its value [rad].  Raises LevelSetError as LevelSet
    does.
    """

    manifold: Sphere | Torus
    coordinate: int
    level: float

    def __post_init__(self) -> None:
        _require_coordinate(self.manifold, self.coordinate)
        _require_level(self.manifold, "level", self.level)

    @property
    def dim(self) -> int:
        """1."""
        return 1

    @property
    def ambient_dim(self) -> int:
        """3."""
        return self.manifold.ambient_dim

    @property
    def periods(self) -> tuple[float]:
        """The coordinate wraps at 2π."""
        return (2 * math.pi,)

    @property
    def radius(self) -> float:
        """Radius of the circle, in the unit of the manifold's radii."""
        metric = self.manifold.metric(self.point(torch.zeros(1, dtype=torch.float64)))
        return math.sqrt(metric[1 - self.coordinate, 1 - self.coordinate])

    def point(self, u: Float[Tensor, "*batch 1"]) -> Float[Tensor, "*batch 2"]:
        """The point in the chart of the manifold that the circle lies on."""
        require_dim(u, self.dim, "u")
        held = torch.full_like(u, self.level)
        return torch.cat([held, u] if self.coordinate == 0 else [u, held], dim=-1)

    def embed(self, u: Float[Tensor, "*batch 1"]) -> Float[Tensor, "*batch 3"]:
        """The point in R³."""
        return self.manifold.embed(self.point(u))

    def metric(self, u: Float[Tensor, "*batch 1"]) -> Float[Tensor, "*batch 1 1"]:
        """The entry of the manifold's metric along the circle: its squared radius, everywhere."""
        free = 1 - self.coordinate
        return self.manifold.metric(self.point(u))[..., free : free + 1, free : free + 1]

    def distance(
        self, a: Float[Tensor, "*#batch 1"], b: Float[Tensor, "*#batch 1"]
    ) -> Float[Tensor, "*batch"]:
        """Length of the shorter arc, 0 to π times the radius: the way on the circle, not across the
        manifold.

        Raises NonFiniteError with the place of the first coordinate that is not finite.
        """
        for name, points in (("a", a), ("b", b)):
            require_dim(points, self.dim, name)
            require_finite(points, name)
        return self.radius * _wrapped(b - a)[..., 0].abs()


@dataclass(frozen=True)
class LevelSet:
    """The points where one chart coordinate is at one of several levels: a set of circles S¹.

    manifold, coordinate: Sphere with 0, its elevation (Fig. 2a); Torus with 1, its tube angle (Fig.
    2b), or with 0, its ring angle.  The sphere's azimuth is refused: its level sets run from pole
    to pole and don't close.
    levels: values of that coordinate [rad], at least one.  Levels that differ by whole periods are
    one.
    tolerance: deviation of the coordinate that still counts as held [rad], at least 0; the set is
    then made of bands about the levels.  Bands that overlap or touch (to 1e-12 rad) are one
    component.
    Raises LevelSetError on anything else, such as an elevation at a pole, |θ| ≥ π/2, where the
    circle has no length.
    """

    manifold: Sphere | Torus
    coordinate: int
    levels: tuple[float, ...]
    tolerance: float = 0.0

    def __post_init__(self) -> None:
        _require_coordinate(self.manifold, self.coordinate)
        if not self.levels:
            raise LevelSetError("levels = (): must hold at least one")
        for k, level in enumerate(self.levels):
            _require_level(self.manifold, f"levels[{k}]", level)
        if not (math.isfinite(self.tolerance) and self.tolerance >= 0):
            raise LevelSetError(f"tolerance = {self.tolerance}: must be finite and at least 0")

    def inclusion(self, z: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
        """The inclusion map ι(z) [rad], eqs. 7-8: how far the coordinate is from the nearest level,
        beyond `tolerance`.

        Zero to the bit where the constraint holds.  Elevations beyond a pole are understood.
        Raises NonFiniteError with the place of the first coordinate that is not finite.
        """
        return (self._deviations(z).amin(-1) - self.tolerance).clamp(min=0)

    def components(self) -> tuple[LevelCircle, ...]:
        """The connected components, by rising level from −π.

        A band that several levels share is given by the circle of the one that `levels` names
        first.
        """
        return tuple(self._circle(min(level.number for level in group)) for group in self._groups())

    def component_of(self, z: Float[Tensor, "*batch 2"]) -> Int[Tensor, "*batch"]:
        """Index of each point's component in `components()`, −1 where the constraint doesn't
        hold.
        """
        component = [0] * len(self.levels)
        for index, group in enumerate(self._groups()):
            for level in group:
                component[level.number] = index
        nearest = self._deviations(z).argmin(-1)
        found = torch.tensor(component, device=z.device)[nearest]
        return torch.where(self.inclusion(z) > 0, OUTSIDE, found)

    def _circle(self, index: int) -> LevelCircle:
        return LevelCircle(self.manifold, self.coordinate, self.levels[index])

    def _deviations(self, z: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch L"]:
        """Distance of the coordinate to each level, [rad]."""
        require_dim(z, self.manifold.dim, "z")
        require_finite(z, "z")
        held = z[..., self.coordinate]
        if isinstance(self.manifold, Sphere):
            # Elevation by way of the embedded point is inexact by a bit, so only where it has to
            # be.
            held = torch.where(held.abs() <= math.pi / 2, held, self.manifold.elevation(z))
        offsets = held[..., None] - torch.tensor(self.levels, dtype=z.dtype, device=z.device)
        return (_wrapped(offsets) if self._wraps else offsets).abs()

    @property
    def _wraps(self) -> bool:
        return math.isfinite(self.manifold.periods[self.coordinate])

    def _groups(self) -> list[list["_Level"]]:
        """The levels by component, in the order of `components`."""
        width = 2 * self.tolerance + TOUCH
        levels = torch.tensor(self.levels, dtype=torch.float64)
        values = _wrapped(levels) if self._wraps else levels
        ordered = sorted(_Level(value, number) for number, value in enumerate(values.tolist()))
        groups = [[ordered[0]]]
        for before, level in itertools.pairwise(ordered):
            if level.value - before.value > width:
                groups.append([])
            groups[-1].append(level)
        if (
            self._wraps
            and len(groups) > 1
            and ordered[0].value + 2 * math.pi - ordered[-1].value <= width
        ):
            # The last band runs on into the first across the seam of the chart.
            groups = [*groups[1:-1], groups[-1] + groups[0]]
        return groups


class _Level(NamedTuple):
    """A level by its value on the chart's coordinate, wrapped to [−π, π] if that repeats, and its
    place in `levels`.
    """

    value: float
    number: int


def _wrapped(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """An angle's image in [−π, π], exact for those within it."""
    return angle - 2 * math.pi * torch.round(angle / (2 * math.pi))


def _require_coordinate(manifold: Sphere | Torus, coordinate: int) -> None:
    if coordinate not in (0, 1):
        raise LevelSetError(f"coordinate = {coordinate}: must be 0 or 1")
    if not math.isfinite(manifold.periods[1 - coordinate]):
        raise LevelSetError(
            f"coordinate = {coordinate}: the other one doesn't repeat, so its level sets "
            f"don't close"
        )


def _require_level(manifold: Sphere | Torus, name: str, level: float) -> None:
    if not math.isfinite(level):
        raise LevelSetError(f"{name} = {level}: must be finite")
    if isinstance(manifold, Sphere) and abs(level) >= math.pi / 2:
        raise LevelSetError(
            f"{name} = {level}: an elevation must lie between the poles, −π/2 to π/2"
        )
