"""A timed path while it is passed: where the arm is and how fast, and how it stops on the path.

Between the middles of two lines the velocity changes evenly, by the acceleration at the row between
them; it is 0 at the end, and what it is said to be at the start.  So it never changes faster than
the limits allow, and at a row it lies between those of the lines before and after.  The place is
on the line, as far along as this velocity leads.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from constraint_geodesics.geometry.errors import GeometryError, StartVelocityError
from constraint_geodesics.geometry.timing import time_parametrisation

AT_A_ROW = 1e-7
"""A place so near to a row [rad] is that row."""
AT_REST = 1e-9
"""What is no faster [rad/s] rests."""
ROOM = 5e-7
"""Relative acceleration beyond the limits that a motion may use that goes on: it used them up
before, to the last bit, and so must stop or go on with them but for rounding.  The certificate
allows twice as much.
"""
SPARED = 0.98
"""Share of the accelerations that a motion is planned with: a stop has all of them, so that it can
nearly always stay on the path.
"""
_CORNER = 1e-5
"""How near to a corner the rows beside it are [rad]."""
_FRACTIONS = 7
"""Bisections of the line on which a motion stops."""


class State(NamedTuple):
    """Of a motion.  configuration, velocity (D,) [rad, rad/s]; row: the next row of the path."""

    configuration: Float[np.ndarray, "D"]
    velocity: Float[np.ndarray, "D"]
    row: int


class Motion(NamedTuple):
    """Rows (T, D) [rad] and their times (T,) [s], from a velocity (D,) at the first, to rest."""

    joints: Float[np.ndarray, "T D"]
    times: Float[np.ndarray, "T"]
    start_velocity: Float[np.ndarray, "D"]


class Pace(NamedTuple):
    """The limits that a motion keeps, of each joint [rad/s, rad/s²]: planned ones use SPARED of the
    accelerations where they can, stops all of them.
    """

    velocity: Float[np.ndarray, "D"]
    acceleration: Float[np.ndarray, "D"]

    def times(
        self, joints: Float[np.ndarray, "T D"], start_velocity: Float[np.ndarray, "D"] | None
    ) -> Float[np.ndarray, "T"]:
        """Of the rows of a path that goes on, from a velocity (None: from rest).

        Raises GeometryError as `time_parametrisation` does.
        """
        try:
            return self._times(joints, start_velocity, SPARED)
        except StartVelocityError:
            return self._times(joints, start_velocity, 1.0)

    def hardest(
        self, joints: Float[np.ndarray, "T D"], start_velocity: Float[np.ndarray, "D"]
    ) -> Float[np.ndarray, "T"] | None:
        """Of the rows of a stop, with all of the accelerations; None where it can't be done on
        them.
        """
        try:
            return self._times(joints, start_velocity, 1.0)
        except GeometryError:
            return None

    def _times(
        self, joints: np.ndarray, start_velocity: np.ndarray | None, share: float
    ) -> Float[np.ndarray, "T"]:
        room = 1.0 + ROOM if start_velocity is not None and start_velocity.any() else 1.0
        limits = self.velocity, share * room * self.acceleration
        return time_parametrisation(joints, *limits, start_velocity)


def state_at(motion: Motion, at_s: float) -> State:
    """Where a motion is at a time [s] from 0 to its duration, and how fast."""
    joints, times, start = motion
    row = int(np.clip(np.searchsorted(times, at_s, side="right"), 1, len(times) - 1))
    middles = np.concatenate([[0.0], 0.5 * (times[1:] + times[:-1]), times[-1:]])
    lines = np.diff(joints, axis=0) / np.diff(times)[:, None]
    velocities = np.vstack([start, lines, np.zeros_like(start)])

    def velocity_at(moment: float) -> Float[np.ndarray, "D"]:
        return np.array([np.interp(moment, middles, column) for column in velocities.T])

    line, velocity = joints[row] - joints[row - 1], velocity_at(at_s)
    marks = times[row - 1], middles[row], times[row]
    speeds = np.array([float(velocity_at(mark) @ line) for mark in marks])
    share = _passed(at_s, np.array(marks), speeds)
    place = (1.0 - share) * joints[row - 1] + share * joints[row]
    if np.linalg.norm(joints[row] - place) <= AT_A_ROW:
        place, row = joints[row].copy(), row + 1  # no view: who alters it leaves the path alone
    elif np.linalg.norm(joints[row - 1] - place) <= AT_A_ROW:
        place = joints[row - 1].copy()
    if np.linalg.norm(velocity) <= AT_REST or row == len(joints):  # at its end it rests
        velocity = np.zeros_like(start)
    return State(place, velocity, row)


def _passed(at_s: float, marks: Float[np.ndarray, "3"], speeds: Float[np.ndarray, "3"]) -> float:
    """The share of a line that is passed at a time, by speeds along it at its beginning, middle and
    end that change evenly between them; at a sharp corner some may be negative, there it waits.
    """
    speeds = np.maximum(speeds, 0.0)
    if not speeds.any():  # both ends are one place
        return float((at_s - marks[0]) / (marks[2] - marks[0]))
    halves = 0.5 * (speeds[1:] + speeds[:-1]) * np.diff(marks)
    half = int(at_s >= marks[1])
    now = float(np.interp(at_s, marks, speeds))
    within = 0.5 * (speeds[half] + now) * (at_s - marks[half])
    return float((halves[:half].sum() + within) / halves.sum())


def ahead(joints: Float[np.ndarray, "T D"], state: State) -> Float[np.ndarray, "n D"]:
    """What is left of a path's rows, from the state on."""
    return np.vstack([state.configuration, joints[state.row :]])


def shortest_stop(
    rows: Float[np.ndarray, "n D"], velocity: Float[np.ndarray, "D"], pace: Pace
) -> Motion | None:
    """The motion from a velocity at the first row that stops the earliest on the way along rows;
    None where it can't before their end.
    """
    if len(rows) < 2 or pace.hardest(rows, velocity) is None:
        return None
    short, last = 0, len(rows) - 1  # it stops by row `last`, and not by row `short`
    while last - short > 1:
        middle = (short + last) // 2
        if pace.hardest(rows[: middle + 1], velocity) is None:
            short = middle
        else:
            last = middle
    low, high = 0.0, 1.0
    for _ in range(_FRACTIONS):
        share = 0.5 * (low + high)
        found = pace.hardest(_ending(rows, last, share), velocity)
        low, high = (share, high) if found is None else (low, share)
    ended = _ending(rows, last, high)
    times = pace.hardest(ended, velocity)
    return None if times is None else Motion(ended, times, velocity)


def going_on(
    stop: Float[np.ndarray, "n D"], onward: Float[np.ndarray, "m D"]
) -> Float[np.ndarray, "T D"]:
    """The rows of a stop, then those of a path from its end, with more of them close to the corner
    between the two, and halfway to the next one.

    The way may turn back there.  The limits hold in differences, which let an arm pass a corner
    the faster the longer its lines are; next to it they are so short that it all but rests in
    between.  From rest a whole line takes so long that a spline to its end bends it.
    """
    corner = stop[-1]
    before, after = _beside(corner, stop[-2]), _beside(corner, onward[1])
    return np.vstack([stop[:-1], before[:1], corner, after, onward[1:]])


def _beside(corner: np.ndarray, row: np.ndarray) -> Float[np.ndarray, "k D"]:
    """Rows on the line from a corner to another row: close to it, and halfway; none on a short
    line.
    """
    line = row - corner
    length = float(np.linalg.norm(line))
    shares = np.array([_CORNER / length, 0.5] if length > 4.0 * _CORNER else [])
    return corner + shares[:, None] * line


def _ending(rows: np.ndarray, last: int, share: float) -> np.ndarray:
    """The rows up to a share of the line before row `last`."""
    if share == 1.0:
        return rows[: last + 1]
    end = (1.0 - share) * rows[last - 1] + share * rows[last]
    return np.vstack([rows[:last], end])
