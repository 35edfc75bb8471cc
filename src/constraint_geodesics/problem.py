"""The seam of the planners: a problem between two configurations, its solution and status, and who
plans it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.scene.clearance import ClearanceModel

SATISFIED = 1e-4
"""Largest violation [rad or m] at which a configuration still keeps its constraint."""

CHECK_SPACING = 0.05
"""Distance of the configurations [rad] at which a path is looked at where no proof is at hand."""

LIMIT_SLACK = 1e-9
"""How far beyond a limit an end may lie [rad], by rounding."""

Status = Literal[
    "solved",
    "not_found",
    "not_connected",
    "start_violates",
    "goal_violates",
    "out_of_limits",
    "in_collision",
    "not_applicable",
    "stopped",
]
"""How a query ended, for the planner and every baseline alike.  not_applicable: it cannot work on
such a problem at all.  stopped: of a motion under way, that it stops on its path and goes no
further, certified by `replan`; waypoints that `Trajectory.stop` draws anew are not.  Where the
status does not say it all, an explanation does.
"""


class PlannerError(ValueError):
    """A question that makes no sense; the message names the value and what is allowed."""


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
    clearance: ClearanceModel | None = None
    """Distances of what may meet, for planners that use them; None if unknown."""
    is_clear: Callable[[np.ndarray], bool] | None = None
    """Whether the straight lines between rows (T, D) touch nothing; None if `is_free` is all that
    is known.
    """
    is_sound: Callable[[np.ndarray], bool] | None = None
    """Whether a whole path (T, D) is certified, for planners that are asked again where it is not;
    None where nobody looks.
    """

    def keeps_clear(self, rows: Float[np.ndarray, "T D"]) -> bool:
        """Whether a path touches nothing on its whole way, where that is known, else at
        configurations CHECK_SPACING apart; the ends are known to be free.
        """
        if self.is_clear is not None:
            return self.is_clear(rows)
        passed = np.insert(np.cumsum(np.linalg.norm(np.diff(rows, axis=0), axis=1)), 0, 0.0)
        at = np.linspace(0.0, passed[-1], int(np.ceil(passed[-1] / CHECK_SPACING)) + 1)[1:-1]
        points = np.stack([np.interp(at, passed, column) for column in rows.T], axis=1)
        return all(self.is_free(q) for q in points)


@dataclass(frozen=True)
class Solution:
    """What a planner answers: a status, and the path if there is one."""

    status: Status
    """A status other than "solved" comes without a path."""
    joints: Float[np.ndarray, "T D"]
    """The configurations [rad] as they are executed, ends included; (0, D) if there is no path."""
    time_s: float
    """Wall-clock time from the problem to these configurations."""
    iterations: int
    """How often the planner's own loop ran; for a roadmap, its samples."""
    explanation: str = ""
    """Why there is no path, where the status does not say it all."""


class PathPlanner(Protocol):
    """Plans one problem at a time; the same problem and seed give the same path."""

    @property
    def name(self) -> str:
        """The name results are listed under."""
        ...

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """Look for a path; that there is none is an answer, not an error."""
        ...


def refusal(problem: PlanningProblem) -> Status | None:
    """Why no planner needs to look at this problem, or None if both ends can be reached by a
    robot.
    """
    for end in ("start", "goal"):
        violated = end_refused(problem.manifold, getattr(problem, end), end)
        if violated is not None:
            return violated
    if not (problem.is_free(problem.start) and problem.is_free(problem.goal)):
        return "in_collision"
    return None


def end_refused(
    manifold: ConstraintManifold, q: Float[np.ndarray, "D"], end: Literal["start", "goal"]
) -> Status | None:
    """Why a configuration can't be this end of a path, collisions apart; None where it can."""
    if manifold.robot.limit_distance(q) < -LIMIT_SLACK:  # first: what is in degrees is beyond them
        return "out_of_limits"
    if not manifold.violation(q) <= SATISFIED:  # nor is it where it is no number
        return "start_violates" if end == "start" else "goal_violates"
    return None
