"""Curves that trained policies propose on the learned manifold, for any constraint, seen in
training or not.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.geodesics.episodes import episode_settings
from constraint_geodesics.geodesics.problem import LearnedProblem
from constraint_geodesics.geodesics.proposals import MeanPolicy, propose
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.lift import correct_and_retract
from constraint_geodesics.params import GeodesicParams

KEPT = 32
"""Constraints whose problem is kept for the next query."""


class PolicyProposals:
    """The best curve that each policy meets on its way from the straight latent line, feasible ones
    first.
    """

    def __init__(
        self, chart: LearnedManifold, policies: Sequence[MeanPolicy], settings: GeodesicParams
    ) -> None:
        self.chart, self.policies, self.settings = chart, policies, settings
        self._problems: dict[int, tuple[ConstraintManifold, LearnedProblem]] = {}

    @classmethod
    def from_arrays(
        cls,
        manifold: Mapping[str, np.ndarray],
        policies: Mapping[str, np.ndarray],
        settings: GeodesicParams,
    ) -> "PolicyProposals":
        """From a bundle's arrays, the policies' under `seed/name`."""
        seeds = sorted({int(name.split("/")[0]) for name in policies})
        actors = []
        for seed in seeds:
            own = {
                name.split("/")[1]: values
                for name, values in policies.items()
                if int(name.split("/")[0]) == seed
            }
            actors.append(MeanPolicy.from_arrays(own))
        return cls(LearnedManifold.from_arrays(manifold), actors, settings)

    def __call__(
        self,
        manifold: ConstraintManifold,
        start: Float[np.ndarray, "D"],
        goal: Float[np.ndarray, "D"],
        points: int,
    ) -> Float[np.ndarray, "K n D"]:
        """Decoded curves with their ends corrected (eq. 9-11 and `lift`), not yet retracted."""
        problem = self._problem(manifold)
        ends = problem.ends(start[None], goal[None])
        found = propose(problem, self.policies, episode_settings(self.settings), ends)
        order = np.lexsort((found.cost[:, 0], ~found.feasible[:, 0]))
        phi = found.phi[order, 0]
        t = np.linspace(0.0, 1.0, points)
        decoded = self.chart.decode(
            problem.latent_points(phi, ends[np.zeros(len(phi), dtype=int)], t)
        )
        return correct_and_retract(manifold, decoded, t, ends.q_start, ends.q_goal, None).joints

    def _problem(self, manifold: ConstraintManifold) -> LearnedProblem:
        key = id(manifold)
        if key not in self._problems:
            while len(self._problems) >= KEPT:
                self._problems.pop(next(iter(self._problems)))
            curve = PinnedPolynomial(self.chart.dim, self.settings.degree)
            nobody = np.empty((0, manifold.robot.dof))
            problem = LearnedProblem(
                self.chart, manifold, curve, nobody, self.settings.length_degree, True, 0.0
            )
            self._problems[key] = (
                manifold,
                problem,
            )  # the manifold too, so that its id stays its own
        return self._problems[key][1]
