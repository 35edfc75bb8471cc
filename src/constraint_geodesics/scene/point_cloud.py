"""Points, as a depth camera sees them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from heapq import heappop, heappush
from itertools import count
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema
from scipy.spatial import ConvexHull

from constraint_geodesics.fields import Positive
from constraint_geodesics.scene.pieces import HULL_MARGIN, Piece
from constraint_geodesics.scene.shape import Placement, RoundedBox, Shape, ShapeError, add_mesh
from constraint_geodesics.values import are_usable, numbers

MOST = 10_000
"""Points at most: PyBullet takes no larger mesh of balls."""
CELLS = 256
"""Boxes that cover a cloud, at most."""
_GOLDEN = 0.5 * (1.0 + np.sqrt(5.0))
_BALL = np.array([[0, s, t * _GOLDEN] for s in (-1, 1) for t in (-1, 1)])
_BALL = np.concatenate([np.roll(_BALL, k, axis=1) for k in range(3)])
_BALL /= np.linalg.norm(_BALL[0])
"""Corners (12, 3) of an icosahedron in the unit sphere."""


class Points:
    """An array (n, 3) [m] that is a value: it can't be written to, and is compared by its
    numbers.
    """

    def __init__(self, points: Any) -> None:
        own = numbers(points)
        if own is None:
            raise ShapeError("points are no array of numbers: must be (n, 3) [m]")
        if own.ndim != 2 or own.shape[1] != 3 or not len(own) or not are_usable(own):
            raise ShapeError(f"points of shape {own.shape}: must be (n, 3) finite numbers [m]")
        if len(own) > MOST:
            raise ShapeError(f"{len(own)} points: at most {MOST}: keep one a voxel")
        own.flags.writeable = False
        self.array: Float[np.ndarray, "n 3"] = own
        self._hash = hash(own.tobytes())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Points) and (
            self is other or np.array_equal(self.array, other.array)
        )

    def __hash__(self) -> int:
        return self._hash

    def __reduce__(self) -> Any:
        return Points, (self.array,)

    def __repr__(self) -> str:
        return f"Points({len(self.array)})"

    @classmethod
    def of(cls, points: Any) -> "Points":
        """From an array, or lists."""
        return points if isinstance(points, cls) else cls(points)

    @classmethod
    def __get_pydantic_core_schema__(cls, _: Any, __: GetCoreSchemaHandler) -> CoreSchema:
        as_lists = core_schema.plain_serializer_function_ser_schema(lambda own: own.array.tolist())
        return core_schema.no_info_plain_validator_function(cls.of, serialization=as_lists)


@dataclass(frozen=True)
class PointCloud(Shape):
    """Balls of one radius about points (n, 3) [m], in the frame of a pose: the base frame by
    default.  They are covered by boxes, as many as CELLS.
    """

    name: str
    points_m: Points
    radius_m: Positive
    pose: Placement = field(default_factory=Placement)
    exempt_links: tuple[str, ...] = ()
    kind: Literal["point_cloud"] = "point_cloud"

    def __post_init__(self) -> None:
        object.__setattr__(self, "points_m", Points.of(self.points_m))
        super().__post_init__()
        object.__setattr__(self, "pose", Placement.of(self.pose))

    @property
    def at(self) -> Placement:
        """Its pose."""
        return self.pose

    def pieces(self) -> tuple[Piece, ...]:
        """Boxes around the points of a cell each, rounded by the radius, and by the margin that
        PyBullet has around the boxes of links that come near triangles.
        """
        turn, place = self.pose.turn, np.array(self.pose.position_m)
        found = []
        for own in _cells(self.points_m.array, self.radius_m):
            low, high = own.min(axis=0), own.max(axis=0)
            x, y, z = (0.5 * (low + high) @ turn.T + place).tolist()
            a, b, c = (0.5 * (high - low)).tolist()
            around = RoundedBox((x, y, z), (a, b, c), self.radius_m + HULL_MARGIN, turn).piece()
            found.append(around._replace(margin=HULL_MARGIN))
        return tuple(found)

    def placed(self, at: Placement) -> "PointCloud":
        """With its frame elsewhere."""
        return replace(self, pose=at)

    def add_to(self, bullet: Any) -> int:
        """An icosahedron in each ball, to PyBullet."""
        points = self.points_m.array

        def mesh() -> Any:
            corners = (points[:, None] + self.radius_m * _BALL).reshape(-1, 3)
            faces = np.arange(len(points))[:, None, None] * len(_BALL)
            return corners, faces + ConvexHull(_BALL).simplices

        key = f"{blake2b(points.tobytes()).hexdigest()} {self.radius_m!r}"
        return add_mesh(bullet, self.pose, key, mesh)

    def drawn(self, rerun: Any, style: Mapping[str, Any]) -> Any:
        """Points of Rerun, as large as the balls."""
        points = self.points_m.array @ self.pose.turn.T + self.pose.position_m
        return rerun.Points3D(points, radii=self.radius_m, colors=style["colors"])


def _cells(points: Float[np.ndarray, "n 3"], radius: float) -> list[Float[np.ndarray, "k 3"]]:
    """Points in groups that lie close together: the group whose box is longest is divided in the
    middle of its longest edge, again and again, until all are as small as a ball or there are
    enough.
    """
    waiting: list[tuple[float, int, np.ndarray]] = []
    number = count()

    def push(own: np.ndarray) -> None:
        heappush(waiting, (-float(np.ptp(own, axis=0).max()), next(number), own))

    push(points)
    while len(waiting) < CELLS and -waiting[0][0] > 2.0 * radius:
        _, _, own = heappop(waiting)
        edge = int(np.ptp(own, axis=0).argmax())
        low = own[:, edge] <= 0.5 * (own[:, edge].min() + own[:, edge].max())
        push(own[low])
        push(own[~low])
    return [own for *_, own in waiting]
