"""The certifier against PyBullet, the project's own constraint, dense sampling, and many kinds of
corruption.
"""

import ast
import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import constraint_geodesics.certification as package
from constraint_geodesics.certification.certifier import CertificationError, Certifier, Limits
from constraint_geodesics.constraints.constraint import (
    Constraint,
    ConstraintManifold,
    Pose,
    constraint_manifold,
)
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.learning.lift import as_executed, densify
from constraint_geodesics.params import Params
from constraint_geodesics.robot.kinematics import load_robot, rotation_from_rpy
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.scene.world import World

LIMITS = Limits(acceleration_rad_s2=(20.0,) * 6)
FREE = Constraint((0,) * 6)
CONSTRAINTS = {
    "cone": Constraint((0, 0, 0, 1, 1, 0)),
    "cone about x": Constraint((0, 0, 0, 0, 1, 1)),
    "cone with tolerance": Constraint((0, 0, 0, 1, 0, 1), (0, 0, 0, 0.17, 0, 0.17)),
    "swing entries": Constraint((0, 0, 0, 1, 1, 0), (0, 0, 0, 0.0, 0.17, 0)),
    "swing entries about y": Constraint((0, 0, 0, 1, 0, 1), (0, 0, 0, 0.05, 0, 0.1)),
    "rotation": Constraint((0, 0, 0, 1, 1, 1)),
    "rotation with tolerance": Constraint((0, 0, 0, 1, 1, 1), (0, 0, 0, 0.1, 0.1, 0.1)),
    "rotation entries": Constraint((0, 0, 0, 1, 1, 1), (0, 0, 0, 0.0, 0.1, 0.2)),
    "twist": Constraint((0, 0, 0, 0, 0, 1)),
    "twist with tolerance": Constraint((0, 0, 0, 1, 0, 0), (0, 0, 0, 0.1, 0, 0)),
    "position": Constraint((1, 1, 1, 0, 0, 0)),
    "height with tolerance": Constraint((0, 0, 1, 0, 0, 0), (0, 0, 0.02, 0, 0, 0)),
    "slide": Constraint((0, 0, 1, 1, 1, 0)),
    "mixed": Constraint((0, 1, 1, 1, 0, 0), (0, 0.01, 0, 0.05, 0, 0)),
}
GANTRY_JOINTS = [
    ("fixed", "0 0 1"),
    ("revolute", "1 1 0"),
    ("prismatic", "{slide}"),
    ("fixed", "0 0 1"),
    ("revolute", "0 0 -1"),
    ("revolute", "0 1 0"),
    ("prismatic", "-1 0 0"),
    ("revolute", "1 -2 3"),
    ("fixed", "0 0 1"),
]
GANTRY_LINK = """
  <link name="{name}"><inertial><origin xyz="0.02 -0.01 0.03" rpy="{turn} 0.3 0.1"/>
    <mass value="1"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>"""
GANTRY_JOINT = """
  <joint name="joint{i}" type="{kind}"><parent link="link{i}"/><child link="link{next}"/>
    <origin xyz="0.1 -0.05 0.2" rpy="0.3 {i} -0.7"/><axis xyz="{axis}"/>
    <limit lower="-1" upper="1" velocity="2" effort="1"/></joint>"""


GANTRY_TOOL = f"link{len(GANTRY_JOINTS)}"


def write_gantry(folder: Path, slide: str) -> Path:
    """A URDF of sliding and turning joints about skewed axes, fixed ones among them, and turned
    inertial frames.
    """
    links = [
        GANTRY_LINK.format(name=f"link{i}", turn=0.4 * i) for i in range(len(GANTRY_JOINTS) + 1)
    ]
    joints = [
        GANTRY_JOINT.format(i=i, next=i + 1, kind=kind, axis=axis.format(slide=slide))
        for i, (kind, axis) in enumerate(GANTRY_JOINTS)
    ]
    urdf = folder / "gantry.urdf"
    urdf.write_text(f"<robot name='gantry'>{''.join(links + joints)}</robot>")
    return urdf


@dataclass(frozen=True)
class Question:
    """A path and everything it is certified against."""

    joints: object
    constraint: Constraint
    start: np.ndarray | None = None
    goal: np.ndarray | None = None
    times: object = None

    def put_to(self, certifier: Certifier, collisions: bool = True):
        return certifier.certify(
            self.joints, self.constraint, self.start, self.goal, self.times, collisions
        )


@pytest.fixture(scope="module")
def gantry(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return Scene(
        load_robot(write_gantry(tmp_path_factory.mktemp("gantry"), "0 0.6 0.8"), GANTRY_TOOL)
    )


@pytest.fixture(params=["scene", "kuka_scene", "gantry"])
def any_scene(request: pytest.FixtureRequest) -> Scene:
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="module")
def certifier(scene: Scene):
    with Certifier(scene, LIMITS) as judge:
        yield judge


@pytest.fixture(scope="module")
def good(scene: Scene, params: Params) -> Question:
    """A path that keeps the cup level, between drawn ends, slow and smooth in time."""
    manifold = constraint_manifold(scene.robot, params.constraints["level_cup"])
    drawn = retract(manifold, scene.robot.sample(80, np.random.default_rng(0)))
    ends = drawn.joints[drawn.converged & (scene.robot.limit_distance(drawn.joints) > 0.05)]
    with scene.world() as world:
        for start, goal in itertools.pairwise(ends):
            joints = as_executed(manifold, np.stack([start, goal]), 0.01)
            steps = np.linalg.norm(np.diff(joints, axis=0), axis=-1)
            inside = scene.robot.limit_distance(joints).min() > 0.05
            if inside and steps.max() < 0.02 and steps.sum() > 2.0 and world.free(joints).all():
                return Question(joints, manifold.constraint, start, goal, gentle_times(joints))
    raise AssertionError("no drawn pair has a valid path")


def gentle_times(joints: np.ndarray) -> np.ndarray:
    """Times [s] at which the speed along a path rises and falls like a sine, up to 0.5 rad/s."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(joints, axis=0), axis=-1))])
    return np.arccos(1.0 - 2.0 * along / along[-1]) * along[-1]


def dense(joints: np.ndarray, count: int) -> np.ndarray:
    """The piecewise linear path at `count` places of each segment, and its last row."""
    share = np.linspace(0.0, 1.0, count, endpoint=False)[:, None]
    inner = joints[:-1, None] + share * (joints[1:] - joints[:-1])[:, None]
    return np.concatenate([inner.reshape(-1, joints.shape[1]), joints[-1:]])


def excesses(manifold: ConstraintManifold, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The project's own excess over the tolerance of each configuration: of the angles [rad], of
    the positions [m].
    """
    excess = manifold.inclusion(q)
    shared = len(set(manifold.rows.tolerance[3:][manifold.rows.held[3:]])) == 1
    angles = np.linalg.norm(excess[:, 3:], axis=-1) if shared else excess[:, 3:].max(axis=-1)
    return angles, excess[:, :3].max(axis=-1)


def walk(
    manifold: ConstraintManifold, rows: int, step: float, rng: np.random.Generator
) -> np.ndarray:
    """A random path along the constraint, about `step` from row to row."""
    path = [retract(manifold, manifold.robot.sample(1, rng)).joints[0]]
    heading = rng.normal(size=manifold.robot.dof)
    while len(path) < rows:
        heading = heading + 0.3 * rng.normal(size=len(heading))
        # a step along the constraint first, so that the row after it is as far away as wanted
        tangent = (
            retract(manifold, path[-1] + 1e-4 * heading / np.linalg.norm(heading)).joints - path[-1]
        )
        path.append(retract(manifold, path[-1] + step * tangent / np.linalg.norm(tangent)).joints)
    return np.array(path)


# What the certifier is made of.


def test_it_shares_with_the_search_the_bodies_and_their_distance_alone() -> None:
    """Which are compared with PyBullet's in test_collisions.py."""
    allowed = {
        "constraint_geodesics.compiled": {"COMPILE", "LEAF"},
        "constraint_geodesics.scene": {"convex_kernels"},
        "constraint_geodesics.scene.bodies": {"Body", "BodyTable", "Pair", "touching"},
        "constraint_geodesics.scene.scene": {"Scene"},
        "constraint_geodesics.constraints.constraint": {"Constraint", "Pose"},
        "constraint_geodesics.scene.world": {"BodyKey", "LoadedChain", "LoadedLink", "World"},
        "constraint_geodesics.scene.pieces": {"NOT_CONVEX", "Piece", "prism"},
        "constraint_geodesics.xml_files": {"read_xml"},  # its text; what it says it reads itself
    }
    of_convex_kernels = {
        "BALL",
        "REACH",
        "ROUNDING",
        "FRAME",
        "MARGIN",
        "SIMPLEX",
        "VECTOR",
        "distance",
        "gap_along",
        "pieces_of",
        "place_balls",
        "roughly_apart",
        "turned",
    }
    used = set()
    sources = sorted(Path(package.__file__).parent.glob("*.py"))
    assert len(sources) > 3
    for source in sources:
        for node in ast.walk(ast.parse(source.read_text())):
            if isinstance(node, ast.Import):
                plain = {"contextlib", "math", "numpy", "time", "xml.etree.ElementTree"}
                assert {name.name for name in node.names} <= plain
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith(
                "constraint_geodesics"
            ):
                own = str(node.module).startswith("constraint_geodesics.certification")
                names = {name.name for name in node.names}
                assert own or names <= allowed[str(node.module)]
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "convex":
                used.add(node.attr)
            # of the robot it reads data only
            if isinstance(node, ast.Attribute) and "robot" in ast.dump(node.value):
                assert node.attr not in {
                    "forward",
                    "jacobian",
                    "chain",
                    "manifold",
                    "limit_distance",
                    "sample",
                }
    assert used == of_convex_kernels


def test_its_kinematics_are_pybullets(any_scene: Scene) -> None:
    q = any_scene.robot.sample(300, np.random.default_rng(0))
    with Certifier(any_scene) as certifier, any_scene.world() as world:
        own, labels = certifier.tool_poses(q), world.label(q)
    np.testing.assert_allclose(own[:, :3], labels.position, atol=1e-6)
    same = own[:, 3:] * np.sign((own[:, 3:] * labels.quaternion).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(same, labels.quaternion, atol=1e-6)


def test_the_constraint_is_measured_as_the_search_measures_it(any_scene: Scene) -> None:
    """One formulation by quaternions, one by matrices: the same excess at any configuration, near
    and far.
    """
    rng = np.random.default_rng(1)
    robot = any_scene.robot
    with Certifier(any_scene) as certifier:
        for constraint in CONSTRAINTS.values():
            centre = robot.sample(1, rng)[0]
            held = constraint.relative_to(Pose(*robot.forward(centre)))
            q = np.concatenate(
                [robot.sample(15, rng), centre + 0.1 * rng.normal(size=(15, robot.dof))]
            )
            angles, positions = excesses(ConstraintManifold(robot, held), q)
            found = [certifier.certify(np.stack([row, row]), held, collisions=False) for row in q]
            np.testing.assert_allclose(
                [each.max_violation_rad for each in found], angles, atol=1e-9
            )
            np.testing.assert_allclose(
                [each.max_violation_m for each in found], positions, atol=1e-9
            )


def test_a_world_finds_the_first_collision_of_a_batch(scene: Scene) -> None:
    q = scene.robot.sample(200, np.random.default_rng(2))
    with scene.world() as world:
        free = world.free(q)
        assert 0 < free.sum() < len(q)
        assert world.first_collision(q) == np.argmin(free)
        assert world.first_collision(q[free]) is None


# The bound between the rows.


def check_bound(
    certifier: Certifier, manifold: ConstraintManifold, path: np.ndarray, count: int
) -> tuple[float, ...]:
    """Bounds and true maxima (sampled) of angles and positions; the bound holds, whatever the
    path.
    """
    certificate = certifier.certify(path, manifold.constraint, collisions=False)
    angles, positions = (each.max() for each in excesses(manifold, dense(path, count)))
    assert certificate.violation_bound_rad >= angles
    assert certificate.violation_bound_m >= positions
    # what counts as attained is attained
    assert certificate.max_violation_rad <= certificate.violation_bound_rad
    assert certificate.max_violation_m <= certificate.violation_bound_m
    return certificate.violation_bound_rad, certificate.violation_bound_m, angles, positions


@pytest.mark.parametrize("name", CONSTRAINTS)
@pytest.mark.parametrize("step", [0.01, 0.02, 0.03])
def test_on_fine_paths_along_the_constraint_the_bound_is_tight(
    scene, kuka_scene, gantry, name, step
) -> None:
    for any_scene, seed in ((scene, 0), (kuka_scene, 1), (gantry, 2)):
        rng = np.random.default_rng(seed)
        reference = Pose(*any_scene.robot.forward(any_scene.robot.sample(1, rng)[0]))
        manifold = ConstraintManifold(any_scene.robot, CONSTRAINTS[name].relative_to(reference))
        with Certifier(any_scene) as certifier:
            path = walk(manifold, 6, step, rng)
            bound_rad, bound_m, angles, positions = check_bound(certifier, manifold, path, 2000)
        # beyond 1e-4 a retraction has jumped, or the row itself is off
        assert bound_rad <= 1.2 * angles + 1e-6
        assert bound_m <= 1.2 * positions + 1e-6


@pytest.mark.parametrize("name", CONSTRAINTS)
@pytest.mark.parametrize(
    ("step", "tolerance"), [(0.02, 1e-4), (0.1, 1e-4), (0.5, 10.0), (1.0, 10.0), (7.0, 1e-4)]
)
def test_the_bound_holds_on_any_path(scene, kuka_scene, gantry, name, step, tolerance) -> None:
    """Rows off the constraint, steps up to a whole turn, references up to a half turn away.

    With a large tolerance long pieces are not cut, so that the remainder of the interpolation
    counts.
    """
    for any_scene, seed in ((scene, 3), (kuka_scene, 4), (gantry, 5)):
        rng = np.random.default_rng(seed)
        robot = any_scene.robot
        with Certifier(any_scene, Limits(violation_tolerance=tolerance)) as certifier:
            for turn in (0.0, 0.1, 1.5, np.pi - 1e-3):
                steps = rng.normal(size=(4, robot.dof))
                steps *= step / np.linalg.norm(steps, axis=-1, keepdims=True)
                path = np.cumsum(np.concatenate([robot.sample(1, rng), steps]), axis=0)
                position, rotation = robot.forward(path[0])
                reference = Pose(
                    position, rotation_from_rpy(turn * np.eye(3)[rng.integers(3)]) @ rotation
                )
                manifold = ConstraintManifold(robot, CONSTRAINTS[name].relative_to(reference))
                check_bound(certifier, manifold, path, 200)


@pytest.mark.parametrize(
    "name", ["cone", "swing entries", "rotation", "rotation entries", "twist", "position"]
)
def test_the_interpolations_remainder_counts_where_pieces_are_long(scene, gantry, name) -> None:
    """Few joints turn far at once, and the tolerance is what the rows need: all of the excess lies
    between them.
    """
    shape = CONSTRAINTS[name]
    with_entries = "entries" in name or name == "position"
    for any_scene in (scene, gantry):
        rng = np.random.default_rng(6)
        robot = any_scene.robot
        with Certifier(any_scene, Limits(violation_tolerance=10.0)) as certifier:
            for _ in range(60):
                path = robot.sample(1, rng).repeat(2, axis=0)
                moved = rng.choice(robot.dof, size=rng.integers(1, 3), replace=False)
                path[1, moved] += rng.uniform(0.5, 2.0, len(moved)) * rng.choice(
                    [-1, 1], len(moved)
                )
                held = shape.relative_to(Pose(*robot.forward(robot.sample(1, rng)[0])))
                needed = np.abs(ConstraintManifold(robot, held).residual(path))
                angle = np.linalg.norm(needed[:, 3:], axis=-1).max()
                widths = needed.max(axis=0) if with_entries else angle * np.array(shape.axes)
                held = replace(held, tolerance=tuple(widths * np.array(shape.axes)))
                check_bound(certifier, ConstraintManifold(robot, held), path, 2000)


def test_the_bound_is_the_excess_itself_where_the_tool_only_turns_freely(
    certifier: Certifier, good: Question
) -> None:
    """Turning joint 6 alone keeps the tool's z axis: nothing happens between the rows, however long
    the way.
    """
    path = np.repeat(good.start[None], 60, axis=0)
    path[:, 5] += np.linspace(0.0, 3.0, 60) * -np.sign(path[:, 5])
    held = Constraint((0, 0, 0, 1, 1, 0), reference=Pose(np.zeros(3), np.eye(3)))
    tilt = certifier.certify(path, held, collisions=False)
    first = certifier.certify(path[[0, 0]], held, collisions=False)
    assert first.max_violation_rad > 0.1
    np.testing.assert_allclose(tilt.max_violation_rad, first.max_violation_rad, atol=1e-6)
    assert first.max_violation_rad <= tilt.violation_bound_rad <= 1.02 * first.max_violation_rad


# Good paths, and twenty-odd ways to spoil one.


def test_a_good_path_passes_with_its_measures(
    scene: Scene, certifier: Certifier, good: Question
) -> None:
    certificate = good.put_to(certifier)
    assert certificate.valid
    assert certificate.violation is None
    steps = np.linalg.norm(np.diff(good.joints, axis=0), axis=-1)
    np.testing.assert_allclose(certificate.length_rad, steps.sum())
    np.testing.assert_allclose(certificate.max_step_rad, steps.max())
    np.testing.assert_allclose(
        certificate.limit_distance_rad, scene.robot.limit_distance(good.joints).min()
    )
    np.testing.assert_allclose(certificate.duration_s, good.times[-1])
    true = ConstraintManifold(scene.robot, good.constraint).violation(dense(good.joints, 50)).max()
    assert 1e-7 < true <= certificate.violation_bound <= 1.2 * true + 1e-6
    np.testing.assert_allclose(certificate.max_violation, true, rtol=0.05)
    assert certificate.max_violation_m == certificate.violation_bound_m == 0.0
    assert certificate.clearance_m > 1e-3
    assert certificate.asked_pybullet == 0
    assert certificate.rests_on.startswith("convex pieces of 7 links and 1 shapes")
    assert 0.0 < certificate.largest_pose_difference < 1e-6
    assert certificate.time_s > 0.0


def test_times_and_ends_and_collisions_are_optional(certifier: Certifier, good: Question) -> None:
    certificate = Question(good.joints, good.constraint).put_to(certifier, collisions=False)
    assert certificate.valid
    assert np.isnan(certificate.duration_s)
    assert np.isnan(certificate.clearance_m)


def test_without_a_reference_the_start_is_held(
    scene: Scene, certifier: Certifier, good: Question
) -> None:
    free_reference = replace(good.constraint, reference=None)
    assert replace(good, constraint=free_reference).put_to(certifier).valid
    tilted = good.joints + np.array([0, 0, 0, 0, 1e-2, 0])
    own = Question(tilted, free_reference).put_to(certifier, collisions=False)
    held = ConstraintManifold(
        scene.robot, free_reference.relative_to(Pose(*scene.robot.forward(good.start)))
    )
    at_start = Question(tilted, free_reference, start=good.start).put_to(
        certifier, collisions=False
    )
    np.testing.assert_allclose(
        at_start.max_violation, held.violation(dense(tilted, 20)).max(), rtol=1e-2
    )
    assert own.max_violation < at_start.max_violation


def edited(change: Callable[[np.ndarray], object]) -> Callable[[Question, Scene], Question]:
    """The question with its joints changed in place or replaced."""

    def corrupt(good: Question, _: Scene) -> Question:
        joints = good.joints.copy()
        result = change(joints)
        return replace(good, joints=joints if result is None else result)

    return corrupt


def retimed(change: Callable[[np.ndarray], object]) -> Callable[[Question, Scene], Question]:
    return lambda good, _: replace(good, times=change(good.times.copy()))


def put(joints: np.ndarray, where: object, value: object) -> None:
    joints[where] = value


def a_turn_further(joints: np.ndarray, row: int, joint: int) -> None:
    joints[row:-1, joint] += 2 * np.pi


def exchanged(values: np.ndarray, first: int, second: int) -> np.ndarray:
    values[[first, second]] = values[[second, first]]
    return values


def tilted(size: float, row: int) -> Callable[[Question, Scene], Question]:
    """One row moved by the smallest joint change that tilts the tool by `size` [rad]."""

    def corrupt(good: Question, scene: Scene) -> Question:
        joints = good.joints.copy()
        jacobian = ConstraintManifold(scene.robot, good.constraint).jacobian(joints[row])[3:5]
        joints[row] += np.linalg.pinv(jacobian) @ np.array([size, 0.0])
        return replace(good, joints=joints)

    return corrupt


def sparse(good: Question, scene: Scene) -> Question:
    """Every fifth row: each keeps the constraint, some of the lines between them do not."""
    rows = np.append(np.arange(0, len(good.joints) - 1, 5), len(good.joints) - 1)
    return replace(good, joints=good.joints[rows], times=None)


def noisy(good: Question, scene: Scene) -> Question:
    joints = good.joints.copy()
    joints[1:-1] += 1e-3 * np.random.default_rng(0).normal(size=joints[1:-1].shape)
    return replace(good, joints=joints)


def other_reference(good: Question, scene: Scene) -> Question:
    pose = good.constraint.reference
    turned = Pose(pose.position, rotation_from_rpy(np.array([0.01, 0.0, 0.0])) @ pose.rotation)
    return replace(good, constraint=good.constraint.relative_to(turned))


def other_constraint(good: Question, scene: Scene) -> Question:
    return replace(good, constraint=Constraint((0, 0, 1, 0, 0, 0)))


def sharp(good: Question, scene: Scene) -> Question:
    """At 1 rad/s from the first row to the last, with no time to speed up."""
    steps = np.linalg.norm(np.diff(good.joints, axis=0), axis=-1)
    return replace(good, times=np.concatenate([[0.0], np.cumsum(steps)]))


def straight_to(q: np.ndarray, start: np.ndarray) -> Question:
    return Question(densify(np.stack([start, q]), 0.05), FREE, start, q)


def through_the_table(good: Question, scene: Scene) -> Question:
    """Down into the table and up again: both ends are free, and the arm never touches itself."""
    home, down = np.zeros(6), np.array([0.0, 1.0, -0.6, 0.0, 0.0, 0.0])
    return Question(densify(np.stack([home, down, home]), 0.05), FREE, home, home)


def into_itself(good: Question, scene: Scene) -> Question:
    q = scene.robot.sample(300, np.random.default_rng(4))
    with scene.world() as world:
        labels = world.label(q)
    return straight_to(q[labels.self_collision & ~labels.workcell_collision][0], good.start)


NAN, INF = float("nan"), float("inf")
CORRUPTIONS: dict[str, tuple[Callable[[Question, Scene], Question], str, int | None]] = {
    "a number is missing": (edited(lambda q: put(q, (40, 3), NAN)), "not_finite", 40),
    "a number is infinite": (edited(lambda q: put(q, (40, 0), INF)), "not_finite", 40),
    "a joint is missing": (edited(lambda q: q[:, :5]), "shape", None),
    "a joint too many": (edited(lambda q: np.pad(q, ((0, 0), (0, 1)))), "shape", None),
    "flattened": (edited(np.ravel), "shape", None),
    "text": (edited(lambda q: q.astype(str)), "shape", None),
    "complex": (edited(lambda q: q.astype(complex)), "shape", None),
    "ragged rows": (edited(lambda q: [[0.0] * 6, [0.0] * 5]), "shape", None),
    "one row": (edited(lambda q: q[:1]), "too_short", None),
    "no rows": (edited(lambda q: q[:0]), "too_short", None),
    "start off by 2e-6": (edited(lambda q: put(q, (0, 2), q[0, 2] + 2e-6)), "start_missed", 0),
    "goal off by 2e-6": (edited(lambda q: put(q, (-1, 4), q[-1, 4] - 2e-6)), "goal_missed", -1),
    "walked backwards": (edited(lambda q: q[::-1]), "start_missed", 0),
    "cut short": (edited(lambda q: q[:-3]), "goal_missed", -4),
    "turned as a whole": (
        edited(lambda q: put(q, (slice(None), 0), q[:, 0] + 1e-3)),
        "start_missed",
        0,
    ),
    "a row outside the limits": (edited(lambda q: put(q, (40, 4), 3.2)), "joint_limits", 40),
    "a joint a turn further": (edited(lambda q: a_turn_further(q, 40, 2)), "joint_limits", 40),
    "a jump": (edited(lambda q: put(q, 40, q[40] * 0.9)), "step", 39),
    "a block of rows deleted": (edited(lambda q: np.delete(q, slice(41, 71), axis=0)), "step", 40),
    "far rows exchanged": (edited(lambda q: exchanged(q, 40, 90)), "step", 39),
    "near rows exchanged": (edited(lambda q: exchanged(q, 100, 101)), "acceleration", None),
    "a row tilted by 2e-4": (tilted(2e-4, 40), "constraint", 40),
    "noise": (noisy, "constraint", None),
    "another reference": (other_reference, "constraint", 0),
    "another constraint": (other_constraint, "constraint", None),
    "rows too sparse": (sparse, "constraint_between_rows", None),
    "times of other rows": (retimed(lambda t: t[:-1]), "times_shape", None),
    "a time is missing": (
        retimed(lambda t: np.where(np.arange(len(t)) == 40, NAN, t)),
        "times_not_finite",
        40,
    ),
    "times start late": (retimed(lambda t: t + 0.5), "times_start", 0),
    "times reversed": (retimed(lambda t: t[::-1]), "times_start", 0),
    "a time twice": (
        retimed(lambda t: np.where(np.arange(len(t)) == 40, t[39], t)),
        "times_order",
        39,
    ),
    "times exchanged": (retimed(lambda t: exchanged(t, 40, 41)), "times_order", 40),
    "too fast": (retimed(lambda t: t * 0.02), "velocity", None),
    "too sharp": (sharp, "acceleration", 0),
    "through the table": (through_the_table, "workcell_collision", None),
    "into itself": (into_itself, "self_collision", None),
}


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_a_corrupted_path_is_refused_for_what_is_wrong(certifier, scene, good, name) -> None:
    corrupt, kind, row = CORRUPTIONS[name]
    question = corrupt(good, scene)
    certificate = question.put_to(certifier)
    assert not certificate.valid
    assert certificate.violation.kind == kind
    if row is not None:
        assert certificate.violation.row == row % len(good.joints)
    assert not certificate.violation.value <= certificate.violation.limit or kind == "times_order"
    assert certificate.violation.message
    assert "\n" not in certificate.violation.message


def test_the_message_says_where_how_much_and_what_is_allowed(certifier, scene, good) -> None:
    violation = tilted(2e-4, 40)(good, scene).put_to(certifier).violation
    assert violation.message == (
        "in row 40 roll and pitch is beyond its tolerance of 0 rad by 0.0002 rad, 0.0001 is allowed"
    )
    np.testing.assert_allclose((violation.value, violation.limit), (2e-4, 1e-4), rtol=1e-3)


def test_the_first_promise_broken_is_reported(certifier, scene, good) -> None:
    """Each later corruption is hidden by the one before it, and a path with neither is measured all
    the same.
    """
    broken = tilted(2e-4, 40)(good, scene)
    both = replace(broken, times=broken.times * 0.02)
    assert both.put_to(certifier).violation.kind == "constraint"
    assert replace(both, goal=good.start).put_to(certifier).violation.kind == "goal_missed"
    measured = replace(both, goal=good.start).put_to(certifier)
    np.testing.assert_allclose(measured.max_violation, 2e-4, rtol=1e-3)
    assert np.isnan(measured.clearance_m)


def test_a_row_at_the_edge_of_what_is_allowed_passes(certifier, scene, good) -> None:
    """The decision is as sharp as the measurement: 0.9e-4 at a row passes, 1.1e-4 does not."""
    assert tilted(0.9e-4, 40)(replace(good, times=None), scene).put_to(certifier).valid
    assert not tilted(1.1e-4, 40)(replace(good, times=None), scene).put_to(certifier).valid


def test_the_segment_that_leaves_the_constraint_is_named(certifier, scene, good) -> None:
    """Sparse rows break it in several places: the first is named, with what is too much there."""
    question = sparse(good, scene)
    manifold = ConstraintManifold(scene.robot, good.constraint)
    pieces = [
        excesses(manifold, dense(pair, 100))[0].max()
        for pair in np.stack([question.joints[:-1], question.joints[1:]], 1)
    ]
    broken = np.flatnonzero(np.array(pieces) > 1e-4)
    assert 1 < len(broken) < len(pieces)
    violation = question.put_to(certifier).violation
    assert (violation.kind, violation.row) == ("constraint_between_rows", broken[0])
    np.testing.assert_allclose(violation.value, pieces[broken[0]], rtol=0.05)


def test_a_pose_that_is_not_pybullets_is_reported(tmp_path: Path) -> None:
    """PyBullet slides by the length of a prismatic axis, which the URDF should have made 1: someone
    must be wrong.
    """
    scene = Scene(load_robot(write_gantry(tmp_path, "0 1 2"), GANTRY_TOOL))
    with Certifier(scene) as certifier:
        path = densify(np.stack([np.zeros(6), np.full(6, 0.3)]), 0.1)
        violation = certifier.certify(path, FREE).violation
    assert (violation.kind, violation.limit) == ("pose", 1e-6)
    assert violation.value > 0.1


@pytest.mark.parametrize("name", ["cone", "rotation entries", "mixed"])
def test_numbers_beyond_all_bounds_are_refused_like_others(certifier, good, name) -> None:
    """Where differences overflow nothing is known, so nothing small is claimed; an end that is no
    number is missed.
    """
    held = CONSTRAINTS[name].relative_to(good.constraint.reference)
    far = np.where(np.random.default_rng(0).random((5, 6)) < 0.5, 1e308, -1e308)
    certificate = certifier.certify(far, held)
    assert certificate.violation.kind == "joint_limits"
    assert certificate.violation_bound >= 3.0
    nowhere = certifier.certify(good.joints, replace(held, reference=None), start=np.full(6, NAN))
    assert nowhere.violation.kind == "start_missed"
    assert nowhere.max_violation == INF


def test_velocity_limits_are_the_robots(scene: Scene, good: Question) -> None:
    """A pace is right up to the limit, to a relative 1e-9."""
    velocity = np.abs(np.diff(good.joints, axis=0)) / np.diff(good.times)[:, None]
    fastest = good.times * (velocity / scene.robot.velocity).max()
    with Certifier(scene) as certifier:
        assert replace(good, times=fastest).put_to(certifier).valid
        assert (
            replace(good, times=fastest * (1 - 1e-6)).put_to(certifier).violation.kind == "velocity"
        )


def test_acceleration_is_that_of_the_equation(scene: Scene, good: Question) -> None:
    dt = np.diff(good.times)
    velocity = np.diff(good.joints, axis=0) / dt[:, None]
    inner = np.diff(velocity, axis=0) / (0.5 * (dt[1:] + dt[:-1]))[:, None]
    rows = np.abs(
        np.concatenate([velocity[:1] / (0.5 * dt[0]), inner, velocity[-1:] / (0.5 * dt[-1])])
    )
    largest = rows.max(axis=0)
    with Certifier(scene, Limits(acceleration_rad_s2=tuple(largest))) as certifier:
        assert good.put_to(certifier).valid
    for joint in range(6):
        less = largest * np.where(np.arange(6) == joint, 1 - 1e-5, 1)
        with Certifier(scene, Limits(acceleration_rad_s2=tuple(less))) as certifier:
            violation = good.put_to(certifier).violation
        assert (violation.kind, violation.row) == ("acceleration", np.argmax(rows[:, joint]))


def under_way(good: Question, row: int) -> tuple[Question, np.ndarray]:
    """The good path, nearly as fast as is allowed, from one of its rows on, and the velocity of the
    line before it.
    """
    lines = np.diff(good.joints, axis=0) / np.diff(good.times)[:, None]
    around = np.diff(good.times)[1:] + np.diff(good.times)[:-1]
    most = 2.0 * np.abs(np.diff(lines, axis=0)) / around[:, None] / LIMITS.acceleration_rad_s2
    good = replace(good, times=good.times * 1.001 * np.sqrt(most.max()))
    line = (good.joints[row] - good.joints[row - 1]) / (good.times[row] - good.times[row - 1])
    rest = good.times[row:] - good.times[row]
    return replace(good, joints=good.joints[row:], times=rest, start=good.joints[row]), line


def test_a_velocity_at_the_start_must_lead_along_the_path(certifier, good) -> None:
    """Slowly, so that the accelerations allow any direction."""
    there, aside = np.eye(6)[4], np.eye(6)[3]
    rows, times = good.joints[0] + 0.05 * np.arange(9)[:, None] * there, 0.5 * np.arange(9)
    for velocity, words in (
        (0.15 * there, ""),
        (0.1 * there + 0.03 * aside, ""),
        (-0.15 * there, "runs back"),
        (0.1 * there + 0.05 * aside, "beside the line"),
        (0.25 * there, "run past the line's end"),
    ):
        found = certifier.certify(
            rows, FREE, times=times, collisions=False, start_velocity=velocity
        )
        assert found.valid == (not words), found.violation
        if words:
            assert found.violation.kind == "start_velocity"
            assert words in found.violation.message


def test_a_velocity_at_the_start_must_not_lead_off_the_constraint(certifier, good) -> None:
    row = int(np.argmax(np.linalg.norm(np.diff(good.joints, axis=0), axis=1)))
    rows, slow = good.joints[row:], 20.0 * (good.times[row:] - good.times[row])
    line = (rows[1] - rows[0]) / slow[1]
    for turned, valid in ((0.0, True), (0.9, False)):
        velocity = line + turned * np.linalg.norm(line) * np.eye(6)[3]  # tilts the tool
        found = certifier.certify(
            rows, good.constraint, rows[0], good.goal, slow, start_velocity=velocity
        )
        assert found.valid == valid, found.violation
        if not valid:
            assert "leads off the constraint" in found.violation.message


def test_a_velocity_at_the_start_must_not_lead_out_of_a_tolerance(scene, certifier, good) -> None:
    """Where nothing is broken yet, a little inside of it, and the line follows its edge."""
    tilting = Constraint((0, 0, 0, 1, 1, 0), (0, 0, 0, 0.1, 0.1, 0), good.constraint.reference)
    manifold = ConstraintManifold(scene.robot, tilting)
    drawn = scene.robot.sample(2000, np.random.default_rng(0))
    on_edge = retract(manifold, drawn)
    starts = on_edge.joints[scene.robot.limit_distance(on_edge.joints) > 0.3]
    turn, found = np.eye(6)[4], []
    for q in starts:  # the fifth joint tilts the tool; the first turns all about the upright
        rate = (manifold.violation(q + 1e-4 * turn) - manifold.violation(q)) / 1e-4
        if rate > 0.5 and manifold.violation(q) < 1e-9:
            found.append(q - 5e-4 * turn)
    assert len(found) > 20
    spin, seconds = np.eye(6)[0], 0.04
    for q in found[:20]:
        rows = q + 0.012 * np.arange(9)[:, None] * spin
        times = seconds * np.arange(9)
        for outward, valid in ((0.0, True), (0.35, False)):
            velocity = 0.3 * spin + outward * turn
            answer = certifier.certify(
                rows, tilting, times=times, collisions=False, start_velocity=velocity
            )
            if valid:
                assert answer.valid, answer.violation
            else:
                assert answer.violation.kind == "start_velocity"
                assert "leads off the constraint" in answer.violation.message


def test_an_arm_that_turns_into_its_path_is_looked_at_beside_it(scene, good) -> None:
    """A ball where it goes while it turns, and the line alone does not."""
    q, spin, aside = good.joints[0], np.eye(6)[5], np.eye(6)[0]
    rows, times = q + 0.05 * np.arange(9)[:, None] * spin, 0.1 * np.arange(9)
    velocity = 0.5 * spin + 0.19 * aside
    beside = q + 0.025 * spin + 0.25 * 0.19 * 0.1 * aside
    with Certifier(scene, LIMITS) as certifier:
        places, there = certifier.tool_poses(np.stack([q, beside]))[:, :3]
        way = (there - places) / np.linalg.norm(there - places)
        alone = certifier.certify(rows, FREE, times=times, start_velocity=velocity)
        assert alone.valid, alone.violation
    near, far = 0.0, 0.3
    while far - near > 3e-4:  # until it stands hardly beside the line
        away = 0.5 * (near + far)
        ball = Sphere("ball", tuple(places + away * way), 0.02)
        with Certifier(replace(scene, workcell=(*scene.workcell, ball)), LIMITS) as certifier:
            if certifier.certify(rows, FREE, times=times).valid:
                far = away
                answer = certifier.certify(rows, FREE, times=times, start_velocity=velocity)
            else:
                near = away
    assert answer.violation.kind == "workcell_collision"
    assert answer.violation.row == 0
    assert answer.violation.message.startswith("as the arm turns into the line from row 0: ")


def assert_limited(certifier, rows, times, along, fastest, said) -> None:
    """A velocity along the first line and beside it is certified up to the fastest one beside it;
    what is faster passes a joint limit, as is said.
    """
    for share, valid in ((0.0, True), (0.99, True), (1.01, False)):
        velocity = along + share * fastest
        found = certifier.certify(
            rows, FREE, times=times, collisions=False, start_velocity=velocity
        )
        assert found.valid == valid, found.violation
        if not valid:
            assert found.violation.kind == "joint_limits"
            assert said in found.violation.message


def test_a_joint_that_moves_must_be_able_to_stop_before_its_limit(certifier, good) -> None:
    """At rest a path may begin on a limit."""
    there, out, upper = np.eye(6)[4], np.eye(6)[5], certifier.scene.robot.upper[5]
    start, times = np.where(out == 1.0, upper - 1e-4, good.joints[0]), np.r_[0.0, 0.01:0.5:0.1]
    rows, room = start + 0.2 * times[:, None] * there, np.sqrt(2e-4 * LIMITS.acceleration_rad_s2[5])
    assert_limited(certifier, rows, times, 0.2 * there, room * out, "needs")


def test_a_joint_that_moves_may_hardly_pass_its_limit_as_the_arm_turns(certifier, good) -> None:
    """Whether the line leaves the joint where it is or leads it back: it turns evenly."""
    there, out, upper = np.eye(6)[4], np.eye(6)[5], certifier.scene.robot.upper[5]
    start, times = np.where(out == 1.0, upper - 1e-4, good.joints[0]), 0.1 * np.arange(9)
    for back in (0.0, 0.02):
        rows = start + 0.1 * np.arange(9)[:, None] * (0.2 * there - back * out)
        turn, fast = np.linspace(0.0, 0.05, 20_001), np.arange(1, 60) / 2e3
        reached = [(v * turn - 0.5 * (v + back) * turn**2 / 0.05).max() for v in fast]
        most = np.interp(2e-4, reached, fast)
        said = "beyond its limit before the line"
        assert_limited(certifier, rows, times, 0.2 * there, most * out, said)


def test_shares_of_the_limits_are_certified(certifier, good) -> None:
    """A motion that uses them up is refused at a small share of them."""
    asked = good.joints, good.constraint, good.start, good.goal, good.times
    assert certifier.certify(*asked, collisions=False).valid
    for scales in ((1e-3, 1.0), (1.0, 1e-3)):
        found = certifier.certify(*asked, collisions=False, scales=scales)
        assert found.violation.kind == ("velocity" if scales[0] < 1.0 else "acceleration")


def test_a_region_must_be_placed(certifier, good) -> None:
    """It would be relative to the last row itself."""
    with pytest.raises(CertificationError, match="region has no reference"):
        certifier.certify(good.joints, FREE, region=Constraint((1, 1, 1, 0, 0, 0)))


def test_a_motion_under_way_is_certified_from_its_velocity_alone(certifier, good) -> None:
    """The change at the first row is held against the first line's half, as at any other row."""
    rest, line = under_way(good, len(good.joints) // 2)
    resting = rest.put_to(certifier).violation
    assert (resting.kind, resting.row) == ("acceleration", 0)

    def certified(velocity: np.ndarray):
        return certifier.certify(
            rest.joints, good.constraint, rest.start, good.goal, rest.times, start_velocity=velocity
        )

    certificate = certified(line)
    assert certificate.valid, certificate.violation
    np.testing.assert_array_equal(certificate.start_velocity, line)
    assert certificate.summary()["start_velocity"] == tuple(line)
    leaving = (rest.joints[1] - rest.joints[0]) / rest.times[1]
    room = 0.5 * rest.times[1] * np.array(LIMITS.acceleration_rad_s2)
    for joint in range(6):
        for sign in (-1.0, 1.0):
            for share, valid in ((0.999, True), (1.001, False)):
                away = leaving.copy()
                away[joint] += sign * share * room[joint]
                found = certified(away)
                assert found.valid == valid, found.violation
                if not valid:
                    assert (found.violation.kind, found.violation.row) == ("acceleration", 0)
                    ratio = found.violation.value / found.violation.limit
                    np.testing.assert_allclose(ratio, 1.001, rtol=1e-6)
    assert good.put_to(certifier).start_velocity is None


def test_a_start_faster_than_the_robot_or_than_the_line_is_long_is_refused(
    certifier, scene, good
) -> None:
    rest, line = under_way(good, len(good.joints) // 2)
    fast = line * (1.01 * (scene.robot.velocity / np.abs(line)).min())
    about = (rest.joints, good.constraint, rest.start, good.goal)
    violation = certifier.certify(*about, rest.times, start_velocity=fast).violation
    assert (violation.kind, violation.row) == ("velocity", 0)
    # on a line that lasts for seconds a stop looks gentle: the arm would run past its end
    slow = np.concatenate([[0.0], rest.times[1:] + 10.0])
    violation = certifier.certify(*about, slow, start_velocity=line).violation
    assert (violation.kind, violation.row) == ("start_velocity", 0)
    assert "run past the line's end" in violation.message
    for wrong, message in ((line[:5], "6 joint values"), (line * np.nan, "must be finite")):
        with pytest.raises(CertificationError, match=message):
            certifier.certify(*about, rest.times, start_velocity=wrong)
    with pytest.raises(CertificationError, match="goes with times"):
        certifier.certify(*about, start_velocity=line)


def test_collisions_are_looked_at_where_they_are_asked_for(certifier, scene, good) -> None:
    assert not through_the_table(good, scene).put_to(certifier).valid
    assert through_the_table(good, scene).put_to(certifier, collisions=False).valid


def test_bare_worlds_differ_from_workcells(scene: Scene, good: Question) -> None:
    with Certifier(Scene(scene.robot)) as certifier:
        assert through_the_table(good, scene).put_to(certifier).valid
    with World(scene.robot) as world:
        assert world.first_collision(through_the_table(good, scene).joints) is None


# Misuse.


@pytest.mark.parametrize(
    "wrong",
    [
        {"end_tolerance_rad": -1.0},
        {"max_step_rad": 0.0},
        {"max_step_rad": NAN},
        {"acceleration_rad_s2": (1.0, 0.0)},
    ],
)
def test_limits_that_mean_nothing_are_refused(wrong: dict) -> None:
    with pytest.raises(CertificationError, match=next(iter(wrong))):
        Limits(**wrong)


def test_questions_that_mean_nothing_are_refused(
    scene: Scene, certifier: Certifier, good: Question
) -> None:
    with pytest.raises(CertificationError, match="start"):
        certifier.certify(good.joints, good.constraint, start=good.start[:5])
    pose = Pose(np.zeros(3), np.eye(3))
    object.__setattr__(pose, "rotation", 2 * np.eye(3))  # the certifier takes nobody's word for it
    skewed = good.constraint.relative_to(pose)
    with pytest.raises(CertificationError, match="orthonormal"):
        certifier.certify(good.joints, skewed)
    with pytest.raises(CertificationError, match="2 entries for 6 joints"):
        Certifier(scene, Limits(acceleration_rad_s2=(1.0, 1.0)))
