"""Elastic bands without anything learned, on the same compiled kernels as the planner's own.

An elastic band [Quinlan and Khatib 1993] is a chain of configurations that is shortened until it is
taut; here on the constraint, by Newton's method (search/band.py).  It finds the shortest path
near the one it starts from, so what matters is the start: the straight joint line, many bends of
it, or another planner's path.
"""

import time
from collections.abc import Callable, Iterable

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.learning.lift import densify
from constraint_geodesics.problem import SATISFIED, PlanningProblem, Solution, Status, refusal
from constraint_geodesics.scene.clearance import NO_CLEARANCE
from constraint_geodesics.search.band import BandSettings, project, step_lengths
from constraint_geodesics.search.candidates import Candidate, Task, rows_of
from constraint_geodesics.search.curve_kernels import HALVINGS, LONGEST_ROW_STEP
from constraint_geodesics.search.space import space_of

ROW_SPACING = 0.04
"""Distance of the rows [rad] that are drawn along a given path, before they are halved where that
is not enough.
"""
ROW_SAFETY = 0.8
"""Share of the allowed violation between two rows that is used: nothing draws them closer later."""
COINCIDENT = 1e-9
"""Ends that are no further apart [rad] are one configuration: a band between them has no direction.
"""
FINER = (1, 2, 4)
_ROUNDS = 50

Configurations = Callable[[ConstraintManifold, int, np.random.Generator], Float[np.ndarray, "n D"]]
"""Draws as many configurations [rad] on or near a constraint as are asked for, or fewer if there
are few.
"""


def uniform_configurations(
    manifold: ConstraintManifold, count: int, rng: np.random.Generator
) -> Float[np.ndarray, "n D"]:
    """Drawn uniformly within the joint limits and projected; fewer than `count` where that hardly
    ever succeeds.
    """
    kept, found = [np.empty((0, manifold.robot.dof))], 0
    for _ in range(_ROUNDS):
        drawn = retract(manifold, manifold.robot.sample(2 * count, rng))
        inside = drawn.converged & (manifold.robot.limit_distance(drawn.joints) >= 0.0)
        kept.append(drawn.joints[inside][: count - found])
        found += len(kept[-1])
        if found >= count:
            break
    return np.concatenate(kept)


def bent_lines(
    problem: PlanningProblem, segments: int, count: int, configurations: Configurations, seed: int
) -> Float[np.ndarray, "count n D"]:
    """The straight joint line, then parabolas through points between its middle and random
    configurations [rad].
    """
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, segments + 1)[:, None]
    line = (1.0 - t) * problem.start + t * problem.goal
    shares = rng.uniform(size=(count - 1, 1))
    past = (
        configurations(problem.manifold, count - 1, rng)
        if count > 1
        else np.empty((0, line.shape[1]))
    )
    bends = shares[: len(past)] * (past - 0.5 * (problem.start + problem.goal))
    lines = np.concatenate([line[None], line + 4.0 * (t * (1.0 - t)) * bends[:, None, :]])
    lines[:, 0], lines[:, -1] = problem.start, problem.goal
    return lines


def rows_along(
    manifold: ConstraintManifold, joints: Float[np.ndarray, "T D"]
) -> Float[np.ndarray, "n D"]:
    """Rows along a path whose own rows lie on the constraint, so close that straight lines between
    them keep it to 1e-4 and stay within the limits; the ends stay, to the bit.  A jump remains one.
    """
    rows = densify(joints, ROW_SPACING)
    if len(rows) > 2:
        rows[1:-1] = _projected(manifold, rows[1:-1])
    return halved(manifold, rows)


def halved(
    manifold: ConstraintManifold, rows: Float[np.ndarray, "T D"]
) -> Float[np.ndarray, "n D"]:
    """The rows, with one more wherever a line between two leaves the constraint halfway, until none
    does.
    """
    for _ in range(HALVINGS):
        middle = 0.5 * (rows[1:] + rows[:-1])
        far = step_lengths(rows) > 1.1 * LONGEST_ROW_STEP
        off = np.flatnonzero((manifold.violation(middle) > ROW_SAFETY * SATISFIED) | far)
        if not len(off):
            break
        rows = np.insert(rows, off + 1, _projected(manifold, middle[off]), axis=0)
    return rows


def _projected(
    manifold: ConstraintManifold, points: Float[np.ndarray, "n D"]
) -> Float[np.ndarray, "n D"]:
    """On the constraint and within the limits, whatever is in the way; the points may be far from
    either.
    """
    moved = np.ascontiguousarray(points)
    project(space_of(manifold), moved)
    return moved


def task_of(problem: PlanningProblem, settings: BandSettings) -> Task:
    """The problem's constraint and clearance as the band takes them; one that is not known is left
    to `is_free`.
    """
    clearance = problem.clearance or NO_CLEARANCE
    return Task(problem.manifold, clearance, lambda: None, settings)


def settled(problem: PlanningProblem, began: float) -> Solution | None:
    """The answer to a problem that needs no search: its refusal, or the path between ends that
    coincide.
    """
    refused = refusal(problem)
    if refused is not None:
        return without_path(problem, refused, began)
    if np.linalg.norm(problem.goal - problem.start) <= COINCIDENT:
        return answer(np.stack([problem.start, problem.goal]), problem, began, 0)
    return None


def answer(
    rows: Float[np.ndarray, "T D"] | None,
    problem: PlanningProblem,
    began: float,
    iterations: int,
    explanation: str = "",
) -> Solution:
    """The record of a search that ends now.  rows: of the path, None for none.  began: its clock
    reading [s].  explanation: why there is no path.
    """
    if rows is None:
        return without_path(problem, "not_found", began, explanation, iterations)
    return Solution("solved", rows, time.perf_counter() - began, iterations)


def without_path(
    problem: PlanningProblem,
    status: Status,
    began: float,
    explanation: str = "",
    iterations: int = 0,
) -> Solution:
    """The record of a planner that has no path to give."""
    empty = np.empty((0, len(problem.start)))
    return Solution(status, empty, time.perf_counter() - began, iterations, explanation)


def first_free(
    problem: PlanningProblem, curves: Iterable[Candidate | None]
) -> tuple[Float[np.ndarray, "T D"] | None, int]:
    """`free_rows` of the first curve that has sound ones, where the problem can tell, or else of
    the first that has some; and how many curves were looked at.
    """
    first, tried = None, 0
    for tried, candidate in enumerate(curves, 1):
        rows = None if candidate is None else free_rows(problem, candidate)
        if rows is not None and is_kept(problem, rows):
            return rows, tried
        first = rows if first is None else first
    return first, tried


def is_kept(problem: PlanningProblem, joints: Float[np.ndarray, "T D"]) -> bool:
    """Whether a whole path is certified, where the problem can tell."""
    return problem.is_sound is None or problem.is_sound(joints)


def free_rows(problem: PlanningProblem, candidate: Candidate) -> Float[np.ndarray, "T D"] | None:
    """The candidate's rows, or None if it touches something.

    Where a curve is pushed past the corner of a box, its projection has a kink that no more of its
    points bridge: there the rows in between know nothing of clearance, but are checked like all
    others.
    """
    rows = halved(problem.manifold, rows_of(candidate, SATISFIED))
    return rows if problem.keeps_clear(rows) else None
