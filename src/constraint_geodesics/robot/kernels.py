"""Compiled kinematics of a serial chain: one implementation for the planner, the constraint and the
training.

All kernels work in float64 on one configuration and allocate nothing that grows with the batch, so
that a retraction costs microseconds.  Shapes: D joints, `origins` (D, 4, 4) the transform from the
previous joint's frame to this joint's frame at zero, `axes` (D, 3) the joint axis in that frame,
`prismatic` (D,) bool, `tool` (4, 4) from the last joint's frame to the tool.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from constraint_geodesics.compiled import COMPILE, LEAF


# A frame is a tuple of scalars, its position and its rotation by rows: an allocation costs more
# than the arithmetic of a joint.  The three functions below are inlined, since passing a frame
# through a call is slower.
@njit(**COMPILE, inline="always")
def frame_of(m):
    """The frame that a transform (4, 4) leads to from the base."""
    return (
        m[0, 3],
        m[1, 3],
        m[2, 3],
        m[0, 0],
        m[0, 1],
        m[0, 2],
        m[1, 0],
        m[1, 1],
        m[1, 2],
        m[2, 0],
        m[2, 1],
        m[2, 2],
    )


@njit(**COMPILE, inline="always")
def moved_frame(frame, m):
    """The frame that a transform (4, 4) leads to from `frame`."""
    p0, p1, p2, r00, r01, r02, r10, r11, r12, r20, r21, r22 = frame
    return (
        p0 + r00 * m[0, 3] + r01 * m[1, 3] + r02 * m[2, 3],
        p1 + r10 * m[0, 3] + r11 * m[1, 3] + r12 * m[2, 3],
        p2 + r20 * m[0, 3] + r21 * m[1, 3] + r22 * m[2, 3],
        r00 * m[0, 0] + r01 * m[1, 0] + r02 * m[2, 0],
        r00 * m[0, 1] + r01 * m[1, 1] + r02 * m[2, 1],
        r00 * m[0, 2] + r01 * m[1, 2] + r02 * m[2, 2],
        r10 * m[0, 0] + r11 * m[1, 0] + r12 * m[2, 0],
        r10 * m[0, 1] + r11 * m[1, 1] + r12 * m[2, 1],
        r10 * m[0, 2] + r11 * m[1, 2] + r12 * m[2, 2],
        r20 * m[0, 0] + r21 * m[1, 0] + r22 * m[2, 0],
        r20 * m[0, 1] + r21 * m[1, 1] + r22 * m[2, 1],
        r20 * m[0, 2] + r21 * m[1, 2] + r22 * m[2, 2],
    )


@njit(**COMPILE, inline="always")
def joint_frame(origins, axes, prismatic, q, j, frame, joint_origins, joint_axes):
    """The frame that joint j carries, from that of the joint before; writes the joint's origin and
    axis.
    """
    p0, p1, p2, r00, r01, r02, r10, r11, r12, r20, r21, r22 = moved_frame(frame, origins[j])
    x, y, z = axes[j, 0], axes[j, 1], axes[j, 2]
    a0 = r00 * x + r01 * y + r02 * z
    a1 = r10 * x + r11 * y + r12 * z
    a2 = r20 * x + r21 * y + r22 * z
    joint_origins[j, 0], joint_origins[j, 1], joint_origins[j, 2] = p0, p1, p2
    joint_axes[j, 0], joint_axes[j, 1], joint_axes[j, 2] = a0, a1, a2
    if prismatic[j]:
        p0, p1, p2 = p0 + a0 * q[j], p1 + a1 * q[j], p2 + a2 * q[j]
    else:
        # Rodrigues' rotation of each column c about the axis a: c cos + (a × c) sin + a (a·c)(1 −
        # cos)
        c, s = np.cos(q[j]), np.sin(q[j])
        x, y, z = x * (1.0 - c), y * (1.0 - c), z * (1.0 - c)
        r00, r10, r20 = (
            r00 * c + (a1 * r20 - a2 * r10) * s + a0 * x,
            r10 * c + (a2 * r00 - a0 * r20) * s + a1 * x,
            r20 * c + (a0 * r10 - a1 * r00) * s + a2 * x,
        )
        r01, r11, r21 = (
            r01 * c + (a1 * r21 - a2 * r11) * s + a0 * y,
            r11 * c + (a2 * r01 - a0 * r21) * s + a1 * y,
            r21 * c + (a0 * r11 - a1 * r01) * s + a2 * y,
        )
        r02, r12, r22 = (
            r02 * c + (a1 * r22 - a2 * r12) * s + a0 * z,
            r12 * c + (a2 * r02 - a0 * r22) * s + a1 * z,
            r22 * c + (a0 * r12 - a1 * r02) * s + a2 * z,
        )
    return p0, p1, p2, r00, r01, r02, r10, r11, r12, r20, r21, r22


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


@njit(**LEAF)
def pose_of(chain, q, posture):
    """Write the posture of one configuration."""
    # taken apart once: a field that is read in a loop counts its array's references each time
    origins, axes, prismatic, base, tool = chain
    position, rotation, joint_origins, joint_axes = posture
    frame = frame_of(base)
    for j in range(q.shape[0]):
        frame = joint_frame(origins, axes, prismatic, q, j, frame, joint_origins, joint_axes)
    p0, p1, p2, r00, r01, r02, r10, r11, r12, r20, r21, r22 = moved_frame(frame, tool)
    position[0], position[1], position[2] = p0, p1, p2
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = r00, r01, r02
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = r10, r11, r12
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = r20, r21, r22


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
