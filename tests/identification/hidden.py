"""Tasks whose formula identification is not told, and demonstrations of them."""

import numpy as np
from scipy.ndimage import gaussian_filter1d

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.polynomial import PolynomialConstraint, Relation
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.studies.hidden_tasks import (
    BOWL,
    CENTRE,
    HEIGHT,
    HINGE,
    LEVEL,
    REACH,
    about,
    row,
)

HIDDEN = {
    "cup": LEVEL,
    "plane": (row("m", -0.2, p2=1.0), *LEVEL),
    "towards a centre": BOWL,
    "door": (*LEVEL, row("m", -HEIGHT, p2=1.0), about(HINGE, REACH, flat=True)),
    "sphere": (about(CENTRE, 0.3, flat=False),),
    "sphere up there": (about(np.array([0.5, 0.1, 0.3]), 0.3, flat=False), *LEVEL),
    "cylinder": (about(HINGE, REACH, flat=True),),
    "line": (row("m", -0.35, p0=1.0), row("m", -0.3, p2=1.0)),
    "point": tuple(row("m", -x, **{f"p{k}": 1.0}) for k, x in enumerate((0.4, 0.1, 0.3))),
    "angle": (row("rad", -0.5, u33=1.0),),
    "orientation": tuple(
        Relation("hidden", "rad", 0.0, linear)
        for linear in np.array(
            [
                0.5 * (np.eye(12)[3 + 3 * j + k] - np.eye(12)[3 + 3 * k + j])
                for k, j in ((2, 1), (0, 2), (1, 0))
            ]
        )
    ),
}
UPRIGHT = [task for task, rows in HIDDEN.items() if set(LEVEL) <= set(rows)]
"""Tasks whose tool's y axis points up, not down."""


def manifold_of(task: str, robot: SerialRobot) -> ConstraintManifold:
    """The hidden set."""
    return ConstraintManifold(robot, PolynomialConstraint(HIDDEN[task]))


def drawn(task: str, robot: SerialRobot, count: int, seed: int = 0) -> np.ndarray:
    """Configurations on the hidden set, within the limits."""
    rng, found = np.random.default_rng(seed), []
    while sum(map(len, found)) < count:
        q = retract(manifold_of(task, robot), robot.sample(4000, rng))
        kept = q.joints[q.converged & (robot.limit_distance(q.joints) > 0.0)]
        turned = robot.forward(kept)[1]
        if task in UPRIGHT:
            kept = kept[turned[:, 2, 1] > 0.0]
        if task == "orientation":  # half turns are zeros of the formula, too
            kept = kept[np.trace(turned, axis1=1, axis2=2) > 1.0]
        found.append(kept)
    return np.concatenate(found)[:count]


def demonstrations(task: str, robot: SerialRobot, count: int, error_deg: float = 0.0) -> list:
    """Motions of 60 rows on the hidden set, with a person's smooth error."""
    rng, manifold = np.random.default_rng(3), manifold_of(task, robot)
    ends, found = drawn(task, robot, 40 * count), []
    while len(found) < count:
        first = ends[rng.integers(len(ends))]
        order = np.argsort(np.linalg.norm(ends - first, axis=1))
        last = ends[order[rng.integers(5, max(10, len(ends) // 8))]]
        line = retract(manifold, first + np.linspace(0.0, 1.0, 60)[:, None] * (last - first))
        steps = np.linalg.norm(np.diff(line.joints, axis=0), axis=1)
        if (
            line.converged.all()
            and steps.max() < 0.3
            and robot.limit_distance(line.joints).min() > 0
        ):
            error = gaussian_filter1d(rng.normal(size=line.joints.shape), 5, axis=0)
            found.append(line.joints + np.radians(error_deg) * error / error.std())
    return found
