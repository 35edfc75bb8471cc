"""The beginning of a path for an arm that moves: from its velocity onto a curve that was found from
rest.

A curve that begins at the state of the arm leaves it in any direction.  Its beginning is replaced
by a cubic with the arm's direction at one end and the curve's at the other, projected onto the
constraint; how far along the curve it ends is a matter of trying.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.kernels import ManifoldArrays, violation_batch
from constraint_geodesics.geometry.braking import Pace
from constraint_geodesics.problem import LIMIT_SLACK, SATISFIED, Status
from constraint_geodesics.search.band import PROJECTION, project, step_lengths
from constraint_geodesics.search.candidates import Candidate, rows_of
from constraint_geodesics.search.curve_kernels import curve_points, spline_through
from constraint_geodesics.search.preparation import Query
from constraint_geodesics.search.space import Space

RUN_OUTS = (1.0, 2.0, 0.5, 4.0)
"""Lengths of the curve that are replaced, as multiples of the braking distance, in the order in
which they are tried.
"""
ACROSS = 0.02
"""By how much a velocity may lead off the constraint [rad/s or m/s]: within the acceleration limits
it is turned along it before that is seen.
"""
_SHORTEST, _STEP = 0.05, 0.04
"""Of a run-out, and between its points [rad]."""
_FEWEST = 5
_LEFT = 1e-6
_NEAR = 0.5
"""Share of the line after it, of a line that is too short to be one."""
_OFF = 1e-6
"""What the arm is off the constraint [rad] that is not seen."""
_FADING = 0.05
"""Share of the accelerations that brings it back."""
_FULL, _LEAST, _MOST_PIECES = 0.97, 0.04, 5
"""Share of the violation that is used up where an arm is off, the least that a line uses of it, and
into how many a line is cut.
"""
_BEYOND = 1.6
"""Braking distances that a straight run-out has room for: projection bends and stretches it."""


def braking_distance(velocity: Float[np.ndarray, "D"], pace: Pace) -> float:
    """Length [rad] of a straight stop from a velocity within the acceleration limits."""
    speed = float(np.linalg.norm(velocity))
    return 0.5 * speed * float((np.abs(velocity) / pace.acceleration).max())


def merged(
    space: Space, candidate: Candidate, velocity: Float[np.ndarray, "D"], length: float
) -> Candidate | None:
    """The candidate with so much of its beginning [rad] replaced by a curve that leaves along a
    velocity; None where that does not keep the constraint and the limits.
    """
    points = candidate.points
    along = np.insert(np.cumsum(step_lengths(points)), 0, 0.0)
    at = min(int(np.searchsorted(along, max(length, _SHORTEST))), len(points) - 1)
    back, on = max(at - 1, 0), min(at + 1, len(points) - 1)
    end = points[on] - points[back]
    blend = _cubic(points[0], velocity, points[at], end)
    return _drawn(space, candidate, np.concatenate([blend, points[at + 1 :]]))


def run_out(
    space: Space, start: Float[np.ndarray, "D"], velocity: Float[np.ndarray, "D"], pace: Pace
) -> Candidate | None:
    """A curve straight on along a velocity, long enough to stop on it; None where it leaves the
    constraint or the limits.
    """
    length = _BEYOND * braking_distance(velocity, pace) + _SHORTEST
    direction = velocity / np.linalg.norm(velocity)
    shares = np.linspace(0.0, 1.0, max(int(np.ceil(length / _STEP)), _FEWEST))
    points = start + length * shares[:, None] * direction
    return _drawn(space, Candidate("straight", space, points, length, points), points)


def run_outs(
    space: Space, candidate: Candidate, velocity: Float[np.ndarray, "D"], pace: Pace
) -> Iterator[Candidate]:
    """The candidate with beginnings of several lengths that leave along a velocity."""
    distance, tried = braking_distance(velocity, pace), -1.0
    for share in RUN_OUTS:
        length = min(max(share * distance, _SHORTEST), candidate.length)
        if length == tried:
            continue
        tried = length
        found = merged(space, candidate, velocity, length)
        if found is not None:
            yield found


def _cubic(
    start: np.ndarray, velocity: np.ndarray, end: np.ndarray, onward: np.ndarray
) -> Float[np.ndarray, "n D"]:
    """Points of the Hermite cubic between two places and two directions."""
    chord = float(np.linalg.norm(end - start))
    first = chord * velocity / np.linalg.norm(velocity)
    last = chord * onward / max(float(np.linalg.norm(onward)), 1e-12)
    t = np.linspace(0.0, 1.0, max(int(np.ceil(chord / _STEP)), _FEWEST) + 1)[:, None]
    u = 1.0 - t
    places = u * u * (1.0 + 2.0 * t) * start + t * t * (1.0 + 2.0 * u) * end
    return np.asarray(places + t * u * u * first - t * t * u * last)


def _drawn(space: Space, candidate: Candidate, points: np.ndarray) -> Candidate | None:
    """Points of a new beginning, projected, as a candidate; its end stays where it is."""
    points = np.ascontiguousarray(points)
    goal = points[-1].copy()
    left = project(space, points)
    if np.array_equal(goal, candidate.points[-1]):
        points[-1] = goal
    steps = step_lengths(points)
    if left > _LEFT or not steps.min() > 1e-9:
        return None
    return replace(candidate, space=space, points=points, length=float(steps.sum()))


def left_over(space: Space, rows: Float[np.ndarray, "n D"]) -> Candidate | None:
    """What is left of a path, its waypoints after the place where the arm is, as a candidate of a
    space.
    """
    steps = step_lengths(rows[:3])
    if len(rows) > 2 and steps[0] < _NEAR * steps[1]:
        rows = np.delete(rows, 1, axis=0)
    length = float(step_lengths(rows).sum())
    return _drawn(space, Candidate("straight", space, rows, length, rows), rows.copy())


def rows_from(
    candidate: Candidate,
    start: Float[np.ndarray, "D"],
    velocity: Float[np.ndarray, "D"],
    pace: Pace,
    violation: float,
) -> Float[np.ndarray, "T D"]:
    """Rows along a candidate that begin at the arm's place, off the constraint by as much as the
    line it comes from; as `rows_of`, lines leave the constraint by less than `violation`.

    An arm that moves fast can't turn onto the constraint at once: what it is off fades over the
    way that the accelerations need for it, on rows as much closer.
    """
    rows = rows_of(candidate, violation)
    off = start - rows[0]
    size = float(np.abs(off).max())
    if size > _OFF and len(rows) > _FEWEST:
        lasting = np.sqrt(6.0 * float((np.abs(off) / pace.acceleration).max()) / _FADING)
        length, along = float(np.linalg.norm(velocity)) * lasting, np.cumsum(step_lengths(rows))
        ends = min(int(np.searchsorted(along, length)) + 1, len(rows) - 1)
        rows = _closer(candidate, rows, ends, _pieces(candidate, start, violation))
        passed = np.insert(np.cumsum(step_lengths(rows)), 0, 0.0) / max(length, 1e-9)
        share = np.minimum(passed, 1.0)[:, None]
        rows = rows + (1.0 - share) ** 2 * (1.0 + 2.0 * share) * off
    rows[0], rows[-1] = start, candidate.points[-1]
    return rows


def _pieces(candidate: Candidate, start: np.ndarray, violation: float) -> int:
    """Into how many each of the first lines is cut: it may leave the constraint by what the start
    leaves of it.
    """
    manifold = ManifoldArrays(candidate.space.chain, candidate.space.constraint)
    worst = np.empty(1)
    violation_batch(manifold, start[None].copy(), worst)
    room = max(_FULL * SATISFIED - float(worst[0]), _LEAST * SATISFIED)
    return int(np.clip(np.ceil(np.sqrt(violation / room)), 2, _MOST_PIECES))


def _closer(
    candidate: Candidate, rows: np.ndarray, lines: int, pieces: int
) -> Float[np.ndarray, "T D"]:
    """The rows, with each of the first lines cut into pieces on the curve."""
    near = np.ascontiguousarray(rows[: min(lines + 4, len(rows))])
    curve, sound = spline_through(near)
    if not sound:
        return rows
    knots = curve.knots[: lines + 1]
    at = np.interp(np.arange(lines * pieces + 1) / pieces, np.arange(lines + 1), knots)
    drawn, _ = curve_points(candidate.space, curve, at / curve.knots[-1], PROJECTION)
    return np.concatenate([drawn, rows[lines + 1 :]])


def refused_velocity(query: Query, pace: Pace) -> tuple[Status, str] | None:
    """Why no path can begin with the query's velocity; None where one can."""
    manifold, velocity = query.task.manifold, query.start_velocity
    if velocity is None:
        return None
    robot, q = manifold.robot, query.start
    over = np.abs(velocity) - pace.velocity * (1.0 + 1e-6)
    if (over > 0.0).any():
        j = int(np.argmax(over))
        line = f"{robot.joint_names[j]} of the start moves at {abs(velocity[j]):.4g} /s"
        return "out_of_limits", f"{line}, {pace.velocity[j]:.4g} /s is its limit"
    room = np.where(velocity > 0.0, robot.upper - q, q - robot.lower)
    short = velocity**2 / (2.0 * pace.acceleration) - room
    short[velocity == 0.0] = 0.0
    if (short > LIMIT_SLACK).any():  # no more than the certificate allows
        j = int(np.argmax(short))
        line = f"{robot.joint_names[j]} of the start moves at {velocity[j]:.4g} /s"
        return "out_of_limits", f"{line} and can't stop within {room[j]:.4g}, where its limit is"
    rate = _leading_off(query, velocity)
    if rate > ACROSS:
        line = f"the start's velocity leads off {query.name} at {rate:.3g} rad/s or m/s"
        return "start_violates", f"{line}, {ACROSS:.3g} is allowed"
    return None


def _leading_off(query: Query, velocity: np.ndarray) -> float:
    """How fast a velocity breaks the constraint, to first order [rad/s or m/s]."""
    manifold = query.task.manifold
    residual, jacobian = manifold.linearise(query.start)
    rates, rows = jacobian @ velocity, manifold.rows
    worst = float(np.abs(rates[rows.exact]).max(initial=0.0))
    for group in rows.loose_groups:
        size = float(np.linalg.norm(residual[group]))
        if size >= rows.tolerance[group].max() - SATISFIED:
            # from the middle of a narrow tolerance any way leads off
            off = residual[group] @ rates[group] / size if size else np.linalg.norm(rates[group])
            worst = max(worst, float(off))
    return worst
