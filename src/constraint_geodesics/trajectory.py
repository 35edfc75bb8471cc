"""What a planner answers: waypoints and times with their certificate, or a status that says why
not; and the CSV it is written as.
"""

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from constraint_geodesics.certification.certifier import Certificate, Violation
from constraint_geodesics.certification.motion import MotionLimits, check_times
from constraint_geodesics.constraints.constraint import (
    Constraint,
    ConstraintManifold,
    constraint_from_json,
)
from constraint_geodesics.extras import require
from constraint_geodesics.formats import NUMBER, TABLE, FormatError
from constraint_geodesics.geometry.braking import (
    Motion,
    Pace,
    State,
    ahead,
    shortest_stop,
    state_at,
)
from constraint_geodesics.problem import SATISFIED, PlannerError, Status
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.search.band import project, step_lengths
from constraint_geodesics.search.candidates import Candidate
from constraint_geodesics.search.run_out import left_over, rows_from, run_out, run_outs
from constraint_geodesics.search.space import space_of
from constraint_geodesics.text_files import is_number, read_text, reason_of, write_text
from constraint_geodesics.values import checked_path, finite_number, numbers, shown

CONSTRAINT, VELOCITY, SHAPES = "constraint", "start_velocity", "shapes"
"""Names of the comment lines of a trajectory's CSV, `# name: JSON`."""
REDRAWN = 0.9 * SATISFIED
"""Violation [rad or m] that lines may use which are drawn anew on a path's way."""
_FRAMES = 10_000
"""Of a recording, at most."""
TOUCHES = ("self_collision", "workcell_collision", "clearance")
"""What a certificate finds where a motion meets something."""
STANDING_S = 0.001
"""Duration of a path from a configuration to itself."""


@dataclass(frozen=True)
class Asked:
    """What a query was asked under: the constraint with its reference, its name, and the scene;
    regions: those of its goals that are more than single configurations.  pace: the limits of
    velocity and acceleration that its motion uses, of which scales are the shares.  wanted: the
    configuration that a motion under way was to reach, if it is not its last.
    """

    constraint: Constraint
    name: str
    scene: Scene = field(repr=False)
    pace: Pace = field(repr=False)
    regions: tuple[Constraint, ...] = ()
    scales: tuple[float, float] = (1.0, 1.0)
    wanted: Float[np.ndarray, "D"] | None = field(default=None, repr=False)


class Way(NamedTuple):
    """Another curve that was found before the answer's or with it: the proposal that it came from,
    its length [rad] and points (T, D) on it.  It is certified for nothing.
    """

    source: str
    length_rad: float
    points: Float[np.ndarray, "T D"]


@dataclass(frozen=True)
class Statistics:
    """How an answer came about.

    planning_time_s: everything, the certificate included.  method: of the planner.  source: the
    proposal that the waypoints came from, "" without a path.  snapped_rad: how far the start was
    moved on request.  looked_at: the goal's configurations [rad], the nearest first; None where
    the query was refused before.  ways: others that were found round something, the shortest first.
    """

    planning_time_s: float
    method: str
    source: str = ""
    snapped_rad: float = 0.0
    looked_at: Float[np.ndarray, "n D"] | None = field(default=None, repr=False)
    ways: tuple[Way, ...] = field(default=(), repr=False)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A planner's answer; two of them are equal only if they are the same object.

    status: "solved", or why there is no path to the goal.  joints (T, D) [rad]: waypoints, both
    ends exact, straight lines between them keep the constraint to within `violation_bound`;
    (0, D) without a path.  times (T,) [s]: within the velocity and acceleration limits, at rest at
    the end, and at the start unless there is a `start_velocity` [rad/s, or m/s of prismatic
    joints].  explanation: one line for people.  certificate: None without a path.

    Of a motion under way `replan`'s answer that is not "solved" has waypoints too where the arm can
    stop on its path at all: those of the stop, of which nothing is known that it breaks where the
    status is "stopped" (its certificate is valid, or None where `stop` drew waypoints anew); else
    the explanation says what, and so does `certificate.violation` where there is a certificate.
    """

    status: Status
    joints: Float[np.ndarray, "T D"]
    times: Float[np.ndarray, "T"]
    explanation: str
    asked: Asked
    statistics: Statistics
    certificate: Certificate | None = field(default=None, repr=False)
    start_velocity: Float[np.ndarray, "D"] | None = field(default=None, repr=False)

    @property
    def goal(self) -> Float[np.ndarray, "D"] | None:
        """The configuration that is reached [rad]; None without a path."""
        return self.joints[-1].copy() if len(self.joints) else None

    @property
    def constraint(self) -> Constraint:
        """The constraint, held where the query holds it."""
        return self.asked.constraint

    @property
    def constraint_name(self) -> str:
        """Its name, or its axes in words."""
        return self.asked.name

    @property
    def scene(self) -> Scene:
        """Robot and workcell."""
        return self.asked.scene

    @property
    def source(self) -> str:
        """The proposal that the waypoints came from."""
        return self.statistics.source

    @property
    def method(self) -> str:
        """The planner's method."""
        return self.statistics.method

    @property
    def planning_time_s(self) -> float:
        """Everything, the certificate included."""
        return self.statistics.planning_time_s

    @property
    def length_rad(self) -> float:
        """In joint space; nan without a path, as the figures below."""
        return np.nan if self.certificate is None else self.certificate.length_rad

    @property
    def max_violation(self) -> float:
        """Largest excess over the tolerance where it was looked at [rad, or m where a held position
        is worse].
        """
        return np.nan if self.certificate is None else self.certificate.max_violation

    @property
    def violation_bound(self) -> float:
        """Its bound on the whole path [rad, or m]."""
        return np.nan if self.certificate is None else self.certificate.violation_bound

    @property
    def clearance_m(self) -> float:
        """What bodies that can meet within the joint limits are proven to keep apart on the whole
        path [m]: at least half of the least distance that they have.
        """
        return np.nan if self.certificate is None else self.certificate.clearance_m

    @property
    def collision_time_s(self) -> float:
        """What the proof took that nothing touches."""
        return np.nan if self.certificate is None else self.certificate.collision_time_s

    def at(self, s: float | Sequence[float] | Float[np.ndarray, "n"]) -> Float[np.ndarray, "*n D"]:
        """Configurations [rad] at shares s in [0, 1] of the length, each on the constraint: points
        of the straight lines between the waypoints, projected.

        What is certified are the waypoints and those lines.  The projected points keep the
        constraint itself, but nothing was asked of their collisions, and near a singular
        configuration they lie further from the lines than the violation's bound says, since that
        is no distance of joints.

        Raises PlannerError without a path, or if a share lies outside [0, 1].
        """
        self._require_path("use")
        shares = _shares(s)
        along = np.concatenate([[0.0], np.cumsum(step_lengths(self.joints))])
        at = shares * along[-1]
        points = np.ascontiguousarray(
            np.stack([np.interp(at, along, joint) for joint in self.joints.T], axis=1)
        )
        between = ~np.isin(at, along)
        moved = points[between]
        project(space_of(ConstraintManifold(self.scene.robot, self.constraint)), moved)
        points[between] = moved
        points[shares == 0.0], points[shares == 1.0] = self.joints[0], self.joints[-1]
        return points[0] if np.ndim(s) == 0 else points

    def save(self, file: str | Path) -> None:
        """Write it as CSV: comment lines with the constraint, the velocity at the start where it
        does not rest there, the names of the shapes that it was planned among, carried ones too,
        and the format, then time_s and the joints [rad], a line a waypoint.

        Raises PlannerError without a path.
        """
        self._require_path("save")
        names = self.scene.robot.joint_names
        checked_path(file, "file", PlannerError)
        write_trajectory(Path(file), self.motion, self.constraint, names, self.scene.names)

    def to_joint_trajectory(self) -> dict[str, Any]:
        """As ROS's trajectory_msgs/JointTrajectory: `joint_names`, and `points` with `positions`
        [rad or m], `velocities` [1/s], `accelerations` [1/s²] and `time_from_start`, in whole `sec`
        and `nanosec`.

        Accelerations are the certified differences at the waypoints; a velocity lies between those
        of the lines before and after; the first is `start_velocity`, the last is 0.  Raises
        PlannerError without a path.
        """
        self._require_path("use")
        steps, durations = np.diff(self.joints, axis=0), np.diff(self.times)[:, None]
        first = self.motion.start_velocity
        speeds = np.vstack([first, steps / durations, np.zeros_like(first)])
        lasting = np.pad(durations, ((1, 1), (0, 0)))
        both = lasting[:-1] + lasting[1:]
        accelerations = 2.0 * np.diff(speeds, axis=0) / both
        velocities = (speeds[:-1] * lasting[1:] + speeds[1:] * lasting[:-1]) / both
        rows = zip(self.joints, velocities, accelerations, self.times, strict=True)
        return {
            "joint_names": list(self.scene.robot.joint_names),
            "points": [
                {
                    "positions": q.tolist(),
                    "velocities": v.tolist(),
                    "accelerations": a.tolist(),
                    "time_from_start": _duration(float(t)),
                }
                for q, v, a, t in rows
            ],
        }

    def state(self, at_s: float) -> State:
        """Configuration [rad] and velocity [rad/s] at a time from 0 to the duration [s], and the
        waypoint that comes next.

        The velocity is that of a line in its middle, and changes evenly from there to the middle of
        the next one, by the certified acceleration between them.  The place is on the straight line
        between two waypoints, as far along as this velocity leads.  Raises PlannerError without a
        path, or for another time.
        """
        self._require_path("use")
        return state_at(self.motion, self._moment(at_s))

    def stop(self, at_s: float) -> "Trajectory":
        """The hardest stop on the path from its state at a time [s]: the shortest that the limits
        of its pace allow, of status "stopped" unless it is known to break something: then the
        explanation names it, and the status is "in_collision" where the path's certificate has a
        contact, else "not_found".

        Its lines are those of the path, so what was proven of them holds, in the scene that the
        path was certified in, and its certificate says so.  Where the velocity can't change so much
        on what is left of a line, or leads too far beside it, waypoints are drawn anew, along the
        same curve or close by: that is not proven, and the certificate is None.  `planner.replan`
        certifies a stop in the scene as it is now, and how the arm turns into its first line, which
        is here as it is on the path.
        Raises PlannerError without a path, for a time beyond 0 and the duration, or where the arm
        can't stop on the path any more.
        """
        self._require_path("stop on")
        began, moment = time.perf_counter(), self._moment(at_s)
        manifold = ConstraintManifold(self.scene.robot, self.constraint)
        state = state_at(self.motion, moment)
        stop = stopping(self.motion, state, self.asked.pace, manifold)
        if stop is None:
            raise PlannerError(f"at_s = {at_s}: the arm can't stop on the path any more")
        motion, on_path = stop
        where = "on the path" if on_path else "close to the path, on waypoints drawn anew,"
        line = f"a stop after {motion.times[-1]:.2f} s {where}"
        known = self._inherited(motion) if on_path else None
        broken = _broken_times(motion, self.asked.pace) if known is None else known.violation
        status: Status = "stopped"
        if broken is not None:
            status = "in_collision" if broken.kind in TOUCHES else "not_found"
            line = f"{line} is not certified: {broken.message}"
        elif not on_path:
            line = f"{line} is not certified"
        spent = time.perf_counter() - began
        about = replace(self.statistics, planning_time_s=spent, snapped_rad=0.0)
        about = replace(about, source="stop", looked_at=None)
        start = motion.start_velocity if motion.start_velocity.any() else None
        asked = replace(self.asked, wanted=self.wanted)
        found = motion.joints, motion.times, line, asked, about, known, start
        return Trajectory(status, *found)

    @property
    def wanted(self) -> Float[np.ndarray, "D"]:
        """The configuration that a motion is to reach [rad]: its last unless it stops before."""
        wanted = self.joints[-1] if self.asked.wanted is None else self.asked.wanted
        return wanted.copy()

    @property
    def motion(self) -> Motion:
        """Waypoints and times, and the velocity at the first."""
        start = self.start_velocity
        resting = np.zeros(self.joints.shape[1])
        return Motion(self.joints, self.times, resting if start is None else start)

    def _moment(self, at_s: float) -> float:
        moment = finite_number(at_s)
        if moment is None or not 0.0 <= moment <= self.times[-1]:
            what = f"must be a time from 0 to {self.times[-1]:.6g} s"
            raise PlannerError(f"at_s = {shown(at_s)}: {what}")
        return moment

    def _inherited(self, motion: Motion) -> Certificate | None:
        """The certificate of a motion on lines of the path: what was proven of all of them, and its
        times looked at anew.
        """
        if self.certificate is None:
            return None
        steps, start = step_lengths(motion.joints), motion.start_velocity
        broken = self.certificate.violation
        if broken is None:
            broken = _broken_times(motion, self.asked.pace)
        else:  # its row is one of the path's
            broken = replace(broken, row=None, message=f"of the path: {broken.message}")
        return replace(
            self.certificate,
            violation=broken,
            length_rad=float(steps.sum()),
            max_step_rad=float(steps.max()),
            goal_violation=np.nan,
            duration_s=float(motion.times[-1]),
            time_s=0.0,
            collision_time_s=0.0,
            start_velocity=tuple(start.tolist()) if start.any() else None,
        )

    def record(self, file: str | Path, frames: int = 100, demonstrations: Any = None) -> None:
        """Write a Rerun recording: the motion, other ways that were found, in grey, what of a
        goal's region and configurations was looked at, and demonstrations, as `identify` takes
        them, with what of the constraint lies near them.  Raises PlannerError without a path,
        MissingExtraError without the extra `record`, DemonstrationError for demonstrations that
        can't be read.
        """
        require("record")
        from constraint_geodesics.identification.demonstrations import demonstrations_from
        from constraint_geodesics.recording.goal import GoalView
        from constraint_geodesics.recording.recording import PathRecord, record_path

        self._require_path("record")
        checked_path(file, "file", PlannerError)
        if isinstance(frames, bool) or not isinstance(frames, int) or not 2 <= frames <= _FRAMES:
            line = f"must be a whole number from 2 to {_FRAMES}"
            raise PlannerError(f"frames = {shown(frames)}: {line}")
        looked_at, regions = self.statistics.looked_at, self.asked.regions
        goal = None
        if looked_at is not None and (regions or len(looked_at) > 1):
            goal = GoalView(looked_at, regions)
        name, text = self.constraint_name, self._markdown()
        motions: tuple[np.ndarray, ...] = ()
        if demonstrations is not None:
            motions = tuple(demonstrations_from(demonstrations, self.scene.robot)[0])
        record = PathRecord(self.method, name, None, None, self.joints, text, goal=goal)
        ways = tuple(way.points for way in self.statistics.ways)
        record = replace(record, times=self.times, demonstrations=motions, ways=ways)
        manifold = ConstraintManifold(self.scene.robot, self.constraint)
        around, carried = self.scene.workcell, self.scene.attached
        record_path(Path(file), record, manifold, around, frames=frames, attached=carried)

    def draw(self, file: str | Path) -> None:
        """Draw joints and violation over time as PNG.  Raises PlannerError without a path."""
        from constraint_geodesics.recording.path_figure import DrawnPath, path_figure
        from constraint_geodesics.recording.png import save_png

        self._require_path("draw")
        checked_path(file, "file", PlannerError)
        robot = self.scene.robot
        violation = ConstraintManifold(robot, self.constraint).violation(self.joints)
        skeletons, bound = robot.skeleton(self.joints), self.violation_bound
        units = ["m" if sliding else "rad" for sliding in robot.chain.prismatic]
        motion = self.times, self.joints, robot.joint_names, units
        drawn = DrawnPath(*motion, skeletons, violation, bound)
        save_png(path_figure(drawn, f"{self.constraint_name}: {self.explanation}"), Path(file))

    def summary(self) -> dict[str, str | float | int | None]:
        """The answer without its arrays, as JSON takes it; figures that do not exist are None."""
        numbers = {
            "length_rad": self.length_rad,
            "duration_s": self.times[-1] if len(self.times) else np.nan,
            "max_violation": self.max_violation,
            "violation_bound": self.violation_bound,
            "clearance_m": self.clearance_m,
            "goal_violation": np.nan
            if self.certificate is None
            else self.certificate.goal_violation,
            "snapped_rad": self.statistics.snapped_rad,
            "planning_time_s": self.planning_time_s,
            "collision_time_s": self.collision_time_s,
        }
        return {
            "status": self.status,
            "constraint": self.constraint_name,
            "explanation": self.explanation,
            "method": self.method,
            "source": self.source or None,
            "rows": len(self.joints),
        } | {name: float(x) if np.isfinite(x) else None for name, x in numbers.items()}

    def _require_path(self, use: str) -> None:
        if not len(self.joints):
            raise PlannerError(f"there is no path to {use}: {self.explanation}")

    def _markdown(self) -> str:
        return f"**planned path**, constraint `{self.constraint_name}`\n\n- {self.explanation}"


def stopping(
    motion: Motion, state: State, pace: Pace, manifold: ConstraintManifold
) -> tuple[Motion, bool] | None:
    """The shortest stop on a motion's way from one of its states, and whether all its lines are the
    motion's; None where there is none.

    A motion that uses its accelerations up may leave none to go on with on what is left of a line,
    or its velocity leads too far beside it, at a corner: its waypoints are drawn anew then, its
    curve is begun straight, or it goes straight on.  At last the next waypoint is left out, so that
    the first line has the time which the motion had: that can break the constraint by the height of
    a line's curve, a fraction of a mrad.  Where the times of all are wrong, the first is the
    answer.
    """
    if not state.velocity.any():
        place, rest = state.configuration, np.zeros_like(state.velocity)
        return Motion(np.stack([place, place]), np.array([0.0, STANDING_S]), rest), True
    first: tuple[Motion, bool] | None = None
    for rows, on_path in _ways_to_stop(motion, state, pace, manifold):
        found = shortest_stop(rows, state.velocity, pace)
        if found is None:
            continue
        if _broken_times(found, pace) is None:
            return found, on_path
        first = first or (found, on_path)
    return first


def _ways_to_stop(
    motion: Motion, state: State, pace: Pace, manifold: ConstraintManifold
) -> Iterator[tuple[Float[np.ndarray, "n D"], bool]]:
    """Rows that a motion may stop on, and whether they are its own."""
    rows, velocity = ahead(motion.joints, state), state.velocity
    yield rows, True
    space = space_of(manifold)
    curve = left_over(space, rows) if len(rows) > 1 else None
    curves: Iterator[Candidate] = iter(())
    if curve is not None:
        curves = chain([curve], run_outs(space, curve, velocity, pace))
    straight = run_out(space, state.configuration, velocity, pace)
    for own in chain(curves, [] if straight is None else [straight]):
        yield rows_from(own, rows[0], velocity, pace, REDRAWN), False
    if len(rows) > 1:
        yield np.delete(rows, 1, axis=0), False


def _broken_times(motion: Motion, pace: Pace) -> Violation | None:
    """The first promise on velocities and accelerations that a motion breaks."""
    limits = MotionLimits(pace.velocity, tuple(pace.acceleration.tolist()), motion.start_velocity)
    return next(check_times(motion.joints, motion.times, limits)[0], None)


def _duration(seconds: float) -> dict[str, int]:
    """As ROS's builtin_interfaces/Duration, to the nearest nanosecond."""
    whole, rest = divmod(round(1e9 * seconds), 1_000_000_000)
    return {"sec": whole, "nanosec": rest}


def _shares(s: Any) -> Float[np.ndarray, "n"]:
    found = numbers(s)
    shares = np.array([np.nan]) if found is None else np.atleast_1d(found)
    if shares.ndim != 1 or not ((shares >= 0.0) & (shares <= 1.0)).all():
        raise PlannerError(f"s = {shown(s)}: must be a number or a row of numbers in [0, 1]")
    return shares


def write_trajectory(
    file: Path,
    motion: Motion,
    constraint: Constraint,
    names: Sequence[str],
    shapes: Sequence[str] = (),
) -> None:
    """Write waypoints and times as CSV, before the header comment lines of the constraint, of the
    velocity at the first waypoint unless it rests, of the shapes' names, and of the format; numbers
    to the last bit.
    """
    lines = [f"# {CONSTRAINT}: {json.dumps(constraint.to_json())}"]
    if motion.start_velocity.any():
        lines.append(f"# {VELOCITY}: {json.dumps(motion.start_velocity.tolist())}")
    if shapes:
        lines.append(f"# {SHAPES}: {json.dumps(list(shapes))}")
    lines += [f"# {NUMBER}: {TABLE.line}", ",".join(("time_s", *names))]
    for t, row in zip(motion.times, motion.joints, strict=True):
        lines.append(",".join(repr(float(x)) for x in (t, *row)))
    write_text(file, "\n".join(lines) + "\n")


class Read(NamedTuple):
    """What a CSV says of a path: waypoints [rad], and what it has of times [s], a constraint, the
    velocity at the first waypoint [rad/s], names of the shapes that it was planned among, and which
    file it is.
    """

    joints: Float[np.ndarray, "T D"]
    times: Float[np.ndarray, "T"] | None
    constraint: Constraint | None
    start_velocity: Float[np.ndarray, "D"] | None
    shapes: tuple[str, ...]
    file: Path


def read_trajectory(
    file: Path, names: Sequence[str] | None = None, robot: SerialRobot | None = None
) -> Read:
    """A path from CSV: lines of joints [rad] under their names, with a column time_s and comment
    lines of a constraint and a velocity if there are any.  names: of the joints, which the columns
    must have in this order.  robot: for the kinds of constraints that need one.

    Raises PlannerError naming the file and the line that can't be read.
    """
    try:
        text = read_text(file, "utf-8-sig")
    except (OSError, UnicodeError) as error:
        raise PlannerError(f"{file}: can't be read: {reason_of(error)}") from None
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), 1)]
    said: dict[str, tuple[int, str]] = {}
    table: list[tuple[int, str]] = []
    for number, line in lines:
        if not line.startswith("#"):
            if line:
                table.append((number, line))
            continue
        name, _, text = (part.strip() for part in line.removeprefix("#").partition(":"))
        if name in said:
            raise PlannerError(f"{file}, line {number}: a second {name}")
        if name in (CONSTRAINT, VELOCITY, SHAPES, NUMBER):
            said[name] = number, text
    _require_format(file, *said.pop(NUMBER, (0, TABLE.line)))
    if len(table) < 2:
        raise PlannerError(f"{file}: a header line and at least one row are needed")
    header = _header(file, table[0][1].split(","), names)
    array = _table(file, table[1:], len(header))
    timed = header[0] == "time_s"
    joints, times = array[:, int(timed) :], array[:, 0] if timed else None
    constraint = _constraint_of(file, *said[CONSTRAINT], robot) if CONSTRAINT in said else None
    start = _velocity_of(file, *said[VELOCITY], joints.shape[1]) if VELOCITY in said else None
    if start is not None and not timed:
        raise PlannerError(f"{file}: a {VELOCITY} goes with times: there is no column time_s")
    shapes = _shapes_of(file, *said[SHAPES]) if SHAPES in said else ()
    return Read(joints, times, constraint, start, shapes, file)


def _shapes_of(file: Path, number: int, text: str) -> tuple[str, ...]:
    try:
        given = json.loads(text)
    except (ValueError, RecursionError):
        given = None
    if not (isinstance(given, list) and all(isinstance(name, str) for name in given)):
        raise PlannerError(f"{file}, line {number}: not a list of names: {text[:80]}")
    return tuple(given)


def _require_format(file: Path, number: int, text: str) -> None:
    try:
        TABLE.require_line(text)
    except FormatError as error:
        raise PlannerError(f"{file}, line {number}: {error}") from None


def _velocity_of(file: Path, number: int, text: str, dof: int) -> Float[np.ndarray, "D"]:
    try:
        given = json.loads(text)
        numbers = isinstance(given, list) and all(type(x) in (int, float) for x in given)
        found = np.array(given if numbers else [], float)
    except (ValueError, OverflowError, RecursionError):
        found = np.empty(0)
    if found.shape != (dof,) or not np.isfinite(found).all():
        raise PlannerError(f"{file}, line {number}: not a velocity of {dof} joints: {text[:80]}")
    return found


def _header(file: Path, cells: Sequence[str], names: Sequence[str] | None) -> list[str]:
    header = [name.strip() for name in cells]
    if names is not None and header[int(header[0] == "time_s") :] == list(names):
        return header  # joints may be called by numbers
    if any(is_number(name) for name in header):
        wanted = "a header line with the joints' names is needed before the rows"
        raise PlannerError(f"{file}: {wanted}")
    if names is not None:
        raise PlannerError(
            f"{file}: its columns are {', '.join(header)}: must be {', '.join(names)}, after "
            f"time_s if any"
        )
    return header


def _table(file: Path, lines: Sequence[tuple[int, str]], count: int) -> Float[np.ndarray, "T n"]:
    """All rows at once, which is three times as fast; where one is broken, each by itself."""
    text = ",".join(line for _, line in lines)
    try:
        if all(line.count(",") == count - 1 for _, line in lines):
            return np.array(list(map(float, text.split(",")))).reshape(-1, count)
    except ValueError:
        pass
    return np.array([_numbers(file, number, line.split(","), count) for number, line in lines])


def _numbers(file: Path, number: int, cells: Sequence[str], count: int) -> list[float]:
    if not all(is_number(cell) for cell in cells):
        raise PlannerError(f"{file}, line {number}: not a row of numbers")
    if len(cells) != count:
        raise PlannerError(f"{file}, line {number}: {len(cells)} numbers under {count} names")
    return [float(cell) for cell in cells]


def _constraint_of(file: Path, number: int, text: str, robot: SerialRobot | None) -> Constraint:
    try:
        return constraint_from_json(json.loads(text), robot)
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise PlannerError(f"{file}, line {number}: not a constraint: {error}") from None
