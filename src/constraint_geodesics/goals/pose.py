"""A tool pose as the goal: the branches of the inverse kinematics, whole turns included."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.goals.region import NEAREST
from constraint_geodesics.robot.inverse_kinematics import (
    Search,
    seeds_of,
    solutions,
    turned_towards,
)
from constraint_geodesics.search.nearest import nearest_on

POSE_JOINTS = 6
"""Joints up to which a pose is reached by single configurations, and not by families of them."""
MANY_SEEDS = 1024
"""Of the inverse kinematics, for members of all families."""
_SEEDS = 128
"""Configurations, beside NEAREST members of families, from which the nearest are looked for."""


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
        return f"the tool at ({x:.4g}, {y:.4g}, {z:.4g}) m, turned as asked"

    def configurations(
        self, manifold: ConstraintManifold, start: Float[np.ndarray, "D"]
    ) -> Iterator[Float[np.ndarray, "D"] | None]:
        """The branches that are found; of families the configurations nearest to the start, then
        members.
        """
        robot, (place, turn) = manifold.robot, (self.pose.position, self.pose.rotation)
        found = solutions(robot, place, turn, near=start)
        if robot.dof <= POSE_JOINTS:
            yield from found
            return
        own = ConstraintManifold(robot, self.region)
        found = found[np.argsort(np.linalg.norm(found - start, axis=1))][:NEAREST]
        seeds = turned_towards(robot, seeds_of(robot, _SEEDS), start)
        yield from nearest_on(own, start, np.concatenate([start[None], found, seeds]))
        yield None
        yield from solutions(robot, place, turn, Search(seeds=MANY_SEEDS), start)
