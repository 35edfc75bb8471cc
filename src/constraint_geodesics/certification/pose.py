"""Axes of the tool's pose, bounded along straight joint lines; proof in kernels.py."""

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

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
    own = _Axes(tuple(constraint.axes), tuple(constraint.tolerance))
    held, channels, table = _demanded(own, *_reference(asked), allowed)
    found = np.empty((len(channels), kernels.FOUND))
    wanted = max(_INTERPOLATION_SHARE * allowed, 1e-9)
    kernels.keep(asked.chain, held, table, asked.rows, wanted, found)
    at_rows: list[Broken] = []
    between: list[Broken] = []
    for channel, sizes in zip(channels, found.tolist(), strict=True):
        if sizes[kernels.ROW] >= 0.0:
            at_rows.append(channel.broken(sizes[kernels.ROW], sizes[kernels.AT_ROW]))
        if sizes[kernels.SEGMENT] >= 0.0:
            between.append(channel.broken(sizes[kernels.SEGMENT], sizes[kernels.ON_SEGMENT]))
        for excesses, size in ((attained, sizes[kernels.ATTAINED]), (bound, sizes[kernels.BOUND])):
            excesses[channel.unit] = max(excesses[channel.unit], size - channel.tolerance)
    return summed_up(attained, bound, at_rows, between, asked.limits)


class _Axes(NamedTuple):
    """Which of the six are held, and how loosely."""

    axes: tuple[int, ...]
    tolerance: tuple[float, ...]


@lru_cache(maxsize=256)
def _demanded(
    own: _Axes, place: bytes, turn: bytes, allowed: float
) -> tuple[kernels.Held, tuple[_Channel, ...], np.ndarray]:
    """What is held, as numbers that have a tolerance, and their table for `kernels.keep`; of a
    reference's position and quaternion, as bytes.
    """
    angles = _angles_held(own, np.frombuffer(turn).copy())
    held = kernels.Held(*angles, any(own.axes[:3]), np.frombuffer(place).copy())
    channels = tuple(_channels(own, held.kind, held.k))
    table = np.array([(c.kind, c.entry, c.tolerance, c.tolerance + allowed) for c in channels])
    return held, channels, table


def _reference(asked: Asked) -> tuple[bytes, bytes]:
    """Position (3,) [m] and quaternion (w, x, y, z) of the reference: the constraint's, or that of
    `first`.
    """
    pose = asked.constraint.reference
    if pose is not None:
        turn = quaternion_of(np.asarray(pose.rotation, float))
        return np.asarray(pose.position, float).tobytes(), turn.tobytes()
    own = np.empty((1, 7))
    kernels.poses(asked.chain, np.ascontiguousarray(asked.first[None]), own)
    return own[0, :3].tobytes(), own[0, [6, 3, 4, 5]].tobytes()


def _angles_held(constraint: _Axes, reference: np.ndarray) -> tuple[int, int, np.ndarray]:
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


def _channels(constraint: _Axes, kind: int, k: int) -> Iterator[_Channel]:
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
