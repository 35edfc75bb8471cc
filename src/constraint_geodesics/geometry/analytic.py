"""Manifolds whose answer is known: the plane, the sphere S² and the torus T², in closed form.

Only the torus' distance takes more, a root of an elliptic integral.  They are the oracle every
solver is tested against, and the examples of Fig. 2.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from constraint_geodesics.geometry.manifold import GeometryError, require_dim, require_finite
from constraint_geodesics.geometry.torus_distance import torus_distance


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

    def distance(
        self, a: Float[Tensor, "*#batch N"], b: Float[Tensor, "*#batch N"]
    ) -> Float[Tensor, "*batch"]:
        """Euclidean distance.  Raises NonFiniteError with the place of the first coordinate that is
        not finite.
        """
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

    @property
    def dim(self) -> int:
        """2."""
        return 2

    @property
    def ambient_dim(self) -> int:
        """3."""
        return 3

    @property
    def periods(self) -> tuple[float, float]:
        """The azimuth wraps at 2π; the elevation has a reflection beyond the poles, but no period
        of its own.
        """
        return math.inf, 2 * math.pi

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

    def distance(
        self, a: Float[Tensor, "*#batch N"], b: Float[Tensor, "*#batch N"]
    ) -> Float[Tensor, "*batch"]:
        """Length of the shorter great circle arc, 0 to πr.

        The arc is 2r atan2(sin(δ/2), cos(δ/2)), with both squares written as sums in the chart
        (haversines), so that inside the chart nothing cancels: coincident and antipodal points keep
        full accuracy, where acos(a·b) loses half its digits.  Elevations beyond a pole are
        understood, with an error of up to 5e-8 r.
        Raises NonFiniteError with the place of the first coordinate that is not finite.
        """
        _require_points(self.dim, a, b)
        half_rise, half_turn = ((b - a) / 2).unbind(-1)
        rings = torch.cos(a[..., 0]) * torch.cos(b[..., 0])
        near = torch.sin(half_rise) ** 2 + rings * torch.sin(half_turn) ** 2
        far = torch.sin((a[..., 0] + b[..., 0]) / 2) ** 2 + rings * torch.cos(half_turn) ** 2
        # Beyond a pole `rings` is negative, and rounding may leave a square just below zero.
        return 2 * self.radius * torch.atan2(near.clamp(min=0).sqrt(), far.clamp(min=0).sqrt())

    def elevation(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch"]:
        """Elevation of the embedded point, −π/2 to π/2 [rad]: Fig. 2a's sub-manifolds are its level
        sets.
        """
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

    @property
    def dim(self) -> int:
        """2."""
        return 2

    @property
    def ambient_dim(self) -> int:
        """3."""
        return 3

    @property
    def periods(self) -> tuple[float, float]:
        """Both angles wrap at 2π."""
        return 2 * math.pi, 2 * math.pi

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

    def distance(
        self, a: Float[Tensor, "*#batch N"], b: Float[Tensor, "*#batch N"]
    ) -> Float[Tensor, "*batch"]:
        """Length of the shortest of all geodesics between two points, whichever way round the ring
        and the tube.

        From Clairaut's relation (`torus_distance`), computed in float64 on the processor: the error
        is a few 1e-15 R for R ≥ 1.1 r and grows to 2e-13 R at R = 1.0001 r.  Symmetric to the bit,
        0 where a equals b.
        An oracle, not a loss: the result carries no gradient.
        Raises NonFiniteError with the place of the first coordinate that is not finite.
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
