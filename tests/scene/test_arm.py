"""The arm of somebody's URDF: what PyBullet has of the whole robot with the other joints held, the
pairs that may touch, meshes that PyBullet alone reads.
"""

from pathlib import Path

import numpy as np
import pybullet
import pytest
from tests.robot.test_description import ARM

from constraint_geodesics.params import PoseParams, RobotParams
from constraint_geodesics.robot.kinematics import RobotError, SerialRobot, load_robot
from constraint_geodesics.scene import allowed_collisions, arm
from constraint_geodesics.scene.arm import FOUND, load_arm
from constraint_geodesics.scene.collada import as_obj
from constraint_geodesics.scene.pieces import read_pieces
from constraint_geodesics.scene.scene import Scene, robot_from
from constraint_geodesics.scene.urdf import find_urdf

PANDA = RobotParams(
    urdf="franka_panda/panda.urdf",
    tool_link="panda_grasptarget",
    hold={"panda_finger_joint1": 0.03},
    tool=PoseParams(position_m=(0.01, 0.02, 0.1), rpy_rad=(0.1, -0.4, 2.0)),
    may_touch=FOUND,
)


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch) -> Path:
    """Nothing is taken from, or left in, the user's cache."""
    folder = tmp_path / "arms"
    monkeypatch.setattr(arm, "arms_folder", lambda: folder)
    return folder


def test_the_arm_is_where_pybullet_has_it_in_the_whole_robot() -> None:
    """The URDF as it is, its fingers held, the tool's frame in its link."""
    robot = robot_from(PANDA)
    client = pybullet.connect(pybullet.DIRECT)
    body = pybullet.loadURDF(str(find_urdf(PANDA.urdf)), useFixedBase=True, physicsClientId=client)
    info = [
        pybullet.getJointInfo(body, i, physicsClientId=client)
        for i in range(pybullet.getNumJoints(body, physicsClientId=client))
    ]
    joints = {row[1].decode(): row[0] for row in info}
    links = {row[12].decode(): row[0] for row in info}
    tool = np.array(PANDA.tool.position_m)
    turn = pybullet.getQuaternionFromEuler(PANDA.tool.rpy_rad)
    for q in robot.sample(20, np.random.default_rng(0)):
        for name, value in zip(robot.joint_names, q, strict=True):
            pybullet.resetJointState(body, joints[name], value, physicsClientId=client)
        state = pybullet.getLinkState(
            body, links["panda_grasptarget"], computeForwardKinematics=1, physicsClientId=client
        )
        place, turned = pybullet.multiplyTransforms(state[4], state[5], tool, turn)
        position, rotation = robot.forward(q)
        np.testing.assert_allclose(position, place, atol=1e-6)
        wanted = np.reshape(pybullet.getMatrixFromQuaternion(turned), (3, 3))
        np.testing.assert_allclose(rotation, wanted, atol=1e-6)
    pybullet.disconnect(client)


def test_pairs_that_may_touch_are_no_collision_for_anybody() -> None:
    plain = robot_from(PANDA.model_copy(update={"may_touch": "adjacent"}))
    found = robot_from(PANDA)
    drawn = found.sample(200, np.random.default_rng(1))
    with Scene(plain).world() as whole, Scene(found).world() as world:
        assert not whole.free(drawn).any(), "hand and last link always touch"
        free = world.free(drawn)
    assert 0.6 < free.mean() < 0.95
    assert ("panda_link7", "panda_hand") in found.allowed


def test_what_was_found_by_sampling_is_kept(own_folder, monkeypatch) -> None:
    first = load_arm(PANDA)
    monkeypatch.setattr(arm, "allowed_by_sampling", lambda robot: pytest.fail("sampled again"))
    again = load_arm(PANDA)
    assert again.allowed == first.allowed
    assert again.sampled == first.sampled
    assert again.robot.urdf == first.robot.urdf
    other = PANDA.model_copy(update={"limits_rad": {"panda_joint1": (-1.0, 1.0)}})
    with pytest.raises(pytest.fail.Exception):
        load_arm(other)
    monkeypatch.setattr(allowed_collisions, "ALWAYS", 0.9)
    with pytest.raises(pytest.fail.Exception):
        load_arm(PANDA)


def test_a_visual_that_is_not_there_is_left_out(tmp_path) -> None:
    file = tmp_path / "arm.urdf"
    drawn = '<visual><geometry><mesh filename="{}"/></geometry></visual><visual/>'
    text = ARM.replace('<link name="hand"/>', f'<link name="hand">{drawn.format("no.stl")}</link>')
    text = text.replace('<link name="left"/>', f'<link name="left">{drawn.format("l.stl")}</link>')
    (tmp_path / "l.stl").write_text(stl(CORNERS))
    file.write_text(text)
    robot = robot_from(RobotParams(urdf=str(file), tool_link="hand", may_touch=FOUND))
    assert "no.stl" not in robot.urdf.read_text()
    assert robot.urdf.read_text().count("<visual>") == 1
    with Scene(robot).world() as world:
        assert world.is_free(np.array([0.0, 0.2, 0.0]))


@pytest.mark.parametrize("size", ["1", "1 1", "1 1 0", "1 1 nan", "1 1 inf"])
def test_a_box_has_three_edges(tmp_path, size) -> None:
    file = tmp_path / "arm.urdf"
    file.write_text(ARM.replace('size="0.1 0.1 1"', f'size="{size}"'))
    said = rf"arm\.urdf: .*'upper': a box with size {size}, which must be 3 positive numbers"
    with pytest.raises(RobotError, match=said):
        robot_from(RobotParams(urdf=str(file), tool_link="hand", may_touch=FOUND))


def test_what_pybullet_does_not_load_is_one_line(tmp_path) -> None:
    file = tmp_path / "arm.urdf"
    broken = '<link name="hand"><inertial><mass value="x"/></inertial></link>'
    file.write_text(ARM.replace('<link name="hand"/>', broken))
    with pytest.raises(RobotError, match=r"arm\.urdf: PyBullet can't load it: look at <inertial>"):
        robot_from(RobotParams(urdf=str(file), tool_link="hand", may_touch=FOUND))


def test_an_edited_mesh_is_sampled_anew(tmp_path) -> None:
    """The hand becomes so large that it is always in the base."""
    mesh = tmp_path / "hand.stl"
    mesh.write_text(stl(0.01 * CORNERS))
    params = with_hand(tmp_path, 'filename="hand.stl"', base=BASE)
    assert load_arm(params).sampled == ((), 1.0)
    mesh.write_text(stl(50.0 * (CORNERS - 0.25)))
    assert ("base", "hand", "always touch") in load_arm(params).allowed
    mesh.write_text(stl(0.01 * CORNERS))
    assert load_arm(params).sampled == ((), 1.0)


CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
BASE = "<collision><geometry><sphere radius='0.05'/></geometry></collision>"


def stl(corners: np.ndarray) -> str:
    """A tetrahedron as an STL file that is a text."""
    triangles = (
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x} {y} {z}\n" for x, y, z in corners[list(face)])
        + "endloop\nendfacet\n"
        for face in FACES
    )
    return f"solid hand\n{''.join(triangles)}endsolid hand\n"


def with_hand(folder: Path, mesh: str, base: str = "") -> RobotParams:
    """An arm whose hand has a mesh with these attributes."""
    file = folder / "arm.urdf"
    shape = f"<collision><geometry><mesh {mesh}/></geometry></collision>"
    text = ARM.replace('<link name="hand"/>', f'<link name="hand">{shape}</link>')
    file.write_text(text.replace('<link name="base"/>', f'<link name="base">{base}</link>'))
    return RobotParams(urdf=str(file), tool_link="hand", may_touch=FOUND)


def hand_of(robot: SerialRobot) -> np.ndarray:
    """Corners of the hand's only piece in its own frame."""
    link = next(own for own in read_pieces(robot.urdf) if own.name == "hand")
    (piece,) = (own.at(np.linalg.inv(link.pose)) for own in link.pieces)
    return piece.corners


def hand_in_pybullet(urdf: str) -> np.ndarray:
    client = pybullet.connect(pybullet.DIRECT)
    body = pybullet.loadURDF(urdf, physicsClientId=client)
    links = {
        pybullet.getJointInfo(body, i, physicsClientId=client)[12]: i
        for i in range(pybullet.getNumJoints(body, physicsClientId=client))
    }
    found = pybullet.getMeshData(body, links[b"hand"], physicsClientId=client)[1]
    pybullet.disconnect(client)
    return np.array(found)


def test_an_stl_file_that_is_a_text_is_a_shape_to_pybullet_too(tmp_path) -> None:
    (tmp_path / "hand.STL").write_text(stl(CORNERS))
    params = with_hand(tmp_path, 'filename="hand.STL" scale="-0.1 0.1 0.2"')
    robot = robot_from(params)
    wanted = CORNERS * [-0.1, 0.1, 0.2]
    assert same_corners(hand_of(robot), wanted)
    assert same_corners(hand_in_pybullet(str(robot.urdf)), wanted)
    plain = load_robot(Path(params.urdf), "hand")
    with pytest.raises(RobotError, match=r"arm\.urdf: .* link 'hand' is none to PyBullet: write"):
        Scene(plain).world()


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("hand.stl", "solid hand\nendsolid hand\n", "has no triangles"),
        ("hand.stl", stl(CORNERS).replace("1.0 0.0 0.0", "one 0.0 0.0"), "one"),
        ("hand.stl", stl(CORNERS).replace("1.0 0.0 0.0", "nan 0.0 0.0"), "has no triangles"),
        ("hand.stl", stl(CORNERS * [1, 1, 0]), "has no volume"),
        ("hand.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "a corner that is not there"),
        ("hand.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "has no faces"),
        ("hand.obj", "v 0 0 0\nv 1 0 0\nv 0 1 nan\nf 1 2 3\n", "no finite numbers"),
        ("hand.ply", "ply\n", "must be OBJ or STL"),
    ],
)
def test_a_broken_mesh_is_one_line_with_the_users_file(tmp_path, name, content, said) -> None:
    """PyBullet reads past the corners of some, and ends the process with others."""
    (tmp_path / name).write_text(content)
    with pytest.raises(RobotError, match=said) as caught:
        robot_from(with_hand(tmp_path, f'filename="{name}"'))
    assert str(caught.value).startswith(str(tmp_path / "arm.urdf")) or name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_without_a_velocity_no_robot_is_made(tmp_path) -> None:
    file = tmp_path / "arm.urdf"
    file.write_text(ARM.replace('velocity="2"', ""))
    with pytest.raises(RobotError, match="velocity"):
        robot_from(RobotParams(urdf=str(file), tool_link="hand", may_touch=FOUND))


BOX = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="0.1"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="pa" count="12">0 0 0 1 0 0 0 2 0 0 0 3</float_array>
<technique_common><accessor source="#pa" count="4" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<source id="n"><float_array id="na" count="3">0 0 1</float_array>
<technique_common><accessor source="#na" count="1" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/>
<input semantic="NORMAL" source="#n" offset="1"/>
<p>0 0 2 0 1 0 0 0 1 0 3 0 1 0 2 0 3 0 2 0 0 0 3 0</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node id="a"><translate>0 0 5</translate>
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>
"""


def test_a_mesh_may_be_a_link_into_a_cache(tmp_path) -> None:
    """Whose files are named by what is in them."""
    (tmp_path / "blobs").mkdir()
    (tmp_path / "blobs" / "5d41402a").write_text(BOX)
    (tmp_path / "tip.dae").symlink_to(tmp_path / "blobs" / "5d41402a")
    params = with_hand(tmp_path, 'filename="tip.dae"')
    assert hand_of(robot_from(params)).shape == (4, 3)


@pytest.mark.parametrize("up", ["Z_UP", "Y_UP", "X_UP", None])
def test_a_collada_mesh_is_the_one_that_pybullet_reads(tmp_path, up: str | None) -> None:
    upright = "<up_axis>Z_UP</up_axis>"
    (tmp_path / "tip.dae").write_text(
        BOX.replace(upright, upright.replace("Z_UP", up) if up else "")
    )
    params = with_hand(tmp_path, 'filename="tip.dae" scale="2 2 2"')
    # a tenth of a metre a unit, doubled, half a metre up
    wanted = 0.2 * np.array([[0, 0, 5], [1, 0, 5], [0, 2, 5], [0, 0, 8]], float)
    assert same_corners(hand_of(robot_from(params)), wanted)
    assert same_corners(hand_in_pybullet(params.urdf), wanted)


@pytest.mark.parametrize(
    ("kind", "faces"),
    [
        ("tristrips", [(0, 1, 2), (3, 2, 1)]),
        ("trifans", [(0, 1, 2), (0, 2, 3)]),
        ("polygons", [(0, 1, 2, 3)]),
    ],
)
def test_strips_fans_and_polygons_of_a_collada_mesh_are_faces(tmp_path, kind, faces) -> None:
    """Two sheets of four corners each, the second one at the first one's height."""
    sheets = "0 0 1 0 2 0 3 0</p><p>0 0 2 0 1 0 3 0"
    text = BOX.replace("triangles", kind)
    start, end = text.index("<p>") + 3, text.index("</p>")
    (tmp_path / "tip.dae").write_text(text[:start] + sheets + text[end:])
    lines = as_obj(tmp_path / "tip.dae").splitlines()
    found = [tuple(int(k) - 1 for k in line.split()[1:]) for line in lines if line[0] == "f"]
    assert found[: len(faces)] == faces
    assert len(found) == 2 * len(faces)
    assert {k for face in found[len(faces) :] for k in face} == {0, 1, 2, 3}


def same_corners(found: np.ndarray, wanted: np.ndarray) -> bool:
    away = np.linalg.norm(found[:, None] - wanted, axis=-1)
    return bool(max(away.min(axis=0).max(), away.min(axis=1).max()) < 1e-6)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "no XML"),
        ("<COLLADA/>", "no scene"),
        (BOX.replace("<triangles", "<lines").replace("</triangles", "</lines"), "without faces"),
        (BOX.replace("0 3 0 2 0 0 0 3 0", "0 9 0 2 0 0 0 3 0"), "a corner that is not there"),
        (BOX.replace('url="#g"', 'url="#h"'), "h"),
        (BOX.replace("0 2 0 0", "0 2 zero 0"), "zero"),
        (BOX.replace("0 3 0 2 0 0 0 3 0", "0 3 0 2 0 0 0 -1 0"), "a corner that is not there"),
        (BOX.replace('semantic="VERTEX"', 'semantic="TEXCOORD"'), "<triangles> without VERTEX"),
        (BOX.replace('semantic="POSITION"', 'semantic="NORMAL"'), "<vertices> without POSITION"),
        (BOX.replace("instance_geometry", "instance_controller"), "<instance_controller>"),
        (BOX.replace("<instance_geometry", '<instance_node url="#a"/><instance_geometry'), "below"),
        (BOX.replace("<p>0", "<ph><p>0").replace("</p>", "</p></ph>"), "<ph>"),
        (BOX.replace("triangles", "patches"), "<patches> is not read"),
        (BOX.replace("<mesh>", "<convex_mesh/><mesh>"), "<convex_mesh> is not read"),
        (BOX.replace("translate>", "lookat>"), "<lookat> is not read"),
        (BOX.replace("0 2 0 0 0 3<", "0 2 nan 0 0 3<"), "no finite numbers"),
        (BOX.replace("<translate>0 0 5</translate>", "<rotate>0 0 0 9</rotate>"), "length 0"),
        (BOX.replace("triangles", "polylist").replace("<p>", "<vcount>3 3 3</vcount><p>"), "9 cor"),
    ],
)
def test_a_mesh_that_can_not_be_read_is_named(tmp_path, content, said) -> None:
    (tmp_path / "tip.dae").write_text(content)
    with pytest.raises(RobotError, match=rf"tip\.dae: .*{said}.*: write it as OBJ or STL"):
        robot_from(with_hand(tmp_path, 'filename="tip.dae"'))
