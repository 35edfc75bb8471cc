"""A box along the axes of the base frame."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from constraint_geodesics.fields import Positive, Vector3
from constraint_geodesics.scene.pieces import Piece
from constraint_geodesics.scene.shape import RoundedBox, Shape, Triple, add_body


@dataclass(frozen=True)
class Box(Shape):
    """A box: its centre and edge lengths [m]."""

    name: str
    centre_m: Vector3
    size_m: tuple[Positive, Positive, Positive]
    exempt_links: tuple[str, ...] = ()
    kind: Literal["box"] = "box"

    @property
    def _half_edges(self) -> Triple:
        x, y, z = self.size_m
        return 0.5 * x, 0.5 * y, 0.5 * z

    def pieces(self) -> tuple[Piece, ...]:
        """It is one, without rounding."""
        return (RoundedBox(self.centre_m, self._half_edges).piece(),)

    def add_to(self, bullet: Any) -> int:
        """A box of PyBullet."""
        kind = bullet.GEOM_BOX
        return add_body(bullet, self.centre_m, shapeType=kind, halfExtents=self._half_edges)

    def drawn(self, rerun: Any, style: Mapping[str, Any]) -> Any:
        """A box of Rerun."""
        return rerun.Boxes3D(centers=[self.centre_m], sizes=[self.size_m], **style)
