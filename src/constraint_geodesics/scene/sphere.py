"""A sphere."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from constraint_geodesics.fields import Positive, Vector3
from constraint_geodesics.scene.pieces import Piece
from constraint_geodesics.scene.shape import Placement, RoundedBox, Shape, add_body


@dataclass(frozen=True)
class Sphere(Shape):
    """A sphere: its centre and radius [m]."""

    name: str
    centre_m: Vector3
    radius_m: Positive
    exempt_links: tuple[str, ...] = ()
    kind: Literal["sphere"] = "sphere"

    @property
    def at(self) -> Placement:
        """Its centre."""
        return Placement(self.centre_m)

    def pieces(self) -> tuple[Piece, ...]:
        """A box without edges, rounded by the radius."""
        return (RoundedBox(self.centre_m, (0.0, 0.0, 0.0), self.radius_m).piece(),)

    def placed(self, at: Placement) -> "Sphere":
        """About another centre."""
        return replace(self, centre_m=at.position_m)

    def add_to(self, bullet: Any) -> int:
        """A sphere of PyBullet."""
        kind = bullet.GEOM_SPHERE
        return add_body(bullet, self.centre_m, shapeType=kind, radius=self.radius_m)

    def drawn(self, rerun: Any, style: Mapping[str, Any]) -> Any:
        """An ellipsoid of Rerun."""
        return rerun.Ellipsoids3D(centers=[self.centre_m], radii=[self.radius_m], **style)
