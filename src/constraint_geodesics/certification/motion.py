"""The times of a path: whether they rise, and the velocities and accelerations along it."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from constraint_geodesics.certification.certificate import Violation, malformed, real_array

_VELOCITY_SLACK = 1e-9
_ACCELERATION_SLACK = 1e-6


class MotionLimits(NamedTuple):
    """Of each joint [rad/s, rad/s²]; None: not demanded."""

    velocity: Float[np.ndarray, "D"]
    acceleration: tuple[float, ...] | None


def check_times(
    rows: Float[np.ndarray, "T D"], times: Any, limits: MotionLimits
) -> tuple[Iterator[Violation], float]:
    """What is wrong with the times, in the order of the checks, and the duration [s]."""
    if times is None:
        return iter(()), float("nan")
    clock = real_array(times)
    if clock is None or clock.shape != (len(rows),):
        what = "no array of real numbers" if clock is None else f"of shape {clock.shape}"
        text = f"the times are {what}: ({len(rows)},) is needed, one for each row"
        return iter([malformed("times_shape", None, text)]), float("nan")
    return _wrong(rows, clock, limits), float(clock[-1] - clock[0])


def _wrong(rows: np.ndarray, times: np.ndarray, limits: MotionLimits) -> Iterator[Violation]:
    finite = np.isfinite(times)
    if not finite.all():
        row = int(np.argmin(finite))
        text = f"the time of row {row} is {times[row]}: must be finite"
        yield malformed("times_not_finite", row, text)
    if times[0] != 0.0:
        text = f"the times start at {times[0]:.6g} s, not at 0 s"
        yield Violation("times_start", 0, float(times[0]), 0.0, text)
    with np.errstate(all="ignore"):
        dt = np.diff(times)
        if not (dt > 0).all():
            row = int(np.argmax(~(dt > 0)))
            text = (
                f"row {row + 1} is at {times[row + 1]:.9g} s, row {row} at "
                f"{times[row]:.9g} s: times must rise"
            )
            yield Violation("times_order", row, float(dt[row]), 0.0, text)
        velocity = np.diff(rows, axis=0) / dt[:, None]
        bound = _Bound(
            "velocity", "on the line from row", "rad/s", limits.velocity, _VELOCITY_SLACK
        )
        yield from _too_much(bound, velocity)
        if limits.acceleration is not None:
            padded, around = np.pad(velocity, ((1, 1), (0, 0))), np.pad(dt, 1)
            acceleration = np.diff(padded, axis=0) / (0.5 * (around[1:] + around[:-1]))[:, None]
            most = np.asarray(limits.acceleration, float)
            bound = _Bound("acceleration", "at row", "rad/s²", most, _ACCELERATION_SLACK)
            yield from _too_much(bound, acceleration)


class _Bound(NamedTuple):
    """What is bounded, where, in which unit, the limits (D,) of its size, the relative slack."""

    kind: str
    where: str
    unit: str
    limits: np.ndarray
    slack: float


def _too_much(bound: _Bound, values: np.ndarray) -> Iterator[Violation]:
    """The first row of values (n, D) that passes the bound."""
    wrong = ~(np.abs(values) <= bound.limits * (1.0 + bound.slack))
    if wrong.any():
        row = int(np.argmax(wrong.any(axis=1)))
        joint = int(np.argmax(wrong[row]))
        value, limit = float(abs(values[row, joint])), float(bound.limits[joint])
        text = (
            f"{bound.where} {row} joint {joint} has the {bound.kind} {value:.6g} {bound.unit}, "
            f"{limit:.6g} {bound.unit} is allowed"
        )
        yield Violation(bound.kind, row, value, limit, text)
