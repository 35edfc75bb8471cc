"""Elastic bands without anything learned, on the same compiled kernels as the project's own
planner: its nearest peers.

An elastic band [Quinlan and Khatib 1993] is a chain of configurations that is shortened until it is
taut; here on the constraint, by Newton's method (geodesics/band.py).  It finds the shortest path
near the one it starts from, so what matters is the start: the straight joint line, many bends of
it, or another planner's path.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.learning.lift import densify
from constraint_geodesics.problem import SATISFIED, PathPlanner, PlanningProblem, Solution, refusal
from constraint_geodesics.scene.clearance import no_clearance
from constraint_geodesics.search.band import BandSettings, project, step_lengths
from constraint_geodesics.search.candidates import (
    HALVINGS,
    LONGEST_ROW_STEP,
    PARTLY_RELAXED,
    ROW_SAFETY,
    Candidate,
    Task,
    refined,
    rows_of,
)
from constraint_geodesics.search.roadmap import resample
from constraint_geodesics.search.space import space_of

ROW_SPACING = 0.04
"""Distance of the rows [rad] that are drawn along a given path, before they are halved where that
is not enough.
"""
CHECK_SPACING = 0.05
"""Distance of the configurations [rad] that are checked for collision on a path."""
COINCIDENT = 1e-9
"""Ends that are no further apart [rad] are one configuration: a band between them has no direction.
"""
_FINER = (1, 2, 4)
_ROUNDS = 50

Configurations = Callable[[ConstraintManifold, int, np.random.Generator], Float[np.ndarray, "n D"]]
"""Draws as many configurations [rad] on or near a constraint as are asked for, or fewer if there
are few.
"""


@dataclass(frozen=True)
class StraightBand:
    """The band that starts as the straight joint line from start to goal.

    A line that jumps where it is projected is tried again with more nodes.  No chance is involved:
    the seed is ignored.
    """

    settings: BandSettings = field(default_factory=BandSettings)
    name: str = "straight + band"

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """The relaxed line if it is sound; "not_found" if it jumps, leaves the limits or touches
        something.
        """
        began = time.perf_counter()
        del seed
        early = settled(problem, began)
        if early is not None:
            return early
        task = task_of(problem, self.settings)
        straight = np.stack([problem.start, problem.goal])
        tried = 0
        for segments in (self.settings.segments * finer for finer in _FINER):
            tried += 1
            candidate = refined(task, "straight", resample(straight, segments + 1))
            rows = None if candidate is None else free_rows(problem, task, candidate)
            if rows is not None:
                return Solution("solved", rows, time.perf_counter() - began, tried)
        return nothing(problem, began, tried)


@dataclass(frozen=True)
class MultiStartBand:
    """The shortest of many bands, each from a parabola bent past a configuration of the constraint.

    starts: number of bands; the first is straight.  configurations: what is bent past; by default
    drawn uniformly within the limits and projected.
    """

    starts: int = 32
    configurations: Configurations = field(default_factory=lambda: uniform_configurations)
    settings: BandSettings = field(default_factory=BandSettings)
    name: str = "band from many starts"

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """Relax all of them; the shortest that touches nothing is the answer."""
        began = time.perf_counter()
        early = settled(problem, began)
        if early is not None:
            return early
        task = task_of(problem, self.settings)
        lines = bent_lines(problem, self.settings.segments, self.starts, self.configurations, seed)
        found = [refined(task, "straight", line) for line in lines]
        for candidate in sorted((c for c in found if c is not None), key=lambda c: c.length):
            rows = free_rows(problem, task, candidate)
            if rows is not None:
                return Solution("solved", rows, time.perf_counter() - began, len(found))
        return nothing(problem, began, len(found))


@dataclass(frozen=True)
class BandAfter:
    """Another planner's path, shortened by a band; the path itself where no band is both sound and
    shorter.
    """

    inner: PathPlanner
    settings: BandSettings = field(default_factory=BandSettings)

    @property
    def name(self) -> str:
        """The other planner's, and the band."""
        return f"{self.inner.name} + band"

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """What the other planner answers, shortened; its time is part of the answer's."""
        return band_after(problem, self.inner.plan(problem, seed), self.settings)


def band_after(problem: PlanningProblem, planned: Solution, settings: BandSettings) -> Solution:
    """A planned path shortened by a band, time and iterations added to its own; without a path,
    what it was.
    """
    began = time.perf_counter()
    if (
        planned.status != "solved"
        or len(planned.joints) < 2
        or step_lengths(planned.joints).sum() <= COINCIDENT
    ):
        return planned
    own = rows_along(problem.manifold, planned.joints)
    longest = float(step_lengths(own).sum())
    rows, iterations = own, 0
    task = task_of(problem, settings)
    for candidate in _bands_along(task, planned.joints):
        iterations += candidate.iterations
        if candidate.length < longest:
            relaxed = free_rows(problem, task, candidate)
            if relaxed is not None:
                rows = relaxed
                break
    spent = time.perf_counter() - began
    return Solution("solved", rows, planned.time_s + spent, planned.iterations + iterations)


def _bands_along(task: Task, joints: Float[np.ndarray, "T D"]) -> Iterator[Candidate]:
    """Sound bands from a path: with more nodes where fewer jump or touch something, then less and
    less relaxed.
    """
    segments = task.settings.segments
    for pieces in (segments * finer for finer in _FINER):
        candidate = refined(task, "graph", resample(joints, pieces + 1))
        if candidate is not None:
            yield candidate
    for iterations in PARTLY_RELAXED:
        partly = replace(task, settings=replace(task.settings, iterations=iterations))
        candidate = refined(partly, "graph", resample(joints, segments * _FINER[-1] + 1))
        if candidate is not None:
            yield candidate


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
    """On the constraint and within the limits, whatever the boxes; the points may be far from
    either.
    """
    moved = np.ascontiguousarray(points)
    project(space_of(manifold), moved)
    return moved


def is_clear(problem: PlanningProblem, rows: Float[np.ndarray, "T D"]) -> bool:
    """Whether no configuration of a path, CHECK_SPACING apart, touches anything."""
    way = np.concatenate([[0.0], np.cumsum(step_lengths(rows))])
    at = np.linspace(0.0, way[-1], int(np.ceil(way[-1] / CHECK_SPACING)) + 1)
    points = np.stack([np.interp(at, way, column) for column in rows.T], axis=1)
    return all(problem.is_free(q) for q in points[1:-1])


def task_of(problem: PlanningProblem, settings: BandSettings) -> Task:
    """The problem's constraint and boxes as the band takes them; boxes that are not known are left
    to `is_free`.
    """
    clearance = problem.clearance or no_clearance(problem.manifold.robot.dof)
    return Task(problem.manifold, clearance, lambda: None, False, settings)


def settled(problem: PlanningProblem, began: float) -> Solution | None:
    """The answer to a problem that needs no search: its refusal, or the path between ends that
    coincide.
    """
    refused = refusal(problem)
    if refused is not None:
        return Solution(refused, np.empty((0, len(problem.start))), time.perf_counter() - began, 0)
    if np.linalg.norm(problem.goal - problem.start) <= COINCIDENT:
        return Solution(
            "solved", np.stack([problem.start, problem.goal]), time.perf_counter() - began, 0
        )
    return None


def nothing(
    problem: PlanningProblem, began: float, iterations: int, explanation: str = ""
) -> Solution:
    """The answer of a search that found no path."""
    empty = np.empty((0, len(problem.start)))
    return Solution("not_found", empty, time.perf_counter() - began, iterations, explanation)


def free_rows(
    problem: PlanningProblem, task: Task, candidate: Candidate
) -> Float[np.ndarray, "T D"] | None:
    """The candidate's rows, or None if it touches something.

    Where a curve is pushed past the corner of a box, its projection has a kink that no more of its
    points bridge: there the rows in between know nothing of boxes, but are checked like all others.
    """
    rows = halved(problem.manifold, rows_of(task, candidate, SATISFIED)[1])
    return rows if is_clear(problem, rows) else None
