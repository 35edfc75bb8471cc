"""What a constraint is, whatever its kind: a residual in joint space with a tolerance a row (eqs. 6
to 8).

A kind is a subclass in a file of its own here, named like the kind; what proves it between
waypoints stands in the file of the same name in certification/, and its entry of params.yaml in
params.py.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints import kernels
from constraint_geodesics.constraints.kernels import ConstraintArrays, ManifoldArrays, Rows
from constraint_geodesics.params import ConstraintParams
from constraint_geodesics.robot.kinematics import SerialRobot, rotation_from_rpy
from constraint_geodesics.values import are_usable, numbers, shown

AXES = ("x", "y", "z", "roll", "pitch", "yaw")
"""Of a tool's pose, in the base frame."""
CONTEXT = 12
"""Numbers that a policy sees of a constraint."""


class ConstraintError(ValueError):
    """A constraint that makes no sense; the message names the entry, its value and what is
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
        position = _three(self.position, "position", "m")
        rotation = numbers(self.rotation)
        if rotation is None or rotation.shape != (3, 3) or not are_usable(rotation):
            raise ConstraintError(
                f"rotation = {shown(self.rotation)}: must be (3, 3) finite numbers"
            )
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0.0:
            raise ConstraintError(
                f"rotation = {rotation.tolist()}: must be orthonormal and right-handed"
            )
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "rotation", rotation)

    @classmethod
    def from_rpy(cls, position_m: Any, rpy_rad: Any) -> "Pose":
        """From a position [m] and roll, pitch, yaw [rad] about the fixed axes."""
        position = _three(position_m, "position_m", "m")
        return cls(position, rotation_from_rpy(_three(rpy_rad, "rpy_rad", "rad")))

    @classmethod
    def from_quaternion(cls, position_m: Any, xyzw: Any) -> "Pose":
        """From a position [m] and a quaternion x, y, z, w, as ROS has it, of any length but 0."""
        found = numbers(xyzw)
        if found is None or found.shape != (4,) or not are_usable(found) or not found.any():
            raise ConstraintError(f"xyzw = {shown(xyzw)}: must be 4 finite numbers, not all 0")
        x, y, z, w = found / np.linalg.norm(found)
        rotation = np.array(
            [
                [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
                [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
                [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
            ]
        )
        return cls(_three(position_m, "position_m", "m"), rotation)


def _three(values: Any, name: str, unit: str) -> Float[np.ndarray, "3"]:
    found = numbers(values)
    if found is None or found.shape != (3,) or not are_usable(found):
        raise ConstraintError(f"{name} = {shown(values)}: must be 3 finite numbers [{unit}]")
    return found


class Series(NamedTuple):
    """One line of a drawing: what of a constraint is bounded, along a path, and its bound."""

    name: str
    unit: str
    values: Float[np.ndarray, "n"]
    limit: float


class Bounded(Protocol):
    """What is demanded of one row: |r| ≤ tolerance, in "m" or "rad"."""

    @property
    def name(self) -> str:
        """In words."""
        ...

    @property
    def unit(self) -> str:
        """Of the residual."""
        ...

    @property
    def tolerance(self) -> float:
        """0 holds exactly."""
        ...


_DRAWN = {"m": ("mm", 1e3), "rad": ("deg", 180.0 / math.pi)}


def each_held(bounds: Sequence[Bounded]) -> Rows:
    """Rows that are all held, each by itself."""
    tolerance = np.array([bound.tolerance for bound in bounds])
    return Rows(np.ones(len(bounds), bool), tolerance, np.zeros(len(bounds), bool))


def each_drawn(bounds: Sequence[Bounded], residual: Float[np.ndarray, "n m"]) -> list[Series]:
    """Rows drawn each by itself, in mm or degrees."""
    found = []
    for bound, values in zip(bounds, residual.T, strict=True):
        unit, scale = _DRAWN[bound.unit]
        found.append(Series(bound.name, unit, scale * abs(values), scale * bound.tolerance))
    return found


def left_out_words(units: Sequence[str], left_out: Sequence[float]) -> str:
    """The largest rms by which rows were missed on demonstrations left out; empty without any."""
    most = {"m": 0.0, "rad": 0.0}
    for unit, off in zip(units, left_out, strict=False):
        most[unit] = max(most[unit], off)
    parts = [f"{1e3 * most['m']:.2g} mm"] * (most["m"] > 0.0)
    parts += [f"{np.degrees(most['rad']):.2g}°"] * (most["rad"] > 0.0)
    return f"which demonstrations left out miss by {' and '.join(parts)}" if parts else ""


class Constraint:
    """The base of all kinds.  `Constraint(axes=…, tolerance=…, reference=…)` builds the first of
    them, `constraints.pose.PoseConstraint`, which holds axes of the tool's pose.
    """

    kind: ClassVar[str]
    """Its name in params.yaml and JSON, and that of its file here and in certification/."""

    def __new__(cls, *args: Any, **values: Any) -> "Constraint":
        """A pose constraint where no kind is named."""
        return object.__new__(kind_named("pose") if cls is Constraint else cls)

    @property
    def rows(self) -> Rows:
        """Which rows of the residual are held, how loosely, and which of them together."""
        raise NotImplementedError

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each row: "m" or "rad"."""
        raise NotImplementedError

    def arrays(self, robot: SerialRobot) -> ConstraintArrays:
        """What the compiled search takes: its `ConstraintArrays` for this robot."""
        raise NotImplementedError

    def compile(self) -> None:
        """Compile functions of its own, so that no query waits; nothing for a kind without any."""

    @property
    def codim(self) -> int:
        """Number of rows that leave no freedom: the codimension of the constraint manifold."""
        return len(self.rows.exact)

    @property
    def is_free(self) -> bool:
        """Whether nothing is held."""
        return not bool(self.rows.held.any())

    @property
    def is_placed(self) -> bool:
        """Whether it says by itself which configurations it allows; else `relative_to` a pose."""
        return True

    def relative_to(self, pose: Pose) -> "Constraint":
        """The same constraint held at `pose`, for the kinds that have a reference."""
        return self

    @property
    def reference(self) -> Pose | None:
        """The pose that it is held at, for the kinds that have one."""
        return None

    def apart_from(self, other: "Constraint") -> "tuple[Constraint, Constraint]":
        """It and another without rows that both would hold, for the kinds that can tell."""
        return self, other

    def loosened(self, least: Mapping[str, float]) -> "Constraint":
        """The same with every tolerance at least that of its row's unit: {"m": …, "rad": …}."""
        raise NotImplementedError

    @property
    def label(self) -> str:
        """A few words that describe it in a sentence."""
        raise NotImplementedError

    @property
    def caveat(self) -> str:
        """What a certificate against it leaves open: how far demonstrations that were left out are
        from it; empty where it was given.
        """
        return ""

    @property
    def context(self) -> Float[np.ndarray, "12"]:
        """CONTEXT numbers of order 1 that a policy sees; zeros for kinds that it never saw."""
        return np.zeros(CONTEXT)

    @property
    def level_axis(self) -> Float[np.ndarray, "3"] | None:
        """The direction in the tool's frame that is held upright; None where none is."""
        return None

    @property
    def key(self) -> tuple:
        """Hashable, the same for constraints that allow the same configurations."""
        raise NotImplementedError

    def amount(self, excess: Float[np.ndarray, "m"]) -> str:
        """The excesses of one configuration in the units people use."""
        units = np.array(self.units)
        metres = float(np.max(excess, where=units == "m", initial=0.0))
        angle = float(np.linalg.norm(excess[units == "rad"]))
        parts = [f"{1e3 * metres:.3g} mm"] * (metres > 0.0)
        return " and ".join(parts + [f"{np.degrees(angle):.3g}°"] * (angle > 0.0))

    def series(self, residual: Float[np.ndarray, "n m"]) -> list[Series]:
        """What is drawn of the residuals along a path, in mm and degrees."""
        raise NotImplementedError

    def to_json(self) -> dict[str, Any]:
        """As JSON takes it; `constraint_from_json` reads it.

        Raises ConstraintError if it can't be written.
        """
        raise NotImplementedError

    @classmethod
    def from_json(cls, about: Mapping[str, Any], robot: SerialRobot | None) -> "Constraint":
        """What `to_json` wrote.  Raises ConstraintError, KeyError or TypeError if it did not."""
        raise NotImplementedError

    @classmethod
    def from_params(cls, params: Any, robot: SerialRobot) -> "Constraint":
        """The one that an entry of params.yaml describes."""
        raise NotImplementedError


def kind_named(kind: str) -> type[Constraint]:
    """The class of a kind, from the file of its name."""
    if not isinstance(kind, str) or not kind.isidentifier():
        raise ConstraintError(f"kind = {kind!r}: there is no such kind of constraint")
    try:
        found: type[Constraint] = import_module(f"constraint_geodesics.constraints.{kind}").KIND
    except (ModuleNotFoundError, AttributeError):
        raise ConstraintError(f"kind = {kind!r}: there is no such kind of constraint") from None
    return found


def constraint_from(params: ConstraintParams, robot: SerialRobot) -> Constraint:
    """The constraint that one entry of params.yaml describes."""
    return kind_named(params.kind).from_params(params, robot)


def constraint_from_json(about: Mapping[str, Any], robot: SerialRobot | None = None) -> Constraint:
    """The constraint that `Constraint.to_json` wrote; robot: for the kinds that need one.

    Raises ConstraintError if it is none.
    """
    if not isinstance(about, Mapping):
        raise ConstraintError(f"{shown(about)}: no constraint: must be entries by name")
    kind = kind_named(about.get("kind", "pose"))
    try:
        return kind.from_json(about, robot)
    except ConstraintError:
        raise
    except KeyError as error:
        raise ConstraintError(f"{kind.kind}: {error} is missing") from None
    except (AttributeError, IndexError, OverflowError, TypeError, ValueError) as error:
        raise ConstraintError(f"{kind.kind}: {' '.join(str(error).split())}") from None


@dataclass(frozen=True)
class ConstraintManifold:
    """The joint configurations of one robot that satisfy one constraint: {q : ι_C(q) = 0}, eqs.
    7-8.

    Raises ConstraintError if the constraint still lacks its reference.
    """

    robot: SerialRobot
    constraint: Constraint

    def __post_init__(self) -> None:
        if not self.constraint.is_placed:
            raise ConstraintError(
                "the constraint has no reference pose: use constraint.relative_to(start pose)"
            )

    def __getstate__(self) -> dict[str, Any]:
        """Without the arrays: they hold addresses, which another process has not."""
        return {"robot": self.robot, "constraint": self.constraint}

    @property
    def codim(self) -> int:
        """Codimension in joint space."""
        return self.constraint.codim

    @cached_property
    def rows(self) -> Rows:
        """How the m rows of the residual are bounded."""
        return self.constraint.rows

    @cached_property
    def arrays(self) -> ManifoldArrays:
        """For the kernels."""
        return ManifoldArrays(self.robot.chain, self.constraint.arrays(self.robot))

    def residual(self, q: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "*batch m"]:
        """C ⊙ x of eq. 7 in each row's unit; zero where nothing is held, tolerance not yet taken
        off.
        """
        return self.linearise(q)[0]

    def jacobian(self, q: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "*batch m D"]:
        """Derivative of the residual to the joints; zero rows where nothing is held."""
        return self.linearise(q)[1]

    def linearise(
        self, q: Float[np.ndarray, "*batch D"]
    ) -> tuple[Float[np.ndarray, "*batch m"], Float[np.ndarray, "*batch m D"]]:
        """Residual and Jacobian from one pass over the kinematics."""
        dof, count = self.robot.dof, len(self.rows.held)
        flat = np.require(q, np.float64, ("C", "W")).reshape(-1, dof)
        residuals, jacobians = np.empty((len(flat), count)), np.empty((len(flat), count, dof))
        kernels.residual_batch(self.arrays, flat, residuals, jacobians)
        batch = q.shape[:-1]
        return residuals.reshape(*batch, count), jacobians.reshape(*batch, count, dof)

    def inclusion(self, q: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "*batch m"]:
        """Inclusion map ι_C of eqs. 7-8, in each row's unit: max(|C ⊙ x| − tolerance, 0), zero
        exactly where satisfied.
        """
        count = len(self.rows.held)
        residuals = self.residual(q).reshape(-1, count)
        excesses, worst = np.empty_like(residuals), np.empty(len(residuals))
        kernels.excess_batch(self.rows, residuals, excesses, worst)
        return np.abs(excesses).reshape(*q.shape[:-1], count)

    def violation(self, q: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "*batch"]:
        """Largest excess over the tolerance [rad or m]; 0 where the constraint holds."""
        flat = np.require(q, np.float64, ("C", "W")).reshape(-1, self.robot.dof)
        worst = np.empty(len(flat))
        kernels.violation_batch(self.arrays, flat, worst)
        return worst.reshape(q.shape[:-1])

    def amount(self, q: Float[np.ndarray, "D"]) -> str:
        """Excess of one configuration in the units people use."""
        return self.constraint.amount(self.inclusion(q))


def constraint_manifold(robot: SerialRobot, params: ConstraintParams) -> ConstraintManifold:
    """The constraint manifold of a robot that one entry of params.yaml describes."""
    return ConstraintManifold(robot, constraint_from(params, robot))
