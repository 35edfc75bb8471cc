"""Geodesics as minima of the energy: damped Newton from several starts, all in one batch."""

import time
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from constraint_geodesics.geodesics.problem import ChartProblem, Ends, Geodesic
from constraint_geodesics.geodesics.solver import Candidates, Work, goal_images, shortest_of
from constraint_geodesics.geometry.curves import Curves, PinnedPolynomial
from constraint_geodesics.geometry.length import (
    Collocation,
    Objective,
    energy_function,
    length_function,
    resolved,
    rules,
)
from constraint_geodesics.geometry.manifold import GeometryError, Manifold, WalledManifold

BLOCK = 64
"""Curves whose second derivatives are taken at once."""
HAIR = 1e-3
"""Bend of the straight start over that of the others."""
PROMISING = 1.2
"""Energy over the least one of the same query up to which a minimum is followed further."""
FENCE = (0.2, 0.2)
"""Where the fence before a wall begins [steps], and its height."""
DAMPING = (1e-4, 1e8)
"""First damping, relative to the largest curvature of the energy, and the one at which a curve is
given up.
"""


@dataclass(frozen=True)
class GradientSolver:
    """Minima of the energy E = ∫ γ̇ᵀ M(γ) γ̇ dt over a curve family, and from there of the length.

    Over all curves the two are one, since a minimum of the energy runs at constant speed (E = L²).
    Over a family they are not: part of a cubic's freedom goes into its speed, so its shortest
    member is found by the second descent.

    starts: curves tried for each image of the goal, the straight line (but for a hair) first, the
    others bent at random by `spread` times the distance of the ends.  iterations: Newton steps at
    most, of each descent.  tolerance: a curve has converged when the next step promises to lower
    the value by less than this share.
    Raises GeometryError unless starts and iterations are at least 1. Newton's direction is taken
    with the absolute values of the curvatures, so that saddle points (a path straight over a hill)
    repel; where the value does not fall the step is damped.
    """

    starts: int = 4
    iterations: int = 60
    tolerance: float = 1e-7
    spread: float = 0.5
    seed: int = 0

    def __post_init__(self) -> None:
        for name, value in (("starts", self.starts), ("iterations", self.iterations)):
            if value < 1:
                raise GeometryError(f"{name} = {value}: must be at least 1")

    def solve(self, problem: ChartProblem, ends: Ends) -> list[Geodesic]:
        """The shortest minimum found between each start and goal."""
        began = time.perf_counter()
        simpler = self.simpler(problem, ends)
        starts = Candidates.join([*simpler, self.candidates(problem, ends)])
        given = simpler[0] if simpler else None
        return self.refine(problem, ends, starts, given=given, began=began)

    def simpler(self, problem: ChartProblem, ends: Ends) -> list[Candidates]:
        """The cubics found, as curves of a family that has more freedom; none for one that has not.

        In many dimensions random starts are worse ones: a spline would end above the cubic.
        """
        cubic = PinnedPolynomial(problem.curve.dim, 3)
        if problem.curve.functions <= cubic.functions:
            return []
        found = self.solve(replace(problem, curve=cubic), ends)
        t = np.linspace(0.0, 1.0, 4 * problem.curve.functions + 3)
        points = torch.from_numpy(np.stack([geodesic.points(t) for geodesic in found]))
        phi = problem.curve.fit(points, torch.from_numpy(t)).numpy()
        start, goal = (np.stack([getattr(one, end) for one in found]) for end in ("start", "goal"))
        return [Candidates(np.arange(len(found)), phi, start, goal)]

    def candidates(self, problem: ChartProblem, ends: Ends) -> Candidates:
        """The starts: straight and bent curves to every image of the goals."""
        query, goal = goal_images(problem, ends)
        query, goal = np.repeat(query, self.starts), np.repeat(goal, self.starts, axis=0)
        start = ends.z_start[query]
        distance = np.linalg.norm(goal - start, axis=1)
        rng = np.random.default_rng(self.seed)
        size = len(query), problem.curve.coefficients
        phi = rng.normal(scale=self.spread, size=size) * distance[:, None]
        # straight but for a hair: at a saddle the slope of the straight line is exactly zero, and
        # nothing would move
        phi[:: self.starts] *= HAIR
        return Candidates(query, phi, start, goal)

    def refine(
        self,
        problem: ChartProblem,
        ends: Ends,
        candidates: Candidates,
        given: Candidates | None = None,
        began: float | None = None,
    ) -> list[Geodesic]:
        """The shortest curve for each query after Newton steps from the candidates.

        given: curves that compete as they are, too: a descent knows nothing of the manifold's
        border.
        began: clock reading [s] from which the time counts; now by default.
        """
        began = time.perf_counter() if began is None else began
        manifold, rule = _descended(problem, candidates)
        energy = energy_function(manifold, problem.curve, rule)
        length = length_function(manifold, problem.curve, rule)
        first = minimise(energy, candidates, self.iterations, self.tolerance)
        inside = problem.stays_inside(first.phi, candidates.ends())
        rows = _promising(candidates.query, np.where(inside, first.value, np.inf))
        kept = Candidates(
            candidates.query[rows], first.phi[rows], candidates.start[rows], candidates.goal[rows]
        )
        second = minimise(length, kept, self.iterations, self.tolerance)
        found, converged = replace(kept, phi=second.phi), second.converged
        if given is not None:
            found = Candidates.join([found, given])
            converged = np.concatenate([converged, np.zeros(len(given.query), dtype=bool)])
        spent = time.perf_counter() - began
        evaluations = first.evaluations + second.evaluations
        work = Work(first.steps + second.steps, evaluations, spent)
        return shortest_of(problem, ends, found, converged, work)


def _descended(problem: ChartProblem, candidates: Candidates) -> tuple[Manifold, Collocation]:
    """What curves descend on and by which rule: among walls before a fence, with points as close
    as its steps.
    """
    manifold, family = problem.manifold, problem.curve
    if not isinstance(manifold, WalledManifold):
        return manifold, rules(tuple(family.breaks))[1]
    arrays = (candidates.phi, candidates.start, candidates.goal)
    curves = Curves(family, *(torch.from_numpy(np.array(values)) for values in arrays))
    return manifold.fenced(*FENCE), rules(resolved(manifold, curves))[0]


def _promising(query: Int[np.ndarray, "C"], energy: Float[np.ndarray, "C"]) -> Int[np.ndarray, "K"]:
    """Rows whose energy is near the least of their query: the second descent gains a few per cent,
    not more.

    Where no curve of a query can be used (all inf), all of them stay: the second descent may find
    back.
    """
    least = np.full(query.max() + 1, np.inf)
    np.fmin.at(least, query, energy)
    return np.flatnonzero((energy <= PROMISING * least[query]) | np.isinf(least[query]))


@dataclass(frozen=True)
class Descent:
    """Where a descent ended, the function there, which are minima, and the work it took."""

    phi: Float[np.ndarray, "C p"]
    value: Float[np.ndarray, "C"]
    converged: Bool[np.ndarray, "C"]
    steps: int
    evaluations: int


def minimise(
    function: Objective, candidates: Candidates, iterations: int, tolerance: float
) -> Descent:
    """At most `iterations` damped Newton steps down a function, all curves in one batch."""
    phi, start, goal = (
        torch.from_numpy(np.array(x)) for x in (candidates.phi, candidates.start, candidates.goal)
    )
    damping = torch.full((len(phi),), DAMPING[0], dtype=phi.dtype)
    converged, active = torch.zeros(len(phi), dtype=torch.bool), torch.arange(len(phi))
    reached = torch.full_like(damping, torch.inf)
    evaluations = steps = 0
    while len(active) and steps < iterations:
        steps += 1
        known, value, gradient, curvature, axes = _expansion(
            function, phi[active], start[active], goal[active]
        )
        active = active[known]
        # stiffness no smaller than the damping, in units of the largest curvature of that curve
        largest = curvature.abs().amax(-1, keepdim=True).clamp(min=1e-30)
        stiffness = curvature.abs() + damping[active, None] * largest
        along = (gradient[:, None] @ axes)[:, 0]
        promised = 0.5 * (along.square() / stiffness).sum(-1)
        step = -(axes @ (along / stiffness)[..., None])[..., 0]
        with torch.no_grad():  # a step to where the function is not finite is refused
            lower = torch.nan_to_num(
                function(phi[active] + step, start[active], goal[active]), nan=torch.inf
            )
        evaluations += 2 * len(active)
        better = lower < value
        phi[active] += torch.where(better[:, None], step, 0.0)
        reached[active] = torch.where(better, lower, value)
        done = promised <= tolerance * value
        damping[active] = torch.where(better, damping[active] / 10, damping[active] * 10).clamp(
            min=1e-12
        )
        converged[active] = done
        active = active[~done & (damping[active] < DAMPING[1])]
    return Descent(phi.numpy(), reached.numpy(), converged.numpy(), steps, evaluations)


def _expansion(
    function: Objective, phi: Tensor, start: Tensor, goal: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Which curves have finite derivatives; their value, gradient, curvatures and axes."""

    def first(phi: Tensor, start: Tensor, goal: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        gradient, value = torch.func.grad_and_value(function)(phi, start, goal)
        return gradient, (gradient, value)

    second = torch.func.vmap(torch.func.jacfwd(first, has_aux=True))
    blocks = zip(phi.split(BLOCK), start.split(BLOCK), goal.split(BLOCK), strict=True)
    parts = [(hessian, *rest) for hessian, rest in (second(*block) for block in blocks)]
    hessian, gradient, value = (torch.cat(part) for part in zip(*parts, strict=True))
    known = value.isfinite() & gradient.isfinite().all(-1) & hessian.isfinite().flatten(1).all(-1)
    curvature, axes = torch.linalg.eigh((hessian[known] + hessian[known].mT) / 2)
    return known, value[known], gradient[known], curvature, axes
