"""A box."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from constraint_geodesics.fields import Angles3, Positive, Vector3
from constraint_geodesics.scene.pieces import Piece
from constraint_geodesics.scene.shape import Placement, RoundedBox, Shape, Triple, add_body


@dataclass(frozen=True)
class Box(Shape):
    """A box: its centre and edge lengths [m], and how its edges are turned from the base frame's
    axes [rad].
    """

    name: str
    centre_m: Vector3
    size_m: tuple[Positive, Positive, Positive]
    exempt_links: tuple[str, ...] = ()
    kind: Literal["box"] = "box"
    rpy_rad: Angles3 = (0.0, 0.0, 0.0)

    @property
    def at(self) -> Placement:
        """Its centre, turned as its edges are."""
        return Placement(self.centre_m, self.rpy_rad)

    @property
    def _half_edges(self) -> Triple:
        x, y, z = self.size_m
        return 0.5 * x, 0.5 * y, 0.5 * z

    def pieces(self) -> tuple[Piece, ...]:
        """It is one, without rounding."""
        turn = self.at.turn
        return (RoundedBox(self.centre_m, self._half_edges, turn=turn).piece(),)

    def placed(self, at: Placement) -> "Box":
        """About another centre, and turned."""
        return replace(self, centre_m=at.position_m, rpy_rad=at.rpy_rad)

    def add_to(self, bullet: Any) -> int:
        """A box of PyBullet."""
        kind = bullet.GEOM_BOX
        turn, size = self.at.quaternion, self._half_edges
        return add_body(bullet, self.centre_m, turn, shapeType=kind, halfExtents=size)

    def drawn(self, rerun: Any, style: Mapping[str, Any]) -> Any:
        """A box of Rerun."""
        turn = rerun.Quaternion(xyzw=self.at.quaternion)
        size = {"sizes": [self.size_m], "quaternions": [turn]}
        return rerun.Boxes3D(centers=[self.centre_m], **size, **style)
