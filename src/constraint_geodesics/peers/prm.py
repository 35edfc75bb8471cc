"""PRM and PRM* of OMPL: a roadmap of random configurations, made for one query."""

from typing import ClassVar

from constraint_geodesics.fields import Count, Positive
from constraint_geodesics.peers.ompl_settings import OmplSettings, Search


class PrmSettings(OmplSettings):
    """iterations: samples at most; PRM ends with its first path, PRM* (`star`) uses all of them."""

    family: ClassVar = "prm"

    star: bool = False
    budget_s: Positive = 3.0
    iterations: Count = 100_000

    @property
    def search(self) -> Search:
        """With or without the star."""
        return "prm_star" if self.star else "prm"

    @property
    def ends_by_counting(self) -> bool:
        """PRM* runs until its budget is over."""
        return super().ends_by_counting and not self.star


BASELINE = PrmSettings
