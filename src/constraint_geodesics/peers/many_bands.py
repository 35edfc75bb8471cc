"""Elastic bands from many starts: the straight joint line and random bends of it."""

import time
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.fields import Count
from constraint_geodesics.peers.baseline import BaselineSettings, Context
from constraint_geodesics.peers.elastic_band import (
    Configurations,
    answer,
    bent_lines,
    first_free,
    settled,
    task_of,
    uniform_configurations,
)
from constraint_geodesics.problem import PathPlanner, PlanningProblem, Solution
from constraint_geodesics.search.band import BandSettings
from constraint_geodesics.search.candidates import refined


class ManyBandsSettings(BaselineSettings):
    """starts: number of bands; the first is straight."""

    family: ClassVar = "band"
    uses_bundle: ClassVar = True

    starts: Count = 32

    def make(self, context: Context) -> PathPlanner:
        """Bends past the nodes of the constraint's roadmap; without one, past random ones."""
        roadmap = context.bundle.roadmaps.get(context.constraint)
        if roadmap is None or not len(roadmap.joints):
            return MultiStartBand(self.starts)
        nodes = roadmap.joints

        def configurations(
            _: ConstraintManifold, count: int, rng: np.random.Generator
        ) -> Float[np.ndarray, "count D"]:
            return nodes[rng.integers(len(nodes), size=count)]

        return MultiStartBand(self.starts, configurations)


@dataclass(frozen=True)
class MultiStartBand:
    """The shortest of many bands, each from a parabola bent past a configuration of the constraint.

    configurations: what is bent past; by default drawn uniformly within the limits and projected.
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
        shortest_first = sorted((c for c in found if c is not None), key=lambda c: c.length)
        rows, _ = first_free(problem, shortest_first)
        return answer(rows, problem, began, len(found))


BASELINE = ManyBandsSettings
