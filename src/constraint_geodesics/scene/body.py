"""A body read from a URDF."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from constraint_geodesics.fields import Angles3, Vector3
from constraint_geodesics.robot.kinematics import rotation_from_rpy
from constraint_geodesics.scene.pieces import Piece, read_pieces
from constraint_geodesics.scene.shape import PlacedUrdf, Placement, Shape
from constraint_geodesics.scene.urdf import find_urdf, quiet


@dataclass(frozen=True)
class Body(Shape):
    """A URDF at a pose [m, rad]: a path in this checkout, or one in pybullet_data."""

    reads_files: ClassVar[bool] = True
    name: str
    urdf: str | Path
    position_m: Vector3 = (0.0, 0.0, 0.0)
    rpy_rad: Angles3 = (0.0, 0.0, 0.0)
    exempt_links: tuple[str, ...] = ()
    kind: Literal["urdf"] = "urdf"

    @property
    def at(self) -> Placement:
        """The pose of the URDF's root."""
        return Placement(self.position_m, self.rpy_rad)

    def placed(self, at: Placement) -> "Body":
        """The URDF elsewhere."""
        return replace(self, position_m=at.position_m, rpy_rad=at.rpy_rad)

    def urdf_model(self) -> PlacedUrdf:
        """The URDF at its pose."""
        turn = rotation_from_rpy(np.array(self.rpy_rad))
        return PlacedUrdf(find_urdf(self.urdf), self.position_m, turn)

    def pieces(self) -> tuple[Piece, ...]:
        """Those of all its links."""
        model, pose = self.urdf_model(), np.eye(4)
        pose[:3, :3], pose[:3, 3] = model.rotation, model.position
        return tuple(p.at(pose) for link in read_pieces(model.file) for p in link.pieces)

    def add_to(self, bullet: Any) -> int:
        """All of the URDF, its moving joints at 0."""
        with quiet():
            return int(
                bullet.loadURDF(
                    str(find_urdf(self.urdf)),
                    basePosition=self.position_m,
                    baseOrientation=bullet.getQuaternionFromEuler(self.rpy_rad),
                    useFixedBase=True,
                )
            )
