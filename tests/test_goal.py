"""A goal is a set of configurations: one by default, any class that names some by the seam."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.goal import ConfigurationGoal, Goal, as_goal
from constraint_geodesics.problem import PlannerError
from tests.planner_fixtures import packaged_planner, pairs_of


@dataclass(frozen=True, eq=False)
class AnyOf:
    """Whichever of some configurations is reached first."""

    goals: tuple[np.ndarray, ...]

    @property
    def description(self) -> str:
        return f"any of {len(self.goals)} configurations"

    def configurations(self, manifold: ConstraintManifold, start: np.ndarray) -> Iterator:
        yield from self.goals


def test_numbers_are_a_configuration() -> None:
    start, goal = pairs_of("level_cup", 1, seed=1)[0]
    planner = packaged_planner()
    plain = planner.plan(start, goal, "level_cup")
    typed = planner.plan(start, ConfigurationGoal(goal), "level_cup")
    assert typed.joints.tobytes() == plain.joints.tobytes()
    assert plain.goal.tobytes() == goal.tobytes()
    np.testing.assert_array_equal(as_goal(goal, 6).joints, goal)


def test_a_configuration_of_another_robot_is_refused() -> None:
    start = pairs_of("level_cup", 1, seed=1)[0][0]
    for wrong in (np.zeros(5), np.full(6, np.nan)):
        with pytest.raises(PlannerError, match="goal"):
            packaged_planner().plan(start, ConfigurationGoal(wrong), "level_cup")


class Either(NamedTuple):
    """A goal that is a tuple as well."""

    first: np.ndarray
    second: np.ndarray

    @property
    def description(self) -> str:
        return "one of two configurations"

    def configurations(self, manifold: ConstraintManifold, start: np.ndarray) -> Iterator:
        yield from self


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
    alone = packaged_planner().plan(start, AnyOf((off,)), "level_cup")
    assert alone.status == "goal_violates"
    assert alone.goal is None
    nothing = packaged_planner().plan(start, AnyOf(()), "level_cup")
    assert (nothing.status, nothing.goal) == ("not_found", None)
    assert "any of 0 configurations" in nothing.explanation
