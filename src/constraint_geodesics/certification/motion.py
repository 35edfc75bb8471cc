"""The times of a path: whether they rise, and the velocities and accelerations along it."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from constraint_geodesics.certification import kernels
from constraint_geodesics.certification.certificate import Violation, malformed, real_array

_SLACK = 1e-6
"""Relative, of the speed that the first line must have."""
_ASIDE_RAD = 5e-3
"""By how much an arm may leave the first line while it turns into it from its velocity."""


class MotionLimits(NamedTuple):
    """Of each joint [rad/s, rad/s²]; None: not demanded.  start: the velocity at the first row."""

    velocity: Float[np.ndarray, "D"]
    acceleration: tuple[float, ...] | None
    start: Float[np.ndarray, "D"]


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
    if (row := kernels.not_rising(times)) >= 0:
        text = (
            f"row {row + 1} is at {times[row + 1]:.9g} s, row {row} at {times[row]:.9g} s: times "
            "must rise"
        )
        yield Violation("times_order", row, float(times[row + 1] - times[row]), 0.0, text)
    found = kernels.too_fast(rows, times, limits.velocity)
    if found[0] >= 0:
        yield _too_much("velocity", "on the line from row", "rad/s", limits.velocity, found)
    yield from _begun(rows, times, limits)
    if limits.acceleration is not None:
        most = np.asarray(limits.acceleration, float)
        found = kernels.too_sudden(rows, times, most, limits.start)
        if found[0] >= 0:
            yield _too_much("acceleration", "at row", "rad/s²", most, found)


def _begun(rows: np.ndarray, times: np.ndarray, limits: MotionLimits) -> Iterator[Violation]:
    """What is wrong with the velocity at the first row: it passes the limits, or the first line is
    so slow that at constant acceleration the arm would overshoot its end and come back, or leads
    elsewhere, so that the arm leaves it while it turns.
    """
    if not limits.start.any():
        return
    over = np.abs(limits.start) - limits.velocity * (1.0 + _SLACK)
    if (over > 0.0).any():
        joint = int(np.argmax(over))
        found = 0, joint, float(abs(limits.start[joint]))
        yield _too_much("velocity", "at row", "rad/s", limits.velocity, found)
    speed = float(np.linalg.norm(rows[1] - rows[0]) / (times[1] - times[0]))
    least = 0.5 * float(np.linalg.norm(limits.start))
    if not speed >= least * (1.0 - _SLACK):
        text = (
            f"row 0 is passed at {2.0 * least:.6g} rad/s and the line from it at {speed:.6g} rad/s:"
            " the arm would run past the line's end, half of the speed is needed"
        )
        yield Violation("start_velocity", 0, speed, least, text)
    line = (rows[1] - rows[0]) / float(np.linalg.norm(rows[1] - rows[0]))
    along = float(limits.start @ line)
    across = float(np.linalg.norm(limits.start - along * line))
    # from it to the line's own velocity in its middle, evenly
    aside = 0.25 * across * float(times[1] - times[0])
    if along < 0.0 or aside > _ASIDE_RAD:
        what = "runs back before" if along < 0.0 else f"is {aside:.3g} rad beside the line when"
        text = f"the arm {what} it goes along the line from row 0, {_ASIDE_RAD:.3g} rad is allowed"
        yield Violation("start_velocity", 0, aside, _ASIDE_RAD, text)


def _too_much(
    kind: str, where: str, unit: str, limits: np.ndarray, found: tuple[int, int, float]
) -> Violation:
    row, joint, value = found
    limit = float(limits[joint])
    text = (
        f"{where} {row} joint {joint} has the {kind} {value:.6g} {unit}, {limit:.6g} {unit} is "
        "allowed"
    )
    return Violation(kind, row, value, limit, text)
