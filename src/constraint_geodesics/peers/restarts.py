"""A planner asked again and again with other seeds until a time is over: any random planner as an
anytime one.
"""

import time
from dataclasses import dataclass

import numpy as np

from constraint_geodesics.problem import PathPlanner, PlanningProblem, Solution
from constraint_geodesics.search.band import step_lengths

SEEDS = 100_000
"""Restarts of one seed draw from their own range of seeds."""


@dataclass(frozen=True)
class Restarted:
    """The shortest path that a planner finds within `budget_s` [s], each attempt with another seed.

    An attempt that has begun is not interrupted; one that would not end in time by the mean of
    those before is not begun.  An answer that no other seed can change (a refusal, a misfit) ends
    the search at once.
    """

    inner: PathPlanner
    budget_s: float

    @property
    def name(self) -> str:
        """The planner's, and its budget."""
        return f"{self.inner.name}, restarted for {self.budget_s:g} s"

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """The first of the shortest paths, or what the first attempt answered where none found
        one.
        """
        began = time.perf_counter()
        best, attempts, iterations = None, 0, 0
        while True:
            answer = self.inner.plan(problem, SEEDS * seed + attempts)
            attempts += 1
            iterations += answer.iterations
            if best is None or _length(answer) < _length(best):
                best = answer
            spent = time.perf_counter() - began
            if (
                answer.status not in ("solved", "not_found")
                or spent * (attempts + 1) / attempts > self.budget_s
            ):
                return Solution(best.status, best.joints, spent, iterations, best.explanation)


def _length(answer: Solution) -> float:
    return float(step_lengths(answer.joints).sum()) if answer.status == "solved" else float(np.inf)
