"""What may meet in a scene, as collision_kernels.py takes it: how far each convex piece gets from
the joints' axes, and which pairs of bodies need a look.
"""

from collections.abc import Callable, Collection
from typing import Any

import numpy as np
from jaxtyping import Float

from constraint_geodesics.certification import collision_kernels as kernels
from constraint_geodesics.certification.chain import Chain, rotated
from constraint_geodesics.scene import convex_kernels as convex
from constraint_geodesics.scene.bodies import Body, BodyTable, Pair
from constraint_geodesics.scene.pieces import NOT_CONVEX, Piece, prism
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.world import BodyKey

_SIDES = 256
_CELLS = 20_000
"""Cells of joint values over which it is tried to prove that two bodies never meet."""
_FEW_JOINTS = 3
"""So many joints that move two bodies are few enough for that."""


class Collider:
    """A scene's bodies as the kernels take them, and their pairs: those that may meet while the arm
    moves, which the first pairs of `arrays` are, those that never move relative to each other, and
    those that are proven to stay apart at all joint values within `limits` (2, D).

    chain: the certifier's.  Two bodies that are proven to stay further apart than `margin` [m] need
    no look at a path whose joints are within the limits, or `beyond` them by so much [rad]; it is
    tried for those that are there at first.
    """

    def __init__(self, scene: Scene, chain: Chain, margin: float, beyond: float) -> None:
        robot = scene.robot
        self.limits = np.stack([robot.lower - beyond, robot.upper + beyond])
        self._chain = chain
        frames = np.empty((robot.dof + 1, 12))
        kernels.joint_frames(chain, np.zeros(robot.dof), frames)
        self._table = BodyTable(scene, frames, _reach_on(chain, self.limits))
        self._apart: frozenset[Pair] = frozenset()
        self._arrange()
        bodies, all_arrays = self.bodies, self.arrays
        self._apart = frozenset(
            (a, b)
            for p, (a, b) in enumerate(self.moving)
            if bodies[b].frame - bodies[a].frame <= _FEW_JOINTS
            and kernels.never_meets(all_arrays, p, self.limits, margin, _CELLS)
        )
        self._arrange()

    def change(self, scene: Scene) -> None:
        """Follow the scene.  Raises RobotError, with nothing changed, where a shape can't be
        bounded.
        """
        before = self.bodies
        self._table.change(scene)
        bodies = self.bodies
        others = {key for key, body in before.items() if bodies.get(key) is not body}
        self._apart = frozenset(pair for pair in self._apart if others.isdisjoint(pair))
        self._arrange()

    @property
    def state(self) -> tuple[Any, ...]:
        """To be taken back by `restore`."""
        return self._table.state, self._apart

    def restore(self, state: tuple[Any, ...]) -> None:
        """Be as before."""
        table, self._apart = state
        self._table.restore(table)
        self._arrange()

    @property
    def bodies(self) -> dict[BodyKey, Body]:
        """All of them."""
        return self._table.bodies

    @property
    def links(self) -> Collection[str]:
        """Names of all links."""
        return self._table.links.keys()

    def link_pose(self, q: Float[np.ndarray, "D"], link: str) -> Float[np.ndarray, "4 4"]:
        """Of a link's frame in the base frame."""
        frames, own = np.empty((len(q) + 1, 12)), self._table.links[link]
        kernels.joint_frames(self._chain, q, frames)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = frames[own.frame, 3:].reshape(3, 3), frames[own.frame, :3]
        return pose @ own.pose

    @property
    def apart(self) -> frozenset[Pair]:
        """Pairs that never meet."""
        return self._apart

    def _arrange(self) -> None:
        table, frames = self._table, self._table.frames
        is_rigid = frames[:, 0] == frames[:, 1]
        moving = table.ends[~is_rigid & ~table.named(self._apart)]
        self._keys, self._ends = list(table.bodies), np.concatenate([moving, table.ends[is_rigid]])
        self.arrays = kernels.Bodies(self._chain, *table.arrays(self._ends), len(moving))

    @property
    def moving(self) -> list[Pair]:
        """Pairs that may meet while the arm moves."""
        return [self._named(row) for row in range(self.arrays.top)]

    def rigid(self, within: float) -> dict[int, Pair]:
        """Pairs that never move relative to each other, by their rows of `arrays.pairs`, without
        those that the balls around them say are further apart than so much [m].
        """
        nodes, top = self.arrays.nodes, self.arrays.top
        ends = self.arrays.pairs[top : len(self._ends), :2].astype(int)
        # two bodies that one frame carries, in which both balls are
        balls = nodes[ends, convex.BALL : convex.BALL + 4]
        away = np.linalg.norm(balls[:, 0, :3] - balls[:, 1, :3], axis=1)
        near = away - balls[:, :, 3].sum(axis=1) <= within
        return {row: self._named(row) for row in (top + np.flatnonzero(near)).tolist()}

    def _named(self, row: int) -> Pair:
        first, second = self._ends[row].tolist()
        return self._keys[first], self._keys[second]

    def pair(self, row: float) -> tuple[Body, Body]:
        """The bodies of a row of `arrays.pairs`."""
        pairs = self.arrays.pairs
        tops = pairs[: self.arrays.top]
        own = int(row)
        if own >= self.arrays.top:
            own = int(np.flatnonzero((tops[:, 2] <= own) & (own < tops[:, 3]))[0])
        first, second = self._named(own)
        return self.bodies[first], self.bodies[second]

    def covered(self) -> list[str]:
        """Bodies whose meshes are not convex, so that their hulls cover more than them."""
        bodies = self.bodies.values()
        return sorted(b.name for b in bodies if any(p.hollow_m > NOT_CONVEX for p in b.pieces))


def _reach_on(
    chain: Chain, limits: Float[np.ndarray, "2 D"]
) -> Callable[[Piece, int], Float[np.ndarray, "D"]]:
    """What tells how far the points of a piece, carried by a frame, get from each axis at most."""
    # rows: where the axes of the frame before are turned to
    turns = [np.array([rotated(q, axis) for axis in np.eye(3)]) for q in chain.turns]

    def reach(piece: Piece, frame: int) -> Float[np.ndarray, "D"]:
        found, points = np.zeros(limits.shape[1]), piece.corners
        # wherever the joints after an axis are: of a cylinder about that axis, in the frame before,
        # those of a cylinder about the axis before, …
        for j in range(frame - 1, -1, -1):
            if chain.prismatic[j]:
                points, found[j] = np.concatenate([points, points]), 1.0
                points[: len(points) // 2, 2] += limits[0, j]
                points[len(points) // 2 :, 2] += limits[1, j]
            else:
                radius = np.linalg.norm(points[:, :2], axis=1).max()
                found[j] = radius + piece.rounding
                points = prism(_SIDES, radius, points[:, 2].min(), points[:, 2].max())
            points = points @ turns[j] + chain.offsets[j]
        return found

    return reach
