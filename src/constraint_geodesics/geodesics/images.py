"""Images of points in charts that repeat: which of them a curve ends at decides its way round."""

from itertools import product

import numpy as np
from jaxtyping import Float

from constraint_geodesics.geometry.manifold import Manifold, PeriodicManifold


def nearest_image(manifold: Manifold, offset: Float[np.ndarray, "m N"]) -> Float[np.ndarray, "m N"]:
    """Offsets in the chart, with every periodic coordinate taken the shorter way round."""
    period = _periods(manifold)
    finite = np.isfinite(period)
    turned = offset.copy()
    turned[:, finite] -= period[finite] * np.round(offset[:, finite] / period[finite])
    return turned


def images_between(
    manifold: Manifold, start: Float[np.ndarray, "B N"], goal: Float[np.ndarray, "B N"]
) -> Float[np.ndarray, "B k N"]:
    """Images of each goal, both ways round every periodic coordinate, the nearest to its start
    first.
    """
    period = _periods(manifold)
    near = start + nearest_image(manifold, goal - start)
    other = np.where(near >= start, -1.0, 1.0) * np.where(np.isfinite(period), period, 0.0)
    choices = product(*([0, 1] if np.isfinite(p) else [0] for p in period))
    goals = np.stack([near + np.array(choice) * other for choice in choices], axis=1)
    return with_goals_bits(goals, goal[:, None])


def with_goals_bits(
    images: Float[np.ndarray, "*#B N"], goal: Float[np.ndarray, "*#B N"]
) -> Float[np.ndarray, "*B N"]:
    """Images of goals; coordinates that are no turn away get the bits of the goal's own."""
    return np.where(np.abs(images - goal) < 1e-9, goal, images)


def _periods(manifold: Manifold) -> Float[np.ndarray, "N"]:
    if isinstance(manifold, PeriodicManifold):
        return np.array(manifold.periods)
    return np.full(manifold.dim, np.inf)
