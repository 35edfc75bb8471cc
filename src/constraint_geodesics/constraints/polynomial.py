"""Polynomial relations of the tool's pose, or of a joint's place: what demonstrations show, as rows
of a residual.

With y = (p, R e_x, R e_y, R e_z) (12,), the tool's position [m] and the axes of its frame in the
base frame, one row is r = c + wᵀy + ½ yᵀA y.  Planes, spheres, cylinders, arcs and quadrics of the
position, and axes that are level or point at something, are of this form.  Of a joint y = (p, 0),
with the place p of its origin.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float
from numba import carray, int64, njit

from constraint_geodesics.compiled import LEAF
from constraint_geodesics.constraints.constraint import ConstraintError
from constraint_geodesics.constraints.kernels import (
    JOINT_WORDS,
    LINEARISE_WORDS,
    TOOL_WORDS,
    ConstraintArrays,
    c_function,
    chain_at,
    floats,
    lanes_at,
)
from constraint_geodesics.constraints.relations import RelationsConstraint
from constraint_geodesics.constraints.tool_features import FEATURES, into_joints, jacobian_of_origin
from constraint_geodesics.robot.kernels import geometric_jacobian, poses_of, posture_in
from constraint_geodesics.robot.kinematics import SerialRobot

_ROW = 1 + FEATURES + FEATURES * FEATURES
"""Numbers of the data that are one row's: c, w, A."""


@dataclass(frozen=True, eq=False)
class Relation:
    """One row |c + wᵀy + ½ yᵀA y| ≤ tolerance, in metres or radians.

    name: what it is, in words.  unit: "m" or "rad", of the residual to first order.
    Raises ConstraintError for numbers that are not finite, shapes that do not fit, or no name.
    """

    name: str
    unit: str
    constant: float
    linear: Float[np.ndarray, "12"]
    quadratic: Float[np.ndarray, "12 12"] | None = None
    tolerance: float = 0.0

    def __post_init__(self) -> None:
        linear = np.array(self.linear, np.float64)
        full = np.zeros((FEATURES, FEATURES)) if self.quadratic is None else self.quadratic
        full = np.array(full, np.float64)
        if linear.shape != (FEATURES,) or full.shape != (FEATURES, FEATURES):
            raise ConstraintError(
                f"relation {self.name!r}: linear has shape {linear.shape} and quadratic "
                f"{full.shape}: must be (12,) and (12, 12)"
            )
        numbers = np.concatenate([[self.constant, self.tolerance], linear, full.ravel()])
        if not np.isfinite(numbers).all() or self.tolerance < 0.0:
            raise ConstraintError(
                f"relation {self.name!r}: its numbers must be finite, its tolerance not negative"
            )
        if not self.name or self.unit not in ("m", "rad"):
            raise ConstraintError(f"relation {self.name!r}: a name and m or rad are needed")
        object.__setattr__(self, "linear", linear)
        object.__setattr__(self, "quadratic", 0.5 * (full + full.T))

    @property
    def matrix(self) -> Float[np.ndarray, "12 12"]:
        """A, zero where there is none."""
        assert self.quadratic is not None
        return self.quadratic

    @property
    def numbers(self) -> Float[np.ndarray, "n"]:
        """c, w and A, one after another."""
        return np.concatenate([[self.constant], self.linear, self.matrix.ravel()])

    def values(self, y: Float[np.ndarray, "n 12"]) -> Float[np.ndarray, "n"]:
        """The residual of features."""
        return self.constant + y @ self.linear + 0.5 * ((y @ self.matrix) * y).sum(axis=1)

    def gradients(self, y: Float[np.ndarray, "n 12"]) -> Float[np.ndarray, "n 12"]:
        """∂r/∂y = w + A y."""
        return self.linear + y @ self.matrix


@dataclass(frozen=True, eq=False)
class PolynomialConstraint(RelationsConstraint):
    """Relations that all hold.  joint: the joint, counted from 0, whose origin they are of, None
    for the tool.
    """

    kind: ClassVar[str] = "polynomial"
    joint: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.joint is not None and self.joint < 0:
            raise ConstraintError(f"joint = {self.joint}: must be 0 or more")

    def arrays(self, robot: SerialRobot) -> ConstraintArrays:
        """For the kernels."""
        if self.joint is not None and self.joint >= robot.dof:
            raise ConstraintError(f"joint = {self.joint}: the arm has {robot.dof} joints")
        which = -1.0 if self.joint is None else float(self.joint)
        data = np.concatenate([[which], *(own.numbers for own in self.relations)])
        return ConstraintArrays(self.rows, data, _compiled().address, 0, _room(robot.dof))

    def compile(self) -> None:
        """What all of this kind share, once."""
        _compiled()

    @property
    def whose(self) -> str:
        """The tool, or a joint."""
        return super().whose if self.joint is None else f"the place of joint {self.joint + 1}"

    @property
    def key(self) -> tuple:
        """All numbers, to the bit."""
        own = tuple((r.unit, r.tolerance, r.numbers.tobytes()) for r in self.relations)
        return (self.kind, self.joint, own)

    def to_json(self) -> dict[str, Any]:
        """All numbers."""
        relations = [
            {
                "name": own.name,
                "unit": own.unit,
                "constant": own.constant,
                "linear": own.linear.tolist(),
                "quadratic": own.matrix.tolist() if own.matrix.any() else None,
                "tolerance": own.tolerance,
            }
            for own in self.relations
        ]
        return {
            "kind": self.kind,
            "joint": self.joint,
            "relations": relations,
            "left_out": list(self.left_out),
        }

    @classmethod
    def from_json(
        cls, about: Mapping[str, Any], robot: SerialRobot | None
    ) -> "PolynomialConstraint":
        """What `to_json` wrote."""
        relations = tuple(
            Relation(
                str(own["name"]),
                str(own["unit"]),
                float(own["constant"]),
                np.array(own["linear"], float),
                None if own["quadratic"] is None else np.array(own["quadratic"], float),
                float(own["tolerance"]),
            )
            for own in about["relations"]
        )
        joint = about.get("joint")
        joint = None if joint is None else int(joint)
        if joint is not None and robot is not None and joint >= robot.dof:
            raise ConstraintError(f"joint = {joint}: the arm has {robot.dof} joints")
        return cls(relations, tuple(float(x) for x in about["left_out"]), joint)


KIND = PolynomialConstraint


def _room(dof: int) -> int:
    """Numbers for the lanes, y and its gradient, and a Jacobian (6, D)."""
    return TOOL_WORDS + JOINT_WORDS * dof + 2 * FEATURES + 6 * dof


@njit(**LEAF)
def _value_and_gradient(row, y, gradient):
    """The value r of one row's numbers, and ∂r/∂y = w + A y into gradient (12,)."""
    value = row[0]
    for i in range(FEATURES):
        slope = 0.0
        for j in range(FEATURES):
            slope += row[1 + FEATURES + FEATURES * i + j] * y[j]
        value += (row[1 + i] + 0.5 * slope) * y[i]
        gradient[i] = row[1 + i] + slope
    return value


def _write(
    origins, axes, prismatic, base, tool, data, q, room, residuals, jacobians, dof, rows, count
):
    chain, lanes = chain_at(origins, axes, prismatic, base, tool, dof), lanes_at(room, dof)
    rest = room + 8 * (TOOL_WORDS + JOINT_WORDS * dof)
    y, gradient = carray(floats(rest), (FEATURES,)), carray(floats(rest + 96), (FEATURES,))
    geometric = carray(floats(rest + 192), (6, dof))
    values = carray(floats(residuals), (count, rows))
    joint = int64(carray(floats(data), (1,))[0])
    poses_of(chain, carray(floats(q), (count, dof)), lanes)
    for n in range(count):
        posture = posture_in(lanes, n)
        for i in range(3):
            y[i] = posture.position[i] if joint < 0 else posture.origins[joint, i]
            for k in range(3):
                y[3 + 3 * k + i] = posture.rotation[i, k] if joint < 0 else 0.0
        if jacobians != 0 and joint < 0:
            geometric_jacobian(chain.prismatic, posture, geometric)
        elif jacobians != 0:
            jacobian_of_origin(chain.prismatic, posture, joint, geometric)
        for m in range(rows):
            row = carray(floats(data + 8 * (1 + _ROW * m)), (_ROW,))
            values[n, m] = _value_and_gradient(row, y, gradient)
            if jacobians != 0:
                slopes = carray(floats(jacobians + 8 * dof * (rows * n + m)), (dof,))
                into_joints(gradient, y, geometric, slopes)
    return 0


@cache
def _compiled() -> Any:
    return c_function(_write, LINEARISE_WORDS)
