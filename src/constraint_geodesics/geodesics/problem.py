"""What a geodesic solver is asked and what it answers: ends, the cost of curves between them, the result."""

from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal, Protocol

import joblib
import numpy as np
import torch
from jaxtyping import Bool, Float

from constraint_geodesics.constraints.lift import as_executed, correct_and_retract, densify, jump_excess
from constraint_geodesics.constraints.retraction import Retraction
from constraint_geodesics.constraints.vector import ConstraintManifold
from constraint_geodesics.geometry.curves import CurveFamily, PinnedPolynomial
from constraint_geodesics.geometry.length import Collocation, estimate_length
from constraint_geodesics.geometry.manifold import BoundedManifold, GeometryError, Manifold, require_inside
from constraint_geodesics.learning.learned_manifold import LearnedManifold

REDRAWN = 10
"""Times that a goal equal to its start is drawn again."""
FITTED = 65
"""Points of a curve that another family's is fitted to."""
INSIDE_POINTS = 1025
"""Points of a curve that are looked up to tell whether it stays inside a bounded manifold."""
JUMP_WEIGHT = 2.0
"""Cost of a radian of a jump, beyond its length: a jump must never pay for a shorter curve."""


@dataclass(frozen=True)
class Ends:
    """Starts and goals of B curves, as chart points (B, N) and, on a robot's manifold, as joints (B, D) [rad]."""

    z_start: Float[np.ndarray, "B N"]
    z_goal: Float[np.ndarray, "B N"]
    q_start: Float[np.ndarray, "B D"]
    q_goal: Float[np.ndarray, "B D"]

    def __getitem__(self, rows: np.ndarray) -> "Ends":
        return Ends(self.z_start[rows], self.z_goal[rows], self.q_start[rows], self.q_goal[rows])

    def __len__(self) -> int:
        return len(self.z_start)

    @property
    def distance(self) -> Float[np.ndarray, "B"]:
        """Distance of start and goal in the chart: the unit of coefficients, so that near and far pairs look alike."""
        return np.maximum(np.linalg.norm(self.z_goal - self.z_start, axis=1), 1e-9)

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
    """Length of B curves, their cost (the length and what is wrong with them), and which are curves one could use."""

    length: Float[np.ndarray, "B"]
    cost: Float[np.ndarray, "B"]
    feasible: Bool[np.ndarray, "B"]


class GeodesicProblem(Protocol):
    """Curves between any two ends of one manifold, and what they cost."""

    @property
    def curve(self) -> CurveFamily:
        """The family searched."""
        ...

    def evaluate(self, phi: Float[np.ndarray, "B p"], ends: Ends) -> Costs:
        """Cost of the curves with coefficients phi."""
        ...

    def sample_ends(self, count: int, rng: np.random.Generator) -> Ends:
        """Ends to train on."""
        ...

    def sample_curves(self, ends: Ends, rng: np.random.Generator) -> Float[np.ndarray, "B p"]:
        """Coefficients of one random curve between each of the given ends."""
        ...

    def fingerprint(self) -> str:
        """The same for problems that cost every curve the same and draw the same ends."""
        ...


Status = Literal["converged", "iteration_limit", "not_found", "not_connected"]


@dataclass(frozen=True)
class Geodesic:
    """What a solver found between one start and goal: the one record of every solver.

    status: "converged" (more of the same work would not shorten the curve: the gradient stands at a local minimum, the
    graph has given its shortest path, the last step of the policy's roll-outs met nothing shorter), "iteration_limit"
    (it was still getting shorter), "not_found" (every curve tried jumps, collides, or leaves the limits or the
    manifold), "not_connected" (start and goal are not joined, as far as the graph that was searched knows).
    curve, phi, start, goal: γ_φ; on a periodic chart the goal may be another image of the one asked for.
    length: of γ_φ, in the unit of the manifold; nan where nothing was found.  straight_length: of the straight chart
    line to the nearest image of the goal.  iterations: steps of the solver.  evaluations: curves measured.
    """

    status: Status
    curve: CurveFamily
    phi: Float[np.ndarray, "p"]
    start: Float[np.ndarray, "N"]
    goal: Float[np.ndarray, "N"]
    length: float
    straight_length: float
    iterations: int
    evaluations: int
    time_s: float

    @property
    def found(self) -> bool:
        """Whether there is a curve to use."""
        return self.status in ("converged", "iteration_limit")

    def points(self, t: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T N"]:
        """γ_φ(t) in the chart."""
        phi, start, goal, times = _tensors(self.phi, self.start, self.goal, t)
        return self.curve.evaluate(phi, start, goal, times)[0].numpy()

    @classmethod
    def nothing(
        cls, status: Status, curve: CurveFamily, start: Float[np.ndarray, "N"], goal: Float[np.ndarray, "N"]
    ) -> "Geodesic":
        """The answer where there is no curve: φ = 0, and no length."""
        return cls(status, curve, np.zeros(curve.coefficients), start, goal, np.nan, np.nan, 0, 0, 0.0)


class GeodesicSolver(Protocol):
    """A way to find geodesics.  `geodesics_between` calls it with ends that it has checked."""

    def solve(self, problem: "ChartProblem", ends: Ends) -> list[Geodesic]:
        """The shortest curve of the problem's family found between each start and goal, one record each."""
        ...


class Domain(Protocol):
    """Where the ends of training and test come from."""

    def sample(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "B N"]:
        """Random points of the chart."""
        ...


@dataclass(frozen=True)
class Box:
    """Points uniform in a box of the chart."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    def sample(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "B N"]:
        """Random points of the box."""
        return rng.uniform(self.low, self.high, (count, len(self.low)))


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

    def evaluate(self, phi: Float[np.ndarray, "B p"], ends: Ends) -> Costs:
        """The cost is the length, at the default accuracy; a curve that leaves the manifold is not feasible."""
        free, start, goal = _tensors(phi, ends.z_start, ends.z_goal)
        with torch.no_grad():
            length = estimate_length(self.manifold, self.curve, free, start, goal).length.numpy()
        return Costs(length, length, np.isfinite(length) & self.stays_inside(phi, ends))

    def stays_inside(self, phi: Float[np.ndarray, "B p"], ends: Ends) -> Bool[np.ndarray, "B"]:
        """Whether all of INSIDE_POINTS points of each curve belong to the manifold."""
        if not isinstance(self.manifold, BoundedManifold):
            return np.ones(len(phi), dtype=bool)
        t = torch.linspace(0.0, 1.0, INSIDE_POINTS, dtype=torch.float64)
        free, start, goal = _tensors(phi, ends.z_start, ends.z_goal)
        points, _ = self.curve.evaluate(free, start, goal, t)
        return self.manifold.contains(points).all(-1).numpy()

    def ends(self, start: Float[np.ndarray, "B N"], goal: Float[np.ndarray, "B N"]) -> Ends:
        """Ends from chart points.

        Raises GeometryError on a wrong shape, NonFiniteError or OutsideError with the first bad point.
        """
        start, goal = (np.asarray(values, np.float64) for values in (start, goal))
        if start.ndim != 2 or start.shape != goal.shape:
            raise GeometryError(f"start and goal have shapes {start.shape} and {goal.shape}: both must be (B, N)")
        for name, points in (("start", start), ("goal", goal)):
            require_inside(self.manifold, torch.from_numpy(points), name)
        return Ends(start, goal, start, goal)

    def sample_ends(self, count: int, rng: np.random.Generator) -> Ends:
        """Random pairs of points of the domain; a set may hold one twice, so pairs of one point are drawn again."""
        start, goal = self.domain.sample(count, rng), self.domain.sample(count, rng)
        for _ in range(REDRAWN):
            same = np.flatnonzero((start == goal).all(axis=1))
            if not len(same):
                break
            goal[same] = self.domain.sample(len(same), rng)
        return Ends(start, goal, start, goal)

    def sample_curves(self, ends: Ends, rng: np.random.Generator) -> Float[np.ndarray, "B p"]:
        """Cubics with normal coefficients, whatever the family; the ends' distance is their standard deviation."""
        cubic = PinnedPolynomial(self.curve.dim, 3)
        phi = rng.normal(size=(len(ends), cubic.coefficients)) * ends.distance[:, None]
        if self.curve == cubic:
            return phi
        t = torch.linspace(0.0, 1.0, FITTED, dtype=torch.float64)
        free, start, goal = _tensors(phi, ends.z_start, ends.z_goal)
        points, _ = cubic.evaluate(free, start, goal, t)
        return self.curve.fit(points, t).numpy()

    def fingerprint(self) -> str:
        """Of manifold, curve family and domain."""
        return str(joblib.hash((_content(self.manifold), self.curve, self.domain)))


@dataclass(frozen=True)
class LearnedProblem:
    """Geodesics on a learned manifold under a constraint, between configurations that satisfy it.

    With `retract` the curve is decoded, its ends corrected, every point retracted onto the constraint, and the length
    is that of the retracted path with the decoder's deviation beside it: ∫ √(‖q̇‖² + ‖σ̇‖²) dt.
    Without, it is the length of the latent curve as the paper measures it, ∫ ‖ḟ‖ dt, and the cost rises by
    `inclusion_weight` times the mean of ι_C along the curve.
    degree: of the polynomials that lengths are measured with (Collocation), on one point more.
    """

    chart: LearnedManifold
    manifold: ConstraintManifold
    curve: CurveFamily
    joints: Float[np.ndarray, "n D"]
    degree: int
    retract: bool
    inclusion_weight: float
    retraction: Retraction = field(default_factory=lambda: Retraction(accuracy=1e-3, iterations=6))

    def evaluate(self, phi: Float[np.ndarray, "B p"], ends: Ends) -> Costs:
        """Length and cost; a curve is feasible if it has no jump, stays within the limits and, retracted, converged.

        The cost holds the length's error estimate too: a curve must not look short because its length is not known.
        """
        rule = _rule(self.degree)
        t = rule.times.numpy()
        embedded = self.chart.embed_points(self.latent_points(phi, ends, t))
        dof = self.manifold.robot.dof
        decoded, deviation = embedded[..., :dof].astype(np.float64), embedded[..., dof:]
        retraction = self.retraction if self.retract else None
        lifted = correct_and_retract(self.manifold, decoded, t, ends.q_start, ends.q_goal, retraction)
        shape = np.concatenate([lifted.joints if self.retract else decoded, deviation], axis=-1, dtype=np.float32)
        length, error = _length_and_error(rule, shape)
        outside = -np.minimum(self.manifold.robot.limit_distance(lifted.joints), 0.0).sum(-1)
        if not self.retract:
            cost = (length + error) * (1.0 + self.inclusion_weight * self.manifold.violation(decoded).mean(-1))
            return Costs(length, cost + outside, outside == 0.0)
        excess = jump_excess(lifted.joints, t)
        left = lifted.violation.max(axis=-1)
        cost = length + error + JUMP_WEIGHT * excess + outside + left
        return Costs(length, cost, (excess == 0.0) & (outside == 0.0) & (left <= 10 * self.retraction.accuracy))

    def latent_points(
        self, phi: Float[np.ndarray, "B p"], ends: Ends, t: Float[np.ndarray, "T"]
    ) -> Float[np.ndarray, "B T N"]:
        """γ_φ(t) in the latent space, eqs. 9-11."""
        free, start, goal, times = _tensors(phi, ends.z_start, ends.z_goal, t)
        return self.curve.evaluate(free, start, goal, times)[0].numpy()

    def path(self, phi: Float[np.ndarray, "p"], ends: Ends, spacing: float) -> Float[np.ndarray, "T D"]:
        """The joint path of one curve, rows about `spacing` [rad] apart unless the curve has a jump.

        The curve itself is evaluated until its points are 0.1 rad apart; the rows between them are drawn as those of
        any other planner's path.
        """
        exact = Retraction() if self.retract else None
        points = 65
        while True:
            t = np.linspace(0.0, 1.0, points)
            decoded = self.chart.decode(self.latent_points(phi[None], ends, t))
            joints = correct_and_retract(self.manifold, decoded, t, ends.q_start, ends.q_goal, exact).joints[0]
            if np.linalg.norm(np.diff(joints, axis=0), axis=-1).max() <= 0.1 or points > 1000:
                return as_executed(self.manifold, joints, spacing) if self.retract else densify(joints, spacing)
            points = 2 * points - 1

    def ends(self, start: Float[np.ndarray, "B D"], goal: Float[np.ndarray, "B D"]) -> Ends:
        """Ends from configurations [rad]."""
        return Ends(self.chart.encode(start), self.chart.encode(goal), start, goal)

    def sample_ends(self, count: int, rng: np.random.Generator) -> Ends:
        """Pairs of configurations of the constraint's data."""
        rows = rng.integers(len(self.joints), size=(2, count))
        return self.ends(self.joints[rows[0]], self.joints[rows[1]])

    def sample_curves(self, ends: Ends, rng: np.random.Generator) -> Float[np.ndarray, "B p"]:
        """Curves bent towards random configurations of the constraint's data: where a straight line changes its
        branch, the way round leads past some of them.
        """
        past = self.chart.encode(self.joints[rng.integers(len(self.joints), size=len(ends))])
        share = rng.uniform(size=(len(ends), 1))
        bend = share * (past - 0.5 * (ends.z_start + ends.z_goal))
        noise = rng.normal(scale=0.1, size=(len(ends), self.curve.coefficients))
        return bent_halfway(self.curve, bend) + noise

    def fingerprint(self) -> str:
        """Of the networks, robot, constraint, data and settings."""
        weights = _content(self.chart)
        settings = (self.curve, self.degree, self.retract, self.inclusion_weight, self.retraction)
        chain = self.manifold.robot.chain.arrays
        return str(joblib.hash((weights, chain, vars(self.manifold.constraint), self.joints, settings)))


def bent_halfway(curve: CurveFamily, bend: Float[np.ndarray, "B N"]) -> Float[np.ndarray, "B p"]:
    """Coefficients of parabolas that pass `bend` away from the straight line halfway."""
    t = torch.linspace(0.0, 1.0, 4 * curve.functions + 3, dtype=torch.float64)
    height = (4.0 * t * (1.0 - t))[:, None]
    return curve.fit(height * torch.from_numpy(np.asarray(bend, np.float64))[:, None, :], t).numpy()


def _tensors(*arrays: np.ndarray) -> tuple[torch.Tensor, ...]:
    return tuple(torch.from_numpy(np.asarray(values, np.float64)) for values in arrays)


def _content(value: Any) -> Any:
    """What identifies a manifold: its weights where it is a network, itself otherwise."""
    if isinstance(value, LearnedManifold):
        return {name: weight.numpy() for name, weight in value.vae.state_dict().items()}
    return value


@cache
def _rule(degree: int) -> Collocation:
    return Collocation.chebyshev(degree)


def _length_and_error(
    rule: Collocation, values: Float[np.ndarray, "B S A"]
) -> tuple[Float[np.ndarray, "B"], Float[np.ndarray, "B"]]:
    """Length by a rule, and its difference to the rule of half the degree."""
    assert rule.half is not None
    points = torch.from_numpy(values)
    length, coarse = rule.length(points), rule.half.length(points[:, ::2])
    return length.double().numpy(), (length - coarse).abs().double().numpy()
