"""The seam of the planners: a problem between two configurations, the path as it is executed, and who plans it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.vector import ConstraintManifold

SATISFIED = 1e-4
"""Largest violation [rad or m] at which a configuration still keeps its constraint."""

Status = Literal[
    "solved",
    "not_found",
    "start_violates",
    "goal_violates",
    "out_of_limits",
    "start_in_collision",
    "goal_in_collision",
]


@dataclass(frozen=True)
class PlanningProblem:
    """Get from `start` to `goal` on the constraint manifold without a collision."""

    start: Float[np.ndarray, "D"]
    """First configuration [rad]."""
    goal: Float[np.ndarray, "D"]
    """Last configuration [rad]."""
    manifold: ConstraintManifold
    is_free: Callable[[np.ndarray], bool]
    """Whether one configuration (D,) touches neither itself nor the workcell."""


@dataclass(frozen=True)
class PlannedPath:
    """What a planner answers: a status, and the path if there is one."""

    status: Status
    """A status other than "solved" comes without a path."""
    joints: Float[np.ndarray, "T D"]
    """The configurations [rad] as they are executed, ends included; (0, D) if there is no path."""
    time_s: float
    """Wall-clock time from the problem to these configurations."""
    iterations: int
    """How often the planner's own loop ran; for a roadmap, its samples."""


class PathPlanner(Protocol):
    """Plans one problem at a time; the same problem and seed give the same path."""

    @property
    def name(self) -> str:
        """The name results are listed under."""
        ...

    def plan(self, problem: PlanningProblem, seed: int) -> PlannedPath:
        """Look for a path; that there is none is an answer, not an error."""
        ...


def refusal(problem: PlanningProblem) -> Status | None:
    """Why no planner needs to look at this problem, or None if both ends can be reached by a robot."""
    if problem.manifold.violation(problem.start) > SATISFIED:
        return "start_violates"
    if problem.manifold.violation(problem.goal) > SATISFIED:
        return "goal_violates"
    if problem.manifold.robot.limit_distance(np.stack([problem.start, problem.goal])).min() < 0.0:
        return "out_of_limits"
    if not problem.is_free(problem.start):
        return "start_in_collision"
    if not problem.is_free(problem.goal):
        return "goal_in_collision"
    return None
