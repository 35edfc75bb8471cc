"""PRM, RRT* and BiRRT (RRTConnect) from OMPL on the constraint manifold: the peers of the learned planner.

The only importer of ompl.  Held axes are planned in OMPL's constrained state spaces (projected, atlas, tangent
bundle), no constraint in the plain space of the joints.  A search ends by counting, never by a clock, and OMPL's
random numbers restart with every problem: a seed gives the same path in any process, whatever was planned before
and however busy the machine is.  `budget_s` is a safety limit; where it strikes, the result depends on the machine.
"""

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from ompl import base, geometric, util

from constraint_geodesics.constraints.retraction import retract
from constraint_geodesics.constraints.vector import Constraint, ConstraintManifold
from constraint_geodesics.params import BenchmarkParams
from constraint_geodesics.planners.path_planner import SATISFIED, PlannedPath, PlanningProblem, refusal
from constraint_geodesics.robot.bullet import Body, Box, World
from constraint_geodesics.robot.kinematics import SerialRobot

PlannerName = Literal["prm", "rrt_star", "birrt"]

_STALL = 0.2
"""A step along the constraint that advances by less than this share of itself leads nowhere."""
_WANDER = 2.0
"""OMPL's λ: a step along the constraint is at most this many times as long as the straight one."""
_MILESTONES_BETWEEN_LOOKS = 5
_SHORTCUTS = 50


@dataclass(frozen=True)
class SamplingPlanner:
    """One of OMPL's planners with its settings."""

    name: PlannerName
    settings: BenchmarkParams
    simplify: bool = True

    def plan(self, problem: PlanningProblem, seed: int) -> PlannedPath:
        """Look for a path until one is found (PRM, BiRRT) or the iterations are used up (RRT* always uses them).

        Rows of the path lie at most 2 `delta_rad` apart, unless the planner's own edge jumps: the jump is kept.
        time_s holds everything from here on: the projections, the simplification, the rows in between.
        """
        began = time.perf_counter()
        nothing = np.empty((0, problem.manifold.robot.dof))
        refused = refusal(problem)
        if refused is not None:
            return PlannedPath(refused, nothing, time.perf_counter() - began, 0)
        if problem.manifold.codim >= problem.manifold.robot.dof:  # isolated points, which OMPL has no space for
            return PlannedPath("not_found", nothing, time.perf_counter() - began, 0)
        util.noOutputHandler()
        util.RNG.setSeed(seed + 1)  # OMPL refuses the seed 0
        space = _Space(problem, self.settings)
        found, iterations = _SEARCHES[self.name](space, self.settings, began + self.settings.budget_s)
        joints = nothing if found is None else self._as_executed(space, found)
        status: Literal["solved", "not_found"] = "not_found" if found is None else "solved"
        return PlannedPath(status, joints, time.perf_counter() - began, iterations)

    def _as_executed(self, space: "_Space", found: Any) -> Float[np.ndarray, "T D"]:
        if self.simplify:
            shorter = geometric.PathGeometric(found)
            _shorten(space, shorter)
            joints, sound = space.dense(shorter)
            if sound:
                return joints
        return space.dense(found)[0]


def plan_all(
    planner_name: PlannerName,
    settings: BenchmarkParams,
    robot: SerialRobot,
    constraint: Constraint,
    workcell: Sequence[Box | Body],
    starts: Float[np.ndarray, "n D"],
    goals: Float[np.ndarray, "n D"],
    seed: int,
) -> list[PlannedPath]:
    """Plan n problems of one constraint with one planner and seed, one after another; a task for any process.

    Loading the world and the compiled kernels is not part of the paths' times.
    """
    manifold = ConstraintManifold(robot, constraint)
    planner = SamplingPlanner(planner_name, settings)
    with World(robot, workcell) as world:
        problems = [PlanningProblem(a, b, manifold, world.is_free) for a, b in zip(starts, goals, strict=True)]
        for problem in problems[:1]:
            refusal(problem)
            retract(manifold, problem.start)
        return [planner.plan(problem, seed) for problem in problems]


class _HeldAxes(base.Constraint):
    """The constraint as OMPL asks for it.

    Projection and test are those of the compiled retraction, which also knows tolerances; `function` and `jacobian`
    (exactly held axes only) serve the tangent spaces of the atlas.
    """

    def __init__(self, manifold: ConstraintManifold, step: float) -> None:
        super().__init__(manifold.robot.dof, manifold.codim, SATISFIED)
        self._manifold = manifold
        self._exact = np.flatnonzero(manifold.held & (manifold.tolerance == 0.0))
        self._step = step
        self._last = np.full(manifold.robot.dof, np.inf)

    def function(self, x: np.ndarray, out: np.ndarray) -> None:
        out[:] = self._manifold.residual(x)[self._exact]

    def jacobian(self, x: np.ndarray, out: np.ndarray) -> None:
        out[:] = self._manifold.jacobian(x)[self._exact]

    def project(self, x: np.ndarray) -> bool:
        retracted = retract(self._manifold, x)
        if not retracted.converged or self._stalls(x, retracted.joints):
            return False
        self._last = retracted.joints
        x[:] = retracted.joints
        return True

    def isSatisfied(self, x: np.ndarray) -> bool:
        return bool(self._manifold.violation(x) <= SATISFIED)

    def _stalls(self, wanted: np.ndarray, reached: np.ndarray) -> bool:
        # OMPL walks along the manifold as long as the goal comes nearer, by however little: thousands of steps
        # into a dead end.  It steps from the point projected last, which is how such a step is told from a sample.
        if abs(np.linalg.norm(wanted - self._last) - self._step) > 1e-6 * self._step:
            return False
        return bool(np.linalg.norm(reached - self._last) < _STALL * self._step)


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
    """OMPL's state space for one problem, its start and goal, and the way from its states to rows of joints."""

    problem: PlanningProblem
    settings: BenchmarkParams
    information: Any = field(init=False)
    definition: Any = field(init=False)

    def __post_init__(self) -> None:
        manifold, kind = self.problem.manifold, self.settings.space
        if manifold.tolerance.any():  # a band has no tangent spaces
            kind = "projected"
        joints = _joint_space(manifold.robot)
        if manifold.constraint.is_free:
            self.information = base.SpaceInformation(joints)
            self.information.setStateValidityCheckingResolution(self.settings.delta_rad / joints.getMaximumExtent())
        else:
            self.information = _constrained(joints, kind, _HeldAxes(manifold, self.settings.delta_rad))
            self.information.getStateSpace().setDelta(self.settings.delta_rad)
            self.information.getStateSpace().setLambda(_WANDER)
            self.information.setMotionValidator(_Motions(self.information, _validity(self.problem)))
        self.information.setStateValidityChecker(_validity(self.problem))
        self.information.setup()
        ends = [self._state(q) for q in (self.problem.start, self.problem.goal)]
        if not manifold.constraint.is_free and kind != "projected":
            for end in ends:
                self.information.getStateSpace().anchorChart(end)
        self.definition = base.ProblemDefinition(self.information)
        self.definition.setStartAndGoalStates(*ends)

    def dense(self, path: Any) -> tuple[Float[np.ndarray, "T D"], bool]:
        """The configurations along a path's edges, its ends exact, and whether all of them are sound."""
        states = path.getStates()
        rows, sound = [_read(states[0], self._dof)[None]], True
        for first, second in itertools.pairwise(states):
            walk = self._walk(first, second)
            if not self._is_sound(walk):
                # a roadmap's edge may have been checked from its other end, and OMPL's walk is not symmetric;
                # the pieces that a shortcut leaves of an edge are not checked at all
                backward = self._walk(second, first)[::-1]
                if self._is_sound(backward):
                    walk = backward
                else:
                    sound = False
            rows.append(walk[1:])
        return np.concatenate(rows), sound

    def _walk(self, first: Any, second: Any) -> Float[np.ndarray, "t D"]:
        path = geometric.PathGeometric(self.information, first, second)
        path.interpolate()
        joints = np.array([_read(state, self._dof) for state in path.getStates()])
        joints[1:-1] = retract(self.problem.manifold, joints[1:-1]).joints  # the tangent bundle leaves them beside it
        return joints

    def _is_sound(self, joints: Float[np.ndarray, "t D"]) -> bool:
        """Whether the rows follow each other without a jump, within the limits and free of collisions."""
        longest = np.linalg.norm(np.diff(joints, axis=0), axis=1).max(initial=0.0)
        if longest > _WANDER * self.settings.delta_rad * (1.0 + 1e-6):
            return False
        within = self.problem.manifold.robot.limit_distance(joints).min() >= 0.0
        return bool(within) and all(self.problem.is_free(q) for q in joints[1:-1])

    def _state(self, q: np.ndarray) -> Any:
        state = self.information.getStateSpace().allocState()
        if self.problem.manifold.constraint.is_free:
            state[0 : self._dof] = q.tolist()
        else:
            state.copy(q.tolist())
        return state

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


def _constrained(joints: Any, kind: str, constraint: _HeldAxes) -> Any:
    if kind == "projected":
        return base.ConstrainedSpaceInformation(base.ProjectedStateSpace(joints, constraint))
    if kind == "atlas":
        return base.ConstrainedSpaceInformation(base.AtlasStateSpace(joints, constraint))
    return base.TangentBundleSpaceInformation(base.TangentBundleStateSpace(joints, constraint))


def _validity(problem: PlanningProblem) -> Callable[[Any], bool]:
    # it must not hold OMPL's own objects: nothing collects such a cycle
    robot, is_free = problem.manifold.robot, problem.is_free

    def is_valid(state: Any) -> bool:
        q = _read(state, robot.dof)
        # projection may leave the bounds that were sampled in
        return bool((q >= robot.lower).all() and (q <= robot.upper).all() and is_free(q))

    return is_valid


def _read(state: Any, dof: int) -> Float[np.ndarray, "D"]:
    return np.array([state[i] for i in range(dof)])


def _shorten(space: _Space, path: Any) -> None:
    # `simplify` leaves out the shortcuts in constrained spaces, and its limit is a time
    simplifier = geometric.PathSimplifier(space.information)
    simplifier.reduceVertices(path)
    simplifier.partialShortcutPath(path, _SHORTCUTS, _SHORTCUTS)
    simplifier.reduceVertices(path)


def _prm(space: _Space, settings: BenchmarkParams, deadline: float) -> tuple[Any, int]:
    """Grow a roadmap of at most `prm_iterations` samples around both ends, looking for a path every few samples.

    OMPL's own loop lets a second thread look while the first one samples for 0.2 s at a time, so that a path depends
    on the machine.  Here `solve` may not run at all: it only enters the ends and answers with the path that
    comes nearest to the goal, found by A*.
    """
    planner = geometric.PRM(space.information)
    planner.setProblemDefinition(space.definition)
    planner.setup()
    tries = 0

    def enough() -> bool:
        nonlocal tries
        tries += 1
        return planner.milestoneCount() >= wanted or tries > most_tries or time.perf_counter() > deadline

    most_tries = 100 * settings.prm_iterations
    while True:
        planner.solve(base.plannerAlwaysTerminatingCondition())
        wanted = planner.milestoneCount() + _MILESTONES_BETWEEN_LOOKS
        if space.definition.getSolutionDifference() == 0.0:
            return space.definition.getSolutionPath(), planner.milestoneCount()
        space.definition.clearSolutionPaths()
        if wanted > settings.prm_iterations or tries > most_tries or time.perf_counter() > deadline:
            return None, planner.milestoneCount()
        planner.growRoadmapPtc(base.PlannerTerminationCondition(enough))


def _rrt_star(space: _Space, settings: BenchmarkParams, deadline: float) -> tuple[Any, int]:
    planner = geometric.RRTstar(space.information)
    planner.setRange(settings.range_rad)
    return _grow_tree(planner, space, settings.rrt_star_iterations, deadline)


def _birrt(space: _Space, settings: BenchmarkParams, deadline: float) -> tuple[Any, int]:
    planner = geometric.RRTConnect(space.information)
    planner.setRange(settings.range_rad)
    return _grow_tree(planner, space, settings.birrt_iterations, deadline)


def _grow_tree(planner: Any, space: _Space, most: int, deadline: float) -> tuple[Any, int]:
    iterations = 0

    def enough() -> bool:
        nonlocal iterations
        if iterations >= most or time.perf_counter() > deadline:
            return True
        iterations += 1
        return False

    planner.setProblemDefinition(space.definition)
    planner.setup()
    planner.solve(base.PlannerTerminationCondition(enough))
    exact = space.definition.hasExactSolution()
    return (space.definition.getSolutionPath() if exact else None), iterations


_SEARCHES: dict[PlannerName, Callable[[_Space, BenchmarkParams, float], tuple[Any, int]]] = {
    "prm": _prm,
    "rrt_star": _rrt_star,
    "birrt": _birrt,
}
