"""Manifolds whose answer is known: plane, sphere S² and torus T², and circles cut out of them.

They are the oracle that every solver is tested against, and the examples of Fig. 2.  Only the
torus' distance is no closed form, but a root of an elliptic integral.
"""

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from constraint_geodesics.geometry.graph import OUTSIDE
from constraint_geodesics.geometry.manifold import GeometryError, require_dim, require_finite
from constraint_geodesics.geometry.torus_distance import torus_distance

Points = Float[Tensor, "*#batch N"]


@dataclass(frozen=True)
class Plane:
    """The flat space R^N in Cartesian coordinates, embedded as itself.

    dim: N, at least 1.  Raises GeometryError otherwise.
    """

    dim: int = 2

    def __post_init__(self) -> None:
        if self.dim < 1:
            raise GeometryError(f"dim = {self.dim}: must be at least 1")

    @property
    def ambient_dim(self) -> int:
        """N."""
        return self.dim

    def embed(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch N"]:
        """The point itself."""
        require_dim(z, self.dim, "z")
        return z

    def metric(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch N N"]:
        """The identity everywhere."""
        require_dim(z, self.dim, "z")
        return torch.eye(self.dim, dtype=z.dtype, device=z.device).expand(*z.shape, self.dim)

    def distance(self, a: Points, b: Points) -> Float[Tensor, "*batch"]:
        """Euclidean distance.  Raises NonFiniteError with the place of the first bad coordinate."""
        _require_points(self.dim, a, b)
        return torch.linalg.vector_norm(b - a, dim=-1)


@dataclass(frozen=True)
class Sphere:
    """The sphere S² in R³, chart z = (elevation θ, azimuth α) [rad].

    The chart is regular for |θ| < π/2; at the poles the metric loses a rank.  Azimuth wraps at 2π.
    radius: positive, in the unit of every length.  Raises GeometryError otherwise.
    """

    radius: float = 1.0

    def __post_init__(self) -> None:
        _require_positive("radius", self.radius)

    dim = 2
    ambient_dim = 3
    periods = (math.inf, 2 * math.pi)
    """The azimuth wraps; the elevation is reflected at the poles, but has no period."""

    def embed(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch 3"]:
        """The point r (cos θ cos α, cos θ sin α, sin θ)."""
        require_dim(z, self.dim, "z")
        elevation, azimuth = z.unbind(-1)
        ring = torch.cos(elevation)
        unit = torch.stack(
            [ring * torch.cos(azimuth), ring * torch.sin(azimuth), torch.sin(elevation)], dim=-1
        )
        return self.radius * unit

    def metric(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch N N"]:
        """The matrix r² diag(1, cos² θ)."""
        require_dim(z, self.dim, "z")
        ring = torch.cos(z[..., 0])
        return self.radius**2 * torch.diag_embed(
            torch.stack([torch.ones_like(ring), ring**2], dim=-1)
        )

    def distance(self, a: Points, b: Points) -> Float[Tensor, "*batch"]:
        """Length of the shorter great circle arc, 0 to πr.

        The arc is 2r atan2(sin(δ/2), cos(δ/2)), with both squares written as sums in the chart
        (haversines), so that inside the chart nothing cancels: coincident and antipodal points keep
        full accuracy, where acos(a·b) loses half its digits.  Elevations beyond a pole are
        understood, with an error of up to 5e-8 r.
        Raises NonFiniteError with the first bad coordinate.
        """
        _require_points(self.dim, a, b)
        half_rise, half_turn = ((b - a) / 2).unbind(-1)
        rings = torch.cos(a[..., 0]) * torch.cos(b[..., 0])
        near = torch.sin(half_rise) ** 2 + rings * torch.sin(half_turn) ** 2
        far = torch.sin((a[..., 0] + b[..., 0]) / 2) ** 2 + rings * torch.cos(half_turn) ** 2
        # Beyond a pole `rings` is negative, and rounding may leave a square just below zero.
        return 2 * self.radius * torch.atan2(near.clamp(min=0).sqrt(), far.clamp(min=0).sqrt())

    def elevation(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch"]:
        """Elevation of the embedded point, −π/2 to π/2 [rad]; Fig. 2a shows its level sets."""
        require_dim(z, self.dim, "z")
        return torch.atan2(torch.sin(z[..., 0]), torch.cos(z[..., 0]).abs())


@dataclass(frozen=True)
class Torus:
    """The torus T² = S¹ × S¹ in R³, chart z = (ring angle u, tube angle v) [rad]; both wrap at 2π.

    major: radius R of the ring that the tube's centre draws around the z axis.  minor: radius r of
    the tube. v = 0 is the outer equator, v = π the inner one.  Raises GeometryError unless 0 < r <
    R.
    """

    major: float = 2.0
    minor: float = 1.0

    def __post_init__(self) -> None:
        _require_positive("major", self.major)
        _require_positive("minor", self.minor)
        if self.minor >= self.major:
            raise GeometryError(
                f"minor = {self.minor}: must be below major = {self.major}, or the tube meets "
                f"itself"
            )

    dim = 2
    ambient_dim = 3
    periods = (2 * math.pi, 2 * math.pi)

    def embed(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch 3"]:
        """The point ((R + r cos v) cos u, (R + r cos v) sin u, r sin v)."""
        require_dim(z, self.dim, "z")
        ring_angle, tube_angle = z.unbind(-1)
        ring = self.major + self.minor * torch.cos(tube_angle)
        height = self.minor * torch.sin(tube_angle)
        return torch.stack(
            [ring * torch.cos(ring_angle), ring * torch.sin(ring_angle), height], dim=-1
        )

    def metric(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch N N"]:
        """The matrix diag((R + r cos v)², r²)."""
        require_dim(z, self.dim, "z")
        ring = self.major + self.minor * torch.cos(z[..., 1])
        return torch.diag_embed(
            torch.stack([ring**2, torch.full_like(ring, self.minor**2)], dim=-1)
        )

    def distance(self, a: Points, b: Points) -> Float[Tensor, "*batch"]:
        """Length of the shortest of all geodesics between two points, whichever way round the ring
        and the tube.

        From Clairaut's relation (`torus_distance`), computed in float64 on the processor: the error
        is a few 1e-15 R for R ≥ 1.1 r and grows to 2e-13 R at R = 1.0001 r.  Symmetric to the bit,
        0 where a equals b.
        An oracle, not a loss: the result carries no gradient.
        Raises NonFiniteError with the first bad coordinate.
        """
        _require_points(self.dim, a, b)
        dtype = torch.promote_types(torch.result_type(a, b), torch.float32)
        pairs = [ends.detach().to("cpu", torch.float64) for ends in torch.broadcast_tensors(a, b)]
        lengths = torus_distance(
            self.major, self.minor, *(ends.reshape(-1, self.dim).numpy() for ends in pairs)
        )
        return torch.from_numpy(lengths).reshape(pairs[0].shape[:-1]).to(a.device, dtype)

    def tube_angle(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch"]:
        """Angle around the tube, −π to π [rad]: Fig. 2b's sub-manifolds are its level sets."""
        require_dim(z, self.dim, "z")
        return torch.atan2(torch.sin(z[..., 1]), torch.cos(z[..., 1]))


def _require_positive(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise GeometryError(f"{name} = {value}: must be positive and finite")


def _require_points(dim: int, a: Tensor, b: Tensor) -> None:
    for name, points in (("a", a), ("b", b)):
        require_dim(points, dim, name)
        require_finite(points, name)


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

    dim = 1
    ambient_dim = 3
    periods = (2 * math.pi,)

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

    def distance(self, a: Points, b: Points) -> Float[Tensor, "*batch"]:
        """Length of the shorter arc, 0 to π times the radius: the way on the circle, not across the
        manifold.

        Raises NonFiniteError with the first bad coordinate.
        """
        _require_points(self.dim, a, b)
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
        Raises NonFiniteError with the first bad coordinate.
        """
        return (self._deviations(z).amin(-1) - self.tolerance).clamp(min=0)

    def components(self) -> tuple[LevelCircle, ...]:
        """The connected components, by rising level from −π.

        A band that several levels share is given by the circle of the one that `levels` names
        first.
        """
        return tuple(self._circle(min(level.number for level in group)) for group in self._groups())

    def component_of(self, z: Float[Tensor, "*batch 2"]) -> Int[Tensor, "*batch"]:
        """Each point's place in `components()`, −1 where the constraint doesn't hold."""
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
    """A level's value, wrapped to [−π, π] if the coordinate repeats, and its place in `levels`."""

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
