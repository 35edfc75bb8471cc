"""What is demanded of a path, and what was found: the records of the certifier."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np


class CertificationError(ValueError):
    """A question that can't be answered, as opposed to a path that is no good; the message names
    the value.
    """


@dataclass(frozen=True)
class Limits:
    """What is demanded of a path.

    end_tolerance_rad: of each joint at the start and the goal.  max_step_rad: between rows, in
    Euclidean norm.
    violation_tolerance: of the constraint beyond its own tolerance, rad or m, at and between rows.
    acceleration_rad_s2: of each joint, or None for no demand.  pose_tolerance: rad or m, against
    PyBullet's pose.
    Raises CertificationError for a value that is negative, not finite, or zero where it must be
    positive.
    """

    end_tolerance_rad: float = 1e-6
    max_step_rad: float = 0.1
    violation_tolerance: float = 1e-4
    limit_tolerance_rad: float = 1e-9
    acceleration_rad_s2: tuple[float, ...] | None = None
    pose_tolerance: float = 1e-6

    def __post_init__(self) -> None:
        for name in (
            "end_tolerance_rad",
            "violation_tolerance",
            "limit_tolerance_rad",
            "pose_tolerance",
        ):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise CertificationError(f"{name} = {value}: must be finite and not negative")
        if not (np.isfinite(self.max_step_rad) and self.max_step_rad > 0):
            raise CertificationError(
                f"max_step_rad = {self.max_step_rad}: must be finite and positive"
            )
        for value in self.acceleration_rad_s2 or ():
            if not value > 0:
                raise CertificationError(
                    f"acceleration_rad_s2 = {self.acceleration_rad_s2}: each must be positive"
                )


@dataclass(frozen=True)
class Violation:
    """The first promise a path breaks: its kind, the row or segment (a segment has its first row's
    index), by how much.

    value and limit are in the message's unit; both are nan where there is no number to compare.
    """

    kind: str
    row: int | None
    value: float
    limit: float
    message: str


@dataclass(frozen=True)
class Certificate:
    """What was found; a measure is nan where a path is too malformed to have it.

    max_violation: largest excess over the constraint's tolerance among the rows and the worst place
    between them; violation_bound: proven for the whole piecewise linear path, but not beside it,
    where an arm turns into the first line from a start_velocity; both the larger of
    the angles' [rad] and the positions' [m], which also stand separately.  limit_distance_rad: to
    the nearest joint limit, negative outside.  goal_violation: by how much the last row is beyond
    the goal's region [rad or m]; nan where none was asked for.
    clearance_m: what bodies that can meet within the joint limits are proven to keep apart on the
    whole path, at least half of the least distance that they have; nan where it was not looked
    at.  asked_pybullet: how many parts of the path come so close to something that the proof
    rests on PyBullet's distances there; clearance_m is 0 then.  rests_on: what was taken for the
    bodies, and which pairs of them were left out.
    largest_pose_difference: of all links from PyBullet's [rad or m]; nan without PyBullet.
    duration_s: nan without times.  time_s: what certification took, of which collision_time_s for
    collisions.  start_velocity: that the path was certified to go on from at its first row [rad/s];
    None for rest.
    """

    violation: Violation | None
    length_rad: float
    max_step_rad: float
    max_violation: float
    violation_bound: float
    max_violation_rad: float
    violation_bound_rad: float
    max_violation_m: float
    violation_bound_m: float
    limit_distance_rad: float
    goal_violation: float
    clearance_m: float
    asked_pybullet: int
    rests_on: str
    largest_pose_difference: float
    duration_s: float
    time_s: float
    collision_time_s: float
    start_velocity: tuple[float, ...] | None = None

    @property
    def valid(self) -> bool:
        """Whether every promise is kept."""
        return self.violation is None

    def summary(self) -> dict[str, Any]:
        """All of it as JSON takes it; what is not a number is None."""
        broken = None if self.violation is None else _known(self.violation)
        return {"valid": self.valid, **_known(self), "violation": broken}


def _known(record: Violation | Certificate) -> dict[str, Any]:
    """Its fields, None for what is no finite number."""
    fields = vars(record).items()
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in fields}


def blank(violation: Violation | None, began: float) -> Certificate:
    """The certificate of what is no path."""
    nan = float("nan")
    measures = (nan,) * 11
    return Certificate(violation, *measures, 0, "", nan, nan, time.perf_counter() - began, 0.0)


def malformed(kind: str, row: int | None, message: str) -> Violation:
    """A violation without a number to compare."""
    return Violation(kind, row, float("nan"), float("nan"), message)


def real_array(values: Any) -> np.ndarray | None:
    """Real numbers as a float64 array that could be written to, or None: the kernels are compiled
    for no others.
    """
    try:
        table = np.asarray(values)
    except ValueError:  # rows of unequal length
        return None
    return np.require(table, np.float64, ("C", "W")) if table.dtype.kind in "fiu" else None
