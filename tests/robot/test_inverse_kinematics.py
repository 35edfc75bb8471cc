"""Inverse kinematics against what is known of it: every solution has the pose, the one that the
pose was made of is among them, and a search from many times as many seeds finds no more.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from constraint_geodesics.robot.inverse_kinematics import SAME, Search, solutions, spread
from constraint_geodesics.robot.kinematics import SerialRobot, load_robot
from constraint_geodesics.scene.urdf import find_urdf

MANY = Search(seeds=4096, iterations=40)
PLANAR = """<robot name="planar">
<link name="base"/><link name="a"/><link name="b"/><link name="tool"/>
<joint name="one" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="-6.3" upper="6.3" velocity="1" effort="1"/></joint>
<joint name="two" type="revolute"><origin xyz="1 0 0"/><parent link="a"/><child link="b"/>
<axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="1" effort="1"/></joint>
<joint name="three" type="prismatic"><origin xyz="0.5 0 0"/><parent link="b"/><child link="tool"/>
<axis xyz="0 0 1"/><limit lower="-0.1" upper="0.4" velocity="1" effort="1"/></joint></robot>"""

WRIST = """<link name="wrist"/><joint name="four" type="revolute"><parent link="wrist"/>
<child link="tool"/><axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="1" effort="1"/></joint>
</robot>"""
SCARA = PLANAR.replace('<child link="tool"/>', '<child link="wrist"/>').replace("</robot>", WRIST)


def robots() -> dict[str, SerialRobot]:
    return {
        "xarm6": load_robot(find_urdf("xarm/xarm6_robot.urdf"), "link6"),
        "iiwa": load_robot(find_urdf("kuka_iiwa/model.urdf"), "lbr_iiwa_link_7"),
        "panda": load_robot(find_urdf("franka_panda/panda.urdf"), "panda_link8"),
    }


def among(q: np.ndarray, found: np.ndarray) -> bool:
    return bool((np.abs(found - q).max(axis=1) < SAME).any())


@pytest.mark.parametrize("name", ["xarm6", "iiwa", "panda"])
def test_every_solution_has_the_pose_and_keeps_the_limits(name: str) -> None:
    robot = robots()[name]
    for q in robot.sample(40, np.random.default_rng(0)):
        position, rotation = robot.forward(q)
        found = solutions(robot, position, rotation)
        assert len(found)
        assert robot.limit_distance(found).min() >= 0.0
        there, turned = robot.forward(found)
        np.testing.assert_allclose(there, np.broadcast_to(position, there.shape), atol=1e-9)
        np.testing.assert_allclose(turned, np.broadcast_to(rotation, turned.shape), atol=1e-9)


def test_all_branches_of_six_joints_are_found() -> None:
    robot = robots()["xarm6"]
    complete = own = 0
    for q in robot.sample(100, np.random.default_rng(1)):
        pose = robot.forward(q)
        found, all_of_them = solutions(robot, *pose), solutions(robot, *pose, MANY)
        own += among(q, found)
        complete += all(among(other, found) for other in all_of_them)
    assert own >= 99
    assert complete >= 99


def test_whole_turns_are_solutions_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(PLANAR)
    robot = load_robot(tmp_path / "arm.urdf", "tool")
    q = np.array([0.5, 1.0, 0.2])
    found = solutions(robot, *robot.forward(q))
    # the elbow's other side would turn the tool; the first joint turns on by whole turns
    np.testing.assert_allclose(
        found[np.argsort(found[:, 0])], [[0.5 - 2.0 * np.pi, 1.0, 0.2], q], atol=1e-6
    )


def test_half_a_turn_off_is_no_solution(tmp_path: Path) -> None:
    # all axes are upright, so nothing turns the tool over, and the way there has no direction
    (tmp_path / "arm.urdf").write_text(SCARA)
    robot = load_robot(tmp_path / "arm.urdf", "tool")
    position, rotation = robot.forward(np.array([0.5, 1.0, 0.2, 0.3]))
    assert len(solutions(robot, position, rotation))
    assert not len(solutions(robot, position, rotation @ np.diag([1.0, -1.0, -1.0])))


def test_a_pose_out_of_reach_has_no_solution() -> None:
    robot = robots()["xarm6"]
    assert not len(solutions(robot, np.array([3.0, 0.0, 0.0]), np.eye(3)))


def test_representatives_are_far_apart() -> None:
    robot = robots()["iiwa"]
    found = solutions(robot, *robot.forward(np.full(7, 0.3)), Search(seeds=512))
    few = spread(found, 16)
    assert len(few) == 16
    away = np.linalg.norm(few[:, None] - few, axis=2)[np.triu_indices(16, 1)].min()
    assert (
        away > np.linalg.norm(found[:16, None] - found[:16], axis=2)[np.triu_indices(16, 1)].min()
    )
    np.testing.assert_array_equal(spread(found[:3], 16), found[:3])


def test_a_pose_just_out_of_reach_has_no_solution() -> None:
    """Of an arm of three joints any pose is, but those that it has."""
    robot = robots()["xarm6"]
    stretched = np.array([0.3, 1.2, -0.2, 0.0, 0.5, 0.0])
    position, rotation = robot.forward(stretched)
    assert len(solutions(robot, position, rotation))
    reach = np.linalg.norm(
        robot.forward(robot.sample(200_000, np.random.default_rng(0)))[0], axis=1
    )
    far = position * (reach.max() + 0.2) / np.linalg.norm(position)
    assert not len(solutions(robot, far, rotation))


def test_a_planar_arm_reaches_a_pose_or_not_by_a_thousandth_of_a_millimetre(tmp_path) -> None:
    urdf = tmp_path / "planar.urdf"
    urdf.write_text(PLANAR)
    robot = load_robot(urdf, "tool")
    position, rotation = robot.forward(np.array([0.4, 1.0, 0.1]))
    assert len(solutions(robot, position, rotation))
    # in its plane the tool's direction and distance hang together
    for off in (1e-6, 5e-5):
        assert not len(solutions(robot, position * (1.0 + off), rotation))


def test_what_rounding_puts_beyond_a_limit_is_found(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(SCARA)
    robot = load_robot(tmp_path / "arm.urdf", "tool")
    for q in robot.sample(20, np.random.default_rng(4)):
        for at in (robot.lower, robot.upper):
            q[2:] = at[2:]  # the lift and the wrist
            found = solutions(robot, *robot.forward(q))
            assert among(q, found)
            assert robot.limit_distance(found).min() >= 0.0


def test_of_many_whole_turns_the_nearest_are_given() -> None:
    robot = robots()["xarm6"]
    wide = replace(robot, lower=np.full(6, -1e16), upper=np.full(6, 1e16))
    q = robot.sample(1, np.random.default_rng(3))[0]
    near = q + 100.0 * np.pi
    found = solutions(wide, *robot.forward(q), near=near)
    assert 0 < len(found) <= 16 * 3**6
    assert np.abs(found - near).max() < 3.0 * np.pi + 1e-6
    assert among(near, found)
