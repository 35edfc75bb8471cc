from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.planner_fixtures import (
    assert_sound,
    length,
    manifold_of,
    packaged_planner,
    pairs_of,
    problem,
)

from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.peers import gradient_geodesic
from constraint_geodesics.peers.gradient_geodesic import GradientGeodesic, GradientGeodesicSettings
from constraint_geodesics.peers.latent_geodesic import executable, first_curves
from constraint_geodesics.peers.straight_latent import StraightLatent
from constraint_geodesics.problem import PlanningProblem, Solution
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.world import World

NAMES = ("free", "level_cup", "level_cup_relaxed", "slide", "fixed_orientation")


def solved_straight(chart: LearnedManifold, world: World) -> Solution:
    """A straight latent line that is a path."""
    paths = (StraightLatent(chart).plan(problem(world, "level_cup", k), 0) for k in range(9))
    return next(path for path in paths if path.status == "solved")


@pytest.mark.parametrize("name", NAMES)
def test_curves_keep_the_constraint_and_descent_shortens_them(
    chart: LearnedManifold, world: World, certifier: Certifier, name: str
) -> None:
    solved = 0
    for seed in range(6):
        asked = problem(world, name, seed)
        straight, geodesic = (
            p.plan(asked, 0) for p in (StraightLatent(chart), GradientGeodesic(chart))
        )
        for path in (straight, geodesic):
            assert path.status in ("solved", "not_found")
            assert (len(path.joints) > 0) == (path.status == "solved")
            if path.status == "solved":
                assert_sound(path, asked, certifier)
        if straight.status == "solved":
            assert geodesic.status == "solved"
            assert length(geodesic.joints) <= length(straight.joints) * (1.0 + 1e-4)
        solved += geodesic.status == "solved"
    assert solved >= 4


def test_without_a_constraint_the_geodesic_is_the_straight_joint_line(
    chart: LearnedManifold, world: World
) -> None:
    asked = problem(world, "free", 0)
    path = GradientGeodesic(chart).plan(asked, 0)
    assert length(path.joints) == pytest.approx(np.linalg.norm(asked.goal - asked.start), rel=2e-3)


def test_same_seed_same_path_and_another_seed_another_search(
    chart: LearnedManifold, world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    planner = GradientGeodesic(chart, GradientGeodesicSettings(drawn=64))
    asked, begun = problem(world, "level_cup", 1), list[np.ndarray]()

    def first_of(*given: Any) -> np.ndarray:
        begun.append(first_curves(*given))
        return begun[-1]

    def searched(seed: int) -> tuple[Solution, np.ndarray]:
        begun.clear()
        return planner.plan(asked, seed), begun[0]

    monkeypatch.setattr(gradient_geodesic, "first_curves", first_of)
    (first, curves), (again, same), (other, others) = map(searched, (3, 3, 4))
    assert first.status == "solved"
    np.testing.assert_array_equal(first.joints, again.joints)
    np.testing.assert_array_equal(curves, same)
    assert first.iterations == again.iterations
    assert other.status == "solved"
    assert not np.array_equal(curves, others), "other curves are gone on from"


def test_a_chart_of_another_robot_does_not_apply(chart: LearnedManifold, kuka: SerialRobot) -> None:
    middle = 0.5 * (kuka.lower + kuka.upper)
    asked = PlanningProblem(
        middle, middle + 0.1, ConstraintManifold(kuka, Constraint((0,) * 6)), lambda _: True
    )
    for planner in (StraightLatent(chart), GradientGeodesic(chart)):
        path = planner.plan(asked, 0)
        assert (path.status, path.joints.shape) == ("not_applicable", (0, 7))
        assert "7" in path.explanation


def test_a_query_from_a_configuration_to_itself_stands_still(
    chart: LearnedManifold, world: World
) -> None:
    asked = problem(world, "level_cup", 0)
    standing = replace(asked, goal=asked.start)
    for planner in (StraightLatent(chart), GradientGeodesic(chart)):
        path = planner.plan(standing, 0)
        assert path.status == "solved"
        assert (
            length(path.joints) < 1e-3
        )  # an end is retracted to within 1e-4 of the constraint, not to it


def test_geodesic_goes_around_a_box_that_the_straight_line_hits(
    chart: LearnedManifold, world: World, certifier: Certifier
) -> None:
    scene = packaged_planner().scene.now
    manifold = manifold_of(packaged_planner(), "level_cup")
    free = solved_straight(chart, world)
    middle = free.joints[len(free.joints) // 2]
    tool = scene.robot.forward(middle)[0]
    box = Box("post", tuple(float(x) for x in tool), (0.08, 0.08, 0.08))
    workcell = (*scene.workcell, box)
    with World(scene.robot, workcell) as fuller:
        model = clearance_model(replace(scene, workcell=workcell))
        blocked = PlanningProblem(free.joints[0], free.joints[-1], manifold, fuller.is_free, model)
        assert StraightLatent(chart).plan(blocked, 0).status == "not_found"
        path = GradientGeodesic(chart).plan(blocked, 0)
        assert path.status == "solved"
        assert fuller.free(path.joints).all()
        assert_sound(path, blocked, certifier)


def test_rows_are_drawn_where_lines_would_leave_the_constraint_and_jumps_are_refused(
    chart: LearnedManifold, world: World
) -> None:
    manifold = manifold_of(packaged_planner(), "level_cup")
    path = solved_straight(chart, world).joints
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
