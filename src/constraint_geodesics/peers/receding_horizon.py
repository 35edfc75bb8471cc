"""Receding-horizon optimisation: the next few waypoints are optimised, the path takes the first of
them, and the horizon moves on, until the goal is within it.

From the configuration q₀ that the path has come to, the waypoints q₁ … q_H ahead are
    min ½ Σᵢ ‖qᵢ₊₁ − qᵢ‖² + s ‖goal − q_H‖
under the demands of trajectory_optimisation.py: constraint, limits, clearance.  Where nothing is in
the way, the minimum is H steps of length s straight to the goal.  A goal within reach of H steps is
the last waypoint, and the energy is all that is left.  SciPy's SLSQP is the optimiser.

As any search that sees no further than its horizon, it is caught where every way on leads away from
the goal.  It then begins at the other end, and after that goes by way of random configurations.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from constraint_geodesics.fields import Count, Positive
from constraint_geodesics.peers.baseline import BaselineSettings, Context
from constraint_geodesics.peers.elastic_band import (
    answer,
    bent_lines,
    settled,
    task_of,
    uniform_configurations,
)
from constraint_geodesics.peers.kept_rows import first_kept
from constraint_geodesics.peers.trajectory_optimisation import Course, Nodes, demands_of
from constraint_geodesics.problem import PathPlanner, PlanningProblem, Solution
from constraint_geodesics.search.band import BandSettings, project, step_lengths
from constraint_geodesics.search.candidates import Task, refined

Energy = Callable[[np.ndarray], tuple[float, np.ndarray]]

KEPT = 1e-3
"""Violation [rad or m] that an optimised waypoint may have: more, and the optimiser failed."""
TORN = 3.0
"""A leg with a step longer than so many wanted ones has jumped."""
PROGRESS = 0.1
"""Of a step: what a whole horizon of moves must come nearer to the goal, else the path is caught.
"""
HERE = 1e-9
"""A distance to the goal [rad] below which it has no direction."""
_ROUNDS = 3


class RecedingHorizonSettings(BaselineSettings):
    """horizon: waypoints ahead.  step_rad: wanted distance of waypoints, s.  taken: of them, before
    the horizon moves on.  moves: of the horizon at most.  vias: random configurations tried at
    most.  iterations: of one optimisation at most.  accuracy: relative change of the objective
    below which it stops.
    """

    family: ClassVar = "optimisation"

    horizon: Count = 12
    step_rad: Positive = 0.25
    taken: Count = 3
    moves: Count = 60
    vias: Count = 16
    iterations: Count = 30
    accuracy: Positive = 1e-6

    def make(self, context: Context) -> PathPlanner:
        """It needs nothing."""
        return RecedingHorizon(self)


@dataclass(frozen=True)
class RecedingHorizon:
    """The path from start to goal, then that from goal to start, then those by way of random
    configurations; the first sound one is the answer.

    band: its clearance is that of the waypoints.
    """

    settings: RecedingHorizonSettings = field(default_factory=RecedingHorizonSettings)
    band: BandSettings = field(default_factory=BandSettings)
    name: str = "receding horizon"

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """The first sound path; iterations counts the moves of the horizon."""
        began = time.perf_counter()
        early = settled(problem, began)
        if early is not None:
            return early
        task, moves = task_of(problem, self.band), 0
        for nodes, moved in self._courses(problem, task, seed):
            moves += moved
            # zero iterations of a band: the curve through the waypoints, looked at for jumps
            candidate = None if nodes is None else refined(task, "straight", nodes, refine=False)
            rows = None if candidate is None else first_kept(problem, [candidate])
            if rows is not None:
                return answer(rows, problem, began, moves)
        return answer(None, problem, began, moves)

    def _courses(
        self, problem: PlanningProblem, task: Task, seed: int
    ) -> Iterator[tuple[Nodes | None, int]]:
        """Waypoints, None where an attempt is caught, and its moves."""
        start, goal = problem.start, problem.goal
        yield self._through(problem, task, start, goal)
        back, moved = self._through(problem, task, goal, start)
        yield None if back is None else back[::-1], moved
        bends = bent_lines(problem, 2, 1 + self.settings.vias, uniform_configurations, seed)
        for _, via, _ in bends[1:]:
            project(task.open, via[None])
            yield self._through(problem, task, start, via, goal)

    def _through(
        self, problem: PlanningProblem, task: Task, *stops: Float[np.ndarray, "D"]
    ) -> tuple[Nodes | None, int]:
        """Waypoints by way of all stops, and the moves that they took."""
        whole, moves = stops[0][None], 0
        for goal in stops[1:]:
            legs = Legs(task, goal, self.settings, problem.keeps_clear)
            nodes, moved = legs.from_(whole[-1])
            moves += moved
            if nodes is None:
                return None, moves
            whole = np.concatenate([whole, nodes[1:]])
        return whole, moves


@dataclass(frozen=True)
class Legs:
    """The horizons on the way to one goal."""

    task: Task
    goal: Float[np.ndarray, "D"]
    settings: RecedingHorizonSettings
    keeps_clear: Callable[[Nodes], bool]

    def from_(self, start: Float[np.ndarray, "D"]) -> tuple[Nodes | None, int]:
        """Waypoints from a start to the goal, both included, None where the way is caught; and how
        often the horizon moved.
        """
        own = self.settings
        path, ahead = start[None], self._guess(start[None])
        away = [self._away(start)]
        for move in range(1, own.moves + 1):
            last = self._last(path[-1])
            if last is not None:
                return np.concatenate([path, last]), move
            nodes = self._optimised(*self._drawn(path[-1], ahead))
            if nodes is None:
                return None, move
            project(self.task.open, nodes)
            path, ahead = (
                np.concatenate([path, nodes[: own.taken]]),
                self._guess(nodes[own.taken - 1 :]),
            )
            away.append(self._away(path[-1]))
            if self._is_caught(away):
                return None, move
        return None, own.moves

    def _is_caught(self, away: list[float]) -> bool:
        """Whether the last horizon's worth of moves came no nearer to the goal than before."""
        before, recent = away[: -self.settings.horizon], away[-self.settings.horizon :]
        return bool(before) and min(recent) > min(before) - PROGRESS * self.settings.step_rad

    def _away(self, q: Float[np.ndarray, "D"]) -> float:
        return float(np.linalg.norm(self.goal - q))

    def _guess(self, known: Nodes) -> Nodes:
        """Known waypoints, the first of which is where the horizon begins, with more on the
        straight line to the goal, up to where that touches something: from beyond, the optimiser
        would push waypoints out on the far side.  Without the first.
        """
        missing = self.settings.horizon + 1 - len(known)
        away = self._away(known[-1])
        reach = min(self.settings.step_rad * missing / max(away, HERE), 1.0)
        shares = np.linspace(0.0, reach, missing + 1)[1:, None]
        more = known[-1] + shares * (self.goal - known[-1])
        project(self.task.open, more)
        ahead = np.concatenate([known, more])
        blocked = np.flatnonzero((self._clearances(ahead[1:]) < 0.0).any(axis=1))
        if len(blocked):
            ahead[blocked[0] + 1 :] = ahead[blocked[0]]
        return ahead[1:]

    def _last(self, q: Float[np.ndarray, "D"]) -> Nodes | None:
        """The waypoints from q to the goal; None where it is out of reach, or the leg fails."""
        own = self.settings
        if self._away(q) > own.horizon * own.step_rad:
            return None
        course = Course.through(np.linspace(q, self.goal, own.horizon + 1))
        nodes = self._optimised(course, course.energy)
        if nodes is None or not self.keeps_clear(np.stack([q, *nodes, self.goal])):
            return None
        return np.concatenate([nodes, self.goal[None]])

    def _drawn(self, q: Float[np.ndarray, "D"], ahead: Nodes) -> tuple[Course, Energy]:
        """The horizon from q whose last waypoint is drawn to the goal, beginning at `ahead`."""
        course = open_course(np.stack([q, self.goal]), ahead)
        return course, lambda y: drawn_energy(course, y, self.settings.step_rad)

    def _optimised(self, course: Course, energy: Energy) -> Nodes | None:
        """The waypoints of a course without its ends; None where the optimiser fails.

        Most meet no limit and touch nothing: both are asked for where they do.
        """
        manifold, robot = self.task.manifold, self.task.manifold.robot
        beyond, near, y = np.zeros((2, robot.dof), bool), False, course.start
        for _ in range(_ROUNDS):
            y = self._minimised(course, energy, y, beyond, near)
            inner = course.nodes(y)[1:-1]
            if not np.isfinite(inner).all():
                return None
            over = np.stack([(inner < robot.lower).any(axis=0), (inner > robot.upper).any(axis=0)])
            touches = bool((self._clearances(inner) < 0.0).any())
            if not ((over & ~beyond).any() or (touches and not near)):
                break
            beyond, near = beyond | over, near or touches
        steps = step_lengths(course.nodes(y)[:-1])
        torn = steps.max() > TORN * self.settings.step_rad
        return None if torn or manifold.violation(inner).max() > KEPT else inner

    def _minimised(
        self, course: Course, energy: Energy, y: np.ndarray, beyond: np.ndarray, near: bool
    ) -> np.ndarray:
        asked: dict[str, Any] = {
            "options": {"maxiter": self.settings.iterations, "ftol": self.settings.accuracy},
            "constraints": [
                {
                    "type": "eq" if demand.equal else "ineq",
                    "fun": course.values(demand),
                    "jac": course.jacobian(demand),
                }
                for demand in demands_of(self.task, beyond, near)
            ],
        }
        found: np.ndarray = minimize(energy, y, jac=True, method="SLSQP", **asked).x
        return found

    def _clearances(self, nodes: Nodes) -> Float[np.ndarray, "n D"]:
        """What is left of the clearance at waypoints [m]."""
        return demands_of(self.task, np.zeros((2, nodes.shape[1]), bool), True)[-1].linearise(
            nodes
        )[0]


def open_course(ends: Float[np.ndarray, "2 D"], ahead: Nodes) -> Course:
    """A course whose last waypoint before the goal is free: nothing joins the two.

    As in `Course`, K = L Lᵀ is the matrix of ½ Σ ‖qᵢ₊₁ − qᵢ‖², here without the step to the goal.
    """
    count = len(ahead)
    second = 2.0 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
    second[-1, -1] = 1.0
    factor = np.linalg.cholesky(second)
    return Course(ends, (factor.T @ ahead).ravel(), np.linalg.inv(factor.T))


def drawn_energy(course: Course, y: np.ndarray, pull: float) -> tuple[float, np.ndarray]:
    """½ Σ ‖qᵢ₊₁ − qᵢ‖² + pull ‖goal − q_H‖ [rad²] of an open course, and its gradient."""
    steps = np.diff(course.nodes(y), axis=0)
    distance = max(float(np.linalg.norm(steps[-1])), HERE)
    slopes = np.concatenate([steps[:-1], pull / distance * steps[-1:]])
    value = 0.5 * float(np.square(steps[:-1]).sum()) + pull * distance
    return value, (course.transform.T @ (slopes[:-1] - slopes[1:])).ravel()


BASELINE = RecedingHorizonSettings
