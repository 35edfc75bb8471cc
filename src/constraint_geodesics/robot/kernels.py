"""Compiled kinematics of a serial chain: one implementation for the planner, the constraint and the
training.

All kernels work in float64, on one configuration or on LANES side by side, and allocate nothing
that grows with the batch.  Shapes: D joints, `origins` (D, 4, 4) the transform from the
previous joint's frame to this joint's frame at zero, `axes` (D, 3) the joint axis in that frame,
`prismatic` (D,) bool, `tool` (4, 4) from the last joint's frame to the tool.
"""

import math
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numba import njit

from constraint_geodesics.compiled import COMPILE, LEAF

EXACT = LEAF | {"fastmath": False}
"""Those whose last bit does not hang on how a loop is compiled."""


def _split(exact: Fraction, bits: int) -> tuple[float, Fraction]:
    """A number's leading bits, and the rest."""
    unit = Fraction(2) ** (math.frexp(float(exact))[1] - bits)
    leading = (exact // unit) * unit
    return float(leading), exact - leading


# π/2 in parts, of which so many quarter turns are exact products
_FIRST, _rest = _split(Fraction(15707963267948966192313216916397514420986, 10**40), 33)
_SECOND, _rest = _split(_rest, 33)
_THIRD = float(_rest)
_QUARTERS = 2.0 / math.pi
_TO_INTEGER = 1.5 * 2.0**52  # added and taken off again, it rounds to the nearest integer
_S1, _S2, _S3, _S4, _S5, _S6, _S7, _S8 = (
    (-1) ** k / math.factorial(2 * k + 1) for k in range(1, 9)
)
_C1, _C2, _C3, _C4, _C5, _C6, _C7, _C8, _C9 = (
    (-1) ** k / math.factorial(2 * k) for k in range(1, 10)
)


# One configuration and many side by side are worked out by the same arithmetic.  A frame is three
# lines of scalars, each a coordinate of its origin and a row of its rotation: an allocation costs
# more than the arithmetic of a joint.  LLVM inlines what is short; numba, which takes long for it,
# does where a whole frame would pass through a call.
@njit(**EXACT)
def sine_cosine(angle):
    """Sine and cosine of an angle [rad], to 1e-15 up to 10⁵ rad, by their Taylor series about the
    nearest multiple of π/2: a compiler can work out many of them side by side.
    """
    turns = (angle * _QUARTERS + _TO_INTEGER) - _TO_INTEGER
    x = ((angle - turns * _FIRST) - turns * _SECOND) - turns * _THIRD
    y = x * x
    s = _S1 + y * (_S2 + y * (_S3 + y * (_S4 + y * (_S5 + y * (_S6 + y * (_S7 + y * _S8))))))
    c = _C5 + y * (_C6 + y * (_C7 + y * (_C8 + y * _C9)))
    c = _C1 + y * (_C2 + y * (_C3 + y * (_C4 + y * c)))
    s, c = x + x * y * s, 1.0 + y * c
    quarter = turns - 4.0 * np.floor(0.25 * turns)
    odd = (quarter == 1.0) | (quarter == 3.0)
    sine = c if odd else s
    cosine = s if odd else c
    sine = -sine if quarter >= 2.0 else sine
    cosine = -cosine if (quarter == 1.0) | (quarter == 2.0) else cosine
    return sine, cosine


@njit(**EXACT)
def line_of(m, i):
    """Line i of the frame that a transform (4, 4) leads to from the base."""
    return m[i, 3], m[i, 0], m[i, 1], m[i, 2]


@njit(**EXACT)
def columns_of(m):
    """A transform (4, 4) by its columns, the translation first, as `moved` takes it."""
    return (
        (m[0, 3], m[1, 3], m[2, 3]),
        (m[0, 0], m[1, 0], m[2, 0]),
        (m[0, 1], m[1, 1], m[2, 1]),
        (m[0, 2], m[1, 2], m[2, 2]),
    )


@njit(**EXACT)
def along(line, axis):
    """The product of a line's row with a column: of a frame's axis, a coordinate in the base
    frame.
    """
    return line[1] * axis[0] + line[2] * axis[1] + line[3] * axis[2]


@njit(**EXACT)
def moved(line, columns):
    """A line of the frame that a transform leads to from a frame."""
    place, x, y, z = columns
    return line[0] + along(line, place), along(line, x), along(line, y), along(line, z)


@njit(**EXACT)
def turned(line, axis, own, sine, cosine):
    """A line of a frame that was turned about its axis; own: what `along` says.  By Rodrigues'
    formula.
    """
    p, u, v, w = line
    x, y, z = axis
    rest = own * (1.0 - cosine)
    return (
        p,
        u * cosine + (v * z - w * y) * sine + rest * x,
        v * cosine + (w * x - u * z) * sine + rest * y,
        w * cosine + (u * y - v * x) * sine + rest * z,
    )


@njit(**EXACT, inline="always")
def joint_frame(origins, axes, prismatic, q, j, frame, joint_origins, joint_axes):
    """The frame that joint j carries, from that of the joint before; writes the joint's origin and
    axis.
    """
    m, axis = columns_of(origins[j]), (axes[j, 0], axes[j, 1], axes[j, 2])
    one, two, three = moved(frame[0], m), moved(frame[1], m), moved(frame[2], m)
    a0, a1, a2 = along(one, axis), along(two, axis), along(three, axis)
    joint_origins[j, 0], joint_origins[j, 1], joint_origins[j, 2] = one[0], two[0], three[0]
    joint_axes[j, 0], joint_axes[j, 1], joint_axes[j, 2] = a0, a1, a2
    if prismatic[j]:
        one = one[0] + a0 * q[j], one[1], one[2], one[3]
        two = two[0] + a1 * q[j], two[1], two[2], two[3]
        three = three[0] + a2 * q[j], three[1], three[2], three[3]
    else:
        s, c = sine_cosine(q[j])
        one = turned(one, axis, a0, s, c)
        two = turned(two, axis, a1, s, c)
        three = turned(three, axis, a2, s, c)
    return one, two, three


class Posture(NamedTuple):
    """Where an arm is, in the base frame: the tool's position (3,) [m] and rotation (3, 3), each
    joint's origin [m] and axis (D, 3).
    """

    position: np.ndarray
    rotation: np.ndarray
    origins: np.ndarray
    axes: np.ndarray


@njit(**COMPILE)
def new_posture(dof):
    """Arrays that `pose_of` writes."""
    return Posture(np.empty(3), np.empty((3, 3)), np.empty((dof, 3)), np.empty((dof, 3)))


@njit(**EXACT)
def pose_of(chain, q, posture):
    """Write the posture of one configuration."""
    # taken apart once: a field that is read in a loop counts its array's references each time
    origins, axes, prismatic, base, tool = chain
    position, rotation, joint_origins, joint_axes = posture
    frame = line_of(base, 0), line_of(base, 1), line_of(base, 2)
    for j in range(q.shape[0]):
        frame = joint_frame(origins, axes, prismatic, q, j, frame, joint_origins, joint_axes)
    m = columns_of(tool)
    one, two, three = moved(frame[0], m), moved(frame[1], m), moved(frame[2], m)
    position[0], rotation[0, 0], rotation[0, 1], rotation[0, 2] = one
    position[1], rotation[1, 0], rotation[1, 1], rotation[1, 2] = two
    position[2], rotation[2, 0], rotation[2, 1], rotation[2, 2] = three


LANES = 32
"""Configurations that are worked out side by side."""
_BLOCK = 8
"""Lanes are filled up to a multiple of these: a loop's last few take as long."""
_FEW = 6
"""Configurations below which each is worked out by itself."""


class Lanes(NamedTuple):
    """Where an arm is in up to LANES configurations: frame (3, 4, LANES), the tool's position, then
    its rotation; origins, axes (D, 3, LANES) of the joints; and their sines and cosines, or
    positions in place of sines (D, LANES).
    """

    frame: np.ndarray
    origins: np.ndarray
    axes: np.ndarray
    sines: np.ndarray
    cosines: np.ndarray


@njit(inline="always", **LEAF)
def posture_in(lanes, n):
    """The posture of configuration n."""
    frame = lanes.frame
    return Posture(frame[:, 0, n], frame[:, 1:, n], lanes.origins[:, :, n], lanes.axes[:, :, n])


@njit(**EXACT)
def _move_lanes(line, m, count):
    """`moved` of a line (4, LANES), in place.  Here and below a loop that writes more is slower:
    the compiler has to know that no output is another's input.
    """
    p, r0, r1, r2 = line[0], line[1], line[2], line[3]
    columns = columns_of(m)
    for n in range(count):
        p[n] = p[n] + along((0.0, r0[n], r1[n], r2[n]), columns[0])
    for n in range(count):
        _, r0[n], r1[n], r2[n] = moved((0.0, r0[n], r1[n], r2[n]), columns)


@njit(**EXACT)
def _turn_lanes(line, axis, own, sines, cosines, count):
    """`turned` of a line (4, LANES), in place."""
    r0, r1, r2 = line[1], line[2], line[3]
    for n in range(count):
        row = 0.0, r0[n], r1[n], r2[n]
        _, r0[n], r1[n], r2[n] = turned(row, axis, own[n], sines[n], cosines[n])


@njit(**EXACT)
def poses_of(chain, q, lanes):
    """Write the postures of at most LANES configurations (B, D), each to the bit as `pose_of`
    does.
    """
    origins, axes, prismatic, base, tool = chain
    frame, joint_origins, joint_axes, sines, cosines = lanes
    given, dof = q.shape
    if given < _FEW:
        for n in range(given):
            pose_of(chain, q[n], posture_in(lanes, n))
        return
    count = -(-given // _BLOCK) * _BLOCK
    for j in range(dof):
        angles, other = sines[j], cosines[j]
        for n in range(count):
            angles[n] = q[min(n, given - 1), j]
        if not prismatic[j]:
            for n in range(count):
                angles[n], other[n] = sine_cosine(angles[n])
    for i in range(3):
        for k in range(4):
            frame[i, k, :count] = base[i, (k + 3) % 4]
    for j in range(dof):
        axis, s, c = (axes[j, 0], axes[j, 1], axes[j, 2]), sines[j], cosines[j]
        for i in range(3):
            line = frame[i]
            _move_lanes(line, origins[j], count)
            p, r0, r1, r2 = line[0], line[1], line[2], line[3]
            o, a = joint_origins[j, i], joint_axes[j, i]
            for n in range(count):
                o[n] = p[n]
            for n in range(count):
                a[n] = along((p[n], r0[n], r1[n], r2[n]), axis)
            if prismatic[j]:
                for n in range(count):
                    p[n] += a[n] * s[n]
            else:
                _turn_lanes(line, axis, a, s, c, count)
    for i in range(3):
        _move_lanes(frame[i], tool, count)


@njit(**COMPILE)
def forward_batch(chain, q, positions, rotations):
    """Tool poses of q (B, D) into positions (B, 3) and rotations (B, 3, 3)."""
    own = new_posture(q.shape[1])
    for b in range(q.shape[0]):
        pose_of(chain, q[b], Posture(positions[b], rotations[b], own.origins, own.axes))


@njit(**LEAF)
def geometric_jacobian(prismatic, posture, jacobian):
    """Geometric Jacobian (6, D) of one posture in the base frame: linear rows [m], then angular
    rows [rad].
    """
    position, _, origins, axes = posture
    for j in range(axes.shape[0]):
        a0, a1, a2 = axes[j, 0], axes[j, 1], axes[j, 2]
        if prismatic[j]:
            jacobian[0, j], jacobian[1, j], jacobian[2, j] = a0, a1, a2
            jacobian[3, j] = jacobian[4, j] = jacobian[5, j] = 0.0
            continue
        d0 = position[0] - origins[j, 0]
        d1 = position[1] - origins[j, 1]
        d2 = position[2] - origins[j, 2]
        jacobian[0, j] = a1 * d2 - a2 * d1
        jacobian[1, j] = a2 * d0 - a0 * d2
        jacobian[2, j] = a0 * d1 - a1 * d0
        jacobian[3, j], jacobian[4, j], jacobian[5, j] = a0, a1, a2


@njit(**COMPILE)
def jacobian_batch(chain, q, jacobians):
    """Geometric Jacobians of q (B, D) into jacobians (B, 6, D)."""
    posture = new_posture(q.shape[1])
    for b in range(q.shape[0]):
        pose_of(chain, q[b], posture)
        geometric_jacobian(chain.prismatic, posture, jacobians[b])


@njit(**COMPILE)
def skeleton_batch(chain, q, points):
    """Base, joint origins and tool of q (B, D) into points (B, D + 2, 3)."""
    dof = q.shape[1]
    own = new_posture(dof)
    for b in range(q.shape[0]):
        points[b, 0] = chain.base[:3, 3]
        pose_of(
            chain, q[b], Posture(points[b, dof + 1], own.rotation, points[b, 1 : dof + 1], own.axes)
        )
