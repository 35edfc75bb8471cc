"""What may meet in a scene, as collision_kernels.py takes it: convex pieces, how far each gets from
the joints' axes, and the pairs of bodies that move relative to each other.
"""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, QhullError

from constraint_geodesics.certification import collision_kernels as kernels
from constraint_geodesics.certification.chain import Chain, rotated
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.pieces import NOT_CONVEX, Piece, read_pieces
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.shape import Shape
from constraint_geodesics.scene.world import BodyKey

_SIDES = 256
_MIXED = 9
"""Pieces with fewer corners are no hulls to be computed: any two corners count as neighbours."""
_TRIED, _ROUNDING_M = 200, 1e-9
_CELLS = 20_000
"""Cells of joint values over which it is tried to prove that two bodies never meet."""
_FEW_JOINTS = 3
"""So many joints that move two bodies are few enough for that."""


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


def read_bodies(scene: Scene, chain: Chain) -> list[Body]:
    """Links and shapes that have a collision shape.  Raises RobotError where one can't be bounded,
    naming it.
    """
    robot, found = scene.robot, []
    frames = np.empty((robot.dof + 1, 12))
    kernels.joint_frames(chain, np.zeros(robot.dof), frames)
    for link in read_pieces(robot.urdf):
        moved = [robot.joint_names.index(j) for j in link.joints if j in robot.joint_names]
        frame = moved[-1] + 1 if moved else 0
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = frames[frame, 3:].reshape(3, 3), frames[frame, :3]
        pieces = tuple(piece.at(np.linalg.inv(pose)) for piece in link.pieces)
        if pieces:
            found.append(Body(link.name, frame, pieces, link.parent, link.pose))
    shapes = ((shape, shape.pieces()) for shape in scene.workcell)
    return found + [Body(s.name, 0, pieces, shape=s) for s, pieces in shapes if pieces]


def pairs_of(bodies: Sequence[Body]) -> Iterator[tuple[int, int]]:
    """Bodies whose contact PyBullet reports, that of the lower frame first: not a link and the one
    it hangs on, not a shape and a link that may touch it, or the one that carries the arm, not two
    shapes.
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
            yield a, b


@dataclass(frozen=True)
class Collider:
    """A scene's bodies as the kernels take them, and their pairs: those that may meet while the arm
    moves, which the first pairs of `arrays` are, those that never move relative to each other, and
    those that are proven to stay apart at all joint values within `limits` (2, D).
    """

    bodies: tuple[Body, ...]
    limits: Float[np.ndarray, "2 D"]
    moving: tuple[tuple[int, int], ...]
    rigid: tuple[tuple[int, int], ...]
    apart: tuple[tuple[int, int], ...]
    arrays: kernels.Bodies

    def pair(self, row: float) -> tuple[int, int]:
        """The bodies of a row of `arrays.pairs`."""
        pairs = self.arrays.pairs
        tops = pairs[: self.arrays.top]
        own = int(row)
        if own >= self.arrays.top:
            own = int(np.flatnonzero((tops[:, 2] <= own) & (own < tops[:, 3]))[0])
        return self.moving[own]

    def covered(self) -> list[str]:
        """Bodies whose meshes are not convex, so that their hulls cover more than them."""
        deep = {b.name for b in self.bodies if any(p.hollow_m > NOT_CONVEX for p in b.pieces)}
        return sorted(deep)


def collider(scene: Scene, chain: Chain, margin: float, beyond: float) -> Collider:
    """The collider of a scene on the certifier's chain.  Two bodies that are proven to stay further
    apart than `margin` [m] need no look at a path whose joints are within the limits, or `beyond`
    them by so much [rad].
    """
    robot = scene.robot
    limits = np.stack([robot.lower - beyond, robot.upper + beyond])
    bodies = read_bodies(scene, chain)
    nodes = _Nodes(robot, chain, limits)
    for body in bodies:
        nodes.add_body(body)
    pairs = list(pairs_of(bodies))
    rigid = [pair for pair in pairs if bodies[pair[0]].frame == bodies[pair[1]].frame]
    moving = [pair for pair in pairs if pair not in rigid]
    all_arrays, apart = nodes.arrays(moving, len(moving)), []
    for p, (a, b) in enumerate(moving):
        few = bodies[b].frame - bodies[a].frame <= _FEW_JOINTS
        if few and kernels.never_meets(all_arrays, p, limits, margin, _CELLS):
            apart.append((a, b))
    moving = [pair for pair in moving if pair not in apart]
    arrays = nodes.arrays([*moving, *rigid], len(moving))
    return Collider(tuple(bodies), limits, tuple(moving), tuple(rigid), tuple(apart), arrays)


class _Nodes:
    """The nodes' table while it is made: first all bodies, then all pieces."""

    def __init__(self, robot: SerialRobot, chain: Chain, limits: Float[np.ndarray, "2 D"]) -> None:
        self._robot, self._chain, self._limits = robot, chain, limits
        # rows: where the axes of the frame before are turned to
        self._turns = [np.array([rotated(q, axis) for axis in np.eye(3)]) for q in chain.turns]
        self._bodies: list[np.ndarray] = []
        self._pieces: list[np.ndarray] = []
        self._ranges: list[range] = []
        self._hulls: list[float] = []

    def add_body(self, body: Body) -> None:
        """A body and its pieces."""
        first = len(self._pieces)
        for piece in body.pieces:
            self._add_piece(body.frame, piece)
        own = np.array(self._pieces[first:])
        self._ranges.append(range(first, len(self._pieces)))
        row = own[0].copy()
        row[kernels.REACH :] = own[:, kernels.REACH :].max(axis=0)
        if len(own) > 1:
            row[kernels.ROUNDING], row[kernels.BOX] = own[:, kernels.ROUNDING].max(), -1.0
            corners = np.concatenate([piece.corners for piece in body.pieces])
            ball, size = slice(kernels.BALL, kernels.BALL + 3), kernels.BALL + 3
            row[ball] = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
            away = np.linalg.norm(own[:, ball] - row[ball], axis=1)
            row[size] = (away + own[:, size]).max()
        self._bodies.append(row)

    def _add_piece(self, frame: int, piece: Piece) -> None:
        row = np.zeros(kernels.REACH + self._robot.dof)
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
        row[kernels.REACH :] = self._reach(frame, corners, piece.rounding)
        self._pieces.append(row)

    def _reach(
        self, frame: int, corners: Float[np.ndarray, "n 3"], rounding: float
    ) -> Float[np.ndarray, "D"]:
        """How far points get from each axis at most, wherever the joints after it are: those of a
        cylinder about the axis, in the frame before, those of a cylinder about the axis before, ….
        """
        reach, points = np.zeros(self._robot.dof), corners
        for j in range(frame - 1, -1, -1):
            if self._chain.prismatic[j]:
                points, reach[j] = np.concatenate([points, points]), 1.0
                points[: len(points) // 2, 2] += self._limits[0, j]
                points[len(points) // 2 :, 2] += self._limits[1, j]
            else:
                radius = np.linalg.norm(points[:, :2], axis=1).max()
                reach[j] = radius + rounding
                points = _cylinder(radius, points[:, 2].min(), points[:, 2].max())
            points = points @ self._turns[j] + self._chain.offsets[j]
        return reach

    def arrays(self, pairs: Sequence[tuple[int, int]], moving: int) -> kernels.Bodies:
        """The nodes with these pairs of bodies, of which the first `moving` are looked at."""
        count = len(self._bodies)
        pieces = [[count + k for k in own] for own in self._ranges]
        table: list[tuple[int, int, int, int]] = []
        children: list[tuple[int, int, int, int]] = []
        for a, b in pairs:
            if len(pieces[a]) == len(pieces[b]) == 1:
                table.append((pieces[a][0], pieces[b][0], 0, 0))
                continue
            first = len(pairs) + len(children)
            children += [(i, k, 0, 0) for i in pieces[a] for k in pieces[b]]
            table.append((a, b, first, len(pairs) + len(children)))
        rows = np.zeros((len(table) + len(children), kernels.PAIR))
        rows[:, : kernels.VECTOR] = np.array(table + children, float).reshape(-1, 4)
        nodes = np.array([*self._bodies, *self._pieces], float)
        nodes = nodes.reshape(-1, kernels.REACH + self._robot.dof)
        return kernels.Bodies(self._chain, np.array(self._hulls), nodes, rows, moving)


def _cylinder(radius: float, low: float, high: float) -> Float[np.ndarray, "n 3"]:
    """Rims of a prism around the cylinder about the z axis."""
    turn = np.linspace(0.0, 2.0 * np.pi, _SIDES, endpoint=False)
    wide = radius / np.cos(np.pi / _SIDES)
    x, y, one = wide * np.cos(turn), wide * np.sin(turn), np.ones(_SIDES)
    return np.concatenate([np.stack([x, y, low * one], 1), np.stack([x, y, high * one], 1)])


def _with_neighbours(
    points: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "m 3"], list[Int[np.ndarray, "k"]]]:
    """Corners of a convex hull, and for each those beside it: that share a face, or all others
    where a way along edges might end before the corner that lies furthest out.
    """
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
    values = corners @ directions.T
    highest = np.maximum.reduceat(values[beside], starts)
    ends = values >= highest
    return bool((values.max(axis=0) - np.where(ends, values, np.inf) <= _ROUNDING_M).all())
