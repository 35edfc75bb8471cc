"""PyBullet as the judge: tool poses and collisions of given configurations.

The only importer of pybullet.  Every world is a client of its own; nothing is simulated here.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import combinations
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float

from constraint_geodesics.robot.kinematics import RobotError, SerialRobot, urdf_root
from constraint_geodesics.scene.attached import Attached, is_unchanged
from constraint_geodesics.scene.names import require_names
from constraint_geodesics.scene.shape import Placement, Shape
from constraint_geodesics.scene.urdf import quiet


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


@dataclass(frozen=True)
class LoadedLink:
    """One link of the chain to the tool as PyBullet holds it, with the joint that carries it.

    A link's pose is that of its inertial frame.  At joint value 0 the joint lies at
    `joint_position` [m] in the parent's inertial frame, and `quaternion` (x, y, z, w) turns this
    link's inertial frame into the parent's.
    """

    name: str
    kind: str
    """revolute, prismatic, fixed, or another of PyBullet's joint types."""
    column: int | None
    """Which entry of a configuration moves the joint; None for none."""
    axis: tuple[float, float, float]
    """Of the joint, in this link's inertial frame."""
    joint_position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    inertial_position: tuple[float, float, float]
    """Of the inertial frame in the link's own frame, whose origin is the joint [m]."""
    inertial_quaternion: tuple[float, float, float, float]


@dataclass(frozen=True)
class LoadedChain:
    """PyBullet's model from the base to the tool: the pose of the base's inertial frame [m], then
    each link.
    """

    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    links: tuple[LoadedLink, ...]


class BodyKey(NamedTuple):
    """A link of the robot, or a shape of the workcell."""

    name: str
    is_shape: bool


class _Client:
    """PyBullet's functions and constants, for one physics client of its own."""

    def __init__(self) -> None:
        with quiet():
            import pybullet
        self._module = pybullet
        self._id = pybullet.connect(pybullet.DIRECT)
        self.meshes = dict[str, int]()  # shapes of meshes that were made here, by what is in them

    @cached_property
    def speck(self) -> int:
        """What every shape looks like, which nobody sees."""
        size = {"shapeType": self.GEOM_BOX, "halfExtents": [1e-3] * 3}
        return int(self.createVisualShape(**size))

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._module, name)
        if callable(found) and name not in _WITHOUT_CLIENT:
            found = partial(found, physicsClientId=self._id)
        setattr(self, name, found)  # so that it is asked for once
        return found


_WITHOUT_CLIENT = [
    "error",
    "getEulerFromQuaternion",
    "getMatrixFromQuaternion",
    "getQuaternionFromEuler",
    "invertTransform",
    "multiplyTransforms",
]


@dataclass(frozen=True)
class _Placed:
    """A shape's body: which one, its links, what was made into it, and the pose of its inertial
    frame in its own.  carrier: the index of the link that carries it.
    """

    body: int
    links: tuple[int, ...]
    made: Shape | Attached
    inertial: tuple[Any, Any]
    carrier: int | None = None


class World:
    """One robot among fixed bodies, and what it carries.  Adjacent links, pairs of links that the
    robot allows, links exempt from a shape, what carries a shape and what is said to touch it, and
    allowed pairs of names may touch; nothing else may.

    Raises RobotError if PyBullet has not all of the robot's collision shapes, and SceneError for
    names that can't be.
    """

    def __init__(
        self,
        robot: SerialRobot,
        fixed: Sequence[Shape] = (),
        attached: Sequence[Attached] = (),
        allowed: Collection[tuple[str, str]] = (),
    ) -> None:
        self._bullet = bullet = _Client()
        self.robot = robot
        flags = bullet.URDF_USE_SELF_COLLISION | bullet.URDF_USE_SELF_COLLISION_EXCLUDE_PARENT
        flags |= bullet.URDF_IGNORE_VISUAL_SHAPES  # seconds for some robots
        bullet.setPhysicsEngineParameter(enableFileCaching=0)  # a file may be written anew
        try:
            with quiet():
                self._body = body = bullet.loadURDF(str(robot.urdf), useFixedBase=True, flags=flags)
        except bullet.error:
            self.close()
            raise RobotError(
                f"{robot.urdf}: PyBullet can't load it: look at <inertial>, <visual>, <material>"
            ) from None
        info = [bullet.getJointInfo(body, i) for i in range(bullet.getNumJoints(body))]
        joint_index = {row[1].decode(): row[0] for row in info}
        self._link_index = {row[12].decode(): row[0] for row in info}
        self._link_index[bullet.getBodyInfo(body)[0].decode()] = -1
        self._check_shapes()
        self._joints = [joint_index[name] for name in robot.joint_names]
        self._tool = self._link_index[robot.tool_link]
        names = {index: name for name, index in self._link_index.items()}
        hanging = (frozenset((names[row[0]], names[row[16]])) for row in info)
        self._never = frozenset([*map(frozenset, robot.allowed), *hanging])
        self._shapes = dict[str, _Placed]()
        self._allowed = frozenset[frozenset[str]]()
        try:
            self.change(fixed, attached, allowed)
        except BaseException:
            self.close()
            raise

    def change(
        self,
        fixed: Sequence[Shape],
        attached: Sequence[Attached] = (),
        allowed: Collection[tuple[str, str]] = (),
    ) -> None:
        """Other shapes around the robot, other ones that it carries: what stays is left alone, and
        all does where this raises.
        """
        require_names(self._link_index, fixed, attached, allowed)
        everything: list[Shape | Attached] = [*fixed, *attached]
        wanted = {one.name: one for one in everything}
        shapes = (*fixed, *(one.shape for one in attached))
        pairs = [*allowed, *((s.name, link) for s in shapes for link in s.exempt_links)]
        pairs += [(one.name, other) for one in attached for other in (one.link, *one.touching)]
        gone = dict.fromkeys(  # in order: PyBullet gives their numbers to others
            name
            for name, own in self._shapes.items()
            if name not in wanted or not is_unchanged(wanted[name], own.made)
        )
        news = {n: one for n, one in wanted.items() if n not in self._shapes or n in gone}
        made = self._made(news)  # all that can fail, before anything goes
        now = frozenset(map(frozenset, pairs)) | self._never
        # what is noted of pairs is ahead of what PyBullet knows: after an interrupt a change back
        # does all of it again
        try:
            # before a body goes, since PyBullet gives its number to another
            over = {p for p in self._allowed if p not in now or not p.isdisjoint(gone)}
            self._allowed -= over
            self._filter(over, 1)
            for name in gone:
                self._bullet.removeBody(self._shapes.pop(name).body)
            self._shapes |= made
        except BaseException:
            for name, own in made.items():
                if self._shapes.get(name) is not own:
                    self._bullet.removeBody(own.body)
            raise
        others = now - self._allowed
        # a pair of which one is away is filtered when it comes
        self._allowed = frozenset(p for p in now if all(self._parts(name) for name in p))
        self._filter(others, 0)

    def _made(self, news: Mapping[str, Shape | Attached]) -> dict[str, _Placed]:
        """Bodies of new shapes; none of them where one can't be made."""
        made = dict[str, _Placed]()
        if not news:
            return made
        try:
            for name, one in news.items():
                try:
                    made[name] = self._add(one)
                except (self._bullet.error, SystemError) as error:
                    raise RobotError(f"{name!r}: PyBullet can't make it: {error}") from None
        except BaseException:
            for own in made.values():
                self._bullet.removeBody(own.body)
            raise
        return made

    def _add(self, one: Shape | Attached) -> _Placed:
        bullet = self._bullet
        if isinstance(one, Shape):
            body = one.add_to(bullet)
        else:
            body = one.shape.placed(Placement()).add_to(bullet)
        links = (-1, *range(bullet.getNumJoints(body)))
        inertial = bullet.getDynamicsInfo(body, -1)[3:5]
        if isinstance(one, Shape):
            return _Placed(body, links, one, inertial)
        for link in links:  # what stands still meets nothing else that does, which this does not
            bullet.setCollisionFilterGroupMask(body, link, _MOVING, _ALL)
        place, turn = bullet.multiplyTransforms(
            one.shape.at.position_m, one.shape.at.quaternion, *inertial
        )
        return _Placed(body, links, one, (place, turn), self._link_index[one.link])

    def _filter(self, pairs: Iterable[frozenset[str]], counts: int) -> None:
        """Whether pairs are examined: what may touch need not be, again and again."""
        for pair in pairs:
            ends = [part for name in pair for part in self._parts(name)]
            for (first, link), (second, other) in combinations(ends, 2):
                self._bullet.setCollisionFilterPair(first, second, link, other, counts)

    def _parts(self, name: str) -> list[tuple[int, int]]:
        """Bodies with their links that are called so: a shape, or a link of the robot."""
        if name in self._shapes:
            own = self._shapes[name]
            return [(own.body, link) for link in own.links]
        return [(self._body, self._link_index[name])] if name in self._link_index else []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the physics client."""
        if self._bullet.isConnected():
            self._bullet.disconnect()

    def label(self, q: Float[np.ndarray, "n D"]) -> Labels:
        """Tool pose and collisions of each configuration [rad]."""
        poses, collisions = [], []
        for row in q:
            self._place(row)
            state = self._bullet.getLinkState(self._body, self._tool, computeForwardKinematics=1)
            poses.append((*state[4], *state[5]))
            collisions.append(self._collisions())
        position, quaternion = np.split(np.array(poses).reshape(-1, 7), [3], axis=1)
        rpy = [self._bullet.getEulerFromQuaternion(row) for row in quaternion]
        own, workcell = np.array(collisions, dtype=bool).reshape(-1, 2).T
        return Labels(position, quaternion, np.array(rpy).reshape(-1, 3), own, workcell)

    def is_free(self, q: Float[np.ndarray, "D"]) -> bool:
        """Whether one configuration touches neither itself nor the workcell."""
        self._place(q)
        return not any(self._collisions())

    def free(self, q: Float[np.ndarray, "n D"]) -> Bool[np.ndarray, "n"]:
        """Which configurations touch neither themselves nor the workcell."""
        return np.array([self.is_free(row) for row in q], dtype=bool)

    def first_collision(self, q: Float[np.ndarray, "n D"]) -> int | None:
        """Index of the first configuration that is not free; None where all are."""
        return next((index for index, row in enumerate(q) if not self.is_free(row)), None)

    def link_poses(
        self, q: Float[np.ndarray, "D"], links: Sequence[str]
    ) -> list[Float[np.ndarray, "4 4"]]:
        """Poses of the frames of links in the base frame at one configuration."""
        self._place(q)
        found = []
        for name in links:
            pose = np.eye(4)
            if (index := self._link_index[name]) >= 0:
                state = self._bullet.getLinkState(self._body, index, computeForwardKinematics=1)
                turn = self._bullet.getMatrixFromQuaternion(state[5])
                pose[:3, :3], pose[:3, 3] = np.array(turn).reshape(3, 3), state[4]
            found.append(pose)
        return found

    def distance(
        self, q: Float[np.ndarray, "D"], first: BodyKey, second: BodyKey, most_m: float
    ) -> float:
        """PyBullet's distance of two bodies at one configuration [m], negative where they overlap;
        inf where it is more than `most_m`.
        """
        self._place(q)
        # a little more, so that what is as far away as `most_m` is still found
        (a, i), (b, k) = self._indices(first), self._indices(second)
        return self._between(a, b, i, k, most_m + 1e-4)

    def _between(self, first: int, second: int, link: int, other: int, most_m: float) -> float:
        """Distance of two bodies' links as they stand [m]; inf where it is more than `most_m`."""
        found = self._bullet.getClosestPoints(first, second, most_m, link, other)
        return min((point[8] for point in found), default=np.inf)

    def _indices(self, key: BodyKey) -> tuple[int, int]:
        """A body's index and that of its link; -2 stands for all links."""
        if key.is_shape:
            return self._shapes[key.name].body, -2
        return self._body, self._link_index[key.name]

    def loaded_chain(self) -> LoadedChain:
        """The chain from the base to the tool, as PyBullet understood the URDF."""
        bullet, body = self._bullet, self._body
        kinds = {
            bullet.JOINT_REVOLUTE: "revolute",
            bullet.JOINT_PRISMATIC: "prismatic",
            bullet.JOINT_FIXED: "fixed",
        }
        links: list[LoadedLink] = []
        link = self._tool
        while link >= 0:
            info = bullet.getJointInfo(body, link)
            dynamics = bullet.getDynamicsInfo(body, link)
            x, y, z, w = info[15]  # turns the parent's coordinates into this link's
            name = info[12].decode()
            kind = kinds.get(info[2], f"PyBullet's type {info[2]}")
            column = self._joints.index(link) if link in self._joints else None
            frame = (info[13], info[14], (-x, -y, -z, w), *dynamics[3:5])
            links.append(LoadedLink(name, kind, column, *frame))
            link = info[16]
        position, quaternion = bullet.getBasePositionAndOrientation(body)
        return LoadedChain(position, quaternion, tuple(reversed(links)))

    def _check_shapes(self) -> None:
        """PyBullet goes on without a shape that it can't read, and nothing would touch it."""
        for link in urdf_root(self.robot.urdf).iterfind("link"):
            name = link.get("name", "")
            shapes = self._bullet.getCollisionShapeData(self._body, self._link_index[name])
            if len(shapes) < len(link.findall("collision")):
                self.close()
                raise RobotError(
                    f"{self.robot.urdf}: a collision shape of link {name!r} is none to PyBullet: "
                    "write its mesh as OBJ or binary STL, in the URDF's folder or one above it"
                )

    def _place(self, q: np.ndarray) -> None:
        values = np.asarray(q, float)[:, None].tolist()
        bullet = self._bullet
        bullet.resetJointStatesMultiDof(self._body, self._joints, values)
        for own in self._shapes.values():
            if own.carrier is None:
                continue
            if own.carrier < 0:
                position, turn = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
            else:
                state = bullet.getLinkState(self._body, own.carrier, computeForwardKinematics=1)
                position, turn = state[4:6]
            pose = bullet.multiplyTransforms(position, turn, *own.inertial)
            bullet.resetBasePositionAndOrientation(own.body, *pose)

    def _collisions(self) -> tuple[bool, bool]:
        """Whether the arm, or what it carries, touches itself, and whether it touches the
        workcell.
        """
        self._bullet.performCollisionDetection()
        carried = [own.body for own in self._shapes.values() if own.carrier is not None]
        moving, own, workcell = {self._body, *carried}, False, False
        for body in moving:
            for contact in self._bullet.getContactPoints(bodyA=body):
                if contact[8] >= 0.0:  # a contact is listed from a small positive distance on
                    continue
                if contact[2] in moving:
                    own = own or self._overlap(contact)
                elif body != self._body or contact[3] != _BASE:  # what carries the arm may touch
                    workcell = workcell or self._overlap(contact)
        return own, workcell

    def _overlap(self, contact: Sequence[Any]) -> bool:
        """Whether the two links of a contact overlap now: PyBullet keeps contacts from one
        configuration to the next, and lists some, centimetres deep, of links that are apart again.
        """
        _, first, second, link, other = contact[:5]
        return self._between(first, second, link, other, 0.0) < 0.0


_BASE = -1
"""The index of a robot's base among its links."""
_MOVING, _ALL = 1, -1
"""PyBullet's groups of bodies: those that move, and what they may meet."""


@dataclass(frozen=True)
class Physics:
    """A world's PyBullet, with the indices of its robot, for what simulates instead of judging."""

    bullet: Any
    body: int
    joints: tuple[int, ...]
    tool: int
    fixed: tuple[int, ...]


def physics(world: World) -> Physics:
    """What simulating in a world takes; the world is no judge afterwards, and closing it ends the
    simulation.
    """
    fixed = tuple(own.body for own in world._shapes.values() if own.carrier is None)
    return Physics(world._bullet, world._body, tuple(world._joints), world._tool, fixed)
