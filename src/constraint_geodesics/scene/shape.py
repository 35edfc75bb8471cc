"""What a shape of the workcell is for the planner, for PyBullet and for Rerun.

A new kind is one more file in this folder, and its name in shapes.py.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float
from pydantic import ConfigDict

from constraint_geodesics.robot.kinematics import RobotError
from constraint_geodesics.scene.pieces import Piece, box_corners

Triple = tuple[float, float, float]


class RoundedBox(NamedTuple):
    """All points within `rounding` of a box: its centre, half edges [m] and turn into the base
    frame (3, 3).  With half edges of 0 it is a sphere, with one that is not 0 a capsule.
    """

    centre: Triple
    half_edges: Triple
    rounding: float = 0.0
    turn: Float[np.ndarray, "3 3"] = np.eye(3)

    def piece(self) -> Piece:
        """It as a convex piece, in the base frame."""
        corners = box_corners(np.array(self.half_edges))
        box = np.array([*self.centre, *self.half_edges, *np.ravel(self.turn)])
        at = corners @ self.turn.T + np.array(self.centre)
        return Piece(at, self.rounding, box=box)


class PlacedUrdf(NamedTuple):
    """A URDF file at a pose in the base frame [m]."""

    file: Path
    position: Triple
    rotation: Float[np.ndarray, "3 3"]


class Shape(ABC):
    """A fixed body of the workcell, a frozen dataclass whose fields are its entries in params.yaml.

    `kind`: a Literal of its own, which tells the kinds apart there.  exempt_links: the robot's
    links that may touch it.
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")
    name: str
    exempt_links: tuple[str, ...]

    def pieces(self) -> tuple[Piece, ...]:
        """Convex pieces that cover it, in the base frame.  Raises RobotError where there are
        none.
        """
        raise RobotError(f"workcell {self.name!r}: a shape without pieces can't be bounded")

    def urdf_model(self) -> PlacedUrdf | None:
        """Its meshes, where it has some; they are drawn by Rerun itself."""
        return None

    @abstractmethod
    def add_to(self, bullet: Any) -> int:
        """Make its body in a world, with `bullet`'s functions of PyBullet; the body's index."""

    def drawn(self, rerun: Any, style: Mapping[str, Any]) -> Any:
        """Its archetype of the module `rerun`, in the style that all shapes share; None if it is
        drawn by its meshes.
        """
        return None


def add_body(bullet: Any, position: Triple, turn: Any = (0, 0, 0, 1), **geometry: Any) -> int:
    """A fixed body of PyBullet with one collision shape, turned by a quaternion x, y, z, w."""
    shape = bullet.createCollisionShape(**geometry)
    return int(bullet.createMultiBody(0, shape, basePosition=position, baseOrientation=turn))
