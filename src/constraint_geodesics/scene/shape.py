"""What a shape of the workcell is for the planner, for PyBullet and for Rerun.

A new kind is one more file in this folder, and its name in shapes.py.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from math import inf
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from jaxtyping import Float
from pydantic import ConfigDict

from constraint_geodesics.fields import Angles3, Vector3
from constraint_geodesics.robot.kinematics import RobotError, rotation_from_rpy, rpy_of
from constraint_geodesics.scene.pieces import Piece, box_corners
from constraint_geodesics.values import LARGEST, are_usable, checked_path, numbers, shown

Triple = tuple[float, float, float]


class ShapeError(ValueError):
    """A shape that there can't be; the message names it, its field, the value and what is
    allowed.
    """


_SINGLE = ("radius_m", "length_m", "scale")
"""Fields of shapes that are one number and positive."""
_SIZES = ("size_m", *_SINGLE)
"""All that must be positive."""
_TRIPLES = ("centre_m", "size_m", "from_m", "to_m", "position_m", "rpy_rad")
"""Those that are three; what further fields of shapes of one's own are, one or three, only they
know.
"""


def _numbers(shape: str, name: str, value: Any) -> Any:
    """A field as a float, or a tuple of three."""
    dimensions = [()] if name in _SINGLE else [(3,)] if name in _TRIPLES else [(), (3,)]
    least = 0.0 if name in _SIZES else -inf
    is_triple = type(value) is tuple and [type(own) for own in value] == [float] * 3
    usable = is_triple and all(least < own and abs(own) <= LARGEST for own in value)
    if usable and name not in _SINGLE:  # soon seen, as of most
        return value
    given = numbers(value)
    if given is None or given.shape not in dimensions:
        count = " or ".join("three numbers" if own else "a number" for own in dimensions)
        raise ShapeError(f"{shape!r}: {name} = {shown(value)}: must be {count}")
    if not are_usable(given) or not (given > least).all():
        what = "positive and finite" if name in _SIZES else "finite"
        raise ShapeError(f"{shape!r}: {name} = {shown(value)}: must be {what}")
    return float(given) if given.ndim == 0 else tuple(given.tolist())


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


@dataclass(frozen=True)
class Placement:
    """Where a shape's own frame is in the base frame: its position [m], and its roll, pitch and yaw
    about the fixed axes [rad].
    """

    position_m: Vector3 = (0.0, 0.0, 0.0)
    rpy_rad: Angles3 = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("position_m", "rpy_rad"):
            own = _numbers("placement", name, getattr(self, name))
            object.__setattr__(self, name, own)

    @classmethod
    def of(cls, pose: Any) -> "Placement":
        """From a Pose, or anything that has a `position` (3,) [m] and a `rotation` (3, 3)."""
        if isinstance(pose, cls):
            return pose
        try:
            x, y, z = (float(value) for value in pose.position)
            return cls((x, y, z), rpy_of(np.asarray(pose.rotation, float).reshape(3, 3)))
        except (AttributeError, TypeError, ValueError):
            line = f"{shown(pose)} is no pose: must be a Pose or a Placement"
            raise ShapeError(line) from None

    @classmethod
    def of_matrix(cls, matrix: Float[np.ndarray, "4 4"]) -> "Placement":
        """From the pose of the frame."""
        x, y, z = matrix[:3, 3].tolist()
        return cls((x, y, z), rpy_of(matrix[:3, :3]))

    @property
    def turn(self) -> Float[np.ndarray, "3 3"]:
        """Into the base frame."""
        return rotation_from_rpy(np.array(self.rpy_rad))

    @property
    def quaternion(self) -> list[float]:
        """The same as x, y, z, w."""
        (sr, sp, sy), (cr, cp, cy) = (
            np.sin(np.multiply(0.5, self.rpy_rad)),
            np.cos(np.multiply(0.5, self.rpy_rad)),
        )
        x, y = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy
        z, w = cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy
        return [float(x), float(y), float(z), float(w)]

    @property
    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """The pose of the frame."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.turn, self.position_m
        return pose


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

    def __post_init__(self) -> None:
        """Raises ShapeError for numbers, names and files that are none, and for sizes that are not
        positive.
        """
        if not isinstance(self.name, str) or not self.name:
            raise ShapeError(f"name = {shown(self.name)}: must be a text, of a shape")
        links = self.exempt_links
        is_list = isinstance(links, Sequence) and not isinstance(links, str)
        if not is_list or not all(isinstance(link, str) for link in links):
            line = f"exempt_links = {shown(links)}: must be a list of names"
            raise ShapeError(f"{self.name!r}: {line}")
        for own in fields(self):  # type: ignore[arg-type]
            value = getattr(self, own.name)
            if own.name in ("file", "urdf"):
                checked_path(value, f"{self.name!r}: {own.name}", ShapeError)
            elif own.name.endswith(("_m", "_rad", "scale")) and not hasattr(value, "array"):
                object.__setattr__(self, own.name, _numbers(self.name, own.name, value))
        object.__setattr__(self, "exempt_links", tuple(self.exempt_links))

    reads_files: ClassVar[bool] = False
    """Whether its pieces come from files, which may be written anew."""
    name: str
    exempt_links: tuple[str, ...]

    @property
    @abstractmethod
    def at(self) -> Placement:
        """Where its own frame is: that about its middle, or of its file."""

    def pieces(self) -> tuple[Piece, ...]:
        """Convex pieces that cover it, in the base frame.  Raises RobotError where there are
        none.
        """
        raise RobotError(f"workcell {self.name!r}: a shape without pieces can't be bounded")

    def urdf_model(self) -> PlacedUrdf | None:
        """Its meshes, where it has some; they are drawn by Rerun itself."""
        return None

    @abstractmethod
    def placed(self, at: Placement) -> Self:
        """The same shape with its own frame elsewhere."""

    def is_like(self, other: "Shape") -> bool:
        """Whether both differ at most in where they are."""
        return self.placed(Placement()) == other.placed(Placement())

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
    return _as_body(bullet, bullet.createCollisionShape(**geometry), position, turn)


def _as_body(bullet: Any, shape: int, position: Triple, turn: Any) -> int:
    # with a look of its own, since PyBullet makes one of hundreds of triangles for what is round
    place = {"basePosition": position, "baseOrientation": turn}
    return int(bullet.createMultiBody(0, shape, bullet.speck, **place))


def add_mesh(bullet: Any, at: Placement, key: str, mesh: Callable[[], Any]) -> int:
    """A fixed body of triangles: corners (n, 3) [m] and faces (m, 3), which are asked for where
    the world has had none of this key: PyBullet never frees megabytes of each mesh that it makes.
    """
    if key not in bullet.meshes:
        corners, faces = mesh()
        bullet.meshes[key] = bullet.createCollisionShape(
            shapeType=bullet.GEOM_MESH,
            vertices=corners.tolist(),
            indices=faces.reshape(-1).tolist(),
            flags=bullet.GEOM_FORCE_CONCAVE_TRIMESH,
        )
    return _as_body(bullet, bullet.meshes[key], at.position_m, at.quaternion)
