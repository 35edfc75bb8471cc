"""Direct trajectory optimisation on the constraint by SciPy: waypoints are the variables,
sequential programming moves them.

min ½ Σᵢ ‖qᵢ₊₁ − qᵢ‖²  over the waypoints q₁ … q_{n−1} between fixed ends, subject at every waypoint
to
    r(qᵢ) = 0          held axes without a tolerance (the residual of eq. 7),
    ‖r_g(qᵢ)‖² ≤ tol²   groups g of axes with one,
    l ≤ qᵢ ≤ u          joint limits, and  d(qᵢ) ≥ clearance  of the links that a joint carries.
The sum of squared steps has the shortest path as its minimum, with even steps.  "SLSQP" is Kraft's
method [1988], "trust-constr" the one of Byrd, Hribar and Nocedal [1999] and Lalee, Nocedal and
Plantenga [1998].
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, Literal, Self

import numpy as np
from jaxtyping import Float
from numba import njit
from scipy.optimize import BFGS, NonlinearConstraint, OptimizeResult, minimize

from constraint_geodesics.compiled import COMPILE
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.fields import Count, Positive
from constraint_geodesics.peers.baseline import BaselineSettings, Context
from constraint_geodesics.peers.elastic_band import (
    Configurations,
    answer,
    bent_lines,
    free_rows,
    settled,
    task_of,
    uniform_configurations,
)
from constraint_geodesics.problem import PathPlanner, PlanningProblem, Solution
from constraint_geodesics.scene.clearance import (
    DISTANCE,
    contact_row,
    frames_of,
    near_contacts,
    new_contacts,
)
from constraint_geodesics.search.band import BandSettings
from constraint_geodesics.search.candidates import Task, refined

Method = Literal["SLSQP", "trust-constr"]
Nodes = Float[np.ndarray, "n D"]

LIMIT_MARGIN = 1e-6
"""Kept from a joint limit by a waypoint [rad], because constraints are met to rounding only."""
LOST = 0.1
"""Waypoints that lie so far beyond a limit [rad] at the end are those of an optimisation that
diverged.
"""
FAR = 0.2
"""Distances of bodies [m] beyond which they are not told apart."""
_ROUNDS = 3
_TRUST_REGION_ENDS = {"gtol": 1e-5, "xtol": 1e-6}


@dataclass(frozen=True)
class Demand:
    """What is asked of every waypoint: k numbers that must be zero, or must not be negative.

    linear: whether they are in the joints.  linearise: of waypoints (n, D) the numbers (n, k) and
    their derivatives (n, k, D).
    """

    equal: bool
    linear: bool
    linearise: Callable[[Nodes], tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k D"]]]


@dataclass(frozen=True)
class Course:
    """The waypoints q between two ends as the variables y of an optimisation: q = T y.

    With the second differences' matrix K = L Lᵀ and T = L⁻ᵀ the energy ½ Σ ‖qᵢ₊₁ − qᵢ‖² is ½ ‖y‖²
    but for terms that are linear: a method that starts from a unit matrix as the Hessian, as SLSQP
    does, then starts from the true one and needs a quarter of the iterations.
    """

    ends: Float[np.ndarray, "2 D"]
    start: Float[np.ndarray, "y"]
    """Where the optimisation begins."""
    transform: Float[np.ndarray, "n n"]

    @classmethod
    def through(cls, line: Nodes) -> Self:
        """With the line's ends, beginning at its waypoints."""
        count = len(line) - 2
        second = 2.0 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
        factor = np.linalg.cholesky(second)
        return cls(line[[0, -1]], (factor.T @ line[1:-1]).ravel(), np.linalg.inv(factor.T))

    def nodes(self, y: Float[np.ndarray, "y"]) -> Nodes:
        """The waypoints with their ends [rad]."""
        return np.concatenate([self.ends[:1], self._inner(y), self.ends[1:]])

    def energy(self, y: Float[np.ndarray, "y"]) -> tuple[float, Float[np.ndarray, "y"]]:
        """½ Σ ‖qᵢ₊₁ − qᵢ‖² [rad²] and its gradient."""
        steps = np.diff(self.nodes(y), axis=0)
        return 0.5 * float(np.square(steps).sum()), (
            self.transform.T @ (steps[:-1] - steps[1:])
        ).ravel()

    def values(self, demand: Demand) -> Callable[[np.ndarray], np.ndarray]:
        """The demanded numbers of all waypoints (n k,), as a function of y."""
        return lambda y: demand.linearise(self._inner(y))[0].ravel()

    def jacobian(self, demand: Demand) -> Callable[[np.ndarray], np.ndarray]:
        """Their derivatives (n k, n D) to y."""

        def derivatives(y: np.ndarray) -> np.ndarray:
            rows = demand.linearise(self._inner(y))[1]
            return np.einsum("ikd,ij->ikjd", rows, self.transform).reshape(
                rows.shape[0] * rows.shape[1], -1
            )

        return derivatives

    def nonlinear(self, demand: Demand) -> NonlinearConstraint:
        """As "trust-constr" takes it; second derivatives are approximated where there are any."""
        most = 0.0 if demand.equal else np.inf
        curvature: Any = (lambda y, _: np.zeros((y.size, y.size))) if demand.linear else BFGS()
        return NonlinearConstraint(self.values(demand), 0.0, most, self.jacobian(demand), curvature)

    def _inner(self, y: np.ndarray) -> Nodes:
        return self.transform @ y.reshape(len(self.transform), -1)


class TrajectoryOptimisationSettings(BaselineSettings):
    """method: of SciPy.  starts: lines at most, the first of which is straight.  wanted: sound
    paths after which no further line is tried; the shortest is the answer.  iterations: of one
    optimisation at most.  accuracy: relative change of the objective below which it stops.
    """

    family: ClassVar = "optimisation"

    method: Method = "SLSQP"
    starts: Count = 16
    wanted: Count = 1
    iterations: Count = 50
    accuracy: Positive = 1e-7

    def make(self, context: Context) -> PathPlanner:
        """It needs nothing."""
        return TrajectoryOptimisation(self)


@dataclass(frozen=True)
class TrajectoryOptimisation:
    """Waypoints optimised from the straight joint line, then from lines bent past random
    configurations.

    band: its segments and clearance are those of the waypoints.
    """

    settings: TrajectoryOptimisationSettings = field(default_factory=TrajectoryOptimisationSettings)
    configurations: Configurations = field(default_factory=lambda: uniform_configurations)
    band: BandSettings = field(default_factory=BandSettings)

    @property
    def name(self) -> str:
        """With the method's name."""
        return f"trajectory optimisation ({self.settings.method})"

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """The shortest sound path of the first that are found; iterations counts the
        optimiser's.
        """
        began = time.perf_counter()
        early = settled(problem, began)
        if early is not None:
            return early
        task = task_of(problem, self.band)
        found: list[tuple[float, np.ndarray]] = []
        iterations = 0
        for line in self._lines(problem, seed):
            nodes, spent = self._optimised(task, line)
            iterations += spent
            # zero iterations of a band: the curve through the waypoints, looked at for jumps, and
            # its rows
            candidate = None if nodes is None else refined(task, "straight", nodes, refine=False)
            rows = None if candidate is None else free_rows(problem, candidate)
            if candidate is not None and rows is not None:
                found.append((candidate.length, rows))
            if len(found) >= self.settings.wanted:
                break
        shortest = min(found, key=lambda each: each[0])[1] if found else None
        return answer(shortest, problem, began, iterations)

    def _lines(self, problem: PlanningProblem, seed: int) -> Iterator[Nodes]:
        """The straight start, the bent ones, and at last the straight one with twice the
        waypoints.
        """
        segments = self.band.segments
        yield bent_lines(problem, segments, 1, self.configurations, seed)[0]
        if self.settings.starts > 1:  # most problems need no configurations to bend past
            yield from bent_lines(
                problem, segments, self.settings.starts, self.configurations, seed
            )[1:]
        yield bent_lines(problem, 2 * segments, 1, self.configurations, seed)[0]

    def _optimised(self, task: Task, line: Nodes) -> tuple[Nodes | None, int]:
        """Waypoints from a line, and iterations.  Most meet no limit and touch nothing: both
        are asked for where they do.
        """
        beyond, near = np.zeros((2, task.manifold.robot.dof), bool), False
        spent = 0
        for _ in range(_ROUNDS):
            result, nodes = self._minimised(
                _started(task.manifold, line), demands_of(task, beyond, near)
            )
            spent += int(result.nit)
            if not np.isfinite(nodes).all():
                return None, spent
            newly = _beyond(task.manifold, nodes) & ~beyond
            newly_near = not near and bool((_clearances(task, nodes[1:-1])[0] < 0.0).any())
            if not (newly.any() or newly_near):
                break
            beyond, near = beyond | newly, near or newly_near
        far = task.manifold.robot.limit_distance(nodes[1:-1]).min() < -LOST
        return (None if far else nodes), spent

    def _minimised(self, line: Nodes, demands: Sequence[Demand]) -> tuple[OptimizeResult, Nodes]:
        """One run of SciPy's optimiser, in coordinates in which the objective is ½ ‖y‖² but for a
        linear term.
        """
        course = Course.through(line)
        asked: dict[str, Any]
        if self.settings.method == "SLSQP":
            asked = {
                "options": {"maxiter": self.settings.iterations, "ftol": self.settings.accuracy},
                "constraints": [
                    {
                        "type": "eq" if d.equal else "ineq",
                        "fun": course.values(d),
                        "jac": course.jacobian(d),
                    }
                    for d in demands
                ],
            }
        else:
            asked = {
                "hess": lambda y: np.eye(y.size),
                "options": {"maxiter": self.settings.iterations, **_TRUST_REGION_ENDS},
                "constraints": [course.nonlinear(d) for d in demands],
            }
        result = minimize(
            course.energy, course.start, jac=True, method=self.settings.method, **asked
        )
        return result, course.nodes(result.x)


def _started(manifold: ConstraintManifold, line: Nodes) -> Nodes:
    """The line with its waypoints on the constraint where they reach it, and within the limits."""
    projected = retract(manifold, line[1:-1])
    inner = np.where(projected.converged[:, None], projected.joints, line[1:-1])
    return np.concatenate(
        [line[:1], np.clip(inner, manifold.robot.lower, manifold.robot.upper), line[-1:]]
    )


def demands_of(task: Task, beyond: np.ndarray, near: bool) -> list[Demand]:
    """The constraint, the lower and upper limits that `beyond` (2, D) names, and clearance where
    bodies are near.
    """
    found = _axes(task.manifold)
    found += [_limits(task.manifold, beyond)] * bool(beyond.any())
    found += [Demand(False, False, partial(_clearances, task))] * near
    return found


def _axes(manifold: ConstraintManifold) -> list[Demand]:
    """The constraint: one demand for the rows held exactly, one for those with a tolerance."""
    exact, groups = manifold.rows.exact, manifold.rows.loose_groups
    tolerances = np.array([manifold.rows.tolerance[group[0]] for group in groups])

    def equal(q: Nodes) -> tuple[np.ndarray, np.ndarray]:
        residual, jacobian = manifold.linearise(q)
        return residual[:, exact], jacobian[:, exact]

    def within(q: Nodes) -> tuple[np.ndarray, np.ndarray]:
        residual, jacobian = manifold.linearise(q)
        squares = np.stack([np.square(residual[:, group]).sum(axis=1) for group in groups], axis=1)
        slopes = np.stack(
            [
                2.0 * np.einsum("ik,ikd->id", residual[:, group], jacobian[:, group])
                for group in groups
            ],
            axis=1,
        )
        # over the tolerance, so that metres and radians are weighed alike
        return (tolerances**2 - squares) / tolerances, -slopes / tolerances[:, None]

    return [Demand(True, False, equal)] * bool(len(exact)) + [Demand(False, False, within)] * bool(
        groups
    )


def _beyond(manifold: ConstraintManifold, nodes: Nodes) -> np.ndarray:
    """Which lower and upper limits (2, D) some waypoint exceeds."""
    inner = nodes[1:-1]
    return np.stack(
        [(inner < manifold.robot.lower).any(axis=0), (inner > manifold.robot.upper).any(axis=0)]
    )


def _limits(manifold: ConstraintManifold, beyond: np.ndarray) -> Demand:
    """That waypoints keep some of the lower and upper limits (2, D)."""
    robot = manifold.robot
    rows = np.concatenate([np.eye(robot.dof)[beyond[0]], -np.eye(robot.dof)[beyond[1]]])
    bounds = np.concatenate([robot.lower[beyond[0]], -robot.upper[beyond[1]]]) + LIMIT_MARGIN

    def linearise(q: Nodes) -> tuple[np.ndarray, np.ndarray]:
        return q @ rows.T - bounds, np.broadcast_to(rows, (len(q), *rows.shape))

    return Demand(False, True, linearise)


def _clearances(task: Task, nodes: Nodes) -> tuple[np.ndarray, np.ndarray]:
    """How far the links that each joint carries are clear of what they must not touch beyond what
    is asked (n, D) [m], and the derivatives (n, D, D).
    """
    values, gradients = np.empty(nodes.shape), np.empty((*nodes.shape, nodes.shape[1]))
    _link_clearances(
        task.manifold.robot.chain,
        task.clearance.arrays,
        np.ascontiguousarray(nodes),
        values,
        gradients,
    )
    return values - task.settings.clearance_m, gradients


@njit(**COMPILE)
def _link_clearances(chain, model, q, values, gradients):  # type: ignore[no-untyped-def]
    """The smallest distance of the links that each joint carries, of q (B, D) into values (B, D),
    at most FAR, and their gradients (B, D, D).
    """
    contacts = new_contacts(model, q.shape[1])
    for b in range(q.shape[0]):
        values[b], gradients[b] = FAR, 0.0
        for c in range(near_contacts(chain, model, q[b], FAR, contacts)):
            link = frames_of(contacts, c)[1] - 1
            if contacts.found[c, DISTANCE] < values[b, link]:
                values[b, link] = contacts.found[c, DISTANCE]
                contact_row(chain.prismatic, contacts, c, gradients[b, link])


BASELINE = TrajectoryOptimisationSettings
