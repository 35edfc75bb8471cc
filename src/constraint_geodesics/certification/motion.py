"""The times of a path: whether they rise, and the velocities and accelerations along it."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from constraint_geodesics.certification import kernels
from constraint_geodesics.certification.certificate import Violation, malformed, real_array


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
    if (row := kernels.not_rising(times)) >= 0:
        text = (
            f"row {row + 1} is at {times[row + 1]:.9g} s, row {row} at {times[row]:.9g} s: times "
            "must rise"
        )
        yield Violation("times_order", row, float(times[row + 1] - times[row]), 0.0, text)
    found = kernels.too_fast(rows, times, limits.velocity)
    if found[0] >= 0:
        yield _too_much("velocity", "on the line from row", "rad/s", limits.velocity, found)
    if limits.acceleration is not None:
        most = np.asarray(limits.acceleration, float)
        found = kernels.too_sudden(rows, times, most)
        if found[0] >= 0:
            yield _too_much("acceleration", "at row", "rad/s²", most, found)


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
