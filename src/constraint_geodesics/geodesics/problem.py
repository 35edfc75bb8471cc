"""What a geodesic solver is asked and what it answers: ends, cost of curves, the result."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any, Literal, Protocol

import joblib
import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.projection import Retraction
from constraint_geodesics.geodesics.pull_kernels import Bounds, tangential_gradient
from constraint_geodesics.geometry.curves import CurveFamily, Curves, PinnedPolynomial
from constraint_geodesics.geometry.length import TOLERANCE, Collocation, Quadrature, estimate_length
from constraint_geodesics.geometry.manifold import (
    BoundedManifold,
    GeometryError,
    Manifold,
    require_inside,
)
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.lift import (
    Lifted,
    allowed_steps,
    as_executed,
    corrected,
    densify,
    jump_excess,
    retracted,
)

Phi = Float[np.ndarray, "B p"]
"""Coefficients of B curves."""
Paths = Float[np.ndarray, "B S D"]
"""Joints [rad] along B curves."""

REDRAWN = 10
"""Times that a goal equal to its start is drawn again."""
FITTED = 65
"""Points of a curve that another family's is fitted to."""
INSIDE_POINTS = 1025
"""Points of a curve that are looked up to tell whether it stays inside a bounded manifold."""
JUMP_WEIGHT = 2.0
"""Cost of a radian of a jump, beyond its length: a jump must never pay for a shorter curve."""
SHOWN_NODES = 3
"""Inner configurations of a curve that a policy sees."""
PRIOR_POINTS = 256
"""Latent points that the decoder's mean Jacobian is taken over."""
LEAST_SINGULAR = 0.2
"""Smallest singular value of the decoder's mean Jacobian that is inverted, as a share of the
largest.
"""
LONGEST_DESCENT = 0.5
"""Longest step of the descent, in units of the ends' distance: at a jump the pull has no scale."""


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
        phi, start, goal, times = _tensors(self.phi, self.start, self.goal, t)
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
        """Costs alone."""
        return Observed.alone(self.evaluate(phi, ends))

    def lengths(self, phi: Phi, ends: Ends, tolerance: float = TOLERANCE) -> Float[np.ndarray, "B"]:
        """Lengths on the manifold, to a relative tolerance (`estimate_length`)."""
        with torch.no_grad():
            curves = _curves(self.curve, phi, ends)
            return estimate_length(self.manifold, curves, tolerance).length.numpy()

    def stays_inside(self, phi: Phi, ends: Ends) -> Bool[np.ndarray, "B"]:
        """Whether all of INSIDE_POINTS points of each curve belong to the manifold."""
        if not isinstance(self.manifold, BoundedManifold):
            return np.ones(len(phi), dtype=bool)
        t = torch.linspace(0.0, 1.0, INSIDE_POINTS, dtype=torch.float64)
        points, _ = _curves(self.curve, phi, ends).at(t)
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
        """Random pairs of points of the domain; pairs of one point are drawn again."""
        start, goal = self.domain.sample(count, rng), self.domain.sample(count, rng)
        for _ in range(REDRAWN):
            same = np.flatnonzero((start == goal).all(axis=1))
            if not len(same):
                break
            goal[same] = self.domain.sample(len(same), rng)
        return Ends(start, goal, start, goal)

    def sample_curves(self, ends: Ends, rng: np.random.Generator) -> Phi:
        """Cubics with normal coefficients of the ends' distance, whatever the family."""
        cubic = PinnedPolynomial(self.curve.dim, 3)
        phi = rng.normal(size=(len(ends), cubic.coefficients)) * ends.distance[:, None]
        if self.curve == cubic:
            return phi
        t = torch.linspace(0.0, 1.0, FITTED, dtype=torch.float64)
        points, _ = _curves(cubic, phi, ends).at(t)
        return self.curve.fit(points, t).numpy()

    def fingerprint(self) -> str:
        """Of manifold, curve family and domain."""
        return str(joblib.hash((_content(self.manifold), self.curve, self.domain)))


@dataclass(frozen=True)
class LearnedProblem:
    """Geodesics on a learned manifold under a constraint, between configurations that satisfy it.

    With `retract` curves are decoded, their ends corrected, every point retracted onto the
    constraint, and the length is that of the path with the decoder's deviation: ∫ √(‖q̇‖² + ‖σ̇‖²)
    dt.  Without, it is the length of the latent curve as the paper measures it, ∫ ‖ḟ‖ dt, and the
    cost rises by `inclusion_weight` times the mean of ι_C along the curve.
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

    def evaluate(self, phi: Phi, ends: Ends) -> Costs:
        """Length and cost; a curve is feasible if it has no jump, stays within the limits and,
        retracted, converged.

        The cost holds the length's error estimate too: a curve must not look short because its
        length is not known.
        """
        decoded, deviation = self._decoded(phi, ends)
        return self._costs(self._lifted(decoded, ends), decoded, deviation)

    def observed(self, phi: Phi, ends: Ends) -> Observed:
        """Costs, descent and features; both describe the constraint by what it does to the curve.

        descent: K⁻¹ ∫ (J̄⁺ P q̈) b_k dt in the chart, with P the projector on the tangent space of
        the constraint (`tangential_gradient`), J̄ the decoder's mean Jacobian and K_jk =
        ∫ ḃ_j ḃ_k dt.
        features: whether the curve is not feasible; jumps, and what lies outside the limits, as the
        coefficients that would follow them (2 p); their sizes and what the retraction left (3);
        configurations at SHOWN_NODES inner times [π rad]; the constraint's axes (6) and tolerances
        (6) [`pose.SEEN_TOLERANCE`].
        Where curves are not retracted there are costs alone: what counts there is the whole
        embedding.
        """
        if not self.retract:
            return Observed.alone(self.evaluate(phi, ends))
        decoded, deviation = self._decoded(phi, ends)
        lifted = self._lifted(decoded, ends)
        constraint = np.broadcast_to(self._constraint, (len(phi), 12))
        costs = self._costs(lifted, decoded, deviation)
        return self._observed(costs, lifted, self._pulls(lifted.joints), constraint, ends)

    def _decoded(self, phi: Phi, ends: Ends) -> tuple[Paths, Paths]:
        """Decoder mean and deviation [rad] at the times that lengths are measured with."""
        embedded = self.chart.embed_points(
            self.latent_points(phi, ends, _rule(self.degree).times.numpy())
        )
        dof = self.manifold.robot.dof
        return embedded[..., :dof].astype(np.float64), embedded[..., dof:]

    def _lifted(self, decoded: Paths, ends: Ends) -> Lifted:
        t = _rule(self.degree).times.numpy()
        joints = corrected(decoded, t, ends.q_start, ends.q_goal)
        return retracted(self.manifold, joints, self.retraction if self.retract else None)

    def _costs(self, lifted: Lifted, decoded: Paths, deviation: Paths) -> Costs:
        rule = _rule(self.degree)
        assert rule.half is not None
        mean = lifted.joints if self.retract else decoded
        shape = torch.from_numpy(np.concatenate([mean, deviation], axis=-1, dtype=np.float32))
        fine, coarse = rule.length(shape), rule.half.length(shape[:, ::2])
        length, error = fine.double().numpy(), (fine - coarse).abs().double().numpy()
        outside = -np.minimum(self.manifold.robot.limit_distance(lifted.joints), 0.0).sum(-1)
        if not self.retract:
            factor = 1.0 + self.inclusion_weight * self.manifold.violation(decoded).mean(-1)
            return Costs(length, (length + error) * factor + outside, outside == 0.0)
        excess = jump_excess(lifted.joints, rule.times.numpy())
        left = lifted.violation.max(axis=-1)
        cost = length + error + JUMP_WEIGHT * excess + outside + left
        kept = left <= 10 * self.retraction.accuracy
        return Costs(length, cost, (excess == 0.0) & (outside == 0.0) & kept)

    def _pulls(self, joints: Paths) -> Paths:
        manifold, robot = self.manifold, self.manifold.robot
        pulls = np.empty_like(joints)
        bounds = Bounds(robot.lower, robot.upper, 2 * self.retraction.accuracy)
        tangential_gradient(
            manifold.arrays, bounds, _rule(self.degree).times.numpy(), joints, pulls
        )
        return pulls

    def _observed(
        self,
        costs: Costs,
        lifted: Lifted,
        pulls: Paths,
        constraint: Float[np.ndarray, "B 12"],
        ends: Ends,
    ) -> Observed:
        t, (basis, between) = _rule(self.degree).times.numpy(), self._bases
        robot, joints, far = self.manifold.robot, lifted.joints, ends.distance[:, None]
        descent = self._coefficients(pulls, basis)
        size = np.linalg.norm(descent, axis=1, keepdims=True)
        descent *= np.minimum(1.0, LONGEST_DESCENT * far / np.maximum(size, 1e-12))
        steps = np.diff(joints, axis=1)
        lengths = np.linalg.norm(steps, axis=-1)
        excess = np.maximum(lengths - allowed_steps(joints, t), 0.0)
        beyond = steps * (excess / np.maximum(lengths, 1e-12))[..., None]
        jump = self._coefficients(beyond, between) / far
        over = np.maximum(joints - robot.upper, 0.0) + np.minimum(joints - robot.lower, 0.0)
        outside = self._coefficients(over, basis) / far
        sizes = np.stack([excess.sum(1), np.abs(over).sum((1, 2)), lifted.violation.max(1)], axis=1)
        shown = joints[:, np.linspace(0, len(t) - 1, SHOWN_NODES + 2).round().astype(int)[1:-1]]
        seen = (
            ~costs.feasible[:, None],
            np.clip(jump, -3.0, 3.0),
            np.clip(outside, -3.0, 3.0),
            np.log1p(sizes),
            shown.reshape(len(joints), -1) / np.pi,
            constraint,
        )
        return Observed(costs, descent, np.concatenate(seen, axis=1))

    def _coefficients(self, joints: Paths, basis: Float[np.ndarray, "S m"]) -> Phi:
        """Σ_s J̄⁺ q_s b_k(t_s), preconditioned by K⁻¹, as coefficients of the family."""
        weights = basis @ self._stiffness
        summed = (joints.transpose(0, 2, 1) @ weights).transpose(0, 2, 1) @ self._to_latent.T
        return summed.transpose(0, 2, 1).reshape(len(joints), -1)

    @cached_property
    def _bases(self) -> tuple[Float[np.ndarray, "S m"], Float[np.ndarray, "S-1 m"]]:
        """b_k at the times lengths are measured with, and halfway between them."""
        t = _rule(self.degree).times
        return self.curve.basis(t).numpy(), self.curve.basis(0.5 * (t[1:] + t[:-1])).numpy()

    @cached_property
    def _stiffness(self) -> Float[np.ndarray, "m m"]:
        """K⁻¹."""
        rule = Quadrature.gauss_legendre(10, self.curve.breaks)
        slopes = self.curve.basis_derivative(rule.nodes)
        return torch.linalg.inv(slopes.mT @ (rule.weights[:, None] * slopes)).numpy()

    @cached_property
    def _to_latent(self) -> Float[np.ndarray, "N D"]:
        """J̄⁺: the decoder is so close to linear that one Jacobian serves."""
        z = np.random.default_rng(0).normal(size=(PRIOR_POINTS, self.chart.dim))
        jacobian = torch.func.vmap(torch.func.jacfwd(self.chart.vae.mean))(self.chart.tensor(z))
        # directions that the decoder hardly answers to would take all of the step
        return np.linalg.pinv(jacobian.mean(0).double().numpy(), rcond=LEAST_SINGULAR)

    @cached_property
    def _constraint(self) -> Float[np.ndarray, "12"]:
        return self.manifold.constraint.context

    def latent_points(
        self, phi: Phi, ends: Ends, t: Float[np.ndarray, "T"]
    ) -> Float[np.ndarray, "B T N"]:
        """γ_φ(t) in the latent space, eqs. 9-11."""
        return _curves(self.curve, phi, ends).at(*_tensors(t))[0].numpy()

    def lifted_at(
        self, phi: Phi, ends: Ends, t: Float[np.ndarray, "T"], retraction: Retraction | None
    ) -> Lifted:
        """The curves in joint space at rising times, 0 and 1 among them: decoded, their ends
        corrected and, unless `retraction` is None, retracted.
        """
        decoded = self.chart.decode(self.latent_points(phi, ends, t))
        line = corrected(decoded, t, ends.q_start, ends.q_goal)
        return retracted(self.manifold, line, retraction)

    def path(
        self, phi: Float[np.ndarray, "p"], ends: Ends, spacing: float
    ) -> Float[np.ndarray, "T D"]:
        """The joint path of one curve, rows about `spacing` [rad] apart unless the curve has a
        jump.

        The curve itself is evaluated until its points are 0.1 rad apart; the rows between them are
        drawn as those of any other planner's path.
        """
        exact = Retraction() if self.retract else None
        points = 65
        while True:
            t = np.linspace(0.0, 1.0, points)
            joints = self.lifted_at(phi[None], ends, t, exact).joints[0]
            if np.linalg.norm(np.diff(joints, axis=0), axis=-1).max() <= 0.1 or points > 1000:
                if self.retract:
                    return as_executed(self.manifold, joints, spacing)
                return densify(joints, spacing)
            points = 2 * points - 1

    def ends(self, start: Float[np.ndarray, "B D"], goal: Float[np.ndarray, "B D"]) -> Ends:
        """Ends from configurations [rad]."""
        return Ends(self.chart.encode(start), self.chart.encode(goal), start, goal)

    def sample_ends(self, count: int, rng: np.random.Generator) -> Ends:
        """Pairs of configurations of the constraint's data."""
        rows = rng.integers(len(self.joints), size=(2, count))
        return self.ends(self.joints[rows[0]], self.joints[rows[1]])

    def sample_curves(self, ends: Ends, rng: np.random.Generator) -> Phi:
        """Curves bent towards random configurations of the data: the way round a branch."""
        past = self.chart.encode(self.joints[rng.integers(len(self.joints), size=len(ends))])
        share = rng.uniform(size=(len(ends), 1))
        bend = share * (past - 0.5 * (ends.z_start + ends.z_goal))
        noise = rng.normal(scale=0.1, size=(len(ends), self.curve.coefficients))
        return bent_halfway(self.curve, bend) + noise

    def fingerprint(self) -> str:
        """Of the networks, robot, constraint, data and settings."""
        weights = _content(self.chart)
        settings = (self.curve, self.degree, self.retract, self.inclusion_weight, self.retraction)
        chain = self.manifold.robot.chain
        return str(
            joblib.hash((weights, chain, self.manifold.constraint.key, self.joints, settings))
        )


@dataclass(frozen=True)
class ProblemSet:
    """Several constraints on one learned manifold as one problem: each pair of ends has its member.

    Curves are decoded and priced together; only what depends on the constraint goes by members.
    Raises GeometryError if the members differ in more than constraint and data, or do not retract.
    """

    members: Sequence[LearnedProblem]

    def __post_init__(self) -> None:
        first = self.members[0]
        for member in self.members:
            same = replace(member, manifold=first.manifold, joints=first.joints) == first
            if not (same and member.retract and member.manifold.robot is first.manifold.robot):
                raise GeometryError(
                    "members of a problem set differ in more than constraint and data"
                )

    @property
    def curve(self) -> CurveFamily:
        """The family of all members."""
        return self.members[0].curve

    def evaluate(self, phi: Phi, ends: Ends) -> Costs:
        """Each row as its member measures it."""
        first = self.members[0]
        decoded, deviation = first._decoded(phi, ends)
        return first._costs(self._lifted(decoded, ends), decoded, deviation)

    def observed(self, phi: Phi, ends: Ends) -> Observed:
        """Each row as its member sees it."""
        first = self.members[0]
        decoded, deviation = first._decoded(phi, ends)
        lifted = self._lifted(decoded, ends)
        pulls = np.empty_like(decoded)
        for member, rows in self._rows(ends):
            pulls[rows] = member._pulls(lifted.joints[rows])
        constraint = np.stack([member._constraint for member in self.members])[ends.member]
        costs = first._costs(lifted, decoded, deviation)
        return first._observed(costs, lifted, pulls, constraint, ends)

    def _lifted(self, decoded: Paths, ends: Ends) -> Lifted:
        lifted = Lifted(np.empty_like(decoded), np.empty(decoded.shape[:2]))
        for member, rows in self._rows(ends):
            part = member._lifted(decoded[rows], ends[rows])
            lifted.joints[rows], lifted.violation[rows] = part.joints, part.violation
        return lifted

    def sample_ends(self, count: int, rng: np.random.Generator) -> Ends:
        """Ends of members drawn evenly."""
        chosen = rng.integers(len(self.members), size=count)
        joints = np.empty((2, count, self.members[0].manifold.robot.dof))
        for k, member in enumerate(self.members):
            rows = np.flatnonzero(chosen == k)
            joints[:, rows] = member.joints[rng.integers(len(member.joints), size=(2, len(rows)))]
        return replace(self.members[0].ends(*joints), member=chosen)

    def sample_curves(self, ends: Ends, rng: np.random.Generator) -> Phi:
        """Each curve as its member draws it."""
        phi = np.empty((len(ends), self.curve.coefficients))
        for member, rows in self._rows(ends):
            phi[rows] = member.sample_curves(ends[rows], rng)
        return phi

    def fingerprint(self) -> str:
        """Of all members."""
        return str(joblib.hash([member.fingerprint() for member in self.members]))

    def _rows(self, ends: Ends) -> list[tuple[LearnedProblem, Int[np.ndarray, "b"]]]:
        rows = [np.flatnonzero(ends.member == k) for k in range(len(self.members))]
        return [(member, r) for member, r in zip(self.members, rows, strict=True) if len(r)]


def bent_halfway(curve: CurveFamily, bend: Float[np.ndarray, "B N"]) -> Phi:
    """Coefficients of parabolas that pass `bend` away from the straight line halfway."""
    t = torch.linspace(0.0, 1.0, 4 * curve.functions + 3, dtype=torch.float64)
    height = (4.0 * t * (1.0 - t))[:, None]
    return curve.fit(height * torch.from_numpy(np.asarray(bend, np.float64))[:, None, :], t).numpy()


def _curves(family: CurveFamily, phi: Phi, ends: Ends) -> Curves:
    return Curves(family, *_tensors(phi, ends.z_start, ends.z_goal))


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
