"""The elastic band that starts as the straight joint line."""

import time
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from constraint_geodesics.peers.baseline import BaselineSettings, Context
from constraint_geodesics.peers.elastic_band import FINER, free_rows, nothing, settled, task_of
from constraint_geodesics.problem import PathPlanner, PlanningProblem, Solution
from constraint_geodesics.search.band import BandSettings
from constraint_geodesics.search.candidates import refined
from constraint_geodesics.search.roadmap import resample


class StraightBandSettings(BaselineSettings):
    """It has none of its own."""

    family: ClassVar = "band"
    random: ClassVar = False

    def make(self, context: Context) -> PathPlanner:
        """It needs nothing."""
        return StraightBand()


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
        for segments in (self.settings.segments * finer for finer in FINER):
            tried += 1
            candidate = refined(task, "straight", resample(straight, segments + 1))
            rows = None if candidate is None else free_rows(problem, task, candidate)
            if rows is not None:
                return Solution("solved", rows, time.perf_counter() - began, tried)
        return nothing(problem, began, tried)


BASELINE = StraightBandSettings
