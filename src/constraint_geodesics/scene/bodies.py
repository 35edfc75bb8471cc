"""What may meet in a scene: convex pieces of links and shapes, the frames that carry them, and the
pairs of bodies that move relative to each other, as convex_kernels.py takes them.  It follows a
scene that changes: what stays is not read again.
"""

import contextlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, QhullError

from constraint_geodesics.robot.kinematics import RobotError, SerialRobot
from constraint_geodesics.scene import convex_kernels as kernels
from constraint_geodesics.scene.attached import Attached, is_unchanged
from constraint_geodesics.scene.names import require_names
from constraint_geodesics.scene.pieces import Piece, read_pieces
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.shape import Placement, Shape
from constraint_geodesics.scene.world import BodyKey

_MIXED = 9
"""Pieces with fewer corners are no hulls to be computed: any two corners count as neighbours."""
_ROUNDING_M = 1e-9


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
    shapes = (*scene.workcell, *(one.shape for one in scene.attached))
    exempt = [(shape.name, link) for shape in shapes for link in shape.exempt_links]
    said = [(one.name, other) for one in scene.attached for other in one.touching]
    return frozenset(map(frozenset, [*robot.allowed, *scene.allowed, *exempt, *said]))


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
    where it has more than one piece, its hulls, and where among these its corners are.
    """

    nodes: np.ndarray
    hulls: np.ndarray
    corners: np.ndarray

    def at(self, pose: Float[np.ndarray, "4 4"], frame: int) -> "_Block":
        """The same elsewhere, carried by another frame."""
        nodes, hulls, turn = self.nodes.copy(), self.hulls.copy(), pose[:3, :3]
        ball, own = slice(kernels.BALL, kernels.BALL + 3), slice(kernels.BOX + 3, kernels.PLACE)
        nodes[:, ball] = nodes[:, ball] @ turn.T + pose[:3, 3]
        nodes[:, own] = (turn @ nodes[:, own].reshape(-1, 3, 3)).reshape(-1, 9)
        # a box is looked at by its turn in the base frame, which one that moves has not for good
        nodes[(nodes[:, kernels.BOX] < 0.0) | (frame > 0), kernels.BOX : kernels.PLACE] = -1.0
        at = self.corners[:, None] + np.arange(3)
        hulls[at] = hulls[at] @ turn.T + pose[:3, 3]
        return _Block(nodes, hulls, self.corners)


def block_of(pieces: Sequence[Piece], dof: int) -> _Block:
    """Pieces as the kernels take them, carried by the base."""
    rows, hulls, places, size = list[np.ndarray](), list[np.ndarray](), list[np.ndarray](), 0
    for piece in pieces:
        row = np.zeros(kernels.REACH + dof)
        hull, own_places = _hull(np.ascontiguousarray(piece.corners, float).tobytes())
        corners = hull[own_places[:, None] + np.arange(3)]
        centre = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        radius = np.linalg.norm(corners - centre, axis=1).max() + piece.rounding
        row[kernels.ROUNDING], row[kernels.MARGIN] = piece.rounding, piece.margin
        row[kernels.CORNER] = size
        hulls.append(hull)
        places.append(own_places + size)
        size += len(hull)
        row[kernels.BALL : kernels.BOX] = (*centre, radius * (1.0 + 1e-9))
        row[kernels.BOX : kernels.PLACE] = -1.0
        if piece.box is not None:
            row[kernels.BALL : kernels.BALL + 3] = piece.box[:3]
            row[kernels.BOX : kernels.PLACE] = piece.box[3:]
        rows.append(row)
    if len(pieces) > 1:
        own, whole = np.array(rows), rows[0].copy()
        whole[kernels.ROUNDING] = own[:, kernels.ROUNDING].max()
        whole[kernels.MARGIN] = own[:, kernels.MARGIN].min()
        whole[kernels.BOX : kernels.PLACE] = -1.0
        all_corners = np.concatenate([piece.corners for piece in pieces])
        ball, size = slice(kernels.BALL, kernels.BALL + 3), kernels.BALL + 3
        whole[ball] = 0.5 * (all_corners.min(axis=0) + all_corners.max(axis=0))
        away = np.linalg.norm(own[:, ball] - whole[ball], axis=1)
        whole[size] = (away + own[:, size]).max()
        rows.insert(0, whole)
    return _Block(np.array(rows), np.concatenate(hulls), np.concatenate(places))


class _Own(NamedTuple):
    """A shape's pieces in its own frame, and these as the kernels take them."""

    pieces: tuple[Piece, ...]
    block: _Block


def _own_of(shape: Shape, dof: int, known: _Own | None) -> _Own:
    """known: of the same shape before, which a file with the same in it leaves as it is."""
    at_origin = shape.placed(Placement())
    if not shape.reads_files:
        return _kept_own(at_origin, dof)
    pieces = at_origin.pieces()
    if known is not None and _are_same(pieces, known.pieces):
        return known
    return _made_own(shape.name, pieces, dof)


@lru_cache(maxsize=64)  # certificate and search ask the same, one after the other
def _kept_own(at_origin: Shape, dof: int) -> _Own:
    return _made_own(at_origin.name, at_origin.pieces(), dof)


def _made_own(name: str, pieces: tuple[Piece, ...], dof: int) -> _Own:
    if not pieces:
        raise RobotError(f"{name!r} has no collision shape: nothing could touch it")
    return _Own(pieces, block_of(pieces, dof))


def _are_same(first: Sequence[Piece], second: Sequence[Piece]) -> bool:
    return len(first) == len(second) and all(
        np.array_equal(a.corners, b.corners)
        and (a.rounding, a.hollow_m) == (b.rounding, b.hollow_m)
        for a, b in zip(first, second, strict=True)
    )


class _Now(NamedTuple):
    """All that changes of a table; a change makes another one and writes into none.

    places: of the bodies among each other.  shapes: what was made into the bodies that are no
    links, and what is known of it in its own frame.
    """

    scene: Scene
    allowed: frozenset[frozenset[str]]
    bodies: dict[BodyKey, Body]
    places: dict[BodyKey, int]
    blocks: dict[BodyKey, _Block]
    shapes: dict[str, tuple[Shape | Attached, _Own]]
    ends: Int[np.ndarray, "P 2"]


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
        blocks = {key: block_of(body.pieces, self._dof) for key, body in self._robot.items()}
        for key, body in self._robot.items():
            self._carry(blocks[key], body)
        bare = Scene(scene.robot)
        allowed, places = touching(bare.robot, bare), _places(self._robot)
        ends = _pairs(self._robot, places, list(self._robot), allowed, places)
        self._now = _Now(bare, allowed, self._robot, places, blocks, {}, ends)
        self.change(scene)

    def change(self, scene: Scene) -> None:
        """Follow the scene: shapes come, go and move, links and shapes may touch others than
        before.  Nothing has changed where it raises RobotError, or SceneError for names.
        """
        require_names(self.links, scene.workcell, scene.attached, scene.allowed)
        everything: list[Shape | Attached] = [*scene.workcell, *scene.attached]
        before, wanted = self._now, {one.name: one for one in everything}
        bodies, blocks, shapes = dict(before.bodies), dict(before.blocks), dict(before.shapes)
        for name in before.shapes.keys() - wanted.keys():
            key = BodyKey(name, True)
            del bodies[key], blocks[key], shapes[name]
        news = set[BodyKey]()
        for name, one in wanted.items():
            made, own = before.shapes.get(name, (None, None))
            if made is not None and is_unchanged(one, made):
                continue
            own = _own_of(one.shape if isinstance(one, Attached) else one, self._dof, own)
            key, shapes[name] = BodyKey(name, True), (one, own)
            bodies[key], blocks[key] = self._placed(one, own)
            news.add(key)
        allowed = touching(scene.robot, scene)
        if allowed != before.allowed:  # of what is named there all pairs are looked at again
            named = set().union(*(allowed ^ before.allowed))
            news |= {key for key in bodies if key.name in named}
        order = [*self._robot, *(BodyKey(name, True) for name in wanted)]  # the scene's own
        bodies, blocks = ({key: own[key] for key in order} for own in (bodies, blocks))
        places = _places(bodies)
        stay = [-1 if key in news else places.get(key, -1) for key in before.bodies]
        ends = np.array(stay, int)[before.ends]
        moving = [*self._robot, *(BodyKey(one.name, True) for one in scene.attached)]
        more = _pairs(bodies, places, moving, allowed, news)
        ends = np.concatenate([ends[(ends >= 0).all(axis=1)], more])
        # whatever came when: of what is as near the first counts
        ends = ends[np.lexsort((ends.min(axis=1), ends.max(axis=1)))]
        self._now = _Now(scene, allowed, bodies, places, blocks, shapes, ends)

    @property
    def state(self) -> tuple[Any, ...]:
        """All that changes, to be taken back by `restore`; nothing is read again for that."""
        return self._now

    def restore(self, state: tuple[Any, ...]) -> None:
        """Be as before."""
        self._now = _Now(*state)

    @property
    def bodies(self) -> dict[BodyKey, Body]:
        """All of them."""
        return self._now.bodies

    @property
    def ends(self) -> Int[np.ndarray, "P 2"]:
        """The pairs."""
        return self._now.ends

    @property
    def frames(self) -> Int[np.ndarray, "P 2"]:
        """Those that carry the bodies of each pair."""
        return np.array([body.frame for body in self.bodies.values()], int)[self.ends]

    def named(self, pairs: Collection[Pair]) -> Bool[np.ndarray, "P"]:
        """Which pairs are among those."""
        place, count = self._now.places, len(self.bodies)
        known = [place[a] * count + place[b] for a, b in pairs if a in place and b in place]
        found = np.zeros(count * count, bool)
        found[known] = True
        return found[self.ends[:, 0] * count + self.ends[:, 1]]

    def arrays(self, ends: Int[np.ndarray, "n 2"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Hulls (H,), nodes (N, REACH + D) and pairs (P, PAIR) of these pairs of bodies, behind
        which those of their pieces are.
        """
        blocks = list(self._now.blocks.values())
        counts = np.array([len(block.nodes) for block in blocks], int)
        sizes = np.array([len(block.hulls) for block in blocks], int)
        none = np.empty((0, kernels.REACH + self._dof))
        nodes = np.concatenate([none, *(block.nodes for block in blocks)])
        nodes[:, kernels.CORNER] += np.repeat(np.cumsum(sizes) - sizes, counts)
        hulls = np.concatenate([np.empty(0), *(block.hulls for block in blocks)])
        begins = np.cumsum(counts) - counts
        return hulls, nodes, kernels.pair_table(ends, begins, counts, nodes)

    def _placed(self, one: Shape | Attached, own: _Own) -> tuple[Body, _Block]:
        shape = one.shape if isinstance(one, Attached) else one
        pose, frame, carrier = shape.at.matrix, 0, None
        if isinstance(one, Attached):
            link = self.links[one.link]
            pose, frame, carrier = link.pose @ pose, link.frame, one.link
        there = tuple(piece.at(pose) for piece in own.pieces)
        body = Body(shape.name, frame, there, shape=shape, carrier=carrier)
        block = own.block.at(pose, frame)
        self._carry(block, body)
        return body, block

    def _carry(self, block: _Block, body: Body) -> None:
        """Write which frame carries a body, and how far its points get from each axis."""
        nodes = block.nodes
        nodes[:, kernels.FRAME] = body.frame
        if body.frame > 0:
            reaches = np.array([self._reach(piece, body.frame) for piece in body.pieces])
            nodes[-len(reaches) :, kernels.REACH :] = reaches
            nodes[0, kernels.REACH :] = reaches.max(axis=0)


def _places(bodies: Mapping[BodyKey, Body]) -> dict[BodyKey, int]:
    return {key: place for place, key in enumerate(bodies)}


def _pairs(
    bodies: Mapping[BodyKey, Body],
    places: Mapping[BodyKey, int],
    moving: Collection[BodyKey],
    allowed: Collection[frozenset[str]],
    news: Collection[BodyKey],
) -> Int[np.ndarray, "n 2"]:
    """Pairs that may meet of which one is new, that of the lower frame first.  moving: bodies that
    are no shapes around the arm.
    """
    found, done = list[tuple[int, int]](), set[BodyKey]()
    for key in news:
        own, place = bodies[key], places[key]
        done.add(key)
        for other in moving if own.is_fixed else bodies:
            if other in done:
                continue
            a, b = (place, own), (places[other], bodies[other])
            first, second = (a, b) if _order(*a) < _order(*b) else (b, a)
            if may_meet(first[1], second[1], allowed):
                found.append((first[0], second[0]))
    return np.array(found, int).reshape(-1, 2)


def _order(place: int, body: Body) -> tuple[int, bool, int]:
    """Of two bodies that may meet, which is the first."""
    return body.frame, body.shape is None, place


@lru_cache(maxsize=4096)  # certificate and search ask the same, and so does every further scene
def _hull(data: bytes) -> tuple[Float[np.ndarray, "H"], Int[np.ndarray, "m"]]:
    """A convex hull of points (n, 3) as the kernels take it, and where its corners are in that."""
    points = np.frombuffer(data).reshape(-1, 3)
    corners, beside, counts = _with_neighbours(points)
    begins = np.cumsum(4 + counts) - counts - 4
    hull = np.zeros(4 * len(corners) + len(beside))
    leads = np.ones(len(hull), bool)
    leads[begins[:, None] + np.arange(4)] = False
    hull[begins[:, None] + np.arange(3)], hull[begins + 3] = corners, counts
    hull[leads] = begins[beside] - np.repeat(begins, counts)
    return hull, begins


def _with_neighbours(
    points: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "m 3"], Int[np.ndarray, "E"], Int[np.ndarray, "m"]]:
    """Corners of a convex hull, those beside each, one corner's after the other's, and how many
    they are: that share a face, or all others where it is not proven that a way along edges ends at
    the corner that lies furthest out.
    """
    if len(points) >= _MIXED:
        with contextlib.suppress(QhullError):  # flat
            hull = ConvexHull(points)
            corners, faces = np.unique(hull.simplices, return_inverse=True)
            faces = faces.reshape(hull.simplices.shape)
            count = len(corners)
            own = points[corners]
            around, begins = np.argsort(faces.ravel(), kind="stable") // 3, np.zeros(count + 1, int)
            begins[1:] = np.cumsum(np.bincount(faces.ravel(), minlength=count))
            if kernels.leads_furthest(own, faces, begins, around, _ROUNDING_M):
                ways = [faces[:, i] * count + faces[:, k] for i, k in permutations(range(3), 2)]
                first, second = np.divmod(np.unique(np.concatenate(ways)), count)  # each edge once
                return own, second, np.bincount(first, minlength=count)
    first, second = np.nonzero(~np.eye(len(points), dtype=bool))
    return points, second, np.bincount(first, minlength=len(points))
