"""Axes of the tool's pose held at a reference: the constraint vector C of eq. 6, and its residual
in joint space (eq. 7).

The orientation residual neither wraps nor locks.  With E = R R_refᵀ the rotation away from the
reference: three held axes: the rotation vector of E; two held axes, axis k free: the swing that
turns e_k back, i.e. the angle θ between R R_refᵀ e_k and e_k times its direction; one held axis k:
the twist of E about e_k. The swing keeps its size up to θ = π, where the horizontal part of the
axis alone would vanish upside down too.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float
from numba import carray, njit

from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.constraints.constraint import (
    AXES,
    Constraint,
    ConstraintError,
    Pose,
    Series,
)
from constraint_geodesics.constraints.kernels import (
    CURVATURE_WORDS,
    JOINT_WORDS,
    LINEARISE_WORDS,
    TOOL_WORDS,
    ConstraintArrays,
    Rows,
    c_function,
    chain_at,
    flags,
    floats,
    lanes_at,
)
from constraint_geodesics.robot.kernels import geometric_jacobian, poses_of, posture_in
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.values import LARGEST, numbers, shown

SEEN_TOLERANCE = 0.2
"""Tolerance [rad or m] that a policy sees as 1."""
_SMALL = 1e-9


@dataclass(frozen=True)
class PoseConstraint(Constraint):
    """Which task axes x y z roll pitch yaw are held (eq. 6), how loosely, and relative to which
    pose.

    axes: six entries 0 (free) or 1 (held).  tolerance: six half-widths [m, m, m, rad, rad, rad]; 0
    holds exactly.
    reference: the pose the axes are held at, or None for the pose of the path's start. Held angles
    that share one tolerance form a cone around the reference, so that 10° on roll and pitch is a
    tilt of at most 10°; unequal ones are bounded each by itself.
    """

    kind: ClassVar[str] = "pose"
    axes: tuple[int, ...]
    tolerance: tuple[float, ...] = (0.0,) * 6
    reference: Pose | None = None

    def __post_init__(self) -> None:
        axes, widths = _entries(self.axes, "axes"), _entries(self.tolerance, "tolerance")
        for axis, held, tolerance in zip(AXES, axes, widths, strict=True):
            if held not in (0, 1):
                raise ConstraintError(f"axes[{axis}] = {held:g}: must be 0 (free) or 1 (held)")
            if not 0.0 <= tolerance <= LARGEST:
                raise ConstraintError(
                    f"tolerance[{axis}] = {tolerance:g}: must be finite and not negative"
                )
            if axis in AXES[3:] and tolerance > math.pi:
                raise ConstraintError(
                    f"tolerance[{axis}] = {tolerance:g}: must be at most π, it is in rad"
                )
            if tolerance and not held:
                raise ConstraintError(
                    f"tolerance[{axis}] = {tolerance}: the axis is free, so it can have none"
                )
        if not (self.reference is None or isinstance(self.reference, Pose)):
            line = f"reference = {shown(self.reference)}: must be a Pose, or None"
            raise ConstraintError(line)
        object.__setattr__(self, "axes", tuple(map(int, axes)))
        object.__setattr__(self, "tolerance", tuple(widths))

    @property
    def rows(self) -> Rows:
        """The six axes; held angles that share one tolerance are bounded together."""
        held, tolerance = np.array(self.axes, bool), np.array(self.tolerance)
        together = held & (np.arange(6) >= 3)
        if len(set(tolerance[together].tolist())) > 1:
            together[:] = False
        return Rows(held, tolerance, together)

    @property
    def units(self) -> tuple[str, ...]:
        """Metres, then radians."""
        return ("m",) * 3 + ("rad",) * 3

    def arrays(self, robot: SerialRobot) -> ConstraintArrays:
        """For the kernels."""
        pose, rows = self.reference or Pose(np.zeros(3), np.eye(3)), self.rows
        data = [rows.held, rows.tolerance, pose.position, np.ravel(pose.rotation)]
        write, bend = (function.address for function in _compiled())
        return ConstraintArrays(rows, np.concatenate(data), write, bend, _room(robot.dof))

    @property
    def is_free(self) -> bool:
        """Whether no axis is held."""
        return not any(self.axes)

    @property
    def is_placed(self) -> bool:
        """Whether it has a reference, or needs none."""
        return self.reference is not None or self.is_free

    def relative_to(self, pose: Pose) -> "PoseConstraint":
        """The same constraint held at `pose`."""
        if not isinstance(pose, Pose):
            raise ConstraintError(f"pose = {shown(pose)}: must be a Pose")
        return replace(self, reference=pose)

    def apart_from(self, other: Constraint) -> tuple[Constraint, Constraint]:
        """Positions that both hold exactly are the first's; so are angles, if either one's are all
        exact and among the other's exact ones, the other's.
        """
        if not isinstance(other, PoseConstraint):
            return self, other
        first, second = np.array(self.axes, bool), np.array(other.axes, bool)
        exact = first & (np.array(self.tolerance) == 0.0)
        exact_too = second & (np.array(other.tolerance) == 0.0)
        second[:3] &= ~(exact & exact_too)[:3]
        if not (second & ~(exact & exact_too))[3:].any():
            second[3:] = False
        elif not (first & ~(exact & exact_too))[3:].any():
            first[3:] = False
        return self._holding(first), other._holding(second)

    def _holding(self, held: np.ndarray) -> "PoseConstraint":
        tolerance = np.where(held, self.tolerance, 0.0).tolist()
        return replace(self, axes=tuple(held.astype(int).tolist()), tolerance=tuple(tolerance))

    def loosened(self, least: Mapping[str, float]) -> "PoseConstraint":
        """The same with every held axis loosened to the least of its unit."""
        wider = zip(self.axes, self.tolerance, self.units, strict=True)
        tolerance = tuple(max(own, least[unit]) if held else 0.0 for held, own, unit in wider)
        return replace(self, tolerance=tolerance)

    @property
    def label(self) -> str:
        """Its held axes."""
        axes = " ".join(axis for axis, held in zip(AXES, self.axes, strict=True) if held)
        return f"the constraint on {axes}" if axes else "no constraint"

    @property
    def context(self) -> Float[np.ndarray, "12"]:
        """Which axes are held, and their tolerances over SEEN_TOLERANCE."""
        return np.concatenate(
            [np.array(self.axes, bool), np.array(self.tolerance) / SEEN_TOLERANCE]
        )

    @property
    def level_axis(self) -> Float[np.ndarray, "3"] | None:
        """What points up at the reference, where roll and pitch are held."""
        if self.reference is None or not (self.axes[3] and self.axes[4]):
            return None
        return np.array(self.reference.rotation[2])

    @property
    def key(self) -> tuple:
        """Axes, tolerances and reference, to the bit."""
        pose = None if self.is_free else self.reference
        where = () if pose is None else (pose.position.tobytes(), pose.rotation.tobytes())
        return (self.kind, self.axes, self.tolerance, *where)

    def series(self, residual: Float[np.ndarray, "n 6"]) -> list[Series]:
        """Held positions each by itself [mm]; held angles that share one tolerance together
        [deg].
        """
        rows = self.rows
        found = [
            Series(AXES[i], "mm", 1e3 * abs(residual[:, i]), 1e3 * self.tolerance[i])
            for i in range(3)
            if self.axes[i]
        ]
        angles = [i for i in range(3, 6) if self.axes[i]]
        for group in [angles] if rows.together.any() else [[i] for i in angles]:
            name = "tilt" if len(group) == 2 else " ".join(AXES[i] for i in group)
            size = np.degrees(np.linalg.norm(residual[:, group], axis=1))
            found.append(Series(name, "deg", size, math.degrees(self.tolerance[group[0]])))
        return found

    def to_json(self) -> dict[str, Any]:
        """Axes, tolerance and reference; `kind` is left out, as in params.yaml."""
        pose = self.reference
        reference = (
            None
            if pose is None
            else {"position_m": pose.position.tolist(), "rotation": pose.rotation.tolist()}
        )
        return {"axes": list(self.axes), "tolerance": list(self.tolerance), "reference": reference}

    @classmethod
    def from_json(cls, about: Mapping[str, Any], robot: SerialRobot | None) -> "PoseConstraint":
        """What `to_json` wrote."""
        pose, tolerance = about["reference"], about["tolerance"]
        if not isinstance(pose, dict | None):
            raise ConstraintError(f"reference = {shown(pose)}: must be a pose")
        reference = (
            None
            if pose is None
            else Pose(np.array(pose["position_m"], float), np.array(pose["rotation"], float))
        )
        return cls(tuple(about["axes"]), tolerance, reference)

    @classmethod
    def from_params(cls, params: Any, robot: SerialRobot) -> "PoseConstraint":
        """From axes, tolerance and reference."""
        pose = params.reference
        reference = None if pose is None else Pose.from_rpy(pose.position_m, pose.rpy_rad)
        return cls(params.axes, params.tolerance, reference)


KIND = PoseConstraint


def _entries(given: Any, name: str) -> list[float]:
    """One number an axis."""
    found = numbers(given, flags=name == "axes")
    if found is None or found.ndim != 1:
        raise ConstraintError(f"{name} = {shown(given)}: must be six numbers")
    if len(found) != len(AXES):
        line = f"{name} has {len(found)} entries: one is needed for each of {' '.join(AXES)}"
        raise ConstraintError(line)
    return list(map(float, found))


@njit(**LEAF)
def _quaternion(a, b):
    """Unit quaternion (w ≥ 0, x, y, z) of the rotation E = A Bᵀ, by Shepperd's branch with the
    largest component.
    """
    e00 = a[0, 0] * b[0, 0] + a[0, 1] * b[0, 1] + a[0, 2] * b[0, 2]
    e01 = a[0, 0] * b[1, 0] + a[0, 1] * b[1, 1] + a[0, 2] * b[1, 2]
    e02 = a[0, 0] * b[2, 0] + a[0, 1] * b[2, 1] + a[0, 2] * b[2, 2]
    e10 = a[1, 0] * b[0, 0] + a[1, 1] * b[0, 1] + a[1, 2] * b[0, 2]
    e11 = a[1, 0] * b[1, 0] + a[1, 1] * b[1, 1] + a[1, 2] * b[1, 2]
    e12 = a[1, 0] * b[2, 0] + a[1, 1] * b[2, 1] + a[1, 2] * b[2, 2]
    e20 = a[2, 0] * b[0, 0] + a[2, 1] * b[0, 1] + a[2, 2] * b[0, 2]
    e21 = a[2, 0] * b[1, 0] + a[2, 1] * b[1, 1] + a[2, 2] * b[1, 2]
    e22 = a[2, 0] * b[2, 0] + a[2, 1] * b[2, 1] + a[2, 2] * b[2, 2]
    trace = e00 + e11 + e22
    if trace > 0.0:
        s = 2.0 * np.sqrt(trace + 1.0)
        w, x, y, z = 0.25 * s, (e21 - e12) / s, (e02 - e20) / s, (e10 - e01) / s
    elif e00 >= e11 and e00 >= e22:
        s = 2.0 * np.sqrt(1.0 + e00 - e11 - e22)
        w, x, y, z = (e21 - e12) / s, 0.25 * s, (e01 + e10) / s, (e02 + e20) / s
    elif e11 >= e22:
        s = 2.0 * np.sqrt(1.0 + e11 - e00 - e22)
        w, x, y, z = (e02 - e20) / s, (e01 + e10) / s, 0.25 * s, (e12 + e21) / s
    else:
        s = 2.0 * np.sqrt(1.0 + e22 - e00 - e11)
        w, x, y, z = (e10 - e01) / s, (e02 + e20) / s, (e12 + e21) / s, 0.25 * s
    if w < 0.0:
        return -w, -x, -y, -z
    return w, x, y, z


@njit(**LEAF)
def _swing(w, k, residual, linear):
    """Swing from e_k to the unit vector w into residual[3:], and its derivative (3, 3) to ω, where
    ẇ = ω × w.
    """
    i, j = (k + 1) % 3, (k + 2) % 3
    # e_k × w has the components (−w_j, w_i) along (e_i, e_j)
    si, sj, c = -w[j], w[i], w[k]
    s = np.sqrt(si * si + sj * sj)
    theta = np.arctan2(s, c)
    if s > _SMALL:
        g = theta / s
        dg = (s - theta * c) / (s * s)
    else:
        # upside down the direction is lost: lean towards e_i, so that a step is still taken
        g = 1.0 if c > 0.0 else np.pi / _SMALL
        dg = 0.0
        if c < 0.0:
            si = _SMALL
    residual[3 + i], residual[3 + j] = g * si, g * sj
    for a in range(3):
        # ω = e_a gives ẇ = e_a × w
        w0 = 0.0 if a == 0 else (w[2] if a == 1 else -w[1])
        w1 = -w[2] if a == 0 else (0.0 if a == 1 else w[0])
        w2 = w[1] if a == 0 else (-w[0] if a == 1 else 0.0)
        dw = (w0, w1, w2)
        dsi, dsj, dc = -dw[j], dw[i], dw[k]
        dtheta = (c * (si * dsi + sj * dsj) / s - s * dc) if s > _SMALL else 0.0
        linear[k, a] = 0.0
        linear[i, a] = g * dsi + dg * dtheta * si
        linear[j, a] = g * dsj + dg * dtheta * sj


@njit(**LEAF)
def _rotation_vector(quaternion, residual, linear):
    """Rotation vector of a unit quaternion into residual[3:], and the inverse left Jacobian of
    SO(3), its derivative to ω.
    """
    w, x, y, z = quaternion
    n = np.sqrt(x * x + y * y + z * z)
    theta = 2.0 * np.arctan2(n, w)
    scale = theta / n if n > _SMALL else 2.0
    r0, r1, r2 = x * scale, y * scale, z * scale
    residual[3], residual[4], residual[5] = r0, r1, r2
    if theta > 1e-4:
        half = 0.5 * theta
        b = (1.0 - half * np.cos(half) / np.sin(half)) / (theta * theta)
    else:
        b = 1.0 / 12.0
    rest = 1.0 - b * (r0 * r0 + r1 * r1 + r2 * r2)
    linear[0, 0], linear[0, 1], linear[0, 2] = (
        rest + b * r0 * r0,
        b * r0 * r1 + 0.5 * r2,
        b * r0 * r2 - 0.5 * r1,
    )
    linear[1, 0], linear[1, 1], linear[1, 2] = (
        b * r1 * r0 - 0.5 * r2,
        rest + b * r1 * r1,
        b * r1 * r2 + 0.5 * r0,
    )
    linear[2, 0], linear[2, 1], linear[2, 2] = (
        b * r2 * r0 + 0.5 * r1,
        b * r2 * r1 - 0.5 * r0,
        rest + b * r2 * r2,
    )


@njit(**LEAF)
def _twist(quaternion, k, residual, linear):
    """Twist about e_k into residual[3 + k], and its derivative to ω into row k of `linear`."""
    w, i, j = quaternion[0], (k + 1) % 3, (k + 2) % 3
    vk, vi, vj = quaternion[1 + k], quaternion[1 + i], quaternion[1 + j]
    residual[3 + k] = 2.0 * np.arctan2(vk, w)
    square = max(w * w + vk * vk, _SMALL)
    # q̇ = ½ ω ⊗ q, so ẇ = −½ ω·v and v̇_k = ½ (w ω_k + (ω × v)_k) with (ω × v)_k = ω_i v_j − ω_j
    # v_i
    linear[k, k] = (w * w + vk * vk) / square
    linear[k, i] = (w * vj + vk * vi) / square
    linear[k, j] = (-w * vi + vk * vj) / square


@njit(**LEAF)
def _last_angle(held, wanted):
    """The last of the three angles that is held (1.0), or is not (0.0)."""
    axis = 0
    for i in range(3):
        if held[3 + i] == wanted:
            axis = i
    return axis


@njit(**LEAF)
def _residual(about, position, rotation, residual, linear):
    """Residual (6,) [m, rad] of one tool pose, and the (3, 3) matrix that turns ω into its
    orientation part.

    Entries of axes that are not held are zero.
    """
    held, place, reference = about.held, about.position, about.rotation
    for i in range(3):
        residual[i] = position[i] - place[i] if held[i] else 0.0
        residual[3 + i] = 0.0
    linear[:, :] = 0.0
    count = 0
    for i in range(3):
        if held[3 + i]:
            count += 1
    if count == 0:
        return
    if count == 2:
        free = _last_angle(held, 0.0)
        v0, v1, v2 = reference[free, 0], reference[free, 1], reference[free, 2]
        w = (
            rotation[0, 0] * v0 + rotation[0, 1] * v1 + rotation[0, 2] * v2,
            rotation[1, 0] * v0 + rotation[1, 1] * v1 + rotation[1, 2] * v2,
            rotation[2, 0] * v0 + rotation[2, 1] * v1 + rotation[2, 2] * v2,
        )
        _swing(w, free, residual, linear)
        return
    quaternion = _quaternion(rotation, reference)
    if count == 3:
        _rotation_vector(quaternion, residual, linear)
        return
    _twist(quaternion, _last_angle(held, 1.0), residual, linear)


class _About(NamedTuple):
    """What of the six axes is held (1 or 0) and how loosely, and the reference pose."""

    held: np.ndarray
    tolerance: np.ndarray
    position: np.ndarray
    rotation: np.ndarray


@njit(inline="always", **COMPILE)
def _about_at(data):
    return _About(
        carray(floats(data), (6,)),
        carray(floats(data + 48), (6,)),
        carray(floats(data + 96), (3,)),
        carray(floats(data + 120), (3, 3)),
    )


def _room(dof: int) -> int:
    """Numbers for the lanes, for one orientation's derivative (3, 3) and a Jacobian (6, D)."""
    return TOOL_WORDS + JOINT_WORDS * dof + 9 + 6 * dof


def _write(
    origins, axes, prismatic, base, tool, data, q, room, residuals, jacobians, dof, rows, count
):
    chain, about = chain_at(origins, axes, prismatic, base, tool, dof), _about_at(data)
    lanes, rest = lanes_at(room, dof), room + 8 * (TOOL_WORDS + JOINT_WORDS * dof)
    linear, geometric = carray(floats(rest), (3, 3)), carray(floats(rest + 72), (6, dof))
    values = carray(floats(residuals), (count, 6))
    poses_of(chain, carray(floats(q), (count, dof)), lanes)
    for n in range(count):
        posture = posture_in(lanes, n)
        _residual(about, posture.position, posture.rotation, values[n], linear)
        if jacobians != 0:
            geometric_jacobian(chain.prismatic, posture, geometric)
            slopes = carray(floats(jacobians + 48 * dof * n), (6, dof))
            _slopes(about.held, linear, geometric, slopes)
    return 0


def _bend(prismatic, data, room, weights, full, dof, which):
    known = _curvature(
        carray(flags(prismatic), (dof,)),
        _about_at(data),
        posture_in(lanes_at(room, dof), which),
        carray(floats(weights), (6,)),
        carray(floats(full), (dof, dof)),
    )
    return 1 if known else 0


@njit(**LEAF)
def _slopes(held, linear, geometric, out):
    """The Jacobian's rows (6, D) that are held: positions as they are, angles by what turns ω into
    the residual.
    """
    for i in range(3):
        if held[i]:
            for d in range(out.shape[1]):
                out[i, d] = geometric[i, d]
        if held[3 + i]:
            for d in range(out.shape[1]):
                value = 0.0
                for a in range(3):
                    value += linear[i, a] * geometric[3 + a, d]
                out[3 + i, d] = value


@cache
def _compiled() -> tuple[Any, Any]:
    return c_function(_write, LINEARISE_WORDS), c_function(_bend, CURVATURE_WORDS)


@njit(**LEAF)
def _curvature(prismatic, about, posture, weights, full):
    """Σ λ_j ∇²r_j into `full` (D, D), for positions, and two or three angles held exactly, without
    prismatic joints.  With the joints' axes a and origins o in the base frame, i ≤ j: ∂²p/∂q_i∂q_j
    = a_i × (a_j × (p − o_j)); of a rotation vector ½ a_i × a_j; of the swing e_k × (a_i × (a_j ×
    e_k)).
    """
    held, tolerance = about.held, about.tolerance
    angles, exact = 0, True
    for i in range(3, 6):
        if held[i]:
            angles += 1
            exact = exact and tolerance[i] == 0.0
    if (weights[3] != 0.0 or weights[4] != 0.0 or weights[5] != 0.0) and (angles < 2 or not exact):
        return False
    for j in range(full.shape[0]):
        if prismatic[j]:
            return False
    position, joint_origins, joint_axes = posture.position, posture.origins, posture.axes
    l0, l1, l2 = weights[3], weights[4], weights[5]
    free = -1
    for i in range(3, 6):
        if not held[i]:
            free = i - 3
    w0, w1, w2 = 1.0 * (free == 0), 1.0 * (free == 1), 1.0 * (free == 2)
    # λ·(e_k × v) = (λ × e_k)·v
    c0, c1, c2 = l1 * w2 - l2 * w1, l2 * w0 - l0 * w2, l0 * w1 - l1 * w0
    for j in range(full.shape[0]):
        b0, b1, b2 = joint_axes[j, 0], joint_axes[j, 1], joint_axes[j, 2]
        x, y, z = (
            position[0] - joint_origins[j, 0],
            position[1] - joint_origins[j, 1],
            position[2] - joint_origins[j, 2],
        )
        p0, p1, p2 = b1 * z - b2 * y, b2 * x - b0 * z, b0 * y - b1 * x
        s0, s1, s2 = b1 * w2 - b2 * w1, b2 * w0 - b0 * w2, b0 * w1 - b1 * w0
        for i in range(j + 1):
            a0, a1, a2 = joint_axes[i, 0], joint_axes[i, 1], joint_axes[i, 2]
            value = (
                weights[0] * (a1 * p2 - a2 * p1)
                + weights[1] * (a2 * p0 - a0 * p2)
                + weights[2] * (a0 * p1 - a1 * p0)
            )
            if angles > 0 and free >= 0:
                value += (
                    c0 * (a1 * s2 - a2 * s1) + c1 * (a2 * s0 - a0 * s2) + c2 * (a0 * s1 - a1 * s0)
                )
            elif angles > 0 and i < j:
                value += 0.5 * (
                    l0 * (a1 * b2 - a2 * b1) + l1 * (a2 * b0 - a0 * b2) + l2 * (a0 * b1 - a1 * b0)
                )
            full[i, j] = full[j, i] = value
    return True
