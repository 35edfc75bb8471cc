"""Geodesics in the latent space of the learned manifold by descent, retracted onto the constraint:
no policy, no graph.

The manifold was trained once, without a constraint.  A curve between the encoded ends is decoded,
its ends are corrected and every point is retracted onto the constraint; the length of that path is
what is minimised.
"""

import time
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy import optimize

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.projection import Retraction, retract
from constraint_geodesics.geodesics.problem import Costs, Ends, LearnedProblem, repeated
from constraint_geodesics.geometry.curves import CurveFamily, PinnedPolynomial, PinnedSpline
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.lift import as_executed, corrected, retracted
from constraint_geodesics.problem import (
    LIMIT_SLACK,
    SATISFIED,
    PlanningProblem,
    Solution,
    Status,
    refusal,
)
from constraint_geodesics.scene.clearance import ClearanceModel

ROW_SPACING, LONGEST_STEP = 0.02, 0.1
"""Distance of a path's rows, and the longest one that is no jump [rad]."""
BETWEEN = 0.8 * SATISFIED
"""Violation halfway between two rows above which another row is drawn there [rad or m]."""
HALVINGS = 6
"""Times that rows are drawn closer."""
CHECK_SPACING = 0.05
"""Distance of the configurations that are checked for collision [rad]."""
DEGREE, FINE_DEGREE = 16, 32
"""Degrees of the polynomials that lengths are measured with while many curves are compared, and
while few are.
"""
EXACT = Retraction(accuracy=1e-6, iterations=20)
INFEASIBLE = 1e3
"""Added to the cost of a curve that is not feasible [rad]: more than any curve costs."""
LONGEST_STRIDE, LONGER, SHORTER = 1.5, 1.3, 0.4
"""Largest multiple of the problem's descent taken in one step; change of a curve's own multiple
after each step.
"""
DIFFERENCE = 3e-4
"""Half step of central differences, in units of the ends' distance: the decoder computes in single
precision.
"""
LEAST_GRADIENT = 1e-3
"""Gradient of the cost [rad per unit of the ends' distance] at which a curve is a minimum."""
ALIKE = 0.02
"""Curves whose coefficients differ by less, in units of the ends' distance, are one."""
MARGIN, PUSH = 0.01, 200.0
"""Distance to the workcell's boxes that is kept [m], and the cost of what is missing, as a mean
along the curve [rad/m].
"""
CLEARANCE_POINTS = 65


@dataclass(frozen=True)
class StraightLatent:
    """The straight latent line between the encoded ends, decoded and retracted; there is nothing to
    choose.
    """

    chart: LearnedManifold
    name: str = "straight latent line"

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """The line if it is a path; a jump to another branch, a limit or a collision leave it
        "not_found".
        """
        began = time.perf_counter()
        refused = turned_away(problem, self.chart)
        if refused is not None:
            return without_path(problem, *refused, began)
        learned = retracted_problem(
            self.chart, problem.manifold, PinnedPolynomial(self.chart.dim, 1)
        )
        ends = learned.ends(problem.start[None], problem.goal[None])
        joints = free_rows(problem, learned, np.empty(0), ends)
        return answer(joints, problem, began, 1)


@dataclass(frozen=True)
class GradientGeodesic:
    """The shortest retracted curve of a family that descent finds from several starts, one of them
    straight.

    All starts go down together along the problem's own descent (`LearnedProblem.look`: the
    tangential part of the path's curvature, pulled back to the chart), each with a step size of its
    own.  That stands still where the mean Jacobian of the decoder is no longer exact; from there
    BFGS on the cost itself polishes the best.  Where every one of these collides, they are pushed
    out of the workcell's boxes, as far as `problem.clearance` knows them.

    segments: of the family, cubic C² splines (1: the cubics of eq. 10).  drawn: curves bent towards
    random configurations on the constraint, of which the cheapest join the straight line as
    `starts` in all.
    descent_steps: along the problem's descent.  polished: different curves that BFGS goes on with,
    polish_steps: its iterations at most.  rounds: of all this, each with other random curves, until
    one finds a path.
    Raises ValueError unless starts, polished and rounds are at least 1.
    """

    chart: LearnedManifold
    segments: int = 2
    drawn: int = 1024
    starts: int = 16
    descent_steps: int = 15
    polished: int = 1
    polish_steps: int = 15
    rounds: int = 3
    name: str = "gradient geodesic"

    def __post_init__(self) -> None:
        for name, value in (
            ("starts", self.starts),
            ("polished", self.polished),
            ("rounds", self.rounds),
        ):
            if value < 1:
                raise ValueError(f"{name} = {value}: must be at least 1")

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """The shortest curve that is a path; the random starts depend on the seed."""
        began = time.perf_counter()
        refused = turned_away(problem, self.chart)
        if refused is not None:
            return without_path(problem, *refused, began)
        rng = np.random.default_rng(seed)
        joints = on_constraint(problem.manifold, self.drawn, rng)
        learned = retracted_problem(
            self.chart, problem.manifold, PinnedSpline(self.chart.dim, self.segments), joints
        )
        ends = learned.ends(problem.start[None], problem.goal[None])
        costs = [_Cost(learned, ends)]
        if problem.clearance is not None and len(problem.clearance.boxes):
            costs.append(_Cost(learned, ends, problem.clearance))
        found, iterations = None, 0
        for _ in range(self.rounds):
            if found is not None:
                break
            met = descended(learned, self._starts(learned, ends, rng), ends, self.descent_steps)
            iterations += self.descent_steps
            for cost in costs:
                if found is None:
                    found, steps = self._polished(cost, met, problem)
                    iterations += steps
        return answer(found, problem, began, iterations)

    def _starts(
        self, learned: LearnedProblem, ends: Ends, rng: np.random.Generator
    ) -> Float[np.ndarray, "K p"]:
        straight = np.zeros((1, learned.curve.coefficients))
        if not len(learned.joints) or self.starts == 1:
            return straight
        many = repeated(ends, self.drawn)
        bent = learned.sample_curves(many, rng)
        order = np.argsort(ranks(learned.evaluate(bent, many)), kind="stable")
        return np.concatenate([straight, bent[order[: self.starts - 1]]])

    def _polished(
        self, cost: "_Cost", met: Float[np.ndarray, "K p"], problem: PlanningProblem
    ) -> tuple[Float[np.ndarray, "T D"] | None, int]:
        """Rows of the cheapest curve that is a path, and the iterations spent on it."""
        coarse = cost(met)
        picked = met[different(met, coarse, ALIKE * cost.ends.distance[0])]
        fine, tried, steps = cost.finer(), [], 0
        for phi in picked[: self.polished]:
            better, spent = polished(fine, phi, self.polish_steps)
            tried.append(better)
            steps += spent
        # what was not polished may still be free where the shortest curves collide
        candidates = np.concatenate([np.reshape(tried, (-1, met.shape[1])), picked])
        values = fine(candidates)
        for row in np.argsort(values, kind="stable"):
            if values[row] >= INFEASIBLE:
                break
            joints = free_rows(problem, fine.learned, candidates[row], cost.ends)
            if joints is not None:
                return joints, steps
        return None, steps


def turned_away(problem: PlanningProblem, chart: LearnedManifold) -> tuple[Status, str] | None:
    """Status and explanation where a planner on this chart need not look at a problem, or
    cannot.
    """
    dof = problem.manifold.robot.dof
    if chart.ambient_dim != 2 * dof:
        return (
            "not_applicable",
            f"the manifold is that of {chart.ambient_dim // 2} joints, the robot has {dof}",
        )
    refused = refusal(problem)
    return None if refused is None else (refused, "")


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


def ranks(costs: Costs) -> Float[np.ndarray, "B"]:
    """Costs [rad], those of all infeasible curves behind the others'."""
    return np.where(costs.feasible, costs.cost, costs.cost + INFEASIBLE)


def descended(
    learned: LearnedProblem, phi: Float[np.ndarray, "K p"], ends: Ends, steps: int
) -> Float[np.ndarray, "K p"]:
    """Curves between the same ends after steps along the problem's descent; none costs more than
    before.
    """
    many = repeated(ends, len(phi))
    seen = learned.observed(phi, many)
    value, descent, stride = ranks(seen.costs), seen.descent, np.ones((len(phi), 1))
    for _ in range(steps):
        tried = phi + stride * descent
        seen = learned.observed(tried, many)
        cheaper = (ranks(seen.costs) < value)[:, None]
        phi, descent = np.where(cheaper, tried, phi), np.where(cheaper, seen.descent, descent)
        value = np.minimum(ranks(seen.costs), value)
        stride = np.where(cheaper, np.minimum(LONGER * stride, LONGEST_STRIDE), SHORTER * stride)
    return phi


def different(
    phi: Float[np.ndarray, "K p"], values: Float[np.ndarray, "K"], apart: float
) -> Int[np.ndarray, "k"]:
    """Rows of curves of which no two are alike, the cheapest first."""
    kept: list[int] = []
    for row in np.argsort(values, kind="stable"):
        if all(np.linalg.norm(phi[row] - phi[other]) >= apart for other in kept):
            kept.append(int(row))
    return np.array(kept, dtype=np.int64)


@dataclass(frozen=True)
class _Cost:
    """Cost of curves (K, p) between one pair of ends [rad]: `ranks`, and what the clearance model
    objects to.
    """

    learned: LearnedProblem
    ends: Ends
    clearance: ClearanceModel | None = None

    def __call__(self, phi: Float[np.ndarray, "K p"]) -> Float[np.ndarray, "K"]:
        many = repeated(self.ends, len(phi))
        value = ranks(self.learned.evaluate(phi, many))
        if self.clearance is None:
            return value
        t, manifold = self._times, self.learned.manifold
        decoded = self.learned.chart.decode(self.learned.latent_points(phi, many, t))
        line = corrected(decoded, t, many.q_start, many.q_goal)
        joints = retracted(manifold, line, self.learned.retraction).joints
        missing = np.maximum(
            MARGIN - self.clearance.clearance(manifold.robot, joints[:, 1:-1]), 0.0
        )
        return value + PUSH * missing.mean(axis=1)

    def finer(self) -> "_Cost":
        """The same at the accuracy of a result."""
        return replace(self, learned=replace(self.learned, degree=FINE_DEGREE, retraction=EXACT))

    @cached_property
    def _times(self) -> Float[np.ndarray, "T"]:
        return np.linspace(0.0, 1.0, CLEARANCE_POINTS)


def polished(
    cost: _Cost, phi: Float[np.ndarray, "p"], steps: int
) -> tuple[Float[np.ndarray, "p"], int]:
    """A curve after BFGS with central differences, and its iterations; a curve that is not feasible
    stays as it is.
    """
    unit = cost.ends.distance[0]
    moves = DIFFERENCE * unit * np.concatenate([np.eye(len(phi)), -np.eye(len(phi))])

    def value(scaled: Float[np.ndarray, "p"]) -> float:
        return float(cost(unit * scaled[None])[0])

    def gradient(scaled: Float[np.ndarray, "p"]) -> Float[np.ndarray, "p"]:
        up, down = cost(unit * scaled + moves).reshape(2, -1)
        # a curve that borders on an infeasible one would see a cliff of INFEASIBLE
        return np.clip(up - down, -INFEASIBLE * DIFFERENCE, INFEASIBLE * DIFFERENCE) / (
            2.0 * DIFFERENCE
        )

    before = value(phi / unit)
    if before >= INFEASIBLE or steps < 1:
        return phi, 0
    found = optimize.minimize(
        value,
        phi / unit,
        jac=gradient,
        method="BFGS",
        options={"maxiter": steps, "gtol": LEAST_GRADIENT},
    )
    return (unit * found.x, int(found.nit)) if found.fun < before else (phi, int(found.nit))


def free_rows(
    problem: PlanningProblem, learned: LearnedProblem, phi: Float[np.ndarray, "p"], ends: Ends
) -> Float[np.ndarray, "T D"] | None:
    """Rows of a retracted curve as they are executed; None if it is no path or touches
    something.
    """
    rows = executable(problem.manifold, learned.path(phi, ends, LONGEST_STEP))
    return rows if rows is not None and is_clear(problem, rows) else None


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


def is_clear(problem: PlanningProblem, rows: Float[np.ndarray, "T D"]) -> bool:
    """Whether configurations CHECK_SPACING apart along the rows are free; the ends were looked at
    already.
    """
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(rows, axis=0), axis=1))])
    at = np.linspace(0.0, way[-1], int(np.ceil(way[-1] / CHECK_SPACING)) + 1)[1:-1]
    points = np.stack([np.interp(at, way, joint) for joint in rows.T], axis=1)
    # from the middle outwards a collision is met sooner than from an end, which is free
    order = np.argsort(np.abs(np.arange(len(points)) - 0.5 * len(points)), kind="stable")
    return all(problem.is_free(points[row]) for row in order)


def answer(
    joints: Float[np.ndarray, "T D"] | None, problem: PlanningProblem, began: float, iterations: int
) -> Solution:
    """The record of a search that ends now; began: its clock reading [s]."""
    if joints is None:
        return without_path(problem, "not_found", "", began, iterations)
    return Solution("solved", joints, time.perf_counter() - began, iterations)


def without_path(
    problem: PlanningProblem, status: Status, explanation: str, began: float, iterations: int = 0
) -> Solution:
    """The record of a planner that has no path to give."""
    nothing = np.empty((0, problem.manifold.robot.dof))
    return Solution(status, nothing, time.perf_counter() - began, iterations, explanation)
