"""The certificate of a path: every promise checked again, by code that shares no geometry with the
search.

What it takes from elsewhere are the robot's limits and PyBullet's word on collisions
(robot/bullet.py).  Its kinematics are unit quaternions along the chain that PyBullet itself loaded,
not the project's reading of the URDF, and are compared with PyBullet's poses in every certificate.
A path is what an arm executes: straight joint lines between its rows.  The constraint is bounded
along all of them (proof in kernels.py); joint limits hold between rows because they hold at both
ends; collisions are examined at points of the path, so they are sampled, not proven.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float

from constraint_geodesics.certification import kernels
from constraint_geodesics.constraints.pose import Constraint, Pose
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.world import LoadedChain

_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
_POSE_ROWS = 5
_MOST_PIECES = 64
# share of the violation's tolerance that the interpolation between two stations may add to a bound
_INTERPOLATION_SHARE = 0.01
_VELOCITY_SLACK = 1e-9
_ACCELERATION_SLACK = 1e-6


class CertificationError(ValueError):
    """A question that can't be answered, as opposed to a path that is no good; the message names
    the value.
    """


@dataclass(frozen=True)
class Limits:
    """What is demanded of a path.

    end_tolerance_rad: of each joint at the start and the goal.  max_step_rad: between rows, in
    Euclidean norm.
    violation_tolerance: of the constraint beyond its own tolerance, rad or m, at and between rows.
    collision_spacing_rad: between the configurations examined for collision, along the path.
    acceleration_rad_s2: of each joint, or None for no demand.  pose_tolerance: rad or m, against
    PyBullet's pose.
    Raises CertificationError for a value that is negative, not finite, or zero where it must be
    positive.
    """

    end_tolerance_rad: float = 1e-6
    max_step_rad: float = 0.1
    violation_tolerance: float = 1e-4
    limit_tolerance_rad: float = 1e-9
    collision_spacing_rad: float = 0.05
    acceleration_rad_s2: tuple[float, ...] | None = None
    pose_tolerance: float = 1e-6

    def __post_init__(self) -> None:
        for name in (
            "end_tolerance_rad",
            "violation_tolerance",
            "limit_tolerance_rad",
            "pose_tolerance",
        ):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise CertificationError(f"{name} = {value}: must be finite and not negative")
        for name in ("max_step_rad", "collision_spacing_rad"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise CertificationError(f"{name} = {value}: must be finite and positive")
        for value in self.acceleration_rad_s2 or ():
            if not value > 0:
                raise CertificationError(
                    f"acceleration_rad_s2 = {self.acceleration_rad_s2}: each must be positive"
                )


@dataclass(frozen=True)
class Violation:
    """The first promise a path breaks: its kind, the row or segment (a segment has its first row's
    index), by how much.

    value and limit are in the message's unit; both are nan where there is no number to compare.
    """

    kind: str
    row: int | None
    value: float
    limit: float
    message: str


@dataclass(frozen=True)
class Certificate:
    """What was found; a measure is nan where a path is too malformed to have it.

    max_violation: largest excess over the constraint's tolerance among the rows and the worst place
    between them; violation_bound: proven for the whole piecewise linear path; both the larger of
    the angles' [rad] and the positions' [m], which also stand separately.  limit_distance_rad: to
    the nearest joint limit, negative outside.
    collision_checks: configurations examined.  largest_pose_difference: of the tool pose from
    PyBullet's [rad or m].
    duration_s: nan without times.  time_s: what certification took,
    of which collision_time_s for PyBullet's checks of pose and collision.
    """

    violation: Violation | None
    length_rad: float
    max_step_rad: float
    max_violation: float
    violation_bound: float
    max_violation_rad: float
    violation_bound_rad: float
    max_violation_m: float
    violation_bound_m: float
    limit_distance_rad: float
    collision_checks: int
    largest_pose_difference: float
    duration_s: float
    time_s: float
    collision_time_s: float

    @property
    def valid(self) -> bool:
        """Whether every promise is kept."""
        return self.violation is None

    def summary(self) -> dict[str, Any]:
        """All of it as JSON takes it; what is not a number is None."""
        measures = {name: value for name, value in vars(self).items() if name != "violation"}
        known = {name: None if np.isnan(value) else value for name, value in measures.items()}
        broken = (
            None
            if self.violation is None
            else {
                name: None if isinstance(value, float) and np.isnan(value) else value
                for name, value in vars(self.violation).items()
            }
        )
        return {"valid": self.valid, "violation": broken, **known}


class _Chain(NamedTuple):
    """The chain as kernels.py describes it."""

    turns: Float[np.ndarray, "D+1 4"]
    offsets: Float[np.ndarray, "D+1 3"]
    prismatic: np.ndarray
    lengths: Float[np.ndarray, "D+1"]


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

    kinematics: _Chain
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


class _Broken(NamedTuple):
    """Where one channel first passes its tolerance by too much, and by how much."""

    row: int
    excess: float
    channel: _Channel


@dataclass(frozen=True)
class _Kept:
    """How well the constraint is kept: excesses in rad (angles) and m (positions), and what is too
    much.
    """

    attained: dict[str, float]
    bound: dict[str, float]
    at_rows: Violation | None
    between_rows: Violation | None


class Certifier:
    """Certifies paths of one robot in its workcell; holds a PyBullet world until it is closed.

    Raises CertificationError if the limits do not fit the robot, or PyBullet's chain has a joint it
    can't follow.
    """

    def __init__(self, scene: Scene, limits: Limits | None = None) -> None:
        self.scene = scene
        self.limits = Limits() if limits is None else limits
        robot = scene.robot
        self._dof = len(robot.joint_names)
        self._lower, self._upper = np.asarray(robot.lower, float), np.asarray(robot.upper, float)
        self._velocity = np.asarray(robot.velocity, float)
        wanted = self.limits.acceleration_rad_s2
        if wanted is not None and len(wanted) != self._dof:
            raise CertificationError(
                f"acceleration_rad_s2 has {len(wanted)} entries for {self._dof} joints"
            )
        self._world = scene.world()
        self._chain = _read_chain(self._world.loaded_chain(), self._dof)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free the PyBullet world."""
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
    ) -> Certificate:
        """Check a path [rad], with its times [s] if it has them, and report the first promise it
        breaks.

        A constraint without a reference is held relative to the tool's pose at `start`, or else at
        the first row.
        The order: the array itself, ends, joint limits, steps, constraint at the rows and between
        them, times, velocity and acceleration, pose, self-collision, collision with the workcell.
        A collision reported is the first one met in a coarse-to-fine order.  Once one promise is
        broken no later one is looked at; what is cheap to measure is measured all the same.
        Raises CertificationError if `start` or `goal` has the wrong shape, or the reference is no
        pose.
        """
        began = time.perf_counter()
        ends = self._end(start, "start"), self._end(goal, "goal")
        rows, violation = self._as_rows(joints)
        if rows is None:
            return _blank(violation, began)
        with np.errstate(over="ignore", invalid="ignore"):
            steps = np.sqrt(np.square(np.diff(rows, axis=0)).sum(axis=1))
            margin = np.minimum(rows - self._lower, self._upper - rows).min(axis=1)
            kept = self._kept(rows, constraint, rows[0] if ends[0] is None else ends[0])
        clock, duration = self._clock(rows, times)
        checks: tuple[Callable[[], Violation | None], ...] = (
            lambda: self._missed("start_missed", rows, 0, ends[0]),
            lambda: self._missed("goal_missed", rows, len(rows) - 1, ends[1]),
            lambda: self._outside(rows, margin),
            lambda: self._jump(steps),
            lambda: kept.at_rows,
            lambda: kept.between_rows,
            lambda: next(clock, None),
        )
        violation = next((found for check in checks if (found := check()) is not None), None)
        difference, examined = float("nan"), 0
        asked = time.perf_counter()
        if violation is None:
            difference, violation = self._pose_difference(rows)
        if violation is None and collisions:
            examined, violation = self._collision(rows, steps)
        return Certificate(
            violation,
            float(steps.sum()),
            float(steps.max()),
            max(kept.attained.values()),
            max(kept.bound.values()),
            kept.attained["rad"],
            kept.bound["rad"],
            kept.attained["m"],
            kept.bound["m"],
            float(margin.min()),
            examined,
            difference,
            duration,
            time.perf_counter() - began,
            time.perf_counter() - asked,
        )

    def _as_rows(self, joints: Any) -> tuple[Float[np.ndarray, "T D"] | None, Violation | None]:
        """The path as an array of at least two finite rows, or why it is none."""
        table = _array(joints)
        if table is None or table.ndim != 2 or table.shape[1] != self._dof:
            what = "no array of real numbers" if table is None else f"of shape {table.shape}"
            return None, _malformed(
                "shape", None, f"the path is {what}: (T, {self._dof}) real numbers are needed"
            )
        if len(table) < 2:
            return None, _malformed(
                "too_short", None, f"the path has {len(table)} rows: at least 2 are needed"
            )
        finite = np.isfinite(table).all(axis=1)
        if not finite.all():
            row = int(np.argmin(finite))
            return None, _malformed(
                "not_finite", row, f"row {row} is {table[row].tolist()}: must be finite"
            )
        return table, None

    def _end(self, wanted: Any, name: str) -> np.ndarray | None:
        if wanted is None:
            return None
        end = _array(wanted)
        if end is None or end.shape != (self._dof,):
            raise CertificationError(f"{name} = {wanted}: {self._dof} joint values are needed")
        return end

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

    def _outside(self, rows: np.ndarray, margin: np.ndarray) -> Violation | None:
        allowed = self.limits.limit_tolerance_rad
        wrong = margin < -allowed
        if not wrong.any():
            return None
        row = int(np.argmax(wrong))
        joint = int(np.argmin(np.minimum(rows[row] - self._lower, self._upper - rows[row])))
        limits = f"[{self._lower[joint]:.6g}, {self._upper[joint]:.6g}]"
        text = (
            f"joint {joint} of row {row} is {rows[row, joint]:.9g} rad, its limits are {limits} rad"
        )
        return Violation("joint_limits", row, float(-margin[row]), allowed, text)

    def _jump(self, steps: np.ndarray) -> Violation | None:
        allowed = self.limits.max_step_rad
        wrong = ~(steps <= allowed)
        if not wrong.any():
            return None
        row = int(np.argmax(wrong))
        text = (
            f"rows {row} and {row + 1} are {steps[row]:.6g} rad apart, {allowed:.6g} rad is allowed"
        )
        return Violation("step", row, float(steps[row]), allowed, text)

    def _kept(self, rows: np.ndarray, constraint: Constraint, first: np.ndarray) -> _Kept:
        """How well the constraint is kept at the rows and on the whole path."""
        attained, bound = {"rad": 0.0, "m": 0.0}, {"rad": 0.0, "m": 0.0}
        if constraint.is_free:
            return _Kept(attained, bound, None, None)
        position, quaternion = self._reference(constraint.reference, first)
        held = _Held(
            self._chain, *_angles_held(constraint, quaternion), any(constraint.axes[:3]), position
        )
        line = self._cut(rows)
        curves = held.trace(line.stations)
        broken_rows: list[_Broken] = []
        broken_segments: list[_Broken] = []
        for channel in _channels(constraint, held.kind, held.axis):
            limit = channel.tolerance + self.limits.violation_tolerance
            sizes = channel.values(curves)[line.rows]
            if not sizes.max() <= limit:
                row = int(np.argmax(~(sizes <= limit)))
                broken_rows.append(_Broken(row, float(sizes[row]) - channel.tolerance, channel))
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
                broken_segments.append(
                    _Broken(int(segment), float(value) - channel.tolerance, channel)
                )
            # the interpolant says where the path is worst; what counts as attained is its true
            # value there
            place = line.stations[piece] + t * (line.stations[piece + 1] - line.stations[piece])
            largest = np.append(sizes, channel.values(held.trace(place[None]))).max()
            largest = np.inf if np.isnan(largest) else largest  # joint values that overflow
            attained[channel.unit] = max(attained[channel.unit], float(largest) - channel.tolerance)
            bound[channel.unit] = max(bound[channel.unit], float(highest) - channel.tolerance)
        return _Kept(
            attained,
            bound,
            self._left("constraint", "in row", broken_rows),
            self._left("constraint_between_rows", "on the line from row", broken_segments),
        )

    def _cut(self, rows: np.ndarray) -> _Line:
        """The path in pieces that are short enough for the interpolation."""
        counts = np.empty(len(rows) - 1, dtype=np.int64)
        wanted = max(_INTERPOLATION_SHARE * self.limits.violation_tolerance, 1e-9)
        pieces = kernels.count_pieces(self._chain, rows, wanted, _MOST_PIECES, counts)
        stations, segments = np.empty((pieces + 1, self._dof)), np.empty(pieces, dtype=np.int64)
        turned, fourth = np.empty(pieces), np.empty(pieces)
        kernels.cut(self._chain, rows, counts, stations, segments, turned, fourth)
        return _Line(np.concatenate([[0], np.cumsum(counts)]), stations, segments, turned, fourth)

    def _left(self, kind: str, where: str, broken: list[_Broken]) -> Violation | None:
        """The first place where the constraint is left, as a violation."""
        if not broken:
            return None
        first = min(broken, key=lambda each: each.row)
        channel, allowed = first.channel, self.limits.violation_tolerance
        text = (
            f"{where} {first.row} {channel.name} is beyond its tolerance of "
            f"{channel.tolerance:.3g} {channel.unit} by "
            f"{'' if kind == 'constraint' else 'up to '}{first.excess:.3g} {channel.unit}, "
            f"{allowed:.3g} is allowed"
        )
        return Violation(kind, first.row, first.excess, allowed, text)

    def _reference(self, pose: Pose | None, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) [m] and quaternion (w, x, y, z) of the reference: the constraint's, or that
        of a row.
        """
        if pose is not None:
            return np.ascontiguousarray(pose.position, np.float64), _quaternion(
                np.asarray(pose.rotation, float)
            )
        own = self.tool_poses(first[None])[0]
        return own[:3], own[[6, 3, 4, 5]]

    def _clock(self, rows: np.ndarray, times: Any) -> tuple[Iterator[Violation], float]:
        """What is wrong with the times, in the order of the checks, and the duration [s]."""
        if times is None:
            return iter(()), float("nan")
        clock = _array(times)
        if clock is None or clock.shape != (len(rows),):
            what = "no array of real numbers" if clock is None else f"of shape {clock.shape}"
            text = f"the times are {what}: ({len(rows)},) is needed, one for each row"
            return iter([_malformed("times_shape", None, text)]), float("nan")
        return self._paces(rows, clock), float(clock[-1] - clock[0])

    def _paces(self, rows: np.ndarray, times: np.ndarray) -> Iterator[Violation]:
        finite = np.isfinite(times)
        if not finite.all():
            row = int(np.argmin(finite))
            yield _malformed(
                "times_not_finite", row, f"the time of row {row} is {times[row]}: must be finite"
            )
        if times[0] != 0.0:
            yield Violation(
                "times_start",
                0,
                float(times[0]),
                0.0,
                f"the times start at {times[0]:.6g} s, not at 0 s",
            )
        with np.errstate(all="ignore"):
            dt = np.diff(times)
            if not (dt > 0).all():
                row = int(np.argmax(~(dt > 0)))
                text = (
                    f"row {row + 1} is at {times[row + 1]:.9g} s, row {row} at "
                    f"{times[row]:.9g} s: times must rise"
                )
                yield Violation("times_order", row, float(dt[row]), 0.0, text)
            velocity = np.diff(rows, axis=0) / dt[:, None]
            yield from _too_much(
                "velocity",
                "on the line from row",
                "rad/s",
                velocity,
                self._velocity,
                _VELOCITY_SLACK,
            )
            wanted = self.limits.acceleration_rad_s2
            if wanted is not None:
                padded = np.pad(velocity, ((1, 1), (0, 0)))
                around = np.pad(dt, 1)
                acceleration = np.diff(padded, axis=0) / (0.5 * (around[1:] + around[:-1]))[:, None]
                limits = np.asarray(wanted, float)
                yield from _too_much(
                    "acceleration", "at row", "rad/s²", acceleration, limits, _ACCELERATION_SLACK
                )

    def _pose_difference(self, rows: np.ndarray) -> tuple[float, Violation | None]:
        """The certifier's kinematics against PyBullet's, at rows spread over the path [rad or m,
        the larger].
        """
        chosen = np.unique(np.linspace(0, len(rows) - 1, _POSE_ROWS).round().astype(int))
        theirs = self._world.label(rows[chosen])
        own = self.tool_poses(rows[chosen])
        metres = np.sqrt(np.square(own[:, :3] - theirs.position).sum(axis=1))
        same = own[:, 3:] * np.sign((own[:, 3:] * theirs.quaternion).sum(axis=1, keepdims=True))
        chord = np.sqrt(np.square(same - theirs.quaternion).sum(axis=1))
        difference = np.maximum(metres, 4.0 * np.arcsin(np.minimum(0.5 * chord, 1.0)))
        value, allowed = float(difference.max()), self.limits.pose_tolerance
        if value <= allowed:
            return value, None
        row = int(chosen[np.argmax(difference)])
        text = (
            f"the tool pose of row {row} is {value:.3g} (rad or m) off PyBullet's, "
            f"{allowed:.3g} is allowed"
        )
        return value, Violation("pose", row, value, allowed, text)

    def _collision(self, rows: np.ndarray, steps: np.ndarray) -> tuple[int, Violation | None]:
        """How many configurations were examined, and the first one met that touches something."""
        along = np.concatenate([[0.0], np.cumsum(steps)])
        count = max(int(np.ceil(along[-1] / self.limits.collision_spacing_rad)), 1) + 1
        places = np.linspace(0.0, along[-1], count)[_coarse_to_fine(count)]
        segment = np.clip(np.searchsorted(along, places, side="right") - 1, 0, len(steps) - 1)
        share = (places - along[segment]) / np.where(steps[segment] > 0, steps[segment], 1.0)
        points = rows[segment] + share[:, None] * (rows[segment + 1] - rows[segment])
        index = self._world.first_collision(points)
        if index is None:
            return count, None
        labels = self._world.label(points[index : index + 1])
        own = bool(labels.self_collision[0])
        kind, what = ("self_collision", "itself") if own else ("workcell_collision", "the workcell")
        row = int(segment[index])
        text = (
            f"the arm touches {what} on the line from row {row}, {share[index]:.0%} of the "
            f"way to the next"
        )
        return index + 1, Violation(kind, row, float("nan"), float("nan"), text)


def _blank(violation: Violation | None, began: float) -> Certificate:
    """The certificate of what is no path."""
    nan = float("nan")
    measures = (nan,) * 9
    return Certificate(violation, *measures, 0, nan, nan, time.perf_counter() - began, 0.0)


def _malformed(kind: str, row: int | None, message: str) -> Violation:
    return Violation(kind, row, float("nan"), float("nan"), message)


def _array(values: Any) -> np.ndarray | None:
    """Real numbers as a float64 array, or None."""
    try:
        table = np.asarray(values)
    except ValueError:  # rows of unequal length
        return None
    return np.ascontiguousarray(table, dtype=np.float64) if table.dtype.kind in "fiu" else None


def _too_much(
    kind: str, where: str, unit: str, values: np.ndarray, limits: np.ndarray, slack: float
) -> Iterator[Violation]:
    """The first row whose |values| (n, D) pass `limits` (D,) by more than the relative `slack`."""
    wrong = ~(np.abs(values) <= limits * (1.0 + slack))
    if wrong.any():
        row = int(np.argmax(wrong.any(axis=1)))
        joint = int(np.argmax(wrong[row]))
        value, limit = float(abs(values[row, joint])), float(limits[joint])
        text = (
            f"{where} {row} joint {joint} has the {kind} {value:.6g} {unit}, {limit:.6g} "
            f"{unit} is allowed"
        )
        yield Violation(kind, row, value, limit, text)


def _coarse_to_fine(count: int) -> np.ndarray:
    """0 to count − 1, both ends first, then what halves the gaps."""
    last = count - 1
    step = 1 << max(last - 1, 0).bit_length()
    order = [0, last] if last > 0 else [0]
    while step > 1:
        order.extend(range(step // 2, last, step))
        step //= 2
    return np.array(order)


def _angles_held(constraint: Constraint, reference: np.ndarray) -> tuple[int, int, np.ndarray]:
    """Kind, axis and anchor as `kernels.trace` takes them, from the reference's quaternion; kind −1
    for no angle.
    """
    held = [bool(x) for x in constraint.axes[3:]]
    back = reference * np.array([1.0, -1.0, -1.0, -1.0])
    if sum(held) == 2:
        k = held.index(False)
        return kernels.SWING, k, np.append(_rotated(back, np.eye(3)[k]), 0.0)
    if sum(held) == 1:
        return kernels.TWIST, held.index(True), back
    return (kernels.ROTATION if all(held) else -1), 0, back


def _channels(constraint: Constraint, kind: int, k: int) -> Iterator[_Channel]:
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


def _read_chain(loaded: LoadedChain, dof: int) -> _Chain:
    """PyBullet's chain of inertial frames as a chain of joint frames whose z axis is the
    joint's.
    """
    turns: list[np.ndarray] = []
    offsets: list[np.ndarray] = []
    prismatic: list[bool] = []
    turn, arm, joint = (
        _wxyz(loaded.quaternion),
        np.array(loaded.position),
        np.array(loaded.position),
    )
    tool = np.array([1.0, 0.0, 0.0, 0.0])
    for link in loaded.links:
        joint = arm + _rotated(turn, np.array(link.joint_position))
        turn = _product(turn, _wxyz(link.quaternion))
        tool = _wxyz(link.inertial_quaternion) * np.array([1.0, -1.0, -1.0, -1.0])
        if link.column is not None:
            if link.kind not in ("revolute", "prismatic") or link.column != len(turns):
                raise CertificationError(
                    f"link {link.name!r}: joint {link.column} of type {link.kind}, where "
                    f"joint {len(turns)} of a "
                    "serial arm was expected"
                )
            aligned = _from_z_to(np.array(link.axis))
            turns.append(_product(turn, aligned))
            offsets.append(joint)
            prismatic.append(link.kind == "prismatic")
            turn, joint = aligned * np.array([1.0, -1.0, -1.0, -1.0]), np.zeros(3)
        elif link.kind != "fixed":
            raise CertificationError(
                f"link {link.name!r}: a {link.kind} joint that no joint value moves"
            )
        arm = joint + _rotated(turn, _rotated(tool, np.array(link.inertial_position)))
    if len(turns) != dof:
        raise CertificationError(f"PyBullet's chain has {len(turns)} joints, the robot has {dof}")
    turns.append(_product(turn, tool))
    offsets.append(joint)
    return _Chain(
        np.array(turns),
        np.array(offsets),
        np.array(prismatic),
        np.sqrt(np.square(np.array(offsets)).sum(axis=1)),
    )


def _wxyz(quaternion: tuple[float, float, float, float]) -> np.ndarray:
    """A unit quaternion (w, x, y, z) from PyBullet's (x, y, z, w)."""
    q = np.array([quaternion[3], *quaternion[:3]])
    return q / np.sqrt((q * q).sum())


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    vector = a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
    return np.concatenate([[a[0] * b[0] - (a[1:] * b[1:]).sum()], vector])


def _rotated(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    across = np.cross(q[1:], v) + q[0] * v
    return v + 2.0 * np.cross(q[1:], across)


def _from_z_to(axis: np.ndarray) -> np.ndarray:
    """A unit quaternion that turns e_z to the direction of `axis`."""
    x, y, z = axis / np.sqrt((axis * axis).sum())
    if z < -1.0 + 1e-9:
        return np.array([0.0, 1.0, 0.0, 0.0])
    q = np.array([1.0 + z, -y, x, 0.0])
    return q / np.sqrt((q * q).sum())


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """The unit quaternion (w, x, y, z) whose rotation is nearest: Bar-Itzhack's symmetric
    eigenvector (2000).
    """
    if rotation.shape != (3, 3) or not np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-6:
        raise CertificationError(
            f"the reference's rotation is {rotation.tolist()}: must be orthonormal"
        )
    (a, b, c), (d, e, f), (g, h, i) = rotation
    k = np.array(
        [
            [a - e - i, b + d, c + g, h - f],
            [b + d, e - a - i, f + h, c - g],
            [c + g, f + h, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    return np.array([w, x, y, z])
