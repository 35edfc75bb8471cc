"""What may meet in a scene: convex pieces of links and shapes, the frames that carry them, and the
pairs of bodies that move relative to each other, as convex_kernels.py takes them.
"""

import contextlib
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, QhullError

from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene import convex_kernels as kernels
from constraint_geodesics.scene.pieces import Piece, read_pieces
from constraint_geodesics.scene.shape import Shape
from constraint_geodesics.scene.world import BodyKey

_MIXED = 9
"""Pieces with fewer corners are no hulls to be computed: any two corners count as neighbours."""
_TRIED, _ROUNDING_M = 200, 1e-9


@dataclass(frozen=True)
class Body:
    """A link, or a shape around the arm: the frame that carries it, and its pieces there.

    parent: the link that a link hangs on.  pose: of a link's own frame in the base frame, all
    joints at 0.
    """

    name: str
    frame: int
    pieces: tuple[Piece, ...]
    parent: str | None = None
    pose: Float[np.ndarray, "4 4"] | None = None
    shape: Shape | None = None

    @property
    def key(self) -> BodyKey:
        """What it is in a world."""
        return BodyKey(self.name, self.shape is not None)


def read_bodies(
    robot: SerialRobot, workcell: Sequence[Shape], frames: Float[np.ndarray, "D+1 12"]
) -> list[Body]:
    """Links and shapes that have a collision shape, carried by frames that are so placed with all
    joints at 0.  Raises RobotError where one can't be bounded, naming it.
    """
    found = []
    for link in read_pieces(robot.urdf):
        moved = [robot.joint_names.index(j) for j in link.joints if j in robot.joint_names]
        frame = moved[-1] + 1 if moved else 0
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = frames[frame, 3:].reshape(3, 3), frames[frame, :3]
        pieces = tuple(piece.at(np.linalg.inv(pose)) for piece in link.pieces)
        if pieces:
            found.append(Body(link.name, frame, pieces, link.parent, link.pose))
    shapes = ((shape, shape.pieces()) for shape in workcell)
    return found + [Body(s.name, 0, pieces, shape=s) for s, pieces in shapes if pieces]


def pairs_of(
    bodies: Sequence[Body], allowed: Collection[tuple[str, str]]
) -> Iterator[tuple[int, int]]:
    """Bodies whose contact PyBullet reports, that of the lower frame first: not a link and the one
    it hangs on, not links that are allowed to touch, not a shape and a link that may touch it, or
    the one that carries the arm, not two shapes.
    """
    order = sorted(range(len(bodies)), key=lambda i: (bodies[i].frame, bodies[i].shape is None, i))
    for place, a in enumerate(order):
        for b in order[place + 1 :]:
            first, second = bodies[a], bodies[b]
            if first.shape is not None and second.shape is not None:
                continue
            if first.shape is not None and (
                second.name in first.shape.exempt_links or second.parent is None
            ):
                continue
            if first.shape is None and first.name == second.parent:
                continue
            if first.shape is None and second.name == first.parent:
                continue
            if first.shape is None and second.shape is None and _may_touch(first, second, allowed):
                continue
            yield a, b


def _may_touch(first: Body, second: Body, allowed: Collection[tuple[str, str]]) -> bool:
    return (first.name, second.name) in allowed or (second.name, first.name) in allowed


class NodeTable:
    """Bodies and their pieces as nodes (N, REACH): first all bodies, then all pieces."""

    def __init__(self, bodies: Sequence[Body]) -> None:
        self._bodies = bodies
        self._pieces: list[np.ndarray] = []
        self._ranges: list[range] = []
        self._hulls: list[float] = []
        rows = [self._body(body) for body in bodies]
        self.nodes = np.array([*rows, *self._pieces], float).reshape(-1, kernels.REACH)
        self.hulls = np.array(self._hulls)
        self.pieces = [[len(rows) + k for k in own] for own in self._ranges]

    def _body(self, body: Body) -> np.ndarray:
        first = len(self._pieces)
        for piece in body.pieces:
            self._add_piece(body.frame, piece)
        own = np.array(self._pieces[first:])
        self._ranges.append(range(first, len(self._pieces)))
        row = own[0].copy()
        if len(own) > 1:
            row[kernels.ROUNDING], row[kernels.BOX] = own[:, kernels.ROUNDING].max(), -1.0
            corners = np.concatenate([piece.corners for piece in body.pieces])
            ball, size = slice(kernels.BALL, kernels.BALL + 3), kernels.BALL + 3
            row[ball] = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
            away = np.linalg.norm(own[:, ball] - row[ball], axis=1)
            row[size] = (away + own[:, size]).max()
        return row

    def _add_piece(self, frame: int, piece: Piece) -> None:
        row = np.zeros(kernels.REACH)
        corners, beside = _with_neighbours(piece.corners)
        begins = len(self._hulls) + np.cumsum([0, *(4 + len(own) for own in beside)])
        for corner, own in zip(corners, beside, strict=True):
            self._hulls += [*corner, len(own), *begins[own]]
        centre = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        radius = np.linalg.norm(corners - centre, axis=1).max() + piece.rounding
        row[[kernels.FRAME, kernels.ROUNDING, kernels.CORNER]] = frame, piece.rounding, begins[0]
        row[kernels.BALL : kernels.BOX] = (*centre, radius * (1.0 + 1e-9))
        row[kernels.BOX : kernels.PLACE] = -1.0
        if piece.box is not None:
            row[kernels.BALL : kernels.BALL + 3] = piece.box[:3]
            row[kernels.BOX : kernels.PLACE] = piece.box[3:]
        self._pieces.append(row)

    def with_reaches(
        self, dof: int, reach: Callable[[Piece, int], Float[np.ndarray, "D"]]
    ) -> Float[np.ndarray, "N REACH+D"]:
        """The nodes with how far their points get from each joint's axis at most.  reach: how far a
        piece's do, given the frame that carries it.
        """
        reaches = np.zeros((len(self.nodes), dof))
        for b, (body, nodes) in enumerate(zip(self._bodies, self.pieces, strict=True)):
            for node, piece in zip(nodes, body.pieces, strict=True):
                reaches[node] = reach(piece, body.frame)
            reaches[b] = reaches[nodes].max(axis=0)
        return np.concatenate([self.nodes, reaches], axis=1)

    def pairs(self, bodies: Sequence[tuple[int, int]]) -> Float[np.ndarray, "P 9"]:
        """The table of these pairs of bodies, and behind them those of their pieces."""
        pieces = self.pieces
        table: list[tuple[int, int, int, int]] = []
        children: list[tuple[int, int, int, int]] = []
        for a, b in bodies:
            if len(pieces[a]) == len(pieces[b]) == 1:
                table.append((pieces[a][0], pieces[b][0], 0, 0))
                continue
            first = len(bodies) + len(children)
            children += [(i, k, 0, 0) for i in pieces[a] for k in pieces[b]]
            table.append((a, b, first, len(bodies) + len(children)))
        rows = np.zeros((len(table) + len(children), kernels.PAIR))
        rows[:, : kernels.VECTOR] = np.array(table + children, float).reshape(-1, 4)
        corners = self.nodes[rows[:, :2].astype(int), kernels.CORNER]
        rows[:, kernels.CORNERS : kernels.CORNERS + 2] = corners
        return rows


def _with_neighbours(
    points: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "m 3"], list[Int[np.ndarray, "k"]]]:
    """Corners of a convex hull, and for each those beside it: that share a face, or all others
    where a way along edges might end before the corner that lies furthest out.
    """
    return _hull(np.ascontiguousarray(points, float).tobytes())


@lru_cache(maxsize=4096)  # certificate and search ask the same, and so does every further scene
def _hull(data: bytes) -> tuple[Float[np.ndarray, "m 3"], list[Int[np.ndarray, "k"]]]:
    points = np.frombuffer(data).reshape(-1, 3)
    if len(points) >= _MIXED:
        with contextlib.suppress(QhullError):  # flat
            hull = ConvexHull(points)
            corners, faces = np.unique(hull.simplices, return_inverse=True)
            faces = faces.reshape(hull.simplices.shape)
            edges = np.concatenate([faces[:, [i, k]] for i in range(3) for k in range(3) if i != k])
            edges = np.unique(edges, axis=0)
            starts = np.searchsorted(edges[:, 0], range(len(corners)))
            own = points[corners]
            if _leads_furthest(own, edges[:, 1], starts, hull.equations[:, :3]):
                return own, np.split(edges[:, 1], starts[1:])
    others = np.arange(len(points))
    return points, [np.delete(others, i) for i in others]


def _leads_furthest(
    corners: Float[np.ndarray, "m 3"],
    beside: Int[np.ndarray, "E"],
    starts: Int[np.ndarray, "m"],
    normals: Float[np.ndarray, "f 3"],
) -> bool:
    """Whether no corner lies further out than all beside it without being the furthest, in the
    directions of the faces, near them, and in others.
    """
    rng = np.random.default_rng(0)
    near = normals + 1e-3 * rng.normal(size=normals.shape)
    directions = np.concatenate([normals, near, rng.normal(size=(_TRIED, 3))])
    ends = np.append(starts, len(beside))
    return bool(kernels.leads_furthest(corners, beside, ends, directions, _ROUNDING_M))
