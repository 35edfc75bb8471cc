"""The clearance model against PyBullet, the certificate's own distances and finite differences."""

from pathlib import Path

import numpy as np
import pytest

from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.robot.kinematics import SerialRobot, load_robot
from constraint_geodesics.scene.body import Body
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.capsule import Capsule
from constraint_geodesics.scene.clearance import (
    DISTANCE,
    FINEST_M,
    NO_CLEARANCE,
    NORMAL,
    PAIR,
    ClearanceArrays,
    ClearanceModel,
    Contacts,
    clearance_batch,
    clearance_model,
    contact_row,
    near_again,
    near_contacts,
    new_contacts,
    new_nearby,
    path_stays_clear,
)
from constraint_geodesics.scene.convex_kernels import REACH
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.scene.urdf import data_path
from constraint_geodesics.scene.world import World

TABLE = Box("table", (0.0, 0.0, -0.05), (2.4, 2.4, 0.1), ("link_base",))
KUKA_TABLE = Box("table", (0.0, 0.0, -0.05), (2.4, 2.4, 0.1), ("lbr_iiwa_link_0",))
WALL = Box("wall", (0.6, 0.0, 0.5), (0.1, 2.0, 1.0))
PLATE = Box("plate", (0.4, 0.0, 0.4), (0.004, 0.5, 0.5))
BALL = Sphere("ball", (0.35, 0.1, 0.4), 0.12)
PIPE = Capsule("pipe", (0.4, 0.0, 0.2), (0.5, 0.1, 0.7), 0.01)
BODY = Body("lamp", data_path() / "table" / "table.urdf", (0.7, 0.0, 0.0))
BESIDE = Box("wall", (0.0, 0.55, 0.5), (4.0, 0.2, 4.0))
SKIN = 0.0003
"""Distance [m] from 0 at which PyBullet's word may be another, but for boxes, whose edges it rounds
off.
"""
BITE = 0.003
SAMPLED_M = 0.001
"""Motion between two places of a line that is sampled, at most."""

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


SCENES = pytest.mark.parametrize(
    ("name", "shapes"),
    [
        ("xarm", ()),
        ("xarm", (TABLE, WALL)),
        ("xarm", (TABLE, BALL)),
        ("xarm", (TABLE, PIPE, PLATE)),
        ("xarm", (TABLE, BODY)),
        ("kuka", (KUKA_TABLE, WALL)),
        ("lift", (BESIDE,)),
    ],
    ids=("alone", "wall", "ball", "pipe and plate", "body", "kuka", "sliding joint"),
)


@SCENES
def test_its_sign_is_what_pybullet_says_of_shapes_and_of_the_arm_itself(
    request: pytest.FixtureRequest, name: str, shapes: tuple
) -> None:
    robot: SerialRobot = request.getfixturevalue(name)
    clearance = clearance_model(Scene(robot, shapes)).clearance(
        robot, q := robot.sample(2000, np.random.default_rng(0))
    )
    with World(robot, shapes) as world:
        free = world.free(q)
    assert 0.02 < free.mean() < 0.98
    assert free[clearance > SKIN].all()
    assert not free[clearance < -BITE].any()
    assert (np.abs(clearance) < BITE).mean() < 0.05


@SCENES
def test_it_is_the_certificates_distance_on_the_searchs_own_kinematics(
    request: pytest.FixtureRequest, name: str, shapes: tuple
) -> None:
    """Where nothing overlaps; pairs that never meet are left out of both."""
    robot: SerialRobot = request.getfixturevalue(name)
    with Certifier(Scene(robot, shapes)) as certifier:
        collisions = certifier.collisions
        model = clearance_model(Scene(robot, shapes), collisions.apart)
        q = robot.sample(300, np.random.default_rng(1))
        found = model.clearance(robot, q)
        theirs = np.array([collisions.clearance(row) for row in q])
    apart = found > 0.0
    assert apart.any()
    np.testing.assert_allclose(found[apart], theirs[apart], atol=1e-5)
    assert (theirs[~apart] <= 1e-6).all()


def distance_of(
    robot: SerialRobot, model: ClearanceArrays, contact: np.ndarray, q: np.ndarray, room: Contacts
) -> float:
    """The distance of a contact's pair of pieces at another configuration; nan where another pair
    of the same bodies is nearer.
    """
    count = near_contacts(robot.chain, model, q, 0.11, room)
    own = room.found[:count, PAIR] == contact[PAIR]
    return float(room.found[:count][own, DISTANCE][0]) if own.any() else np.nan


@SCENES
def test_contacts_that_are_asked_for_again_are_all_that_there_are(
    request: pytest.FixtureRequest, name: str, shapes: tuple
) -> None:
    """Along walks of small steps and great ones."""
    robot: SerialRobot = request.getfixturevalue(name)
    model, rng, found = clearance_model(Scene(robot, shapes)).arrays, np.random.default_rng(3), 0
    room, kept = new_contacts(model, robot.dof), new_contacts(model, robot.dof)
    nearby = new_nearby(model, 4, robot.dof)
    places = robot.sample(4, rng)
    for step in (*rng.uniform(0.0, 0.1, 60), 1.0, *rng.uniform(0.0, 0.02, 60)):
        places = places + step * rng.uniform(-1.0, 1.0, places.shape)
        for k, q in enumerate(places):
            count = near_contacts(robot.chain, model, q, 0.05, room)
            again = near_again(robot.chain, model, q, 0.05, kept, nearby, k)
            told = [room.found[:count], kept.found[:again]]
            apart = [own[own[:, DISTANCE] > 1e-6, DISTANCE] for own in told]
            np.testing.assert_allclose(*apart, rtol=0.0, atol=1e-6)
            # how deep pieces overlap hangs on the direction that was looked along before
            pairs = [set(model.pairs[own[:, PAIR].astype(int), 0]) for own in told]
            assert pairs[0] == pairs[1]
            found += count
    assert found > 100


@SCENES
def test_each_row_is_the_gradient_of_its_contacts_distance(
    request: pytest.FixtureRequest, name: str, shapes: tuple
) -> None:
    robot: SerialRobot = request.getfixturevalue(name)
    model, step = clearance_model(Scene(robot, shapes)).arrays, 1e-6
    room, row, smooth, seen = new_contacts(model, robot.dof), np.empty(robot.dof), 0, 0
    for q in robot.sample(60, np.random.default_rng(2)):
        count = near_contacts(robot.chain, model, q, 0.1, room)
        for contact in room.found[:count].copy():
            if contact[DISTANCE] <= 0.0:  # which direction is taken may change
                continue
            assert np.linalg.norm(contact[NORMAL : NORMAL + 3]) == pytest.approx(1.0, abs=1e-9)
            again = distance_of(robot, model, contact, q, room)
            assert again == pytest.approx(contact[DISTANCE], abs=1e-7)
            room.found[0] = contact
            contact_row(robot.chain.prismatic, room, 0, row)
            slopes = np.empty((2, robot.dof))
            for j in range(robot.dof):
                for side, sign in enumerate((-1.0, 1.0)):
                    moved = q.copy()
                    moved[j] += sign * step
                    distance = distance_of(robot, model, contact, moved, room)
                    slopes[side, j] = sign * (distance - contact[DISTANCE]) / step
            seen += 1
            # where other corners come nearest there may be a kink, and two slopes
            if np.abs(slopes[0] - slopes[1]).max() < 1e-5:
                # a kink within the step leaves the gradient between the two slopes
                off = np.abs(row - slopes.mean(axis=0))
                assert (off <= 0.5 * np.abs(slopes[0] - slopes[1]) + 1e-6).all()
                smooth += 1
    assert smooth > 0.9 * seen > 0


@SCENES
def test_a_line_that_stays_clear_is_free_between_its_ends_too(
    request: pytest.FixtureRequest, name: str, shapes: tuple
) -> None:
    """Against clearances between which nothing moves by more than SAMPLED_M; thin plates and rods
    are no less safe than thick ones.
    """
    robot: SerialRobot = request.getfixturevalue(name)
    model, rng = clearance_model(Scene(robot, shapes)), np.random.default_rng(3)
    starts = robot.sample(1500, rng)
    starts = starts[model.clearance(robot, starts) > 0.0][:60]
    answers = []
    reaches = model.arrays.nodes[:, REACH:].max(axis=0)
    for start in starts:
        end = np.clip(start + rng.normal(size=robot.dof) * 0.5, robot.lower, robot.upper)
        count = int(np.ceil(np.abs(end - start) @ reaches / SAMPLED_M)) + 1
        places = start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)
        clearances = np.empty(count)
        clearance_batch(robot.chain, model.arrays, 2.0 * FINEST_M, places, clearances)
        least = clearances.min()
        clear = path_stays_clear(robot.chain, model.arrays, np.stack([start, end]))
        assert least > 0.0 if clear else least < FINEST_M
        answers.append(clear)
    assert 0 < sum(answers) < len(answers)


def test_a_plate_between_two_configurations_is_seen(xarm: SerialRobot) -> None:
    """The arm's hand on either side of a plate of 4 mm, and nothing near it at both ends."""
    q = np.zeros((2, 6))
    q[:, 1], q[:, 2] = -0.4, -0.6
    q[0, 0], q[1, 0] = -0.8, 0.8
    tool = xarm.forward(np.array([0.0, *q[0, 1:]]))[0]
    x, y, z = map(float, tool)
    model = clearance_model(Scene(xarm, (Box("plate", (x, y, z), (0.3, 0.004, 0.3)),)))
    assert (model.clearance(xarm, q) > 0.03).all()
    assert not path_stays_clear(xarm.chain, model.arrays, q)
    assert path_stays_clear(xarm.chain, clearance_model(Scene(xarm, ())).arrays, q)


def test_exempt_links_may_touch_their_box_and_no_other(xarm: SerialRobot) -> None:
    floor, exempt = ((0.0, 0.0, 0.1), (4.0, 4.0, 0.4)), ("link_base", "link1", "link2")
    q = xarm.sample(1000, np.random.default_rng(4))
    strict, loose = Box("strict", *floor, ("link_base",)), Box("loose", *floor, exempt)
    assert (clearance_model(Scene(xarm, (strict,))).clearance(xarm, q) < 0.0).all(), (
        "the arm's first links stand in it"
    )
    clearance = clearance_model(Scene(xarm, (loose,))).clearance(xarm, q)
    assert 0.1 < (clearance > 0.0).mean() < 0.9
    free = {}
    for link in ("", "link3", "link4"):
        board = Box("board", (0.25, 0.0, 0.75), (0.02, 0.3, 0.5), (link,) if link else ())
        clearance = clearance_model(Scene(xarm, (loose, board))).clearance(xarm, q)
        with World(xarm, (loose, board)) as world:
            free[link] = world.free(q)
        assert free[link][clearance > SKIN].all()
        assert not free[link][clearance < -BITE].any()
    # each of the two alone touches the board somewhere, where the other's exemption is of no use
    for link, other in (("link3", "link4"), ("link4", "link3")):
        assert (free[link] & ~free[""] & ~free[other]).any()


def test_two_shapes_leave_the_smaller_clearance_of_each(xarm: SerialRobot) -> None:
    q = xarm.sample(300, np.random.default_rng(5))
    alone = [clearance_model(Scene(xarm, (shape,))).clearance(xarm, q) for shape in (TABLE, WALL)]
    both = clearance_model(Scene(xarm, (TABLE, WALL))).clearance(xarm, q)
    apart = both > 0.0
    np.testing.assert_allclose(both[apart], np.minimum(*alone)[apart], atol=1e-6)
    np.testing.assert_array_equal(apart, np.minimum(*alone) > 0.0)


def test_any_batch_shape_is_answered_alike(xarm: SerialRobot) -> None:
    model = clearance_model(Scene(xarm, (TABLE,)))
    q = xarm.sample(12, np.random.default_rng(6))
    flat = model.clearance(xarm, q)
    np.testing.assert_array_equal(model.clearance(xarm, q.reshape(3, 4, 6)), flat.reshape(3, 4))
    assert model.clearance(xarm, q[0]).shape == ()
    assert model.clearance(xarm, q[:0]).shape == (0,)


def test_beyond_the_distance_asked_for_it_is_that(xarm: SerialRobot) -> None:
    model: ClearanceModel = clearance_model(Scene(xarm, (TABLE, WALL)))
    q = xarm.sample(500, np.random.default_rng(7))
    exact, bounded, far = model.clearance(xarm, q), np.empty(len(q)), 0.05
    clearance_batch(xarm.chain, model.arrays, far, q, bounded)
    clear = exact > 0.0
    np.testing.assert_allclose(bounded[clear], np.minimum(exact, far)[clear], atol=1e-6)
    assert (bounded[~clear] <= 0.0).all()
    assert (NO_CLEARANCE.clearance(xarm, q) == np.inf).all()


@pytest.mark.parametrize(
    "shapes",
    [
        ('<sphere radius="0.06"/>',),
        ('<box size="0.06 0.08 0.2"/>',),
        (CYLINDER, '<box size="0.2 0.02 0.02"/>'),
    ],
    ids=("sphere", "box", "cylinder and box"),
)
def test_links_of_any_collision_shape_are_known(tmp_path: Path, shapes: tuple) -> None:
    robot = lift_robot(tmp_path, *shapes)
    model = clearance_model(Scene(robot, (BESIDE,)))
    q = robot.sample(500, np.random.default_rng(8))
    with World(robot, (BESIDE,)) as world:
        free = world.free(q)
    assert free[model.clearance(robot, q) > SKIN].all()
