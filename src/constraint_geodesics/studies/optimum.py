"""The shortest curve of a family between two ends, as far as many starts find it: what every search
for one curve is measured against.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from constraint_geodesics.constraints.projection import Retraction
from constraint_geodesics.geodesics.descent import INFEASIBLE, beginning, descended, ranks
from constraint_geodesics.geodesics.learned_problem import LearnedProblem
from constraint_geodesics.geodesics.problem import Costs, Ends, Phi
from constraint_geodesics.scene.clearance import path_stays_clear

FINE_DEGREE, POLISH_DEGREE = 64, 32
"""Degrees of the polynomials that lengths are measured with at last, and while curves are polished.
"""
EXACT = Retraction(accuracy=1e-6, iterations=20)
ROW_SPACING, LONGEST_STEP = 0.05, 0.1
"""Distance of a path's rows, and the longest one that is no jump [rad]."""
LIMIT_SLACK, VIOLATION_SLACK = 1e-3, 1e-6
"""What a path may exceed joint limits by between the points that the search looked at, and the
constraint by [rad].
"""
NEAR = 0.02
"""Curves whose coefficients differ by less, in units of the ends' distance, are polished once."""
DIFFERENCE = 3e-4
"""Half step of central differences, in units of the ends' distance: a cost is known to single
precision.
"""
FIRST_STEP = 0.1
"""Longest step of the polish, in units of the ends' distance."""
HALVINGS, SUFFICIENT = 6, 1e-4
"""Of the polish's line search: cuts by SHORTENED at most, and the share of the expected decrease
that it asks for.
"""
SHORTENED = 0.35
GAIN = 1e-6
"""Relative decrease below which a curve is polished no more."""


@dataclass(frozen=True)
class OptimumSettings:
    """Work spent on the optimum of each query.

    random_starts: cheapest of `drawn` random curves, added to the given starts.  descent_steps:
    from every start.  polished: curves that quasi-Newton goes on with.  polish_steps: its
    iterations at most.
    """

    random_starts: int = 32
    drawn: int = 256
    descent_steps: int = 20
    polished: int = 4
    polish_steps: int = 40
    seed: int = 0


@dataclass(frozen=True)
class FamilyOptimum:
    """The shortest feasible curve found for each query; length [rad] is nan where there is none."""

    phi: Float[np.ndarray, "Q p"]
    length: Float[np.ndarray, "Q"]
    feasible: Bool[np.ndarray, "Q"]


def family_optimum(
    problem: LearnedProblem,
    ends: Ends,
    starts: Float[np.ndarray, "Q K p"],
    settings: OptimumSettings | None = None,
) -> FamilyOptimum:
    """The shortest feasible curve of the family for each query, as far as many starts find it.

    From every start the problem's own descent, then BFGS on the cost, all queries in one batch.
    Starts and what the descent made of them count too, so no feasible start is shorter than the
    answer.
    """
    settings = settings or OptimumSettings()
    queries, size = len(ends), problem.curve.coefficients
    phi = np.concatenate([starts, _random_starts(problem, ends, settings)], axis=1)
    each = ends[np.repeat(np.arange(queries), phi.shape[1])]
    started = beginning(problem, phi.reshape(-1, size), each)
    moved = descended(problem, started, each, settings.descent_steps)
    met = np.concatenate([phi, moved.phi.reshape(phi.shape)], axis=1)
    finer = replace(problem, degree=POLISH_DEGREE, retraction=EXACT)
    costs = finer.evaluate(met.reshape(-1, size), ends[np.repeat(np.arange(queries), met.shape[1])])
    picked = _picked(problem, met, _lengths(costs).reshape(met.shape[:2]), ends, settings.polished)
    final = np.take_along_axis(met, np.maximum(picked, 0)[..., None], axis=1)
    query, place = np.nonzero(picked >= 0)
    final[query, place] = polished(finer, final[query, place], ends[query], settings.polish_steps)
    return _shortest(problem, np.concatenate([final, met], axis=1), ends)


def measured(problem: LearnedProblem, phi: Phi, ends: Ends) -> Costs:
    """Costs at FINE_DEGREE; a feasible curve's executed path is sound besides."""
    costs = _fine(problem).evaluate(phi, ends)
    feasible = costs.feasible.copy()
    for row in np.flatnonzero(feasible):
        feasible[row] = is_sound(problem, phi[row], ends[np.array([row])])
    return replace(costs, feasible=feasible)


def is_sound(problem: LearnedProblem, phi: Float[np.ndarray, "p"], ends: Ends) -> bool:
    """Whether one curve's path has no step above LONGEST_STEP, keeps limits and constraint and
    touches nothing.

    Lengths look at a curve at a few points, between which it may change its branch unseen.
    """
    path, robot = problem.path(phi, ends, ROW_SPACING), problem.manifold.robot
    return bool(
        np.linalg.norm(np.diff(path, axis=0), axis=1).max() <= LONGEST_STEP
        and robot.limit_distance(path).min() >= -LIMIT_SLACK
        and problem.manifold.violation(path).max() <= VIOLATION_SLACK
        and path_stays_clear(robot.chain, problem.clearance.arrays, path)
    )


def polished(problem: LearnedProblem, phi: Phi, ends: Ends, steps: int) -> Phi:
    """Curves after BFGS on the cost with central differences (Nocedal and Wright, alg. 6.1).

    Every feasible curve goes on until a step gains less than GAIN; none gets worse or infeasible.
    """
    phi, size = phi.copy(), phi.shape[1]
    value = ranks(problem.evaluate(phi, ends)) if len(phi) else np.empty(0)
    rows = np.flatnonzero(value < INFEASIBLE)
    gradient = _gradients(problem, phi, ends, rows)
    inverse = np.tile(np.eye(size), (len(phi), 1, 1))
    fresh = np.ones(len(phi), dtype=bool)
    for _ in range(steps):
        if not len(rows):
            break
        direction = -(inverse[rows] @ gradient[rows, :, None])[..., 0]
        far, length = FIRST_STEP * ends.distance[rows], np.linalg.norm(direction, axis=1)
        direction *= np.minimum(1.0, far / np.maximum(length, 1e-12))[:, None]
        slope = (direction * gradient[rows]).sum(axis=1)
        line = _Line(phi[rows], ends[rows], value[rows], direction, slope)
        moved, new = _line_search(problem, line)
        stuck = new >= value[rows]
        going = np.where(stuck, ~fresh[rows], value[rows] - new > GAIN * value[rows])
        # a kink spoils the Hessian: once more without
        inverse[rows[stuck]], fresh[rows[stuck]] = np.eye(size), True
        on = rows[going & ~stuck]
        change = (moved - phi[rows])[going & ~stuck]
        phi[rows], value[rows] = moved, new
        slopes = _gradients(problem, phi, ends, on)
        _update(inverse, fresh, on, change, slopes[on] - gradient[on])
        gradient[on] = slopes[on]
        rows = rows[going]
    return phi


def _fine(problem: LearnedProblem) -> LearnedProblem:
    return replace(problem, degree=FINE_DEGREE, retraction=EXACT)


def _random_starts(
    problem: LearnedProblem, ends: Ends, settings: OptimumSettings
) -> Float[np.ndarray, "Q {settings.random_starts} p"]:
    """The cheapest of many random curves for each query."""
    queries, drawn = len(ends), settings.drawn
    many = ends[np.repeat(np.arange(queries), drawn)]
    phi = problem.sample_curves(many, np.random.default_rng(settings.seed))
    order = np.argsort(ranks(problem.evaluate(phi, many)).reshape(queries, drawn), axis=1)
    kept = order[:, : settings.random_starts, None]
    return np.take_along_axis(phi.reshape(queries, drawn, -1), kept, axis=1)


def _shortest(
    problem: LearnedProblem, phi: Float[np.ndarray, "Q M p"], ends: Ends
) -> FamilyOptimum:
    """The shortest sound curve of each query, as `measured` has it."""
    queries, count, size = phi.shape
    costs = _fine(problem).evaluate(
        phi.reshape(-1, size), ends[np.repeat(np.arange(queries), count)]
    )
    length = _lengths(costs).reshape(queries, count)
    best = _picked(problem, phi, length, ends, 1)
    feasible, row = best[:, 0] >= 0, np.maximum(best, 0)
    found = np.take_along_axis(phi, row[..., None], axis=1)[:, 0]
    return FamilyOptimum(
        np.where(feasible[:, None], found, 0.0),
        np.where(feasible, np.take_along_axis(length, row, axis=1)[:, 0], np.nan),
        feasible,
    )


def _picked(
    problem: LearnedProblem,
    phi: Float[np.ndarray, "Q M p"],
    length: Float[np.ndarray, "Q M"],
    ends: Ends,
    count: int,
) -> Int[np.ndarray, "Q {count}"]:
    """Each query's shortest sound curves, none near another; -1 where there are no more."""
    picked = np.full((len(phi), count), -1)
    for query in range(len(phi)):
        one, near, found = ends[np.array([query])], NEAR * ends.distance[query], 0
        for k in np.argsort(length[query], kind="stable"):
            if found == count or not np.isfinite(length[query, k]):
                break
            apart = np.linalg.norm(phi[query, picked[query, :found]] - phi[query, k], axis=1)
            if (apart >= near).all() and is_sound(problem, phi[query, k], one):
                picked[query, found] = k
                found += 1
    return picked


def _lengths(costs: Costs) -> Float[np.ndarray, "B"]:
    """Lengths of what is feasible, inf for the rest."""
    return np.where(costs.feasible, costs.length, np.inf)


def _gradients(problem: LearnedProblem, phi: Phi, ends: Ends, rows: Int[np.ndarray, "b"]) -> Phi:
    """Of the cost, by central differences; zero but in the given rows."""
    gradients, count, size = np.zeros_like(phi), len(rows), phi.shape[1]
    if not count:
        return gradients
    step = DIFFERENCE * ends.distance[rows]
    moves = np.concatenate([np.eye(size), -np.eye(size)])
    tried = (phi[rows, None] + step[:, None, None] * moves).reshape(-1, size)
    cost = problem.evaluate(tried, ends[np.repeat(rows, 2 * size)]).cost.reshape(count, 2, size)
    gradients[rows] = (cost[:, 0] - cost[:, 1]) / (2.0 * step[:, None])
    return gradients


class _Line(NamedTuple):
    """Curves with their cost, and a direction (B, p) to search along with the cost's slope."""

    phi: Phi
    ends: Ends
    value: Float[np.ndarray, "B"]
    direction: Phi
    slope: Float[np.ndarray, "B"]


def _line_search(problem: LearnedProblem, line: _Line) -> tuple[Phi, Float[np.ndarray, "B"]]:
    """The first of ever shorter steps whose decrease is sufficient (Armijo), else no step."""
    phi, new, share = line.phi.copy(), line.value.copy(), 1.0
    rows = np.arange(len(phi))
    for _ in range(HALVINGS):
        tried = phi[rows] + share * line.direction[rows]
        cost = ranks(problem.evaluate(tried, line.ends[rows]))
        enough = cost < line.value[rows] + SUFFICIENT * share * line.slope[rows]
        phi[rows[enough]], new[rows[enough]] = tried[enough], cost[enough]
        rows, share = rows[~enough], SHORTENED * share
        if not len(rows):
            break
    return phi, new


def _update(
    inverse: Float[np.ndarray, "B p p"],
    fresh: Bool[np.ndarray, "B"],
    rows: np.ndarray,
    change: Float[np.ndarray, "b p"],
    turn: Float[np.ndarray, "b p"],
) -> None:
    """BFGS update of the inverse Hessians in `rows`, in place; skipped where the curvature is not
    positive.

    Before the first one a Hessian is scaled to the curvature met (Nocedal and Wright, eq. 6.20).
    """
    curvature = (change * turn).sum(axis=1)
    kept = curvature > 1e-10
    rows, s, y, sy = rows[kept], change[kept], turn[kept], curvature[kept]
    scale = np.where(fresh[rows], sy / (y * y).sum(axis=1), 1.0)
    h = scale[:, None, None] * inverse[rows]
    left = np.eye(s.shape[1]) - s[:, :, None] * y[:, None] / sy[:, None, None]
    inverse[rows] = (
        left @ h @ left.transpose(0, 2, 1) + s[:, :, None] * s[:, None] / sy[:, None, None]
    )
    fresh[rows] = False
