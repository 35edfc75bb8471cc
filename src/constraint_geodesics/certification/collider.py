"""What may meet in a scene, as collision_kernels.py takes it: how far each convex piece gets from
the joints' axes, and which pairs of bodies need a look.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from constraint_geodesics.certification import collision_kernels as kernels
from constraint_geodesics.certification.chain import Chain, rotated
from constraint_geodesics.scene.bodies import Body, NodeTable, pairs_of, read_bodies
from constraint_geodesics.scene.pieces import NOT_CONVEX, Piece, prism
from constraint_geodesics.scene.scene import Scene

_SIDES = 256
_CELLS = 20_000
"""Cells of joint values over which it is tried to prove that two bodies never meet."""
_FEW_JOINTS = 3
"""So many joints that move two bodies are few enough for that."""


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
    frames = np.empty((robot.dof + 1, 12))
    kernels.joint_frames(chain, np.zeros(robot.dof), frames)
    bodies = read_bodies(robot, scene.workcell, frames)
    table = NodeTable(bodies)
    nodes = table.with_reaches(robot.dof, _reach_on(chain, limits))

    def arrays(wanted: Sequence[tuple[int, int]], top: int) -> kernels.Bodies:
        return kernels.Bodies(chain, table.hulls, nodes, table.pairs(wanted), top)

    pairs = list(pairs_of(bodies, robot.allowed))
    rigid = [pair for pair in pairs if bodies[pair[0]].frame == bodies[pair[1]].frame]
    moving = [pair for pair in pairs if pair not in rigid]
    all_arrays, apart = arrays(moving, len(moving)), []
    for p, (a, b) in enumerate(moving):
        few = bodies[b].frame - bodies[a].frame <= _FEW_JOINTS
        if few and kernels.never_meets(all_arrays, p, limits, margin, _CELLS):
            apart.append((a, b))
    moving = [pair for pair in moving if pair not in apart]
    looked_at = arrays([*moving, *rigid], len(moving))
    return Collider(tuple(bodies), limits, tuple(moving), tuple(rigid), tuple(apart), looked_at)


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
