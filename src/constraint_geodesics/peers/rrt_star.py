"""RRT* and Informed RRT* of OMPL: a tree that is rewired until its budget is over."""

from typing import ClassVar

from constraint_geodesics.fields import Positive
from constraint_geodesics.peers.baseline import Context
from constraint_geodesics.peers.ompl_settings import OmplSettings
from constraint_geodesics.problem import PathPlanner


class RrtStarSettings(OmplSettings):
    """informed: samples that cannot shorten the path are rejected."""

    family: ClassVar = "rrt_star"

    informed: bool = False
    budget_s: Positive = 1.0
    range_rad: Positive = 4.0

    def make(self, context: Context) -> PathPlanner:
        """Rows as far apart as the judge wants them."""
        from constraint_geodesics.peers.ompl import SamplingPlanner, Search

        search: Search = "informed_rrt_star" if self.informed else "rrt_star"
        return SamplingPlanner(search, self, context.params.judge.row_spacing_rad)

    @property
    def ends_by_counting(self) -> bool:
        """Its budget ends it."""
        return False


BASELINE = RrtStarSettings
