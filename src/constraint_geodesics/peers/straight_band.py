"""The elastic band that starts as the straight joint line."""

import time
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from constraint_geodesics.peers.baseline import BaselineSettings, Context
from constraint_geodesics.peers.elastic_band import FINER, answer, first_free, settled, task_of
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
        early = settled(problem, began)
        if early is not None:
            return early
        task = task_of(problem, self.settings)
        straight = np.stack([problem.start, problem.goal])
        lines = (resample(straight, self.settings.segments * finer + 1) for finer in FINER)
        curves = (refined(task, "straight", line) for line in lines)
        rows, tried = first_free(problem, curves)
        return answer(rows, problem, began, tried)


BASELINE = StraightBandSettings
