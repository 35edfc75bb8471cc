"""Axes of the tool's pose, bounded along straight joint lines; proof in kernels.py."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from constraint_geodesics.certification import kernels
from constraint_geodesics.certification.chain import Chain, quaternion_of, rotated
from constraint_geodesics.certification.kept import Asked, Broken, Kept, nothing_exceeds, summed_up

_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
_MOST_PIECES = 64
# share of the violation's tolerance that the interpolation between two stations may add to a bound
_INTERPOLATION_SHARE = 0.01


class _Curves(NamedTuple):
    """Values and derivatives (3, S, 4) along a path, as `kernels.trace` writes them; (3, 0, 4) of
    what is not held.
    """

    turn: np.ndarray
    shift: np.ndarray


class _Line(NamedTuple):
    """A path cut into pieces: where its rows are among the stations, and the kernels' numbers for
    each piece.
    """

    rows: np.ndarray
    stations: np.ndarray
    segments: np.ndarray
    turned: np.ndarray
    fourth: np.ndarray


class _Held(NamedTuple):
    """What a constraint holds, as `kernels.trace` takes it."""

    kinematics: Chain
    kind: int
    axis: int
    anchor: np.ndarray
    positions: bool
    place: np.ndarray

    def trace(self, q: np.ndarray) -> _Curves:
        """The curves through the stations q (S, D)."""
        turn = np.empty((3, len(q) if self.kind >= 0 else 0, 4))
        shift = np.empty((3, len(q) if self.positions else 0, 4))
        kernels.trace(
            self.kinematics, self.kind, self.axis, self.anchor, self.place, q, *turn, *shift
        )
        return _Curves(turn, shift)


class _Channel(NamedTuple):
    """One number that is held below a tolerance: the size of what is held, or an entry of it."""

    name: str
    unit: str
    kind: int
    entry: int
    tolerance: float

    def of(self, curves: _Curves) -> np.ndarray:
        """The curve it is read off."""
        return curves.shift if self.kind == kernels.POSITION else curves.turn

    def values(self, curves: _Curves) -> np.ndarray:
        """Its values (S,) at the stations."""
        x = self.of(curves)[0]
        out = np.empty(len(x))
        kernels.values(self.kind, self.entry, x, out)
        return out

    def broken(self, row: int, value: float) -> Broken:
        """That it passes its tolerance there."""
        return Broken(row, float(value) - self.tolerance, self.name, self.unit, self.tolerance)


def kept(asked: Asked) -> Kept:
    """How well the constraint is kept at the rows and on the whole path."""
    attained, bound = nothing_exceeds()
    constraint = asked.constraint
    position, quaternion = _reference(asked)
    held = _Held(
        asked.chain, *_angles_held(constraint, quaternion), any(constraint.axes[:3]), position
    )
    line = _cut(asked)
    curves = held.trace(line.stations)
    at_rows: list[Broken] = []
    between: list[Broken] = []
    for channel in _channels(constraint, held.kind, held.axis):
        limit = channel.tolerance + asked.limits.violation_tolerance
        sizes = channel.values(curves)[line.rows]
        if not sizes.max() <= limit:
            row = int(np.argmax(~(sizes <= limit)))
            at_rows.append(channel.broken(row, sizes[row]))
        highest, piece, t, segment, value = kernels.bound_pieces(
            channel.kind,
            channel.entry,
            channel.tolerance,
            limit - kernels.ROUNDING,
            *channel.of(curves),
            line.turned,
            line.fourth,
            line.segments,
        )
        if segment >= 0:
            between.append(channel.broken(int(segment), value))
        # the interpolant says where the path is worst; what counts as attained is its true value
        # there
        place = line.stations[piece] + t * (line.stations[piece + 1] - line.stations[piece])
        largest = np.append(sizes, channel.values(held.trace(place[None]))).max()
        largest = np.inf if np.isnan(largest) else largest  # joint values that overflow
        attained[channel.unit] = max(attained[channel.unit], float(largest) - channel.tolerance)
        bound[channel.unit] = max(bound[channel.unit], float(highest) - channel.tolerance)
    return summed_up(attained, bound, at_rows, between, asked.limits)


def _cut(asked: Asked) -> _Line:
    """The path in pieces that are short enough for the interpolation."""
    rows, chain = asked.rows, asked.chain
    counts = np.empty(len(rows) - 1, dtype=np.int64)
    wanted = max(_INTERPOLATION_SHARE * asked.limits.violation_tolerance, 1e-9)
    pieces = kernels.count_pieces(chain, rows, wanted, _MOST_PIECES, counts)
    stations, segments = np.empty((pieces + 1, rows.shape[1])), np.empty(pieces, dtype=np.int64)
    turned, fourth = np.empty(pieces), np.empty(pieces)
    kernels.cut(chain, rows, counts, stations, segments, turned, fourth)
    return _Line(np.concatenate([[0], np.cumsum(counts)]), stations, segments, turned, fourth)


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
    """Kind, axis and anchor as `kernels.trace` takes them, from the reference's quaternion; kind −1
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
