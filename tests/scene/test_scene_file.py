"""Scenes in files, to a planner and to the shell."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from constraint_geodesics import bundle
from constraint_geodesics.planner import Planner
from constraint_geodesics.scene.body import Body
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.capsule import Capsule
from constraint_geodesics.scene.mesh import Mesh
from constraint_geodesics.scene.scene import SceneError
from constraint_geodesics.scene.scene_file import read_attached, read_scene

SCENE = """
shapes:
  crate: {kind: box, centre_m: [0.5, 0.3, 0.1], size_m: [0.15, 0.15, 0.2]}
  bottle: {kind: cylinder, pose: {position_m: [-0.5, -0.5, 0.15]}, length_m: 0.3, radius_m: 0.04}
  part: {kind: mesh, file: part.obj, pose: {position_m: [0.6, -0.2, 0.1], rpy_rad: [0, 0, 0.5]}}
  seen: {kind: point_cloud, radius_m: 0.02, points_m: [[0.4, 0.1, 0.5], [0.42, 0.1, 0.5]]}
attached:
  cup: {link: link6, touching: [link5], kind: sphere, centre_m: [0, 0, 0.1], radius_m: 0.05}
allowed:
- [crate, bottle]
"""
CUP = "cup: {link: link6, kind: box, centre_m: [0, 0, 0.08], size_m: [0.06, 0.06, 0.1]}\n"


@pytest.fixture
def planner() -> Iterator[Planner]:
    with Planner.load(bundle.PACKAGED) as loaded:
        yield loaded


def brick(file: Path) -> None:
    corners = [(x, y, z) for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1)]
    faces = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {face}" for face in faces]
    file.write_text("\n".join(lines) + "\n")


def test_a_file_adds_to_what_is_there(planner: Planner, tmp_path: Path) -> None:
    brick(tmp_path / "part.obj")
    (tmp_path / "scene.yaml").write_text(SCENE)
    read_scene(tmp_path / "scene.yaml").into(planner.scene)
    names = [shape.name for shape in planner.scene.workcell]
    assert names == ["table", "crate", "bottle", "part", "seen"]
    assert planner.scene.workcell[1] == Box("crate", (0.5, 0.3, 0.1), (0.15, 0.15, 0.2))
    part = planner.scene.workcell[3]
    assert isinstance(part, Mesh)
    assert part.file == tmp_path / "part.obj"  # beside the scene's file
    (cup,) = planner.scene.attached
    assert (cup.name, cup.link, cup.touching) == ("cup", "link6", ("link5",))
    assert planner.scene.now.allowed == {("crate", "bottle")}


def test_a_file_of_attached_shapes_alone(planner: Planner, tmp_path: Path) -> None:
    (tmp_path / "cup.yaml").write_text(CUP)
    read_attached(tmp_path / "cup.yaml").into(planner.scene)
    assert [one.name for one in planner.scene.attached] == ["cup"]


@pytest.mark.parametrize("end", ["---\n", "---\n---\n", "...\n", "--- # no more\n"])
def test_a_further_document_may_be_empty(tmp_path: Path, end: str) -> None:
    (tmp_path / "cup.yaml").write_text("---\n" + CUP + end)
    assert list(read_attached(tmp_path / "cup.yaml").attached) == ["cup"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("shapes: [", "not YAML"),
        ("- 1", "must be entries by name"),
        ("", "must be entries by name"),
        ("shape: {}", "shape={}: there is no such parameter"),
        ("shapes: [1]", "shapes must be shapes by name"),
        ("shapes: {crate: 3}", "shapes.crate"),
        ("shapes: {crate: {}}", "shapes.crate.kind is missing"),
        ("shapes: {crate: {kind: pyramid}}", "pyramid"),
        ("shapes: {crate: {kind: sphere, radius_m: 1}}", "centre_m is missing"),
        ("shapes: {b: {kind: sphere, centre_m: [0, 0, x], radius_m: 1}}", "centre_m"),
        ("shapes: {b: {kind: sphere, centre_m: [0, 0, 0], radius_m: -1}}", "radius_m=-1"),
        ("shapes: {b: {kind: sphere, centre_m: [0, 0, .nan], radius_m: 1}}", "centre_m"),
        ("shapes: {b: {kind: point_cloud, points_m: [[1, 2]], radius_m: 1}}", "points"),
        ("attached: {b: {kind: sphere, centre_m: [0, 0, 0], radius_m: 1}}", "link is missing"),
        (
            "shapes: {b: {kind: box, centre_m: [0, 0, 0], size_m: [1, 1, 1], rpy_rad: [0, 0, 45]}}",
            "rpy_rad.2: 45: must be within ±4π: angles are in rad, not degrees",
        ),
        (
            "shapes: {b: {kind: cylinder, length_m: 1, radius_m: 1, pose: {rpy_rad: [-90, 0, 0]}}}",
            "pose.rpy_rad.0: -90: must be within ±4π",
        ),
        ("allowed: [[a, b, c]]", "allowed"),
        ("allowed: []\n---\nallowed: []\n", "has 2 documents of YAML: must have one"),
        ("allowed: []\n---\nshapes: [", "not YAML"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "scene.yaml").write_text(text)
    with pytest.raises(SceneError) as error:
        read_scene(tmp_path / "scene.yaml")
    assert said in str(error.value)
    assert str(error.value).startswith(str(tmp_path / "scene.yaml"))
    assert "\n" not in str(error.value)


def test_all_of_a_file_is_added_or_nothing(planner: Planner, tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(SCENE.replace("part.obj", "none.obj"))
    before = planner.scene.now
    with pytest.raises(ValueError, match=r"none\.obj"):
        read_scene(tmp_path / "scene.yaml").into(planner.scene)
    assert planner.scene.now is before


def test_what_is_attached_takes_no_other_shapes_place(planner: Planner, tmp_path: Path) -> None:
    (tmp_path / "cell.yaml").write_text(SCENE.replace("bottle", "cup").replace("part: ", "#"))
    before = planner.scene.now
    with pytest.raises(SceneError, match="attached.cup: another shape of that name stands"):
        read_scene(tmp_path / "cell.yaml").into(planner.scene)
    assert planner.scene.now is before
    planner.scene.add(Box("cup", (0.4, 0.4, 0.2), (0.06, 0.06, 0.2)))
    (tmp_path / "cup.yaml").write_text(CUP)
    with pytest.raises(SceneError, match="another shape"):
        read_attached(tmp_path / "cup.yaml").into(planner.scene)
    assert [shape.name for shape in planner.scene.workcell] == ["table", "cup"]
    planner.scene.remove("cup")
    planner.scene.add(Box("cup", (0.4, 0.4, 0.2), (0.06, 0.06, 0.1)))  # that is picked up
    read_attached(tmp_path / "cup.yaml").into(planner.scene)
    assert [shape.name for shape in planner.scene.workcell] == ["table"]
    assert [one.name for one in planner.scene.attached] == ["cup"]


def test_a_capsule_that_stands_askew_is_picked_up(planner: Planner, tmp_path: Path) -> None:
    planner.scene.add(Capsule("pen", (0.41, 0.33, 0.2), (0.47, 0.42, 0.22), 0.01))
    own = "pen: {link: link6, kind: capsule, from_m: [0, 0, 0.1], to_m: [0, 0, %s], radius_m: 0.01}"
    (tmp_path / "pen.yaml").write_text(own % 0.22)
    with pytest.raises(SceneError, match="another shape"):
        read_attached(tmp_path / "pen.yaml").into(planner.scene)
    (tmp_path / "pen.yaml").write_text(own % 0.21)
    read_attached(tmp_path / "pen.yaml").into(planner.scene)


def test_a_urdf_is_looked_for_beside_the_file_first(tmp_path: Path) -> None:
    """Not where the shell is, nor among PyBullet's, which have one of that name."""
    (tmp_path / "table").mkdir()
    (tmp_path / "table" / "table.urdf").write_text("<robot name='own'><link name='top'/></robot>")
    (tmp_path / "cell.yaml").write_text(
        "shapes: {desk: {kind: urdf, urdf: table/table.urdf}, cube: {kind: urdf, urdf: cube.urdf}}"
    )
    desk, cube = read_scene(tmp_path / "cell.yaml").shapes.values()
    assert isinstance(desk, Body)
    assert isinstance(cube, Body)
    assert desk.urdf == tmp_path / "table" / "table.urdf"
    assert cube.urdf == "cube.urdf"
