"""The constraint vector C of eq. 6 with tolerances and a reference pose, and its residual in joint
space (eq. 7).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from jaxtyping import Bool, Float

from constraint_geodesics.constraints import kernels
from constraint_geodesics.robot.kinematics import SerialRobot, rotation_from_rpy

AXES = ("x", "y", "z", "roll", "pitch", "yaw")


class ConstraintError(ValueError):
    """A constraint that can't be meant; the message names the entry, its value and what is
    allowed.
    """


@dataclass(frozen=True)
class Pose:
    """A tool pose in the base frame: position (3,) [m] and rotation (3, 3).

    Raises ConstraintError if the numbers are not finite, too few or too many, or the rotation is
    none.
    """

    position: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]

    def __post_init__(self) -> None:
        position, rotation = (
            np.array(values, dtype=np.float64) for values in (self.position, self.rotation)
        )
        if position.shape != (3,) or not np.isfinite(position).all():
            raise ConstraintError(f"position = {self.position}: must be 3 finite numbers [m]")
        if rotation.shape != (3, 3) or not np.isfinite(rotation).all():
            raise ConstraintError(f"rotation has shape {rotation.shape}: must be (3, 3), finite")
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0.0:
            raise ConstraintError(
                f"rotation = {rotation.tolist()}: must be orthonormal and right-handed"
            )
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "rotation", rotation)

    @classmethod
    def from_rpy(cls, position_m: Sequence[float], rpy_rad: Sequence[float]) -> Self:
        """From a position [m] and roll, pitch, yaw [rad] about the fixed axes."""
        return cls(np.asarray(position_m, float), rotation_from_rpy(np.asarray(rpy_rad, float)))


@dataclass(frozen=True)
class Constraint:
    """Which task axes x y z roll pitch yaw are held (eq. 6), how loosely, and relative to which
    pose.

    axes: six entries 0 (free) or 1 (held).  tolerance: six half-widths [m, m, m, rad, rad, rad]; 0
    holds exactly.
    reference: the pose the axes are held at, or None for the pose of the path's start. Held angles
    that share one tolerance form a cone around the reference, so that 10° on roll and pitch is a
    tilt of at most 10°; unequal ones are bounded each by itself.
    """

    axes: tuple[int, ...]
    tolerance: tuple[float, ...] = (0.0,) * 6
    reference: Pose | None = None

    def __post_init__(self) -> None:
        for name, entries in (("axes", self.axes), ("tolerance", self.tolerance)):
            if len(entries) != len(AXES):
                raise ConstraintError(
                    f"{name} has {len(entries)} entries: one is needed for each of {' '.join(AXES)}"
                )
        for axis, held, tolerance in zip(AXES, self.axes, self.tolerance, strict=True):
            if held not in (0, 1):
                raise ConstraintError(f"axes[{axis}] = {held}: must be 0 (free) or 1 (held)")
            if not (np.isfinite(tolerance) and tolerance >= 0):
                raise ConstraintError(
                    f"tolerance[{axis}] = {tolerance}: must be finite and not negative"
                )
            if tolerance and not held:
                raise ConstraintError(
                    f"tolerance[{axis}] = {tolerance}: the axis is free, so it can have none"
                )
        object.__setattr__(self, "axes", tuple(int(x) for x in self.axes))
        object.__setattr__(self, "tolerance", tuple(float(x) for x in self.tolerance))

    @property
    def codim(self) -> int:
        """Number of held axes that leave no freedom: the codimension of the constraint manifold."""
        return sum(
            1
            for held, tolerance in zip(self.axes, self.tolerance, strict=True)
            if held and tolerance == 0
        )

    @property
    def is_free(self) -> bool:
        """Whether no axis is held."""
        return not any(self.axes)

    def relative_to(self, pose: Pose) -> "Constraint":
        """The same constraint held at `pose`."""
        return replace(self, reference=pose)


@dataclass(frozen=True)
class ConstraintManifold:
    """The joint configurations of one robot that satisfy one constraint: {q : ι_C(q) = 0}, eqs.
    7-8.

    Raises ConstraintError if an axis is held but the constraint has no reference yet.
    """

    robot: SerialRobot
    constraint: Constraint

    def __post_init__(self) -> None:
        if self.constraint.reference is None and not self.constraint.is_free:
            raise ConstraintError(
                "the constraint has no reference pose: use constraint.relative_to(start pose)"
            )

    @property
    def codim(self) -> int:
        """Codimension in joint space."""
        return self.constraint.codim

    @property
    def held(self) -> Bool[np.ndarray, "6"]:
        """Which of the six task axes are held."""
        return np.array(self.constraint.axes, dtype=bool)

    @property
    def tolerance(self) -> Float[np.ndarray, "6"]:
        """Half-widths [m, m, m, rad, rad, rad]."""
        return np.array(self.constraint.tolerance)

    def residual(self, q: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "*batch 6"]:
        """C ⊙ x of eq. 7 [m, rad], relative to the reference; zero on free axes, tolerance not yet
        taken off.
        """
        return self.linearise(q)[0]

    def jacobian(self, q: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "*batch 6 D"]:
        """Derivative of the residual to the joints; zero rows on free axes."""
        return self.linearise(q)[1]

    def linearise(
        self, q: Float[np.ndarray, "*batch D"]
    ) -> tuple[Float[np.ndarray, "*batch 6"], Float[np.ndarray, "*batch 6 D"]]:
        """Residual and Jacobian from one pass over the kinematics."""
        flat = np.ascontiguousarray(q, dtype=np.float64).reshape(-1, self.robot.dof)
        residuals, jacobians = np.empty((len(flat), 6)), np.empty((len(flat), 6, self.robot.dof))
        kernels.residual_batch(
            self.robot.chain.arrays, self.held, *self.reference_arrays, flat, residuals, jacobians
        )
        batch = q.shape[:-1]
        return residuals.reshape(*batch, 6), jacobians.reshape(*batch, 6, self.robot.dof)

    def inclusion(self, q: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "*batch 6"]:
        """Inclusion map ι_C of eqs. 7-8 [m, rad]: max(|C ⊙ x| − tolerance, 0), zero exactly where
        satisfied.
        """
        return self._excess(q)[0]

    def violation(self, q: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "*batch"]:
        """Largest excess over the tolerance [rad, or m for a held position]; 0 where the constraint
        holds.
        """
        return self._excess(q)[1]

    def _excess(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        residuals = self.residual(q).reshape(-1, 6)
        excesses, worst = np.empty_like(residuals), np.empty(len(residuals))
        kernels.excess_batch(self.held, self.tolerance, residuals, excesses, worst)
        return np.abs(excesses).reshape(*q.shape[:-1], 6), worst.reshape(q.shape[:-1])

    @property
    def reference_arrays(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
        """Reference position and rotation as the kernels take them."""
        pose = self.constraint.reference
        if pose is None:
            return np.zeros(3), np.eye(3)
        return np.ascontiguousarray(pose.position, float), np.ascontiguousarray(
            pose.rotation, float
        )
