"""The paper's way on demonstrations: a VAE of their rows with as many latent dimensions as the
hidden set has, and curves in its latent space that are geodesics of the learned metric (eq. 5),
found by descent or by a policy (eqs. 10 to 15), decoded, with their ends corrected.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from constraint_geodesics.geodesics.gradient import GradientSolver
from constraint_geodesics.geodesics.policy_search import PolicySolver, train_policy
from constraint_geodesics.geodesics.problem import ChartProblem, GeodesicSolver, Samples
from constraint_geodesics.geodesics.solver import geodesics_between
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.learning.lift import corrected
from constraint_geodesics.learning.training import TrainingRun, train_manifold
from constraint_geodesics.params import GeodesicParams, ManifoldParams
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.studies.ablation import MeanManifold
from constraint_geodesics.studies.local_models import Answer

SPACING_RAD, COARSE = 0.02, 65
"""Of a path's rows, and rows that tell how many there must be."""
Answering = Callable[[np.ndarray, np.ndarray], Answer]


class RowLatents:
    """A VAE of rows (n, D) [rad]."""

    def __init__(
        self, robot: SerialRobot, rows: Float[np.ndarray, "n D"], vae: ManifoldParams, scratch: Path
    ) -> None:
        run = TrainingRun(scratch / "vae", _quiet, progress=False)
        self.chart = train_manifold(rows, robot, vae, run).manifold
        curve = PinnedPolynomial(self.chart.dim, 3)
        self._problem = ChartProblem(self.chart, curve, Samples(self.chart.encode(rows)))
        self._scratch = scratch

    def by_descent(self) -> Answering:
        """Geodesics of the metric."""
        return self._by(GradientSolver(), self._problem)

    def without_variance(self) -> Answering:
        """The same without the variance in the metric: nothing keeps a curve where rows are."""
        return self._by(GradientSolver(), replace(self._problem, manifold=MeanManifold(self.chart)))

    def by_policy(self, settings: GeodesicParams, seed: int) -> Answering:
        """Curves of a policy that is trained on this manifold with PPO, between random rows."""
        policy = train_policy(self._problem, settings, seed, self._scratch / "ppo", _quiet)
        return self._by(PolicySolver(policy.mean, settings, seed), self._problem)

    def _by(self, solver: GeodesicSolver, problem: ChartProblem) -> Answering:
        def answer(start: np.ndarray, goal: np.ndarray) -> Answer:
            began = time.perf_counter()
            first, last = self.chart.encode(np.stack([start, goal]))
            (found,) = geodesics_between(solver, problem, first[None], last[None])
            if found.status in ("not_found", "not_connected"):
                return "not_found", None, 1e3 * (time.perf_counter() - began)
            path = self._decoded(found, COARSE, start, goal)
            way = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
            path = self._decoded(found, max(int(way / SPACING_RAD), COARSE), start, goal)
            return "solved", path, 1e3 * (time.perf_counter() - began)

        return answer

    def _decoded(self, found: Any, count: int, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
        t = np.linspace(0.0, 1.0, count)
        return corrected(self.chart.decode(found.points(t)), t, start, goal)


def _quiet(*_: Any) -> None:
    """Nothing is logged of single trainings."""
