"""A mesh from a file, as a part or a fixture."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from constraint_geodesics.fields import Positive
from constraint_geodesics.robot.kinematics import RobotError
from constraint_geodesics.scene.pieces import HULL_MARGIN, Piece, file_digest
from constraint_geodesics.scene.shape import Placement, Shape, add_mesh
from constraint_geodesics.scene.triangles import Triangles, convex_pieces, read_triangles


@dataclass(frozen=True)
class Mesh(Shape):
    """The triangles of an OBJ, STL or Collada file, placed by the file's own frame.

    pose: a Placement, or a Pose.  scale: of the file's numbers, which are metres by default.  What
    is not convex is covered by convex parts.
    """

    reads_files: ClassVar[bool] = True
    name: str
    file: str | Path
    pose: Placement = field(default_factory=Placement)
    exempt_links: tuple[str, ...] = ()
    kind: Literal["mesh"] = "mesh"
    scale: Positive = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "pose", Placement.of(self.pose))

    @property
    def at(self) -> Placement:
        """Its pose."""
        return self.pose

    def pieces(self) -> tuple[Piece, ...]:
        """The convex parts, and the margin that PyBullet has around the boxes of links that come
        near triangles.
        """
        found = _pieces(*self._read(), self.scale)
        return tuple(piece.at(self.pose.matrix) for piece in found)

    def placed(self, at: Placement) -> "Mesh":
        """With the file's frame elsewhere."""
        return replace(self, pose=at)

    def add_to(self, bullet: Any) -> int:
        """The triangles themselves, to PyBullet."""
        file, digest = self._read()

        def mesh() -> Any:
            places = _scaled(file, digest, self.scale).places().reshape(-1, 3)
            return np.unique(places, axis=0, return_inverse=True)

        key = f"{digest}{file.suffix.lower()} {self.scale!r}"
        return add_mesh(bullet, self.pose, key, mesh)

    def drawn(self, rerun: Any, style: Mapping[str, Any]) -> Any:
        """A mesh of Rerun."""
        mesh = _scaled(*self._read(), self.scale)
        corners = mesh.corners @ self.pose.turn.T + self.pose.position_m
        colour = style["colors"][0]
        return rerun.Mesh3D(
            vertex_positions=corners, triangle_indices=mesh.faces, albedo_factor=colour
        )

    def _read(self) -> tuple[Path, str]:
        """The file, and what is in it."""
        try:
            return Path(self.file), file_digest(Path(self.file))
        except OSError as error:
            line = f"{self.name!r}: there is no mesh {str(self.file)!r}: {error.strerror}"
            raise RobotError(line) from None


@lru_cache(maxsize=64)
def _scaled(file: Path, digest: str, scale: float) -> Triangles:
    mesh = read_triangles(file, digest)
    return Triangles(scale * mesh.corners, mesh.faces)


@lru_cache(maxsize=64)
def _pieces(file: Path, digest: str, scale: float) -> tuple[Piece, ...]:
    mesh = _scaled(file, digest, scale)
    try:
        found = convex_pieces(mesh)
    except RobotError as error:
        raise RobotError(f"{file}: {error}") from None
    return tuple(piece._replace(rounding=HULL_MARGIN, margin=HULL_MARGIN) for piece in found)
