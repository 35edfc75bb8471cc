"""From a latent curve to joint space: decode, correct the ends, retract every point onto the
constraint.
"""

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
    """Joint curves (*batch, T, D) [rad] and what of the violation the retraction left at each point
    [rad or m].
    """

    joints: Float[np.ndarray, "*batch T D"]
    violation: Float[np.ndarray, "*batch T"]


def lift(
    chart: Chart,
    manifold: ConstraintManifold,
    z: Float[np.ndarray, "*batch T N"],
    t: Float[np.ndarray, "T"],
    start: Float[np.ndarray, "*batch D"],
    goal: Float[np.ndarray, "*batch D"],
    retraction: Retraction | None,
) -> Lifted:
    """Joint curves q(t) = R(μ(z(t)) + (1 − t)(q_start − μ(z(0))) + t (q_goal − μ(z(1)))), with the
    retraction R.

    z runs from t = 0 to t = 1, so both ends are exact; without a retraction R is the identity.
    """
    decoded = chart.decode(z)
    return correct_and_retract(manifold, decoded, t, start, goal, retraction)


def correct_and_retract(
    manifold: ConstraintManifold,
    decoded: Float[np.ndarray, "*batch T D"],
    t: Float[np.ndarray, "T"],
    start: Float[np.ndarray, "*batch D"],
    goal: Float[np.ndarray, "*batch D"],
    retraction: Retraction | None,
) -> Lifted:
    """The part of `lift` after the decoder."""
    time = t[:, None]
    correction = (1 - time) * (start - decoded[..., 0, :])[..., None, :]
    correction += time * (goal - decoded[..., -1, :])[..., None, :]
    joints = decoded + correction
    joints[..., 0, :], joints[..., -1, :] = start, goal
    if retraction is None:
        return Lifted(joints, manifold.violation(joints))
    result = retract(manifold, joints, retraction)
    # an end that satisfies the constraint to within the accuracy is the caller's own, to the bit
    result.joints[..., 0, :], result.joints[..., -1, :] = start, goal
    return Lifted(result.joints, result.violation)


def jump_excess(
    joints: Float[np.ndarray, "*batch T D"], t: Float[np.ndarray, "T"]
) -> Float[np.ndarray, "*batch"]:
    """How far a curve's steps exceed what a continuous one needs [rad]; more than 0 where it
    changes its branch.

    t: rising times of the points, 0 to 1.  Needed is at most four times an even pace from end to
    end, and 0.05 rad.
    """
    steps = np.linalg.norm(np.diff(joints, axis=-2), axis=-1)
    direct = np.linalg.norm(joints[..., -1, :] - joints[..., 0, :], axis=-1)
    allowed = 0.05 + 4.0 * direct[..., None] * np.diff(t)
    return np.maximum(steps - allowed, 0.0).sum(axis=-1)


def densify(joints: Float[np.ndarray, "T D"], spacing: float) -> Float[np.ndarray, "n D"]:
    """Points along the straight lines between the given ones, at most `spacing` [rad] apart; the
    given ones stay.
    """
    pieces = np.ceil(np.linalg.norm(np.diff(joints, axis=0), axis=-1) / spacing).astype(int).clip(1)
    rows = np.repeat(np.arange(len(pieces)), pieces)
    share = (np.arange(len(rows)) - np.repeat(np.cumsum(pieces) - pieces, pieces)) / pieces[rows]
    inner = joints[rows] + share[:, None] * (joints[rows + 1] - joints[rows])
    return np.concatenate([inner, joints[-1:]])


def as_executed(
    manifold: ConstraintManifold, joints: Float[np.ndarray, "T D"], spacing: float
) -> Float[np.ndarray, "n D"]:
    """A path's rows at most about `spacing` [rad] apart, the new ones on the constraint; the given
    ones stay.

    Between its rows an arm moves in straight joint lines, so rows far apart leave the constraint
    however well each of them keeps it.  A jump stays one: what lies between its sides retracts to
    one side or the other.
    """
    if len(joints) < 2:
        return joints
    dense = densify(joints, spacing)
    refined = retract(manifold, dense).joints
    refined[0], refined[-1] = joints[0], joints[-1]
    return refined
