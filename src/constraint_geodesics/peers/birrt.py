"""BiRRT: OMPL's RRTConnect, two trees that grow towards each other."""

from typing import ClassVar

from constraint_geodesics.peers.ompl_settings import OmplSettings, Search


class BirrtSettings(OmplSettings):
    """It ends with its first path; `budget_s` stops it where there is none."""

    family: ClassVar = "birrt"

    @property
    def search(self) -> Search:
        """RRTConnect."""
        return "birrt"


BASELINE = BirrtSettings
