"""Freedom from collision on the whole of a path: proven by collision_kernels.py, and by PyBullet's
distances where two bodies come closer than the proof's margin.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, QhullError

from constraint_geodesics.certification import collision_kernels as kernels
from constraint_geodesics.certification.certificate import Violation, malformed
from constraint_geodesics.certification.chain import Chain
from constraint_geodesics.certification.collider import Collider
from constraint_geodesics.scene import convex_kernels as convex
from constraint_geodesics.scene.bodies import Body, Pair, touching
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.world import World

MARGIN_M = 1e-4
"""What bodies are proven to keep apart, beyond the margins that PyBullet puts around meshes.  The
distances here are at most 0.02 mm above PyBullet's (tests/certification/test_collisions.py).
"""
_PARTS = (16, 256, 4096)
"""Parts that PyBullet is asked about; the last number ends the attempt."""
_SHORTEST_M = 1e-6
"""Motion over which PyBullet is asked for no shorter parts."""
_ROUNDING_M = 1e-9


_WHAT = {"self_collision": "the arm itself", "workcell_collision": "the workcell"}
_Contact = tuple[str, int | None, str]
"""Kind, row and message of a contact that is there at every configuration."""


class Separation(NamedTuple):
    """What was found on a path: the first violation met, a distance that all bodies which may meet
    are proven to keep [m], and how many parts of the path rest on PyBullet's distances.
    """

    violation: Violation | None
    clearance_m: float = float("nan")
    asked: int = 0


class CollisionCheck:
    """Of one scene, in a PyBullet world that it does not own; without one, what the proof leaves
    open is refused.

    Raises RobotError if a collision shape can't be bounded, naming it.
    """

    def __init__(self, scene: Scene, chain: Chain, world: World | None, beyond_rad: float) -> None:
        self._world = world
        self.collider = Collider(scene, chain, MARGIN_M, beyond_rad)
        self._rigid = dict[Pair, tuple[Body, Body, _Contact | None]]()
        self._follow(scene)

    @contextmanager
    def changing(self, scene: Scene) -> Iterator[None]:
        """Follow the scene, once the world has, which is what happens within; where it, or this,
        can't, all is as it was.
        """
        before = self.collider.state
        try:
            self.collider.change(scene)
            yield
        except BaseException:
            self.collider.restore(before)
            raise
        self._follow(scene)

    def _follow(self, scene: Scene) -> None:
        self._allowed = sorted(tuple(sorted(pair)) for pair in touching(scene.robot, scene))
        self._standing = self._rigid_contact(scene.robot.dof)
        self._rests_on = ""

    @property
    def rests_on(self) -> str:
        """What was taken for the bodies, and what was left out."""
        if not self._rests_on:
            self._rests_on = self._said()
        return self._rests_on

    def _said(self) -> str:
        bodies = self.collider.bodies.values()
        shapes = sum(body.is_fixed for body in bodies)
        carried = [body for body in bodies if body.carrier is not None]
        links = len(bodies) - shapes - len(carried)
        line = f"convex pieces of {links} links and {shapes} shapes"
        if carried:
            line += f", of {', '.join(f'{b.name} on {b.carrier}' for b in carried)}"
        if covered := self.collider.covered():
            line += f", hulls that cover more than the meshes of {', '.join(covered)}"
        if apart := len(self.collider.apart):
            line += f"; {apart} pairs that never meet within the joint limits"
        if self._allowed:
            line += f"; not looked at, since they may touch: {_listed(self._allowed)}"
        never = ["a link with the one it hangs on"] if links > 1 else []
        bases = [b.name for b in bodies if b.shape is None and b.parent is None]
        never += [f"{base} with the shapes around the arm" for base in bases if shapes]
        never += [f"{body.name} with {body.carrier}" for body in carried]
        if never:
            line += f"; never a contact: {', '.join(never)}"
        if self._world is None:
            line += "; no PyBullet, with which nothing was compared"
        return line

    @property
    def apart(self) -> frozenset[Pair]:
        """Pairs of bodies that are proven never to meet within the joint limits."""
        return self.collider.apart

    def is_free(self, q: Float[np.ndarray, "D"]) -> bool:
        """Whether one configuration touches nothing: by PyBullet's word where bodies come close,
        and beyond the limits, where pairs are left out that never meet within them.
        """
        low, high = self.collider.limits
        inside = bool((q >= low).all() and (q <= high).all())
        near, pair = self._nearest(q, MARGIN_M)
        if inside and self._standing is None and near >= MARGIN_M:
            return True
        # PyBullet knows a mesh by its surface alone, and rounds the edges of boxes
        if self._standing is not None or (pair >= 0 and near + self._overlap(pair) <= 0.0):
            return False
        return self._world is not None and self._world.is_free(q)

    def free(self, q: Float[np.ndarray, "n D"]) -> Bool[np.ndarray, "n"]:
        """Which configurations touch nothing, each as `is_free` says."""
        return np.array([self.is_free(row) for row in q], dtype=bool)

    def what_touches(self, q: Float[np.ndarray, "D"]) -> str:
        """What a configuration touches that is not free, and with what."""
        if self._standing is not None:
            kind, _, text = self._standing
            return f"{_WHAT[kind]}: {text}"
        first, second = self.collider.pair(self._nearest(q, np.inf)[1])
        return f"{_WHAT[_kind(first, second)]}: {second.name} with {first.name}"

    def clearance(self, q: Float[np.ndarray, "D"]) -> float:
        """The least distance of bodies that may meet [m], inf where none may; 0 or less where they
        touch.
        """
        return self._nearest(q, np.inf)[0]

    def _nearest(self, q: Float[np.ndarray, "D"], most: float) -> tuple[float, int]:
        place = np.ascontiguousarray(q, float)
        near, pair = kernels.nearest_pair(self.collider.arrays, place, most)
        return float(near), int(pair)

    def is_clear(self, rows: Float[np.ndarray, "T D"]) -> bool:
        """Whether the straight joint lines between rows are within the limits and touch nothing."""
        low, high = self.collider.limits
        within = len(rows) > 0 and bool(((rows >= low) & (rows <= high)).all())
        path = np.ascontiguousarray(rows, float)
        return within and self.along(path).violation is None

    def along(self, rows: Float[np.ndarray, "T D"]) -> Separation:
        """Whether the straight joint lines between the rows are free.  A violation is the first one
        met, halving the path.
        """
        if self._standing is not None:
            return Separation(malformed(*self._standing))
        if len(rows) == 1:
            rows = np.concatenate([rows, rows])
        for most in _PARTS:
            undecided = np.empty((most, 4))
            proven, _, count = kernels.prove_apart(self.collider.arrays, rows, MARGIN_M, undecided)
            for part in undecided[: min(count, most)]:
                if (violation := self._decide(rows, *part)) is not None:
                    return Separation(violation)
            if count <= most:
                # PyBullet's distances say that nothing touches, not by how much
                return Separation(None, 0.0 if count else float(proven), int(count))
        text = f"bodies come closer than {1e3 * MARGIN_M} mm on more than {most} parts of the path"
        return Separation(malformed("clearance", None, text))

    def pose_difference(self, q: Float[np.ndarray, "n D"], world: World) -> float:
        """How far the frame of any link, whether it has a collision shape or not, is from where
        PyBullet has it at most: its origin [m], or the tip of an axis of 1 m.
        """
        links = list(self.collider.links)
        own = [[self.collider.link_pose(row, link) for link in links] for row in q]
        theirs = [world.link_poses(row, links) for row in q]
        off = (np.array(own) - np.array(theirs))[..., :3, :]
        return float(np.linalg.norm(off, axis=-2).max())

    def _decide(
        self, rows: np.ndarray, row: float, start: float, end: float, pair: float
    ) -> Violation | None:
        """What PyBullet's distances say of a part of a line: between two places they change by no
        more than the bodies move, and so do the distances here.  Where bodies overlap by more than
        the margin, they touch.
        """
        if self._world is None:
            return self._unproven(int(row), 0.5 * (start + end), pair)
        first, second = self.collider.pair(pair)
        i, line = int(row), rows[int(row) + 1] - rows[int(row)]
        reach = self._reach(pair)
        waiting = [(start, end)]
        while waiting:
            start, end = waiting.pop()
            middle, motion = 0.5 * (start + end), 0.5 * (end - start) * float(np.abs(line) @ reach)
            q = rows[i] + middle * line
            apart = self._world.distance(q, first.key, second.key, motion)
            # PyBullet rounds the edges of boxes, has less than the balls of a cloud, and says
            # nothing of two meshes: what overlaps here is a contact too
            beyond = self._near(int(pair), q) + self._overlap(int(pair))
            if apart < 0.0 or beyond <= 0.0:
                return self._touches(i, middle, first, second)
            if min(apart, beyond) <= motion + _ROUNDING_M:
                if motion < _SHORTEST_M:
                    return self._unproven(i, middle, pair)
                waiting += [(middle, end), (start, middle)]
        return None

    def _near(self, row: int, q: Float[np.ndarray, "D"]) -> float:
        """The distance of a row of the table of pairs [m]."""
        arrays = self.collider.arrays
        alone = arrays._replace(pairs=_only(arrays.pairs, row), top=1)
        return float(kernels.nearest_pair(alone, np.ascontiguousarray(q, float), np.inf)[0])

    def _overlap(self, row: int) -> float:
        """How far a row of the table of pairs may overlap until it is a contact whatever PyBullet
        says [m]: by the margin of the proof, where that is no more than those around the bodies.
        """
        arrays = self.collider.arrays
        ends = arrays.pairs[row, :2].astype(int)
        return min(MARGIN_M, float(arrays.nodes[ends, convex.MARGIN].sum()))

    def _reach(self, pair: float) -> Float[np.ndarray, "D"]:
        """How far the second body's points get from the axes of the joints that move the two."""
        nodes, row = self.collider.arrays.nodes, self.collider.arrays.pairs[int(pair)]
        a, b = nodes[int(row[0])], nodes[int(row[1])]
        reach = b[convex.REACH :].copy()
        reach[: int(a[convex.FRAME])] = 0.0
        return reach

    def _rigid_contact(self, dof: int) -> _Contact | None:
        """A contact that is there at every configuration, of bodies that were looked at before as
        it was found then.
        """
        before, self._rigid = self._rigid, {}
        for row, pair in self.collider.rigid(MARGIN_M).items():
            bodies = self.collider.bodies[pair[0]], self.collider.bodies[pair[1]]
            known = before.get(pair)
            if known is None or known[0] is not bodies[0] or known[1] is not bodies[1]:
                known = *bodies, self._touch_always(row, *bodies, dof)
            self._rigid[pair] = known
        return next((found for *_, found in self._rigid.values() if found is not None), None)

    def _touch_always(self, row: int, first: Body, second: Body, dof: int) -> _Contact | None:
        zeros = np.zeros(dof)
        near = self._near(row, zeros)
        if near >= MARGIN_M:
            return None
        if self._world is None:
            text = f"{second.name} and {first.name} are too close at every configuration"
            return _kind(first, second), None, text
        # PyBullet knows meshes by their surfaces, none of two of them, and rounds edges of boxes
        apart = self._world.distance(zeros, first.key, second.key, MARGIN_M)
        beyond = near + self._overlap(row) - _depth_of_sharp(first, second)
        if apart < 0.0 or beyond < -_ROUNDING_M:
            text = f"{second.name} and {first.name} touch at every configuration"
            return _kind(first, second), None, text
        return None

    def _touches(self, row: int, share: float, first: Body, second: Body) -> Violation:
        text = (
            f"{second.name} touches {first.name} on the line from row {row}, {share:.0%} of the "
            f"way to the next"
        )
        return malformed(_kind(first, second), row, text)

    def _unproven(self, row: int, share: float, pair: float) -> Violation:
        first, second = self.collider.pair(pair)
        text = (
            f"{second.name} and {first.name} come so close on the line from row {row}, {share:.0%} "
            f"of the way to the next, that no proof keeps them apart"
        )
        return malformed("clearance", row, text)


def _depth_of_sharp(first: Body, second: Body) -> float:
    """How deep pieces of two bodies overlap that have no rounding at all, and so no distance below
    0 [m]: how far the origin is inside the hull of their differences.  0 where faces lie on each
    other.
    """
    sharp = [[piece for piece in body.pieces if piece.rounding == 0.0] for body in (first, second)]
    deepest = 0.0
    for one, other in product(*sharp):
        apart = (other.corners[None] - one.corners[:, None]).reshape(-1, 3)
        try:
            deepest = max(deepest, -float(ConvexHull(apart).equations[:, 3].max()))
        except QhullError:
            continue  # both flat, in one plane
    return deepest


def _listed(pairs: Iterable[tuple[str, ...]]) -> str:
    return ", ".join(" with ".join(pair) for pair in pairs)


def _only(pairs: np.ndarray, row: int) -> np.ndarray:
    """The table of one pair of bodies, or of pieces, alone."""
    first, last = int(pairs[row, 2]), int(pairs[row, 3])
    table = np.concatenate([pairs[row : row + 1], pairs[first:last]])
    table[0, 2:4] = (1.0, len(table)) if len(table) > 1 else 0.0
    return table


def _kind(first: Body, second: Body) -> str:
    return "workcell_collision" if first.is_fixed or second.is_fixed else "self_collision"
