"""The convex pieces that PyBullet collides, read from the same URDF and mesh files.

PyBullet takes each object of an OBJ mesh, the whole of an STL mesh, and a URDF's cylinder as one
convex hull, and keeps a margin of its own around it; of boxes, balls and capsules it takes the
exact shape, but for the edges of a box, which it rounds off.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from constraint_geodesics.robot.description import find_mesh
from constraint_geodesics.robot.kinematics import RobotError, origin_of, urdf_root
from constraint_geodesics.text_files import read_content, read_text

HULL_MARGIN = 0.001
"""What PyBullet keeps around a hull [m]."""
_SAME = 7
"""Corners of a mesh that agree to so many decimals [m] are one."""
_BLOCK, _FEW = 256, 64
NOT_CONVEX = 0.001
"""A mesh with corners so deep inside its hull [m] is not convex."""
_SIDES = 64
_STL_HEAD = 84
"""Bytes of a binary STL file before its triangles; the last four count them."""
_SIGNS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


class Piece(NamedTuple):
    """All points within `rounding` [m] of the convex hull of its corners (n, 3) [m].

    hollow_m: how far corners of its mesh lie inside that hull at most, which covers more than the
    mesh, as PyBullet does.  margin: how much of the rounding [m] is no matter, but what PyBullet
    keeps around it.  box: centre (3,), half edges (3,) and turn (9,) of the box that the
    hull is, where it is known to be one.
    """

    corners: Float[np.ndarray, "n 3"]
    rounding: float = 0.0
    hollow_m: float = 0.0
    box: Float[np.ndarray, "15"] | None = None
    margin: float = 0.0

    def at(self, pose: Float[np.ndarray, "4 4"]) -> "Piece":
        """The same piece elsewhere."""
        return self._replace(corners=self.corners @ pose[:3, :3].T + pose[:3, 3], box=None)


@dataclass(frozen=True)
class LinkPieces:
    """A link of a URDF: the link it hangs on, None for the root; the joints that move it, from the
    root on; its frame and its pieces in the root's frame, all joints at 0.
    """

    name: str
    parent: str | None
    joints: tuple[str, ...]
    pose: Float[np.ndarray, "4 4"]
    pieces: tuple[Piece, ...]


def box_corners(half_edges: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n 3"]:
    """Corners of a box around the origin; fewer than 8 where edges are 0."""
    return _SIGNS[((_SIGNS > 0.0) | (half_edges > 0.0)).all(axis=1)] * half_edges


def prism(sides: int, radius: float, low: float, high: float) -> Float[np.ndarray, "n 3"]:
    """Corners of the prism around a cylinder about the z axis."""
    turn = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    wide = radius / np.cos(np.pi / sides)
    x, y, one = wide * np.cos(turn), wide * np.sin(turn), np.ones(sides)
    return np.concatenate([np.stack([x, y, low * one], 1), np.stack([x, y, high * one], 1)])


def read_pieces(urdf: Path) -> list[LinkPieces]:
    """All links of a URDF.  Raises RobotError where a collision shape can't be bounded, naming the
    file and the link.
    """
    root = urdf_root(urdf)
    above = {_link(j, "child"): (_link(j, "parent"), j) for j in root.findall("joint")}
    found = []
    for link in root.findall("link"):
        name = link.get("name", "")
        pose, joints, at = np.eye(4), list[str](), name
        while at in above:
            at, joint = above[at]
            pose = origin_of(joint) @ pose
            joints.append(joint.get("name", ""))
        pieces = [
            piece.at(pose @ origin_of(collision))
            for collision in link.findall("collision")
            for piece in _pieces_of(collision, urdf, name)
        ]
        parent = above[name][0] if name in above else None
        found.append(LinkPieces(name, parent, tuple(reversed(joints)), pose, tuple(pieces)))
    return found


def _link(joint: ElementTree.Element, end: str) -> str:
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def _pieces_of(collision: ElementTree.Element, urdf: Path, link: str) -> Iterator[Piece]:
    geometry = collision.find("geometry")
    shapes = [] if geometry is None else list(geometry)
    if not shapes:
        raise RobotError(f"{urdf}: a collision shape of link {link!r} has no geometry")
    shape = shapes[0]
    try:
        yield from _KINDS[shape.tag](shape, urdf)
    except KeyError:
        raise RobotError(
            f"{urdf}: the collision shape {shape.tag!r} of link {link!r} can't be bounded: must be "
            f"one of {', '.join(_KINDS)}"
        ) from None
    except QhullError:
        raise RobotError(
            f"{urdf}: collision shape of link {link!r}: has no volume: take a box in its place"
        ) from None
    except (ValueError, OSError) as error:
        reason = str(error).splitlines()[0]
        raise RobotError(f"{urdf}: collision shape of link {link!r}: {reason}") from None


def _numbers(shape: ElementTree.Element, name: str, default: str | None = None) -> np.ndarray:
    text = shape.get(name, default)
    if text is None:
        raise ValueError(f"a {shape.tag} without {name}")
    return np.array(text.split(), float)


def _size(shape: ElementTree.Element, name: str, count: int = 1) -> np.ndarray:
    """Sizes [m], so many, which must be positive."""
    sizes = _numbers(shape, name)
    if not ((sizes > 0.0) & np.isfinite(sizes)).all() or len(sizes) != count:
        what = "a positive number" if count == 1 else f"{count} positive numbers"
        raise ValueError(f"a {shape.tag} with {name} {shape.get(name)}, which must be {what}")
    return sizes


def _box(shape: ElementTree.Element, _: Path) -> Iterator[Piece]:
    yield Piece(box_corners(0.5 * _size(shape, "size", 3)))


def _sphere(shape: ElementTree.Element, _: Path) -> Iterator[Piece]:
    yield Piece(np.zeros((1, 3)), float(_size(shape, "radius")[0]))


def _capsule(shape: ElementTree.Element, _: Path) -> Iterator[Piece]:
    half = np.array([0.0, 0.0, 0.5 * _size(shape, "length")[0]])
    yield Piece(np.array([-half, half]), float(_size(shape, "radius")[0]))


def _cylinder(shape: ElementTree.Element, _: Path) -> Iterator[Piece]:
    """The prism around it, where PyBullet takes one within it."""
    half, radius = 0.5 * float(_size(shape, "length")[0]), float(_size(shape, "radius")[0])
    yield Piece(prism(_SIDES, radius, -half, half), HULL_MARGIN, margin=HULL_MARGIN)


def _mesh(shape: ElementTree.Element, urdf: Path) -> Iterator[Piece]:
    name = shape.get("filename", "")
    file = find_mesh(name, urdf)
    if file is None:
        raise ValueError(f"there is no mesh {name!r}")
    scale = _numbers(shape, "scale", "1 1 1")
    yield from _mesh_pieces(file, file_digest(file), tuple(scale))


@lru_cache(maxsize=256)
def _mesh_pieces(file: Path, _digest: str, scale: tuple[float, ...]) -> tuple[Piece, ...]:
    """Search and certificate ask for the same meshes; a changed file is read again."""
    return tuple(mesh_piece(points * np.array(scale)) for points in read_mesh(file))


_KINDS = {"mesh": _mesh, "box": _box, "sphere": _sphere, "cylinder": _cylinder, "capsule": _capsule}


def mesh_piece(points: Float[np.ndarray, "n 3"]) -> Piece:
    """The hull of a mesh's corners.  Raises QhullError where it has no volume."""
    corners = np.unique(points.round(_SAME), axis=0)
    hull = ConvexHull(corners)
    hollow = _deepest(corners, hull.equations)
    return Piece(corners[hull.vertices], HULL_MARGIN + 10.0**-_SAME, hollow, margin=HULL_MARGIN)


def _deepest(corners: Float[np.ndarray, "n 3"], faces: Float[np.ndarray, "f 4"]) -> float:
    """How far the corner that lies deepest in a hull does [m].  A few faces bound how deep each one
    can lie; those that may lie deepest are measured to all faces first, and most never are.
    """

    def depths(own: Float[np.ndarray, "k 3"], of: Float[np.ndarray, "m 4"]) -> np.ndarray:
        return -(own @ of[:, :3].T + of[:, 3]).max(axis=1)

    bounds = depths(corners, faces[:: len(faces) // _FEW + 1])
    order, found = np.argsort(-bounds), -np.inf
    for own in np.array_split(order, range(_BLOCK, len(order), _BLOCK)):
        if bounds[own[0]] <= found:
            break
        found = max(found, float(depths(corners[own], faces).max()))
    return found


def file_digest(file: Path) -> str:
    """Of what is in a file: its time is no sign, which a copy may keep.  Raises OSError."""
    return blake2b(read_content(file)).hexdigest()


def read_mesh(file: Path) -> list[Float[np.ndarray, "n 3"]]:
    """Corners of each object of an OBJ file, or of the whole of an STL file.  Raises ValueError for
    another kind of file, and for one without faces.
    """
    readers = {".obj": _read_obj, ".stl": _read_stl}
    kind = file.suffix.lower()
    if kind not in readers:
        raise ValueError(f"{file.name} is no mesh that can be read: must be OBJ or STL")
    objects = readers[kind](file)
    if not objects or not all(np.isfinite(points).all() for points in objects):
        raise ValueError(f"{file.name} has no faces, or corners that are no finite numbers")
    return objects


def _read_obj(file: Path) -> list[Float[np.ndarray, "n 3"]]:
    try:
        points, objects = parse_obj(read_text(file, errors="replace"))
    except ValueError as error:
        raise ValueError(f"{file.name}: {error}") from None
    used = [sorted({number for face in faces for number in face}) for faces in objects]
    return [points[own] for own in used if own]


def parse_obj(text: str) -> tuple[Float[np.ndarray, "n 3"], list[list[list[int]]]]:
    """Corners of an OBJ file, and the faces of each of its objects as numbers of corners.  Raises
    ValueError for a face with a corner that is not there.
    """
    corners: list[list[float]] = []
    objects: list[list[list[int]]] = [[]]
    for line in text.splitlines():
        kind, *words = line.split() or [""]
        if kind in ("o", "g") and words:  # without a name PyBullet goes on with the same one
            objects.append([])
        elif kind == "v":
            corners.append([float(x) for x in words[:3]])
        elif kind == "f":
            # numbers count from 1, negative ones from the last corner backwards
            numbers = [int(word.split("/")[0]) for word in words]
            objects[-1].append([n - 1 if n > 0 else len(corners) + n for n in numbers])
    points = np.array(corners, float).reshape(-1, 3)
    if not all(0 <= n < len(points) for faces in objects for face in faces for n in face):
        raise ValueError("a face with a corner that is not there")
    return points, objects


def _read_stl(file: Path) -> list[Float[np.ndarray, "n 3"]]:
    points = stl_triangles(file).reshape(-1, 3) if is_binary_stl(file) else _stl_corners(file)
    return [np.unique(points, axis=0)] if len(points) else []


def stl_triangles(file: Path) -> Float[np.ndarray, "n 3 3"]:
    """The corners of each triangle of a binary STL file."""
    face = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    return np.fromfile(file, face, offset=_STL_HEAD)["corners"].astype(float)


def is_binary_stl(file: Path) -> bool:
    """Whether an STL file is binary, as PyBullet reads it, rather than a text."""
    with file.open("rb") as data:
        count = int.from_bytes(data.read(_STL_HEAD)[80:], "little")
    return file.stat().st_size == _STL_HEAD + 50 * count


def stl_as_obj(file: Path) -> str:
    """An STL file that is a text as OBJ.  Raises RobotError where it is none."""
    try:
        corners = _stl_corners(file)
    except ValueError as error:
        raise RobotError(f"{file}: no STL mesh: {error}: write it as OBJ or binary STL") from None
    if not len(corners) or len(corners) % 3 or not np.isfinite(corners).all():
        raise RobotError(f"{file}: no STL mesh: has no triangles: write it as OBJ or binary STL")
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in corners.tolist()]
    lines += [f"f {k} {k + 1} {k + 2}" for k in range(1, len(corners), 3)]
    return "\n".join(lines) + "\n"


def _stl_corners(file: Path) -> Float[np.ndarray, "n 3"]:
    """Of all triangles of an STL file that is a text."""
    words = (line.split() for line in read_text(file, errors="replace").splitlines())
    rows = [row[1:4] for row in words if row[:1] == ["vertex"]]
    return np.array(rows, float).reshape(-1, 3)
