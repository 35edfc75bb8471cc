"""PyBullet as the judge: tool poses, self-collision and collision with the workcell of given configurations.

The only importer of pybullet.  Every world is a physics client of its own in DIRECT mode; nothing is simulated.
"""

import contextlib
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from jaxtyping import Bool, Float

from constraint_geodesics.robot.kinematics import SerialRobot


@dataclass(frozen=True)
class Box:
    """A fixed box: its centre and edge lengths [m], and the robot's links that may touch it."""

    name: str
    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    exempt_links: tuple[str, ...] = ()


@dataclass(frozen=True)
class Body:
    """A fixed body read from a URDF at a pose [m, rad], and the robot's links that may touch it."""

    name: str
    urdf: Path
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    exempt_links: tuple[str, ...] = ()


@dataclass(frozen=True)
class Labels:
    """What PyBullet says of n configurations."""

    position: Float[np.ndarray, "n 3"]
    """Tool position in the base frame [m]."""
    quaternion: Float[np.ndarray, "n 4"]
    """Tool orientation x, y, z, w."""
    rpy: Float[np.ndarray, "n 3"]
    """Roll, pitch, yaw [rad], for people: they wrap and lock."""
    self_collision: Bool[np.ndarray, "n"]
    workcell_collision: Bool[np.ndarray, "n"]


def data_path() -> Path:
    """Folder of the robots and meshes that ship with PyBullet."""
    with _quiet():
        import pybullet_data
    return Path(pybullet_data.getDataPath())


class World:
    """One robot among fixed bodies.  Adjacent links and exempt links may touch; nothing else may.

    Raises FileNotFoundError if a URDF is missing and ValueError if an exempt link is not the robot's.
    """

    def __init__(self, robot: SerialRobot, fixed: Sequence[Box | Body] = ()) -> None:
        with _quiet():
            import pybullet
        self._bullet = pybullet
        self.robot = robot
        self._client = pybullet.connect(pybullet.DIRECT)
        flags = pybullet.URDF_USE_SELF_COLLISION | pybullet.URDF_USE_SELF_COLLISION_EXCLUDE_PARENT
        with _quiet():
            self._body = pybullet.loadURDF(
                str(robot.urdf), useFixedBase=True, flags=flags, physicsClientId=self._client
            )
        info = [
            pybullet.getJointInfo(self._body, i, physicsClientId=self._client)
            for i in range(pybullet.getNumJoints(self._body, physicsClientId=self._client))
        ]
        joint_index = {row[1].decode(): row[0] for row in info}
        self._link_index = {row[12].decode(): row[0] for row in info}
        self._link_index[pybullet.getBodyInfo(self._body, physicsClientId=self._client)[0].decode()] = -1
        self._joints = [joint_index[name] for name in robot.joint_names]
        self._tool = self._link_index[robot.tool_link]
        self._exempt = {self._add(body): self._links(body) for body in fixed}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free the physics client."""
        if self._bullet.isConnected(self._client):
            self._bullet.disconnect(self._client)

    def label(self, q: Float[np.ndarray, "n D"]) -> Labels:
        """Tool pose and collisions of each configuration [rad]."""
        poses, collisions = [], []
        for row in q:
            self._place(row)
            state = self._bullet.getLinkState(
                self._body, self._tool, computeForwardKinematics=1, physicsClientId=self._client
            )
            poses.append((*state[4], *state[5]))
            collisions.append(self._collisions())
        table = np.array(poses).reshape(-1, 7)
        hits = np.array(collisions, dtype=bool).reshape(-1, 2)
        rpy = [self._bullet.getEulerFromQuaternion(quaternion) for quaternion in table[:, 3:]]
        return Labels(table[:, :3], table[:, 3:], np.array(rpy).reshape(-1, 3), hits[:, 0], hits[:, 1])

    def is_free(self, q: Float[np.ndarray, "D"]) -> bool:
        """Whether one configuration touches neither itself nor the workcell."""
        self._place(q)
        return not any(self._collisions())

    def free(self, q: Float[np.ndarray, "n D"]) -> Bool[np.ndarray, "n"]:
        """Which configurations touch neither themselves nor the workcell."""
        return np.array([self.is_free(row) for row in q], dtype=bool)

    def _place(self, q: np.ndarray) -> None:
        self._bullet.resetJointStatesMultiDof(
            self._body, self._joints, [[float(x)] for x in q], physicsClientId=self._client
        )

    def _collisions(self) -> tuple[bool, bool]:
        self._bullet.performCollisionDetection(physicsClientId=self._client)
        own = workcell = False
        for contact in self._bullet.getContactPoints(bodyA=self._body, physicsClientId=self._client):
            if contact[8] >= 0.0:  # a contact is listed from a small positive distance on
                continue
            if contact[2] == self._body:
                own = True
            elif contact[3] not in self._exempt[contact[2]]:
                workcell = True
        return own, workcell

    def _add(self, body: Box | Body) -> int:
        bullet, client = self._bullet, self._client
        if isinstance(body, Box):
            half = [0.5 * edge for edge in body.size]
            shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=half, physicsClientId=client)
            return int(bullet.createMultiBody(0, shape, basePosition=body.centre, physicsClientId=client))
        if not body.urdf.is_file():
            raise FileNotFoundError(f"workcell {body.name!r}: no such URDF file: {body.urdf}")
        with _quiet():
            return int(
                bullet.loadURDF(
                    str(body.urdf), basePosition=body.position,
                    baseOrientation=bullet.getQuaternionFromEuler(body.rpy), useFixedBase=True,
                    physicsClientId=client,
                )
            )  # fmt: skip

    def _links(self, body: Box | Body) -> frozenset[int]:
        unknown = [name for name in body.exempt_links if name not in self._link_index]
        if unknown:
            raise ValueError(f"workcell {body.name!r}: {unknown} are not links of {self.robot.name}")
        return frozenset(self._link_index[name] for name in body.exempt_links)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the lines that the library writes past Python straight to the process's output."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved = [(stream, os.dup(stream)) for stream in (1, 2)]
    try:
        with open(os.devnull, "w") as nothing:
            for stream, _ in saved:
                os.dup2(nothing.fileno(), stream)
        yield
    finally:
        for stream, copy in saved:
            os.dup2(copy, stream)
            os.close(copy)
