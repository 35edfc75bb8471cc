"""A URDF as it is written, looked at before anything is built from it, and the arm in it: the chain
from the root to a tool link, with all other joints held.

PyBullet ends the process on some broken files and hangs on others; here each fault is one line that
names the file, the element and the mend.
"""

import math
import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from constraint_geodesics.robot.kinematics import RobotError
from constraint_geodesics.xml_files import XmlFileError, read_xml

MOVABLE = ("revolute", "continuous", "prismatic")
_KINDS = (*MOVABLE, "fixed", "floating", "planar")
_XACRO = "xacro"
_PACKAGE = "package://"
_SHORTEST_AXIS, _LARGEST = 1e-9, 1e6
_ROUNDING = 1e-12
_LONGEST = 250
"""Names that are longer end PyBullet's process at some length."""
_WIDEST = 1000.0
"""Limits further apart [rad or m] stand for none."""


class Mimic(NamedTuple):
    """A joint that follows another: its value is multiplier × the other's + offset."""

    joint: str
    multiplier: float
    offset: float

    def value(self, other: float) -> float:
        """Of the joint that follows, where the other is [rad or m]."""
        return self.multiplier * other + self.offset


@dataclass(frozen=True)
class Joint:
    """A joint of a URDF.  lower, upper [rad or m], infinite for a continuous one and where there
    are none; velocity [1/s], infinite where none is given.  fault: the line that says why it can't
    move, which is none where it is not to; "" for one that can.  axis_length: of the direction that
    is written.
    """

    name: str
    kind: str
    parent: str
    child: str
    lower: float = -math.inf
    upper: float = math.inf
    velocity: float = math.inf
    mimic: Mimic | None = None
    fault: str = ""
    axis_length: float = 1.0

    @property
    def is_scaled(self) -> bool:
        """Whether it slides by more or less than its value, to who takes the axis as it is."""
        return self.kind == "prismatic" and abs(self.axis_length - 1.0) > _ROUNDING

    @property
    def is_movable(self) -> bool:
        """Whether one value says where it is."""
        return self.kind in MOVABLE

    @property
    def rest(self) -> float:
        """The value within the limits that is nearest to 0 [rad or m]."""
        return min(max(0.0, self.lower), self.upper)

    @property
    def range(self) -> str:
        """The limits in words."""
        unit = "m" if self.kind == "prismatic" else "rad"
        if self.kind == "continuous":
            return "any angle"
        return f"{self.lower:.6g} to {self.upper:.6g} {unit}"


@dataclass(frozen=True)
class Description:
    """A URDF without faults: its links, the root first, and its joints, each after those above."""

    file: Path
    name: str
    links: tuple[str, ...]
    joints: tuple[Joint, ...]
    tree: ElementTree.Element

    @cached_property
    def above(self) -> Mapping[str, Joint]:
        """The joint that carries a link, for all links but the root."""
        return {joint.child: joint for joint in self.joints}

    @cached_property
    def by_name(self) -> Mapping[str, Joint]:
        """The joints by their names."""
        return {joint.name: joint for joint in self.joints}

    @property
    def ends(self) -> tuple[str, ...]:
        """Links that carry no other: where a tool may be."""
        parents = {joint.parent for joint in self.joints}
        return tuple(link for link in self.links if link not in parents)

    def path(self, link: str) -> tuple[Joint, ...]:
        """The joints from the root to a link."""
        found = []
        while link in self.above:
            found.append(self.above[link])
            link = found[-1].parent
        return tuple(reversed(found))

    def moving(self, link: str) -> tuple[Joint, ...]:
        """Those of them that move."""
        return tuple(joint for joint in self.path(link) if joint.is_movable)


def read_description(urdf: Path) -> Description:
    """Read a URDF.  Raises RobotError, one line with file, element and mend, for the first fault
    that would stop a planner.
    """
    reader = _Reader(urdf)
    tree = reader.tree()
    links, joints = reader.links(tree), reader.joints(tree)
    reader.check_ends(links, joints)
    order = reader.order(links, joints)
    for joint in joints:
        reader.check_mimic(joint, {other.name: other for other in joints})
    ranked = tuple(sorted(joints, key=lambda joint: order.index(joint.child)))
    return Description(urdf, tree.get("name") or urdf.stem, tuple(order), ranked, tree)


class _Reader:
    """Faults of one file, each as an exception."""

    def __init__(self, urdf: Path) -> None:
        self.urdf = urdf

    def fault(self, element: str, what: str, mend: str) -> RobotError:
        """The line: file, element, what is wrong with it, and what to do."""
        return RobotError(f"{self.urdf}: {element} {what}: {mend}")

    def tree(self) -> ElementTree.Element:
        """The root element."""
        if not self.urdf.is_file():
            what = "is a folder" if self.urdf.is_dir() else "does not exist"
            raise self.fault("the file", what, "give the path of a URDF file")
        try:
            tree = read_xml(self.urdf)
        except XmlFileError as error:
            raise self.fault("the file", f"is no XML ({error})", "export it again") from None
        except OSError as error:
            what = f"can't be read ({error.strerror})"
            raise self.fault("the file", what, "give the path of a URDF file") from None
        for element in tree.iter():
            if _XACRO in element.tag or any("${" in value for value in element.attrib.values()):
                mend = f"run `xacro {self.urdf.name} > arm.urdf` and take what it writes"
                raise self.fault(f"<{element.tag.split('}')[-1]}>", "is xacro, not URDF", mend)
        if tree.tag != "robot":
            raise self.fault(f"<{tree.tag}>", "is the root element", "it must be <robot>")
        return tree

    def links(self, tree: ElementTree.Element) -> list[str]:
        """Names of all links."""
        found = self._names(tree, "link")
        if not found:
            raise self.fault("<robot>", "has no <link>", "add the links")
        for link in tree.findall("link"):
            for collision in link.findall("collision"):
                self._check_collision(link.get("name", ""), collision)
        return found

    def joints(self, tree: ElementTree.Element) -> list[Joint]:
        """All joints."""
        self._names(tree, "joint")
        return [self._joint(element) for element in tree.findall("joint")]

    def _names(self, tree: ElementTree.Element, kind: str) -> list[str]:
        found: list[str] = []
        for number, element in enumerate(tree.findall(kind), 1):
            name = element.get("name")
            if not name:
                raise self.fault(f"{kind} number {number}", "has no name", "give it one")
            if len(name.encode()) > _LONGEST:
                what = f"has a name of more than {_LONGEST} letters"
                raise self.fault(f"{kind} {name[:20]!r}…", what, "shorten it")
            if name in found:
                raise self.fault(f"{kind} {name!r}", "is there twice", "rename one of the two")
            found.append(name)
        return found

    def _joint(self, element: ElementTree.Element) -> Joint:
        name, kind = element.get("name", ""), element.get("type", "")
        where = f"joint {name!r}"
        if kind not in _KINDS:
            what = f"is of type {kind!r}" if kind else "has no type"
            raise self.fault(where, what, f"it must be one of {', '.join(_KINDS)}")
        parent, child = self._end(element, "parent"), self._end(element, "child")
        self._numbers(element.find("origin"), where, ("xyz", "rpy"))
        if kind not in MOVABLE:
            return Joint(name, kind, parent, child)
        axis_length = self._axis_length(element.find("axis"), where)
        limit, mimic = element.find("limit"), self._mimic(element.find("mimic"), where)
        given = {} if limit is None else dict(limit.attrib)
        lower, upper, speed = (
            self._number(given, name, where) for name in ("lower", "upper", "velocity")
        )
        fault = self._unfit(kind, lower, upper, speed)
        line = str(self.fault(where, *fault)) if fault else ""
        lower = -math.inf if lower is None else lower
        upper = math.inf if upper is None else upper
        if kind == "revolute" and upper - lower > _WIDEST and not fault:
            kind = "continuous"
        if kind == "continuous" or lower > upper:
            lower, upper = -math.inf, math.inf
        speed = math.inf if speed is None else speed
        return Joint(name, kind, parent, child, lower, upper, speed, mimic, line, axis_length)

    def _end(self, joint: ElementTree.Element, end: str) -> str:
        element = joint.find(end)
        link = None if element is None else element.get("link")
        if not link:
            where = f"joint {joint.get('name')!r}"
            raise self.fault(where, f"has no <{end} link=…>", "name the link")
        return link

    def _axis_length(self, axis: ElementTree.Element | None, where: str) -> float:
        numbers = self._numbers(axis, where, ("xyz",))
        length = math.hypot(*numbers[0]) if numbers else 1.0
        if length < _SHORTEST_AXIS:
            raise self.fault(where, "has an axis of length 0", 'give a direction, as xyz="0 0 1"')
        return length

    def _unfit(
        self, kind: str, lower: float | None, upper: float | None, speed: float | None
    ) -> tuple[str, str] | None:
        """What keeps a joint from moving, and the mend."""
        if speed is not None and speed <= 0.0:
            return (
                f"has velocity {speed:g}",
                'give its top speed, as <limit velocity="1">, or hold it',
            )
        if kind == "continuous":
            return None
        for name, value in (("lower", lower), ("upper", upper)):
            if value is None:
                other = ", or make the joint continuous" if kind == "revolute" else ", or hold it"
                return f"has no {name} limit", f'give <limit {name}="…">{other}'
        assert lower is not None
        assert upper is not None
        what = f"has limits {lower:g} and {upper:g}"
        if lower == upper:
            return what, "make the joint fixed, or hold it"
        if lower > upper:
            return what, "swap them, or hold it"
        if kind == "prismatic" and upper - lower > _WIDEST:
            return what, "give its true limits, or hold it"
        return None

    def _mimic(self, mimic: ElementTree.Element | None, where: str) -> Mimic | None:
        if mimic is None:
            return None
        values = [self._number(mimic.attrib, name, where) for name in ("multiplier", "offset")]
        multiplier, offset = (
            default if value is None else value
            for value, default in zip(values, (1.0, 0.0), strict=True)
        )
        return Mimic(mimic.get("joint", ""), multiplier, offset)

    def check_mimic(self, joint: Joint, joints: Mapping[str, Joint]) -> None:
        """That a joint follows another that moves, and not in the end itself."""
        followed, at = [joint.name], joint
        while at.mimic is not None:
            other = joints.get(at.mimic.joint)
            where = f"joint {at.name!r}"
            if other is None or not other.is_movable:
                what = f"follows {at.mimic.joint!r}, which is no joint that moves"
                raise self.fault(where, what, "name one that does, or remove <mimic>")
            if other.name in followed:
                mend = "remove <mimic> from one of them"
                raise self.fault(where, f"follows {other.name!r}, which follows it", mend)
            followed.append(other.name)
            at = other

    def check_ends(self, links: list[str], joints: list[Joint]) -> None:
        """That joints join links that are there, and carry each one once."""
        carried: dict[str, str] = {}
        for joint in joints:
            where = f"joint {joint.name!r}"
            for end in (joint.parent, joint.child):
                if end not in links:
                    raise self.fault(where, f"names the link {end!r}", "there is no such link")
            if joint.child in carried:
                what = f"carries {joint.child!r}, and so does joint {carried[joint.child]!r}"
                raise self.fault(where, what, "a link hangs on one joint: remove the other")
            carried[joint.child] = joint.name

    def order(self, links: list[str], joints: list[Joint]) -> list[str]:
        """The links from the one root on."""
        carried = {joint.child for joint in joints}
        roots = [link for link in links if link not in carried]
        if len(roots) > 1:
            mend = "join them with a fixed joint, or remove what is not the robot's"
            raise self.fault(f"links {roots[0]!r} and {roots[1]!r}", "hang on no joint", mend)
        found = roots
        for link in found:  # it grows
            found += [joint.child for joint in joints if joint.parent == link]
        rest = [joint for joint in joints if joint.child not in found]
        if rest:
            circle = " and ".join(repr(joint.name) for joint in rest[:2])
            mend = "remove one of them: links must form a tree"
            raise self.fault(f"joints {circle}", "close a circle", mend)
        return found

    def _check_collision(self, link: str, collision: ElementTree.Element) -> None:
        where = f"a collision shape of link {link!r}"
        self._numbers(collision.find("origin"), where, ("xyz", "rpy"))
        for shape in collision.iterfind("geometry/mesh"):
            scale = self._numbers(shape, where, ("scale",))
            if scale and 0.0 in scale[0]:
                raise self.fault(where, "has a mesh with scale 0", "give its true scale")
            name = shape.get("filename", "")
            if find_mesh(name, self.urdf) is None:
                mend = "put it beside the URDF or in a folder above it"
                if name.startswith(_PACKAGE):
                    mend += ", or name the folder that holds the package in ROS_PACKAGE_PATH"
                raise self.fault(where, f"names the mesh {name!r}, which is not there", mend)

    def _numbers(
        self, element: ElementTree.Element | None, where: str, names: tuple[str, ...]
    ) -> list[tuple[float, ...]]:
        """Attributes of three finite numbers, those that are there."""
        found: list[tuple[float, ...]] = []
        for name in names:
            text = None if element is None else element.get(name)
            if text is None:
                continue
            try:
                values = tuple(float(word) for word in text.split())
            except ValueError:
                values = ()
            if len(values) != 3 or not all(abs(value) <= _LARGEST for value in values):
                mend = f"it must be three numbers, none beyond {_LARGEST:g}"
                raise self.fault(where, f"has {name}={text!r}", mend)
            found.append(values)
        return found

    def _number(self, given: Mapping[str, str], name: str, where: str) -> float | None:
        if name not in given:
            return None
        try:
            value = float(given[name])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.fault(where, f"has {name}={given[name]!r}", "it must be a number")
        return value


def find_mesh(name: str, urdf: Path) -> Path | None:
    """The file of a mesh as a URDF names it: in the URDF's folder, or in one above it, where
    PyBullet looks as well; then of package:// addresses where ROS keeps packages.  None where there
    is none.
    """
    plain = name.removeprefix(_PACKAGE).removeprefix("file://")
    if not plain:
        return None
    folders = [urdf.absolute().parent, *urdf.resolve().parents]
    if name.startswith(_PACKAGE):
        folders += _package_folders(plain.split("/")[0])
    return next((folder / plain for folder in folders if (folder / plain).is_file()), None)


def _package_folders(package: str) -> Iterator[Path]:
    """Folders that may hold a package of ROS: those of ROS_PACKAGE_PATH, which may also name the
    package itself, then those that ROS 2 installs to.
    """
    for name, below in (("ROS_PACKAGE_PATH", ""), ("AMENT_PREFIX_PATH", "share")):
        for entry in os.environ.get(name, "").split(os.pathsep):
            folder = Path(entry)
            if not folder.is_absolute():  # the current folder is none of them
                continue
            yield folder / below
            if folder.name == package:
                yield folder.parent


@dataclass(frozen=True)
class Arm:
    """The arm of a description that ends in a tool link.

    moved: the joints that a configuration gives the values of, from the root on.  held: values of
    all others that could move, by name [rad or m].
    """

    description: Description
    tool_link: str
    moved: tuple[Joint, ...]
    held: Mapping[str, float]

    @property
    def is_as_written(self) -> bool:
        """Whether all readers of its own URDF take that for this machine: PyBullet leaves at 0 what
        is held, and slides a link by the length of the axis.
        """
        return not any(self.held.values()) and not any(
            joint.kind == "continuous" or joint.is_scaled for joint in self.moved
        )

    def lines(self) -> Iterator[str]:
        """What was understood, for people."""
        own = self.description
        yield f"{own.name}: {len(own.links)} links, {len(own.joints)} joints, root {own.links[0]}"
        yield f"tool link {self.tool_link}, carried by {len(self.moved)} joints that move:"
        for joint in self.moved:
            unit = "m/s" if joint.kind == "prismatic" else "rad/s"
            speed = f", {joint.velocity:.6g} {unit}" if math.isfinite(joint.velocity) else ""
            yield f"  {joint.name}: {joint.kind}, {joint.range}{speed}"
        for name, value in self.held.items():
            yield f"held: {name} at {value:.6g}"


def arm_to(
    description: Description, tool_link: str, held: Mapping[str, float] | None = None
) -> Arm:
    """The arm from the root to a link.  held: values of joints that are not to move [rad or m]; all
    others beside the chain rest at 0, or where their limits are nearest to it, or follow.

    Raises RobotError for a link or joint that is not there, a value beyond its limits, a chain
    without a joint, or with one that can't move or follows another, and for a joint that follows
    one of the chain.
    """
    file, wanted = description.file, dict(held or {})
    if tool_link not in description.links:
        ends = ", ".join(description.ends)
        raise RobotError(f"{file}: there is no link {tool_link!r}: the last of chains are {ends}")
    for name, value in wanted.items():
        joint = description.by_name.get(name)
        if joint is None or not joint.is_movable:
            movable = ", ".join(joint.name for joint in description.joints if joint.is_movable)
            raise RobotError(f"{file}: {name!r} can't be held: the joints that move are {movable}")
        if not math.isfinite(value):
            raise RobotError(f"{file}: {name} can't be held at {value}: give a finite number")
        if not joint.lower <= value <= joint.upper:
            raise RobotError(f"{file}: {name} can't be held at {value:g}: {joint.range}")
    chain = [joint for joint in description.moving(tool_link) if joint.name not in wanted]
    values = _resting(description, wanted)
    for joint in description.path(tool_link):
        if not joint.is_movable and joint.kind != "fixed":
            raise RobotError(
                f"{file}: joint {joint.name!r} leads to {tool_link!r} and is {joint.kind}: make it "
                "fixed in the URDF"
            )
    for joint in chain:
        if joint.mimic is not None:
            raise RobotError(
                f"{file}: joint {joint.name!r} leads to {tool_link!r} and follows "
                f"{joint.mimic.joint!r}: hold it, or choose a tool link before it"
            )
        if joint.fault:
            raise RobotError(joint.fault)
    if not chain:
        raise RobotError(f"{file}: no joint that moves leads to {tool_link!r}: choose another link")
    names = {joint.name for joint in chain}
    for joint in description.joints:
        leader = _leader(description, joint, wanted)
        if leader.name in names and joint is not leader:
            raise RobotError(
                f"{file}: joint {joint.name!r} follows {leader.name!r}, which moves on the way to "
                f"{tool_link!r}: if it may stand still, hold it, as --hold "
                f"{joint.name}={values[joint.name]:g}"
            )
    still = {name: value for name, value in values.items() if name not in names}
    return Arm(description, tool_link, tuple(chain), still)


def _leader(description: Description, joint: Joint, wanted: Mapping[str, float]) -> Joint:
    """The joint that one follows in the end; itself where it follows none, or is held."""
    while joint.mimic is not None and joint.name not in wanted:
        joint = description.by_name[joint.mimic.joint]
    return joint


def _resting(description: Description, wanted: Mapping[str, float]) -> dict[str, float]:
    """A value for each joint that can move; one that follows another follows its value at rest."""
    found: dict[str, float] = {}

    def value(joint: Joint) -> float:
        if joint.name not in found:
            other = None if joint.mimic is None else description.by_name[joint.mimic.joint]
            if joint.name in wanted:
                found[joint.name] = wanted[joint.name]
            elif other is None or joint.mimic is None:
                found[joint.name] = joint.rest
            else:
                found[joint.name] = joint.mimic.value(value(other))
        return found[joint.name]

    for joint in description.joints:
        if joint.is_movable:
            value(joint)
    return found
