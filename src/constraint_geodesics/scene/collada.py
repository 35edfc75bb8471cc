"""Collision meshes in Collada's format, written as OBJ: PyBullet reads Collada, but a file that is
none ends the process.

Positions alone are read, of triangles, strips and fans of them, polygons and their lists, where the
scene places them, in metres.  The file's <up_axis> turns nothing: neither PyBullet nor ROS looks at
it in a robot's mesh.  Lines have no faces; what else might have some and can't be read is a fault.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from constraint_geodesics.robot.kinematics import RobotError, rotation_about
from constraint_geodesics.xml_files import XmlFileError, read_xml

_LINES = ("lines", "linestrips")
_MOST_STEPS, _MOST_PLACED = 100_000, 2_000_000
"""Elements that are gone through, and corners and faces that are placed: a short file's nodes that
name others twice each would make any number of them.
"""
Element = ElementTree.Element
Part = tuple[Float[np.ndarray, "n 3"], list[list[int]]]
"""Corners, and the faces between them."""


def as_obj(mesh: Path) -> str:
    """The mesh as OBJ, an object a geometry.  Raises RobotError, naming the file, where it can't be
    read or has no faces.
    """
    try:
        parts = list(_parts(mesh))
    except (OSError, ValueError, KeyError, IndexError, AttributeError, RecursionError) as error:
        reason = str(error).splitlines()[0] if str(error) else "broken"
        raise RobotError(f"{mesh}: no Collada mesh: {reason}: write it as OBJ or STL") from None
    if not any(faces for _, faces in parts):
        raise RobotError(f"{mesh}: a Collada mesh without faces: write it as OBJ or STL")
    lines, before = [], 1
    for number, (corners, faces) in enumerate(parts):
        lines.append(f"o part{number}")
        lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in corners.tolist()]
        lines += ["f " + " ".join(str(before + k) for k in face) for face in faces]
        before += len(corners)
    return "\n".join(lines) + "\n"


def _parts(mesh: Path) -> Iterator[Part]:
    try:
        root = read_xml(mesh)
    except XmlFileError as error:
        raise ValueError(f"no XML: {error}") from None
    for element in root.iter():  # Collada's own names carry its address
        element.tag = element.tag.rsplit("}", 1)[-1]
    named = {element.get("id"): element for element in root.iter() if element.get("id")}
    unit, frame = root.find("asset/unit"), np.eye(4)
    frame[:3, :3] *= 1.0 if unit is None else float(unit.get("meter", "1"))
    scene = root.find("scene/instance_visual_scene")
    if scene is None:
        raise ValueError("no scene")
    read, left = dict[Element, Part](), _MOST_PLACED
    steps = iter(range(_MOST_STEPS))
    for geometry, pose in _placed(_of(scene.get("url"), named), frame, named, steps):
        if geometry not in read:
            read[geometry] = _faces(geometry, named)
        corners, faces = read[geometry]
        left -= len(corners) + len(faces)
        if left < 0:
            raise ValueError(f"it places more than {_MOST_PLACED} corners and faces")
        placed = corners @ pose[:3, :3].T + pose[:3, 3]
        if not np.isfinite(placed).all():
            raise ValueError("corners that are no finite numbers")
        yield placed, faces


def _of(address: str | None, named: dict[str | None, Element]) -> Element:
    name = (address or "").removeprefix("#")
    if name not in named:
        raise ValueError(f"it names {name!r}, which is not there")
    return named[name]


def _placed(
    node: Element,
    pose: Float[np.ndarray, "4 4"],
    named: dict[str | None, Element],
    steps: Iterator[int],
    above: tuple[Element, ...] = (),
) -> Iterator[tuple[Element, Float[np.ndarray, "4 4"]]]:
    """The geometries below a node, with what places each.  steps: one is taken for each element."""
    if node in above:
        raise ValueError(f"the node {node.get('id')!r} is below itself")
    above = (*above, node)
    for child in node:
        if next(steps, None) is None:
            raise ValueError(f"its nodes unfold to more than {_MOST_STEPS} elements")
        if child.tag in _NOT_READ:
            raise ValueError(f"<{child.tag}> is not read")
        values = np.array((child.text or "").split(), float) if child.tag in _MOVES else None
        if values is not None:
            pose = pose @ _MOVES[child.tag](values)
        elif child.tag == "instance_geometry":
            yield _of(child.get("url"), named), pose
        elif child.tag == "instance_node":
            yield from _placed(_of(child.get("url"), named), pose, named, steps, above)
        elif child.tag == "node":
            yield from _placed(child, pose, named, steps, above)


def _translation(by: np.ndarray) -> np.ndarray:
    move = np.eye(4)
    move[:3, 3] = by
    return move


def _rotation(turn: np.ndarray) -> np.ndarray:
    """About an axis, by an angle in degrees."""
    if not turn[:3].any():
        raise ValueError("an axis of length 0")
    move = np.eye(4)
    move[:3, :3] = rotation_about(turn[:3], np.radians(turn[3]))
    return move


_MOVES = {
    "matrix": lambda values: values.reshape(4, 4),
    "translate": _translation,
    "rotate": _rotation,
    "scale": lambda values: np.diag([*values, 1.0]),
}
_NOT_READ = ("instance_controller", "lookat", "skew")
"""Skinned meshes, and moves that no exporter of robots writes."""


def _faces(geometry: Element, named: dict[str | None, Element]) -> Part:
    """Corners and faces of one geometry in its own frame."""
    corners, faces = [np.empty((0, 3))], list[list[int]]()
    for kind in ("convex_mesh", "brep"):
        if geometry.find(kind) is not None:
            raise ValueError(f"<{kind}> is not read")
    for primitives in geometry.iterfind("mesh/*"):
        if primitives.tag in ("source", "vertices", "extra", *_LINES):
            continue
        if primitives.tag not in _FACES:
            raise ValueError(f"<{primitives.tag}> is not read")
        if primitives.find("ph") is not None:
            raise ValueError("<ph>, a polygon with holes, is not read")
        vertex = _input(primitives, "VERTEX")
        offsets = [int(own.get("offset", "0")) for own in primitives.findall("input")]
        first = sum(map(len, corners))
        corners.append(_positions(_of(vertex.get("source"), named), named))
        counts = [int(word) for word in (primitives.findtext("vcount") or "").split()]
        for text in primitives.findall("p"):
            numbers = np.array((text.text or "").split(), int).reshape(-1, 1 + max(offsets))
            own = numbers[:, int(vertex.get("offset", "0"))]
            if len(own) and not 0 <= own.min() <= own.max() < len(corners[-1]):
                raise ValueError("a face with a corner that is not there")
            faces += _FACES[primitives.tag](own + first, counts)
    return np.concatenate(corners), [face for face in faces if len(face) > 2]


def _listed(own: np.ndarray, counts: list[int]) -> list[list[int]]:
    """Polygons of so many corners; without counts a single one."""
    ends = np.cumsum(counts or [len(own)])
    if ends[-1] != len(own):
        raise ValueError(f"polygons of {ends[-1]} corners, where {len(own)} are given")
    return [face.tolist() for face in np.split(own, ends[:-1])]


def _strip(own: np.ndarray, _: list[int]) -> list[list[int]]:
    """Each corner after the second makes a triangle with the two before it, turned every other
    time.
    """
    faces = np.stack([own[:-2], own[1:-1], own[2:]], axis=1)
    faces[1::2] = faces[1::2, ::-1]
    return faces.tolist()


def _fan(own: np.ndarray, _: list[int]) -> list[list[int]]:
    """Each corner after the second makes a triangle with the one before it and the first."""
    return [[int(own[0]), *pair] for pair in np.stack([own[1:-1], own[2:]], axis=1).tolist()]


_FACES: Mapping[str, Callable[[np.ndarray, list[int]], list[list[int]]]] = {
    "triangles": lambda own, _: own.reshape(-1, 3).tolist(),
    "tristrips": _strip,
    "trifans": _fan,
    "polylist": _listed,
    "polygons": lambda own, _: [own.tolist()],
}
"""Faces of what a <p> lists, by its element."""


def _input(element: Element, semantic: str) -> Element:
    for own in element.iterfind("input"):
        if own.get("semantic") == semantic:
            return own
    raise ValueError(f"<{element.tag}> without {semantic}")


def _positions(vertices: Element, named: dict[str | None, Element]) -> Float[np.ndarray, "n 3"]:
    source = _of(_input(vertices, "POSITION").get("source"), named)
    accessor = source.find("technique_common/accessor")
    if accessor is None:
        raise ValueError("positions without an accessor")
    values = np.array((source.findtext("float_array") or "").split(), float)
    stride, offset = int(accessor.get("stride", "1")), int(accessor.get("offset", "0"))
    return values[offset:].reshape(-1, stride)[:, :3]
