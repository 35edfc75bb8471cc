"""Sampling-based planning whose samples come from a learned manifold's decoder, projected onto the
constraint.

As in learned sampling for RRT-like planners [Ichter and Pavone 2019; Qureshi et al. 2020; Kicki et
al. 2023]: a sample is drawn in the latent space, decoded to joints, and moved onto the constraint.
Decoded samples are spread like the training data, so they are mostly free of collision, and near
the constraint where the data was.  The trees, the steps along the constraint and the simplification
are those of RRTConnect in `peers/ompl.py`.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal, Protocol

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.projection import Retraction, retract
from constraint_geodesics.learning.lift import Chart
from constraint_geodesics.peers.baseline import MANIFOLD, Context
from constraint_geodesics.peers.elastic_band import answer, rows_along, settled, without_path
from constraint_geodesics.peers.ompl_settings import OmplSettings
from constraint_geodesics.problem import PathPlanner, PlanningProblem, Solution

BATCH = 64
"""Samples that are decoded and projected at once."""


class LatentChart(Chart, Protocol):
    """A chart that knows how its training data is spread, as `learning.inference.FrozenManifold`
    does.
    """

    def sample(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "count N"]:
        """Latent points spread like the training data."""
        ...


class DecoderSettings(OmplSettings):
    """RRTConnect's, in the only space that takes samples from elsewhere."""

    family: ClassVar = "birrt"
    made_by: ClassVar = MANIFOLD

    space: Literal["projected"] = "projected"

    def make(self, context: Context) -> PathPlanner:
        """Samples of the planner's own manifold."""
        from constraint_geodesics.learning.inference import FrozenManifold

        return DecoderSampling(FrozenManifold.load(context.layout.manifold(context.searched)), self)


@dataclass(frozen=True)
class DecoderSampling:
    """RRTConnect with samples decoded from a chart of the same robot."""

    chart: LatentChart
    settings: DecoderSettings
    name: str = "BiRRT, decoded samples"

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """Grow two trees until they meet or the iterations are used up."""
        from constraint_geodesics.peers.ompl import birrt_with_sampler

        began = time.perf_counter()
        early = settled(problem, began)
        if early is not None:
            return early
        manifold = problem.manifold
        misfit = self._misfit(manifold)
        if misfit:
            return without_path(problem, "not_applicable", began, misfit)
        samples = decoded_samples(self.chart, manifold, np.random.default_rng(seed))
        deadline = began + self.settings.budget_s
        joints, iterations = birrt_with_sampler(
            problem, self.settings, partial(next, samples), seed, deadline
        )
        rows = None if joints is None else rows_along(manifold, joints)
        if rows is not None and not problem.keeps_clear(rows):  # they lie a little beside the path
            rows = None
        return answer(rows, problem, began, iterations)

    def _misfit(self, manifold: ConstraintManifold) -> str:
        """Why the decoder or OMPL's space cannot serve the constraint; empty where they can."""
        dof = self.chart.decode(np.zeros(self.chart.dim)).shape[-1]
        if dof != manifold.robot.dof:
            return f"the decoder's configurations have {dof} joints, the robot {manifold.robot.dof}"
        if manifold.codim >= manifold.robot.dof:
            return (
                f"{manifold.codim} axes are held by {manifold.robot.dof} joints: isolated "
                f"points are no space"
            )
        return ""


def decoded_samples(
    chart: LatentChart, manifold: ConstraintManifold, rng: np.random.Generator
) -> Iterator[Float[np.ndarray, "D"]]:
    """Endless configurations [rad] on the constraint and within the limits, or merely decoded where
    none is found.
    """
    axes = max(manifold.rows.held.sum(), 1)
    while True:
        drawn = chart.decode(chart.sample(BATCH, rng))
        share = rng.uniform(size=BATCH) ** (
            1.0 / axes
        )  # of a tolerance: spread over it, not on its edge
        projected = retract(manifold, drawn, Retraction(), band=share)
        kept = projected.converged & (manifold.robot.limit_distance(projected.joints) >= 0.0)
        yield from projected.joints[kept] if kept.any() else drawn


BASELINE = DecoderSettings
