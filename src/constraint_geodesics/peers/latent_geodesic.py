"""What planners on a learned manifold share: retracted curves, and the path that is executed."""

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold
from constraint_geodesics.constraints.projection import Retraction, retract
from constraint_geodesics.geodesics.descent import ranks
from constraint_geodesics.geodesics.learned_problem import LearnedProblem
from constraint_geodesics.geodesics.problem import Ends, repeated
from constraint_geodesics.geometry.curves import CurveFamily
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.lift import as_executed
from constraint_geodesics.peers.elastic_band import without_path
from constraint_geodesics.problem import LIMIT_SLACK, SATISFIED, PlanningProblem, Solution, refusal

ROW_SPACING, LONGEST_STEP = 0.02, 0.1
"""Distance of a path's rows, and the longest one that is no jump [rad]."""
BETWEEN = 0.8 * SATISFIED
"""Violation halfway between two rows above which another row is drawn there [rad or m]."""
HALVINGS = 6
"""Times that rows are drawn closer."""
DEGREE, FINE_DEGREE = 16, 32
"""Degrees of the polynomials that lengths are measured with while many curves are compared, and
while few are.
"""
EDGE_CHORDS = 8
"""Chords that the length of a straight latent line is measured by."""
EXACT = Retraction(accuracy=1e-6, iterations=20)


def turned_away(
    problem: PlanningProblem,
    chart: LearnedManifold,
    began: float,
    own: Constraint | None = None,
    what: str = "",
) -> Solution | None:
    """The answer where a planner on this chart need not look at a problem, or cannot.

    own: the only constraint that it knows, by a graph or grid of this name.
    """
    dof = problem.manifold.robot.dof
    if chart.ambient_dim != 2 * dof:
        another = f"the manifold is that of {chart.ambient_dim // 2} joints, the robot has {dof}"
        return without_path(problem, "not_applicable", began, another)
    refused = refusal(problem)
    if refused is not None:
        return without_path(problem, refused, began)
    if own is not None and not same_constraint(problem.manifold.constraint, own):
        another = f"the {what} is that of another constraint"
        return without_path(problem, "not_applicable", began, another)
    return None


def retracted_problem(
    chart: LearnedManifold,
    manifold: ConstraintManifold,
    curve: CurveFamily,
    joints: Float[np.ndarray, "n D"] | None = None,
) -> LearnedProblem:
    """Retracted curves on a chart; joints: configurations on the constraint that random curves bend
    towards.
    """
    known = np.empty((0, manifold.robot.dof)) if joints is None else joints
    return LearnedProblem(chart, manifold, curve, known, DEGREE, True, 0.0)


def on_constraint(
    manifold: ConstraintManifold, count: int, rng: np.random.Generator
) -> Float[np.ndarray, "m D"]:
    """Random configurations that keep constraint and limits [rad]: what `count` samples of the box
    retract to.
    """
    found = retract(
        manifold, manifold.robot.sample(count, rng), Retraction(accuracy=1e-3, iterations=12)
    )
    return found.joints[found.converged & (manifold.robot.limit_distance(found.joints) >= 0.0)]


def first_curves(
    learned: LearnedProblem, ends: Ends, drawn: int, kept: int, rng: np.random.Generator
) -> Float[np.ndarray, "k p"]:
    """The straight line, and the `kept` cheapest of `drawn` curves bent towards random
    configurations, if there are any.
    """
    straight = np.zeros((1, learned.curve.coefficients))
    if not len(learned.joints) or kept == 0:
        return straight
    many = repeated(ends, drawn)
    bent = learned.sample_curves(many, rng)
    order = np.argsort(ranks(learned.evaluate(bent, many)), kind="stable")
    return np.concatenate([straight, bent[order[:kept]]])


def free_rows(
    problem: PlanningProblem, learned: LearnedProblem, phi: Float[np.ndarray, "p"], ends: Ends
) -> Float[np.ndarray, "T D"] | None:
    """Rows of a retracted curve as they are executed; None if it is no path or touches
    something.
    """
    rows = executable(problem.manifold, learned.path(phi, ends, LONGEST_STEP))
    return rows if rows is not None and problem.keeps_clear(rows) else None


def executable(
    manifold: ConstraintManifold, joints: Float[np.ndarray, "n D"]
) -> Float[np.ndarray, "T D"] | None:
    """Rows about ROW_SPACING apart, closer where straight lines between them would leave the
    constraint.

    The given ones stay to the bit.  None where a path jumps, or leaves the limits or the
    constraint.
    """
    rows = as_executed(manifold, joints, ROW_SPACING)
    for _ in range(HALVINGS):
        middle = 0.5 * (rows[1:] + rows[:-1])
        off = np.flatnonzero(manifold.violation(middle) > BETWEEN)
        if not len(off):
            break
        rows = np.insert(rows, off + 1, retract(manifold, middle[off]).joints, axis=0)
    steps = np.linalg.norm(np.diff(rows, axis=0), axis=1)
    if not np.isfinite(rows).all() or steps.max() > LONGEST_STEP:
        return None
    if manifold.robot.limit_distance(rows).min() < -LIMIT_SLACK:
        return None
    looked_at = np.concatenate([rows, 0.5 * (rows[1:] + rows[:-1])])
    return rows if manifold.violation(looked_at).max() <= SATISFIED else None


def straight_lengths(
    chart: LearnedManifold, first: Float[np.ndarray, "m N"], last: Float[np.ndarray, "m N"]
) -> Float[np.ndarray, "m"]:
    """Lengths of straight latent lines on the manifold, eq. 2, as sums of EDGE_CHORDS chords of the
    embedding.
    """
    t = np.linspace(0.0, 1.0, EDGE_CHORDS + 1)[:, None]
    places = chart.embed_points((1.0 - t) * first[:, None] + t * last[:, None]).astype(np.float64)
    return np.linalg.norm(np.diff(places, axis=1), axis=-1).sum(axis=1)


def same_constraint(first: Constraint, second: Constraint) -> bool:
    """Whether two constraints hold the same, as tightly, at the same pose."""
    return first.is_placed and second.is_placed and first.key == second.key
