"""Descent of curves with steps of their own size: what a search ends with, and its control."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from constraint_geodesics.geodesics.problem import Costs, Ends, GeodesicProblem, Observed, Phi

INFEASIBLE = 1e3
"""Added to the cost of a curve that is not feasible [rad]: more than any curve costs."""
GROWN, CUT, LONGEST_STRIDE = 1.3, 0.4, 1.5
"""Factors of a stride after a better and a worse step, and the longest one: the problem's descent
is about the whole way down.
"""


class Descending(NamedTuple):
    """B curves, what was observed at them, and how much of the descent each takes next."""

    phi: Phi
    now: Observed
    stride: Float[np.ndarray, "B"]

    @property
    def rank(self) -> Float[np.ndarray, "B"]:
        """Costs, with those of all curves that are not feasible behind the others'."""
        return ranks(self.now.costs)


def ranks(costs: Costs) -> Float[np.ndarray, "B"]:
    """Costs, with those of all curves that are not feasible behind the others'."""
    return np.where(costs.feasible, costs.cost, costs.cost + INFEASIBLE)


def beginning(problem: GeodesicProblem, phi: Phi, ends: Ends) -> Descending:
    """Curves before their first step."""
    return Descending(phi, problem.observed(phi, ends), np.ones(len(phi)))


def stepped(problem: GeodesicProblem, curves: Descending, ends: Ends) -> Descending:
    """After one step each along the problem's descent; a curve that it would not make better stays,
    and takes a shorter one next.
    """
    tried = curves.phi + curves.stride[:, None] * curves.now.descent
    found = problem.observed(tried, ends)
    better = ranks(found.costs) < curves.rank
    grown = np.minimum(GROWN * curves.stride, LONGEST_STRIDE)
    return Descending(
        np.where(better[:, None], tried, curves.phi),
        _chosen(better, found, curves.now),
        np.where(better, grown, CUT * curves.stride),
    )


def descended(problem: GeodesicProblem, curves: Descending, ends: Ends, steps: int) -> Descending:
    """After so many steps."""
    for _ in range(steps):
        curves = stepped(problem, curves, ends)
    return curves


def _chosen(better: np.ndarray, new: Observed, old: Observed) -> Observed:
    """The new observation where it is better."""
    costs = (
        np.where(better, getattr(new.costs, name), getattr(old.costs, name))
        for name in ("length", "cost", "feasible")
    )
    descent, features = (
        np.where(better[:, None], getattr(new, name), getattr(old, name))
        for name in ("descent", "features")
    )
    return Observed(Costs(*costs), descent, features)
