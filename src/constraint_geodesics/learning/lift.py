"""From a decoded latent curve to a joint path: the ends corrected, every point retracted."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.projection import Retraction, retract


class Chart(Protocol):
    """Latent coordinates of joint configurations: what this layer needs of a learned manifold."""

    @property
    def dim(self) -> int:
        """Latent dimension N."""
        ...

    def encode(self, q: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "*batch N"]:
        """Latent coordinates of configurations [rad]."""
        ...

    def decode(self, z: Float[np.ndarray, "*batch N"]) -> Float[np.ndarray, "*batch D"]:
        """Configurations [rad] at latent coordinates."""
        ...


@dataclass(frozen=True)
class Lifted:
    """Joint curves [rad] and the violation [rad or m] that is left at each of their points."""

    joints: Float[np.ndarray, "*batch T D"]
    violation: Float[np.ndarray, "*batch T"]


def corrected(
    decoded: Float[np.ndarray, "*batch T D"],
    t: Float[np.ndarray, "T"],
    start: Float[np.ndarray, "*batch D"],
    goal: Float[np.ndarray, "*batch D"],
) -> Float[np.ndarray, "*batch T D"]:
    """Decoded curves μ(t) moved to their ends: μ(t) + (1 − t)(start − μ(0)) + t (goal − μ(1)).

    t runs from 0 to 1; both ends are exact.
    """
    time = t[:, None]
    correction = (1 - time) * (start - decoded[..., 0, :])[..., None, :]
    correction += time * (goal - decoded[..., -1, :])[..., None, :]
    joints = decoded + correction
    joints[..., 0, :], joints[..., -1, :] = start, goal
    return joints


def retracted(
    manifold: ConstraintManifold,
    joints: Float[np.ndarray, "*batch T D"],
    retraction: Retraction | None,
) -> Lifted:
    """Curves with every point but the ends retracted onto the constraint; as they are for None."""
    if retraction is None:
        return Lifted(joints, manifold.violation(joints))
    result = retract(manifold, joints, retraction)
    # an end that satisfies the constraint to within the accuracy is the caller's own, to the bit
    result.joints[..., [0, -1], :] = joints[..., [0, -1], :]
    return Lifted(result.joints, result.violation)


def allowed_steps(
    joints: Float[np.ndarray, "*batch T D"], t: Float[np.ndarray, "T"]
) -> Float[np.ndarray, "*batch T-1"]:
    """Longest steps [rad] of curves that do not jump: four times an even pace, and 0.05 rad.

    t: rising times of the points, 0 to 1.
    """
    direct = np.linalg.norm(joints[..., -1, :] - joints[..., 0, :], axis=-1)
    return 0.05 + 4.0 * direct[..., None] * np.diff(t)


def jump_excess(
    joints: Float[np.ndarray, "*batch T D"], t: Float[np.ndarray, "T"]
) -> Float[np.ndarray, "*batch"]:
    """How far a curve's steps exceed the allowed ones [rad]; above 0 where it changes branch."""
    steps = np.linalg.norm(np.diff(joints, axis=-2), axis=-1)
    return np.maximum(steps - allowed_steps(joints, t), 0.0).sum(axis=-1)


FIRST_POINTS = 65
"""Points of a curve that are looked at first."""
FINEST = 1e-6
"""Times that lie closer together are not parted: what is far apart there is a jump."""
MOST_POINTS = 4000


def closely(
    at: Callable[[Float[np.ndarray, "n"]], Float[np.ndarray, "n D"]], longest: float
) -> tuple[Float[np.ndarray, "T"], Float[np.ndarray, "T D"]]:
    """Times from 0 to 1 and a curve's points there [rad], no further apart than `longest` unless
    the curve jumps.

    Where a curve on a constraint passes close by a singular configuration it is steep: points are
    added there alone.
    """
    times = np.linspace(0.0, 1.0, FIRST_POINTS)
    points = at(times)
    while len(times) < MOST_POINTS:
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        wide = np.flatnonzero((steps > longest) & (np.diff(times) > FINEST))
        if not len(wide):
            break
        pieces = np.ceil(np.minimum(steps[wide] / longest, 8.0)).astype(int)
        places = np.repeat(wide, pieces - 1)
        share = np.concatenate([np.arange(1, n) / n for n in pieces])
        added = times[places] + share * (times[places + 1] - times[places])
        times = np.insert(times, places + 1, added)
        points = np.insert(points, places + 1, at(added), axis=0)
    return times, points


def densify(joints: Float[np.ndarray, "T D"], spacing: float) -> Float[np.ndarray, "n D"]:
    """The given points, and more on the lines between, at most `spacing` [rad] apart."""
    pieces = np.ceil(np.linalg.norm(np.diff(joints, axis=0), axis=-1) / spacing).astype(int).clip(1)
    rows = np.repeat(np.arange(len(pieces)), pieces)
    share = (np.arange(len(rows)) - np.repeat(np.cumsum(pieces) - pieces, pieces)) / pieces[rows]
    inner = joints[rows] + share[:, None] * (joints[rows + 1] - joints[rows])
    return np.concatenate([inner, joints[-1:]])


def as_executed(
    manifold: ConstraintManifold, joints: Float[np.ndarray, "T D"], spacing: float
) -> Float[np.ndarray, "n D"]:
    """Waypoints at most about `spacing` [rad] apart, the new ones on the constraint.

    Between waypoints an arm moves in straight joint lines, which leave the constraint where they
    are long.  A jump stays one: what lies between its sides retracts to one or the other.
    """
    if len(joints) < 2:
        return joints
    dense = densify(joints, spacing)
    refined = retract(manifold, dense).joints
    refined[0], refined[-1] = joints[0], joints[-1]
    return refined
