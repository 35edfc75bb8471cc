"""What a query asks to reach: a seam, with a configuration as its first kind.

A further kind is one file with a class that has `description` and `configurations` (a tool pose
would solve the inverse kinematics there).  `Planner.plan` takes it as it is, and `Trajectory.goal`
says which configuration was reached.  Apart from that file it touches `cli.py`, if the command is
to have an option for it, and its tests: planner, search, certification, recording and benchmark
know configurations alone.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.problem import PlannerError

ArrayLike = Float[np.ndarray, "D"] | Sequence[float]


@runtime_checkable
class Goal(Protocol):
    """A set of configurations, any of which may end the path."""

    @property
    def description(self) -> str:
        """In words, for explanations."""
        ...

    def configurations(
        self, manifold: ConstraintManifold, start: Float[np.ndarray, "D"]
    ) -> Iterator[Float[np.ndarray, "D"]]:
        """Configurations [rad] to be tried one after another, until a path to one is found.

        Raises PlannerError if the goal makes no sense for this robot.
        """
        ...


@dataclass(frozen=True, eq=False)
class ConfigurationGoal:
    """One configuration (D,) [rad].

    Raises PlannerError if it has no joints, as many as another robot, or is not finite.
    """

    joints: Float[np.ndarray, "D"]

    @property
    def description(self) -> str:
        """The joints."""
        return f"the configuration {self.joints.tolist()} rad"

    def configurations(
        self, manifold: ConstraintManifold, start: Float[np.ndarray, "D"]
    ) -> Iterator[Float[np.ndarray, "D"]]:
        """It alone."""
        yield checked_configuration(self.joints, manifold.robot.dof, "goal")


def as_goal(goal: Goal | ArrayLike, dof: int) -> Goal:
    """A goal as it is; numbers are a configuration's.  Raises PlannerError if they are none."""
    # numbers first: asking for the protocol takes longer than looking at both ends
    if type(goal) not in (np.ndarray, list, tuple) and isinstance(goal, Goal):
        return goal
    return ConfigurationGoal(checked_configuration(goal, dof, "goal"))


def checked_configuration(q: Any, dof: int, name: str) -> Float[np.ndarray, "D"]:
    """A copy of one configuration [rad].  Raises PlannerError with its name if it is none."""
    try:
        given = np.asarray(q)
        if given.dtype.kind == "c":
            raise TypeError("complex")
        values = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise PlannerError(f"{name} = {q}: must be {dof} numbers [rad]") from None
    if values.shape != (dof,):
        raise PlannerError(f"{name} has shape {values.shape}: must be ({dof},) [rad]")
    if not all(map(math.isfinite, values.tolist())):
        raise PlannerError(f"{name}[{int(np.argmin(np.isfinite(values)))}] is not finite")
    return values
