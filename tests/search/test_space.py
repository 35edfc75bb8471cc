"""The projection onto what a search may use, where a contact can't be mended."""

import numpy as np
import pytest

from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.robot.kinematics import SerialRobot, load_robot
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.scene import Scene
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
    space = space_of(free, clearance_model(Scene(turntable, (*BLOCKS, POST))), MARGIN)
    post, q = clearance_model(Scene(turntable, (POST,))), np.zeros(2)
    assert post.clearance(turntable, q) == pytest.approx(0.003, abs=1e-9)
    left = project_node(space, q, space.projection, workspace(space))
    assert post.clearance(turntable, q) == pytest.approx(MARGIN, abs=1e-6)
    assert left == pytest.approx(MARGIN - 0.001, abs=1e-9), "the blocks are as near as before"


def test_a_short_step_over_a_limit_is_not_the_last(xarm) -> None:
    """The step back onto the constraint leads beyond a limit that is drawn half-way."""
    reference = Pose(*xarm.forward(np.array([0.3, -0.4, -0.6, 0.2, 0.5, 0.1])))
    level = ConstraintManifold(xarm, Constraint((0, 0, 0, 1, 1, 0), reference=reference))
    found = retract(level, xarm.sample(100, np.random.default_rng(0)))
    on, tried = found.joints[found.converged], 0
    for q, slopes in zip(on, level.jacobian(on)[:, 3:5], strict=True):
        away = -1e-5 * slopes[0] / np.linalg.norm(slopes[0])
        joint = int(np.argmin(away))
        if away[joint] > -3e-6:
            continue
        tried += 1
        limits = np.stack([q - 1.0, q + 1.0])
        limits[1, joint] = q[joint] + 0.5 * away[joint]
        space, moved = space_of(level)._replace(limits=limits), q + away
        settings = space.projection._replace(last_step=1e-4)
        left = project_node(space, moved, settings, workspace(space))
        assert left <= 1e-9
        assert moved[joint] <= limits[1, joint] + 1e-9
        assert level.violation(moved) <= 2e-9
    assert tried > 30


def test_where_no_joint_moves_any_contact_nothing_is_moved(turntable: SerialRobot) -> None:
    free = ConstraintManifold(turntable, Constraint((0,) * 6))
    space = space_of(free, clearance_model(Scene(turntable, BLOCKS)), MARGIN)
    left = project_node(space, q := np.zeros(2), space.projection, workspace(space))
    np.testing.assert_array_equal(q, 0.0)
    assert left == pytest.approx(MARGIN - 0.001, abs=1e-9)
