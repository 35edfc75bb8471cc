"""A tool pose as the goal: every branch of the inverse kinematics, whole turns included."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.goals.region import GoalRegion
from constraint_geodesics.robot.inverse_kinematics import solutions

POSE_JOINTS = 6
"""An arm with more joints reaches a pose by families of configurations."""


@dataclass(frozen=True, eq=False)
class PoseGoal:
    """A tool pose in the base frame.  joints: of the robot that is to reach it."""

    pose: Pose
    joints: int

    @property
    def description(self) -> str:
        """The pose."""
        x, y, z = self.pose.position
        return f"a configuration with the tool at ({x:.4g}, {y:.4g}, {z:.4g}) m, turned as asked"

    @property
    def region(self) -> Constraint | None:
        """The pose, held by all of the families."""
        return GoalRegion(self.pose).region if self.joints > POSE_JOINTS else None

    def configurations(
        self, manifold: ConstraintManifold, start: Float[np.ndarray, "D"]
    ) -> Iterable[Float[np.ndarray, "D"]]:
        """All branches; of a family the configurations nearest to the start."""
        if self.joints > POSE_JOINTS:
            return GoalRegion(self.pose).configurations(manifold, start)
        return solutions(manifold.robot, self.pose.position, self.pose.rotation)
