"""A robot read from its URDF: limits, forward kinematics and Jacobian, batched and compiled.

Nothing here knows how many joints there are; adding a robot adds data only.
"""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from constraint_geodesics.robot import kernels
from constraint_geodesics.xml_files import XmlFileError, read_xml


class RobotError(ValueError):
    """The robot description can't be used; the message names the file and what is wrong with it."""


class ChainArrays(NamedTuple):
    """The serial chain from the root link to the tool link, as the compiled kernels take it (see
    kernels.py).
    """

    origins: Float[np.ndarray, "D 4 4"]
    axes: Float[np.ndarray, "D 3"]
    prismatic: np.ndarray
    base: Float[np.ndarray, "4 4"]
    tool: Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class SerialRobot:
    """A serial arm: names, limits [rad or m, and per second] and its chain.

    allowed: pairs of links that may touch, beside a link and the one that it hangs on.  continuous:
    names of joints whose values a whole turn apart are one place.
    """

    name: str
    urdf: Path
    tool_link: str
    joint_names: tuple[str, ...]
    lower: Float[np.ndarray, "D"]
    upper: Float[np.ndarray, "D"]
    velocity: Float[np.ndarray, "D"]
    chain: ChainArrays
    allowed: frozenset[tuple[str, str]] = frozenset()
    continuous: frozenset[str] = frozenset()

    @property
    def dof(self) -> int:
        """Number of joints D."""
        return len(self.joint_names)

    def moves_like(self, other: "SerialRobot") -> bool:
        """Whether another robot has the same joints and limits, and its tool is where this one's
        is.
        """
        if self is other:
            return True
        names = (self.joint_names, self.tool_link) == (other.joint_names, other.tool_link)
        return (
            names
            and np.array_equal([self.lower, self.upper], [other.lower, other.upper])
            and all(map(np.array_equal, self.chain, other.chain))
        )

    def forward(
        self, q: Float[np.ndarray, "*batch D"]
    ) -> tuple[Float[np.ndarray, "*batch 3"], Float[np.ndarray, "*batch 3 3"]]:
        """Tool position [m] and rotation in the base frame, of configurations q [rad]."""
        flat = self._flat(q)
        positions, rotations = np.empty((len(flat), 3)), np.empty((len(flat), 3, 3))
        kernels.forward_batch(self.chain, flat, positions, rotations)
        return positions.reshape(*q.shape[:-1], 3), rotations.reshape(*q.shape[:-1], 3, 3)

    def jacobian(self, q: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "*batch 6 D"]:
        """Geometric Jacobian in the base frame: three linear rows [m/rad], three angular rows."""
        flat = self._flat(q)
        jacobians = np.empty((len(flat), 6, self.dof))
        kernels.jacobian_batch(self.chain, flat, jacobians)
        return jacobians.reshape(*q.shape[:-1], 6, self.dof)

    def skeleton(self, q: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "*batch n 3"]:
        """Base, joint origins and tool of configurations [m], to draw the arm by: n = D + 2
        points.
        """
        flat = self._flat(q)
        points = np.empty((len(flat), self.dof + 2, 3))
        kernels.skeleton_batch(self.chain, flat, points)
        return points.reshape(*q.shape[:-1], self.dof + 2, 3)

    def limit_distance(self, q: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "*batch"]:
        """Distance to the nearest joint limit [rad]; negative outside the limits."""
        return np.minimum(q - self.lower, self.upper - q).min(axis=-1)

    def sample(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "count D"]:
        """Configurations drawn uniformly within the limits."""
        return rng.uniform(self.lower, self.upper, size=(count, self.dof))

    def _flat(self, q: np.ndarray) -> np.ndarray:
        if q.shape[-1] != self.dof:
            raise RobotError(
                f"{self.name} has {self.dof} joints, but the configurations have {q.shape[-1]}"
            )
        # the kernels are compiled for arrays that could be written to alone
        return np.require(q, np.float64, ("C", "W")).reshape(-1, self.dof)


def urdf_root(urdf: Path) -> ElementTree.Element:
    """The root element of a URDF; raises RobotError where it is no XML."""
    try:
        return read_xml(urdf)
    except XmlFileError as error:
        raise RobotError(f"{urdf}: no URDF: it is no XML ({error})") from None
    except OSError as error:
        raise RobotError(f"{urdf}: no URDF: {error.strerror}") from None


def load_robot(
    urdf: Path, tool_link: str, tighter_limits: Mapping[str, tuple[float, float]] | None = None
) -> SerialRobot:
    """Read the chain from the URDF's root to `tool_link`.

    tighter_limits: joint name → (lower, upper) [rad]; each must lie within the URDF's own limits.
    Raises RobotError if the file or the link is missing, a movable joint has no limits, or a limit
    is not tighter.
    """
    if not urdf.is_file():
        raise RobotError(f"{urdf}: no such URDF file")
    root = urdf_root(urdf)
    parent_joint = {_attribute(j, "child", "link", urdf): j for j in root.findall("joint")}
    if tool_link not in {link.get("name") for link in root.findall("link")}:
        raise RobotError(f"{urdf}: there is no link {tool_link!r}")

    joints, tool = _movable(_joints_to(tool_link, parent_joint, urdf), urdf)
    names = tuple(joint.get("name", "") for joint, _ in joints)
    if not names:
        raise RobotError(f"{urdf}: no movable joint leads to {tool_link!r}")
    tighter = dict(tighter_limits or {})
    unknown = sorted(set(tighter) - set(names))
    if unknown:
        raise RobotError(
            f"{urdf}: limits are given for {unknown}, which are not joints of the chain "
            f"{list(names)}"
        )
    limits = []
    for name, (joint, _) in zip(names, joints, strict=True):
        low, high, speed = _limits(joint, urdf)
        if name in tighter:
            low, high = _tightened(name, (low, high), tighter[name])
        limits.append((low, high, speed))
    lower, upper, velocity = np.array(limits).T.copy()
    origins = np.array([origin for _, origin in joints])
    axes = np.array([_axis(joint) for joint, _ in joints])
    prismatic = np.array([joint.get("type") == "prismatic" for joint, _ in joints])
    chain = ChainArrays(origins, axes, prismatic, np.eye(4), tool)
    name = root.get("name", urdf.stem)
    return SerialRobot(name, urdf, tool_link, names, lower, upper, velocity, chain)


def _joints_to(
    link: str, parent_joint: Mapping[str, ElementTree.Element], urdf: Path
) -> list[ElementTree.Element]:
    """The joints from the root to a link."""
    path = []
    while link in parent_joint:
        path.append(parent_joint[link])
        link = _attribute(parent_joint[link], "parent", "link", urdf)
    return path[::-1]


def _movable(
    path: Sequence[ElementTree.Element], urdf: Path
) -> tuple[list[tuple[ElementTree.Element, np.ndarray]], np.ndarray]:
    """The joints that move, each with the transform from the one before, and the transform from the
    last one to the end of the path.
    """
    found, pending = [], np.eye(4)
    for joint in path:
        pending = pending @ origin_of(joint)
        kind, name = joint.get("type"), joint.get("name", "")
        if kind == "fixed":
            continue
        if kind not in ("revolute", "prismatic", "continuous"):
            raise RobotError(
                f"{urdf}: joint {name!r} is of type {kind!r}, which a serial arm can't have"
            )
        found.append((joint, pending))
        pending = np.eye(4)
    return found, pending


def rotation_from_rpy(rpy: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Rotation of roll, pitch, yaw [rad] about the fixed x, y and z axes, in this order: Rz Ry
    Rx.
    """
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rotation_about(axis: Float[np.ndarray, "3"], angle: float) -> Float[np.ndarray, "3 3"]:
    """Rotation about an axis of any length but 0, by an angle [rad]."""
    x, y, z = axis / np.linalg.norm(axis)
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * across + (1.0 - math.cos(angle)) * across @ across


def rpy_of(rotation: Float[np.ndarray, "3 3"]) -> tuple[float, float, float]:
    """Roll, pitch, yaw [rad] that `rotation_from_rpy` makes a rotation from."""
    level = math.hypot(rotation[0, 0], rotation[1, 0])
    pitch = math.atan2(-rotation[2, 0], level)
    if level < 1e-9:  # upright, where roll and yaw turn about one axis
        return math.atan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0
    roll = math.atan2(rotation[2, 1], rotation[2, 2])
    return roll, pitch, math.atan2(rotation[1, 0], rotation[0, 0])


def _attribute(joint: ElementTree.Element, child: str, name: str, urdf: Path) -> str:
    element = joint.find(child)
    value = None if element is None else element.get(name)
    if value is None:
        raise RobotError(f"{urdf}: joint {joint.get('name')!r} has no <{child} {name}=…>")
    return value


def origin_of(element: ElementTree.Element) -> Float[np.ndarray, "4 4"]:
    """The transform that a URDF's joint, or a link's shape, gives as its origin.  Raises RobotError
    where that is no number.
    """
    origin = element.find("origin")
    transform = np.eye(4)
    if origin is not None:
        transform[:3, :3] = rotation_from_rpy(
            np.array([float(x) for x in origin.get("rpy", "0 0 0").split()])
        )
        transform[:3, 3] = [float(x) for x in origin.get("xyz", "0 0 0").split()]
    if not np.isfinite(transform).all():
        raise RobotError(f"the origin of a <{element.tag}> has numbers that are not finite")
    return transform


def _axis(joint: ElementTree.Element) -> np.ndarray:
    element = joint.find("axis")
    axis = np.array(
        [float(x) for x in ("1 0 0" if element is None else element.get("xyz", "1 0 0")).split()]
    )
    return axis / np.linalg.norm(axis)


def _limits(joint: ElementTree.Element, urdf: Path) -> tuple[float, float, float]:
    limit = joint.find("limit")
    if joint.get("type") == "continuous":
        return -np.pi, np.pi, float(limit.get("velocity", "inf")) if limit is not None else np.inf
    if limit is None or limit.get("lower") is None or limit.get("upper") is None:
        raise RobotError(f"{urdf}: joint {joint.get('name')!r} has no limits")
    lower, upper = float(limit.get("lower", "")), float(limit.get("upper", ""))
    if not np.isfinite([lower, upper]).all():
        what = f"limits of joint {joint.get('name')!r} are {lower:g} and {upper:g}"
        raise RobotError(f"{urdf}: {what}: must be finite, or the joint continuous")
    return lower, upper, float(limit.get("velocity", "inf"))


def _tightened(
    name: str, own: tuple[float, float], wanted: tuple[float, float]
) -> tuple[float, float]:
    if not own[0] <= wanted[0] < wanted[1] <= own[1]:
        raise RobotError(
            f"limits of {name!r}: {list(wanted)} must be a lower one and a higher one within the "
            f"URDF's {list(own)}"
        )
    return wanted
