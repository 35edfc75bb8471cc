"""The projection onto what a search may use, where a contact can't be mended."""

import numpy as np
import pytest

from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.robot.kinematics import SerialRobot, load_robot
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.search.space import project_node, space_of, workspace

MARGIN = 0.005
TURNTABLE = """
<robot name="turntable">
  <link name="stand"/>
  <joint name="turn" type="revolute"><parent link="stand"/><child link="plate"/>
    <origin xyz="0 0 0.3"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
  <link name="plate"><collision><geometry><box size="0.2 0.2 0.02"/></geometry></collision></link>
  <joint name="swing" type="revolute"><parent link="plate"/><child link="arm"/>
    <origin xyz="0 0 0.3"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
  <link name="arm"><collision><origin xyz="0.2 0 0"/>
    <geometry><box size="0.4 0.04 0.04"/></geometry></collision></link>
</robot>"""


@pytest.fixture(scope="module")
def turntable(tmp_path_factory: pytest.TempPathFactory) -> SerialRobot:
    urdf = tmp_path_factory.mktemp("turntable") / "turntable.urdf"
    urdf.write_text(TURNTABLE)
    return load_robot(urdf, "arm")


def below(name: str, x: float, gap_m: float) -> Box:
    """A block under the plate, on which it turns without coming nearer."""
    return Box(name, (x, 0.0, 0.28 - gap_m), (0.04, 0.04, 0.02))


BLOCKS = (below("left", -0.05, 0.001), below("right", 0.05, 0.002))
POST = Box("post", (0.3, 0.03, 0.6), (0.02, 0.014, 0.1))
"""3 mm from the arm."""


def test_contacts_that_no_joint_moves_leave_the_others_to_be_mended(turntable: SerialRobot) -> None:
    """As many as the arm has joints, and nearer than the one that can be mended."""
    free = ConstraintManifold(turntable, Constraint((0,) * 6))
    space = space_of(free, clearance_model(turntable, (*BLOCKS, POST)), MARGIN)
    post, q = clearance_model(turntable, (POST,)), np.zeros(2)
    assert post.clearance(turntable, q) == pytest.approx(0.003, abs=1e-9)
    left = project_node(space, q, space.projection, workspace(space))
    assert post.clearance(turntable, q) == pytest.approx(MARGIN, abs=1e-6)
    assert left == pytest.approx(MARGIN - 0.001, abs=1e-9), "the blocks are as near as before"


def test_a_short_step_onto_the_constraint_is_not_the_last_beside_a_broken_limit(xarm) -> None:
    reference = Pose(*xarm.forward(np.array([0.3, -0.4, -0.6, 0.2, 0.5, 0.1])))
    level = ConstraintManifold(xarm, Constraint((0, 0, 0, 1, 1, 0), reference=reference))
    space, rng = space_of(level), np.random.default_rng(0)
    settings = space.projection._replace(last_step=1e-3)
    on = retract(level, xarm.sample(200, rng))
    inside = on.joints[on.converged & (xarm.limit_distance(on.joints) > 0.01)]
    assert len(inside) > 30
    for q in inside:
        q += 1e-7 * rng.normal(size=6)
        q[0] = xarm.upper[0] + 1e-4  # turns the arm about the vertical, which nothing holds
        left = project_node(space, q, settings, workspace(space))
        assert left <= 1e-6
        assert xarm.limit_distance(q) >= -1e-9


def test_where_no_joint_moves_any_contact_nothing_is_moved(turntable: SerialRobot) -> None:
    free = ConstraintManifold(turntable, Constraint((0,) * 6))
    space = space_of(free, clearance_model(turntable, BLOCKS), MARGIN)
    left = project_node(space, q := np.zeros(2), space.projection, workspace(space))
    np.testing.assert_array_equal(q, 0.0)
    assert left == pytest.approx(MARGIN - 0.001, abs=1e-9)
