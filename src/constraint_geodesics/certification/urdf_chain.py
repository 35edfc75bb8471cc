"""The chain read from the URDF where PyBullet is not there to load it: with unit quaternions, by no
code that the search's reading of it (robot/) uses.
"""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path

from constraint_geodesics.certification.certificate import CertificationError
from constraint_geodesics.scene.world import LoadedChain, LoadedLink
from constraint_geodesics.xml_files import read_xml

_ORIGIN, _NO_TURN = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
_ROUNDING = 1e-6
_KINDS = {"continuous": "revolute"}
"""As PyBullet names them."""


def chain_of_urdf(urdf: Path, tool_link: str, joint_names: Sequence[str]) -> LoadedChain:
    """The chain from the root to the tool, as `World.loaded_chain` gives it, but with each link's
    own frame in the place of its inertial frame.

    Raises CertificationError if an entry can't be read.
    """
    root = read_xml(urdf)
    above = {}
    for joint in root.findall("joint"):
        child = joint.find("child")
        above[None if child is None else child.get("link")] = joint
    links, at = list[LoadedLink](), tool_link
    while at in above:
        joint = above.pop(at)  # so that a chain that bites its tail ends
        links.append(_link(urdf, joint, at, joint_names))
        parent = joint.find("parent")
        at = "" if parent is None else parent.get("link", "")
    return LoadedChain(_ORIGIN, _NO_TURN, tuple(reversed(links)))


def _link(
    urdf: Path, joint: ElementTree.Element, link: str, joint_names: Sequence[str]
) -> LoadedLink:
    name, kind = joint.get("name", ""), joint.get("type", "")
    place = _triple(urdf, joint, "origin", "xyz", "0 0 0")
    turn = _quaternion(*_triple(urdf, joint, "origin", "rpy", "0 0 0"))
    axis = _triple(urdf, joint, "axis", "xyz", "1 0 0")
    column = joint_names.index(name) if name in joint_names else None
    length = math.hypot(*axis)
    none = length == 0.0 and kind != "fixed"  # which some files give one of length 0
    if none or (kind == "prismatic" and abs(length - 1.0) > _ROUNDING):
        # programs differ in whether such a slide moves by its value or by that times the length
        raise CertificationError(f"{urdf}: the axis of joint {name!r} is of length {length:.6g}")
    kind = _KINDS.get(kind, kind)
    return LoadedLink(link, kind, column, axis, place, turn, _ORIGIN, _NO_TURN)


def _triple(
    urdf: Path, joint: ElementTree.Element, entry: str, name: str, default: str
) -> tuple[float, float, float]:
    element = joint.find(entry)
    text = default if element is None else element.get(name, default)
    try:
        x, y, z = (float(word) for word in text.split())
    except ValueError:
        where = f"{urdf}: {entry} {name}={text!r} of joint {joint.get('name')!r}"
        raise CertificationError(f"{where}: must be three numbers") from None
    return x, y, z


def _quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """x, y, z, w of a turn about the fixed x, y and z axes, in this order [rad]."""
    (sr, cr), (sp, cp), (sy, cy) = (
        (math.sin(0.5 * angle), math.cos(0.5 * angle)) for angle in (roll, pitch, yaw)
    )
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )
