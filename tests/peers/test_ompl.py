import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.params import BenchmarkParams
from constraint_geodesics.peers.ompl import PlannerName, SamplingPlanner, plan_all
from constraint_geodesics.problem import PlanningProblem, Solution
from constraint_geodesics.robot.kinematics import SerialRobot, load_robot
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.urdf import data_path
from constraint_geodesics.scene.world import World

PLANNERS: tuple[PlannerName, ...] = ("prm", "rrt_star", "birrt")
SETTINGS = BenchmarkParams(
    seeds=(0,),
    planners=PLANNERS,
    space="projected",
    budget_s=60.0,
    prm_iterations=75,
    rrt_star_iterations=150,
    birrt_iterations=300,
    delta_rad=0.05,
    range_rad=4.0,
)
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
def test_path_keeps_the_cup_level_and_is_executable(name: PlannerName, world: World) -> None:
    for seed in (EASY, HARD):
        asked = problem(world, LEVEL, seed)
        assert_sound(SamplingPlanner(name, SETTINGS).plan(asked, seed=0), asked, world)


@pytest.mark.parametrize("name", ["prm", "birrt"])
def test_every_path_is_executable_before_any_simplification(
    name: PlannerName, world: World
) -> None:
    planner = SamplingPlanner(name, SETTINGS, simplify=False)
    for seed in (
        10,
        29,
        30,
    ):  # projection leaves the limits; a roadmap's edge can be walked in one direction only
        asked = problem(world, LEVEL, seed)
        assert_sound(planner.plan(asked, seed=0), asked, world)


def test_long_steps_do_not_end_in_a_collision(world: World) -> None:
    asked = problem(world, LEVEL, 37)
    settings = SETTINGS.model_copy(update={"delta_rad": 0.3})
    path = SamplingPlanner("birrt", settings, simplify=False).plan(asked, seed=0)
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
    assert SamplingPlanner("birrt", SETTINGS).plan(counted, seed=0).status == "solved"
    assert checks < 4500  # 2800; walking on into dead ends takes 7000


@pytest.mark.parametrize("space", ["atlas", "tangent_bundle"])
def test_other_spaces_keep_the_cup_level(space: str, world: World) -> None:
    asked = problem(world, LEVEL, EASY)
    settings = SETTINGS.model_copy(update={"space": space})
    path = SamplingPlanner("birrt", settings).plan(asked, seed=0)
    assert path.status == "solved"
    assert asked.manifold.violation(path.joints).max() <= 1e-4
    assert world.free(path.joints).all()


def test_simplification_shortens(world: World) -> None:
    asked = problem(world, LEVEL, HARD)
    paths = [
        SamplingPlanner("birrt", SETTINGS, simplify).plan(asked, seed=0)
        for simplify in (True, False)
    ]
    short, long = (np.linalg.norm(np.diff(path.joints, axis=0), axis=1).sum() for path in paths)
    assert_sound(paths[1], asked, world)
    assert short < long


def test_seed_fixes_the_path_whatever_was_planned_before_and_in_any_process(world: World) -> None:
    asked = problem(world, LEVEL, HARD)
    query = asked.start[None], asked.goal[None]
    with ProcessPoolExecutor(1, get_context("spawn")) as fresh:
        elsewhere = {
            name: fresh.submit(plan_all, name, SETTINGS, world.robot, LEVEL, [TABLE], *query, 3)
            for name in PLANNERS
        }
        for name in reversed(PLANNERS):
            planner = SamplingPlanner(name, SETTINGS)
            other, path = planner.plan(asked, seed=4), planner.plan(asked, seed=3)
            assert path.status == "solved"
            assert not np.array_equal(path.joints, other.joints)
            np.testing.assert_array_equal(path.joints, elsewhere[name].result()[0].joints)


def test_refused_problems_say_why(world: World) -> None:
    level, free = (ConstraintManifold(world.robot, constraint) for constraint in (LEVEL, FREE))
    start, goal = ends(level, world.is_free, 1)
    tilted = start + np.array([0, 0, 0, 0, 0.3, 0])
    beyond = np.array([0, 0, -1.0, 0, 0, 3.6])
    in_table = np.array([0, 1.5, -0.3, 0, 0, 0])
    assert not world.is_free(in_table)
    for first, last, manifold, status in (
        (tilted, goal, level, "start_violates"),
        (start, tilted, level, "goal_violates"),
        (start, beyond, free, "out_of_limits"),
        (in_table, goal, free, "in_collision"),
        (start, in_table, free, "in_collision"),
    ):
        path = SamplingPlanner("birrt", SETTINGS).plan(
            PlanningProblem(first, last, manifold, world.is_free), seed=0
        )
        assert (path.status, path.joints.shape, path.iterations) == (status, (0, 6), 0)


@pytest.mark.parametrize("name", PLANNERS)
def test_search_without_a_way_ends_after_its_iterations(name: PlannerName, world: World) -> None:
    manifold = ConstraintManifold(world.robot, FREE)
    start, goal = np.array([-1.0, 0, -1.0, 0, 0, 0]), np.array([1.0, 0, -1.0, 0, 0, 0])
    walled = PlanningProblem(start, goal, manifold, lambda q: abs(q[0]) > 0.2)
    counts = {"prm_iterations": 30, "rrt_star_iterations": 40, "birrt_iterations": 50}
    path = SamplingPlanner(name, SETTINGS.model_copy(update=counts)).plan(walled, seed=0)
    assert path.status == "not_found"
    assert path.joints.shape == (0, 6)
    assert counts[f"{name}_iterations"] - 5 < path.iterations <= counts[f"{name}_iterations"]

    endless = SETTINGS.model_copy(update=dict.fromkeys(counts, 10**9) | {"budget_s": 0.1})
    began = time.perf_counter()
    assert SamplingPlanner(name, endless).plan(walled, seed=0).status == "not_found"
    assert time.perf_counter() - began < 2.0


def test_all_axes_held_leave_no_way(world: World) -> None:
    asked = problem(world, FREE, 1)
    position, rotation = world.robot.forward(asked.start)
    held = ConstraintManifold(world.robot, Constraint((1,) * 6, reference=Pose(position, rotation)))
    stuck = PlanningProblem(asked.start, asked.start, held, world.is_free)
    answer = SamplingPlanner("birrt", SETTINGS).plan(stuck, seed=0)
    assert answer.status == "not_applicable"
    assert "isolated points" in answer.explanation


def test_relaxed_cup_uses_its_band_and_stays_in_it(world: World) -> None:
    asked = problem(world, RELAXED, 10)
    for space in ("atlas", "tangent_bundle"):
        answer = SamplingPlanner("birrt", SETTINGS.model_copy(update={"space": space})).plan(
            asked, seed=0
        )
        assert answer.status == "not_applicable"
        assert "no tangent spaces" in answer.explanation
    path = SamplingPlanner("birrt", SETTINGS).plan(asked, seed=0)
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
        settings = SETTINGS.model_copy(update={"rrt_star_iterations": 1500})
        for name in PLANNERS:
            assert_sound(SamplingPlanner(name, settings).plan(asked, seed=0), asked, world)


def test_seven_joints_need_no_other_code() -> None:
    iiwa = load_robot(data_path() / "kuka_iiwa/model.urdf", "lbr_iiwa_link_7")
    with World(iiwa) as world:
        asked = problem(world, LEVEL, 2)
        assert asked.start.shape == (7,)
        assert_sound(SamplingPlanner("birrt", SETTINGS).plan(asked, seed=0), asked, world)


def test_all_queries_keep_their_place(world: World) -> None:
    level = ConstraintManifold(world.robot, LEVEL)
    starts, goals = ends(level, world.is_free, 1, 4).reshape(2, 2, 6)
    starts[0, 4] += 0.3
    first, second = plan_all("birrt", SETTINGS, world.robot, LEVEL, [TABLE], starts, goals, 0)
    assert first.status == "start_violates"
    assert_sound(second, PlanningProblem(starts[1], goals[1], level, world.is_free), world)
