"""Every fault of a URDF is one line that names file, element and mend; and an arm written as a URDF
of its own is the same arm.
"""

import re
from pathlib import Path

import numpy as np
import pytest

from constraint_geodesics.params import RobotParams
from constraint_geodesics.robot.arm_file import write_arm
from constraint_geodesics.robot.description import arm_to, find_mesh, read_description
from constraint_geodesics.robot.kinematics import RobotError, load_robot, rotation_from_rpy
from constraint_geodesics.scene.scene import robot_from
from constraint_geodesics.scene.urdf import data_path
from constraint_geodesics.scene.world import World

ARM = """<robot name="arm">
  <link name="base"/>
  <link name="upper">
    <collision><origin xyz="0 0 0.5"/><geometry><box size="0.1 0.1 1"/></geometry></collision>
  </link>
  <link name="slide"/>
  <link name="hand"/>
  <link name="left"/>
  <link name="right"/>
  <joint name="turn" type="revolute">
    <parent link="base"/><child link="upper"/><origin xyz="0 0 0.2" rpy="0.3 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-2" upper="2" velocity="1" effort="1"/>
  </joint>
  <joint name="lift" type="prismatic">
    <parent link="upper"/><child link="slide"/><origin xyz="0 0 1" rpy="0 1.5707963267948966 0.4"/>
    <axis xyz="0 1 0"/><limit lower="0.1" upper="0.5" velocity="1" effort="1"/>
  </joint>
  <joint name="roll" type="continuous">
    <parent link="slide"/><child link="hand"/><origin xyz="0.1 0 0"/><axis xyz="1 1 0"/>
    <limit velocity="2" effort="1"/>
  </joint>
  <joint name="grip" type="prismatic">
    <parent link="hand"/><child link="left"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.04" velocity="1" effort="1"/>
  </joint>
  <joint name="follow" type="prismatic">
    <parent link="hand"/><child link="right"/><axis xyz="0 -1 0"/>
    <limit lower="0" upper="0.04" velocity="1" effort="1"/>
    <mimic joint="grip" multiplier="0.5" offset="0.01"/>
  </joint>
</robot>
"""
TURN_LIMIT = '<limit lower="-2" upper="2" velocity="1" effort="1"/>'
LIFT_LIMIT = '<limit lower="0.1" upper="0.5" velocity="1" effort="1"/>'
BOUNDED = ARM.replace("continuous", "revolute").replace(
    '<limit velocity="2"', '<limit lower="-1" upper="1" velocity="2"'
)
FOLLOW = '<mimic joint="grip" multiplier="0.5" offset="0.01"/>'
EXTRA = '<joint name="{}" type="fixed"><parent link="{}"/><child link="{}"/></joint></robot>'


def mesh(attributes: str) -> tuple[str, str]:
    return '<box size="0.1 0.1 1"/>', f"<mesh {attributes}/>"


FAULTS = {
    "not XML": ("</robot>", "", "no XML", "export"),
    "empty": (ARM, "", "no XML", "export"),
    "another root": ('<robot name="arm">', "<sdf>", "no XML", "export"),
    "no robot": (ARM, "<sdf/>", "<sdf>", "<robot>"),
    "xacro": ('name="hand"', 'name="${hand}"', "xacro", "run `xacro"),
    "no links": (ARM, '<robot name="arm"/>', "<link>", "add"),
    "nameless link": ('<link name="slide"/>', "<link/>", "link number 3", "give it one"),
    "link twice": ('<link name="slide"/>', '<link name="hand"/>', "'hand'", "rename"),
    "nameless joint": ('<joint name="lift"', "<joint", "joint number 2", "give it one"),
    "joint twice": ('name="lift"', 'name="turn"', "'turn'", "rename"),
    "no type": (
        'type="prismatic">\n    <parent link="upper"',
        '><parent link="upper"',
        "'lift'",
        "revolute",
    ),
    "unknown type": ('type="continuous"', 'type="hinge"', "'hinge'", "revolute"),
    "no parent": ('<parent link="slide"/>', "", "'roll'", "name the link"),
    "no child": ('<child link="hand"/>', "", "'roll'", "name the link"),
    "unknown parent": ('<parent link="slide"/>', '<parent link="sled"/>', "'sled'", "no such link"),
    "unknown child": ('<child link="hand"/>', '<child link="hnad"/>', "'hnad'", "no such link"),
    "two parents": ("</robot>", EXTRA.format("more", "base", "hand"), "'more'", "remove"),
    "two roots": ("</robot>", '<link name="alone"/></robot>', "'alone'", "join"),
    "all in a circle": ("</robot>", EXTRA.format("back", "hand", "base"), "close a circle", "tree"),
    "a circle beside": (
        "</robot>",
        '<link name="x"/><link name="y"/>'
        '<joint name="xy" type="fixed"><parent link="x"/><child link="y"/></joint>'
        + EXTRA.format("yx", "y", "x"),
        "'xy' and 'yx'",
        "tree",
    ),
    "on itself": ("</robot>", '<link name="x"/>' + EXTRA.format("xx", "x", "x"), "'xx'", "tree"),
    "zero axis": ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>', "'turn'", "direction"),
    "axis of two": ('<axis xyz="0 0 1"/>', '<axis xyz="0 1"/>', "'0 1'", "three numbers"),
    "axis not finite": ('<axis xyz="0 0 1"/>', '<axis xyz="0 nan 1"/>', "nan", "three numbers"),
    "origin of words": ('xyz="0 0 0.2"', 'xyz="here"', "'here'", "three numbers"),
    "axis too long": ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 1e200"/>', "1e200", "three numbers"),
    "endless name": ('name="left"', f'name="{"x" * 3000}"', "more than 250", "shorten"),
    "origin infinite": ('rpy="0.3 0 0"', 'rpy="inf 0 0"', "inf", "three numbers"),
    "limits of words": (TURN_LIMIT, '<limit lower="low" upper="2"/>', "'low'", "number"),
    "limits not finite": (TURN_LIMIT, '<limit lower="-inf" upper="2"/>', "'-inf'", "number"),
    "velocity NaN": (TURN_LIMIT, TURN_LIMIT.replace('ty="1"', 'ty="nan"'), "nan", "number"),
    "follows nobody": ('<mimic joint="grip"', '<mimic joint="grap"', "'grap'", "remove"),
    "follows itself": ('<mimic joint="grip"', '<mimic joint="follow"', "'follow'", "remove"),
    "multiplier of words": ('multiplier="0.5"', 'multiplier="half"', "'half'", "number"),
    "missing mesh": (
        *mesh('filename="package://arm/upper.stl"'),
        "package://arm/upper.stl",
        "put it",
    ),
    "mesh without name": (*mesh(""), "upper", "put it"),
    "mesh of scale 0": (*mesh('filename="x.stl" scale="1 0 1"'), "scale 0", "true scale"),
    "scale of two": (*mesh('filename="x.stl" scale="1 1"'), "'1 1'", "three numbers"),
    "collision's origin": (
        '<origin xyz="0 0 0.5"/>',
        '<origin xyz="0 0"/>',
        "'upper'",
        "three numbers",
    ),
}


UNFIT = {
    "no limits": (TURN_LIMIT, "", "'turn' has no lower", "continuous"),
    "no upper": (TURN_LIMIT, '<limit lower="-2" velocity="1"/>', "upper", "continuous"),
    "crossed limits": (TURN_LIMIT, '<limit lower="2" upper="-2"/>', "2 and -2", "swap"),
    "equal limits": (TURN_LIMIT, '<limit lower="0" upper="0"/>', "0 and 0", "fixed"),
    "velocity 0": (TURN_LIMIT, TURN_LIMIT.replace('ty="1"', 'ty="0"'), "velocity 0", "top speed"),
    "velocity below 0": (TURN_LIMIT, TURN_LIMIT.replace('ty="1"', 'ty="-1"'), "-1", "top speed"),
    "lift without limits": (LIFT_LIMIT, "", "'lift' has no lower", "or hold it"),
    "lift without bounds": (LIFT_LIMIT, '<limit lower="-1e16" upper="1e16"/>', "1e+16", "true"),
    "floating": ('type="revolute"', 'type="floating"', "'turn'", "make it fixed"),
    "planar": ('type="revolute"', 'type="planar"', "'turn'", "make it fixed"),
    "follows the arm": (
        FOLLOW,
        '<mimic joint="turn" offset="0.5"/>',
        "'follow' follows 'turn'",
        "--hold follow=0.5",
    ),
    "follows the arm in the end": (
        '<axis xyz="0 1 0"/>\n    <limit lower="0" upper',
        '<axis xyz="0 1 0"/><mimic joint="roll"/><limit lower="0" upper',
        "'grip' follows 'roll'",
        "--hold grip=0",
    ),
}
"""Faults of joints on the chain to the hand, or of those that follow them."""


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_one_line_with_file_element_and_mend(name: str, tmp_path: Path) -> None:
    file, element, mend = broken(FAULTS[name], tmp_path)
    with pytest.raises(RobotError) as caught:
        read_description(file)
    check_line(str(caught.value), file, element, mend)


@pytest.mark.parametrize("name", UNFIT)
def test_a_joint_that_can_not_move_is_one_line_where_it_is_to(name: str, tmp_path: Path) -> None:
    file, element, mend = broken(UNFIT[name], tmp_path)
    description = read_description(file)
    with pytest.raises(RobotError) as caught:
        arm_to(description, "hand")
    check_line(str(caught.value), file, element, mend)


def broken(fault: tuple[str, str, str, str], folder: Path) -> tuple[Path, str, str]:
    """A file with a fault, and what is to be said of it."""
    before, after, element, mend = fault
    assert before in ARM
    file = folder / "arm.urdf"
    file.write_text(ARM.replace(before, after))
    return file, element, mend


def check_line(line: str, file: Path, element: str, mend: str) -> None:
    assert "\n" not in line
    assert line.startswith(f"{file}: ")
    assert element in line
    assert mend in line.rsplit(": ", 1)[-1]


@pytest.mark.parametrize("made", ["nothing", "folder", "bytes"])
def test_what_is_no_file_is_said(made: str, tmp_path: Path) -> None:
    file = tmp_path / "arm.urdf"
    if made == "folder":
        file.mkdir()
    elif made == "bytes":
        file.write_bytes(bytes(range(256)))
    with pytest.raises(RobotError, match=re.escape(str(file))):
        read_description(file)


@pytest.fixture
def arm_file(tmp_path: Path) -> Path:
    file = tmp_path / "arm.urdf"
    file.write_text(ARM)
    return file


@pytest.mark.parametrize(
    ("link", "held", "said"),
    [
        ("nose", {}, "no link 'nose'"),
        ("base", {}, "no joint that moves"),
        ("right", {}, "follows 'grip'"),
        ("hand", {"nose": 0.0}, "turn, lift, roll, grip, follow"),
        ("hand", {"lift": 0.0}, "0.1 to 0.5 m"),
        ("hand", {"turn": float("nan")}, "nan: give a finite number"),
        ("hand", {"roll": float("inf")}, "inf: give a finite number"),
        ("hand", {"turn": 0.0, "lift": 0.2, "roll": 0.0}, "no joint that moves"),
    ],
)
def test_an_arm_that_can_not_be_is_refused(
    link: str, held: dict[str, float], said: str, arm_file: Path
) -> None:
    with pytest.raises(RobotError, match=re.escape(said)):
        arm_to(read_description(arm_file), link, held)


def test_joints_beside_the_chain_rest_or_follow(arm_file: Path) -> None:
    description = read_description(arm_file)
    assert arm_to(description, "hand").held == {"grip": 0.0, "follow": 0.01}
    arm = arm_to(description, "hand", {"grip": 0.03, "turn": 0.5})
    assert [joint.name for joint in arm.moved] == ["lift", "roll"]
    assert arm.held == pytest.approx({"turn": 0.5, "grip": 0.03, "follow": 0.025})
    assert arm_to(description, "upper").held["lift"] == 0.1  # 0 is beyond its limits


GRIP_LIMIT = '<limit lower="0" upper="0.04" velocity="1" effort="1"/>'


@pytest.mark.parametrize(
    "limit",
    ["", '<limit velocity="0"/>', '<limit lower="0" upper="0"/>', '<limit lower="1" upper="-1"/>'],
)
def test_limits_of_joints_that_stand_still_are_not_asked_for(limit: str, tmp_path: Path) -> None:
    file = tmp_path / "arm.urdf"
    still = ARM.replace(GRIP_LIMIT, limit).replace(TURN_LIMIT, limit)
    assert still.count(limit) >= 3
    file.write_text(still)
    description = read_description(file)
    arm = arm_to(description, "hand", {"turn": 0.0})
    assert arm.held == {"turn": 0.0, "grip": 0.0, "follow": 0.01}
    assert load_robot(*write_arm(arm, tmp_path)).joint_names == ("lift", "roll")
    with pytest.raises(RobotError, match="'turn'"):
        arm_to(description, "hand")


def test_a_joint_that_follows_the_arm_is_refused_however_the_robot_is_named(tmp_path: Path) -> None:
    file = tmp_path / "arm.urdf"
    file.write_text(ARM.replace('<mimic joint="grip"', '<mimic joint="turn"'))
    with pytest.raises(RobotError, match="'follow' follows 'turn'"):
        robot_from(RobotParams(urdf=str(file), tool_link="hand"))


def test_what_follows_a_joint_of_the_arm_may_be_held_on_purpose(tmp_path: Path) -> None:
    file = tmp_path / "arm.urdf"
    file.write_text(ARM.replace('<mimic joint="grip"', '<mimic joint="turn"'))
    description = read_description(file)
    assert arm_to(description, "hand", {"follow": 0.02}).held["follow"] == 0.02
    assert arm_to(description, "hand", {"turn": 0.04}).held["follow"] == pytest.approx(0.03)


def test_limits_that_are_none_mean_once_either_way(tmp_path: Path) -> None:
    file = tmp_path / "arm.urdf"
    wide = '<limit lower="-1e16" upper="1e16" velocity="1"/>'
    file.write_text(ARM.replace(TURN_LIMIT, wide))
    arm = arm_to(read_description(file), "hand")
    robot = load_robot(*write_arm(arm, tmp_path))
    np.testing.assert_allclose([robot.lower[0], robot.upper[0]], [-2.0 * np.pi, 2.0 * np.pi])


def test_meshes_are_beside_the_urdf_above_it_or_where_ros_keeps_them(tmp_path, monkeypatch) -> None:
    urdf, current = tmp_path / "robots" / "arm" / "arm.urdf", tmp_path / "current"
    places = {
        "beside": urdf.parent / "pack" / "a.stl",
        "above": tmp_path / "robots" / "pack" / "a.stl",
        "ros": tmp_path / "ros" / "pack" / "a.stl",
        "itself": tmp_path / "own" / "pack" / "a.stl",
        "ament": tmp_path / "ament" / "share" / "pack" / "a.stl",
        "current": current / "pack" / "a.stl",
    }
    for place in places.values():
        place.parent.mkdir(parents=True)
        place.touch()
    monkeypatch.chdir(current)
    for name, folders in (
        ("ROS_PACKAGE_PATH", [".", "", tmp_path / "ros", tmp_path / "own" / "pack"]),
        ("AMENT_PREFIX_PATH", [tmp_path / "ament"]),
    ):
        monkeypatch.setenv(name, ":".join(map(str, folders)))
    for name in ("beside", "above"):
        for address in ("pack/a.stl", "package://pack/a.stl"):
            assert find_mesh(address, urdf) == places[name]
        places[name].unlink()
    assert find_mesh("pack/a.stl", urdf) is None
    for name in ("ros", "itself", "ament"):
        assert find_mesh("package://pack/a.stl", urdf) == places[name]
        places[name].unlink()
    assert find_mesh("package://pack/a.stl", urdf) is None
    assert find_mesh(f"file://{places['current']}", urdf) == places["current"]
    assert find_mesh(str(places["current"]), urdf) == places["current"]


def test_an_arm_written_alone_is_the_same_arm(arm_file: Path, tmp_path: Path) -> None:
    tool = np.eye(4)
    tool[:3, :3], tool[:3, 3] = rotation_from_rpy(np.array([0.1, np.pi / 2, 0.3])), (0.1, 0.2, 0.3)
    whole = load_robot(arm_file, "hand")
    arm = arm_to(read_description(arm_file), "hand", {"turn": 0.7})
    file, link = write_arm(arm, tmp_path / "arms", tool)
    assert write_arm(arm, tmp_path / "arms", tool) == (file, link)
    robot = load_robot(file, link)
    assert robot.joint_names == ("lift", "roll")
    np.testing.assert_allclose(robot.upper, [0.5, 2.0 * np.pi])
    q = robot.sample(20, np.random.default_rng(0))
    position, rotation = whole.forward(np.column_stack([np.full(20, 0.7), q]))
    there, turned = robot.forward(q)
    np.testing.assert_allclose(there, position + rotation @ tool[:3, 3], atol=1e-12)
    np.testing.assert_allclose(turned, rotation @ tool[:3, :3], atol=1e-12)


@pytest.mark.parametrize("axis", ["0.7071 0.7071 0", "0 2 0"])
def test_an_axis_of_any_length_is_a_direction(arm_file: Path, axis: str) -> None:
    """PyBullet slides links by the axis as it is written."""
    own = f'<axis xyz="{axis}"/>{LIFT_LIMIT}'
    arm_file.write_text(BOUNDED.replace(f'<axis xyz="0 1 0"/>{LIFT_LIMIT}', own))
    robot = robot_from(RobotParams(urdf=str(arm_file), tool_link="hand"))
    written = load_robot(arm_file, "hand")
    with World(robot) as world:
        for q in robot.sample(5, np.random.default_rng(0)):
            (there,) = world.link_poses(q, ["hand"])
            np.testing.assert_allclose(robot.forward(q)[0], written.forward(q)[0], atol=1e-12)
            np.testing.assert_allclose(there[:3, 3], written.forward(q)[0], atol=1e-7)


def test_a_joint_that_rests_beside_0_is_held_there(arm_file: Path) -> None:
    """By PyBullet too, of a robot that parameters name by its URDF alone."""
    arm_file.write_text(BOUNDED.replace('lower="0" upper="0.04"', 'lower="0.03" upper="0.04"'))
    robot = robot_from(RobotParams(urdf=str(arm_file), tool_link="hand"))
    q = np.array([0.1, 0.2, 0.3])
    with World(robot) as world:
        hand, left = world.link_poses(q, ["hand", "left"])
    np.testing.assert_allclose((np.linalg.inv(hand) @ left)[:3, 3], (0.0, 0.03, 0.0), atol=1e-6)


def test_a_gripper_is_held_where_pybullet_puts_it(tmp_path: Path) -> None:
    held = {"panda_finger_joint1": 0.03, "panda_finger_joint2": 0.01, "panda_joint4": -1.0}
    description = read_description(data_path() / "franka_panda" / "panda.urdf")
    file, link = write_arm(arm_to(description, "panda_grasptarget", held), tmp_path)
    robot = load_robot(file, link)
    links = ["panda_leftfinger", "panda_rightfinger", "panda_link3", "panda_hand"]
    whole = (
        load_robot(description.file, "panda_leftfinger"),
        load_robot(description.file, "panda_rightfinger"),
    )
    q = robot.sample(1, np.random.default_rng(0))[0]
    full = np.insert(q, 3, -1.0)
    with World(robot) as world:
        poses = dict(zip(links, world.link_poses(q, links), strict=True))
    for arm, name in zip(whole, links[:2], strict=True):
        position, rotation = arm.forward(np.append(full, held[arm.joint_names[-1]]))
        np.testing.assert_allclose(poses[name][:3, 3], position, atol=2e-6)
        np.testing.assert_allclose(poses[name][:3, :3], rotation, atol=2e-5)
