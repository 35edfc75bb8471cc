"""Policy search on manifolds whose distances are known: Fig. 3, and a check of the search against
exact answers.
"""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from constraint_geodesics.geodesics.environment import begin
from constraint_geodesics.geodesics.episodes import episode_settings
from constraint_geodesics.geodesics.policy_search import TrainedPolicy, follow, train_policy
from constraint_geodesics.geodesics.problem import Box, ChartProblem, Ends, repeated
from constraint_geodesics.geometry.analytic import Plane, Sphere, Torus
from constraint_geodesics.geometry.curves import CurveFamily, PinnedPolynomial, PinnedSpline
from constraint_geodesics.geometry.manifold import MeasuredManifold
from constraint_geodesics.params import GeodesicParams
from constraint_geodesics.studies.geodesic_search import SeedLog

PAIRS = 100
PAIRS_SEED = 11
DRAWN_ROLLOUTS = 12
DRAWN = 65
"""Points of a drawn curve."""


@dataclass(frozen=True)
class Member:
    """A manifold with a known answer, the box of its chart that ends are drawn from, and what the
    box is, in words.
    """

    manifold: MeasuredManifold
    box: Box
    domain: str


MANIFOLDS = {
    "plane": Member(Plane(), Box((-1.5, -1.5), (1.5, 1.5)), "|x|, |y| ≤ 1.5"),
    "sphere": Member(
        Sphere(), Box((-1.2, -1.4), (1.2, 1.4)), "|elevation| ≤ 1.2 rad, |azimuth| ≤ 1.4 rad"
    ),
    "torus": Member(
        Torus(),
        Box((-1.2, -1.2), (1.2, 1.2)),
        "R = 2, r = 1, |ring angle| ≤ 1.2 rad, |tube angle| ≤ 1.2 rad",
    ),
}


@dataclass(frozen=True)
class AnalyticTask:
    """One seed on one analytic manifold, with one curve family."""

    name: str
    curve: CurveFamily
    params: GeodesicParams
    seed: int
    scratch: Path
    run: AbstractContextManager[SeedLog]


@dataclass(frozen=True)
class AnalyticResult:
    """Length over exact distance for unseen pairs, of the first random curve and of the shortest
    one the policy's mean meets from there, and curves to draw.

    sampled: (n, T, 2) curves met while the policy searched the first pair; learned: (T, 2) the one
    it ended with.
    """

    seed: int
    policy: TrainedPolicy
    first_ratio: Float[np.ndarray, "P"]
    ratio: Float[np.ndarray, "P"]
    sampled: Float[np.ndarray, "n T 2"]
    learned: Float[np.ndarray, "T 2"]

    def figures(self) -> dict[str, float]:
        """What is compared between seeds."""
        return {
            "mean_ratio": float(self.ratio.mean()),
            "p95_ratio": float(np.quantile(self.ratio, 0.95)),
            "first_mean_ratio": float(self.first_ratio.mean()),
        }


def curve_family(dim: int, params: GeodesicParams, segments: int = 0) -> CurveFamily:
    """The polynomials that params.yaml names, or C² splines of some segments."""
    return PinnedSpline(dim, segments) if segments else PinnedPolynomial(dim, params.degree)


def analytic_problem(name: str, curve: CurveFamily) -> ChartProblem:
    """Geodesics on an analytic manifold by name."""
    member = MANIFOLDS[name]
    return ChartProblem(member.manifold, curve, member.box)


def unseen_pairs(name: str, problem: ChartProblem) -> tuple[Ends, Float[np.ndarray, "P"]]:
    """The pairs that every solver is compared on, and their exact distances."""
    ends = problem.sample_ends(PAIRS, np.random.default_rng(PAIRS_SEED))
    start, goal = torch.from_numpy(ends.z_start), torch.from_numpy(ends.z_goal)
    return ends, MANIFOLDS[name].manifold.distance(start, goal).numpy()


def run_analytic(task: AnalyticTask) -> AnalyticResult:
    """Train a policy, then follow its mean on unseen pairs from curves that are anything but
    straight.

    The straight line is no start here: in the plane it is the answer.
    """
    problem = analytic_problem(task.name, task.curve)
    with task.run as run:
        policy = train_policy(problem, task.params, task.seed, task.scratch, run.log)
    ends, exact = unseen_pairs(task.name, problem)
    rng = np.random.default_rng(PAIRS_SEED + 1)
    settings, size = episode_settings(task.params), problem.curve.coefficients
    first = begin(problem, ends, problem.sample_curves(ends, rng))
    visited = follow(
        problem, policy.actor, settings, first, np.zeros((task.params.episode_steps, PAIRS, size))
    )
    lengths = np.array([states.length for states in visited])
    best = visited[int(lengths[:, 0].argmin())].phi[:1]
    return AnalyticResult(
        task.seed,
        policy,
        lengths[0] / exact,
        lengths.min(axis=0) / exact,
        _sampled(problem, policy, task, ends, rng),
        _points(problem, best, ends)[0],
    )


def _sampled(
    problem: ChartProblem,
    policy: TrainedPolicy,
    task: AnalyticTask,
    ends: Ends,
    rng: np.random.Generator,
) -> Float[np.ndarray, "n T 2"]:
    """Curves that sampled roll-outs between the first pair of ends meet."""
    size = problem.curve.coefficients
    pair = repeated(ends, DRAWN_ROLLOUTS)
    first = begin(problem, pair, problem.sample_curves(pair, rng))
    noise = rng.normal(size=(task.params.episode_steps, DRAWN_ROLLOUTS, size))
    visited = follow(problem, policy.actor, episode_settings(task.params), first, noise)
    return np.concatenate([_points(problem, states.phi, ends) for states in visited])


def _points(
    problem: ChartProblem, phi: Float[np.ndarray, "n p"], ends: Ends
) -> Float[np.ndarray, "n T 2"]:
    """Points of curves between the first pair of ends."""
    t = torch.linspace(0.0, 1.0, DRAWN, dtype=torch.float64)
    free, start, goal = (torch.from_numpy(x) for x in (phi, ends.z_start[:1], ends.z_goal[:1]))
    return problem.curve.evaluate(free, start, goal, t)[0].numpy()
