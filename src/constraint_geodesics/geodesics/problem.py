"""What a geodesic solver is asked and what it answers: ends, the cost of curves between them, the result."""

from dataclasses import dataclass, field
from typing import Protocol

import joblib
import numpy as np
import torch
from jaxtyping import Bool, Float

from constraint_geodesics.constraints.lift import as_executed, correct_and_retract, densify, jump_excess
from constraint_geodesics.constraints.retraction import Retraction
from constraint_geodesics.constraints.vector import ConstraintManifold
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.geometry.length import Quadrature, curve_length
from constraint_geodesics.geometry.manifold import Manifold
from constraint_geodesics.learning.learned_manifold import LearnedManifold

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
    def curve(self) -> PinnedPolynomial:
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


@dataclass(frozen=True)
class Geodesic:
    """The best curve found for one query, its length and that of the straight line, curves evaluated, time [s].

    status: "solved", "not_found" (every curve tried jumps, collides or leaves the limits), "not_connected" (start
    and goal lie in different components of the sub-manifold).
    """

    status: str
    phi: Float[np.ndarray, "p"]
    length: float
    straight_length: float
    evaluations: int
    time_s: float


@dataclass(frozen=True)
class ChartProblem:
    """Geodesics in one chart of an analytic manifold, eq. 2, between ends drawn from a box of the chart."""

    manifold: Manifold
    curve: PinnedPolynomial
    low: Float[np.ndarray, "N"]
    high: Float[np.ndarray, "N"]
    nodes: int

    def evaluate(self, phi: Float[np.ndarray, "B p"], ends: Ends) -> Costs:
        """The cost is the length."""
        free, start, goal = (torch.from_numpy(np.asarray(x, np.float64)) for x in (phi, ends.z_start, ends.z_goal))
        rule = Quadrature.gauss_legendre(self.nodes)
        length = curve_length(self.manifold, self.curve, free, start, goal, rule).numpy()
        return Costs(length, length, np.ones(len(length), dtype=bool))

    def sample_ends(self, count: int, rng: np.random.Generator) -> Ends:
        """Uniform in the box."""
        start, goal = (rng.uniform(self.low, self.high, (count, len(self.low))) for _ in range(2))
        return Ends(start, goal, start, goal)

    def sample_curves(self, ends: Ends, rng: np.random.Generator) -> Float[np.ndarray, "B p"]:
        """Normal coefficients."""
        return rng.normal(size=(len(ends), self.curve.coefficients))

    def fingerprint(self) -> str:
        """Of manifold, curve family, box and rule."""
        return str(joblib.hash((repr(self.manifold), self.curve, self.low, self.high, self.nodes)))


@dataclass(frozen=True)
class LearnedProblem:
    """Geodesics on a learned manifold under a constraint, between configurations that satisfy it.

    With `retract` the curve is decoded, its ends corrected, every point retracted onto the constraint, and the length
    is that of the retracted path with the decoder's deviation beside it: Σ √(‖Δq‖² + ‖Δσ‖²), eq. 2 by chords.
    Without, it is the length of the latent curve as the paper measures it, Σ ‖Δf‖, and the cost rises by
    `inclusion_weight` times the mean of ι_C along the curve.
    """

    chart: LearnedManifold
    manifold: ConstraintManifold
    curve: PinnedPolynomial
    joints: Float[np.ndarray, "n D"]
    nodes: int
    retract: bool
    inclusion_weight: float
    retraction: Retraction = field(default_factory=lambda: Retraction(accuracy=1e-4, iterations=6))

    def evaluate(self, phi: Float[np.ndarray, "B p"], ends: Ends) -> Costs:
        """Length and cost; a curve is feasible if it has no jump, stays within the limits and, retracted, converged."""
        t = np.linspace(0.0, 1.0, self.nodes)
        z = self.latent_points(phi, ends, t)
        embedded = self.chart.embed_points(z)
        dof = self.manifold.robot.dof
        decoded, deviation = embedded[..., :dof].astype(np.float64), embedded[..., dof:]
        retraction = self.retraction if self.retract else None
        lifted = correct_and_retract(self.manifold, decoded, t, ends.q_start, ends.q_goal, retraction)
        shape = lifted.joints if self.retract else decoded
        square = np.square(np.diff(shape, axis=1)).sum(-1) + np.square(np.diff(deviation, axis=1)).sum(-1)
        length = np.sqrt(square).sum(-1)
        outside = -np.minimum(self.manifold.robot.limit_distance(lifted.joints), 0.0).sum(-1)
        if not self.retract:
            cost = length * (1.0 + self.inclusion_weight * self.manifold.violation(decoded).mean(-1))
            return Costs(length, cost + outside, outside == 0.0)
        excess = jump_excess(lifted.joints)
        left = lifted.violation.max(axis=-1)
        cost = length + JUMP_WEIGHT * excess + outside + left
        return Costs(length, cost, (excess == 0.0) & (outside == 0.0) & (left <= 100 * self.retraction.accuracy))

    def latent_points(
        self, phi: Float[np.ndarray, "B p"], ends: Ends, t: Float[np.ndarray, "T"]
    ) -> Float[np.ndarray, "B T N"]:
        """γ_φ(t) in the latent space, eqs. 9-11."""
        arrays = (torch.from_numpy(np.asarray(x, np.float64)) for x in (phi, ends.z_start, ends.z_goal, t))
        return self.curve.evaluate(*arrays)[0].numpy()

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
        phi = rng.normal(scale=0.1, size=(len(ends), self.curve.dim, self.curve.degree - 1))
        phi[..., 0] += 4.0 * bend  # the first basis function t (1 − t) is 1/4 halfway
        return phi.reshape(len(ends), -1)

    def fingerprint(self) -> str:
        """Of the networks, robot, constraint, data and settings."""
        weights = {name: value.numpy() for name, value in self.chart.vae.state_dict().items()}
        settings = (self.curve, self.nodes, self.retract, self.inclusion_weight, self.retraction)
        chain = self.manifold.robot.chain.arrays
        return str(joblib.hash((weights, chain, vars(self.manifold.constraint), self.joints, settings)))
