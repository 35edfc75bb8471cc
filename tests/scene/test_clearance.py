"""The clearance model against PyBullet, and its gradient against finite differences."""

from pathlib import Path

import numpy as np
import pytest

from constraint_geodesics.robot.kinematics import SerialRobot, load_robot
from constraint_geodesics.scene.body import Body
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.capsule import Capsule
from constraint_geodesics.scene.clearance import (
    ClearanceModel,
    clearance_batch,
    clearance_model,
    clearance_row,
    link_clearances,
    outermost,
)
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.scene.urdf import data_path
from constraint_geodesics.scene.world import World

TABLE = Box("table", (0.0, 0.0, -0.05), (2.4, 2.4, 0.1), ("link_base",))
KUKA_TABLE = Box("table", (0.0, 0.0, -0.05), (2.4, 2.4, 0.1), ("lbr_iiwa_link_0",))
WALL = Box("wall", (0.6, 0.0, 0.5), (0.1, 2.0, 1.0))
BALL = Sphere("ball", (0.35, 0.1, 0.4), 0.12)
PIPE = Capsule("pipe", (0.4, 0.0, 0.2), (0.5, 0.1, 0.7), 0.12)
BESIDE = Box("wall", (0.0, 0.55, 0.5), (4.0, 0.2, 4.0))
SKIN = 0.004
"""Clearance [m] up to which PyBullet may report a contact: the margin of its collision shapes, and
a little.
"""

LINK = """
  <link name="link{i}"><inertial><origin xyz="0.02 -0.01 0.03" rpy="0.4 0.3 0.1"/><mass value="1"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>{shapes}</link>"""
JOINT = """
  <joint name="joint{i}" type="{kind}"><parent link="link{i}"/><child link="link{next}"/>
    <origin xyz="0 0 0.25" rpy="0 0 0.2"/><axis xyz="{axis}"/>
    <limit lower="-1.2" upper="1.2" velocity="2" effort="1"/></joint>"""
SHAPE = (
    '<collision><origin xyz="{x} 0 0.1" rpy="0.1 0.2 0.3"/><geometry>{shape}</geometry></collision>'
)
CYLINDER = '<cylinder radius="0.04" length="0.2"/>'


def lift_robot(folder: Path, *shapes: str) -> SerialRobot:
    """An arm whose second joint slides, with one collision shape a link, or more."""
    collisions = "".join(SHAPE.format(x=0.2 * k, shape=shape) for k, shape in enumerate(shapes))
    joints = [("revolute", "1 0 0"), ("prismatic", "0 0 1"), ("revolute", "0 1 0")]
    parts = [LINK.format(i=i, shapes=collisions) for i in range(4)]
    parts += [
        JOINT.format(i=i, next=i + 1, kind=kind, axis=axis) for i, (kind, axis) in enumerate(joints)
    ]
    urdf = folder / "lift.urdf"
    urdf.write_text(f"<robot name='lift'>{''.join(parts)}</robot>")
    return load_robot(urdf, "link3")


@pytest.fixture(scope="module")
def lift(tmp_path_factory: pytest.TempPathFactory) -> SerialRobot:
    return lift_robot(tmp_path_factory.mktemp("lift"), CYLINDER)


@pytest.mark.parametrize(
    ("name", "boxes", "share"),
    [
        ("xarm", (TABLE,), 0.1),
        ("xarm", (TABLE, WALL), 0.15),
        ("xarm", (BALL,), 0.1),
        ("xarm", (TABLE, BALL), 0.15),
        ("xarm", (TABLE, PIPE), 0.15),
        ("kuka", (KUKA_TABLE,), 0.05),
        ("kuka", (KUKA_TABLE, WALL), 0.1),
        ("lift", (BESIDE,), 0.1),
    ],
    ids=(
        "xarm table",
        "xarm wall",
        "xarm ball",
        "xarm table and ball",
        "xarm table and pipe",
        "kuka table",
        "kuka wall",
        "sliding joint",
    ),
)
def test_what_is_clear_is_free_for_pybullet_and_what_reaches_in_is_not(
    request, name, boxes, share
) -> None:
    robot: SerialRobot = request.getfixturevalue(name)
    model = clearance_model(robot, boxes)
    q = robot.sample(3000, np.random.default_rng(0))
    clearance = model.clearance(robot, q)
    with World(robot, boxes) as world:
        hit = world.label(q).workcell_collision
    assert share < hit.mean() < 0.9
    assert not hit[clearance > SKIN].any()
    assert hit[clearance < 0.0].all()
    between = (clearance >= 0.0) & (clearance <= SKIN)
    assert between.mean() < 0.02


def differences(
    model: ClearanceModel, robot: SerialRobot, q: np.ndarray, step: float
) -> np.ndarray:
    """Slopes (2, D, D) of each link's distance along each joint, from below and from above."""
    here = distances(model, robot, q)[0]
    slopes = np.empty((2, robot.dof, robot.dof))
    for j in range(robot.dof):
        for side, sign in enumerate((-1.0, 1.0)):
            moved = q.copy()
            moved[j] += sign * step
            slopes[side, :, j] = sign * (distances(model, robot, moved)[0] - here) / step
    return slopes


def distances(
    model: ClearanceModel, robot: SerialRobot, q: np.ndarray, far: float = np.inf
) -> tuple[np.ndarray, ...]:
    return measured(model.arrays, robot, q, far)


def measured(arrays: tuple, robot: SerialRobot, q: np.ndarray, far: float) -> tuple:
    dof = robot.dof
    found = (
        np.empty(dof),
        np.empty((dof, 3)),
        np.empty((dof, 3)),
        np.empty((dof, 3)),
        np.empty((dof, 3)),
    )
    link_clearances(robot.chain, arrays, far, q, *found)
    return found


@pytest.mark.parametrize(
    ("name", "boxes"),
    [
        ("xarm", (TABLE, WALL)),
        ("xarm", (BALL,)),
        ("xarm", (PIPE,)),
        ("kuka", (KUKA_TABLE, WALL)),
        ("lift", (BESIDE,)),
    ],
)
def test_each_row_is_the_gradient_of_its_links_distance(request, name, boxes) -> None:
    robot: SerialRobot = request.getfixturevalue(name)
    model = clearance_model(robot, boxes)
    smooth = 0
    q = robot.sample(40, np.random.default_rng(1))
    for configuration in q:
        below, above = differences(model, robot, configuration, 1e-6)
        distance, normals, nearest, origins, axes = distances(model, robot, configuration)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)
        for link in range(robot.dof):
            row = np.empty(robot.dof)
            clearance_row(robot.chain.prismatic, link, normals, nearest, origins, axes, row)
            assert not row[link + 1 :].any()
            # where another point or side comes nearest the distance has a kink, and two slopes
            if np.abs(above[link] - below[link]).max() < 1e-4:
                np.testing.assert_allclose(row, 0.5 * (above + below)[link], atol=1e-5)
                smooth += 1
        assert distance.min() == model.clearance(robot, configuration)
    assert smooth > 0.9 * len(q) * robot.dof


def test_exempt_links_may_touch_their_box_and_no_other(xarm) -> None:
    floor, exempt = ((0.0, 0.0, 0.1), (4.0, 4.0, 0.4)), ("link_base", "link1", "link2")
    q = xarm.sample(2000, np.random.default_rng(2))
    strict, loose = Box("strict", *floor, ("link_base",)), Box("loose", *floor, exempt)
    assert (clearance_model(xarm, (strict,)).clearance(xarm, q) < 0.0).all(), (
        "the arm's first links stand in it"
    )
    model = clearance_model(xarm, (loose,))
    np.testing.assert_array_equal(model.exempt, [[True, True, False, False, False, False]])
    clearance = model.clearance(xarm, q)
    with World(xarm, (loose,)) as world:
        hit = world.label(q).workcell_collision
    assert 0.1 < hit.mean() < 0.9
    assert not hit[clearance > SKIN].any()
    assert hit[clearance < 0.0].all()
    both = clearance_model(xarm, (loose, WALL))
    np.testing.assert_array_equal(both.exempt[1], False)
    alone = clearance_model(xarm, (WALL,)).clearance(xarm, q)
    np.testing.assert_array_equal(both.clearance(xarm, q), np.minimum(clearance, alone))


def test_a_workcell_without_boxes_is_clear_everywhere(xarm) -> None:
    body = Body("table", data_path() / "table" / "table.urdf")
    q = xarm.sample(4, np.random.default_rng(3)).reshape(2, 2, 6)
    for workcell in ((), (body,)):
        model = clearance_model(xarm, workcell)
        assert len(model.points) == 0
        np.testing.assert_array_equal(model.clearance(xarm, q), np.full((2, 2), np.inf))


def test_two_boxes_leave_the_smaller_clearance_of_each(xarm) -> None:
    q = xarm.sample(1000, np.random.default_rng(4))
    alone = [clearance_model(xarm, (box,)).clearance(xarm, q) for box in (TABLE, WALL)]
    both = clearance_model(xarm, (TABLE, WALL)).clearance(xarm, q)
    np.testing.assert_array_equal(both, np.minimum(*alone))
    assert 0.1 < (alone[0] < alone[1]).mean() < 0.9


def test_any_batch_shape_is_answered_alike(xarm) -> None:
    model = clearance_model(xarm, (TABLE,))
    q = xarm.sample(12, np.random.default_rng(5))
    flat = model.clearance(xarm, q)
    np.testing.assert_array_equal(model.clearance(xarm, q.reshape(3, 4, 6)), flat.reshape(3, 4))
    assert model.clearance(xarm, q[0]).shape == ()
    assert model.clearance(xarm, q[:0]).shape == (0,)


def test_beyond_the_distance_asked_for_there_is_a_bound_from_below(xarm) -> None:
    model = clearance_model(xarm, (TABLE, WALL))
    q = xarm.sample(2000, np.random.default_rng(6))
    exact, bounded, far = model.clearance(xarm, q), np.empty(len(q)), 0.05
    clearance_batch(xarm.chain, model.arrays, far, q, bounded)
    assert (bounded <= exact).all()
    np.testing.assert_array_equal(bounded[exact <= far], exact[exact <= far])
    assert (bounded[exact > far] > far).all()
    assert 0.2 < (exact > far).mean() < 0.9


def test_the_outermost_points_reach_nearly_as_far_as_all_of_them() -> None:
    rng = np.random.default_rng(7)
    points = rng.normal(size=(4000, 3))
    points *= (1.0, 0.5, 0.2) / np.linalg.norm(points, axis=1, keepdims=True)
    kept = outermost(points)
    assert 30 < len(kept) <= 48
    assert {tuple(point) for point in kept} <= {tuple(point) for point in points}
    directions = rng.normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    short = (points @ directions.T).max(axis=0) - (kept @ directions.T).max(axis=0)
    assert short.min() >= 0.0
    assert short.max() < 0.1


@pytest.mark.parametrize(
    "shapes",
    [
        ('<sphere radius="0.06"/>',),
        ('<box size="0.06 0.08 0.2"/>',),
        (CYLINDER, '<box size="0.2 0.02 0.02"/>'),
    ],
    ids=("sphere", "box", "cylinder and box"),
)
def test_links_of_any_collision_shape_are_known(tmp_path, shapes) -> None:
    robot = lift_robot(tmp_path, *shapes)
    model = clearance_model(robot, (BESIDE,))
    q = robot.sample(500, np.random.default_rng(8))
    with World(robot, (BESIDE,)) as world:
        hit = world.label(q).workcell_collision
    assert not hit[model.clearance(robot, q) > SKIN].any()


@pytest.mark.parametrize(
    "bodies", [(TABLE, BALL), (WALL, BALL, BESIDE), (PIPE, WALL)], ids=("two", "three", "pipe")
)
def test_points_passed_over_in_groups_are_none_that_are_nearest(xarm, bodies) -> None:
    """Against every point asked one by one."""
    model, rng = clearance_model(xarm, bodies), np.random.default_rng(4)
    for q in xarm.sample(25, rng):
        far = float(rng.uniform(0.02, 0.3))
        found = distances(model, xarm, q, far)[0]
        for joint in range(6):
            exact = one_by_one(xarm, model, q, joint)
            if found[joint] <= far:
                assert found[joint] == pytest.approx(exact, abs=1e-12)
            else:
                assert far < found[joint] <= exact + 1e-12


def one_by_one(robot, model, q, joint) -> float:
    """The smallest distance of the points that a joint carries, each in a group of its own."""
    points = model.points[model.joints == joint]
    chosen = np.arange(len(points), dtype=float)
    groups = np.concatenate(
        [points, np.zeros((len(points), 1)), chosen[:, None], chosen[:, None] + 1.0], axis=1
    )
    groups = np.concatenate([groups, np.full((len(points), 1), float(joint))], axis=1)
    before = [
        [0.0] * 4 + [0.0, 0.0, float(j)] for j in range(joint)
    ]  # no points: the kernel goes joint by joint
    arrays = (
        np.ascontiguousarray(points),
        model.arrays[1],
        np.concatenate([np.reshape(before, (-1, 7)), groups]),
    )
    return float(measured(arrays, robot, q, np.inf)[0][joint])
