"""OMPL's PRM, PRM*, RRT*, Informed RRT* and BiRRT (RRTConnect) on the constraint manifold: the
baselines' searches.

The only importer of ompl.  Held axes are planned in OMPL's constrained state spaces (projected,
atlas, tangent bundle), no constraint in the plain space of the joints.  OMPL's random numbers
restart with every problem: where a search ends by counting, a seed gives the same path in any
process, whatever was planned before and however busy the machine is.  Where `budget_s` ends it, the
path depends on the machine.
"""

import itertools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from ompl import base, geometric, util

from constraint_geodesics.constraints import kernels
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.projection import Retraction, new_room, retract, retract_all
from constraint_geodesics.learning.lift import as_executed
from constraint_geodesics.peers.elastic_band import answer, without_path
from constraint_geodesics.peers.last_problem import LastProblem
from constraint_geodesics.peers.ompl_settings import OmplSettings, Search
from constraint_geodesics.problem import SATISFIED, PlanningProblem, Solution, refusal
from constraint_geodesics.robot.kinematics import SerialRobot

_STALL = 0.2
"""A step along the constraint that advances by less than this share of itself leads nowhere."""
_WANDER = 2.0
"""OMPL's λ: a step along the constraint is at most this many times as long as the straight one."""
_EXPANDED, _EXPANDED_SHARE = 2, 0.05
"""Milestones of a roadmap that come by random walks between two looks, and as a share of all."""
_WALK = 5
"""Milestones that one of these walks leaves at most: OMPL's own number."""
_SHORTCUTS = 50
_FINER = (1, 2, 4)
"""Into how many parts the step between two looks is divided where a shortened path touches
something.
"""

Sampler = Callable[[], Float[np.ndarray, "D"]]
"""Draws one configuration [rad], which is projected onto the constraint afterwards."""


class _Found(NamedTuple):
    """What a search came to: its space, OMPL's path if there is one, iterations and time [s]."""

    space: "_Space"
    path: Any
    iterations: int
    time_s: float


@dataclass(frozen=True)
class SamplingPlanner:
    """One of OMPL's planners with its settings.

    row_spacing_rad: distance of the path's rows at most, the constraint kept between them; None for
    OMPL's own rows.  searches: those that it shares with others.
    """

    name: Search
    settings: OmplSettings
    row_spacing_rad: float | None = None
    searches: LastProblem[_Found] = field(default_factory=LastProblem)

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """Look for a path until one is found (PRM, BiRRT) or the iterations are used up (RRT*
        always uses them).

        Rows of the path lie at most 2 `delta_rad` apart, unless the planner's own edge jumps: the
        jump is kept.
        time_s holds everything from here on: the projections, the simplification, the rows in
        between.
        """
        began = time.perf_counter()
        refused = refusal(problem)
        if refused is not None:
            return without_path(problem, refused, began)
        misfit = self._misfit(problem.manifold)
        if misfit:
            return without_path(problem, "not_applicable", began, misfit)
        search = self.settings.search_alone
        space, path, iterations, spent_s = self.searches.found(
            problem, (self.name, search, seed), lambda: self._found(problem, search, seed)
        )
        began = time.perf_counter() - spent_s
        if path is None:
            return answer(None, problem, began, iterations)
        shortened = self.settings.simplify
        joints = (_simplified(space, path, seed) if shortened else space.dense(path))[0]
        if self.row_spacing_rad is not None:
            joints = as_executed(problem.manifold, joints, self.row_spacing_rad)
        return answer(joints, problem, began, iterations)

    def _found(self, problem: PlanningProblem, settings: OmplSettings, seed: int) -> _Found:
        began = time.perf_counter()
        _start_random_numbers(seed)
        space = _Space(problem, settings, seed=seed)
        path, iterations = _SEARCHES[self.name](space, settings, began + settings.budget_s)
        return _Found(space, path, iterations, time.perf_counter() - began)

    def _misfit(self, manifold: ConstraintManifold) -> str:
        """Why OMPL has no space of this kind for the constraint; empty where it has one."""
        if manifold.codim >= manifold.robot.dof:
            return (
                f"{manifold.codim} rows are held by {manifold.robot.dof} joints: isolated "
                f"points are no space"
            )
        if manifold.rows.tolerance.any() and self.settings.space != "projected":
            return (
                f"a tolerance has no tangent spaces, which the {self.settings.space} space "
                f"is made of"
            )
        return ""


def birrt_with_sampler(
    problem: PlanningProblem, settings: OmplSettings, sampler: Sampler, seed: int, deadline: float
) -> tuple[Float[np.ndarray, "T D"] | None, int]:
    """RRTConnect in the projected space with samples from elsewhere, shortened or not as
    `SamplingPlanner`'s paths are.

    Both ends must be sound.  deadline: of time.perf_counter().  Returns the rows, None without a
    sound path, and the iterations.
    """
    _start_random_numbers(seed)
    space = _Space(problem, settings, sampler)
    found, iterations = _SEARCHES["birrt"](space, settings, deadline)
    if found is None:
        return None, iterations
    joints, sound = _simplified(space, found, seed) if settings.simplify else space.dense(found)
    return (joints if sound else None), iterations


class _Single:
    """The constraint of one configuration at a time, without what arrays and checks of a batch
    cost: OMPL asks for it thousands of times a path.
    """

    def __init__(self, manifold: ConstraintManifold) -> None:
        count, dof = len(manifold.rows.held), manifold.robot.dof
        self._manifold, self._q = manifold.arrays, np.empty((1, dof))
        self._residual, self._jacobian = np.empty((1, count)), np.empty((1, count, dof))
        self._worst, self._share = np.empty(1), np.ones(1)
        self._settings = Retraction()
        self._room = new_room(self._manifold.constraint, dof)

    def linearise(self, x: np.ndarray) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m D"]]:
        """Residual and Jacobian, until the next call."""
        self._q[0] = x
        kernels.residual_batch(self._manifold, self._q, self._residual, self._jacobian)
        return self._residual[0], self._jacobian[0]

    def violation(self, x: np.ndarray) -> float:
        """Excess over the tolerance [rad or m]."""
        self._q[0] = x
        kernels.violation_batch(self._manifold, self._q, self._worst)
        return float(self._worst[0])

    def retract(self, x: np.ndarray, share: float) -> Float[np.ndarray, "D"] | None:
        """The configuration on the constraint, or None; as `projection.retract`.  share: of the
        tolerance that it may use.
        """
        joints, self._share[0] = np.array(x, np.float64)[None], share
        retract_all(self._manifold, self._share, joints, self._settings, self._worst, self._room)
        return joints[0] if self._worst[0] <= self._settings.accuracy else None


class _HeldAxes(base.Constraint):
    """The constraint as OMPL asks for it.

    Projection and test are those of the compiled retraction, which also knows tolerances;
    `function` and `jacobian` (exactly held axes only) serve the tangent spaces of the atlas.

    OMPL's Python bindings let nobody replace the sampler of a projected space.  But a tree's
    iteration first asks whether to go on, then projects its sample: the first projection after
    `expect_sample` is given another one.  Where there is a tolerance a sample is projected into it,
    as deep as the planner's roadmap spreads its own, and not onto its edge.
    """

    def __init__(
        self, manifold: ConstraintManifold, step: float, sampler: Sampler | None, seed: int
    ) -> None:
        super().__init__(manifold.robot.dof, manifold.codim, SATISFIED)
        self._single = _Single(manifold)
        self._sampler = sampler
        self._samples, self._shares = False, np.random.default_rng(seed)
        self._within = 1.0 / int(manifold.rows.held.sum()) if manifold.rows.tolerance.any() else 0.0
        self._exact = manifold.rows.exact
        self.step = step  # along the constraint, that which OMPL has now
        self._last = np.full(manifold.robot.dof, np.inf)

    def function(self, x: np.ndarray, out: np.ndarray) -> None:
        out[:] = self._single.linearise(x)[0][self._exact]

    def jacobian(self, x: np.ndarray, out: np.ndarray) -> None:
        out[:] = self._single.linearise(x)[1][self._exact]

    def expect_sample(self) -> None:
        """What is projected next is a tree's sample."""
        self._samples = True

    def project(self, x: np.ndarray) -> bool:
        share = 1.0
        if self._samples:
            self._samples = False
            if self._sampler is None:
                share = self._shares.uniform() ** self._within
            else:
                x[:] = self._sampler()
        joints = self._single.retract(x, share)
        if joints is None or self._stalls(x, joints):
            return False
        self._last = joints
        x[:] = joints
        return True

    def isSatisfied(self, x: np.ndarray) -> bool:
        return self._single.violation(x) <= SATISFIED

    def _stalls(self, wanted: np.ndarray, reached: np.ndarray) -> bool:
        # OMPL walks along the manifold as long as the goal comes nearer, by however little:
        # thousands of steps into a dead end.  It steps from the point projected last, which is how
        # such a step is told from a sample.
        if abs(_distance(wanted, self._last) - self.step) > 1e-6 * self.step:
            return False
        return _distance(reached, self._last) < _STALL * self.step


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    """`np.linalg.norm` of a difference, at a third of its cost."""
    return math.dist(a.tolist(), b.tolist())


class _Motions(base.MotionValidator):
    """OMPL's walk along the manifold, and the far end, which that walk leaves unchecked."""

    def __init__(self, information: Any, is_valid: Callable[[Any], bool]) -> None:
        super().__init__(information)
        self._walk = base.ConstrainedMotionValidator(information)
        self._is_valid = is_valid

    def checkMotion(self, first: Any, second: Any) -> bool:
        return self._is_valid(second) and bool(self._walk.checkMotion(first, second))


@dataclass
class _Space:
    """OMPL's state space for one problem, its start and goal, and the way from its states to rows
    of joints.
    """

    problem: PlanningProblem
    settings: OmplSettings
    sampler: Sampler | None = None
    """Where a tree's samples come from; by default from OMPL.  Only the projected space can take
    one.
    """
    seed: int = 0
    information: Any = field(init=False)
    definition: Any = field(init=False)
    expect_sample: Callable[[], None] = field(init=False)

    def __post_init__(self) -> None:
        manifold, kind = self.problem.manifold, self.settings.space
        if self.sampler is not None:
            kind = "projected"
        joints = _joint_space(manifold.robot)
        axes = _HeldAxes(manifold, self.settings.delta_rad, self.sampler, self.seed)
        self._axes, self.expect_sample = axes, axes.expect_sample
        if self.is_plain:
            self.information = base.SpaceInformation(joints)
        else:
            self.information = _constrained(joints, kind, axes, self.settings)
            self.information.getStateSpace().setLambda(_WANDER)
            self.information.setMotionValidator(_Motions(self.information, _validity(self.problem)))
        self.information.setStateValidityChecker(_validity(self.problem))
        self.look_closer(1)
        ends = [self._state(q) for q in (self.problem.start, self.problem.goal)]
        if not self.is_plain and kind != "projected":
            for end in ends:
                self.information.getStateSpace().anchorChart(end)
        self.definition = base.ProblemDefinition(self.information)
        self.definition.setStartAndGoalStates(*ends)

    def look_closer(self, parts: int) -> None:
        """Divide the step between two looks into so many parts."""
        step, space = self.settings.delta_rad / parts, self.information.getStateSpace()
        if self.is_plain:
            self.information.setStateValidityCheckingResolution(step / space.getMaximumExtent())
        else:
            space.setDelta(step)
            self._axes.step = step
        self.information.setup()

    def dense(self, path: Any) -> tuple[Float[np.ndarray, "T D"], bool]:
        """The configurations along a path's edges, its ends exact, and whether all of them are
        sound.
        """
        states = path.getStates()
        rows, sound = [_read(states[0], self._dof)[None]], True
        for first, second in itertools.pairwise(states):
            walk = self._walk(first, second)
            here = self._is_sound(walk)
            if not (here or self.is_plain):
                # a roadmap's edge may have been checked from its other end, and OMPL's walk is not
                # symmetric; the pieces that a shortcut leaves of an edge are not checked at all
                backward = self._walk(second, first)[::-1]
                if self._is_sound(backward):
                    walk, here = backward, True
            sound = sound and here
            rows.append(walk[1:])
        return np.concatenate(rows), sound

    def _walk(self, first: Any, second: Any) -> Float[np.ndarray, "t D"]:
        path = geometric.PathGeometric(self.information, first, second)
        path.interpolate()
        joints = np.array([_read(state, self._dof) for state in path.getStates()])
        joints[1:-1] = retract(
            self.problem.manifold, joints[1:-1]
        ).joints  # the tangent bundle leaves them beside it
        return joints

    def _is_sound(self, joints: Float[np.ndarray, "t D"]) -> bool:
        """Whether the rows follow each other without a jump, within the limits and free of
        collisions.
        """
        longest = np.linalg.norm(np.diff(joints, axis=0), axis=1).max(initial=0.0)
        if longest > _WANDER * self.settings.delta_rad * (1.0 + 1e-6):
            return False
        within = self.problem.manifold.robot.limit_distance(joints).min() >= 0.0
        return bool(within) and self.problem.keeps_clear(joints)

    def _state(self, q: np.ndarray) -> Any:
        state = self.information.getStateSpace().allocState()
        if self.is_plain:
            state[0 : self._dof] = q.tolist()
        else:
            state.copy(q.tolist())
        return state

    @property
    def is_plain(self) -> bool:
        """Whether this is the space of the joints itself, which projects nothing."""
        return self.problem.manifold.constraint.is_free and self.sampler is None

    @property
    def _dof(self) -> int:
        return self.problem.manifold.robot.dof


def _joint_space(robot: SerialRobot) -> Any:
    bounds = base.RealVectorBounds(robot.dof)
    for i in range(robot.dof):
        bounds.setLow(i, float(robot.lower[i]))
        bounds.setHigh(i, float(robot.upper[i]))
    space = base.RealVectorStateSpace(robot.dof)
    space.setBounds(bounds)
    return space


def _constrained(joints: Any, kind: str, constraint: _HeldAxes, settings: OmplSettings) -> Any:
    if kind == "projected":
        return base.ConstrainedSpaceInformation(base.ProjectedStateSpace(joints, constraint))
    if kind == "atlas":
        space = base.AtlasStateSpace(joints, constraint)
        information = base.ConstrainedSpaceInformation(space)
    else:
        space = base.TangentBundleStateSpace(joints, constraint)
        information = base.TangentBundleSpaceInformation(space)
    if settings.own_charts:
        space.setRho(settings.chart_radius_rad)
        space.setEpsilon(settings.chart_error_rad)
        space.setExploration(settings.exploration)
    return information


def _validity(problem: PlanningProblem) -> Callable[[Any], bool]:
    # it must not hold OMPL's own objects: nothing collects such a cycle
    robot, is_free = problem.manifold.robot, problem.is_free
    limits = list(zip(robot.lower.tolist(), robot.upper.tolist(), strict=True))
    axes = range(robot.dof)

    def is_valid(state: Any) -> bool:
        q = [state[i] for i in axes]
        # projection may leave the bounds that were sampled in
        for value, (low, high) in zip(q, limits, strict=True):
            if not low <= value <= high:
                return False
        return bool(is_free(np.array(q)))

    return is_valid


def _read(state: Any, dof: int) -> Float[np.ndarray, "D"]:
    return np.array([state[i] for i in range(dof)])


def _start_random_numbers(seed: int) -> None:
    util.noOutputHandler()
    util.RNG.setSeed(seed + 1)  # OMPL refuses the seed 0


def _simplified(space: _Space, found: Any, seed: int) -> tuple[Float[np.ndarray, "T D"], bool]:
    """The rows of the shortened path, and whether they are sound: looked at more closely where they
    are not, and of the path itself where that does not help.
    """
    try:
        for finer in _FINER:
            space.look_closer(finer)
            _start_random_numbers(seed)
            shorter = geometric.PathGeometric(found)
            _shorten(space, shorter)
            joints, sound = space.dense(shorter)
            if sound:
                return joints, True
    finally:
        space.look_closer(1)
    return space.dense(found)


def _shorten(space: _Space, path: Any) -> None:
    # `simplify` leaves out the shortcuts in constrained spaces, and its limit is a time
    simplifier = geometric.PathSimplifier(space.information)
    simplifier.reduceVertices(path)
    simplifier.partialShortcutPath(path, _SHORTCUTS, _SHORTCUTS)
    simplifier.reduceVertices(path)


def _grow_roadmap(
    kind: type, takes_first: bool, space: _Space, settings: OmplSettings, deadline: float
) -> tuple[Any, int]:
    """Grow a roadmap of at most `iterations` milestones around both ends.

    takes_first: a path is looked for again and again, and the first one taken; else after all
    milestones, so that it is the shortest.
    As OMPL's own loop does, it draws milestones all over the space, and half as many by random
    walks from where few connect.  That loop lets a second thread look meanwhile, for 0.2 s at a
    time, so that a path depends on the machine.  Here `solve` may not run at all: it only enters
    the ends and answers with the path that comes nearest to the goal, found by A*.
    """
    planner = kind(space.information)
    planner.setProblemDefinition(space.definition)
    planner.setup()
    most, most_tries, wanted, tries = settings.iterations, 100 * settings.iterations, 0, 0

    def is_over() -> bool:
        late = time.perf_counter() > deadline
        return late or tries > most_tries or planner.milestoneCount() >= most

    def enough() -> bool:
        nonlocal tries
        tries += 1
        space.expect_sample()
        return planner.milestoneCount() >= wanted or is_over()

    condition = base.PlannerTerminationCondition(enough)
    begun = False
    while True:
        over = begun and is_over()
        if takes_first or over or not begun:
            space.definition.clearSolutionPaths()
            planner.solve(base.plannerAlwaysTerminatingCondition())
            if (takes_first or over) and space.definition.getSolutionDifference() == 0.0:
                return space.definition.getSolutionPath(), planner.milestoneCount()
        if over:
            return None, planner.milestoneCount()
        begun = True
        count = planner.milestoneCount()
        few = max(_EXPANDED, int(_EXPANDED_SHARE * count))
        wanted = min(count + 2 * few, most)
        planner.growRoadmapPtc(condition)
        if wanted + few + _WALK <= most:
            wanted += few
            planner.expandRoadmapPtc(condition)


def _informed_rrt_star(space: _Space) -> Any:
    """On a constraint OMPL's sampler of the ellipsoid leaves it, and nearly all of its samples are
    lost: there the tree rejects what lies outside instead, and is pruned.
    """
    if space.is_plain:
        planner = geometric.InformedRRTstar(space.information)
    else:
        planner = geometric.RRTstar(space.information)
        planner.setSampleRejection(True)
        planner.setNewStateRejection(True)
        planner.setTreePruning(True)
    return planner


def _grow_tree(
    kind: Callable[[_Space], Any], space: _Space, settings: OmplSettings, deadline: float
) -> tuple[Any, int]:
    """Grow one of OMPL's trees; returns its path, if any, and the iterations."""
    iterations, planner = 0, kind(space)
    planner.setRange(settings.range_rad)

    def enough() -> bool:
        nonlocal iterations
        if iterations >= settings.iterations or time.perf_counter() > deadline:
            return True
        iterations += 1
        space.expect_sample()
        return False

    planner.setProblemDefinition(space.definition)
    planner.setup()
    planner.solve(base.PlannerTerminationCondition(enough))
    exact = space.definition.hasExactSolution()
    return (space.definition.getSolutionPath() if exact else None), iterations


_SEARCHES: dict[Search, Callable[[_Space, OmplSettings, float], tuple[Any, int]]] = {
    "prm": partial(_grow_roadmap, geometric.PRM, True),
    "prm_star": partial(_grow_roadmap, geometric.PRMstar, False),
    "rrt_star": partial(_grow_tree, lambda space: geometric.RRTstar(space.information)),
    "informed_rrt_star": partial(_grow_tree, _informed_rrt_star),
    "birrt": partial(_grow_tree, lambda space: geometric.RRTConnect(space.information)),
}
