"""A judge of scenes that shares no code with the planner's: convex bodies of a PyBullet client of
its own, their exact kinds, and which of them may touch.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import Any, Self

import numpy as np
import pybullet
from tests.scene.mesh_files import Brick

from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.capsule import Capsule
from constraint_geodesics.scene.cylinder import Cylinder
from constraint_geodesics.scene.mesh import Mesh
from constraint_geodesics.scene.point_cloud import PointCloud
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.shape import Shape
from constraint_geodesics.scene.sphere import Sphere

Pose = tuple[Sequence[float], Sequence[float]]
"""Position [m] and quaternion x, y, z, w."""
Part = tuple[int, int]
"""A body of PyBullet's and one of its links."""
HERE: Pose = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


class Judge:
    """Of a scene as a value.  bricks: of each mesh, by the name of its shape."""

    def __init__(self, scene: Scene, bricks: Mapping[str, Sequence[Brick]]) -> None:
        self._bricks, self._id = bricks, pybullet.connect(pybullet.DIRECT)
        flags = pybullet.URDF_IGNORE_VISUAL_SHAPES
        self._arm = self._call("loadURDF", str(scene.robot.urdf), useFixedBase=True, flags=flags)
        info = [self._call("getJointInfo", self._arm, k) for k in range(self._links())]
        index = {row[12].decode(): row[0] for row in info}
        base = self._call("getBodyInfo", self._arm)[0].decode()
        index[base] = -1
        self._index = index
        joints = {row[1].decode(): row[0] for row in info}
        self._joints = [joints[name] for name in scene.robot.joint_names]
        names = {k: name for name, k in index.items()}
        may = {frozenset((names[row[0]], names[row[16]])) for row in info}
        may |= {frozenset(pair) for pair in (*scene.robot.allowed, *scene.allowed)}
        self._held = list[tuple[int, int, Pose]]()
        parts = {
            name: [(self._arm, k)]
            for name, k in index.items()
            if self._call("getCollisionShapeData", self._arm, k)
        }
        fixed = {shape.name for shape in scene.workcell}
        for shape in scene.workcell:
            parts[shape.name] = [(self._made(own, at), -1) for own, at in self._solids(shape)]
            may |= {frozenset((shape.name, link)) for link in (*shape.exempt_links, base)}
        for one in scene.attached:
            made = [(self._made(own, at), at) for own, at in self._solids(one.shape)]
            parts[one.name] = [(body, -1) for body, _ in made]
            self._held += [(body, index[one.link], at) for body, at in made]
            others = (one.link, *one.touching, *one.shape.exempt_links)
            may |= {frozenset((one.name, other)) for other in others}
        self._pairs = [
            ((a, b), parts[a], parts[b])
            for a, b in combinations(parts, 2)
            if frozenset((a, b)) not in may and not {a, b} <= fixed
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._call("disconnect")

    def deepest(self, q: np.ndarray) -> tuple[float, tuple[str, ...]]:
        """The least distance of what must not touch at a configuration [m], below 0 where it does,
        and what that is; inf where nothing touches.
        """
        self._put(q)
        for body, link, at in self._held:
            place = pybullet.multiplyTransforms(*self._link(link), *at)
            self._call("resetBasePositionAndOrientation", body, *place)
        self._call("performCollisionDetection")
        return min(self._distances(), default=(np.inf, ()))

    def poses(self, rows: np.ndarray, link: str) -> tuple[np.ndarray, np.ndarray]:
        """Positions (n, 3) [m] and rotations (n, 3, 3) of a link, at configurations (n, D)."""
        places, turns = np.empty((len(rows), 3)), np.empty((len(rows), 3, 3))
        for k, q in enumerate(rows):
            self._put(q)
            places[k], turn = self._link(self._index[link])
            turns[k] = np.reshape(pybullet.getMatrixFromQuaternion(turn), (3, 3))
        return places, turns

    def _put(self, q: np.ndarray) -> None:
        for joint, value in zip(self._joints, q.tolist(), strict=True):
            self._call("resetJointState", self._arm, joint, value)

    def _link(self, link: int) -> Pose:
        """Where a link's frame is now."""
        if link < 0:
            return HERE
        state = self._call("getLinkState", self._arm, link, computeForwardKinematics=1)
        return state[4], state[5]

    def _distances(self) -> Iterator[tuple[float, tuple[str, ...]]]:
        for names, first, second in self._pairs:
            for a, i in first:
                for b, k in second:
                    for point in self._call("getClosestPoints", a, b, 0.0, i, k):
                        yield point[8], names

    def _call(self, name: str, *values: Any, **named: Any) -> Any:
        return getattr(pybullet, name)(*values, **named, physicsClientId=self._id)

    def _links(self) -> int:
        return int(self._call("getNumJoints", self._arm))

    def _made(self, solid: Mapping[str, Any], at: Pose) -> int:
        shape = self._call("createCollisionShape", **solid)
        assert shape >= 0
        made = self._call("createMultiBody", 0, shape, basePosition=at[0], baseOrientation=at[1])
        return int(made)

    def _solids(self, shape: Shape) -> Iterator[tuple[dict[str, Any], Pose]]:
        """What a shape is made of, and where: in the base frame, or that of its link."""
        if isinstance(shape, Capsule):
            yield _capsule(shape)
            return
        turn = pybullet.getQuaternionFromEuler(shape.at.rpy_rad)
        at: Pose = (shape.at.position_m, turn)
        if isinstance(shape, Box):
            yield _brick(np.multiply(0.5, shape.size_m)), at
        elif isinstance(shape, Sphere):
            yield _ball(shape.radius_m), at
        elif isinstance(shape, Cylinder):
            kind = {"shapeType": pybullet.GEOM_CYLINDER}
            yield kind | {"radius": shape.radius_m, "height": shape.length_m}, at
        elif isinstance(shape, PointCloud):
            for point in shape.points_m.array.tolist():
                yield _ball(shape.radius_m), pybullet.multiplyTransforms(*at, point, HERE[1])
        else:
            assert isinstance(shape, Mesh)
            for brick in self._bricks[shape.name]:
                centre = np.multiply(shape.scale, brick.centre).tolist()
                place = pybullet.multiplyTransforms(*at, centre, HERE[1])
                yield _brick(np.multiply(shape.scale, brick.half_edges)), place


def _brick(half_edges: np.ndarray) -> dict[str, Any]:
    return {"shapeType": pybullet.GEOM_BOX, "halfExtents": half_edges.tolist()}


def _ball(radius: float) -> dict[str, Any]:
    return {"shapeType": pybullet.GEOM_SPHERE, "radius": radius}


def _capsule(shape: Capsule) -> tuple[dict[str, Any], Pose]:
    """From its ends, along the z axis of its body."""
    first, last = np.array(shape.from_m), np.array(shape.to_m)
    along, turn = last - first, HERE[1]
    length = float(np.linalg.norm(along))
    across = np.cross([0.0, 0.0, 1.0], along)
    if np.linalg.norm(across) > 1e-12:
        angle = float(np.arctan2(np.linalg.norm(across), along[2]))
        turn = pybullet.getQuaternionFromAxisAngle(
            (across / np.linalg.norm(across)).tolist(), angle
        )
    size = {"radius": shape.radius_m, "height": length}
    return {"shapeType": pybullet.GEOM_CAPSULE} | size, ((0.5 * (first + last)).tolist(), turn)
