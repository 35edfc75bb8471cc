"""An arm as a URDF of its own: what all readers of a robot (PyBullet, the planner's kinematics, the
certifier's) take for the same machine.

Joints that are held become fixed where they are held, continuous ones revolute with two turns of
room, axes that links slide along of unit length, and the tool's own frame a link; meshes are named
by their whole paths.
"""

import copy
import hashlib
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from constraint_geodesics.robot.description import Arm, Joint, find_mesh
from constraint_geodesics.robot.kinematics import origin_of, rotation_about, rpy_of
from constraint_geodesics.text_files import write_text

TOOL = "tool"
"""The link of a tool's own frame, with as many underscores as make it a new name."""
_TURNS = 2.0 * math.pi
"""Limits of a continuous joint, either way [rad]: any angle is reached the shorter way round."""


def write_arm(
    arm: Arm,
    folder: Path,
    tool: Float[np.ndarray, "4 4"] | None = None,
    readable: Callable[[Path], Path] = Path,
) -> tuple[Path, str]:
    """Write the URDF into a folder, under a name that tells its content; returns the file and its
    tool link.  tool: the tool's frame in the arm's tool link [m].  readable: the file to be named
    in the place of a mesh that is collided.
    """
    tree, link = _tree_of(arm, tool, readable)
    text = ElementTree.tostring(tree, encoding="unicode")
    file = folder / f"{arm.description.file.stem}-{content_digest(text.encode())}.urdf"
    if not file.is_file():
        write_text(file, text)
    return file, link


def content_digest(content: bytes) -> str:
    """A few letters that tell a content."""
    return hashlib.sha256(content).hexdigest()[:16]


def _tree_of(
    arm: Arm, tool: Float[np.ndarray, "4 4"] | None, readable: Callable[[Path], Path]
) -> tuple[ElementTree.Element, str]:
    own = arm.description
    tree = ElementTree.Element("robot", name=own.name)
    for kind in ("material", "link", "joint"):
        tree.extend(copy.deepcopy(element) for element in own.tree.findall(kind))
    for mesh in tree.iter("mesh"):
        found = find_mesh(mesh.get("filename", ""), own.file)
        if found is not None:
            # a link's own name tells the kind of a mesh that lies in a cache under another one
            mesh.set("filename", str(found.parent.resolve() / found.name))
    for link in tree.findall("link"):
        for visual in link.findall("visual"):
            if not _is_drawn(visual, own.file):  # PyBullet would refuse the whole robot
                link.remove(visual)
    for mesh in tree.iterfind("link/collision/geometry/mesh"):
        mesh.set("filename", str(readable(Path(mesh.get("filename", "")))))
    moved = {joint.name for joint in arm.moved}
    for element in tree.findall("joint"):
        joint = own.by_name[element.get("name", "")]
        if joint.name not in moved:
            _fix(element, joint, arm.held.get(joint.name, 0.0))
        elif joint.kind == "continuous":
            _bound(element)
        elif joint.is_scaled:
            unit = _axis(element) / joint.axis_length
            for entry in element.findall("axis"):
                entry.set("xyz", " ".join(map(repr, unit.tolist())))
    if tool is None:
        return tree, arm.tool_link
    name = TOOL
    while name in own.links or name in own.by_name:
        name += "_"
    ElementTree.SubElement(tree, "link", name=name)
    joint_element = ElementTree.SubElement(tree, "joint", name=name, type="fixed")
    ElementTree.SubElement(joint_element, "parent", link=arm.tool_link)
    ElementTree.SubElement(joint_element, "child", link=name)
    _place(joint_element, tool)
    return tree, name


def _is_drawn(visual: ElementTree.Element, urdf: Path) -> bool:
    shape, mesh = visual.find("geometry/*"), visual.find("geometry/mesh")
    if mesh is not None:
        return find_mesh(mesh.get("filename", ""), urdf) is not None
    return shape is not None


def _fix(element: ElementTree.Element, joint: Joint, value: float) -> None:
    """Make a joint fixed where its value puts it."""
    pose = origin_of(element)
    if joint.is_movable:
        pose = pose @ _motion(element, joint.kind, value)
    element.set("type", "fixed")
    for name in (
        "origin",
        "axis",
        "limit",
        "mimic",
        "dynamics",
        "safety_controller",
        "calibration",
    ):
        for child in element.findall(name):
            element.remove(child)
    _place(element, pose)


def _bound(element: ElementTree.Element) -> None:
    """Make a continuous joint revolute."""
    element.set("type", "revolute")
    limit = element.find("limit")
    if limit is None:
        limit = ElementTree.SubElement(element, "limit", effort="0")
    limit.set("lower", repr(-_TURNS))
    limit.set("upper", repr(_TURNS))


def _axis(joint: ElementTree.Element) -> Float[np.ndarray, "3"]:
    """As it is written, of any length."""
    entry = joint.find("axis")
    text = "1 0 0" if entry is None else entry.get("xyz", "1 0 0")
    return np.array([float(word) for word in text.split()])


def _motion(element: ElementTree.Element, kind: str, value: float) -> Float[np.ndarray, "4 4"]:
    """What a joint's value moves its link by."""
    axis, pose = _axis(element), np.eye(4)
    if kind == "prismatic":
        pose[:3, 3] = value * axis / np.linalg.norm(axis)
    else:
        pose[:3, :3] = rotation_about(axis, value)
    return pose


def _place(element: ElementTree.Element, pose: Float[np.ndarray, "4 4"]) -> None:
    ElementTree.SubElement(
        element,
        "origin",
        xyz=" ".join(repr(float(x)) for x in pose[:3, 3]),
        rpy=" ".join(map(repr, rpy_of(pose[:3, :3]))),
    )
