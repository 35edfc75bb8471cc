"""Collision meshes in Collada's format, written as OBJ: PyBullet reads Collada, but a file that is
none ends the process.

Positions alone are read, of triangles, polygons and their lists, where the scene places them, in
metres and with z up, as PyBullet takes them.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from constraint_geodesics.robot.kinematics import RobotError

_UPRIGHT = {
    "Z_UP": np.eye(3),
    "Y_UP": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "X_UP": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
}
Element = ElementTree.Element
Parts = list[tuple[Float[np.ndarray, "n 3"], list[list[int]]]]
"""Corners and faces of each geometry."""


def as_obj(mesh: Path) -> str:
    """The mesh as OBJ, an object a geometry.  Raises RobotError, naming the file, where it can't be
    read or has no faces.
    """
    try:
        parts = list(_parts(mesh))
    except (OSError, ValueError, KeyError, IndexError, AttributeError) as error:
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


def _parts(mesh: Path) -> Iterator[tuple[Float[np.ndarray, "n 3"], list[list[int]]]]:
    try:
        root = ElementTree.parse(mesh).getroot()
    except ElementTree.ParseError as error:
        raise ValueError(f"no XML: {error}") from None
    for element in root.iter():  # Collada's own names carry its address
        element.tag = element.tag.rsplit("}", 1)[-1]
    named = {element.get("id"): element for element in root.iter() if element.get("id")}
    unit, up = root.find("asset/unit"), root.findtext("asset/up_axis", "Y_UP").strip()
    frame = np.eye(4)
    frame[:3, :3] = _UPRIGHT[up] * (1.0 if unit is None else float(unit.get("meter", "1")))
    scene = root.find("scene/instance_visual_scene")
    if scene is None:
        raise ValueError("no scene")
    for geometry, pose in _placed(_of(scene.get("url"), named), frame, named):
        corners, faces = _faces(geometry, named)
        yield corners @ pose[:3, :3].T + pose[:3, 3], faces


def _of(address: str | None, named: dict[str | None, Element]) -> Element:
    return named[(address or "").removeprefix("#")]


def _placed(
    node: Element, pose: Float[np.ndarray, "4 4"], named: dict[str | None, Element]
) -> Iterator[tuple[Element, Float[np.ndarray, "4 4"]]]:
    """The geometries below a node, with what places each."""
    for child in node:
        values = np.array((child.text or "").split(), float) if child.tag in _MOVES else None
        if values is not None:
            pose = pose @ _MOVES[child.tag](values)
        elif child.tag == "instance_geometry":
            yield _of(child.get("url"), named), pose
        elif child.tag == "instance_node":
            yield from _placed(_of(child.get("url"), named), pose, named)
        elif child.tag == "node":
            yield from _placed(child, pose, named)


def _translation(by: np.ndarray) -> np.ndarray:
    move = np.eye(4)
    move[:3, 3] = by
    return move


def _rotation(turn: np.ndarray) -> np.ndarray:
    """About an axis, by an angle in degrees."""
    move, (x, y, z) = np.eye(4), turn[:3] / np.linalg.norm(turn[:3])
    angle, across = np.radians(turn[3]), np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    move[:3, :3] += np.sin(angle) * across + (1.0 - np.cos(angle)) * across @ across
    return move


_MOVES = {
    "matrix": lambda values: values.reshape(4, 4),
    "translate": _translation,
    "rotate": _rotation,
    "scale": lambda values: np.diag([*values, 1.0]),
}


def _faces(
    geometry: Element, named: dict[str | None, Element]
) -> tuple[Float[np.ndarray, "n 3"], list[list[int]]]:
    """Corners and faces of one geometry in its own frame."""
    corners, faces = [np.empty((0, 3))], list[list[int]]()
    mesh = geometry.find("mesh")
    for primitives in mesh if mesh is not None else ():
        if primitives.tag not in ("triangles", "polylist", "polygons"):
            continue
        inputs = primitives.findall("input")
        vertex = next(own for own in inputs if own.get("semantic") == "VERTEX")
        stride = 1 + max(int(own.get("offset", "0")) for own in inputs)
        first = sum(map(len, corners))
        corners.append(_positions(_of(vertex.get("source"), named), named))
        counts = [int(word) for word in (primitives.findtext("vcount") or "").split()]
        for text in primitives.findall("p"):
            numbers = np.array((text.text or "").split(), int).reshape(-1, stride)
            own = numbers[:, int(vertex.get("offset", "0"))] + first
            if primitives.tag == "triangles":
                faces += own.reshape(-1, 3).tolist()
            else:
                ends = np.cumsum(counts or [len(own)])
                faces += [face.tolist() for face in np.split(own, ends[:-1])]
    points = np.concatenate(corners)
    if faces and max(map(max, faces)) >= len(points):
        raise ValueError("a face with a corner that is not there")
    return points, faces


def _positions(vertices: Element, named: dict[str | None, Element]) -> Float[np.ndarray, "n 3"]:
    position = next(own for own in vertices if own.get("semantic") == "POSITION")
    source = _of(position.get("source"), named)
    accessor = source.find("technique_common/accessor")
    if accessor is None:
        raise ValueError("positions without an accessor")
    values = np.array((source.findtext("float_array") or "").split(), float)
    stride, offset = int(accessor.get("stride", "1")), int(accessor.get("offset", "0"))
    return values[offset:].reshape(-1, stride)[:, :3]
