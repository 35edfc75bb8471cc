"""What a user may write for a goal, as goals."""

from typing import Any

import numpy as np

from constraint_geodesics.constraints.constraint import Pose
from constraint_geodesics.goals.goal import ConfigurationGoal, Goal, checked_configuration
from constraint_geodesics.goals.pose import PoseGoal
from constraint_geodesics.problem import PlannerError


def as_goals(goal: Any, dof: int) -> tuple[Goal, ...]:
    """Goals as they are, numbers as a configuration's, a pose as a PoseGoal, and those of a list,
    or of the rows of a table.  Raises PlannerError if it is none of these, or a list of nothing.
    """
    if goal is None or (isinstance(goal, list | tuple) and not goal):
        # numpy takes None too
        raise PlannerError(f"goal has shape {np.shape(goal)}: there is no goal")  # type: ignore[arg-type]
    # numbers first: asking for the protocol takes longer than looking at both ends
    if isinstance(goal, np.ndarray) and goal.ndim == 2:
        goal = list(goal)
    if type(goal) in (list, tuple) and goal and not any(map(_is_number, goal)):
        return tuple(own for one in goal for own in as_goals(one, dof))
    if type(goal) not in (np.ndarray, list, tuple):
        if isinstance(goal, Pose):
            return (PoseGoal(goal),)
        if isinstance(goal, Goal):
            return (goal,)
    return (ConfigurationGoal(checked_configuration(goal, dof, "goal")),)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number | str)
