"""The straight line of the latent space."""

import time
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.peers.baseline import MANIFOLD, BaselineSettings, Context
from constraint_geodesics.peers.elastic_band import answer
from constraint_geodesics.peers.latent_geodesic import free_rows, retracted_problem, turned_away
from constraint_geodesics.problem import PathPlanner, PlanningProblem, Solution


class StraightLatentSettings(BaselineSettings):
    """It has none of its own."""

    family: ClassVar = "latent"
    random: ClassVar = False
    made_by: ClassVar = MANIFOLD

    def make(self, context: Context) -> PathPlanner:
        """On the manifold that the planner uses."""
        return StraightLatent(context.learned(context.searched))


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
        early = turned_away(problem, self.chart, began)
        if early is not None:
            return early
        learned = retracted_problem(
            self.chart, problem.manifold, PinnedPolynomial(self.chart.dim, 1)
        )
        ends = learned.ends(problem.start[None], problem.goal[None])
        joints = free_rows(problem, learned, np.empty(0), ends)
        return answer(joints, problem, began, 1)


BASELINE = StraightLatentSettings
