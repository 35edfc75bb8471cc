"""BiRRT: OMPL's RRTConnect, two trees that grow towards each other."""

from typing import ClassVar

from constraint_geodesics.peers.baseline import Context
from constraint_geodesics.peers.ompl_settings import OmplSettings
from constraint_geodesics.problem import PathPlanner


class BirrtSettings(OmplSettings):
    """It ends with its first path; `budget_s` stops it where there is none."""

    family: ClassVar = "birrt"

    def make(self, context: Context) -> PathPlanner:
        """Rows as far apart as the judge wants them."""
        from constraint_geodesics.peers.ompl import SamplingPlanner

        return SamplingPlanner("birrt", self, context.params.judge.row_spacing_rad)


BASELINE = BirrtSettings
