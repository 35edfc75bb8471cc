from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from tests.planner_fixtures import manifold_of, packaged_learned, packaged_planner, pairs_of

from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.peers.gradient_geodesic import GradientGeodesic, GradientGeodesicSettings
from constraint_geodesics.peers.latent_geodesic import executable
from constraint_geodesics.peers.straight_latent import StraightLatent
from constraint_geodesics.problem import PlanningProblem, Solution
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.world import World

NAMES = ("free", "level_cup", "level_cup_relaxed", "slide", "fixed_orientation")


@dataclass(frozen=True)
class Bench:
    """The packaged chart, a world to plan in and the judge."""

    chart: LearnedManifold
    world: World
    judge: Certifier

    def problem(
        self, name: str, seed: int, manifold: ConstraintManifold | None = None
    ) -> PlanningProblem:
        start, goal = pairs_of(name, 1, seed)[0]
        return PlanningProblem(
            start, goal, manifold or manifold_of(packaged_planner(), name), self.world.is_free
        )

    def assert_sound(self, path: Solution, problem: PlanningProblem) -> None:
        np.testing.assert_array_equal(path.joints[[0, -1]], [problem.start, problem.goal])
        found = self.judge.certify(
            path.joints, problem.manifold.constraint, problem.start, problem.goal
        )
        assert found.violation is None, found.violation


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    planner = packaged_planner()
    with planner.scene.world() as world, Certifier(planner.scene) as judge:
        yield Bench(LearnedManifold.from_arrays(packaged_learned().manifold), world, judge)


def length(path: Solution) -> float:
    return float(np.linalg.norm(np.diff(path.joints, axis=0), axis=1).sum())


@pytest.mark.parametrize("name", NAMES)
def test_curves_keep_the_constraint_and_descent_shortens_them(bench: Bench, name: str) -> None:
    solved = 0
    for seed in range(3):
        problem = bench.problem(name, seed)
        straight, geodesic = (
            p.plan(problem, 0) for p in (StraightLatent(bench.chart), GradientGeodesic(bench.chart))
        )
        for path in (straight, geodesic):
            assert path.status in ("solved", "not_found")
            assert (len(path.joints) > 0) == (path.status == "solved")
            if path.status == "solved":
                bench.assert_sound(path, problem)
        if straight.status == "solved":
            assert geodesic.status == "solved"
            assert length(geodesic) <= length(straight) * (1.0 + 1e-4)
        solved += geodesic.status == "solved"
    assert solved >= 2


def test_without_a_constraint_the_geodesic_is_the_straight_joint_line(bench: Bench) -> None:
    problem = bench.problem("free", 0)
    path = GradientGeodesic(bench.chart).plan(problem, 0)
    assert length(path) == pytest.approx(np.linalg.norm(problem.goal - problem.start), rel=2e-3)


def test_same_seed_same_path_and_another_seed_another_search(bench: Bench) -> None:
    planner, problem = (
        GradientGeodesic(bench.chart, GradientGeodesicSettings(drawn=64)),
        bench.problem("level_cup", 1),
    )
    first, again, other = (planner.plan(problem, seed) for seed in (3, 3, 4))
    assert first.status == "solved"
    np.testing.assert_array_equal(first.joints, again.joints)
    assert first.iterations == again.iterations
    assert other.status == "solved"


def test_refused_ends_come_without_a_path(bench: Bench) -> None:
    problem = bench.problem("level_cup", 0)
    tilted = problem.start + np.array([0, 0, 0, 0, 0.3, 0])
    beyond = problem.start + np.array([8.0, 0, 0, 0, 0, 0])  # turning the base keeps the cup level
    for first, last, status in (
        (tilted, problem.goal, "start_violates"),
        (problem.start, tilted, "goal_violates"),
        (problem.start, beyond, "out_of_limits"),
    ):
        asked = PlanningProblem(first, last, problem.manifold, bench.world.is_free)
        for planner in (StraightLatent(bench.chart), GradientGeodesic(bench.chart)):
            path = planner.plan(asked, 0)
            assert (path.status, path.joints.shape, path.iterations) == (status, (0, 6), 0)
    walled = PlanningProblem(
        problem.start, problem.goal, problem.manifold, lambda q: bool(q is problem.goal)
    )
    assert StraightLatent(bench.chart).plan(walled, 0).status == "in_collision"


def test_a_chart_of_another_robot_does_not_apply(bench: Bench, kuka: SerialRobot) -> None:
    middle = 0.5 * (kuka.lower + kuka.upper)
    asked = PlanningProblem(
        middle, middle + 0.1, ConstraintManifold(kuka, Constraint((0,) * 6)), lambda _: True
    )
    for planner in (StraightLatent(bench.chart), GradientGeodesic(bench.chart)):
        path = planner.plan(asked, 0)
        assert (path.status, path.joints.shape) == ("not_applicable", (0, 7))
        assert "7" in path.explanation


def test_a_query_from_a_configuration_to_itself_stands_still(bench: Bench) -> None:
    problem = bench.problem("level_cup", 0)
    standing = PlanningProblem(problem.start, problem.start, problem.manifold, bench.world.is_free)
    for planner in (StraightLatent(bench.chart), GradientGeodesic(bench.chart)):
        path = planner.plan(standing, 0)
        assert path.status == "solved"
        assert (
            length(path) < 1e-3
        )  # an end is retracted to within 1e-4 of the constraint, not to it


def test_what_collides_everywhere_is_not_found(bench: Bench) -> None:
    problem = bench.problem("level_cup", 0)

    def only_ends(q: np.ndarray) -> bool:
        return any(np.array_equal(q, end) for end in (problem.start, problem.goal))

    walled = PlanningProblem(problem.start, problem.goal, problem.manifold, only_ends)
    few = GradientGeodesic(bench.chart, GradientGeodesicSettings(drawn=32, starts=4, rounds=1))
    for planner in (StraightLatent(bench.chart), few):
        assert planner.plan(walled, 0).status == "not_found"


def test_geodesic_goes_around_a_box_that_the_straight_line_hits(bench: Bench) -> None:
    scene = packaged_planner().scene
    manifold = manifold_of(packaged_planner(), "level_cup")
    free = StraightLatent(bench.chart).plan(bench.problem("level_cup", 2), 0)
    middle = free.joints[len(free.joints) // 2]
    tool = scene.robot.forward(middle)[0]
    box = Box("post", tuple(float(x) for x in tool), (0.08, 0.08, 0.08))
    workcell = (*scene.workcell, box)
    with World(scene.robot, workcell) as world:
        model = clearance_model(scene.robot, workcell)
        blocked = PlanningProblem(free.joints[0], free.joints[-1], manifold, world.is_free, model)
        assert StraightLatent(bench.chart).plan(blocked, 0).status == "not_found"
        path = GradientGeodesic(bench.chart).plan(blocked, 0)
        assert path.status == "solved"
        assert world.free(path.joints).all()
        bench.assert_sound(path, blocked)


def test_rows_are_drawn_where_lines_would_leave_the_constraint_and_jumps_are_refused(
    bench: Bench,
) -> None:
    manifold = manifold_of(packaged_planner(), "level_cup")
    path = StraightLatent(bench.chart).plan(bench.problem("level_cup", 2), 0).joints
    rows = executable(manifold, path[::5])
    assert rows is not None
    assert manifold.violation(0.5 * (rows[1:] + rows[:-1])).max() <= 1e-4
    assert all((rows == row).all(axis=1).any() for row in path[::5])
    apart = pairs_of("tool_down", 1, 0, joined=False)[0]  # on two sheets
    assert executable(manifold_of(packaged_planner(), "tool_down"), np.stack(apart)) is None


def test_misuse_names_the_value() -> None:
    for setting in ("starts", "polished", "rounds"):
        with pytest.raises(ValueError, match=setting):
            GradientGeodesicSettings(**{setting: 0})
