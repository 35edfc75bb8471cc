from pathlib import Path

import numpy as np
import pytest
from numba import njit

from constraint_geodesics.robot.kernels import (
    LANES,
    Lanes,
    new_posture,
    pose_of,
    poses_of,
    sine_cosine,
)
from constraint_geodesics.robot.kinematics import (
    RobotError,
    load_robot,
    rotation_about,
    rotation_from_rpy,
)
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.urdf import data_path

ROBOTS = ["scene", "kuka_scene"]
SLIDE = """<robot name="slide"><link name="base"/><link name="tool"/><joint name="slide"
type="prismatic"><parent link="base"/><child link="tool"/><axis xyz="0 0 1"/>
<origin xyz="0 0.1 0.2"/><limit lower="-0.5" upper="0.5" velocity="1"/></joint></robot>"""


@pytest.mark.parametrize("place", range(3))
def test_a_rotation_about_an_axis_is_that_of_its_angle(place: int) -> None:
    rpy = 0.7 * np.eye(3)[place]
    wanted = rotation_from_rpy(rpy)
    np.testing.assert_allclose(rotation_about(3.0 * rpy, 0.7), wanted, atol=1e-15)


@pytest.mark.parametrize("name", ROBOTS)
def test_poses_agree_with_pybullet(name: str, request: pytest.FixtureRequest) -> None:
    scene: Scene = request.getfixturevalue(name)
    q = scene.robot.sample(200, np.random.default_rng(0))
    with scene.world() as world:
        labels = world.label(q)
    position, rotation = scene.robot.forward(q)
    np.testing.assert_allclose(position, labels.position, atol=2e-6)
    for quaternion, matrix in zip(labels.quaternion, rotation, strict=True):
        x, y, z, w = quaternion
        np.testing.assert_allclose(matrix[2, 2], 1 - 2 * (x * x + y * y), atol=2e-5)
        np.testing.assert_allclose(matrix[1, 0], 2 * (x * y + z * w), atol=2e-5)


@pytest.mark.parametrize("name", ROBOTS)
def test_the_jacobian_is_the_poses_derivative(name: str, request: pytest.FixtureRequest) -> None:
    robot = request.getfixturevalue(name).robot
    q = robot.sample(20, np.random.default_rng(1))
    jacobian, (_, rotation), step = robot.jacobian(q), robot.forward(q), 1e-6
    for joint in range(robot.dof):
        shift = step * np.eye(robot.dof)[joint]
        (ahead, turned_ahead), (behind, turned_behind) = (
            robot.forward(q + shift),
            robot.forward(q - shift),
        )
        np.testing.assert_allclose(jacobian[:, :3, joint], (ahead - behind) / (2 * step), atol=1e-8)
        spin = (turned_ahead - turned_behind) / (2 * step) @ rotation.transpose(0, 2, 1)
        np.testing.assert_allclose(jacobian[:, 5, joint], spin[:, 1, 0], atol=1e-8)
        np.testing.assert_allclose(jacobian[:, 3, joint], spin[:, 2, 1], atol=1e-8)


@pytest.mark.parametrize("turns", [1.0, 1e2, 1e4])
def test_sines_and_cosines_are_those_of_the_library(turns: float) -> None:
    angles = np.random.default_rng(0).uniform(-2.0 * np.pi * turns, 2.0 * np.pi * turns, 20_000)
    special = 0.5 * np.pi * np.arange(-400, 401)
    angles = np.concatenate([angles, special, np.nextafter(special, 1e3), [0.0, -0.0]])
    found = both(angles, np.empty((2, len(angles))))
    np.testing.assert_allclose(found, [np.sin(angles), np.cos(angles)], rtol=0.0, atol=4e-16)
    assert np.isnan(both(np.array([np.nan, np.inf]), np.empty((2, 2)))).all()


@njit
def both(angles, out):
    for n in range(angles.shape[0]):
        out[0, n], out[1, n] = sine_cosine(angles[n])
    return out


SLIDER = """
<robot name="slider">
  <link name="stand"/>
  <joint name="turn" type="revolute"><parent link="stand"/><child link="mast"/>
    <origin xyz="0.1 0 0.3" rpy="0.2 0.1 0"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
  <link name="mast"/>
  <joint name="lift" type="prismatic"><parent link="mast"/><child link="arm"/>
    <origin xyz="0 0.2 0.3" rpy="0 0.3 0"/><axis xyz="0.6 0 0.8"/>
    <limit lower="-0.5" upper="0.5" velocity="1" effort="1"/></joint>
  <link name="arm"/>
  <joint name="swing" type="revolute"><parent link="arm"/><child link="tip"/>
    <origin xyz="0.3 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
  <link name="tip"/>
</robot>"""


@pytest.mark.parametrize("name", [*ROBOTS, "slider"])
def test_postures_side_by_side_are_those_of_one_after_another_to_the_bit(
    name: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    if name == "slider":
        urdf = tmp_path / "slider.urdf"
        urdf.write_text(SLIDER)
        robot = load_robot(urdf, "tip")
    else:
        robot = request.getfixturevalue(name).robot
    dof, q = robot.dof, robot.sample(LANES, np.random.default_rng(2))
    alone = new_posture(dof)
    for count in (1, 2, 5, 6, 7, 8, 9, 15, 16, 31, LANES):
        joints, turns = np.empty((2, dof, 3, LANES)), np.empty((2, dof, LANES))
        lanes = Lanes(np.empty((3, 4, LANES)), *joints, *turns)
        poses_of(robot.chain, q[:count], lanes)
        for n in range(count):
            pose_of(robot.chain, q[n], alone)
            np.testing.assert_array_equal(lanes.frame[:, 0, n], alone.position)
            np.testing.assert_array_equal(lanes.frame[:, 1:, n], alone.rotation)
            np.testing.assert_array_equal(lanes.origins[:, :, n], alone.origins)
            np.testing.assert_array_equal(lanes.axes[:, :, n], alone.axes)


def test_any_batch_shape(xarm) -> None:
    q = xarm.sample(6, np.random.default_rng(2))
    position, rotation = xarm.forward(q.reshape(2, 3, 6))
    assert position.shape == (2, 3, 3)
    assert rotation.shape == (2, 3, 3, 3)
    np.testing.assert_array_equal(position.reshape(6, 3), xarm.forward(q)[0])
    assert xarm.jacobian(q[0]).shape == (6, 6)


def test_limits_are_the_tighter_ones(xarm) -> None:
    np.testing.assert_allclose(xarm.upper, [3.5, 2.0944, 0.19198, 3.5, np.pi, 3.5], atol=1e-9)
    assert xarm.limit_distance(xarm.upper) == 0
    assert xarm.limit_distance(xarm.upper + 0.25) == pytest.approx(-0.25)


def test_rpy_turns_about_the_fixed_axes() -> None:
    quarter = rotation_from_rpy(np.array([np.pi / 2, 0.0, np.pi / 2]))
    np.testing.assert_allclose(quarter @ [0, 1, 0], [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(quarter @ [1, 0, 0], [0, 1, 0], atol=1e-15)


@pytest.mark.parametrize(
    ("urdf", "link", "limits", "message"),
    [
        ("nowhere.urdf", "link6", {}, "no such URDF"),
        ("xarm/xarm6_robot.urdf", "link9", {}, "no link 'link9'"),
        ("xarm/xarm6_robot.urdf", "link6", {"joint9": (0, 1)}, "joint9"),
        ("xarm/xarm6_robot.urdf", "link6", {"joint2": (-9, 1)}, "joint2"),
    ],
)
def test_a_bad_description_is_named(urdf: str, link: str, limits: dict, message: str) -> None:
    with pytest.raises(RobotError, match=message):
        load_robot(data_path() / Path(urdf), link, limits)


@pytest.mark.parametrize(
    ("sound", "bad", "message"),
    [
        (
            'lower="-0.5"',
            'lower="-inf"',
            "limits of joint 'slide' are -inf and 0.5: must be finite",
        ),
        ('xyz="0 0.1 0.2"', 'xyz="0 nan 0.2"', "the origin of a <joint> has numbers that are not"),
    ],
)
def test_numbers_that_are_none_are_refused(tmp_path, sound: str, bad: str, message: str) -> None:
    (tmp_path / "slide.urdf").write_text(SLIDE.replace(sound, bad))
    with pytest.raises(RobotError, match=message):
        load_robot(tmp_path / "slide.urdf", "tool")


def test_wrong_number_of_joints(xarm) -> None:
    with pytest.raises(RobotError, match="6 joints"):
        xarm.forward(np.zeros((3, 7)))
