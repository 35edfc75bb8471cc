"""A capsule: a cylinder in any direction with a half sphere on either end, as a pipe or a post."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from constraint_geodesics.fields import Positive, Vector3
from constraint_geodesics.robot.kinematics import rpy_of
from constraint_geodesics.scene.pieces import Piece
from constraint_geodesics.scene.shape import Placement, RoundedBox, Shape, add_body

ROUNDING_M = 1e-9
"""Difference of two lengths below which they are one."""


@dataclass(frozen=True)
class Capsule(Shape):
    """All points within a radius of the line from one point to another [m]."""

    name: str
    from_m: Vector3
    to_m: Vector3
    radius_m: Positive
    exempt_links: tuple[str, ...] = ()
    kind: Literal["capsule"] = "capsule"

    @cached_property
    def length_m(self) -> float:
        """Of the line between its ends, without the half spheres."""
        return math.dist(self.to_m, self.from_m)

    @cached_property
    def at(self) -> Placement:
        """Its middle, with the z axis along its line."""
        x, y, z = (0.5 * (a + b) for a, b in zip(self.from_m, self.to_m, strict=True))
        return Placement((x, y, z), rpy_of(self._turn))

    def pieces(self) -> tuple[Piece, ...]:
        """A box with one edge, along the line, rounded by the radius."""
        half_edges = (0.0, 0.0, 0.5 * self.length_m)
        return (RoundedBox(self.at.position_m, half_edges, self.radius_m, self._turn).piece(),)

    def placed(self, at: Placement) -> "Capsule":
        """With its middle elsewhere, and its line along the z axis there."""
        middle, half = np.array(at.position_m), 0.5 * self.length_m * at.turn[:, 2]
        first, last = (middle - half).tolist(), (middle + half).tolist()
        return replace(self, from_m=tuple(first), to_m=tuple(last))

    def is_like(self, other: Shape) -> bool:
        """Its ends are rounded where it is placed, and with them its length."""
        if not isinstance(other, Capsule) or abs(self.length_m - other.length_m) > ROUNDING_M:
            return False
        return self == replace(other, from_m=self.from_m, to_m=self.to_m)

    def add_to(self, bullet: Any) -> int:
        """A capsule of PyBullet, which has it along its z axis."""
        size = {"radius": self.radius_m, "height": self.length_m}
        kind = bullet.GEOM_CAPSULE
        return add_body(bullet, self.at.position_m, self.at.quaternion, shapeType=kind, **size)

    def drawn(self, rerun: Any, style: Mapping[str, Any]) -> Any:
        """A capsule of Rerun, which begins at the origin and runs along its z axis."""
        turn = rerun.Quaternion(xyzw=self.at.quaternion)
        size = {"lengths": [self.length_m], "radii": [self.radius_m]}
        return rerun.Capsules3D(translations=[self.from_m], quaternions=[turn], **size, **style)

    @cached_property
    def _turn(self) -> Float[np.ndarray, "3 3"]:
        """Turns the z axis into the direction of the line."""
        if not self.length_m > 0.0:
            return np.eye(3)
        axis = np.subtract(self.to_m, self.from_m) / self.length_m
        across = _cross(np.eye(3)[np.abs(axis).argmin()], axis)
        across /= np.linalg.norm(across)
        return np.column_stack([across, _cross(axis, across), axis])


def _cross(a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """`np.cross`, at a tenth of its cost."""
    (x, y, z), (u, v, w) = a.tolist(), b.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])
