"""What OMPL's planners share: their state space and how they walk in it, without loading ompl."""

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field

from constraint_geodesics.fields import Count, Positive
from constraint_geodesics.peers.baseline import BaselineSettings, Context
from constraint_geodesics.peers.last_problem import LastProblem
from constraint_geodesics.problem import PathPlanner

Search = Literal["prm", "prm_star", "rrt_star", "informed_rrt_star", "birrt"]


class OmplSettings(BaselineSettings):
    """space: OMPL's constrained state space.  budget_s: limit of one query [s]; iterations: of the
    search, at most.  delta_rad: step along the constraint between two validity checks.  range_rad:
    longest extension of a tree.  simplify: the path is shortened by OMPL.

    Of the charts of atlas and tangent bundle: radius ρ, distance ε to the manifold at most, and the
    share of samples drawn beyond the charts that there are; own_charts: these, not OMPL's own.
    """

    uses_clearance: ClassVar = False
    asks_in_python: ClassVar = True

    space: Literal["projected", "atlas", "tangent_bundle"] = "projected"
    budget_s: Positive = 2.0
    iterations: Count = 1_000_000
    delta_rad: Positive = 0.1
    range_rad: Positive = 2.0
    own_charts: bool = True
    chart_radius_rad: Positive = 1.0
    chart_error_rad: Positive = 0.1
    exploration: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.75
    simplify: bool = True

    @property
    def search(self) -> Search:
        """Which of OMPL's planners it is."""
        raise NotImplementedError

    def make(self, context: Context) -> PathPlanner:
        """Rows as far apart as the judge wants them."""
        from constraint_geodesics.peers.ompl import SamplingPlanner

        searches = context.shared.setdefault("OMPL's searches", LastProblem())
        return SamplingPlanner(self.search, self, context.params.judge.row_spacing_rad, searches)

    @property
    def bare(self) -> Self:
        """The path as it is found: a band shortens it sooner than OMPL does, and as much."""
        return self.model_copy(update={"band": False, "simplify": self.simplify and not self.band})

    @property
    def search_alone(self) -> Self:
        """What the search depends on, and not what is done with its path."""
        return self.model_copy(update={"simplify": True, "band": False, "restarts_s": None})

    @property
    def given_s(self) -> float:
        """That of the restarts, or the budget."""
        return self.restarts_s or self.budget_s

    @property
    def with_half_step(self) -> Self:
        """With half of `delta_rad`."""
        return self.model_copy(update={"delta_rad": self.delta_rad / 2.0})
