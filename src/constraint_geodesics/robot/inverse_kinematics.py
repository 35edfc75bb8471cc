"""Inverse kinematics of any serial arm: the configurations whose tool has a given pose.

Levenberg and Marquardt's method from many seeds side by side.  Its damping follows the square of
the error [Sugihara 2011, IEEE T-RO 27(5), eq. 21]: far away a step is short and safe, beside a
solution it is Newton's.  An arm of six joints has up to 16 solutions, each found from some share of
all configurations: seeds that fill joint space evenly find them, the more seeds the surer
(tests/robot/test_inverse_kinematics.py counts).  Of an arm with more joints they find members of
each family of solutions.
"""

from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.robot.kernels import LANES, Lanes, poses_of
from constraint_geodesics.robot.kinematics import SerialRobot

SAME = 1e-3
"""Solutions that differ by less in every joint [rad or m] are one."""
_TURN = 2.0 * np.pi
_TURNS = 3
"""Whole turns of a joint that are looked at."""
_AXES = 6
_SMALL_STEP, _SMALL_ERROR = 1e-6, 1e-4
"""A step so short [rad or m] from an error so small [rad or m] leaves about its square, but where
the pose is out of reach or the arm singular.
"""
_LEFT = 1e-9
"""So the error is looked at, which may be so large at most [m, rad]."""
_BEYOND = 1e-9
"""How far beyond a limit a solution may lie [rad or m], by rounding, before it is put onto it."""


class Search(NamedTuple):
    """Settings.  seeds: configurations that it begins from.  iterations: of each, at most.
    longest: step [rad or m].  damping: added to the diagonal of J Jᵀ, times the square of the error
    [m² + rad²]; least: added to that.
    """

    seeds: int = 256
    iterations: int = 20
    longest: float = 1.0
    damping: float = 0.05
    least: float = 1e-10


def solutions(
    robot: SerialRobot,
    position: Float[np.ndarray, "3"],
    rotation: Float[np.ndarray, "3 3"],
    settings: Search | None = None,
    near: Float[np.ndarray, "D"] | None = None,
) -> Float[np.ndarray, "n D"]:
    """Configurations within the joint limits whose tool is at this position [m] and rotation in the
    base frame, to 1e-9, each once; of turning joints the values that differ by whole turns, the
    _TURNS nearest to `near` (D,) where the limits leave room for more.
    """
    settings = settings or Search()
    raw = np.empty((settings.seeds, robot.dof))
    count = _solve(
        robot.chain,
        np.ascontiguousarray(position, float),
        np.ascontiguousarray(rotation, float),
        seeds_of(robot, settings.seeds),
        settings,
        raw,
    )
    return whole_turns(robot, raw[:count], ~robot.chain.prismatic, near)


def spread(q: Float[np.ndarray, "n D"], count: int) -> Float[np.ndarray, "m D"]:
    """At most `count` of these configurations, far from each other: the first, then always the one
    furthest from all before [Gonzalez 1985].
    """
    if len(q) <= count:
        return q
    chosen = [0]
    away = np.linalg.norm(q - q[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(q - q[chosen[-1]], axis=1))
    return q[chosen]


def seeds_of(robot: SerialRobot, count: int) -> Float[np.ndarray, "n D"]:
    """Configurations that fill the joint limits evenly, not to be written to; a turning joint
    beyond a turn needs but one.
    """
    return _seeds(robot.lower.tobytes(), robot.upper.tobytes(), count)


def turned_towards(
    robot: SerialRobot, q: Float[np.ndarray, "n D"], other: Float[np.ndarray, "D"]
) -> Float[np.ndarray, "n D"]:
    """Configurations whose turning joints are moved by whole turns as near to another configuration
    as the limits let them.
    """
    turns = np.where(robot.chain.prismatic, 0.0, np.round((other - q) / _TURN))
    least, most = np.ceil((robot.lower - q) / _TURN), np.floor((robot.upper - q) / _TURN)
    return q + _TURN * np.clip(turns, least, most)


@lru_cache(maxsize=16)
def _seeds(lower: bytes, upper: bytes, count: int) -> Float[np.ndarray, "n D"]:
    low, high = np.frombuffer(lower), np.frombuffer(upper)
    middle, half = 0.5 * (low + high), np.minimum(0.5 * (high - low), np.pi)
    # shares of the root of x^(D + 1) = x + 1 fill a box evenly [Roberts 2018]
    root = 2.0
    for _ in range(64):
        root = (1.0 + root) ** (1.0 / (len(low) + 1))
    shares = root ** -np.arange(1.0, len(low) + 1.0)
    even = (0.5 + np.arange(1, count + 1)[:, None] * shares) % 1.0
    return np.ascontiguousarray(middle + half * (2.0 * even - 1.0))


def whole_turns(
    robot: SerialRobot,
    q: Float[np.ndarray, "n D"],
    turning: Bool[np.ndarray, "D"],
    near: Float[np.ndarray, "D"] | None = None,
) -> Float[np.ndarray, "m D"]:
    """Configurations [rad or m] with all whole turns of some joints that keep the limits, or the
    _TURNS nearest to `near`; none of one that breaks a limit otherwise.
    """
    lower, upper = robot.lower - _BEYOND, robot.upper + _BEYOND
    first = np.where(turning, np.ceil((lower - q) / _TURN), 0.0)
    last = np.where(turning, np.floor((upper - q) / _TURN), 0.0)
    middle = np.zeros(robot.dof) if near is None else near
    begin = np.clip(np.round((middle - q) / _TURN) - _TURNS // 2, first, last - _TURNS + 1.0)
    first = np.where(last - first >= _TURNS, begin, first)
    last = np.minimum(last, first + _TURNS - 1.0)
    inside = (turning | ((lower <= q) & (q <= upper))).all(axis=1)
    ways = inside * np.maximum(last - first + 1.0, 0.0).prod(axis=1)
    found = [(q + _TURN * first)[ways == 1.0]]
    for own, low, high in zip(*(rows[ways > 1.0] for rows in (q, first, last)), strict=True):
        turns = product(*(np.arange(a, b + 1.0) for a, b in zip(low, high, strict=True)))
        found.append(own + _TURN * np.array(list(turns)))
    return np.clip(np.concatenate(found), robot.lower, robot.upper)


class _Room(NamedTuple):
    """What the kernels write into, LANES configurations side by side: where the arms are; the
    columns of their Jacobians; J Jᵀ, its lower half; the errors, which become the weights of a
    step; and their squared sizes.
    """

    lanes: Lanes
    jacobians: np.ndarray
    normal: np.ndarray
    errors: np.ndarray
    sizes: np.ndarray


@njit(**COMPILE)
def _new_room(dof):
    lanes = Lanes(
        np.zeros((3, 4, LANES)),
        np.zeros((dof, 3, LANES)),
        np.zeros((dof, 3, LANES)),
        np.zeros((dof, LANES)),
        np.zeros((dof, LANES)),
    )
    return _Room(
        lanes,
        np.zeros((dof, _AXES, LANES)),
        np.zeros((_AXES, _AXES, LANES)),
        np.zeros((_AXES, LANES)),
        np.zeros(LANES),
    )


# Loops over the lanes write one array each: the compiler has to know that none is another's input.
@njit(**LEAF)
def _errors(frame, position, rotation, errors, sizes):
    """What the tools lack of the pose: position [m], and the axis of the rotation that is left,
    times 2 tan(θ/2) of its angle θ, no longer than 4 sin θ.
    """
    for i in range(3):
        own, out = frame[i, 0], errors[i]
        for n in range(LANES):
            out[n] = position[i] - own[n]
    for i in range(3):
        a, b, out = (i + 1) % 3, (i + 2) % 3, errors[3 + i]
        a0, a1, a2 = frame[a, 1], frame[a, 2], frame[a, 3]
        b0, b1, b2 = frame[b, 1], frame[b, 2], frame[b, 3]
        r0, r1, r2 = rotation[b, 0], rotation[b, 1], rotation[b, 2]
        s0, s1, s2 = rotation[a, 0], rotation[a, 1], rotation[a, 2]
        for n in range(LANES):
            ahead = a0[n] * r0 + a1[n] * r1 + a2[n] * r2
            out[n] = 0.5 * (ahead - b0[n] * s0 - b1[n] * s1 - b2[n] * s2)
    sizes[:] = 1.0
    for i in range(3):
        x, y, z = frame[i, 1], frame[i, 2], frame[i, 3]
        for n in range(LANES):
            sizes[n] += x[n] * rotation[i, 0] + y[n] * rotation[i, 1] + z[n] * rotation[i, 2]
    for n in range(LANES):  # the trace, 1 + 2 cos θ, and 1 more
        sizes[n] = 4.0 / max(sizes[n], 1.0)
    for i in range(3, _AXES):
        out = errors[i]
        for n in range(LANES):
            out[n] *= sizes[n]
    sizes[:] = 0.0
    for i in range(_AXES):
        own = errors[i]
        for n in range(LANES):
            sizes[n] += own[n] * own[n]


@njit(**LEAF)
def _jacobians(lanes, prismatic, jacobians):
    """Columns of the geometric Jacobians: linear [m] and angular rows [rad]."""
    frame = lanes.frame
    for j in range(jacobians.shape[0]):
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            linear, angular, axis = jacobians[j, i], jacobians[j, 3 + i], lanes.axes[j, i]
            if prismatic[j]:
                for n in range(LANES):
                    linear[n] = axis[n]
                angular[:] = 0.0
                continue
            first, second = lanes.axes[j, a], lanes.axes[j, b]
            p, o, r, s = frame[b, 0], lanes.origins[j, b], frame[a, 0], lanes.origins[j, a]
            for n in range(LANES):
                linear[n] = first[n] * (p[n] - o[n]) - second[n] * (r[n] - s[n])
            for n in range(LANES):
                angular[n] = axis[n]


@njit(**LEAF)
def _normal(jacobians, sizes, settings, normal):
    """J Jᵀ with its damping."""
    for i in range(_AXES):
        for k in range(i + 1):
            out = normal[i, k]
            out[:] = 0.0
            for j in range(jacobians.shape[0]):
                x, y = jacobians[j, i], jacobians[j, k]
                for n in range(LANES):
                    out[n] += x[n] * y[n]
        diagonal = normal[i, i]
        for n in range(LANES):
            diagonal[n] += settings.damping * sizes[n] + settings.least


@njit(**LEAF)
def _less(out, x, y):
    """Take x y off, in place."""
    for n in range(LANES):
        out[n] -= x[n] * y[n]


@njit(**LEAF)
def _times(out, x):
    for n in range(LANES):
        out[n] *= x[n]


@njit(**LEAF)
def _weights(normal, errors):
    """(J Jᵀ)⁻¹ e in the place of e, by Cholesky's factors, whose diagonal is kept inverted."""
    for i in range(_AXES):
        diagonal = normal[i, i]
        for k in range(i):
            for m in range(k):
                _less(normal[i, k], normal[i, m], normal[k, m])
            _times(normal[i, k], normal[k, k])
            _less(diagonal, normal[i, k], normal[i, k])
        for n in range(LANES):
            diagonal[n] = 1.0 / np.sqrt(max(diagonal[n], 1e-30))
    for i in range(_AXES):
        for m in range(i):
            _less(errors[i], normal[i, m], errors[m])
        _times(errors[i], normal[i, i])
    for i in range(_AXES - 1, -1, -1):
        for m in range(i + 1, _AXES):
            _less(errors[i], normal[m, i], errors[m])
        _times(errors[i], normal[i, i])


@njit(**LEAF)
def _step(q, n, jacobians, weights, longest):
    """Move configuration q (D,) of lane n; returns the length of the step [rad or m]."""
    square = 0.0
    for j in range(q.shape[0]):
        value = 0.0
        for i in range(_AXES):
            value += jacobians[j, i, n] * weights[i, n]
        square += value * value
    length = np.sqrt(square)
    scale = 1.0 if length <= longest else longest / length
    for j in range(q.shape[0]):
        for i in range(_AXES):
            q[j] += scale * jacobians[j, i, n] * weights[i, n]
    return length


@njit(**LEAF)
def _is_new(q, found, count, prismatic):
    """Whether a configuration (D,) is none of the first `count` that were found; whole turns are
    taken off it.
    """
    for j in range(q.shape[0]):
        if not prismatic[j]:
            q[j] -= _TURN * np.floor(q[j] / _TURN + 0.5)
    for k in range(count):
        largest = 0.0
        for j in range(q.shape[0]):
            apart = abs(q[j] - found[k, j])
            if not prismatic[j] and apart > np.pi:
                apart = _TURN - apart
            largest = max(largest, apart)
        if largest < SAME:
            return False
    return True


@njit(**LEAF)
def _is_there(chain, position, rotation, q, room):
    """Whether the tool of a configuration (1, D) has the pose, to _LEFT."""
    poses_of(chain, q, room.lanes)
    frame = room.lanes.frame
    trace = 0.0
    for i in range(3):
        for k in range(3):
            trace += frame[i, 1 + k, 0] * rotation[i, k]
    _errors(frame, position, rotation, room.errors, room.sizes)
    # the errors are 0 where half a turn is left as well: 1 + 2 cos θ tells the two apart
    return room.sizes[0] <= _LEFT**2 and trace > 1.0


@njit(**COMPILE)
def _solve(chain, position, rotation, seeds, settings, found):
    """What the seeds (n, D) lead to, each once, into `found` (n, D), turning joints within half a
    turn of 0; returns how many that are.
    """
    dof = seeds.shape[1]
    room, last = _new_room(dof), _new_room(dof)
    q, age = np.empty((LANES, dof)), np.zeros(LANES, dtype=np.int64)
    begun, reached, count = 0, 0, 0
    while True:
        while count < LANES and begun < seeds.shape[0]:
            q[count], age[count] = seeds[begun], 0
            begun, count = begun + 1, count + 1
        if count == 0:
            return reached
        poses_of(chain, q[:count], room.lanes)
        _errors(room.lanes.frame, position, rotation, room.errors, room.sizes)
        _jacobians(room.lanes, chain.prismatic, room.jacobians)
        _normal(room.jacobians, room.sizes, settings, room.normal)
        _weights(room.normal, room.errors)
        left = 0
        for n in range(count):
            length = _step(q[n], n, room.jacobians, room.errors, settings.longest)
            is_near = length < _SMALL_STEP and room.sizes[n] < _SMALL_ERROR**2
            if is_near and not _is_new(q[n], found, reached, chain.prismatic):
                continue
            if is_near and _is_there(chain, position, rotation, q[n : n + 1], last):
                found[reached] = q[n]
                reached += 1
            elif age[n] + 1 < settings.iterations:  # what is no number ends there
                q[left], age[left] = q[n], age[n] + 1
                left += 1
        count = left
