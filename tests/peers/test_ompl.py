import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest
from tests.planner_fixtures import walled

from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.peers.ompl import SamplingPlanner, Search
from constraint_geodesics.peers.ompl_settings import OmplSettings
from constraint_geodesics.problem import PlanningProblem, Solution
from constraint_geodesics.robot.kinematics import SerialRobot, load_robot
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.urdf import data_path
from constraint_geodesics.scene.world import World

PLANNERS: tuple[Search, ...] = ("prm", "rrt_star", "birrt")
SETTINGS = OmplSettings(budget_s=60.0, range_rad=4.0)
MOST = {"prm": 75, "rrt_star": 150, "birrt": 300}
"""Iterations that are enough for what is asked here."""


def planner_of(name: Search, **changed: object) -> SamplingPlanner:
    """One of the planners with few iterations, and settings changed."""
    return SamplingPlanner(name, SETTINGS.model_copy(update={"iterations": MOST[name]} | changed))


TABLE = Box("table", (0.0, 0.0, -0.05), (2.4, 2.4, 0.1), ("link_base",))
PILLAR = Box("pillar", (0.45, 0.0, 0.5), (0.1, 0.1, 1.0))
SIDE_GRASP = Pose.from_rpy((0.4, 0.0, 0.3), (np.pi / 2, 0.0, 0.0))
LEVEL = Constraint((0, 0, 0, 1, 1, 0), reference=SIDE_GRASP)
RELAXED = Constraint((0, 0, 0, 1, 1, 0), (0, 0, 0, np.radians(10), np.radians(10), 0), SIDE_GRASP)
FREE = Constraint((0,) * 6)
EASY, HARD = 1, 4
"""Seeds of queries: a straight walk along the manifold arrives; it does not, so that chance
decides.
"""


@pytest.fixture(scope="module")
def xarm() -> SerialRobot:
    limits = dict.fromkeys(("joint1", "joint4", "joint6"), (-3.5, 3.5))
    return load_robot(data_path() / "xarm/xarm6_robot.urdf", "link6", limits)


@pytest.fixture(scope="module")
def world(xarm: SerialRobot) -> Iterator[World]:
    with World(xarm, [TABLE]) as loaded:
        yield loaded


def ends(
    manifold: ConstraintManifold, is_free: Callable[[np.ndarray], bool], seed: int, count: int = 2
) -> np.ndarray:
    """Random configurations that keep the constraint, the limits and their distance from
    collisions.
    """
    rng = np.random.default_rng(seed)
    kept: list[np.ndarray] = []
    while len(kept) < count:
        retracted = retract(manifold, manifold.robot.sample(1, rng))
        q = retracted.joints[0]
        if retracted.converged[0] and manifold.robot.limit_distance(q) > 0.05 and is_free(q):
            kept.append(q)
    return np.array(kept)


def problem(world: World, constraint: Constraint, seed: int) -> PlanningProblem:
    manifold = ConstraintManifold(world.robot, constraint)
    start, goal = ends(manifold, world.is_free, seed)
    return PlanningProblem(start, goal, manifold, world.is_free)


def assert_sound(path: Solution, asked: PlanningProblem, world: World) -> None:
    assert path.status == "solved"
    assert path.iterations > 0
    assert 0.0 < path.time_s < SETTINGS.budget_s
    np.testing.assert_allclose(path.joints[[0, -1]], [asked.start, asked.goal], atol=1e-6)
    assert (
        np.linalg.norm(np.diff(path.joints, axis=0), axis=1).max() <= 2 * SETTINGS.delta_rad + 1e-9
    )
    assert asked.manifold.violation(path.joints).max() <= 1e-4
    assert asked.manifold.robot.limit_distance(path.joints).min() >= 0.0
    assert world.free(path.joints).all()


@pytest.mark.parametrize("name", PLANNERS)
def test_path_keeps_the_cup_level_and_is_executable(name: Search, world: World) -> None:
    for seed in (EASY, HARD):
        asked = problem(world, LEVEL, seed)
        assert_sound(planner_of(name).plan(asked, seed=0), asked, world)


@pytest.mark.parametrize("name", ["prm", "birrt"])
def test_every_path_is_executable_before_any_simplification(name: Search, world: World) -> None:
    planner = planner_of(name, simplify=False)
    for seed in (
        10,
        29,
        30,
    ):  # projection leaves the limits; a roadmap's edge can be walked in one direction only
        asked = problem(world, LEVEL, seed)
        assert_sound(planner.plan(asked, seed=0), asked, world)


def test_long_steps_do_not_end_in_a_collision(world: World) -> None:
    asked = problem(world, LEVEL, 37)
    path = planner_of("birrt", delta_rad=0.3, simplify=False).plan(asked, seed=0)
    assert path.status == "solved"
    assert world.free(path.joints).all()


def test_walk_that_stalls_is_given_up(world: World) -> None:
    asked = problem(world, LEVEL, HARD)
    checks = 0

    def is_free(q: np.ndarray) -> bool:
        nonlocal checks
        checks += 1
        return world.is_free(q)

    counted = PlanningProblem(asked.start, asked.goal, asked.manifold, is_free)
    assert planner_of("birrt").plan(counted, seed=0).status == "solved"
    assert checks < 4500  # 2800; walking on into dead ends takes 7000


@pytest.mark.parametrize("space", ["atlas", "tangent_bundle"])
def test_other_spaces_keep_the_cup_level(space: str, world: World) -> None:
    asked = problem(world, LEVEL, EASY)
    path = planner_of("birrt", space=space).plan(asked, seed=0)
    assert path.status == "solved"
    assert asked.manifold.violation(path.joints).max() <= 1e-4
    assert world.free(path.joints).all()


def test_simplification_shortens(world: World) -> None:
    asked = problem(world, LEVEL, HARD)
    paths = [
        planner_of("birrt", simplify=simplify).plan(asked, seed=0) for simplify in (True, False)
    ]
    short, long = (np.linalg.norm(np.diff(path.joints, axis=0), axis=1).sum() for path in paths)
    assert_sound(paths[1], asked, world)
    assert short < long


def planned_elsewhere(name: Search, start: np.ndarray, goal: np.ndarray, seed: int) -> np.ndarray:
    """The joints of a path, for another process."""
    limits = dict.fromkeys(("joint1", "joint4", "joint6"), (-3.5, 3.5))
    robot = load_robot(data_path() / "xarm/xarm6_robot.urdf", "link6", limits)
    with World(robot, [TABLE]) as world:
        manifold = ConstraintManifold(robot, LEVEL)
        problem = PlanningProblem(start, goal, manifold, world.is_free)
        return planner_of(name).plan(problem, seed).joints


def test_seed_fixes_the_path_whatever_was_planned_before_and_in_any_process(world: World) -> None:
    asked = problem(world, LEVEL, HARD)
    with ProcessPoolExecutor(1, get_context("spawn")) as fresh:
        elsewhere = {
            name: fresh.submit(planned_elsewhere, name, asked.start, asked.goal, 3)
            for name in PLANNERS
        }
        for name in reversed(PLANNERS):
            planner = planner_of(name)
            other, path = planner.plan(asked, seed=4), planner.plan(asked, seed=3)
            assert path.status == "solved"
            assert not np.array_equal(path.joints, other.joints)
            np.testing.assert_array_equal(path.joints, elsewhere[name].result())


@pytest.mark.parametrize("name", PLANNERS)
def test_search_without_a_way_ends_after_its_iterations(name: Search, world: World) -> None:
    asked = walled(world.robot, lambda q: abs(q[0]) > 0.2)
    most = {"prm": 30, "rrt_star": 40, "birrt": 50}[name]
    path = planner_of(name, iterations=most).plan(asked, seed=0)
    assert path.status == "not_found"
    assert path.joints.shape == (0, 6)
    assert most - 5 < path.iterations <= most

    endless = planner_of(name, iterations=10**9, budget_s=0.1)
    began = time.perf_counter()
    assert endless.plan(asked, seed=0).status == "not_found"
    assert time.perf_counter() - began < 60.0


def test_all_axes_held_leave_no_way(world: World) -> None:
    asked = problem(world, FREE, 1)
    position, rotation = world.robot.forward(asked.start)
    held = ConstraintManifold(world.robot, Constraint((1,) * 6, reference=Pose(position, rotation)))
    stuck = PlanningProblem(asked.start, asked.start, held, world.is_free)
    answer = planner_of("birrt").plan(stuck, seed=0)
    assert answer.status == "not_applicable"
    assert "isolated points" in answer.explanation


def test_relaxed_cup_uses_its_band_and_stays_in_it(world: World) -> None:
    asked = problem(world, RELAXED, 10)
    for space in ("atlas", "tangent_bundle"):
        answer = planner_of("birrt", space=space).plan(asked, seed=0)
        assert answer.status == "not_applicable"
        assert "no tangent spaces" in answer.explanation
    path = planner_of("birrt").plan(asked, seed=0)
    assert_sound(path, asked, world)
    tilt = np.linalg.norm(asked.manifold.residual(path.joints)[:, 3:], axis=1)
    assert np.radians(2) < tilt.max() <= np.radians(10) + 1e-4


def test_free_motion_goes_around_a_pillar(xarm: SerialRobot) -> None:
    with World(xarm, [TABLE, PILLAR]) as world:
        manifold = ConstraintManifold(xarm, FREE)
        start, goal = (np.array([angle, 0.3, -1.2, 0.0, 0.9, 0.0]) for angle in (-0.8, 0.8))
        straight = start + np.linspace(0, 1, 50)[:, None] * (goal - start)
        assert not world.free(straight).all()
        asked = PlanningProblem(start, goal, manifold, world.is_free)
        for name in PLANNERS:
            more = {"iterations": 1500} if name == "rrt_star" else {}
            assert_sound(planner_of(name, **more).plan(asked, seed=0), asked, world)


def test_seven_joints_need_no_other_code() -> None:
    iiwa = load_robot(data_path() / "kuka_iiwa/model.urdf", "lbr_iiwa_link_7")
    with World(iiwa) as world:
        asked = problem(world, LEVEL, 2)
        assert asked.start.shape == (7,)
        assert_sound(planner_of("birrt").plan(asked, seed=0), asked, world)
