"""Settings of the elastic band: a chain of points on the constraint, shortened by Newton's method
within the joint limits and clear of the workcell and of the arm itself.

The arithmetic is in band_kernels.py, the curve through the points in curve_kernels.py.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.projection import Retraction
from constraint_geodesics.search.space import Space, project_points

ACCURACY = 1e-9
"""Violation [rad or m] that is left on a point of a curve, at most."""
PROJECTION = Retraction(ACCURACY, iterations=12, last_step=1e-5, damping=1e-6)
_AFTER_STEP = PROJECTION._replace(iterations=6, damping=1e-9)
"""The projection of a node after a step of the band."""
PUSHED_M = 0.006
"""Bodies that are nearer are pushed apart, at least [m]."""


@dataclass(frozen=True)
class BandSettings:
    """segments: of the band.  iterations: of Newton's method, at most.  accuracy: relative decrease
    of the energy below which it stops.  largest_step_rad: of one node in one iteration.
    clearance_m: kept to the workcell, and by links to each other.
    """

    segments: int = 16
    iterations: int = 30
    accuracy: float = 1e-5
    largest_step_rad: float = 0.5
    clearance_m: float = 0.006

    def steps(
        self, guarded: bool = False, wider: float = 1.0
    ) -> tuple[int, Retraction, float, float, float, bool]:
        """As `relax_band` takes them.  guarded: no line between two nodes that touches nothing is
        moved into something.  wider: how many times as far what is near is pushed away.
        """
        margin, longest = wider * max(self.clearance_m, PUSHED_M), self.largest_step_rad
        return self.iterations, _AFTER_STEP, self.accuracy, longest, margin, guarded


def step_lengths(points: Float[np.ndarray, "T D"]) -> Float[np.ndarray, "T-1"]:
    """Distances between neighbouring points [rad]; `norm` and `diff` would cost as much again in
    calls.
    """
    return np.sqrt(np.square(points[1:] - points[:-1]).sum(axis=1))


def project(space: Space, points: Float[np.ndarray, "n D"]) -> float:
    """Move points onto the space, in place; returns what is left of the violation [rad or m]."""
    return float(project_points(space, points, np.ones(len(points), bool), PROJECTION))
