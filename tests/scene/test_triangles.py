"""Meshes and point clouds: every triangle and every ball is covered, and holes stay open."""

import os
import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from constraint_geodesics.robot.kinematics import RobotError
from constraint_geodesics.scene import triangles
from constraint_geodesics.scene.mesh import Mesh
from constraint_geodesics.scene.pieces import Piece
from constraint_geodesics.scene.point_cloud import CELLS, PointCloud
from constraint_geodesics.scene.shape import Placement
from constraint_geodesics.scene.triangles import Triangles, convex_pieces

RING_M, TUBE_M = 0.2, 0.06
NOTCHED = np.array([[0, 0], [3, 0], [3, 2], [2, 2], [2, 1], [1, 1], [1, 2], [0, 2]]) * 0.05
FRONT = [[0, 1, 4], [0, 4, 5], [1, 2, 3], [1, 3, 4], [0, 5, 6], [0, 6, 7]]


def ring(along: int, around: int) -> Triangles:
    """A torus about the z axis."""
    u, v = np.meshgrid(
        np.linspace(0, 2 * np.pi, along, endpoint=False),
        np.linspace(0, 2 * np.pi, around, endpoint=False),
        indexing="ij",
    )
    wide = RING_M + TUBE_M * np.cos(v)
    corners = np.stack([wide * np.cos(u), wide * np.sin(u), TUBE_M * np.sin(v)], -1).reshape(-1, 3)
    i, j = (a.ravel() for a in np.meshgrid(range(along), range(around), indexing="ij"))
    a, b = i * around + j, (i + 1) % along * around + j
    c, d = (i + 1) % along * around + (j + 1) % around, i * around + (j + 1) % around
    return Triangles(corners, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def notched() -> Triangles:
    """A block with a notch, its corners all on faces of its hull."""
    flat = [np.column_stack([NOTCHED, np.full(8, z)]) for z in (0.0, 0.1)]
    faces = [[a, c, b] for a, b, c in FRONT] + [[a + 8, b + 8, c + 8] for a, b, c in FRONT]
    for i in range(8):
        j = (i + 1) % 8
        faces += [[i, j, j + 8], [i, j + 8, i + 8]]
    return Triangles(np.concatenate(flat), np.array(faces))


def outside(points: np.ndarray, pieces: tuple[Piece, ...]) -> np.ndarray:
    """How far points are from the nearest piece's inside, by its planes [m]."""
    hulls = [ConvexHull(piece.corners).equations for piece in pieces]
    depths = [(points @ own[:, :3].T + own[:, 3]).max(axis=1) for own in hulls]
    return np.min(depths, axis=0)


@pytest.mark.parametrize("mesh", [ring(30, 16), notched()], ids=["ring", "notch"])
def test_parts_cover_every_triangle_and_leave_holes_open(mesh: Triangles) -> None:
    pieces = convex_pieces(mesh)
    shares = np.random.default_rng(0).dirichlet(np.ones(3), (len(mesh.faces), 20))
    on_it = np.einsum("mkc,mcd->mkd", shares, mesh.places()).reshape(-1, 3)
    assert outside(on_it, pieces).max() < 1e-9
    hole = np.array([[0.0, 0.0, 0.0], [0.075, 0.08, 0.05]])
    assert outside(hole, pieces).max() > 0.02
    assert 1 < len(pieces) <= 32


def test_a_convex_mesh_is_one_piece() -> None:
    hull = ConvexHull(np.random.default_rng(1).normal(size=(60, 3)))
    (piece,) = convex_pieces(Triangles(hull.points, hull.simplices))
    assert len(piece.corners) == len(hull.vertices)


def test_an_open_mesh_is_covered_too() -> None:
    """A scan that ends somewhere: half of a ring."""
    whole = ring(30, 16)
    half = Triangles(whole.corners, whole.faces[(whole.places()[:, :, 0] > 0.0).all(axis=1)])
    pieces = convex_pieces(half)
    assert outside(half.places().mean(axis=1), pieces).max() < 1e-9
    assert outside(np.zeros((1, 3)), pieces)[0] > 0.02


def bin_of(sides: int, faces_a_side: int = 1) -> Triangles:
    """Sides of a box from its floor up, each with corners of its own, as files have them that shade
    sides flat; some as often as they are seen.
    """
    quads = ["0231", "0154", "2673", "0462", "1375", "4576"][:sides]
    signs = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float)
    corners = np.concatenate([signs[list(map(int, quad))] * (0.4, 0.3, 0.2) for quad in quads])
    faces = np.concatenate([[[k, k + 1, k + 2], [k, k + 2, k + 3]] for k in range(0, 4 * sides, 4)])
    return Triangles(corners, np.concatenate([faces, faces[:, ::-1]][:faces_a_side]))


@pytest.mark.parametrize("faces_a_side", [1, 2])
def test_a_bin_without_a_lid_is_open(faces_a_side: int) -> None:
    (piece,) = convex_pieces(bin_of(6, faces_a_side))
    assert len(piece.corners) == 8
    mesh = bin_of(5, faces_a_side)
    pieces = convex_pieces(mesh)
    assert outside(mesh.places().mean(axis=1), pieces).max() < 1e-9
    assert outside(np.array([[0.2, 0.15, 0.12]]), pieces)[0] > 0.05


def test_a_convex_mesh_whose_edges_meet_in_their_middles_is_one_piece() -> None:
    box = bin_of(6)
    a, b = box.corners[box.faces[0, :2]]
    middle = len(box.corners)
    faces = np.array([[box.faces[0, 0], middle, box.faces[0, 2]], [middle, *box.faces[0, 1:]]])
    mesh = Triangles(
        np.concatenate([box.corners, [0.5 * (a + b)]]), np.concatenate([box.faces[1:], faces])
    )
    assert len(convex_pieces(mesh)) == 1


def written(folder: Path, mesh: Triangles) -> dict[str, Path]:
    """The same mesh in each kind of file."""
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in mesh.corners)
    faces = "".join("f " + " ".join(str(k + 1) for k in face) + "\n" for face in mesh.faces)
    (folder / "own.obj").write_text(corners + faces)
    rows = b"".join(
        struct.pack("<12fH", 0, 0, 0, *place.ravel().tolist(), 0) for place in mesh.places()
    )
    (folder / "own.stl").write_bytes(b"\0" * 80 + struct.pack("<I", len(mesh.faces)) + rows)
    text = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x} {y} {z}\n" for x, y, z in place)
        + "endloop\nendfacet\n"
        for place in mesh.places()
    )
    (folder / "text.stl").write_text(f"solid own\n{text}endsolid own\n")
    return {name: folder / name for name in ("own.obj", "own.stl", "text.stl")}


def test_every_kind_of_file_is_the_same_mesh(tmp_path: Path) -> None:
    mesh = notched()
    files = written(tmp_path, mesh)
    at = Placement((0.3, -0.1, 0.2), (0.1, 0.2, 0.3))
    for file in files.values():
        shape = Mesh("part", file, at, scale=2.0)
        moved = 2.0 * mesh.places().mean(axis=1) @ at.turn.T + at.position_m
        assert outside(moved, shape.pieces()).max() < 1e-6
        assert len(shape.pieces()) > 1


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("part.obj", "v 0 0 0\n", "has no faces"),
        ("part.obj", "v 0 0 0\nf 1 2 3\n", "a corner that is not there"),
        ("part.obj", "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "no finite numbers"),
        ("part.obj", "v a b c\n", "could not convert"),
        ("part.stl", "solid\n", "no triangles"),
        ("part.ply", "ply\n", "must be one of .obj, .stl, .dae"),
        ("part.dae", "<COLLADA/>", "Collada"),
        ("part.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "without volume"),
    ],
)
def test_what_is_no_mesh_is_named(tmp_path: Path, name: str, text: str, said: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(RobotError, match=said) as error:
        Mesh("part", tmp_path / name).pieces()
    assert name in str(error.value)
    assert "\n" not in str(error.value)


def test_a_mesh_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match="'part': there is no mesh"):
        Mesh("part", tmp_path / "none.obj").pieces()


@pytest.mark.parametrize("keeps_its_time", [False, True])
def test_a_mesh_that_was_written_anew_is_read_anew(tmp_path: Path, keeps_its_time: bool) -> None:
    """As by a copy that keeps times, or by two writes that the clock does not tell apart."""
    file = written(tmp_path, notched())["own.obj"]
    assert len(Mesh("part", file).pieces()) > 1
    before = file.stat()
    hull = ConvexHull(np.random.default_rng(1).normal(size=(20, 3)))
    mesh = Triangles(hull.points, hull.simplices)
    written(tmp_path, mesh)
    if keeps_its_time:
        os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert len(Mesh("part", file).pieces()) == 1


@pytest.mark.parametrize("count", [1, 2, 50, 5000])
def test_boxes_cover_every_point_of_a_cloud(count: int) -> None:
    rng = np.random.default_rng(count)
    points = rng.uniform(-1.0, 1.0, (count, 3))
    points[:, 2] = 0.1 * np.sin(3.0 * points[:, 0])
    cloud = PointCloud("seen", points, 0.01, Placement((0.5, 0.0, 0.1), (0.3, 0.0, 1.0)))
    pieces, there = cloud.pieces(), points @ cloud.pose.turn.T + cloud.pose.position_m
    assert len(pieces) <= CELLS
    covered = np.zeros(count, bool)
    for piece in pieces:
        assert piece.box is not None
        local = np.abs((there - piece.box[:3]) @ piece.box[6:].reshape(3, 3))
        covered |= (local <= piece.box[3:6] + 1e-9).all(axis=1)
    assert covered.all()


@pytest.mark.parametrize(
    "points", [[], [[1.0, 2.0]], [[0.0, 0.0, np.nan]], "abc", [[1, 2, 3], [1]]]
)
def test_what_is_no_cloud_is_refused(points: object) -> None:
    with pytest.raises(ValueError, match="points"):
        PointCloud("seen", points, 0.01)


def test_a_cloud_that_pybullet_could_not_take_is_refused() -> None:
    with pytest.raises(ValueError, match="12000 points: at most 10000"):
        PointCloud("seen", np.zeros((12_000, 3)), 0.01)


def test_a_mesh_of_many_triangles_is_looked_at_a_part_at_a_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All triangles by all planes are no array that fits into memory."""
    whole = [convex_pieces(mesh) for mesh in (ring(30, 16), notched())]
    most, beyond = [], triangles._beyond

    def seen(places: np.ndarray, hull: ConvexHull) -> np.ndarray:
        found = beyond(places, hull)
        most.append(found.size)
        return found

    monkeypatch.setattr(triangles, "_BLOCK", 3000)
    monkeypatch.setattr(triangles, "_beyond", seen)
    for mesh, pieces in zip((ring(30, 16), notched()), whole, strict=True):
        for own, other in zip(convex_pieces(mesh), pieces, strict=True):
            np.testing.assert_array_equal(own.corners, other.corners)
    assert max(most) <= 2 * 3000
