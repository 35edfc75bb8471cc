"""The project's own planner, whole or in parts, asked as its baselines are."""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import ClassVar, Literal, get_args

from constraint_geodesics.bundle import read_bundle
from constraint_geodesics.constraints.constraint import Constraint
from constraint_geodesics.fields import Positive
from constraint_geodesics.methods import open_method
from constraint_geodesics.peers.baseline import GRAPH, BaselineSettings, Context
from constraint_geodesics.planner import Planner
from constraint_geodesics.problem import PathPlanner, PlanningProblem, Solution
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.search.candidates import ALL_PARTS, Parts

Part = Literal["straight", "graph", "refinement", "tree"]
"""What an entry may switch off."""
_PAIRS = 20
"""Of a roadmap's nodes, one of which will be free and joined."""


class PlannerSettings(BaselineSettings):
    """method: how it looks for curves (`Planner.load`).  without: parts that are switched off.
    only: those that are left, null: all that the planner has by itself.  budget_s: time [s] it goes
    on shortening its path for, or looking for one.
    """

    family: ClassVar = "planner"
    random: ClassVar = False
    uses_clearance: ClassVar = False  # it makes its own model
    uses_bundle: ClassVar = True

    method: Literal["planner", "learned", "learned+band"] = "planner"
    without: tuple[Part, ...] = ()
    only: tuple[Part, ...] | None = None
    budget_s: Positive | None = None

    def make(self, context: Context) -> PathPlanner:
        """All share one planner of each method, whose scene changes from query to query."""
        if self.method not in context.shared:
            context.shared[self.method] = _opened(context, self.method)
        parts = replace(ALL_PARTS, **dict.fromkeys(self.switched_off, False))
        planner = context.shared[self.method]
        return OwnPlanner(planner, planner.scene.now, parts, self.budget_s)

    @property
    def switched_off(self) -> set[str]:
        """Parts that it does without."""
        left = get_args(Part) if self.only is None else self.only
        return {*self.without, *(part for part in get_args(Part) if part not in left)}

    @property
    def trained(self) -> tuple[str, ...]:
        """The paper's system for the learned methods, nothing else."""
        if self.method == "planner":
            return ()
        return (*GRAPH, "train_policies", "build_learned")

    @property
    def uses_roadmaps(self) -> bool:
        """Unless they are switched off."""
        return "graph" not in self.switched_off

    @property
    def ends_by_counting(self) -> bool:
        """Without a budget."""
        return super().ends_by_counting and self.budget_s is None

    @property
    def given_s(self) -> float:
        """That of the restarts, or the budget."""
        return self.restarts_s or self.budget_s or 0.0


@dataclass(frozen=True)
class OwnPlanner:
    """The planner that users call, or some of its parts, behind the interface of its baselines."""

    planner: Planner
    scene: Scene
    parts: Parts = ALL_PARTS
    budget_s: float | None = None
    name: str = "planner"

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:  # nothing in it is random
        """One query under the problem's constraint, in the scene that it was made for."""
        if self.scene != self.planner.scene.now:
            self.planner.scene.become(self.scene)
        path = self.planner.plan(
            problem.start,
            problem.goal,
            problem.manifold.constraint,
            parts=self.parts,
            budget_s=self.budget_s,
        )
        explanation = "" if path.status == "solved" else path.explanation
        return Solution(path.status, path.joints, path.planning_time_s, 1, explanation)


@dataclass(frozen=True)
class _Open:
    """A planner as it was loaded.  known: the scene of its files; prepared: keys of constraints."""

    planner: Planner
    known: Scene
    prepared: set[object]


@lru_cache(maxsize=8)
def _open(folder: Path, method: str) -> _Open:
    """One a process, as those who plan have it."""
    bundle = read_bundle(folder)
    planner = Planner(bundle, "the pipeline's outputs", open_method(method, folder, bundle))
    return _Open(planner, planner.scene.now, set())


def _opened(context: Context, method: str) -> Planner:
    """The planner in the context's scene.  Roadmaps, which know no more than the scene of its
    files, are made before, and what the first query loads is loaded.
    """
    own, constraint = _open(context.layout.planner, method), context.manifold.constraint
    if constraint.key not in own.prepared:
        own.planner.scene.become(own.known)
        own.planner.prepare(constraint)
        nodes, trees = own.planner.nodes(constraint), Parts(straight=False, graph=False)
        if len(nodes):  # loads the trees' compiled code
            own.planner.plan(nodes[0], nodes[-1], constraint, parts=trees)
        own.prepared.add(constraint.key)
    own.planner.scene.become(replace(context.scene, robot=own.planner.robot))
    if method != "planner":
        _answer_once(own.planner, constraint)
    return own.planner


def _answer_once(planner: Planner, constraint: Constraint) -> None:
    """Let a method make what it keeps for a scene: configurations that are free in it, for curves
    to bend towards.
    """
    nodes = planner.nodes(constraint)
    for first, last in zip(nodes[:_PAIRS], nodes[-_PAIRS:], strict=True):
        if planner.plan(first, last, constraint).status not in ("in_collision", "not_connected"):
            return


BASELINE = PlannerSettings
