"""Bayesian optimisation of a curve's coefficients: a Gaussian process of the cost, asked where to
look next.

The only importer of bayes_opt.  A curve between the two ends is retracted onto the constraint and
costs its length and what is wrong with it; nothing is known of the cost but its values.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, ClassVar

import numpy as np
from bayes_opt import BayesianOptimization, SequentialDomainReductionTransformer, acquisition
from jaxtyping import Float
from pydantic import Field

from constraint_geodesics.fields import Count, Name, NonNegative, Positive
from constraint_geodesics.geodesics.learned_problem import LearnedProblem
from constraint_geodesics.geodesics.problem import Costs, Ends
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.learning.learned_manifold import JointManifold, LearnedManifold
from constraint_geodesics.peers.baseline import MANIFOLD, BaselineSettings, Context
from constraint_geodesics.peers.elastic_band import answer
from constraint_geodesics.peers.latent_geodesic import (
    EXACT,
    first_curves,
    free_rows,
    on_constraint,
    retracted_problem,
    turned_away,
)
from constraint_geodesics.problem import PathPlanner, PlanningProblem, Solution

LIMIT_SAMPLES = 1000
"""Configurations that the scale of a chart of joint space is taken from."""
COLLIDING = 3.0
"""Cost of a curve all of whose looked-at points collide, in units of the straight joint distance.
"""
COLLISION_POINTS = 15
"""Inner points of a curve at which collisions are looked for."""
WINDOW = 0.05
"""Least width of a variable's bounds, in units of the ends' distance."""


class BayesianSettings(BaselineSettings):
    """manifold: the learned one in which the curve is a polynomial; null: joint space itself.
    degree: of the polynomial; it has dim (degree - 1) variables, 6 for a parabola of 6 joints:
    twice as many hardly shorten a path and take several times as long.
    drawn: curves bent towards random configurations on the constraint, whose costs together take
    less than one question to the process.  The best of the straight line and the `kept` cheapest of
    them is what the process searches around.
    bound: largest change of a variable, in units of the ends' distance; after each evaluation the
    package draws the bounds closer around the best curve.  initial: curves at random within the
    bounds, before the process is asked for `evaluations` more.  exploration: κ of the confidence
    bound.
    """

    family: ClassVar = "other"

    manifold: Name | None = None
    degree: Annotated[int, Field(ge=2)] = 2
    drawn: Count = 2048
    kept: Count = 40
    bound: Positive = 0.5
    initial: Count = 12
    evaluations: Count = 40
    exploration: NonNegative = 2.0

    def make(self, context: Context) -> PathPlanner:
        """On the learned manifold that it names."""
        return BayesianPlanner(self, context.learned(self.manifold) if self.manifold else None)

    @property
    def trained(self) -> tuple[str, ...]:
        """The manifold, if any."""
        return MANIFOLD if self.manifold else ()


@dataclass(frozen=True)
class BayesianPlanner:
    """A Gaussian process over the coefficients of a curve, and the upper confidence bound of its
    gain; learned: the manifold that the curve lies on, None for joint space itself.
    """

    settings: BayesianSettings = field(default_factory=BayesianSettings)
    learned: LearnedManifold | None = None
    name: str = "Bayesian optimisation"

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """The cheapest curve met that is a path."""
        began = time.perf_counter()
        spread, rng = problem.manifold.robot.sample, np.random.default_rng(0)
        chart = self.learned or JointManifold.of(spread(LIMIT_SAMPLES, rng))
        early = turned_away(problem, chart, began)
        if early is not None:
            return early
        rng = np.random.default_rng(seed)
        joints = on_constraint(problem.manifold, self.settings.drawn, rng)
        learned = retracted_problem(
            chart, problem.manifold, PinnedPolynomial(chart.dim, self.settings.degree), joints
        )
        ends = learned.ends(problem.start[None], problem.goal[None])
        cost = _Cost(problem, learned, ends)
        known = first_curves(learned, ends, self.settings.drawn, self.settings.kept, rng)
        values = np.array([cost(phi) for phi in known])
        met, found = self._searched(cost, known[np.argmin(values)], seed)
        phi, value = np.concatenate([met, known]), np.concatenate([found, values])
        exact = replace(learned, retraction=EXACT)
        rows = None
        for row in np.argsort(value, kind="stable"):
            rows = free_rows(problem, exact, phi[row], ends)
            if rows is not None:
                break
        return answer(rows, problem, began, len(phi))

    def _searched(
        self, cost: "_Cost", centre: Float[np.ndarray, "p"], seed: int
    ) -> tuple[Float[np.ndarray, "n p"], Float[np.ndarray, "n"]]:
        """All curves met and their costs, the centre's first."""
        names, unit = [f"phi{k:03d}" for k in range(len(centre))], cost.ends.distance[0]

        def curve(away: Mapping[str, float]) -> Float[np.ndarray, "p"]:
            return centre + unit * np.array([away[name] for name in names])

        search = BayesianOptimization(
            lambda **away: -cost(curve(away)),
            dict.fromkeys(names, (-self.settings.bound, self.settings.bound)),
            verbose=0,
            random_state=seed,
            acquisition_function=_FrugalBound(kappa=self.settings.exploration),
            allow_duplicate_points=True,
            bounds_transformer=SequentialDomainReductionTransformer(minimum_window=WINDOW),
        )
        search.probe(dict.fromkeys(names, 0.0), lazy=False)
        search.maximize(init_points=self.settings.initial, n_iter=self.settings.evaluations)
        met = search.res
        phi = np.array([curve(entry["params"]) for entry in met])
        return phi, -np.array([entry["target"] for entry in met])


class _FrugalBound(acquisition.UpperConfidenceBound):
    """The confidence bound, its maximum looked for from one start in place of ten, at a tenth of
    the time.
    """

    def suggest(  # type: ignore[no-untyped-def]
        self, gp, target_space, n_random=5_000, n_smart=1, fit_gp=True, random_state=None
    ) -> Float[np.ndarray, "p"]:
        return super().suggest(gp, target_space, n_random, n_smart, fit_gp, random_state)


@dataclass(frozen=True)
class _Cost:
    """Logarithm of one curve's cost, its length and what is wrong with it, over the straight joint
    distance.

    A jump costs many times what there is to gain: without the logarithm the process would see
    nothing else.
    """

    problem: PlanningProblem
    learned: LearnedProblem
    ends: Ends

    def __call__(self, phi: Float[np.ndarray, "p"]) -> float:
        costs: Costs = self.learned.evaluate(phi[None], self.ends)
        return float(
            np.log(
                costs.cost[0] / self._direct
                + COLLIDING * self._colliding(phi, bool(costs.feasible[0]))
            )
        )

    def _colliding(self, phi: Float[np.ndarray, "p"], feasible: bool) -> float:
        """Share of a feasible curve's points that collide; those of others mean nothing."""
        if not feasible:
            return 0.0
        rows = self.learned.path(phi, self.ends, 0.1)
        inner = rows[np.linspace(0, len(rows) - 1, COLLISION_POINTS + 2).round().astype(int)[1:-1]]
        return float(np.mean([not self.problem.is_free(q) for q in inner]))

    @cached_property
    def _direct(self) -> float:
        return max(float(np.linalg.norm(self.problem.goal - self.problem.start)), 1e-9)


BASELINE = BayesianSettings
