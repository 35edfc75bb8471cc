"""The driver of every geodesic solver: checks the ends and answers what needs no search."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from constraint_geodesics.geodesics.images import images_between, nearest_image, with_goals_bits
from constraint_geodesics.geodesics.problem import (
    ChartProblem,
    Ends,
    Geodesic,
    GeodesicSolver,
    SearchStatus,
)
from constraint_geodesics.geodesics.taut import stays_inside
from constraint_geodesics.geometry.curves import Curves
from constraint_geodesics.geometry.manifold import WalledManifold

LENGTH_TOLERANCE = 1e-6
"""Relative error aimed at for the lengths that candidates are ranked by and results carry."""


class Work(NamedTuple):
    """What a batch of queries took: steps of the solver, curves measured, seconds."""

    iterations: int
    evaluations: int
    time_s: float


@dataclass(frozen=True)
class Candidates:
    """Curves that compete for queries: which query (C,), coefficients, and the ends in the chart.

    Several rows may serve one query, with different images of its goal.
    """

    query: Int[np.ndarray, "C"]
    phi: Float[np.ndarray, "C p"]
    start: Float[np.ndarray, "C N"]
    goal: Float[np.ndarray, "C N"]

    def ends(self) -> Ends:
        """The ends of every curve."""
        return Ends(self.start, self.goal, self.start, self.goal)

    @classmethod
    def join(cls, parts: Sequence["Candidates"]) -> "Candidates":
        """All rows of several."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))


def geodesics_between(
    solver: GeodesicSolver,
    problem: ChartProblem,
    start: Float[np.ndarray, "B N"],
    goal: Float[np.ndarray, "B N"],
) -> list[Geodesic]:
    """Geodesics between B starts and goals in the chart, by any solver, one record each.

    Ends that are one point of the manifold give a curve of length 0.  Raises GeometryError on a
    wrong shape, NonFiniteError or OutsideError with the first end that is no point of the manifold.
    """
    ends = problem.ends(start, goal)
    same = np.logical_not(nearest_image(problem.manifold, ends.z_goal - ends.z_start).any(axis=1))
    found = iter(solver.solve(problem, ends[np.flatnonzero(~same)]) if not same.all() else [])
    zero = np.zeros(problem.curve.coefficients)
    return [
        Geodesic("converged", problem.curve, zero, z, z, 0.0, 0.0) if here else next(found)
        for here, z in zip(same, ends.z_start, strict=True)
    ]


def to_nearest_images(problem: ChartProblem, ends: Ends) -> Ends:
    """The same ends with the image of each goal that lies nearest to its start in the chart."""
    image = ends.z_start + nearest_image(problem.manifold, ends.z_goal - ends.z_start)
    return replace(ends, z_goal=with_goals_bits(image, ends.z_goal))


def goal_images(
    problem: ChartProblem, ends: Ends
) -> tuple[Int[np.ndarray, "C"], Float[np.ndarray, "C N"]]:
    """Images of the goals, both ways round each periodic coordinate, and their queries."""
    goals = images_between(problem.manifold, ends.z_start, ends.z_goal)
    return np.repeat(np.arange(len(ends)), goals.shape[1]), goals.reshape(-1, goals.shape[-1])


def shortest_of(
    problem: ChartProblem,
    ends: Ends,
    candidates: Candidates,
    converged: Bool[np.ndarray, "C"],
    work: Work,
) -> list[Geodesic]:
    """The shortest curve of each query that stays on the manifold; "not_found" where there is none.

    work: of the whole batch; each record carries its query's share of the evaluations and time.
    """
    curves = candidates.phi, candidates.ends()
    length = problem.lengths(*curves, LENGTH_TOLERANCE)
    length = np.where(_inside(problem, *curves), length, np.inf)
    lines = np.zeros((len(ends), problem.curve.coefficients))
    straight = problem.lengths(lines, to_nearest_images(problem, ends), LENGTH_TOLERANCE)
    # of curves that are alike to within their accuracy one that has converged is the answer
    rank = length * np.where(converged, 1.0, 1.0 + LENGTH_TOLERANCE)
    results = []
    for query in range(len(ends)):
        rows = np.flatnonzero(candidates.query == query)
        best = rows[np.argmin(rank[rows])]
        status: SearchStatus = "converged" if converged[best] else "iteration_limit"
        if not np.isfinite(length[best]):
            status = "not_found"
        found = candidates.phi[best], candidates.start[best], candidates.goal[best]
        own = float(length[best]) if status != "not_found" else float("nan")
        evaluations, time_s = work.evaluations * len(rows) // len(length), work.time_s / len(ends)
        spent = work.iterations, evaluations, time_s
        line = float(straight[query])
        results.append(Geodesic(status, problem.curve, *found, own, line, *spent))
    return results


def _inside(
    problem: ChartProblem, phi: Float[np.ndarray, "C p"], ends: Ends
) -> Bool[np.ndarray, "C"]:
    """Whether each curve stays on the manifold; among walls it is looked up at every step."""
    inside = problem.stays_inside(phi, ends)
    manifold = problem.manifold
    if isinstance(manifold, WalledManifold):
        arrays = (torch.from_numpy(np.asarray(x)) for x in (phi, ends.z_start, ends.z_goal))
        curves = Curves(problem.curve, *arrays)
        for row in np.flatnonzero(inside):
            inside[row] = stays_inside(manifold, curves[int(row)])
    return inside
