"""Times for the rows of a given path: near time-optimal within velocity and acceleration limits, on
the path itself.

Only the pace along the path is chosen and no row is moved, so a path that keeps a constraint still
keeps it. The method is that of TOPP-RA (Pham and Pham 2018, A New Approach to Time-Optimal Path
Parameterization Based on Reachability Analysis): controllable speeds from the goal backward, then
greedily the largest one from the start forward.  It is worked out here for the differences of the
rows themselves instead of for an interpolating curve, so that the result needs no rows between the
given ones and keeps the limits exactly in these differences.

With the step Δq_i between two rows, its length s_i, its direction u_i = Δq_i / s_i and the speed
w_i = s_i / Δt_i along it, the velocity is v_i = u_i w_i and the acceleration at the row between two
steps is

    a_i = (v_i - v_{i-1}) / (½ (Δt_i + Δt_{i-1})) = 2 (u_i w_i - u_{i-1} w_{i-1}) / (s_i/w_i +
    s_{i-1}/w_{i-1}).

Two neighbours that keep |a_i| ≤ A keep it at any common slower pace, so the speeds of a step from
which the goal can be reached are an interval that begins at 0.

A motion that has the velocity v at its first row keeps |u_0 w_0 - v| ≤ ½ A Δt_0 there, with w_0 ≥
½ |v|: at constant acceleration a slower first step would end in a motion back.  For each joint that
leaves out an open interval of w_0 at most, so what is allowed is the largest speed below which none
of them lies.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numba import njit

from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.geometry.errors import GeometryError, NonFiniteError, StartVelocityError

COINCIDENT = 1e-9
"""Rows closer than this share of the path's length coincide."""
MARGIN = 1e-9
"""Share of the times added at the end, so that a reader's rounding does not carry a value over its
limit.
"""
_ROUNDING = 1e-11
"""Relative excess that counts as rounding while a speed is sought; the stretch at the end takes it
off.
"""
_STRETCHES = (1e-8, 1e-6, 1e-4)
"""Relative changes of the first velocity that are provided for: the stretch at the end makes one;
the next is taken where that does not do.
"""
_NUDGE = 1e-3
"""Relative change of a ratio of speeds that shows the side of the better ratios."""
_SECTIONS = 20
"""Golden sections of an interval of ratios: they leave less than 1e-4 of it."""
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


class _Step(NamedTuple):
    """A step between two rows: its direction (D,), its length, and a speed or its upper limit."""

    direction: Float[np.ndarray, "D"]
    length: float
    speed: float


def time_parametrisation(
    joints: Float[np.ndarray, "T D"],
    velocity: Float[np.ndarray, "D"],
    acceleration: Float[np.ndarray, "D"],
    start_velocity: Float[np.ndarray, "D"] | None = None,
) -> Float[np.ndarray, "T"]:
    """Strictly rising times [s] of a path's rows [rad], from 0, at rest at the end and near
    time-optimal; by default at rest at the start, too.

    velocity, acceleration: limits of each joint [rad/s, rad/s²], positive; a velocity limit may be
    infinite. With Δt_i = t_{i+1} - t_i and v_i = Δq_i / Δt_i the result keeps |v_i| ≤ velocity and,
    at every row, |v_i - v_{i-1}| / (½ (Δt_i + Δt_{i-1})) ≤ acceleration, where before the first row
    and after the last one both the speed and the time step are 0.  Beyond these differences nothing
    is promised: between two rows the joints are taken to move straight, so the rows must be close
    enough together for that.
    start_velocity: at the first row [rad/s], in place of that speed 0 before it; the first step is
    at least half as fast.
    Raises GeometryError on a wrong shape, fewer than two rows, a limit that is not positive, or two
    neighbouring rows that coincide (an arm would have to stop there, for no time at all; drop one),
    NonFiniteError on a row or a velocity that is not finite, StartVelocityError where the rows do
    not let a motion with the start's velocity go on.
    """
    q = np.asarray(joints, dtype=np.float64, order="C")
    if q.ndim != 2 or len(q) < 2 or q.shape[1] == 0:
        raise GeometryError(
            f"joints has shape {q.shape}: must be (T, D) with at least two rows and one joint"
        )
    limits = [
        _limit(velocity, q.shape[1], "velocity"),
        _limit(acceleration, q.shape[1], "acceleration"),
    ]
    if not all(map(math.isfinite, limits[1].tolist())):
        raise GeometryError(f"acceleration = {limits[1].tolist()}: must be finite")
    moving = _start_velocity(start_velocity, q.shape[1])
    times, spacing = np.empty(len(q)), np.empty(len(q) - 1)
    total, _, least = write_steps(q, spacing)
    if math.isfinite(total) and least > COINCIDENT * total:
        _write_times(q, spacing, limits, moving, times)
        return times
    if not np.isfinite(q).all():
        row, joint = np.argwhere(~np.isfinite(q))[0]
        raise NonFiniteError("joints", (int(row), int(joint)), float(q[row, joint]))
    row = int(spacing.argmin())
    raise GeometryError(
        f"joints[{row}] and joints[{row + 1}] coincide: neighbouring rows must differ"
    )


def _write_times(
    q: np.ndarray,
    spacing: np.ndarray,
    limits: list[np.ndarray],
    start: np.ndarray,
    times: np.ndarray,
) -> None:
    fastest = slowest = 0.0
    for stretch in _STRETCHES:
        done, fastest, slowest = _times(q, spacing, *limits, start, stretch, times)
        if done:
            return
    raise StartVelocityError(
        f"start_velocity = {start.tolist()}: the first step can be passed at {fastest:.3g} rad/s "
        f"at most, {slowest:.3g} rad/s are needed"
    )


def _start_velocity(velocity: np.ndarray | None, dim: int) -> np.ndarray:
    """(D,), 0 for none."""
    if velocity is None:
        return np.zeros(dim)
    values = np.asarray(velocity, dtype=np.float64, order="C")
    if values.shape != (dim,):
        raise GeometryError(f"start_velocity has shape {values.shape}: must be ({dim},)")
    if not np.isfinite(values).all():
        joint = int(np.argmin(np.isfinite(values)))
        raise NonFiniteError("start_velocity", (joint,), float(values[joint]))
    return values


def _limit(limit: np.ndarray, dim: int, what: str) -> np.ndarray:
    values = np.asarray(limit, dtype=np.float64, order="C")
    if values.shape != (dim,):
        raise GeometryError(
            f"{what} has shape {values.shape}: must be ({dim},), one limit for each joint"
        )
    if not all(value > 0.0 for value in values.tolist()):
        raise GeometryError(f"{what} = {values.tolist()}: must be positive")
    return values


@njit(**LEAF)
def write_steps(q, steps):
    """Distances of neighbouring rows (T, D) into steps (T − 1,); their sum, the longest and the
    least.
    """
    total, longest, least = 0.0, 0.0, np.inf
    for i in range(steps.shape[0]):
        square = 0.0
        for d in range(q.shape[1]):
            square += (q[i + 1, d] - q[i, d]) ** 2
        steps[i] = np.sqrt(square)
        total += steps[i]
        longest, least = max(longest, steps[i]), min(least, steps[i])
    return total, longest, least


@njit(**COMPILE)
def _times(q, spacing, velocity, acceleration, start, stretch, times):
    """Writes the times (T,) of the rows q (T, D) with the given distances (T-1,), the first row
    passed with the velocity `start` (D,).

    stretch: relative change of the first step's velocity that is provided for.  Returns whether
    there are such times, and the largest and smallest speed that the first step may have.
    """
    steps = spacing.shape[0]
    directions = np.empty((steps, q.shape[1]))
    fastest = np.empty(steps)
    for i in range(steps):
        fastest[i] = np.inf
        for j in range(q.shape[1]):
            directions[i, j] = (q[i + 1, j] - q[i, j]) / spacing[i]
            fastest[i] = min(fastest[i], velocity[j] / abs(directions[i, j]))
    slowest = 0.0
    for j in range(q.shape[1]):
        slowest += start[j] ** 2
    moving, slowest = slowest > 0.0, 0.5 * np.sqrt(slowest)
    first = _Step(directions[0], spacing[0], fastest[0])
    if moving:
        fastest[0] = _fastest_from(start, first, acceleration)
    # from rest and to rest: the acceleration at an end is 2 |u| w² / s
    for i in (steps - 1 if moving else 0, steps - 1):
        for j in range(q.shape[1]):
            fastest[i] = min(
                fastest[i], np.sqrt(0.5 * acceleration[j] * spacing[i] / abs(directions[i, j]))
            )
    ratios = np.empty(steps)
    _controllable(directions, spacing, acceleration, fastest, ratios)
    speed = fastest[0]
    if moving:
        first = _Step(directions[0], spacing[0], fastest[0])
        speed = _fastest_after(start, first, acceleration, stretch)
        if not speed >= slowest * (1.0 + stretch):
            return False, speed, slowest
    times[0] = 0.0
    times[1] = spacing[0] / speed
    for i in range(1, steps):
        _, largest = _ratio_window(spacing[i - 1], spacing[i])
        # the ratio found on the way back is allowed at every pace, so what is allowed is never
        # empty
        allowed = ratios[i - 1] * speed
        before = _Step(directions[i - 1], spacing[i - 1], speed)
        step = _Step(directions[i], spacing[i], min(fastest[i], largest * speed))
        speed = max(allowed, _fastest_next_to(before, step, acceleration))
        times[i + 1] = times[i] + spacing[i] / speed
    # where a step takes a tiny share of the time, rounding makes its acceleration so uncertain that
    # once is not enough
    margin = MARGIN
    used = _used(q, times, velocity, acceleration, moving)
    while used > 1.0 - 0.5 * MARGIN:
        for i in range(1, steps + 1):
            times[i] *= used * (1.0 + margin)
        margin *= 2.0
        used = _used(q, times, velocity, acceleration, moving)
    speed = spacing[0] / times[1]
    kept = not moving or (speed >= slowest and _is_kept(q, times, start, acceleration))
    return kept, speed, slowest


@njit(**LEAF)
def _fastest_from(start, step, acceleration):
    """Largest speed of the first step, up to its own, with which no joint is faster than it can get
    from its velocity: u w² - v w ≤ ½ A s, for u, v and -u, -v.
    """
    speed = step.speed
    for j in range(acceleration.shape[0]):
        u, v = abs(step.direction[j]), start[j]
        if step.direction[j] < 0.0:
            v = -v
        room = 0.5 * acceleration[j] * step.length
        # the stable one of two forms of the root; with u = 0 either sign of v counts
        if u == 0.0:
            v = -abs(v)
        root = np.sqrt(v * v + 4.0 * u * room)
        most = 0.5 * (v + root) / u if v > 0.0 else 2.0 * room / max(root - v, 1e-300)
        speed = min(speed, most)
    return speed


@njit(**LEAF)
def _fastest_after(start, step, acceleration, stretch):
    """Largest speed of the first step, up to its own, with which no joint is slower than it can get
    from its velocity, either: u w² - v w ≥ -½ A s holds outside of an open interval of w.
    """
    speed, lowered = step.speed, True
    while lowered:
        lowered = False
        for j in range(acceleration.shape[0]):
            u, v = abs(step.direction[j]), start[j] * (1.0 + stretch)
            if step.direction[j] < 0.0:
                v = -v
            room = 0.5 * acceleration[j] * step.length
            if v <= 0.0 or v * speed - u * speed * speed <= room:
                continue
            square = v * v - 4.0 * u * room
            speed = min(2.0 * room / (v + np.sqrt(max(square, 0.0))), speed * (1.0 - _ROUNDING))
            lowered = True
    return speed


@njit(**LEAF)
def _is_kept(q, times, start, acceleration):
    """Whether the acceleration at the first row keeps its limit."""
    dt = times[1] - times[0]
    for j in range(q.shape[1]):
        change = (q[1, j] - q[0, j]) / dt - start[j]
        if not 2.0 * abs(change) <= acceleration[j] * dt:
            return False
    return True


@njit(**LEAF)
def _controllable(directions, spacing, acceleration, fastest, ratios):
    """Lowers `fastest` (T-1,) to the largest speeds from which the goal can be reached, backward.

    ratios[i]: speed of step i + 1 over that of step i with which the largest speed of step i is
    reached; it is allowed at every slower speed too.
    """
    for i in range(spacing.shape[0] - 2, -1, -1):
        smallest, largest = _ratio_window(spacing[i], spacing[i + 1])
        step = _Step(directions[i], spacing[i], min(fastest[i], fastest[i + 1] / smallest))
        behind = _Step(directions[i + 1], spacing[i + 1], fastest[i + 1])
        speed = _fastest_next_to(behind, step, acceleration)
        ratio = fastest[i + 1] / speed
        if ratio > largest:  # too slow for the next step's largest speed, which must be lowered
            ratio, speed = largest, 0.0
        # Where a joint turns back or speeds up, going slower after the row can allow to go faster
        # before it.
        lower = ratio * (1.0 - _NUDGE)
        if speed < step.speed and _speed_at_ratio(lower, step, behind, acceleration) > speed:
            trial = _best_ratio(smallest, ratio, step, behind, acceleration)
            reached = _speed_at_ratio(trial, step, behind, acceleration)
            if reached > speed:
                speed, ratio = reached, trial
        fastest[i] = speed
        ratios[i] = ratio


@njit(**LEAF)
def _ratio_window(s, s_next):
    """Smallest and largest ratio of a step's speed to the one before, at constant acceleration.

    Beyond them (coming to rest, starting at rest) the differences would allow any change of speed,
    because a slow step's time makes it look gentle.
    """
    return 1.0 / (1.0 + np.sqrt(1.0 + s / s_next)), 1.0 + np.sqrt(1.0 + s_next / s)


@njit(**LEAF)
def _speed_at_ratio(ratio, step, behind, acceleration):
    """Largest speed of a step if that of the one behind is `ratio` times it; both within theirs."""
    square = min(step.speed, behind.speed / ratio) ** 2
    length = behind.length / ratio + step.length
    for j in range(acceleration.shape[0]):
        change = 2.0 * abs(behind.direction[j] * ratio - step.direction[j])
        if change * square > acceleration[j] * length:
            square = acceleration[j] * length / change
    return np.sqrt(square)


@njit(**LEAF)
def _best_ratio(low, high, step, behind, acceleration):
    """Ratio between low and high with the largest `_speed_at_ratio`, by golden sections."""
    inner, outer = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_inner = _speed_at_ratio(inner, step, behind, acceleration)
    at_outer = _speed_at_ratio(outer, step, behind, acceleration)
    for _ in range(_SECTIONS):
        if at_inner > at_outer:
            high, outer, at_outer = outer, inner, at_inner
            inner = high - _GOLDEN * (high - low)
            at_inner = _speed_at_ratio(inner, step, behind, acceleration)
        else:
            low, inner, at_inner = inner, outer, at_outer
            outer = low + _GOLDEN * (high - low)
            at_outer = _speed_at_ratio(outer, step, behind, acceleration)
    return inner if at_inner > at_outer else outer


@njit(**LEAF)
def _fastest_next_to(known, step, acceleration):
    """Largest speed y of a step, up to its own, next to one of known speed x.

    2 |b y - a x| ≤ A (s_y/y + s_x/x), the same for the step before and the one behind.  Of the
    joint that breaks it the largest root below is taken, until no joint breaks it.
    """
    a, s_x, x = known
    b, s_y, y = step
    time = s_x / x
    lowered = True
    while lowered:
        lowered = False
        for j in range(acceleration.shape[0]):
            change = b[j] * y - a[j] * x
            if 2.0 * abs(change) * y <= acceleration[j] * (time * y + s_y) * (1.0 + _ROUNDING):
                continue
            # σ = sign of the change: 2 σ b y² - c y - A s_y = 0 with c = A s_x/x + 2 σ a x
            sign = 1.0 if change > 0.0 else -1.0
            c = acceleration[j] * time + 2.0 * sign * a[j] * x
            root = np.sqrt(max(c * c + 8.0 * sign * b[j] * acceleration[j] * s_y, 0.0))
            lower = (
                0.25 * (c + root) / (sign * b[j])
                if c > 0.0
                else 2.0 * acceleration[j] * s_y / (root - c)
            )
            y = min(lower, y * (1.0 - _ROUNDING))
            lowered = True
    return y


@njit(**LEAF)
def _used(q, times, velocity, acceleration, moving):
    """Factor by which times may shrink, or must grow if above 1, to keep the limits everywhere but
    at a first row that is passed moving.
    """
    worst = 0.0
    last = q.shape[0] - 1
    for j in range(q.shape[1]):
        v_before = dt_before = 0.0
        for i in range(q.shape[0]):
            dt = times[i + 1] - times[i] if i < last else 0.0
            v = (q[i + 1, j] - q[i, j]) / dt if i < last else 0.0
            worst = max(worst, abs(v) / velocity[j])
            if i > 0 or not moving:
                square = 2.0 * abs(v - v_before) / ((dt + dt_before) * acceleration[j])
                worst = max(worst, np.sqrt(square))
            v_before, dt_before = v, dt
    return worst
