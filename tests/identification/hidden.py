"""Tasks whose formula identification is not told, and demonstrations of them."""

import numpy as np
from scipy.ndimage import gaussian_filter1d

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.polynomial import PolynomialConstraint, Relation
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.robot.kinematics import SerialRobot

CENTRE, RADIUS = np.array([0.42, 0.0, -0.05]), 0.25
HINGE, REACH, HEIGHT = np.array([0.55, 0.35, 0.0]), 0.35, 0.3


def row(unit: str, constant: float, quadratic=None, **entries: float) -> Relation:
    """One relation: entries p0 p1 p2, and u11 for the first entry of R e_x and so on."""
    linear = np.zeros(12)
    for name, value in entries.items():
        at = int(name[1]) if name[0] == "p" else 3 * int(name[1]) + int(name[2]) - 1
        linear[at] = value
    return Relation("hidden", unit, constant, linear, quadratic)


def about(centre: np.ndarray, radius: float, flat: bool) -> Relation:
    """The tip at a distance from a point, or from the upright line through it."""
    full, keep = np.zeros((12, 12)), np.diag([1.0, 1.0, 0.0 if flat else 1.0])
    full[:3, :3] = keep / radius
    linear = np.zeros(12)
    linear[:3] = -keep @ centre / radius
    constant = float((centre @ keep @ centre - radius**2) / (2 * radius))
    return Relation("hidden", "m", constant, linear, full)


LEVEL = (row("rad", 0.0, u21=1.0), row("rad", 0.0, u22=1.0))
"""The tool's y axis upright."""
HIDDEN = {
    "cup": LEVEL,
    "plane": (row("m", -0.2, p2=1.0), *LEVEL),
    "towards a centre": tuple(
        row("m", -float(CENTRE[k]), **{f"p{k}": 1.0, f"u3{k + 1}": RADIUS}) for k in range(3)
    ),
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
