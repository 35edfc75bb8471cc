"""What a query asks to reach: a seam, with a configuration as its first kind.

A further kind is one file here with a class that has `description`, `configurations` and `region`.
`Planner.plan` takes it as it is, and `Trajectory.goal` says which configuration was reached.  Apart
from that file it touches `cli_planning.py`, if the command is to have an option for it, and its
tests: search, certification, recording and benchmark know configurations and constraints alone.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.problem import PlannerError
from constraint_geodesics.robot.inverse_kinematics import whole_turns
from constraint_geodesics.values import checked_joints

ArrayLike = Float[np.ndarray, "D"] | Sequence[float]


@runtime_checkable
class Goal(Protocol):
    """A set of configurations, any of which may end the path."""

    @property
    def description(self) -> str:
        """In words, for explanations."""
        ...

    @property
    def region(self) -> Constraint | None:
        """The set as a constraint with a reference, where it is one: the certificate says how well
        the end keeps it, and where it leaves freedom the end slides in it.
        """
        ...

    def configurations(
        self, manifold: ConstraintManifold, start: Float[np.ndarray, "D"]
    ) -> Iterable[Float[np.ndarray, "D"] | None]:
        """All configurations [rad] of the set, or where there is no end of them those worth a
        look; the planner sees to limits, collisions and the constraint.  After None come more, to
        be worked out only if they are asked for: of these the planner looks at some free ones.

        Raises PlannerError if the goal makes no sense for this robot.
        """
        ...


Wanted = Goal | Pose | ArrayLike
"""What `Planner.plan` takes as a goal; a list of them means any."""


@dataclass(frozen=True, eq=False)
class ConfigurationGoal:
    """One configuration (D,) [rad or m]; of continuous joints the angles, which whole turns do not
    change, or exactly these values.

    Raises PlannerError where it is asked for, if it has not as many joints as the robot, or is not
    finite.
    """

    joints: Float[np.ndarray, "D"]
    region: Constraint | None = None
    exactly: bool = False

    @property
    def description(self) -> str:
        """The joints."""
        return f"the configuration {self.joints.tolist()} rad"

    def configurations(
        self, manifold: ConstraintManifold, start: Float[np.ndarray, "D"]
    ) -> Iterable[Float[np.ndarray, "D"]]:
        """It alone, or with the whole turns of continuous joints."""
        robot = manifold.robot
        q = checked_configuration(self.joints, robot.dof, "goal")
        if self.exactly or not robot.continuous:
            return [q]
        turning = np.array([name in robot.continuous for name in robot.joint_names])
        turned = whole_turns(robot, q[None], turning, start)
        return turned if len(turned) else [q]  # whose limit it breaks is the planner's to say


def checked_configuration(q: Any, dof: int, name: str) -> Float[np.ndarray, "D"]:
    """A copy of one configuration [rad].  Raises PlannerError with its name if it is none."""
    return checked_joints(q, dof, name, PlannerError)
