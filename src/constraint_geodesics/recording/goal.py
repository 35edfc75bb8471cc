"""What a query asked to reach, in a recording: the regions of tool poses, and the arm at the
configurations that were looked at.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import AXES, Constraint, Pose
from constraint_geodesics.constraints.kernels import Rows
from constraint_geodesics.recording import colours
from constraint_geodesics.robot.kinematics import SerialRobot

SHOWN = 32
"""Configurations, the nearest to the start."""
AXIS_M, FREE_M = 0.08, 0.2
"""Length of a pose's drawn axes, and of a free direction to either side."""
_THIN = rr.Radius.ui_points(1.0)
_ROUND = np.linspace(0.0, 2.0 * np.pi, 65)[:, None]


@dataclass(frozen=True)
class GoalView:
    """Configurations (n, D) [rad or m], the nearest first, and regions of tool poses."""

    configurations: Float[np.ndarray, "n D"]
    regions: tuple[Constraint, ...] = ()


def goal_drawings(robot: SerialRobot, goal: GoalView | None) -> Iterator[tuple[str, Any]]:
    """Entities with what Rerun draws: the arm as lines, a region as its pose, its box, and a circle
    about an angle that is free.
    """
    if goal is None:
        return
    if len(goal.configurations) > 1:
        lines = robot.skeleton(goal.configurations[:SHOWN])
        strips = rr.LineStrips3D(list(lines), colors=[(*colours.OTHER, 110)], radii=[_THIN])
        yield "goal/looked_at", strips
    for number, region in enumerate(goal.regions):
        if region.reference is not None:
            yield from _region(f"goal/region_{number}", region.reference, region.rows)


def _region(entity: str, pose: Pose, rows: Rows) -> Iterator[tuple[str, Any]]:
    place, vectors, held = pose.position, AXIS_M * pose.rotation.T, rows.held
    origins = np.tile(place, (3, 1))
    yield f"{entity}/pose", rr.Arrows3D(vectors=vectors, origins=origins, colors=colours.AXES)
    half = np.where(held[:3], rows.tolerance[:3], FREE_M)
    if half.any():
        style = {"colors": [colours.AXES[2]], "radii": [_THIN]}
        yield f"{entity}/places", rr.Boxes3D(centers=[place], half_sizes=[half], **style)
    for axis in np.flatnonzero(~held[3:]):
        across = AXIS_M * np.roll(np.eye(3), -axis - 1, axis=0)[:2]  # e_i and e_j beside e_axis
        circle = place + np.cos(_ROUND) * across[0] + np.sin(_ROUND) * across[1]
        strip = rr.LineStrips3D([circle], colors=[colours.AXES[axis]], radii=[_THIN])
        yield f"{entity}/free_{AXES[3 + axis]}", strip
