"""A cylinder, as a cup, a bottle or a table's leg."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from constraint_geodesics.fields import Positive
from constraint_geodesics.scene.pieces import HULL_MARGIN, Piece, prism
from constraint_geodesics.scene.shape import Placement, Shape, add_body

SIDES = 64
"""Of the prism around it."""


@dataclass(frozen=True)
class Cylinder(Shape):
    """A cylinder along the z axis of its own frame, about whose origin it lies: length and radius
    [m].  pose: a Placement, or a Pose.
    """

    name: str
    pose: Placement
    length_m: Positive
    radius_m: Positive
    exempt_links: tuple[str, ...] = ()
    kind: Literal["cylinder"] = "cylinder"

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "pose", Placement.of(self.pose))

    @property
    def at(self) -> Placement:
        """Its pose."""
        return self.pose

    def pieces(self) -> tuple[Piece, ...]:
        """The prism around it, and PyBullet's margin, since that takes a hull within it."""
        half = 0.5 * self.length_m
        around = Piece(prism(SIDES, self.radius_m, -half, half), HULL_MARGIN, margin=HULL_MARGIN)
        return (around.at(self.pose.matrix),)

    def placed(self, at: Placement) -> "Cylinder":
        """With its frame elsewhere."""
        return replace(self, pose=at)

    def add_to(self, bullet: Any) -> int:
        """A cylinder of PyBullet."""
        size = {"radius": self.radius_m, "height": self.length_m}
        place, turn = self.pose.position_m, self.pose.quaternion
        return add_body(bullet, place, turn, shapeType=bullet.GEOM_CYLINDER, **size)

    def drawn(self, rerun: Any, style: Mapping[str, Any]) -> Any:
        """A cylinder of Rerun."""
        turn = rerun.Quaternion(xyzw=self.pose.quaternion)
        size = {"lengths": [self.length_m], "radii": [self.radius_m]}
        centre = [self.pose.position_m]
        return rerun.Cylinders3D(centers=centre, quaternions=[turn], **size, **style)
