"""The chain that is read from the URDF against the one that PyBullet loads."""

from pathlib import Path

import numpy as np
import pytest

from constraint_geodesics.certification import kernels
from constraint_geodesics.certification.certificate import CertificationError
from constraint_geodesics.certification.chain import Chain, read_chain
from constraint_geodesics.certification.urdf_chain import chain_of_urdf
from constraint_geodesics.robot.kinematics import SerialRobot, load_robot
from constraint_geodesics.scene.scene import Scene

ROBOT = Path(__file__).resolve().parents[1] / "robots" / "six_axis.urdf"
SLIDE = """<robot name="slide"><link name="base"/><link name="tool"/><joint name="slide"
type="prismatic"><parent link="base"/><child link="tool"/><axis xyz="{axis}"/>
<origin xyz="0 0.1 0.2" rpy="0.3 -0.2 0.1"/><limit lower="-0.5" upper="0.5" velocity="1"/></joint>
</robot>"""


@pytest.fixture(params=["xarm", "kuka", "six_axis", "slide"])
def robot(request, tmp_path) -> SerialRobot:
    if request.param == "six_axis":
        return load_robot(ROBOT, "tool")
    if request.param == "slide":
        (tmp_path / "slide.urdf").write_text(SLIDE.format(axis="0 0.6 0.8"))
        return load_robot(tmp_path / "slide.urdf", "tool")
    return request.getfixturevalue(request.param)


def test_a_fixed_joint_may_have_an_axis_of_length_0(tmp_path) -> None:
    flange = '<link name="flange"/><joint name="on" type="fixed"><parent link="tool"/>'
    flange += '<child link="flange"/><axis xyz="0 0 0"/></joint></robot>'
    file = tmp_path / "slide.urdf"
    file.write_text(SLIDE.format(axis="0 0 1").replace("</robot>", flange))
    *_, last = chain_of_urdf(file, "flange", ["slide"]).links
    assert (last.name, last.kind) == ("flange", "fixed")


def poses(chain: Chain, q: np.ndarray) -> np.ndarray:
    out = np.empty((len(q), 7))
    kernels.poses(chain, q, out)
    return out


def test_it_is_the_chain_that_pybullet_loads(robot: SerialRobot) -> None:
    read = chain_of_urdf(robot.urdf, robot.tool_link, robot.joint_names)
    with Scene(robot).world() as world:
        loaded = world.loaded_chain()
    assert [link.name for link in read.links] == [link.name for link in loaded.links]
    assert [link.kind for link in read.links] == [link.kind for link in loaded.links]
    q = robot.sample(200, np.random.default_rng(0))
    own, theirs = (poses(read_chain(chain, robot.dof), q) for chain in (read, loaded))
    np.testing.assert_allclose(own[:, :3], theirs[:, :3], atol=1e-6)
    same = own[:, 3:] * np.sign((own[:, 3:] * theirs[:, 3:]).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(same, theirs[:, 3:], atol=1e-6)


def test_an_axis_that_hardly_differs_from_minus_z_is_kept(tmp_path) -> None:
    hinge = SLIDE.format(axis="4e-05 0 -0.9999999992").replace("prismatic", "revolute")
    (tmp_path / "hinge.urdf").write_text(hinge.replace("0.5", "3"))
    robot = load_robot(tmp_path / "hinge.urdf", "tool")
    chain = read_chain(chain_of_urdf(robot.urdf, robot.tool_link, robot.joint_names), 1)
    q = np.array([[2.0]])
    position, rotation = robot.forward(q[0])
    turned = poses(chain, q)[0]
    np.testing.assert_allclose(turned[:3], position, atol=1e-12)
    x, y, z, w = turned[3:]
    axis = 2.0 * np.array([x * z + w * y, y * z - w * x, 0.5 - x * x - y * y])
    np.testing.assert_allclose(axis, rotation[:, 2], atol=1e-12)


@pytest.mark.parametrize(
    ("axis", "message"),
    [("0 0 0.5", "of length 0.5"), ("0 0 0", "of length 0"), ("0 1", "must be three numbers")],
)
def test_what_can_be_read_in_two_ways_is_refused(tmp_path, axis, message) -> None:
    file = tmp_path / "slide.urdf"
    file.write_text(SLIDE.format(axis=axis))
    with pytest.raises(CertificationError, match=message):
        chain_of_urdf(file, "tool", ("slide",))
