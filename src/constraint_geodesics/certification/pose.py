"""Axes of the tool's pose, bounded along straight joint lines; proof in kernels.py."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from constraint_geodesics.certification import kernels
from constraint_geodesics.certification.chain import quaternion_of, rotated
from constraint_geodesics.certification.kept import Asked, Broken, Kept, nothing_exceeds, summed_up

_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
# share of the violation's tolerance that the interpolation between two stations may add to a bound
_INTERPOLATION_SHARE = 0.01


class _Channel(NamedTuple):
    """One number that is held below a tolerance: the size of what is held, or an entry of it."""

    name: str
    unit: str
    kind: int
    entry: int
    tolerance: float

    def broken(self, row: float, size: float) -> Broken:
        """That it passes its tolerance there."""
        return Broken(int(row), float(size) - self.tolerance, self.name, self.unit, self.tolerance)


def kept(asked: Asked) -> Kept:
    """How well the constraint is kept at the rows and on the whole path."""
    attained, bound = nothing_exceeds()
    constraint, allowed = asked.constraint, asked.limits.violation_tolerance
    place, quaternion = _reference(asked)
    positions = any(constraint.axes[:3])
    held = kernels.Held(*_angles_held(constraint, quaternion), positions, place)
    channels = list(_channels(constraint, held.kind, held.k))
    table = np.array([(c.kind, c.entry, c.tolerance, c.tolerance + allowed) for c in channels])
    found = np.empty((len(channels), kernels.FOUND))
    wanted = max(_INTERPOLATION_SHARE * allowed, 1e-9)
    kernels.keep(asked.chain, held, table, asked.rows, wanted, found)
    at_rows: list[Broken] = []
    between: list[Broken] = []
    for channel, own in zip(channels, found.tolist(), strict=True):
        if own[kernels.ROW] >= 0.0:
            at_rows.append(channel.broken(own[kernels.ROW], own[kernels.AT_ROW]))
        if own[kernels.SEGMENT] >= 0.0:
            between.append(channel.broken(own[kernels.SEGMENT], own[kernels.ON_SEGMENT]))
        for excesses, size in ((attained, own[kernels.ATTAINED]), (bound, own[kernels.BOUND])):
            excesses[channel.unit] = max(excesses[channel.unit], size - channel.tolerance)
    return summed_up(attained, bound, at_rows, between, asked.limits)


def _reference(asked: Asked) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) [m] and quaternion (w, x, y, z) of the reference: the constraint's, or that of
    `first`.
    """
    pose = asked.constraint.reference
    if pose is not None:
        return np.ascontiguousarray(pose.position, np.float64), quaternion_of(
            np.asarray(pose.rotation, float)
        )
    own = np.empty((1, 7))
    kernels.poses(asked.chain, np.ascontiguousarray(asked.first[None]), own)
    return own[0, :3], own[0, [6, 3, 4, 5]]


def _angles_held(constraint: Any, reference: np.ndarray) -> tuple[int, int, np.ndarray]:
    """Kind, axis and anchor as `kernels.Held` has them, from the reference's quaternion; kind −1
    for no angle.
    """
    held = [bool(x) for x in constraint.axes[3:]]
    back = reference * np.array([1.0, -1.0, -1.0, -1.0])
    if sum(held) == 2:
        k = held.index(False)
        return kernels.SWING, k, np.append(rotated(back, np.eye(3)[k]), 0.0)
    if sum(held) == 1:
        return kernels.TWIST, held.index(True), back
    return (kernels.ROTATION if all(held) else -1), 0, back


def _channels(constraint: Any, kind: int, k: int) -> Iterator[_Channel]:
    """What is held: the angles together where they share one tolerance, else each; and each
    position.
    """
    angles = [axis for axis in range(3) if constraint.axes[3 + axis]]
    tolerances = {constraint.tolerance[3 + axis] for axis in angles}
    if len(tolerances) == 1:
        name = " and ".join(_AXES[3 + axis] for axis in angles)
        yield _Channel(name, "rad", kind, kernels.SIZE, tolerances.pop())
    else:
        for axis in angles:
            # a swing about e_i moves u along e_j, and the other way round
            entry = 3 - (axis - k) % 3 if kind == kernels.SWING else 1 + axis
            yield _Channel(_AXES[3 + axis], "rad", kind, entry, constraint.tolerance[3 + axis])
    for axis in range(3):
        if constraint.axes[axis]:
            yield _Channel(_AXES[axis], "m", kernels.POSITION, 1 + axis, constraint.tolerance[axis])
