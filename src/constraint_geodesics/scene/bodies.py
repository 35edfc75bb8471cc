"""What may meet in a scene: convex pieces of links and shapes, the frames that carry them, and the
pairs of bodies that move relative to each other, as convex_kernels.py takes them.  It follows a
scene that changes: what stays is not read again.
"""

import contextlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, QhullError

from constraint_geodesics.robot.kinematics import RobotError, SerialRobot
from constraint_geodesics.scene import convex_kernels as kernels
from constraint_geodesics.scene.attached import Attached
from constraint_geodesics.scene.names import require_names
from constraint_geodesics.scene.pieces import Piece, read_pieces
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.shape import Placement, Shape
from constraint_geodesics.scene.world import BodyKey

_MIXED = 9
"""Pieces with fewer corners are no hulls to be computed: any two corners count as neighbours."""
_TRIED, _ROUNDING_M = 200, 1e-9


@dataclass(frozen=True)
class Body:
    """A link, a shape around the arm, or one that a link carries: the frame that it moves with, and
    its pieces there.

    parent: the link that a link hangs on.  pose: of a link's own frame in the base frame, all
    joints at 0.  carrier: the link that carries a shape.
    """

    name: str
    frame: int
    pieces: tuple[Piece, ...]
    parent: str | None = None
    pose: Float[np.ndarray, "4 4"] | None = None
    shape: Shape | None = None
    carrier: str | None = None

    @property
    def key(self) -> BodyKey:
        """What it is in a world."""
        return BodyKey(self.name, self.shape is not None)

    @property
    def is_fixed(self) -> bool:
        """Whether it is a shape around the arm."""
        return self.shape is not None and self.carrier is None


Pair = tuple[BodyKey, BodyKey]
"""Two bodies, that of the lower frame first."""
Reach = Callable[[Piece, int], Float[np.ndarray, "D"]]
"""How far a piece's points get from each joint's axis at most, given the frame that carries it."""


class _Link(NamedTuple):
    """Of any link, with collision shapes or without: the frame that carries it, and its own frame's
    pose in that.
    """

    frame: int
    pose: Float[np.ndarray, "4 4"]


def links_of(
    robot: SerialRobot, frames: Float[np.ndarray, "D+1 12"]
) -> tuple[list[Body], dict[str, _Link]]:
    """Links that have a collision shape, and where all of them are, carried by frames that are so
    placed with all joints at 0.  Raises RobotError where one can't be bounded, naming it.
    """
    found, links = list[Body](), dict[str, _Link]()
    for link in read_pieces(robot.urdf):
        moved = [robot.joint_names.index(j) for j in link.joints if j in robot.joint_names]
        frame = moved[-1] + 1 if moved else 0
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = frames[frame, 3:].reshape(3, 3), frames[frame, :3]
        into = np.linalg.inv(pose)
        links[link.name] = _Link(frame, into @ link.pose)
        if link.pieces:
            pieces = tuple(piece.at(into) for piece in link.pieces)
            found.append(Body(link.name, frame, pieces, link.parent, link.pose))
    return found, links


def touching(robot: SerialRobot, scene: Scene) -> frozenset[frozenset[str]]:
    """Pairs of names that may touch: of links, of shapes and links, of shapes."""
    pairs = [*robot.allowed, *scene.allowed]
    for shape in (*scene.workcell, *(one.shape for one in scene.attached)):
        pairs += [(shape.name, link) for link in shape.exempt_links]
    for one in scene.attached:
        pairs += [(one.name, other) for other in one.touching]
    return frozenset(map(frozenset, pairs))


def may_meet(first: Body, second: Body, allowed: Collection[frozenset[str]]) -> bool:
    """Whether a contact counts: PyBullet's does.  Not that of a link and the one it hangs on, of a
    shape and what carries it, of bodies that may touch, of a shape and the link that carries the
    arm, of two shapes around it.
    """
    if first.is_fixed and second.is_fixed:
        return False
    for one, other in ((first, second), (second, first)):
        if one.is_fixed and other.shape is None and other.parent is None:
            return False
        if other.shape is None and other.name in (one.parent, one.carrier):
            return False
    return frozenset((first.name, second.name)) not in allowed


class _Block(NamedTuple):
    """A body as the kernels take it, on its own: nodes (n, REACH + D), that of the whole first
    where it has more than one piece, its hulls, where among these its corners are and where what
    leads to others of them.
    """

    nodes: np.ndarray
    hulls: np.ndarray
    corners: np.ndarray
    links: np.ndarray

    @property
    def pieces(self) -> int:
        """How many there are."""
        return max(len(self.nodes) - 1, 1)

    def at(self, pose: Float[np.ndarray, "4 4"], frame: int) -> "_Block":
        """The same elsewhere, carried by another frame."""
        nodes, hulls, turn = self.nodes.copy(), self.hulls.copy(), pose[:3, :3]
        ball, own = slice(kernels.BALL, kernels.BALL + 3), slice(kernels.BOX + 3, kernels.PLACE)
        nodes[:, kernels.FRAME] = frame
        nodes[:, ball] = nodes[:, ball] @ turn.T + pose[:3, 3]
        nodes[:, own] = (turn @ nodes[:, own].reshape(-1, 3, 3)).reshape(-1, 9)
        # a box is looked at by its turn in the base frame, which one that moves has not for good
        nodes[(nodes[:, kernels.BOX] < 0.0) | (frame > 0), kernels.BOX : kernels.PLACE] = -1.0
        at = self.corners[:, None] + np.arange(3)
        hulls[at] = hulls[at] @ turn.T + pose[:3, 3]
        return self._replace(nodes=nodes, hulls=hulls)


def block_of(pieces: Sequence[Piece], dof: int) -> _Block:
    """Pieces as the kernels take them, carried by the base."""
    rows, hulls = list[np.ndarray](), list[float]()
    places, leading = list[int](), list[int]()
    for piece in pieces:
        row = np.zeros(kernels.REACH + dof)
        corners, beside = _with_neighbours(piece.corners)
        begins = len(hulls) + np.cumsum([0, *(4 + len(own) for own in beside)])
        for corner, own in zip(corners, beside, strict=True):
            places.append(len(hulls))
            leading += range(len(hulls) + 4, len(hulls) + 4 + len(own))
            hulls += [*corner, len(own), *begins[own]]
        centre = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        radius = np.linalg.norm(corners - centre, axis=1).max() + piece.rounding
        row[[kernels.ROUNDING, kernels.CORNER]] = piece.rounding, begins[0]
        row[kernels.BALL : kernels.BOX] = (*centre, radius * (1.0 + 1e-9))
        row[kernels.BOX : kernels.PLACE] = -1.0
        if piece.box is not None:
            row[kernels.BALL : kernels.BALL + 3] = piece.box[:3]
            row[kernels.BOX : kernels.PLACE] = piece.box[3:]
        rows.append(row)
    if len(pieces) > 1:
        own, whole = np.array(rows), rows[0].copy()
        whole[kernels.ROUNDING], whole[kernels.BOX : kernels.PLACE] = own[:, 1].max(), -1.0
        all_corners = np.concatenate([piece.corners for piece in pieces])
        ball, size = slice(kernels.BALL, kernels.BALL + 3), kernels.BALL + 3
        whole[ball] = 0.5 * (all_corners.min(axis=0) + all_corners.max(axis=0))
        away = np.linalg.norm(own[:, ball] - whole[ball], axis=1)
        whole[size] = (away + own[:, size]).max()
        rows.insert(0, whole)
    nodes = np.array(rows).reshape(-1, kernels.REACH + dof)
    return _Block(nodes, np.array(hulls), np.array(places, int), np.array(leading, int))


class _Own(NamedTuple):
    """A shape in its own frame, its pieces there, and these as the kernels take them."""

    shape: Shape
    pieces: tuple[Piece, ...]
    block: _Block


def _are_same(first: Sequence[Piece], second: Sequence[Piece]) -> bool:
    return len(first) == len(second) and all(
        np.array_equal(a.corners, b.corners) and a.rounding == b.rounding
        for a, b in zip(first, second, strict=True)
    )


class BodyTable:
    """The bodies of a scene and the pairs of them that may meet, as the kernels take them.

    frames: where the frames that carry the links are with all joints at 0.  reach: of pieces.
    ends: the pairs (P, 2) as places among `bodies`, that of the lower frame first.  Raises
    RobotError where a body can't be bounded, naming it.
    """

    def __init__(self, scene: Scene, frames: Float[np.ndarray, "D+1 12"], reach: Reach) -> None:
        self._dof, self._reach = scene.robot.dof, reach
        links, self.links = links_of(scene.robot, frames)
        self._robot = {body.key: body for body in links}
        self._blocks = {
            key: self._reaching(block_of(body.pieces, self._dof), body)
            for key, body in self._robot.items()
        }
        self._own = dict[str, _Own]()
        self.scene = Scene(scene.robot)
        self.bodies = dict(self._robot)
        self._allowed = touching(scene.robot, self.scene)
        self._made = dict[str, Shape | Attached]()
        self.ends = self._pairs(self.bodies, self._allowed, self._robot)
        self.change(scene)

    def change(self, scene: Scene) -> None:
        """Follow the scene: shapes come, go and move, links and shapes may touch others than
        before.  Nothing has changed where it raises RobotError, or SceneError for names.
        """
        require_names(self.links, scene.workcell, scene.attached, scene.allowed)
        bodies, own, made = dict(self._robot), dict[str, _Own](), dict[str, Shape | Attached]()
        blocks = {key: self._blocks[key] for key in self._robot}
        news = set[BodyKey]()
        everything: list[Shape | Attached] = [*scene.workcell, *scene.attached]
        for one in everything:
            key, before = BodyKey(one.name, True), self._made.get(one.name)
            made[one.name] = one
            if before is one or before == one:
                own[one.name] = self._own[one.name]
                bodies[key], blocks[key] = self.bodies[key], self._blocks[key]
                continue
            own[one.name] = self._own_of(one.shape if isinstance(one, Attached) else one)
            bodies[key], blocks[key] = self._placed(one, own[one.name])
            news.add(key)
        allowed = touching(scene.robot, scene)
        if allowed != self._allowed:  # of what is named there all pairs are looked at again
            named = set().union(*(allowed ^ self._allowed))
            news |= {key for key in bodies if key.name in named}
        place = {key: i for i, key in enumerate(bodies) if key not in news}
        moved = np.array([place.get(key, -1) for key in self.bodies], int)[self.ends]
        ends = np.concatenate([moved[(moved >= 0).all(axis=1)], self._pairs(bodies, allowed, news)])
        self.scene, self._allowed, self.bodies, self._blocks = scene, allowed, bodies, blocks
        self._own, self._made, self.ends = own, made, ends

    @property
    def state(self) -> tuple[Any, ...]:
        """All that changes, to be taken back by `restore`; nothing is read again for that."""
        kept = self.scene, self._allowed, self.bodies, self._blocks
        return *kept, self._own, self._made, self.ends

    def restore(self, state: tuple[Any, ...]) -> None:
        """Be as before."""
        self.scene, self._allowed, self.bodies, self._blocks = state[:4]
        self._own, self._made, self.ends = state[4:]

    @property
    def frames(self) -> Int[np.ndarray, "P 2"]:
        """Those that carry the bodies of each pair."""
        return np.array([body.frame for body in self.bodies.values()], int)[self.ends]

    def named(self, pairs: Collection[Pair]) -> Bool[np.ndarray, "P"]:
        """Which pairs are among those."""
        place, count = {key: i for i, key in enumerate(self.bodies)}, len(self.bodies)
        known = [place[a] * count + place[b] for a, b in pairs if a in place and b in place]
        return np.isin(self.ends[:, 0] * count + self.ends[:, 1], known)

    def arrays(self, ends: Int[np.ndarray, "n 2"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Hulls (H,), nodes (N, REACH + D) and pairs (P, PAIR) of these pairs of bodies, behind
        which those of their pieces are.
        """
        blocks = list(self._blocks.values()) or [block_of([], self._dof)]
        counts = np.array([len(block.nodes) for block in blocks])
        sizes = np.array([len(block.hulls) for block in blocks])
        begins, offsets = np.cumsum(counts) - counts, np.cumsum(sizes) - sizes
        nodes = np.concatenate([block.nodes for block in blocks])
        nodes[:, kernels.CORNER] += np.repeat(offsets, counts)
        hulls = np.concatenate([block.hulls for block in blocks])
        links = np.array([len(block.links) for block in blocks])
        shifts = np.repeat(offsets, links)
        hulls[np.concatenate([block.links for block in blocks]) + shifts] += shifts
        pieces = np.array([block.pieces for block in blocks])
        return hulls, nodes, _pair_table(ends, begins, pieces, nodes)

    @staticmethod
    def _pairs(
        bodies: Mapping[BodyKey, Body],
        allowed: Collection[frozenset[str]],
        news: Collection[BodyKey],
    ) -> Int[np.ndarray, "n 2"]:
        """Pairs that may meet of which one is new, that of the lower frame first."""
        around = [(i, body) for i, body in enumerate(bodies.values()) if body.is_fixed]
        others = [(i, body) for i, body in enumerate(bodies.values()) if not body.is_fixed]
        found = list[tuple[int, int]]()
        for place, key in enumerate(bodies):
            if key not in news:
                continue
            own = bodies[key]
            for other, body in others if own.is_fixed else (*others, *around):
                if other == place or (other < place and body.key in news):
                    continue
                a, b = (place, own), (other, body)
                first, second = (a, b) if _order(*a) < _order(*b) else (b, a)
                if may_meet(first[1], second[1], allowed):
                    found.append((first[0], second[0]))
        return np.array(found, int).reshape(-1, 2)

    def _own_of(self, shape: Shape) -> _Own:
        """As it was before where it has only moved, and a file has the same in it."""
        at_origin, known = shape.placed(Placement()), self._own.get(shape.name)
        same = known is not None and known.shape == at_origin
        if same and known is not None and not known.shape.reads_files:
            return known
        pieces = at_origin.pieces()
        if same and known is not None and _are_same(pieces, known.pieces):
            return known
        if not pieces:
            raise RobotError(f"{shape.name!r} has no collision shape: nothing could touch it")
        return _Own(at_origin, pieces, block_of(pieces, self._dof))

    def _placed(self, one: Shape | Attached, own: _Own) -> tuple[Body, _Block]:
        shape = one.shape if isinstance(one, Attached) else one
        pose, frame, carrier = shape.at.matrix, 0, None
        if isinstance(one, Attached):
            link = self.links[one.link]
            pose, frame, carrier = link.pose @ pose, link.frame, one.link
        there = tuple(piece.at(pose) for piece in own.pieces)
        body = Body(shape.name, frame, there, shape=shape, carrier=carrier)
        return body, self._reaching(own.block.at(pose, frame), body)

    def _reaching(self, block: _Block, body: Body) -> _Block:
        """With how far its points get from each axis, carried by its frame."""
        nodes = block.nodes.copy()
        nodes[:, kernels.FRAME] = body.frame
        if body.frame > 0:
            reaches = np.array([self._reach(piece, body.frame) for piece in body.pieces])
            if len(nodes) > 1:
                reaches = np.concatenate([reaches.max(axis=0)[None], reaches])
            nodes[:, kernels.REACH :] = reaches
        return block._replace(nodes=nodes)


def _order(place: int, body: Body) -> tuple[int, bool, int]:
    """Of two bodies that may meet, which is the first."""
    return body.frame, body.shape is None, place


def _pair_table(
    ends: Int[np.ndarray, "n 2"],
    begins: Int[np.ndarray, "B"],
    pieces: Int[np.ndarray, "B"],
    nodes: np.ndarray,
) -> Float[np.ndarray, "P 9"]:
    """Rows of pairs of bodies, and behind them those of their pieces."""
    counts = pieces[ends]
    whole = (counts == 1).all(axis=1)
    several = np.where(whole, 0, counts.prod(axis=1))
    last = len(ends) + np.cumsum(several)
    rows = np.zeros((len(ends) + several.sum(), kernels.PAIR))
    rows[: len(ends), :2] = begins[ends]
    rows[: len(ends), 2] = np.where(whole, 0, last - several)
    rows[: len(ends), 3] = np.where(whole, 0, last)
    which = np.repeat(np.arange(len(ends)), several)
    inner = np.arange(len(which)) - np.repeat(last - several - len(ends), several)
    first, second = inner // counts[which, 1], inner % counts[which, 1]
    # the whole of a body of several pieces is its first node
    rows[len(ends) :, 0] = begins[ends[which, 0]] + first + (counts[which, 0] > 1)
    rows[len(ends) :, 1] = begins[ends[which, 1]] + second + (counts[which, 1] > 1)
    corners = nodes[rows[:, :2].astype(int), kernels.CORNER]
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
