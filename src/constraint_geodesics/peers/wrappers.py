"""What turns a baseline into another one: a band after its paths, restarts, attempts until a path
is sound, and a memory.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import count

import numpy as np
from jaxtyping import Float

from constraint_geodesics.peers.elastic_band import (
    COINCIDENT,
    FINER,
    free_rows,
    is_kept,
    rows_along,
    task_of,
)
from constraint_geodesics.peers.last_problem import LastProblem
from constraint_geodesics.problem import PathPlanner, PlanningProblem, Solution
from constraint_geodesics.search.band import BandSettings, step_lengths
from constraint_geodesics.search.candidates import Candidate, Task, less_and_less_relaxed, refined
from constraint_geodesics.search.roadmap import resample

TRIES = 2
"""How often it is asked at least, where its first try takes all its time."""
SEEDS = 100_000
"""Restarts of one seed draw from their own range of seeds."""


@dataclass(frozen=True)
class Restarted:
    """The shortest path that a planner finds within `budget_s` [s], each attempt with another seed.

    Until there is a path it goes on as `UntilSound` does, for `limit_s` [s]; once there is one the
    time ends it: what an attempt that has begun finds later counts for nothing, and none is begun
    that would have to be quicker than the quickest.  One that is remembered counts with the time it
    took.  A path that is not sound counts for nothing where the problem can tell; `second` is asked
    after one, where there is one.
    """

    inner: PathPlanner
    budget_s: float
    second: PathPlanner | None = None
    limit_s: float = 0.0

    @property
    def name(self) -> str:
        """The planner's, and its budget."""
        return f"{self.inner.name}, restarted for {self.budget_s:g} s"

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """The first of the shortest sound paths, or what the first attempt answered where none
        found one.
        """
        best, shortest, quickest, iterations, spent = None, np.inf, np.inf, 0, 0.0
        asked, limit_s = self.inner, max(self.limit_s, self.budget_s)
        for attempt in count():
            began = time.perf_counter()
            answer = asked.plan(problem, SEEDS * seed + attempt)
            remembered_s = max(answer.time_s - (time.perf_counter() - began), 0.0)
            iterations += answer.iterations
            length, unsound = _length(answer), _is_unsound(problem, answer)
            if unsound:
                length, asked = np.inf, self.second or self.inner
            took = remembered_s + time.perf_counter() - began
            spent, quickest = spent + took, min(quickest, took)
            if np.isfinite(shortest) and spent > self.budget_s:
                spent = self.budget_s  # by then there was a path, which answers
            elif best is None or length < shortest:
                best, shortest = answer, length
            if np.isfinite(shortest):
                over = spent + quickest > self.budget_s
            else:
                over = spent >= limit_s and (attempt + 1 >= TRIES or not unsound)
            if over or answer.status not in ("solved", "not_found"):
                break
        assert best is not None
        return Solution(best.status, best.joints, spent, iterations, best.explanation)


@dataclass(frozen=True)
class UntilSound:
    """A planner that is asked again with another seed while its path is not sound, for `budget_s`
    [s] in all, TRIES times at least: one that looks at single configurations may touch something
    between them.  `second` is asked from the second attempt on, where there is one.

    An attempt that has begun is not interrupted, and one that finds nothing, after one that was not
    sound, is followed by another too.  Where the problem can't tell, the first answers.
    """

    inner: PathPlanner
    budget_s: float
    second: PathPlanner | None = None

    @property
    def name(self) -> str:
        """The planner's."""
        return self.inner.name

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """The first sound path, the looks at paths within its time; once that is over the last
        answer, sound or not, which is what the planner claims; any other answer as it is.
        """
        spent_s, attempts, iterations = 0.0, 0, 0
        asked = self.inner
        while True:
            answer = asked.plan(problem, SEEDS * seed + attempts)
            asked = self.second or self.inner
            attempts += 1
            iterations += answer.iterations
            began = time.perf_counter()
            again = _is_unsound(problem, answer) or (attempts > 1 and answer.status == "not_found")
            # a remembered answer holds its own time
            spent_s += answer.time_s + time.perf_counter() - began
            if not again or (attempts >= TRIES and spent_s >= self.budget_s):
                return replace(answer, time_s=spent_s, iterations=iterations)


def _is_unsound(problem: PlanningProblem, answer: Solution) -> bool:
    return answer.status == "solved" and not is_kept(problem, answer.joints)


def _length(answer: Solution) -> float:
    return float(step_lengths(answer.joints).sum()) if answer.status == "solved" else float(np.inf)


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
    """A planned path shortened by a band, time and iterations added to its own; without a path, or
    where no band is sound that is shorter, or at all where the path itself is not sound, what it
    was, on rows that keep the constraint between them if those are sound.
    """
    began = time.perf_counter()
    if (
        planned.status != "solved"
        or len(planned.joints) < 2
        or step_lengths(planned.joints).sum() <= COINCIDENT
    ):
        return planned
    own = rows_along(problem.manifold, planned.joints)
    longest, kept = float(step_lengths(own).sum()), cache(lambda: is_kept(problem, own))
    rows, iterations = None, 0
    task = task_of(problem, settings)
    for candidate in _bands_along(task, planned.joints):
        iterations += candidate.iterations
        if candidate.length < longest or not kept():
            relaxed = free_rows(problem, candidate)
            if relaxed is not None and is_kept(problem, relaxed):
                rows = relaxed
                break
    if rows is None:
        rows = own if kept() else planned.joints
    spent = time.perf_counter() - began
    return Solution("solved", rows, planned.time_s + spent, planned.iterations + iterations)


def _bands_along(task: Task, joints: Float[np.ndarray, "T D"]) -> Iterator[Candidate]:
    """Sound bands from a path: with more nodes where fewer jump or touch something, then less and
    less relaxed.
    """
    segments = task.settings.segments
    for pieces in (segments * finer for finer in FINER):
        candidate = refined(task, "graph", resample(joints, pieces + 1))
        if candidate is not None:
            yield candidate
    yield from less_and_less_relaxed(task, "graph", resample(joints, segments * FINER[-1] + 1))


@dataclass(frozen=True)
class Remembered:
    """A planner whose answers to the last problem are kept, so that a band after it shortens the
    very path that its own row shows.

    An answer holds the time it took, whoever asks for it again.
    """

    inner: PathPlanner
    _answers: LastProblem[Solution] = field(default_factory=LastProblem)

    @property
    def name(self) -> str:
        """The planner's."""
        return self.inner.name

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """The planner's answer; for the same problem, as an object, and seed it is not asked
        again.
        """
        return self._answers.found(problem, seed, lambda: self.inner.plan(problem, seed))
