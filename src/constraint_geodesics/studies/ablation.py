"""What choices are worth: the printed reward, curve families, the metric's variance term."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from constraint_geodesics.benchmark.judge import Free
from constraint_geodesics.geodesics.gradient import GradientSolver
from constraint_geodesics.geodesics.problem import ChartProblem, Ends, Geodesic, Samples
from constraint_geodesics.geodesics.solver import geodesics_between
from constraint_geodesics.geometry.curves import CurveFamily
from constraint_geodesics.geometry.manifold import pullback_metric
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.params import GeodesicParams
from constraint_geodesics.studies.geodesic_search import (
    analytic_problem,
    curve_family,
    unseen_pairs,
)

PAIRS_SEED = 21
POINTS = 101
"""Points of a geodesic that are decoded and checked for collision."""
COARSE, DRAWN_AT_ONCE, MOST_DRAWN = 17, 500, 10_000
"""Search for pairs whose straight line collides: points of a line, pairs drawn at once and at most.
"""


def policy_variants(params: GeodesicParams) -> dict[str, tuple[CurveFamily, GeodesicParams]]:
    """Curve family and parameters of each ablated policy search on the analytic manifolds."""
    reward = params.reward.model_copy(update={"form": "printed"})
    families = {name: curve_family(2, params, n) for name, n in _segments(params).items()}
    own = families.pop("polynomial"), params.model_copy(update={"reward": reward})
    return {"printed_reward": own} | {name: (family, params) for name, family in families.items()}


def _segments(params: GeodesicParams) -> dict[str, int]:
    """Name of each curve family compared, and its segments (0: the polynomial)."""
    return {"polynomial": 0} | {f"spline_{n}": n for n in params.ablated_segments}


def family_ratios(name: str, params: GeodesicParams) -> dict[str, float]:
    """Mean ratio to the exact distance of each family's best curve, as the gradient finds it."""
    ratios = {}
    for label, segments in _segments(params).items():
        problem = analytic_problem(name, curve_family(2, params, segments))
        ends, exact = unseen_pairs(name, problem)
        found = geodesics_between(GradientSolver(), problem, ends.z_start, ends.z_goal)
        ratios[label] = float(np.mean([geodesic.length for geodesic in found] / exact))
    return ratios


@dataclass(frozen=True)
class MeanManifold:
    """A learned manifold without the variance term of eq. 5: M = JμᵀJμ."""

    chart: LearnedManifold

    @property
    def dim(self) -> int:
        """Latent dimension N."""
        return self.chart.dim

    @property
    def ambient_dim(self) -> int:
        """D joints."""
        return self.chart.vae.dof

    def embed(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch D"]:
        """Decoder mean μ(z) [rad]."""
        return self.chart.vae.mean(z.to(self.chart.vae.centre.dtype))

    def metric(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch N N"]:
        """JμᵀJμ."""
        return pullback_metric(self.embed, z)


@dataclass(frozen=True)
class LearnedAblation:
    """Geodesics between pairs of training configurations, with one choice changed at a time."""

    chart: LearnedManifold
    joints: Float[np.ndarray, "n D"]
    params: GeodesicParams
    pairs: int
    free: Free

    def figures(self) -> dict[str, dict[str, float]]:
        """Curve families between random pairs; the variance term where straight lines collide."""
        domain, rng = Samples(self.chart.encode(self.joints)), np.random.default_rng(PAIRS_SEED)
        return self._families(domain, rng) | self._variance(domain, rng)

    def variance(self) -> dict[str, dict[str, float]]:
        """The second part alone."""
        domain = Samples(self.chart.encode(self.joints))
        return self._variance(domain, np.random.default_rng(PAIRS_SEED))

    def _families(self, domain: Samples, rng: np.random.Generator) -> dict[str, dict[str, float]]:
        """Length of the best curve of each family over the shortest of all."""
        families = _segments(self.params)
        problems = [self._problem(segments, domain) for segments in families.values()]
        ends = problems[0].sample_ends(self.pairs, rng)
        lengths = np.array([[g.length for g in self._solved(each, ends)] for each in problems])
        ratios = (lengths / lengths.min(axis=0)).mean(axis=1).tolist()
        return {
            name: {"mean_ratio_to_best": ratio}
            for name, ratio in zip(families, ratios, strict=True)
        }

    def _variance(self, domain: Samples, rng: np.random.Generator) -> dict[str, dict[str, float]]:
        """`path_figures` of geodesics with and without the variance term, and of the straight line.

        Between pairs whose straight latent line touches something; between most others there is
        nothing to avoid.
        """
        whole = self._problem(0, domain)
        mean = ChartProblem(MeanManifold(self.chart), whole.curve, domain)
        ends, collide = self._colliding(whole, rng)
        straight = [
            Geodesic.nothing("not_found", whole.curve, *pair) for pair in zip(*ends, strict=True)
        ]
        found = {
            "with_variance": self._solved(whole, Ends(*ends, *ends)),
            "without_variance": self._solved(mean, Ends(*ends, *ends)),
            "straight_latent_line": straight,
        }
        count = float(len(straight))
        counts = {"pairs": count, "straight_lines_that_collide": collide}
        return {
            name: path_figures(self.chart, self._points(curves), self.free) | counts
            for name, curves in found.items()
        }

    def _colliding(
        self, problem: ChartProblem, rng: np.random.Generator
    ) -> tuple[tuple[Float[np.ndarray, "P N"], Float[np.ndarray, "P N"]], float]:
        """Pairs of free ends whose straight latent line touches something, and the share of these
        of all pairs of free ends that were drawn.
        """
        starts, goals, drawn, asked, found = [], [], 0, 0, 0
        t = np.linspace(0.0, 1.0, COARSE)[:, None]
        while found < self.pairs and drawn < MOST_DRAWN:
            ends = problem.sample_ends(DRAWN_AT_ONCE, rng)
            line = (1 - t) * ends.z_start[:, None] + t * ends.z_goal[:, None]
            joints = self.chart.decode(line)
            untouched = self.free(joints.reshape(-1, joints.shape[-1])).reshape(joints.shape[:2])
            between = untouched[:, 0] & untouched[:, -1]
            rows = between & ~untouched.all(axis=1)
            starts.append(ends.z_start[rows])
            goals.append(ends.z_goal[rows])
            drawn, asked = drawn + len(ends), asked + int(between.sum())
            found += int(rows.sum())
        pairs = np.concatenate(starts)[: self.pairs], np.concatenate(goals)[: self.pairs]
        return pairs, found / max(asked, 1)

    def _problem(self, segments: int, domain: Samples) -> ChartProblem:
        return ChartProblem(self.chart, curve_family(self.chart.dim, self.params, segments), domain)

    def _solved(self, problem: ChartProblem, ends: Ends) -> list[Geodesic]:
        if not len(ends):
            return []
        return geodesics_between(GradientSolver(starts=1), problem, ends.z_start, ends.z_goal)

    def _points(self, curves: list[Geodesic]) -> Float[np.ndarray, "P T N"]:
        t = np.linspace(0.0, 1.0, POINTS)
        return np.array([curve.points(t) for curve in curves]).reshape(-1, POINTS, self.chart.dim)


def path_figures(
    chart: LearnedManifold, z: Float[np.ndarray, "P T N"], free: Free
) -> dict[str, float]:
    """What decoded latent curves are like; all nan where there is none.

    length_rad: of the decoded joints, mean.  deviation_rad: largest norm of σ along a curve, mean;
    it rises where no data is.  collision_free: share of curves that touch nothing.
    collision_free_points: share of configurations.
    """
    if not len(z):
        return dict.fromkeys(
            ("length_rad", "deviation_rad", "collision_free", "collision_free_points"), np.nan
        )
    embedded = chart.embed_points(z).astype(np.float64)
    dof = chart.vae.dof
    joints, deviation = embedded[..., :dof], embedded[..., dof:]
    untouched = free(joints.reshape(-1, dof)).reshape(joints.shape[:2])
    return {
        "length_rad": float(np.linalg.norm(np.diff(joints, axis=1), axis=-1).sum(axis=1).mean()),
        "deviation_rad": float(np.linalg.norm(deviation, axis=-1).max(axis=1).mean()),
        "collision_free": float(untouched.all(axis=1).mean()),
        "collision_free_points": float(untouched.mean()),
    }


def by_variant(ratios: Mapping[str, list[float]], families: Mapping[str, float]) -> dict[str, Any]:
    """The metrics file of one analytic manifold's ablation."""
    policy = {name: {"mean_ratio": values} for name, values in ratios.items()}
    return {
        "policy_search": policy,
        "gradient": {name: {"mean_ratio": ratio} for name, ratio in families.items()},
    }
