"""Demonstrations in a recording, and configurations that keep a constraint beside them."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import rerun as rr
from jaxtyping import Float
from scipy.spatial import KDTree

from constraint_geodesics import palette
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.recording.colours import OTHER, rgb
from constraint_geodesics.robot.kinematics import SerialRobot

ENTITIES = ("demonstrations", "identified")
BESIDE_RAD, NEAR_M, POINTS = 0.15, 0.05, 3000
"""How far from the rows configurations of the identified set are drawn, how near a demonstrated
place they end, and how many.
"""
_SHOWN, _SET = OTHER, rgb(palette.BLUE)
_POINT, _LINE = rr.Radius.ui_points(2.0), rr.Radius.ui_points(1.5)


def shown_drawings(
    robot: SerialRobot, shown: Sequence[Float[np.ndarray, "T D"]], constraint: Constraint | None
) -> Iterator[tuple[str, Any]]:
    """Entities with what Rerun draws: the tip's lines or, of independent rows, places; and places
    where the constraint lets it be near them.
    """
    if not shown:
        return
    tips = [robot.forward(rows)[0] for rows in shown]
    many: Any = (
        rr.LineStrips3D(tips, colors=[_SHOWN], radii=[_LINE])
        if len(tips) > 1
        else rr.Points3D(tips[0], colors=[_SHOWN], radii=[_POINT])
    )
    yield ENTITIES[0], many
    if constraint is None:
        return
    rng, rows = np.random.default_rng(0), np.concatenate(shown)
    near = rows[rng.integers(len(rows), size=POINTS)]
    near = near + BESIDE_RAD * rng.normal(size=near.shape)
    kept = retract(ConstraintManifold(robot, constraint), near)
    places = robot.forward(kept.joints[kept.converged])[0]
    away = np.asarray(KDTree(np.concatenate(tips)).query(places)[0])
    yield ENTITIES[1], rr.Points3D(places[away < NEAR_M], colors=[_SET], radii=[_POINT])
