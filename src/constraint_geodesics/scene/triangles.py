"""Triangles of mesh files, and convex parts that cover them."""

from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, QhullError

from constraint_geodesics.extras import require
from constraint_geodesics.robot.kinematics import RobotError
from constraint_geodesics.scene.collada import as_obj
from constraint_geodesics.scene.pieces import (
    NOT_CONVEX,
    Piece,
    is_binary_stl,
    parse_obj,
    stl_as_obj,
    stl_triangles,
)
from constraint_geodesics.text_files import read_text

KINDS = (".obj", ".stl", ".dae")
BESIDE_M = 0.002
"""How far a triangle may stick out of its part before it is divided [m]."""
_SAME_PLACE = 9
"""Decimals of corners [m] that are one."""
_GAPS = 1e-3
"""Share of a hull that its mesh may leave open."""
_HALVINGS = 12
_THRESHOLD = 0.1
"""CoACD's concavity, of the mesh's size, from which on a part is divided."""
_MOST_PARTS = 32
_BLOCK = 1 << 22
"""Numbers that are looked at at once, of a mesh with many triangles."""


class Triangles:
    """A mesh: corners (n, 3) [m] and faces (m, 3)."""

    def __init__(self, corners: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> None:
        self.corners, self.faces = corners, faces

    def places(self) -> Float[np.ndarray, "m 3 3"]:
        """The three corners of each face [m]."""
        return self.corners[self.faces]


@lru_cache(maxsize=64)
def read_triangles(file: Path, _digest: str) -> Triangles:
    """Of an OBJ, STL or Collada file; one with something else in it is read again.  Raises
    RobotError, one line, for what is none, and for one without faces.
    """
    kind = file.suffix.lower()
    if kind not in KINDS:
        raise RobotError(f"{file} is no mesh that can be read: must be one of {', '.join(KINDS)}")
    try:
        if kind == ".stl":
            found = _of_obj(stl_as_obj(file)) if not is_binary_stl(file) else _of_stl(file)
        else:
            found = _of_obj(as_obj(file) if kind == ".dae" else read_text(file, errors="replace"))
    except (OSError, ValueError) as error:
        if isinstance(error, RobotError):
            raise
        raise RobotError(f"{file}: no mesh: {str(error).splitlines()[0]}") from None
    if not len(found.faces) or not np.isfinite(found.corners).all():
        raise RobotError(f"{file}: no mesh: has no faces, or corners that are no finite numbers")
    return found


def _of_obj(text: str) -> Triangles:
    """With each polygon as a fan."""
    points, objects = parse_obj(text)
    faces = [
        (own[0], *ends) for object_ in objects for own in object_ for ends in pairwise(own[1:])
    ]
    return Triangles(points, np.array(faces, int).reshape(-1, 3))


def _of_stl(file: Path) -> Triangles:
    rows = stl_triangles(file).reshape(-1, 3)
    corners, which = np.unique(rows, axis=0, return_inverse=True)
    return Triangles(corners, which.reshape(-1, 3))


def convex_pieces(mesh: Triangles) -> tuple[Piece, ...]:
    """Convex pieces that cover all triangles: the hull where the mesh is convex and closed, else
    hulls of the triangles that belong to each part of a decomposition by CoACD [Wei et al.,
    SIGGRAPH 2022].

    Raises RobotError for a mesh without volume, MissingExtraError without that library.
    """
    try:
        hull = ConvexHull(mesh.corners)
    except QhullError:
        raise RobotError(
            "a mesh without volume can't be bounded: take a box in its place"
        ) from None
    # a face lies on the hull where all its corners lie on one plane of it
    is_shell = all(
        ((-_beyond(own, hull)).max(axis=1).min(axis=1) <= NOT_CONVEX).all()
        for own in _blocks(mesh.places(), hull)
    )
    if is_shell and _is_closed(mesh, hull):
        return (Piece(mesh.corners[hull.vertices]),)
    return tuple(_covering(mesh.places(), _parts(mesh, is_shell or _is_open(mesh))))


def _beyond(places: Float[np.ndarray, "m 3 3"], hull: ConvexHull) -> Float[np.ndarray, "m 3 f"]:
    """How far corners of triangles lie beyond each plane of a hull [m]."""
    found: Float[np.ndarray, "m 3 f"] = places @ hull.equations[:, :3].T + hull.equations[:, 3]
    return found


def _blocks(places: Float[np.ndarray, "m 3 3"], hull: ConvexHull) -> list[np.ndarray]:
    """Triangles in groups so small that what is said of each and each plane fits into memory."""
    count = 3 * len(places) * len(hull.equations) // _BLOCK + 1
    return np.array_split(places, min(count, max(len(places), 1)))


def _parts(mesh: Triangles, is_open: bool) -> list[ConvexHull]:
    """The decomposition's parts, which follow the mesh but for some percent of its size; CoACD
    closes an open one first, as a thin shell.
    """
    require("meshes")
    import coacd

    coacd.set_log_level("error")
    found = coacd.run_coacd(
        coacd.Mesh(mesh.corners, mesh.faces),
        threshold=_THRESHOLD,
        max_convex_hull=_MOST_PARTS,
        preprocess_mode="auto" if is_open else "off",
        resolution=300,
        mcts_nodes=5,
        mcts_iterations=10,
        mcts_max_depth=1,
        seed=0,
    )
    return [ConvexHull(corners) for corners, _ in found]


def _is_closed(mesh: Triangles, hull: ConvexHull) -> bool:
    """Whether a mesh whose faces lie on its hull leaves no way into it, as a bin without a lid
    does: no edge is open, or the faces are as large as the hull, as where edges meet in their
    middles.  Corners at one place are one, and faces that are there twice, from either side, too.
    """
    corners, which = np.unique(mesh.corners.round(_SAME_PLACE), axis=0, return_inverse=True)
    faces = np.unique(np.sort(which.reshape(-1)[mesh.faces], axis=1), axis=0)
    joined = Triangles(corners, faces)
    a, b, c = joined.places().transpose(1, 0, 2)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    return not _is_open(joined) or bool(area >= (1.0 - _GAPS) * hull.area)


def _is_open(mesh: Triangles) -> bool:
    """Whether an edge has one face alone, as where a scan ends."""
    edges = np.sort(np.concatenate([mesh.faces[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] == 1).any())


def _covering(places: Float[np.ndarray, "m 3 3"], parts: list[ConvexHull]) -> list[Piece]:
    """For each part the hull of its own corners and of the triangles that are nearest to it, those
    that reach far beyond it divided first: whatever the parts are, no triangle is left out.
    """
    own = [[part.points[part.vertices]] for part in parts]
    for halving in range(_HALVINGS + 1):
        beyond = np.stack(
            [
                np.concatenate(
                    [_beyond(own, part).max(axis=(1, 2)) for own in _blocks(places, part)]
                )
                for part in parts
            ],
            axis=1,
        )
        nearest, least = beyond.argmin(axis=1), beyond.min(axis=1)
        done = (least <= BESIDE_M) | (halving == _HALVINGS) | (_longest(places) <= BESIDE_M)
        for k in range(len(parts)):
            own[k].append(places[done & (nearest == k)].reshape(-1, 3))
        places = _halved(places[~done])
        if not len(places):
            break
    return [_hull(np.concatenate(points)) for points in own]


def _longest(places: Float[np.ndarray, "m 3 3"]) -> Float[np.ndarray, "m"]:
    edges: Float[np.ndarray, "m"] = np.linalg.norm(
        places - np.roll(places, -1, axis=1), axis=2
    ).max(axis=1)
    return edges


def _halved(places: Float[np.ndarray, "m 3 3"]) -> Float[np.ndarray, "k 3 3"]:
    """Each triangle as two, its longest edge divided."""
    longest = np.linalg.norm(places - np.roll(places, -1, axis=1), axis=2).argmax(axis=1)
    turned = np.take_along_axis(places, ((longest[:, None] + np.arange(3)) % 3)[:, :, None], axis=1)
    a, b, c = turned[:, 0], turned[:, 1], turned[:, 2]
    middle = 0.5 * (a + b)
    return np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])


def _hull(points: Float[np.ndarray, "n 3"]) -> Piece:
    hull = ConvexHull(points)
    depth = -(points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1)
    return Piece(points[hull.vertices], 0.0, float(max(depth.max(), 0.0)))
