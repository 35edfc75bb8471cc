"""The certificate of a path: every promise checked again, by code that is not the search's.

What it takes from elsewhere are the robot's limits, the convex pieces of its links and of the
workcell with their distance (scene/bodies.py, scene/convex_kernels.py), and PyBullet's distances
where two of them come closer than the proof's margin.  Its kinematics are unit quaternions along
the chain that PyBullet itself loaded, not the project's reading of the URDF, and are compared with
PyBullet's poses of all links once.  Without PyBullet the chain is read by urdf_chain.py, nothing is
compared, and paths on which bodies come closer than the margin are refused.
A path is what an arm executes: straight joint lines between its rows.  The constraint is bounded
along all of them, by the file of its kind here, and so is the distance of all bodies that may meet,
by collision_kernels.py; joint limits hold between rows because they hold at both ends.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import chain
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float

from constraint_geodesics.certification import kernels
from constraint_geodesics.certification.certificate import (
    Certificate,
    CertificationError,
    Limits,
    Violation,
    blank,
    malformed,
    real_array,
)
from constraint_geodesics.certification.chain import read_chain
from constraint_geodesics.certification.collisions import CollisionCheck, Separation
from constraint_geodesics.certification.kept import Asked, Kept, how_kept
from constraint_geodesics.certification.motion import MotionLimits, check_times
from constraint_geodesics.certification.urdf_chain import chain_of_urdf
from constraint_geodesics.constraints.constraint import Constraint
from constraint_geodesics.scene.scene import Scene

__all__ = ["Certificate", "CertificationError", "Certifier", "Limits", "Violation"]

_TURNED = np.array([0.25, 0.5, 0.75, 1.0])[:, None]
"""Shares of the time in which an arm turns from its velocity into the first line, at which it is
looked at.
"""
_LEFT = 1e-3
"""By how much the arm may leave the constraint [rad or m] while it turns into the first line."""
_BEYOND_RAD = 1e-4
"""By how much it may pass a joint limit meanwhile [rad, or m]."""
_POSES = 24
"""Configurations at which the kinematics are compared with PyBullet's."""


class _Path(NamedTuple):
    """A path's rows (T, D), the lengths of its steps (T − 1,) [rad], each row's distance to the
    nearest limit (T,), its length, longest step and least distance, how far the last row is beyond
    the goal's region, and how the constraint is kept.
    """

    rows: np.ndarray
    steps: np.ndarray
    margins: np.ndarray
    length: float
    longest: float
    least: float
    beyond: float
    kept: Kept

    def measures(self) -> dict[str, float]:
        """What a certificate says of places."""
        attained, bound = self.kept.attained, self.kept.bound
        return {
            "length_rad": self.length,
            "max_step_rad": self.longest,
            "max_violation": max(attained.values()),
            "violation_bound": max(bound.values()),
            "max_violation_rad": attained["rad"],
            "violation_bound_rad": bound["rad"],
            "max_violation_m": attained["m"],
            "violation_bound_m": bound["m"],
            "limit_distance_rad": self.least,
            "goal_violation": self.beyond,
        }


class Certifier:
    """Certifies paths of one robot in its workcell; holds a PyBullet world, where PyBullet is
    installed, until it is closed.

    Raises CertificationError if the limits do not fit the robot, or PyBullet's chain has a joint it
    can't follow, and RobotError if a collision shape can't be bounded.
    """

    def __init__(self, scene: Scene, limits: Limits | None = None) -> None:
        self.scene = scene
        self.limits = Limits() if limits is None else limits
        robot = scene.robot
        self._dof = len(robot.joint_names)
        self._limits = np.array([robot.lower, robot.upper], float)
        self._beyond = max(self.limits.limit_tolerance_rad, _BEYOND_RAD)
        self._velocity = np.asarray(robot.velocity, float)
        wanted = self.limits.acceleration_rad_s2
        if wanted is not None and len(wanted) != self._dof:
            raise CertificationError(
                f"acceleration_rad_s2 has {len(wanted)} entries for {self._dof} joints"
            )
        self._world = scene.world_if_installed()
        try:
            loaded = (
                chain_of_urdf(robot.urdf, robot.tool_link, robot.joint_names)
                if self._world is None
                else self._world.loaded_chain()
            )
            self._chain = read_chain(loaded, self._dof)
            self.collisions = CollisionCheck(scene, self._chain, self._world, self._beyond)
            self._pose_difference, self._wrong_pose = self._compared_with_pybullet()
        except BaseException:
            self.close()
            raise

    def change(self, scene: Scene) -> None:
        """Certify in another scene of the same robot from now on.  Raises RobotError or ValueError,
        with nothing changed, where a shape can't be bounded or a link does not exist.
        """
        with self.collisions.changing(scene):
            if self._world is not None:
                self._world.change(scene.workcell, scene.attached, scene.allowed)
        self.scene = scene

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the PyBullet world."""
        if self._world is not None:
            self._world.close()

    def tool_poses(self, joints: Float[np.ndarray, "n D"]) -> Float[np.ndarray, "n 7"]:
        """Tool position [m] and quaternion (x, y, z, w) in the base frame, by the certifier's own
        kinematics.
        """
        out = np.empty((len(joints), 7))
        kernels.poses(self._chain, np.ascontiguousarray(joints, np.float64), out)
        return out

    def certify(
        self,
        joints: Float[np.ndarray, "T D"],
        constraint: Constraint,
        start: Float[np.ndarray, "D"] | None = None,
        goal: Float[np.ndarray, "D"] | None = None,
        times: Float[np.ndarray, "T"] | None = None,
        collisions: bool = True,
        region: Constraint | None = None,
        start_velocity: Float[np.ndarray, "D"] | None = None,
        scales: tuple[float, float] = (1.0, 1.0),
    ) -> Certificate:
        """Check a path [rad], with its times [s] if it has them, and report the first promise it
        breaks.  collisions: whether they are looked at.  region: what the last row must keep, as a
        constraint with a reference.  start_velocity: at the first row [rad/s], by default 0; the
        first line must go on from it within the accelerations, in its direction and at half of its
        speed at least, and the arm must not turn into it off the constraint or beyond a limit;
        where accelerations are demanded they must stop each joint before its limit.  scales: shares
        of the velocity and acceleration limits that the times must keep.

        A constraint without a reference is held relative to the tool's pose at `start`, or else at
        the first row.
        The order: the array itself, ends, the goal's region, joint limits, steps, constraint at the
        rows and between them, times, velocity and acceleration, pose, collisions.  Once one promise
        is broken no later one is looked at; what is cheap to measure is measured all the same.
        Raises CertificationError if `start` or `goal` has the wrong shape, the start's velocity is
        none or comes without times, the region has no reference, or one is no pose.
        """
        began = time.perf_counter()
        for own, name in ((constraint, "constraint"), (region, "region")):
            if not isinstance(own, Constraint) and (own is not None or name == "constraint"):
                what = f"{name} = {type(own).__name__}"
                raise CertificationError(f"{what}: must be a Constraint")
        if region is not None and not region.is_placed:
            raise CertificationError("region has no reference: any last row would keep it")
        moving = self._moving(start_velocity, times)
        ends = self._end(start, "start"), self._end(goal, "goal")
        rows, violation = self._as_rows(joints)
        if rows is None:
            return blank(violation, began)
        steps, margins = np.empty(len(rows) - 1), np.empty(len(rows))
        wrong, length, longest, least = kernels.measure(rows, self._limits, steps, margins)
        if wrong >= 0:
            text = f"row {wrong} is {rows[wrong].tolist()}: must be finite"
            return blank(malformed("not_finite", wrong, text), began)
        first = rows[0] if ends[0] is None else ends[0]
        with np.errstate(over="ignore", invalid="ignore"):
            kept = how_kept(Asked(self._chain, rows, constraint, first, self.limits))
            beyond = np.nan if region is None else self._off(rows[-1], region, rows[-1])
        clock, duration = check_times(rows, times, self._motion_limits(scales, moving))
        path = _Path(rows, steps, margins, length, longest, least, beyond, kept)
        begun = self._begun(path, constraint, first, moving, times)
        violation = next(chain(self._broken(path, *ends), clock, begun), self._wrong_pose)
        asked, apart = time.perf_counter(), Separation(violation)
        if violation is None and collisions:
            apart = self.collisions.along(rows)
            if apart.violation is None and moving.any():
                apart = self._as_it_turns(apart, rows, moving, times)
        now = time.perf_counter()
        return Certificate(
            apart.violation,
            **path.measures(),
            clearance_m=apart.clearance_m,
            asked_pybullet=apart.asked,
            rests_on=self.collisions.rests_on,
            largest_pose_difference=self._pose_difference,
            duration_s=duration,
            time_s=now - began,
            collision_time_s=now - asked,
            start_velocity=tuple(moving.tolist()) if moving.any() else None,
        )

    def _broken(
        self, path: _Path, start: np.ndarray | None, goal: np.ndarray | None
    ) -> Iterator[Violation]:
        """The promises on places that are broken, in the order of the checks."""
        checks: tuple[Callable[[], Violation | None], ...] = (
            lambda: self._missed("start_missed", path.rows, 0, start),
            lambda: self._missed("goal_missed", path.rows, len(path.rows) - 1, goal),
            lambda: self._beside(path),
            lambda: self._outside(path),
            lambda: self._jump(path),
            lambda: path.kept.at_rows,
            lambda: path.kept.between_rows,
        )
        yield from (found for check in checks if (found := check()) is not None)

    def _as_rows(self, joints: Any) -> tuple[Float[np.ndarray, "T D"] | None, Violation | None]:
        """The path as an array of at least two rows, or why it is none."""
        table = real_array(joints)
        if table is None or table.ndim != 2 or table.shape[1] != self._dof:
            what = "no array of real numbers" if table is None else f"of shape {table.shape}"
            return None, malformed(
                "shape", None, f"the path is {what}: (T, {self._dof}) real numbers are needed"
            )
        if len(table) < 2:
            return None, malformed(
                "too_short", None, f"the path has {len(table)} rows: at least 2 are needed"
            )
        return table, None

    def _end(self, wanted: Any, name: str) -> np.ndarray | None:
        if wanted is None:
            return None
        end = real_array(wanted)
        if end is None or end.shape != (self._dof,):
            raise CertificationError(f"{name} = {wanted}: {self._dof} joint values are needed")
        return end

    def _moving(self, velocity: Any, times: Any) -> np.ndarray:
        """The velocity at the first row (D,), 0 for none."""
        if velocity is None:
            return np.zeros(self._dof)
        if times is None:
            raise CertificationError("start_velocity goes with times: there are none")
        found = self._end(velocity, "start_velocity")
        if found is None or not np.isfinite(found).all():
            raise CertificationError(f"start_velocity = {velocity}: must be finite")
        return found

    def _begun(
        self,
        path: _Path,
        constraint: Constraint,
        first: np.ndarray,
        velocity: np.ndarray,
        times: Any,
    ) -> Iterator[Violation]:
        """Where the velocity at the first row leads: beyond a joint limit, or off the constraint.
        The times are sound.
        """
        if not velocity.any():
            return
        q, most, (lower, upper) = path.rows[0], self.limits.acceleration_rad_s2, self._limits
        if most is not None:
            room = np.where(velocity > 0.0, upper - q, q - lower)
            needed = velocity**2 / (2.0 * np.asarray(most))
            beyond = np.where(velocity == 0.0, 0.0, needed - room)
            if beyond.max() > (allowed := self.limits.limit_tolerance_rad):
                joint = int(np.argmax(beyond))
                text = (
                    f"joint {joint} of row 0 moves at {velocity[joint]:.4g} rad/s and needs "
                    f"{needed[joint]:.4g} rad to stop, its limit is {room[joint]:.4g} rad away"
                )
                yield Violation("joint_limits", 0, float(beyond[joint]), allowed, text)
        reached = _reached(path.rows, velocity, times)
        beyond = np.maximum(lower - reached, reached - upper).max(axis=0)
        if beyond.max() > (allowed := self._beyond):
            joint = int(np.argmax(beyond))
            text = (
                f"joint {joint} of row 0 moves at {velocity[joint]:.4g} rad/s, and gets "
                f"{beyond[joint]:.3g} rad beyond its limit before the line is followed"
            )
            yield Violation("joint_limits", 0, float(beyond[joint]), allowed, text)
        with np.errstate(over="ignore", invalid="ignore"):
            turned = _turned(path.rows, velocity, times)
            left = float(np.max([self._off(q, constraint, first) for q in turned]))
        if not left <= _LEFT:
            text = (
                f"the velocity at row 0 leads off the constraint: it is left by {left:.3g} rad or "
                f"m before the line is followed, {_LEFT:.3g} is allowed"
            )
            yield Violation("start_velocity", 0, left, _LEFT, text)

    def _motion_limits(self, scales: tuple[float, float], moving: np.ndarray) -> MotionLimits:
        most = self.limits.acceleration_rad_s2
        scaled = None if most is None else tuple(scales[1] * value for value in most)
        return MotionLimits(scales[0] * self._velocity, scaled, moving)

    def _as_it_turns(
        self, apart: Separation, rows: np.ndarray, velocity: np.ndarray, times: Any
    ) -> Separation:
        """What was found on the lines, and beside the first one, where the arm turns into it."""
        turn = np.concatenate([rows[:1], _turned(rows, velocity, times), rows[1:2]])
        beside = self.collisions.along(turn)
        if (found := beside.violation) is not None:
            text = f"as the arm turns into the line from row 0: {found.message}"
            return Separation(replace(found, row=0, message=text))
        least = min(apart.clearance_m, beside.clearance_m)
        return Separation(None, least, apart.asked + beside.asked)

    def _off(self, q: np.ndarray, constraint: Constraint, first: np.ndarray) -> float:
        """How far a configuration is off a constraint [rad or m]."""
        asked = Asked(self._chain, np.stack([q, q]), constraint, first, self.limits)
        return max(how_kept(asked).attained.values())

    def _missed(
        self, kind: str, rows: np.ndarray, row: int, end: np.ndarray | None
    ) -> Violation | None:
        if end is None:
            return None
        off = np.abs(rows[row] - end)
        value, allowed = float(off.max()), self.limits.end_tolerance_rad
        if value <= allowed:
            return None
        which = (
            f"joint {int(np.argmax(off))} of row {row} is {value:.3g} rad away from the "
            f"{kind.split('_')[0]}"
        )
        return Violation(kind, row, value, allowed, f"{which}, {allowed:.3g} rad is allowed")

    def _beside(self, path: _Path) -> Violation | None:
        allowed, row = self.limits.violation_tolerance, len(path.rows) - 1
        if not path.beyond > allowed:
            return None
        text = (
            f"row {row}, the last, is {path.beyond:.3g} rad or m beyond the goal's region, "
            f"{allowed:.3g} is allowed"
        )
        return Violation("goal_missed", row, path.beyond, allowed, text)

    def _outside(self, path: _Path) -> Violation | None:
        allowed = self.limits.limit_tolerance_rad
        if path.least >= -allowed:
            return None
        row = int(np.argmax(path.margins < -allowed))
        q, (lower, upper) = path.rows[row], self._limits
        joint = int(np.argmin(np.minimum(q - lower, upper - q)))
        limits = f"[{lower[joint]:.6g}, {upper[joint]:.6g}]"
        text = f"joint {joint} of row {row} is {q[joint]:.9g} rad, its limits are {limits} rad"
        return Violation("joint_limits", row, float(-path.margins[row]), allowed, text)

    def _jump(self, path: _Path) -> Violation | None:
        allowed = self.limits.max_step_rad
        if path.longest <= allowed:
            return None
        row = int(np.argmax(~(path.steps <= allowed)))
        step = float(path.steps[row])
        text = f"rows {row} and {row + 1} are {step:.6g} rad apart, {allowed:.6g} rad is allowed"
        return Violation("step", row, step, allowed, text)

    def _compared_with_pybullet(self) -> tuple[float, Violation | None]:
        """The certifier's kinematics against PyBullet's, of all links at configurations spread over
        the limits [rad or m, the larger], nan without PyBullet; what is wrong with a difference
        that is too large.
        """
        if self._world is None:
            return np.nan, None
        low, high = np.clip(self._limits, -np.pi, np.pi)
        drawn = np.random.default_rng(0).uniform(low, high, (_POSES, self._dof))
        theirs, own = self._world.label(drawn), self.tool_poses(drawn)
        value = _largest(own, np.hstack([theirs.position, theirs.quaternion]))
        value = max(value, self.collisions.pose_difference(drawn, self._world))
        allowed = self.limits.pose_tolerance
        if value <= allowed:
            return value, None
        text = (
            f"the robot's links are {value:.3g} (rad or m) off PyBullet's somewhere within the "
            f"limits, {allowed:.3g} is allowed"
        )
        return value, Violation("pose", None, value, allowed, text)


def _turned(
    rows: Float[np.ndarray, "T D"], velocity: Float[np.ndarray, "D"], times: Any
) -> Float[np.ndarray, "n D"]:
    """Where an arm is while its velocity changes, evenly, from that at the first row to the first
    line's own in its middle.
    """
    half, line = _first_line(rows, times)
    passed = half * _TURNED
    return rows[0] + passed * velocity + 0.5 * passed**2 / half * (line - velocity)


def _reached(
    rows: Float[np.ndarray, "T D"], velocity: Float[np.ndarray, "D"], times: Any
) -> Float[np.ndarray, "2 D"]:
    """What each joint reaches at most while the velocity changes so: where it turns back, if it
    does, and where it is at the end.
    """
    half, line = _first_line(rows, times)
    end = 0.5 * half * (velocity + line)
    back = velocity * line < 0.0
    peak = 0.5 * half * velocity**2 / np.where(back, velocity - line, 1.0)
    return rows[0] + np.stack([np.where(back, peak, end), end])


def _first_line(rows: Float[np.ndarray, "T D"], times: Any) -> tuple[float, np.ndarray]:
    """Half of the first line's time [s], and its velocity."""
    half = 0.5 * float(times[1] - times[0])
    return half, 0.5 * (rows[1] - rows[0]) / half


def _largest(own: Float[np.ndarray, "n 7"], theirs: Float[np.ndarray, "n 7"]) -> float:
    """The largest difference of poses, positions [m] and quaternions [rad]."""
    metres = np.linalg.norm(own[:, :3] - theirs[:, :3], axis=1)
    same = own[:, 3:] * np.sign((own[:, 3:] * theirs[:, 3:]).sum(axis=1, keepdims=True))
    chord = np.linalg.norm(same - theirs[:, 3:], axis=1)
    return float(np.maximum(metres, 4.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))).max())
