"""Curves that trained policies propose on the learned manifold, for any constraint, seen in
training or not.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.projection import Retraction
from constraint_geodesics.geodesics.episodes import episode_settings
from constraint_geodesics.geodesics.problem import Ends, LearnedProblem
from constraint_geodesics.geodesics.proposals import MeanPolicy, propose
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.lift import Lifted, corrected, retracted
from constraint_geodesics.params import GeodesicParams

KEPT = 32
"""Constraints whose problem is kept for the next query."""


@dataclass(frozen=True)
class LatentCurve:
    """One curve between two ends on the learned manifold (eqs. 9-11) as a curve in joint space.

    phi (p,): its free coefficients.
    """

    problem: LearnedProblem
    ends: Ends
    phi: Float[np.ndarray, "p"]

    @property
    def manifold(self) -> ConstraintManifold:
        """The constraint manifold that it is projected onto."""
        return self.problem.manifold

    def decoded(self, t: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T D"]:
        """Points at times from 0 to 1, both among them, decoded with their ends corrected, not
        projected [rad].
        """
        return self._lifted(t, None).joints[0]

    def at(self, s: Float[np.ndarray, "n"]) -> tuple[Float[np.ndarray, "n D"], float]:
        """Points at any times, projected [rad], and what is left of the violation; the ends are the
        query's, to the bit.
        """
        lifted = self._lifted(np.concatenate([[0.0], s, [1.0]]), Retraction())
        points = lifted.joints[0, 1:-1]
        points[s == 0.0], points[s == 1.0] = self.ends.q_start[0], self.ends.q_goal[0]
        inner = lifted.violation[0, 1:-1][(s > 0.0) & (s < 1.0)]
        return points, float(inner.max(initial=0.0))

    def _lifted(self, t: Float[np.ndarray, "T"], retraction: Retraction | None) -> Lifted:
        decoded = self.problem.chart.decode(
            self.problem.latent_points(self.phi[None], self.ends, t)
        )
        joints = corrected(decoded, t, self.ends.q_start, self.ends.q_goal)
        return retracted(self.manifold, joints, retraction)


class PolicyProposals:
    """The best curve that each policy meets on its way from the straight latent line, feasible ones
    first.
    """

    def __init__(
        self, learned: LearnedManifold, policies: Sequence[MeanPolicy], settings: GeodesicParams
    ) -> None:
        self.learned, self.policies, self.settings = learned, policies, settings
        self._problems: dict[int, LearnedProblem] = {}

    @classmethod
    def from_arrays(
        cls,
        manifold: Mapping[str, np.ndarray],
        policies: Mapping[str, np.ndarray],
        settings: GeodesicParams,
    ) -> "PolicyProposals":
        """From arrays of the networks, the policies' under `seed/name`."""
        by_seed: dict[int, dict[str, np.ndarray]] = {}
        for address, values in policies.items():
            seed, name = address.split("/")
            by_seed.setdefault(int(seed), {})[name] = values
        actors = [MeanPolicy.from_arrays(by_seed[seed]) for seed in sorted(by_seed)]
        return cls(LearnedManifold.from_arrays(manifold), actors, settings)

    def curves(
        self,
        manifold: ConstraintManifold,
        start: Float[np.ndarray, "D"],
        goal: Float[np.ndarray, "D"],
    ) -> list[LatentCurve]:
        """Decoded curves with their ends corrected (eqs. 9-11 and `lift`), as functions of time."""
        problem = self._problem(manifold)
        ends = problem.ends(start[None], goal[None])
        found = propose(problem, self.policies, episode_settings(self.settings), ends)
        order = np.lexsort((found.cost[:, 0], ~found.feasible[:, 0]))
        return [LatentCurve(problem, ends, found.phi[k, 0]) for k in order]

    def _problem(self, manifold: ConstraintManifold) -> LearnedProblem:
        key = id(manifold)  # the problem holds the manifold, so that its id stays its own
        if key not in self._problems:
            while len(self._problems) >= KEPT:
                self._problems.pop(next(iter(self._problems)))
            curve = PinnedPolynomial(self.learned.dim, self.settings.degree)
            nobody, degree = np.empty((0, manifold.robot.dof)), self.settings.length_degree
            self._problems[key] = LearnedProblem(
                self.learned, manifold, curve, nobody, degree, True, 0.0
            )
        return self._problems[key]
