"""The project's own planner, whole or in parts, asked as its baselines are."""

from dataclasses import dataclass, replace
from typing import ClassVar, Literal, get_args

from constraint_geodesics.params import Positive, SphereParams
from constraint_geodesics.peers.baseline import GRAPH, BaselineSettings, Context
from constraint_geodesics.planner import Planner
from constraint_geodesics.problem import PathPlanner, PlanningProblem, Solution
from constraint_geodesics.scene.world import Sphere
from constraint_geodesics.search.candidates import ALL_PARTS, Parts

Part = Literal["straight", "policy", "graph", "refinement", "tree"]


class PlannerSettings(BaselineSettings):
    """without: parts that are switched off.  only: those that are left, null: all that the planner
    has by itself.  budget_s: time [s] it goes on shortening its path for.
    """

    family: ClassVar = "planner"
    uses_bundle: ClassVar = True
    random: ClassVar = False
    uses_clearance: ClassVar = False  # it makes its own model

    without: tuple[Part, ...] = ()
    only: tuple[Part, ...] | None = None
    budget_s: Positive | None = None

    def make(self, context: Context) -> PathPlanner:
        """Baselines made together share one planner, opened once."""
        if "planner" not in context.shared:
            context.shared["planner"] = _opened(context)
        parts = replace(ALL_PARTS, **dict.fromkeys(self.switched_off, False))
        return OwnPlanner(context.shared["planner"], parts, self.budget_s)

    @property
    def switched_off(self) -> set[str]:
        """Parts that it does without."""
        left = get_args(Part) if self.only is None else self.only
        return {*self.without, *(part for part in get_args(Part) if part not in left)}

    @property
    def trained(self) -> tuple[str, ...]:
        """The graph, policies and their bundle; nothing where neither graph nor policies are on."""
        if {"graph", "policy"} <= self.switched_off:
            return ()
        return (*GRAPH, "train_policies {searched}", "build_planner")

    @property
    def ends_by_counting(self) -> bool:
        """Without a budget."""
        return super().ends_by_counting and self.budget_s is None

    @property
    def given_s(self) -> float:
        """The budget."""
        return self.budget_s or 0.0


@dataclass(frozen=True)
class OwnPlanner:
    """The planner that users call, or some of its parts, behind the interface of its baselines."""

    planner: Planner
    parts: Parts = ALL_PARTS
    budget_s: float | None = None
    name: str = "planner"

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:  # nothing in it is random
        """One query under the problem's constraint."""
        path = self.planner.plan(
            problem.start,
            problem.goal,
            problem.manifold.constraint,
            parts=self.parts,
            budget_s=self.budget_s,
        )
        explanation = "" if path.status == "solved" else path.explanation
        return Solution(path.status, path.joints, path.planning_time_s, 1, explanation)


def _opened(context: Context) -> Planner:
    """The planner in the context's scene, its graph and networks loaded."""
    workcell, bundle = context.params.workcell, context.bundle
    balls = {
        body.name: SphereParams(
            centre_m=body.centre, radius_m=body.radius, exempt_links=body.exempt_links
        )
        for body in context.scene.workcell
        if isinstance(body, Sphere)
    }
    within = workcell.model_copy(update={"spheres": {**workcell.spheres, **balls}})
    planner = context.opened.enter_context(
        Planner(replace(bundle, workcell=within), "the pipeline's outputs")
    )
    constraint = context.manifold.constraint
    planner.prepare(constraint)
    nodes = planner.nodes(constraint)
    for parts in (
        Parts(straight=False, graph=False, tree=False),
        Parts(straight=False, graph=False, policy=False),
    ):  # loads the networks and the trees' compiled code
        planner.plan(nodes[0], nodes[-1], constraint, parts=parts)
    return planner


BASELINE = PlannerSettings
