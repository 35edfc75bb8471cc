"""What a query may ask to reach: configurations, poses, regions, lists of them, and any class that
names configurations by the seam.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest
from tests.planner_fixtures import packaged_planner, pairs_of

from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.goals.goal import ConfigurationGoal, Goal
from constraint_geodesics.goals.region import GoalRegion
from constraint_geodesics.goals.wanted import as_goals
from constraint_geodesics.problem import PlannerError
from constraint_geodesics.robot.kinematics import rotation_from_rpy


@dataclass(frozen=True, eq=False)
class AnyOf:
    """Whichever of some configurations is reached by the shortest path."""

    goals: tuple[np.ndarray, ...]
    region: Constraint | None = None

    @property
    def description(self) -> str:
        return f"any of {len(self.goals)} configurations"

    def configurations(self, manifold: ConstraintManifold, start: np.ndarray) -> Iterator:
        yield from self.goals


class Either(NamedTuple):
    """A goal that is a tuple as well."""

    first: np.ndarray
    second: np.ndarray
    region: None = None

    @property
    def description(self) -> str:
        return "one of two configurations"

    def configurations(self, manifold: ConstraintManifold, start: np.ndarray) -> Iterator:
        yield from self[:2]


def pose_of(q: np.ndarray) -> Pose:
    return Pose(*packaged_planner().robot.forward(q))


def turned(pose: Pose, yaw: float) -> Pose:
    """About the base frame's vertical."""
    return Pose(pose.position, rotation_from_rpy(np.array([0.0, 0.0, yaw])) @ pose.rotation)


def length_to(start: np.ndarray, goal: object, name: str) -> float:
    path = packaged_planner().plan(start, goal, name)
    return path.length_rad if path.status == "solved" else np.inf


def test_numbers_are_a_configuration() -> None:
    start, goal = pairs_of("level_cup", 1, seed=1)[0]
    planner = packaged_planner()
    plain = planner.plan(start, goal, "level_cup")
    typed = planner.plan(start, ConfigurationGoal(goal), "level_cup")
    assert typed.joints.tobytes() == plain.joints.tobytes()
    assert plain.goal.tobytes() == goal.tobytes()
    np.testing.assert_array_equal(as_goals(goal, 6)[0].joints, goal)


def test_a_configuration_of_another_robot_is_refused() -> None:
    start = pairs_of("level_cup", 1, seed=1)[0][0]
    for wrong in (np.zeros(5), np.full(6, np.nan)):
        with pytest.raises(PlannerError, match="goal"):
            packaged_planner().plan(start, ConfigurationGoal(wrong), "level_cup")


def test_a_goal_may_be_a_tuple() -> None:
    start, goal = pairs_of("level_cup", 1, seed=1)[0]
    path = packaged_planner().plan(start, Either(goal + 0.3, goal), "level_cup")
    assert (path.status, path.goal.tobytes()) == ("solved", goal.tobytes())


def test_what_merely_has_configurations_is_no_goal() -> None:
    class Listed:
        configurations = (np.zeros(6),)

    start = pairs_of("level_cup", 1, seed=1)[0][0]
    with pytest.raises(PlannerError, match="goal"):
        packaged_planner().plan(start, Listed(), "level_cup")


def test_another_kind_of_goal_is_planned_to_and_says_what_was_reached() -> None:
    start, goal = pairs_of("level_cup", 1, seed=1)[0]
    off = goal + 0.3
    two = AnyOf((off, goal))
    assert isinstance(two, Goal)
    path = packaged_planner().plan(start, two, "level_cup")
    assert path.status == "solved"
    assert path.goal.tobytes() == goal.tobytes()
    assert "any of 2 configurations" in path.explanation
    alone = packaged_planner().plan(start, AnyOf((off,)), "level_cup")
    assert alone.status == "goal_violates"
    assert alone.goal is None
    nothing = packaged_planner().plan(start, AnyOf(()), "level_cup")
    assert (nothing.status, nothing.goal) == ("not_found", None)
    assert "any of 0 configurations" in nothing.explanation


@pytest.mark.parametrize("name", ["free", "level_cup", "slide"])
def test_the_shortest_path_to_any_of_several_is_the_answer(name) -> None:
    pairs = pairs_of(name, 6, seed=30)
    start, goals = pairs[0][0], [goal for _, goal in pairs]
    best = min(length_to(start, goal, name) for goal in goals)
    for wanted in (goals, np.array(goals), [AnyOf(tuple(goals[:3])), *goals[3:]]):
        path = packaged_planner().plan(start, wanted, name)
        assert path.length_rad == pytest.approx(best, rel=2e-4)
        assert f"any of {len(goals)} configurations" in path.explanation


def test_a_refused_goal_of_several_is_passed_over_and_all_refused_are_told() -> None:
    start, goal = pairs_of("level_cup", 1, seed=1)[0]
    tilted, beyond = goal.copy(), goal.copy()
    tilted[4] += 0.3
    beyond[0] = 4.0
    path = packaged_planner().plan(start, [tilted, beyond, goal], "level_cup")
    assert path.goal.tobytes() == goal.tobytes()
    none = packaged_planner().plan(start, [tilted, tilted - 0.01], "level_cup")
    assert none.status == "goal_violates"
    assert "of 2 configurations of the goal: 2 goal_violates" in none.explanation
    both = packaged_planner().plan(start, [tilted, beyond], "level_cup")
    assert "1 goal_violates, 1 out_of_limits" in both.explanation


@pytest.mark.parametrize("name", ["free", "level_cup", "slide", "tool_down"])
def test_a_pose_is_reached_by_its_shortest_branch(name) -> None:
    planner = packaged_planner()
    for start, goal in pairs_of(name, 4, seed=31):
        pose = pose_of(goal)
        path = planner.plan(start, pose, name)
        assert path.status == "solved", path.explanation
        best = min(length_to(start, q, name) for q in planner.ik(pose))
        assert path.length_rad <= best * (1.0 + 1e-3)
        position, rotation = planner.robot.forward(path.goal)
        np.testing.assert_allclose(position, pose.position, atol=1e-8)
        np.testing.assert_allclose(rotation, pose.rotation, atol=1e-8)


def test_a_pose_that_breaks_the_constraint_or_is_out_of_reach_is_told() -> None:
    planner, (start, goal) = packaged_planner(), pairs_of("level_cup", 1, seed=1)[0]
    level = pose_of(goal)
    tilted = Pose(level.position, rotation_from_rpy(np.array([0.3, 0.0, 0.0])) @ level.rotation)
    path = planner.plan(start, tilted, "level_cup")
    assert path.status == "goal_violates", path.explanation
    far = planner.plan(start, Pose(np.array([3.0, 0.0, 0.0]), level.rotation), "level_cup")
    assert far.status == "not_found"
    assert "(3, 0, 0) m" in far.explanation


def test_a_region_may_leave_free_what_the_constraint_holds() -> None:
    """Place alone is asked for: the cup is level there all the same, and the certificate says how
    well the place is kept.
    """
    planner = packaged_planner()
    for start, goal in pairs_of("level_cup", 3, seed=34):
        region = GoalRegion(pose_of(goal), free=("roll", "pitch", "yaw"))
        path = planner.plan(start, region, "level_cup")
        assert path.status == "solved", path.explanation
        assert path.length_rad <= length_to(start, goal, "level_cup") * 1.001
        position, rotation = planner.robot.forward(path.goal)
        np.testing.assert_allclose(position, region.pose.position, atol=1e-7)
        assert path.certificate.goal_violation < 1e-6
        np.testing.assert_allclose(rotation[2], planner.robot.forward(start)[1][2], atol=2e-4)


def test_a_budget_looks_for_shorter_paths_to_any_of_several() -> None:
    planner = packaged_planner()
    start, goal = pairs_of("tool_down", 1, seed=35)[0]
    first = planner.plan(start, pose_of(goal), "tool_down")
    longer = planner.plan(start, pose_of(goal), "tool_down", budget_s=0.3)
    assert longer.length_rad <= first.length_rad
    assert "configurations" in longer.explanation


def test_the_end_lies_in_the_region_where_the_path_is_shortest() -> None:
    """Against the poses of a grid over the free angle, each with all its branches."""
    planner = packaged_planner()
    for start, goal in pairs_of("level_cup", 3, seed=32):
        pose = pose_of(goal)
        path = planner.plan(start, GoalRegion(pose, free=("yaw",)), "level_cup")
        assert path.status == "solved", path.explanation
        position, rotation = planner.robot.forward(path.goal)
        np.testing.assert_allclose(position, pose.position, atol=1e-7)
        np.testing.assert_allclose(rotation[2], pose.rotation[2], atol=1e-7)
        grid = np.linspace(-np.pi, np.pi, 24, endpoint=False)
        best = min(length_to(start, turned(pose, yaw), "level_cup") for yaw in grid)
        assert path.length_rad <= best * 1.01


def test_a_box_of_tolerance_is_used_and_kept() -> None:
    planner = packaged_planner()
    start, goal = pairs_of("free", 1, seed=33)[0]
    pose, tolerance = pose_of(goal), (0.05, 0.02, 0.0, 0.2, 0.2, 0.2)
    exact = planner.plan(start, pose, "free")
    loose = planner.plan(start, GoalRegion(pose, tolerance=tolerance), "free")
    assert loose.length_rad < exact.length_rad - 0.01
    region = GoalRegion(pose, tolerance=tolerance).region
    assert ConstraintManifold(planner.robot, region).violation(loose.goal) < 1e-6
    off = planner.robot.forward(loose.goal)[0] - pose.position
    assert np.abs(off).max() == pytest.approx(0.05, abs=1e-4), "up to its edge"
    assert abs(off[2]) < 1e-6


@pytest.mark.parametrize(
    ("free", "tolerance", "said"),
    [
        (("yow",), (0.0,) * 6, "free = 'yow'.*yaw"),
        (("yaw",), (0.0, 0.0, 0.0, 0.0, 0.0, 0.1), "yaw.*free"),
        ((), (0.1,) * 5, "5 entries"),
        ((), (-0.1,) * 6, "not negative"),
        ((), ("a",) * 6, "goal region"),
    ],
)
def test_a_region_that_makes_no_sense_is_refused(free, tolerance, said) -> None:
    with pytest.raises(PlannerError, match=said):
        GoalRegion(Pose(np.zeros(3), np.eye(3)), free, tolerance)


@pytest.mark.parametrize(
    "wanted", [[], np.empty((0, 6)), "here", 3.0, [None], [0.0, [0.0]], [[0.0] * 5] * 2]
)
def test_what_is_no_goal_is_refused(wanted) -> None:
    start = pairs_of("free", 1, seed=1)[0][0]
    with pytest.raises(PlannerError, match="goal"):
        packaged_planner().plan(start, wanted, "free")


def test_a_region_whose_angles_the_constraint_holds_elsewhere_is_refused_at_once() -> None:
    """Both hold roll and pitch, at two references."""
    planner = packaged_planner()
    start = pairs_of("fixed_orientation", 1, seed=4)[0][0]
    position, rotation = planner.robot.forward(start)
    tilted = rotation_from_rpy(np.array([0.3, 0.0, 0.0])) @ rotation
    region = GoalRegion(Pose(position, tilted), free=["yaw"])
    answer = planner.plan(start, region, "fixed_orientation")
    assert answer.status == "goal_violates", answer.explanation
