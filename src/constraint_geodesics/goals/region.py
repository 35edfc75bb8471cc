"""A region of tool poses as the goal: some axes free, others within a box around a pose."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.both import both
from constraint_geodesics.constraints.constraint import AXES, Constraint, ConstraintManifold, Pose
from constraint_geodesics.problem import SATISFIED, PlannerError
from constraint_geodesics.robot.inverse_kinematics import seeds_of, solutions, turned_towards
from constraint_geodesics.search.nearest import members_of, nearest_on
from constraint_geodesics.values import numbers, shown

SEEDS = 256
"""Configurations from which the nearest of the region are looked for,"""
NEAREST = 64
"""and those of them, at most, that have the region's own pose."""
MANY_SEEDS = 512
"""Those from which others are."""


@dataclass(frozen=True, eq=False)
class GoalRegion:
    """Tool poses around one, in the base frame's axes.

    free: names of axes that may have any value, of x, y, z, roll, pitch and yaw; two held angles
    keep the direction of the third axis, which the tool may turn about.  tolerance: half-widths of
    the others [m, m, m, rad, rad, rad], 0 by default.
    Raises PlannerError for an axis that there is not, and for tolerances that are no six numbers of
    at least 0, or of a free axis.
    """

    pose: Pose
    free: Sequence[str] = ()
    tolerance: Sequence[float] = (0.0,) * 6

    def __post_init__(self) -> None:
        if not isinstance(self.pose, Pose):
            raise PlannerError(f"goal region: pose = {shown(self.pose)}: must be a Pose")
        names = [self.free] if isinstance(self.free, str) else self.free
        for name in names if isinstance(names, Collection) else [names]:
            if name not in AXES:
                raise PlannerError(f"free = {shown(name)}: must be of {', '.join(AXES)}")
        held = tuple(int(axis not in names) for axis in AXES)
        widths = numbers(self.tolerance)
        if widths is None or widths.ndim != 1:
            line = f"goal region: tolerance = {shown(self.tolerance)}: must be six numbers"
            raise PlannerError(line)
        try:
            region = Constraint(held, tuple(widths.tolist()), self.pose)
        except ValueError as error:
            raise PlannerError(f"goal region: {error}") from None
        object.__setattr__(self, "region", region)

    region: Constraint = field(init=False, repr=False)

    @property
    def description(self) -> str:
        """Where it is, and what is free."""
        x, y, z = self.pose.position
        return f"the tool in the region around ({x:.4g}, {y:.4g}, {z:.4g}) m"

    def configurations(
        self, manifold: ConstraintManifold, start: Float[np.ndarray, "D"]
    ) -> Iterator[Float[np.ndarray, "D"] | None]:
        """Those nearest to the start that keep the path's constraint as well, each nearer than all
        beside it, then others; where none keeps both, those of the region.
        """
        robot = manifold.robot
        together = ConstraintManifold(robot, both(self.region, manifold.constraint))
        near, many = (
            turned_towards(robot, seeds_of(robot, count), start) for count in (SEEDS, MANY_SEEDS)
        )
        # a region holds its own pose: no path to it is longer than one there
        there = solutions(robot, self.pose.position, self.pose.rotation, near=start)
        there = there[np.argsort(np.linalg.norm(there - start, axis=1))][:NEAREST]
        seeds = np.concatenate([start[None], there, near])
        region = ConstraintManifold(robot, self.region)
        found = [q for q in nearest_on(together, start, seeds) if region.violation(q) <= SATISFIED]
        if not found:
            yield from nearest_on(region, start, seeds)
            return
        yield from found
        yield None
        # both may hold an angle at two references, and keep one of them
        yield from (q for q in members_of(together, many) if region.violation(q) <= SATISFIED)
