"""The arm of somebody's URDF: what PyBullet has of the whole robot with the other joints held, the
pairs that may touch, meshes that PyBullet alone reads.
"""

from pathlib import Path

import numpy as np
import pybullet
import pytest
from tests.robot.test_description import ARM

from constraint_geodesics.params import PoseParams, RobotParams
from constraint_geodesics.robot.kinematics import RobotError
from constraint_geodesics.scene import arm
from constraint_geodesics.scene.arm import FOUND, load_arm
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
    assert again.robot.urdf == first.robot.urdf
    other = PANDA.model_copy(update={"limits_rad": {"panda_joint1": (-1.0, 1.0)}})
    with pytest.raises(pytest.fail.Exception):
        load_arm(other)


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


def test_a_collada_mesh_is_the_one_that_pybullet_reads(tmp_path) -> None:
    (tmp_path / "tip.dae").write_text(BOX)
    file = tmp_path / "arm.urdf"
    shape = '<collision><geometry><mesh filename="tip.dae" scale="2 2 2"/></geometry></collision>'
    file.write_text(ARM.replace('<link name="hand"/>', f'<link name="hand">{shape}</link>'))
    robot = robot_from(RobotParams(urdf=str(file), tool_link="hand", may_touch=FOUND))
    link = next(own for own in read_pieces(robot.urdf) if own.name == "hand")
    (piece,) = (own.at(np.linalg.inv(link.pose)) for own in link.pieces)
    # a tenth of a metre a unit, doubled, half a metre up
    wanted = 0.2 * np.array([[0, 0, 5], [1, 0, 5], [0, 2, 5], [0, 0, 8]], float)
    assert same_corners(piece.corners, wanted)
    client = pybullet.connect(pybullet.DIRECT)
    body = pybullet.loadURDF(str(file), physicsClientId=client)
    links = {
        pybullet.getJointInfo(body, i, physicsClientId=client)[12]: i
        for i in range(pybullet.getNumJoints(body, physicsClientId=client))
    }
    theirs = pybullet.getMeshData(body, links[b"hand"], physicsClientId=client)[1]
    assert same_corners(np.array(theirs), wanted)
    pybullet.disconnect(client)


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
        (BOX.replace("Z_UP", "UP"), "UP"),
    ],
)
def test_a_mesh_that_can_not_be_read_is_named(tmp_path, content, said) -> None:
    (tmp_path / "tip.dae").write_text(content)
    file = tmp_path / "arm.urdf"
    shape = '<collision><geometry><mesh filename="tip.dae"/></geometry></collision>'
    file.write_text(ARM.replace('<link name="hand"/>', f'<link name="hand">{shape}</link>'))
    with pytest.raises(RobotError, match=rf"tip\.dae: .*{said}.*: write it as OBJ or STL"):
        robot_from(RobotParams(urdf=str(file), tool_link="hand", may_touch=FOUND))
