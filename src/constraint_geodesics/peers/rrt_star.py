"""RRT* and Informed RRT* of OMPL: a tree that is rewired until its budget is over."""

from typing import ClassVar

from constraint_geodesics.fields import Positive
from constraint_geodesics.peers.ompl_settings import OmplSettings, Search


class RrtStarSettings(OmplSettings):
    """informed: samples that cannot shorten the path are rejected."""

    family: ClassVar = "rrt_star"

    informed: bool = False
    budget_s: Positive = 1.0
    range_rad: Positive = 4.0

    @property
    def search(self) -> Search:
        """Informed or not."""
        return "informed_rrt_star" if self.informed else "rrt_star"

    @property
    def ends_by_counting(self) -> bool:
        """Its budget ends it."""
        return False


BASELINE = RrtStarSettings
