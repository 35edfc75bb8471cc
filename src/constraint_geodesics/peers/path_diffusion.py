"""Whole paths drawn by a diffusion model that learned them from this project's planner.

As in motion planning by diffusion [Janner et al. 2022; Carvalho et al. 2023], a network turns noise
into paths between the two ends; here it also sees what the constraint does to the straight line
between them (learning/path_diffusion.py).  Before a step is taken, the path that it expects is
projected onto the constraint, into the limits and out of what it touches [Christopher et al. 2024]:
of the scene the network knows no more than the paths that it learned from show.
"""

import time
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import numpy as np
from jaxtyping import Float
from pydantic import Field

from constraint_geodesics.fields import Count
from constraint_geodesics.learning.path_diffusion import (
    Correction,
    Curves,
    PathDiffusion,
    conditions,
    straight,
)
from constraint_geodesics.peers.baseline import BaselineSettings, Context
from constraint_geodesics.peers.elastic_band import answer, settled, task_of, without_path
from constraint_geodesics.peers.kept_rows import first_kept
from constraint_geodesics.problem import PathPlanner, PlanningProblem, Solution
from constraint_geodesics.search.band import BandSettings, project
from constraint_geodesics.search.candidates import Task, refined

STAGE = "train_path_diffusion"


class PathDiffusionSettings(BaselineSettings):
    """proposals: paths drawn for a query.  steps: of DDIM.  projected: of these, the last ones, in
    which the expected path is projected.
    """

    family: ClassVar = "other"
    made_by: ClassVar = (STAGE,)

    proposals: Count = 32
    steps: Count = 4
    projected: Annotated[int, Field(ge=0)] = 4

    def make(self, context: Context) -> PathPlanner:
        """From the files of its stage."""
        return DiffusionPlanner(PathDiffusion.load(context.layout.path_diffusion), self)


@dataclass(frozen=True)
class DiffusionPlanner:
    """The shortest of the paths drawn for a query that is sound.

    band: its segments are those between the points that a drawn path is taken at, and its clearance
    is kept at these.
    """

    model: PathDiffusion
    settings: PathDiffusionSettings = field(default_factory=PathDiffusionSettings)
    band: BandSettings = field(default_factory=BandSettings)
    name: str = "path diffusion"

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """The shortest sound path of those drawn; iterations counts them."""
        began = time.perf_counter()
        dof = problem.manifold.robot.dof
        if dof != self.model.dof:
            another = f"the model is that of {self.model.dof} joints, the robot has {dof}"
            return without_path(problem, "not_applicable", began, another)
        early = settled(problem, began)
        if early is not None:
            return early
        task = task_of(problem, self.band)
        # zero iterations of a band: the curve through the points, on the constraint
        found = [
            refined(task, "straight", curve, refine=False)
            for curve in self.proposed(problem, task, seed)
        ]
        shortest_first = sorted((c for c in found if c is not None), key=lambda c: c.length)
        rows = first_kept(problem, shortest_first)
        return answer(rows, problem, began, self.settings.proposals)

    def proposed(
        self, problem: PlanningProblem, task: Task, seed: int
    ) -> Float[np.ndarray, "B n D"]:
        """The paths drawn for a query, at even times [rad]."""
        start, goal = problem.start, problem.goal
        seen = conditions(problem.manifold, start[None], goal[None])[0]
        noise = self.model.noise(self.settings.proposals, np.random.default_rng(seed))
        line = straight(start, goal, self.band.segments + 1)
        return self.model.curves(seen, line, noise, self._corrections(task))

    def _corrections(self, task: Task) -> list[Correction | None]:
        """Of each step."""

        def projected(curves: Curves) -> Curves:
            inner: Float[np.ndarray, "n D"] = curves[:, 1:-1].reshape(-1, curves.shape[-1])
            project(task.clear, inner)
            between = inner.reshape(len(curves), -1, curves.shape[-1])
            return np.concatenate([curves[:, :1], between, curves[:, -1:]], axis=1)

        count = min(self.settings.projected, self.settings.steps)
        return [None] * (self.settings.steps - count) + [projected] * count


BASELINE = PathDiffusionSettings
