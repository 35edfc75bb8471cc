from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from tests.planner_fixtures import NAMES, assert_sound, manifold_of, packaged_planner, problems

from constraint_geodesics.certification.certifier import Certifier, Limits
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold
from constraint_geodesics.peers.elastic_band import rows_along, uniform_configurations
from constraint_geodesics.peers.many_bands import MultiStartBand
from constraint_geodesics.peers.ompl import SamplingPlanner
from constraint_geodesics.peers.ompl_settings import OmplSettings
from constraint_geodesics.peers.straight_band import StraightBand
from constraint_geodesics.peers.wrappers import BandAfter, band_after
from constraint_geodesics.problem import PathPlanner, PlanningProblem, Solution
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.world import World
from constraint_geodesics.search.band import BandSettings

BIRRT = SamplingPlanner("birrt", OmplSettings(budget_s=60.0, iterations=300))
PLANNERS: tuple[PathPlanner, ...] = (StraightBand(), MultiStartBand(8), BandAfter(BIRRT))
PILLAR = Box("pillar", (0.45, 0.0, 0.5), (0.1, 0.1, 1.0))


def length(joints: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(joints, axis=0), axis=1).sum())


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("planner", PLANNERS, ids=lambda planner: planner.name)
def test_paths_are_certified(
    planner: PathPlanner, name: str, world: World, certifier: Certifier
) -> None:
    solved = 0
    for asked in problems(world, name, 3):
        path = planner.plan(asked, seed=1)
        if path.status == "solved":
            assert_sound(path, asked, certifier)
            solved += 1
        else:
            assert (path.status, path.joints.shape) == ("not_found", (0, 6))
    assert solved


@pytest.mark.parametrize("planner", PLANNERS, ids=lambda planner: planner.name)
def test_seed_fixes_the_path(planner: PathPlanner, world: World) -> None:
    first, other = problems(world, "level_cup", 2)
    once = planner.plan(first, seed=5)
    planner.plan(other, seed=6)
    again = planner.plan(first, seed=5)
    assert once.status == "solved"
    np.testing.assert_array_equal(once.joints, again.joints)


def test_many_starts_are_no_longer_than_one_and_the_band_no_longer_than_its_path(
    world: World,
) -> None:
    for asked in problems(world, "level_cup", 4):
        straight, many = StraightBand().plan(asked, 0), MultiStartBand(8).plan(asked, 0)
        if straight.status == "solved":
            assert many.status == "solved"
            assert length(many.joints) <= length(straight.joints) * (1 + 1e-6)
        given = BIRRT.plan(asked, 0)
        after = band_after(asked, given, BandSettings())
        assert after.status == given.status == "solved"
        assert length(after.joints) <= length(given.joints) * (
            1 + 1e-3
        )  # lines between far rows cut corners
        assert after.time_s > given.time_s


def test_many_starts_depend_on_the_seed_where_the_straight_one_fails(world: World) -> None:
    for asked in problems(world, "slide", 20):
        if (
            StraightBand().plan(asked, 0).status == "not_found"
            and MultiStartBand(32).plan(asked, 0).status == "solved"
        ):
            few = [MultiStartBand(2).plan(asked, seed) for seed in range(6)]
            assert len({path.joints.tobytes() for path in few}) > 1
            break
    else:
        pytest.fail("no query where bends help")


@pytest.mark.parametrize("planner", PLANNERS, ids=lambda planner: planner.name)
def test_refused_problems_say_why(planner: PathPlanner, world: World) -> None:
    asked = problems(world, "level_cup", 1)[0]
    tilted = asked.start + np.array([0, 0, 0, 0, 0.3, 0])
    free = ConstraintManifold(world.robot, Constraint((0,) * 6))
    beyond, in_table = np.array([0, 0, -1.0, 0, 0, 3.6]), np.array([0, 1.5, -0.3, 0, 0, 0])
    for wrong, status in (
        (replace(asked, start=tilted), "start_violates"),
        (replace(asked, goal=tilted), "goal_violates"),
        (replace(asked, goal=beyond, manifold=free), "out_of_limits"),
        (replace(asked, start=in_table, manifold=free), "in_collision"),
        (replace(asked, goal=in_table, manifold=free), "in_collision"),
    ):
        path = planner.plan(wrong, seed=0)
        assert (path.status, path.joints.shape, path.iterations) == (status, (0, 6), 0)


@pytest.mark.parametrize(
    "planner", [StraightBand(), MultiStartBand(4)], ids=lambda planner: planner.name
)
def test_ends_that_coincide_are_a_path(planner: PathPlanner, world: World) -> None:
    asked = problems(world, "level_cup", 1)[0]
    path = planner.plan(replace(asked, goal=asked.start.copy()), seed=0)
    assert path.status == "solved"
    np.testing.assert_array_equal(path.joints, [asked.start, asked.start])


def walled(world: World, is_free: Callable[[np.ndarray], bool]) -> PlanningProblem:
    free = ConstraintManifold(world.robot, Constraint((0,) * 6))
    start, goal = np.array([-1.0, 0, -1.0, 0, 0, 0]), np.array([1.0, 0, -1.0, 0, 0, 0])
    return PlanningProblem(start, goal, free, is_free)


def test_what_the_boxes_do_not_say_is_checked(world: World) -> None:
    asked = walled(world, lambda q: bool(abs(q[0]) > 0.2))
    for planner in (StraightBand(), MultiStartBand(4)):
        path = planner.plan(asked, seed=0)
        assert (path.status, path.joints.shape) == ("not_found", (0, 6))


def test_path_itself_where_every_band_touches_something(world: World) -> None:
    corner = np.array([0.0, -1.2, -1.0, 0, 0, 0])

    def is_free(q: np.ndarray) -> bool:
        return bool(
            abs(q[1] - corner[1] * (1.0 - abs(q[0]))) < 1e-6
        )  # on the two lines past the corner only

    asked = walled(world, is_free)
    lines = [np.linspace(a, b, 40) for a, b in ((asked.start, corner), (corner, asked.goal))]
    given = Solution("solved", np.concatenate([lines[0], lines[1][1:]]), 0.5, 7)
    after = band_after(asked, given, BandSettings())
    assert after.status == "solved"
    assert length(after.joints) == pytest.approx(length(given.joints))
    np.testing.assert_array_equal(after.joints[[0, -1]], given.joints[[0, -1]])
    assert after.iterations > 7
    nothing = Solution("not_found", np.empty((0, 6)), 0.5, 7)
    assert band_after(asked, nothing, BandSettings()) is nothing


def test_a_pillar_is_gone_around(scene: Scene) -> None:
    around = Scene(scene.robot, (*scene.workcell, PILLAR))
    manifold = ConstraintManifold(scene.robot, Constraint((0,) * 6))
    start, goal = (np.array([angle, 0.3, -1.2, 0.0, 0.9, 0.0]) for angle in (-0.8, 0.8))
    with around.world() as loaded, Certifier(around, Limits()) as judge:
        clearance = clearance_model(around.robot, around.workcell)
        asked = PlanningProblem(start, goal, manifold, loaded.is_free, clearance)
        assert not loaded.free(start + np.linspace(0, 1, 50)[:, None] * (goal - start)).all()
        path = BandAfter(BIRRT).plan(asked, seed=0)
        assert_sound(path, asked, judge)
        assert (
            np.linalg.norm(goal - start)
            < length(path.joints)
            < 0.98 * length(BIRRT.plan(asked, seed=0).joints)
        )


@pytest.mark.parametrize("name", NAMES)
def test_configurations_are_on_the_constraint(name: str) -> None:
    manifold = manifold_of(packaged_planner(), name)
    drawn = uniform_configurations(manifold, 20, np.random.default_rng(0))
    assert drawn.shape == (20, 6)
    assert manifold.violation(drawn).max() <= 1e-8
    assert manifold.robot.limit_distance(drawn).min() >= 0.0


def test_rows_keep_the_constraint_between_them(world: World) -> None:
    asked = problems(world, "level_cup", 1)[0]
    found = BIRRT.plan(asked, 0).joints
    given = np.concatenate([found[:-1:3], found[-1:]])
    rows = rows_along(asked.manifold, given)
    np.testing.assert_array_equal(rows[[0, -1]], given[[0, -1]])
    halfway = asked.manifold.violation(0.5 * (rows[1:] + rows[:-1])).max()
    assert halfway <= 1e-4 < asked.manifold.violation(0.5 * (given[1:] + given[:-1])).max()


def test_seven_joints_need_no_other_code(kuka_scene: Scene) -> None:
    manifold = ConstraintManifold(kuka_scene.robot, packaged_planner().constraints["level_cup"])
    drawn = uniform_configurations(manifold, 60, np.random.default_rng(2))
    with kuka_scene.world() as loaded, Certifier(kuka_scene, Limits()) as judge:
        start, goal = drawn[loaded.free(drawn)][:2]
        asked = PlanningProblem(start, goal, manifold, loaded.is_free)
        path = MultiStartBand(16).plan(asked, 0)
        assert_sound(path, asked, judge)


def test_fewer_configurations_make_fewer_starts(world: World) -> None:
    asked = problems(world, "level_cup", 1)[0]
    assert (
        MultiStartBand(8, lambda manifold, count, rng: np.empty((0, 6))).plan(asked, 0).iterations
        == 1
    )
    assert MultiStartBand(8).plan(asked, 0).iterations == 8


def test_the_band_is_named_after_its_planner() -> None:
    assert BandAfter(MultiStartBand(name="bends")).name == "bends + band"
