"""A tool pose as the goal: the branches of the inverse kinematics, whole turns included."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.goals.region import GoalRegion
from constraint_geodesics.robot.inverse_kinematics import solutions

POSE_JOINTS = 6
"""An arm with more joints reaches a pose by families of configurations."""


@dataclass(frozen=True, eq=False)
class PoseGoal:
    """A tool pose in the base frame."""

    pose: Pose
    region: Constraint = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "region", Constraint((1,) * 6, reference=self.pose))

    @property
    def description(self) -> str:
        """The pose."""
        x, y, z = self.pose.position
        return f"a configuration with the tool at ({x:.4g}, {y:.4g}, {z:.4g}) m, turned as asked"

    def configurations(
        self, manifold: ConstraintManifold, start: Float[np.ndarray, "D"]
    ) -> Iterable[Float[np.ndarray, "D"]]:
        """The branches that are found; of families the configurations nearest to the start."""
        if manifold.robot.dof > POSE_JOINTS:
            return GoalRegion(self.pose).configurations(manifold, start)
        return solutions(manifold.robot, self.pose.position, self.pose.rotation, near=start)
