"""Geodesics in the latent space of the learned manifold by descent, retracted onto the constraint:
no policy, no graph.

The manifold was trained once, without a constraint.  A curve between the encoded ends is decoded,
its ends are corrected and every point is retracted onto the constraint; the length of that path is
what is minimised.
"""

import time
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, ClassVar

import numpy as np
from jaxtyping import Float, Int
from pydantic import Field
from scipy import optimize

from constraint_geodesics.fields import Count
from constraint_geodesics.geodesics.descent import INFEASIBLE, beginning, descended, ranks
from constraint_geodesics.geodesics.learned_problem import LearnedProblem
from constraint_geodesics.geodesics.problem import Ends, repeated
from constraint_geodesics.geometry.curves import PinnedSpline
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.lift import corrected, retracted
from constraint_geodesics.peers.baseline import MANIFOLD, BaselineSettings, Context
from constraint_geodesics.peers.elastic_band import answer
from constraint_geodesics.peers.latent_geodesic import (
    EXACT,
    FINE_DEGREE,
    first_curves,
    free_rows,
    on_constraint,
    retracted_problem,
    turned_away,
)
from constraint_geodesics.problem import PathPlanner, PlanningProblem, Solution
from constraint_geodesics.scene.clearance import ClearanceModel

DIFFERENCE = 3e-4
"""Half step of central differences, in units of the ends' distance: the decoder computes in single
precision.
"""
LEAST_GRADIENT = 1e-3
"""Gradient of the cost [rad per unit of the ends' distance] at which a curve is a minimum."""
ALIKE = 0.02
"""Curves whose coefficients differ by less, in units of the ends' distance, are one."""
MARGIN, PUSH = 0.01, 200.0
"""Distance of what may meet that is kept [m], and the cost of what is missing, as a mean along the
curve [rad/m].
"""
CLEARANCE_POINTS = 65


class GradientGeodesicSettings(BaselineSettings):
    """segments: of the family, cubic C² splines (1: the cubics of eq. 10).  drawn: curves bent
    towards random configurations on the constraint, of which the cheapest join the straight line as
    `starts` in all.
    descent_steps: along the problem's descent.  polished: different curves that BFGS goes on with,
    polish_steps: its iterations at most.  rounds: of all this, each with other random curves, until
    one finds a path.
    """

    family: ClassVar = "latent"
    made_by: ClassVar = MANIFOLD

    segments: Count = 2
    drawn: Count = 1024
    starts: Count = 16
    descent_steps: Count = 15
    polished: Count = 1
    polish_steps: Annotated[int, Field(ge=0)] = 15
    rounds: Count = 3

    def make(self, context: Context) -> PathPlanner:
        """On the manifold that the planner uses."""
        return GradientGeodesic(context.learned(context.searched), self)


@dataclass(frozen=True)
class GradientGeodesic:
    """The shortest retracted curve of a family that descent finds from several starts, one of them
    straight.

    All starts go down together along the problem's own descent (`LearnedProblem.observed`: the
    tangential part of the path's curvature, pulled back to the chart), each with a step size of its
    own.  That stands still where the mean Jacobian of the decoder is no longer exact; from there
    BFGS on the cost itself polishes the best.  Where every one of these collides, they are pushed
    out of collisions, as far as `problem.clearance` knows them.
    """

    chart: LearnedManifold
    settings: GradientGeodesicSettings = field(default_factory=GradientGeodesicSettings)
    name: str = "gradient geodesic"

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """The shortest curve that is a path; the random starts depend on the seed."""
        began = time.perf_counter()
        early = turned_away(problem, self.chart, began)
        if early is not None:
            return early
        rng = np.random.default_rng(seed)
        joints = on_constraint(problem.manifold, self.settings.drawn, rng)
        learned = retracted_problem(
            self.chart,
            problem.manifold,
            PinnedSpline(self.chart.dim, self.settings.segments),
            joints,
        )
        ends = learned.ends(problem.start[None], problem.goal[None])
        costs = [_Cost(learned, ends)]
        if problem.clearance is not None and problem.clearance.arrays.top:
            costs.append(_Cost(learned, ends, problem.clearance))
        found, iterations = None, 0
        for _ in range(self.settings.rounds):
            if found is not None:
                break
            steps = self.settings.descent_steps
            bent = self.settings.starts - 1
            starts = first_curves(learned, ends, self.settings.drawn, bent, rng)
            many = repeated(ends, len(starts))
            met = descended(learned, beginning(learned, starts, many), many, steps).phi
            iterations += steps
            for cost in costs:
                if found is None:
                    found, steps = self._polished(cost, met, problem)
                    iterations += steps
        return answer(found, problem, began, iterations)

    def _polished(
        self, cost: "_Cost", met: Float[np.ndarray, "K p"], problem: PlanningProblem
    ) -> tuple[Float[np.ndarray, "T D"] | None, int]:
        """Rows of the cheapest curve that is a path, and the iterations spent on it."""
        coarse = cost(met)
        picked = met[different(met, coarse, ALIKE * cost.ends.distance[0])]
        fine, tried, steps = cost.finer(), [], 0
        for phi in picked[: self.settings.polished]:
            better, spent = polished(fine, phi, self.settings.polish_steps)
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


BASELINE = GradientGeodesicSettings
