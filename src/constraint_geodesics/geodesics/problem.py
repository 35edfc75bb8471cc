"""What a geodesic solver is asked and what it answers: ends, cost of curves, the result."""

from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal, Protocol

import joblib
import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from constraint_geodesics.geodesics.images import images_between
from constraint_geodesics.geometry.curves import CurveFamily, Curves, PinnedPolynomial
from constraint_geodesics.geometry.length import TOLERANCE, estimate_length, length_function, rules
from constraint_geodesics.geometry.manifold import (
    BoundedManifold,
    GeometryError,
    Manifold,
    require_inside,
)
from constraint_geodesics.learning.learned_manifold import LearnedManifold

Phi = Float[np.ndarray, "B p"]
"""Coefficients of B curves."""

REDRAWN = 10
"""Times that a goal equal to its start is drawn again."""
FITTED = 65
"""Points of a curve that another family's is fitted to."""
DENSITY_SIDE = 65
"""Points a side of the lattice that tells how dense points can be."""
LONGEST_STEP = 0.5
"""Of a descent, in units of the ends' distance."""
RIDGE = 1e-3
"""Added to a descent's stiffness, relative to its mean: at a pole the metric loses a rank."""
INSIDE_POINTS = 1025
"""Points of a curve that are looked up to tell whether it stays inside a bounded manifold."""


@dataclass(frozen=True)
class Ends:
    """Starts and goals of B curves, in the chart and, on a robot's manifold, as joints [rad]."""

    z_start: Float[np.ndarray, "B N"]
    z_goal: Float[np.ndarray, "B N"]
    q_start: Float[np.ndarray, "B D"]
    q_goal: Float[np.ndarray, "B D"]
    member: Int[np.ndarray, "B"] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """Which problem of a `ProblemSet` each pair belongs to; 0 unless given."""

    def __post_init__(self) -> None:
        if len(self.member) != len(self.z_start):
            object.__setattr__(self, "member", np.zeros(len(self.z_start), dtype=np.int64))

    def __getitem__(self, rows: np.ndarray) -> "Ends":
        return Ends(*(values[rows] for values in vars(self).values()))

    def __len__(self) -> int:
        return len(self.z_start)

    @property
    def distance(self) -> Float[np.ndarray, "B"]:
        """Distance of start and goal in the chart, the unit of coefficients: scales look alike."""
        return np.maximum(np.sqrt(((self.z_goal - self.z_start) ** 2).sum(axis=1)), 1e-9)

    def replaced(self, rows: np.ndarray, other: "Ends") -> "Ends":
        """A copy with the given rows taken from `other`."""
        copies = [np.array(values) for values in vars(self).values()]
        for copy, values in zip(copies, vars(other).values(), strict=True):
            copy[rows] = values
        return Ends(*copies)


def repeated(ends: Ends, count: int) -> Ends:
    """The first of the ends, `count` times."""
    return ends[np.zeros(count, dtype=int)]


@dataclass(frozen=True)
class Costs:
    """Length of B curves, cost (the length and what is wrong), and which could be used."""

    length: Float[np.ndarray, "B"]
    cost: Float[np.ndarray, "B"]
    feasible: Bool[np.ndarray, "B"]


@dataclass(frozen=True)
class Observed:
    """What a policy sees of B curves apart from their coefficients.

    descent: the step of a preconditioned descent of the energy, in the chart's unit; no columns
    where a problem has none.  features: numbers of order 1, as many for every problem of a class.
    """

    costs: Costs
    descent: Float[np.ndarray, "B d"]
    features: Float[np.ndarray, "B f"]

    @classmethod
    def alone(cls, costs: Costs) -> "Observed":
        """Costs with neither descent nor features."""
        nothing = np.zeros((len(costs.cost), 0))
        return cls(costs, nothing, nothing)


class GeodesicProblem(Protocol):
    """Curves between any two ends of one manifold, and what they cost."""

    @property
    def curve(self) -> CurveFamily:
        """The family searched."""
        ...

    def evaluate(self, phi: Phi, ends: Ends) -> Costs:
        """Cost of the curves with coefficients phi."""
        ...

    def observed(self, phi: Phi, ends: Ends) -> Observed:
        """The same costs with what else a policy sees of these curves."""
        ...

    def sample_ends(self, count: int, rng: np.random.Generator) -> Ends:
        """Ends to train on."""
        ...

    def sample_curves(self, ends: Ends, rng: np.random.Generator) -> Phi:
        """Coefficients of one random curve between each of the given ends."""
        ...

    def fingerprint(self) -> str:
        """The same for problems that cost every curve the same and draw the same ends."""
        ...


SearchStatus = Literal["converged", "iteration_limit", "not_found", "not_connected"]


@dataclass(frozen=True)
class Geodesic:
    """What a solver found between one start and goal: the one record of every solver.

    status: "converged" (more of the same work would not shorten the curve), "iteration_limit" (it
    was still getting shorter), "not_found" (every curve tried jumps, collides, or leaves the limits
    or the manifold), "not_connected" (not joined, as far as the graph that was searched knows).
    curve, phi, start, goal: γ_φ; on a periodic chart the goal may be another image of the one asked
    for.
    length: of γ_φ, nan where nothing was found.  straight_length: of the straight chart line to the
    nearest image of the goal.  iterations: steps of the solver.  evaluations: curves measured.
    """

    status: SearchStatus
    curve: CurveFamily
    phi: Float[np.ndarray, "p"]
    start: Float[np.ndarray, "N"]
    goal: Float[np.ndarray, "N"]
    length: float = np.nan
    straight_length: float = np.nan
    iterations: int = 0
    evaluations: int = 0
    time_s: float = 0.0

    @property
    def found(self) -> bool:
        """Whether there is a curve to use."""
        return self.status in ("converged", "iteration_limit")

    def points(self, t: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T N"]:
        """γ_φ(t) in the chart."""
        phi, start, goal, times = tensors(self.phi, self.start, self.goal, t)
        return self.curve.evaluate(phi, start, goal, times)[0].numpy()

    @classmethod
    def nothing(
        cls, status: SearchStatus, curve: CurveFamily, start: np.ndarray, goal: np.ndarray
    ) -> "Geodesic":
        """The answer where there is no curve: φ = 0, and no length."""
        return cls(status, curve, np.zeros(curve.coefficients), start, goal)


class GeodesicSolver(Protocol):
    """A solver of geodesics.  `geodesics_between` calls it with ends that it has checked."""

    def solve(self, problem: "ChartProblem", ends: Ends) -> list[Geodesic]:
        """The shortest curve of the problem's family found for each start and goal, in order."""
        ...


class Domain(Protocol):
    """Where the ends of training and test come from."""

    def sample(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "B N"]:
        """Random points of the chart."""
        ...


@dataclass(frozen=True)
class ChartBox:
    """Points uniform in a box of the chart."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    def sample(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "B N"]:
        """Random points of the box."""
        return rng.uniform(self.low, self.high, (count, len(self.low)))


@dataclass(frozen=True)
class Everywhere:
    """Points of a box of the chart, uniform by the manifold's own area."""

    manifold: Manifold
    box: ChartBox

    def sample(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "B N"]:
        """Random points of the box, by rejection; the largest density is that of a lattice."""
        most, found = self._largest_density, np.zeros((0, len(self.box.low)))
        while len(found) < count:
            drawn = self.box.sample(2 * count, rng)
            kept = self._density(drawn) > most * rng.random(len(drawn))
            found = np.concatenate([found, drawn[kept]])
        return found[:count]

    @property
    def _largest_density(self) -> float:
        sides = zip(self.box.low, self.box.high, strict=True)
        axes = np.meshgrid(*(np.linspace(low, high, DENSITY_SIDE) for low, high in sides))
        return float(self._density(np.stack([axis.ravel() for axis in axes], axis=1)).max())

    def _density(self, z: Float[np.ndarray, "B N"]) -> Float[np.ndarray, "B"]:
        """Area of the manifold over that of the chart."""
        density: np.ndarray = torch.linalg.det(self.manifold.metric(torch.from_numpy(z))).numpy()
        return np.sqrt(np.maximum(density, 0.0))


@dataclass(frozen=True)
class Samples:
    """Points of a given set, encoded data for example."""

    points: Float[np.ndarray, "n N"]

    def sample(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "B N"]:
        """Random points of the set."""
        return self.points[rng.integers(len(self.points), size=count)]


@dataclass(frozen=True)
class ChartProblem:
    """Geodesics in one chart of a manifold, eq. 2: the plain problem, without a robot."""

    manifold: Manifold
    curve: CurveFamily
    domain: Domain

    def evaluate(self, phi: Phi, ends: Ends) -> Costs:
        """The cost is the length; a curve that leaves the manifold is not feasible."""
        length = self.lengths(phi, ends)
        return Costs(length, length, np.isfinite(length) & self.stays_inside(phi, ends))

    def observed(self, phi: Phi, ends: Ends) -> Observed:
        """Costs, and a step down the squared length."""
        costs = self.evaluate(phi, ends)
        return Observed(costs, self.descent(phi, ends), np.zeros((len(phi), 0)))

    def descent(self, phi: Phi, ends: Ends) -> Phi:
        """The step that leads to the least energy, if the metric stayed what it is along each
        curve: −H⁻¹ ∇(L²), which is that of the energy at constant speed, with
        H = 2 ∫ ḃ_k ḃ_l M(γ) dt, at most LONGEST_STEP of the ends' distance.
        """
        rule = rules(tuple(self.curve.breaks))[1]
        length = length_function(self.manifold, self.curve, rule)
        slope, value = torch.func.vmap(torch.func.grad_and_value(length))(
            *tensors(phi, ends.z_start, ends.z_goal)
        )
        slope = 2.0 * (value[:, None] * slope).numpy()
        with torch.no_grad():
            points, _ = curves_of(self.curve, phi, ends).at(rule.times)
            metric = self.manifold.metric(points).numpy()
        rates = self.curve.basis_derivative(rule.times).numpy()
        weights = rule.own_weights.numpy()
        stiffness = np.einsum("t,tk,tl,btnm->bnkml", 2.0 * weights, rates, rates, metric)
        stiffness = stiffness.reshape(len(phi), *2 * (self.curve.coefficients,))
        scale = np.trace(stiffness, axis1=1, axis2=2) / self.curve.coefficients
        ridge = np.maximum(RIDGE * scale, 1e-12)[:, None, None] * np.eye(self.curve.coefficients)
        usable = np.isfinite(stiffness).all(axis=(1, 2)) & np.isfinite(slope).all(axis=1)
        step = np.zeros_like(phi)
        solved = np.linalg.solve((stiffness + ridge)[usable], slope[usable, :, None])
        step[usable] = -solved[:, :, 0]
        size = np.sqrt((step**2).sum(axis=1))
        return (
            step * np.minimum(1.0, LONGEST_STEP * ends.distance / np.maximum(size, 1e-12))[:, None]
        )

    def lengths(self, phi: Phi, ends: Ends, tolerance: float = TOLERANCE) -> Float[np.ndarray, "B"]:
        """Lengths on the manifold, to a relative tolerance (`estimate_length`)."""
        with torch.no_grad():
            curves = curves_of(self.curve, phi, ends)
            return estimate_length(self.manifold, curves, tolerance).length.numpy()

    def stays_inside(self, phi: Phi, ends: Ends) -> Bool[np.ndarray, "B"]:
        """Whether all of INSIDE_POINTS points of each curve belong to the manifold."""
        if not isinstance(self.manifold, BoundedManifold):
            return np.ones(len(phi), dtype=bool)
        t = torch.linspace(0.0, 1.0, INSIDE_POINTS, dtype=torch.float64)
        points, _ = curves_of(self.curve, phi, ends).at(t)
        return self.manifold.contains(points).all(-1).numpy()

    def ends(self, start: Float[np.ndarray, "B N"], goal: Float[np.ndarray, "B N"]) -> Ends:
        """Ends from chart points.

        Raises GeometryError on a wrong shape, NonFiniteError or OutsideError with the first bad
        point.
        """
        start, goal = (np.asarray(values, np.float64) for values in (start, goal))
        if start.ndim != 2 or start.shape != goal.shape:
            raise GeometryError(
                f"start and goal have shapes {start.shape} and {goal.shape}: both must be (B, N)"
            )
        for name, points in (("start", start), ("goal", goal)):
            require_inside(self.manifold, torch.from_numpy(points), name)
        return Ends(start, goal, start, goal)

    def sample_ends(self, count: int, rng: np.random.Generator) -> Ends:
        """Random pairs of points of the domain; pairs of one point are drawn again.  Where the
        chart repeats, goals are any of their images near the start.
        """
        start, goal = self.domain.sample(count, rng), self.domain.sample(count, rng)
        for _ in range(REDRAWN):
            same = np.flatnonzero((start == goal).all(axis=1))
            if not len(same):
                break
            goal[same] = self.domain.sample(len(same), rng)
        images = images_between(self.manifold, start, goal)
        if images.shape[1] > 1:
            goal = images[np.arange(count), rng.integers(images.shape[1], size=count)]
        return Ends(start, goal, start, goal)

    def sample_curves(self, ends: Ends, rng: np.random.Generator) -> Phi:
        """Cubics with normal coefficients of the ends' distance, whatever the family."""
        cubic = PinnedPolynomial(self.curve.dim, 3)
        phi = rng.normal(size=(len(ends), cubic.coefficients)) * ends.distance[:, None]
        if self.curve == cubic:
            return phi
        t = torch.linspace(0.0, 1.0, FITTED, dtype=torch.float64)
        points, _ = curves_of(cubic, phi, ends).at(t)
        return self.curve.fit(points, t).numpy()

    def fingerprint(self) -> str:
        """Of manifold, curve family and domain."""
        return str(joblib.hash((content_of(self.manifold), self.curve, self.domain)))


def bent_halfway(curve: CurveFamily, bend: Float[np.ndarray, "B N"]) -> Phi:
    """Coefficients of parabolas that pass `bend` away from the straight line halfway."""
    return (bend[:, :, None] * _parabola(curve)).reshape(len(bend), curve.coefficients)


@cache
def _parabola(curve: CurveFamily) -> Float[np.ndarray, "m"]:
    """Coefficients in one dimension of the parabola through 1 halfway."""
    t = torch.linspace(0.0, 1.0, 4 * curve.functions + 3, dtype=torch.float64)
    height = (4.0 * t * (1.0 - t))[:, None].expand(-1, curve.dim)
    return curve.fit(height[None], t).numpy()[0, : curve.functions]


def curves_of(family: CurveFamily, phi: Phi, ends: Ends) -> Curves:
    """Curves with the given coefficients between the given ends."""
    return Curves(family, *tensors(phi, ends.z_start, ends.z_goal))


def tensors(*arrays: np.ndarray) -> tuple[torch.Tensor, ...]:
    """Arrays as tensors in double precision."""
    return tuple(torch.from_numpy(np.asarray(values, np.float64)) for values in arrays)


def content_of(value: Any) -> Any:
    """What identifies a manifold: its weights where it is a network, itself otherwise."""
    if isinstance(value, LearnedManifold):
        return {name: weight.numpy() for name, weight in value.vae.state_dict().items()}
    return value
