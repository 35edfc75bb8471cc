"""What a user imports: start, goal and constraint in; a certified trajectory out, or a status that
says why not.

planner = Planner.load()
trajectory = planner.plan(start, goal, "level_cup")
"""

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

import numpy as np
from jaxtyping import Float
from pydantic import ValidationError

from constraint_geodesics import warmup
from constraint_geodesics.answering import Answering
from constraint_geodesics.bundle import Bundle, BundleError, open_bundle
from constraint_geodesics.certification.certifier import Certificate, Certifier, Limits
from constraint_geodesics.constraints.constraint import (
    Constraint,
    ConstraintManifold,
    Pose,
    constraint_from,
)
from constraint_geodesics.geometry.braking import AT_REST
from constraint_geodesics.goals.goal import ArrayLike, Wanted, checked_configuration
from constraint_geodesics.goals.pose import MANY_SEEDS, POSE_JOINTS
from constraint_geodesics.goals.wanted import as_goals
from constraint_geodesics.methods import Method, SearchMethod, open_method
from constraint_geodesics.params import (
    JudgeParams,
    PlannerParams,
    PoseParams,
    RobotParams,
    WorkcellParams,
    one_line,
)
from constraint_geodesics.problem import PlannerError as PlannerError
from constraint_geodesics.problem import end_refused
from constraint_geodesics.progress import LINE_AFTER_S, may_show, saying_late, waiting
from constraint_geodesics.progress import progress as bar
from constraint_geodesics.replanning import Replanning
from constraint_geodesics.robot.inverse_kinematics import Search, solutions, spread
from constraint_geodesics.robot.kinematics import RobotError, SerialRobot, rpy_of
from constraint_geodesics.scene.arm import FOUND
from constraint_geodesics.scene.names import shapes_of
from constraint_geodesics.scene.planning_scene import PlanningScene
from constraint_geodesics.scene.scene import Scene, robot_from, workcell_from
from constraint_geodesics.scene.scene import SceneError as SceneError
from constraint_geodesics.scene.shape import Shape
from constraint_geodesics.search.candidates import ALL_PARTS, Parts
from constraint_geodesics.search.nearest import Projection, projection
from constraint_geodesics.search.preparation import Preparation, Query
from constraint_geodesics.trajectory import Read, Trajectory, read_trajectory
from constraint_geodesics.values import LARGEST, checked_path, is_number, numbers, shown

SNAP_RAD, SNAP_M = 0.01, 0.001
"""Distances by which a start is moved on request, at most: of its turning joints, and of its
prismatic ones.
"""
CLEARANCE_SHARE = 0.05
"""Of what an arm typically keeps, asked for in the search by a planner that is made from a URDF."""
SLOWEST = 1e-6
"""Share of the limits that a motion uses, at least: a second becomes days."""
SPREAD = 64
"""Of the configurations that reach a pose, where there is no end of them."""
OWN_CONSTRAINTS = {"free": Constraint((0,) * 6), "level": Constraint((0, 0, 0, 1, 1, 0))}
"""By name, of a planner that is made from a URDF: nothing held, and the tilt that the start has."""


_Given = ParamSpec("_Given")
_Answer = TypeVar("_Answer")


def _in_turn(
    method: Callable[Concatenate["Planner", _Given], _Answer],
) -> Callable[Concatenate["Planner", _Given], _Answer]:
    """The method, begun when no other thread has the planner or changes its scene."""

    @wraps(method)
    def alone(planner: "Planner", *args: _Given.args, **kwargs: _Given.kwargs) -> _Answer:
        with planner.scene.lock:
            return method(planner, *args, **kwargs)

    return alone


def _late_bar(opened: ExitStack, total: int) -> Callable[[int], None]:
    """What is told how many queries are done, and shows a bar of the rest once two seconds have
    passed.
    """
    began, advance = time.monotonic(), None

    def tell(done: int) -> None:
        nonlocal advance
        if advance is not None:
            advance()
        elif done < total and time.monotonic() - began > LINE_AFTER_S and may_show():
            advance = opened.enter_context(bar(f"planned, after the first {done}", total - done))

    return tell


class Planner:
    """Plans paths of one robot in its workcell under any constraint.  Close it, or use it as a
    context manager.

    The roadmap of a constraint that has none yet is made the first time that a query needs it, or
    by `prepare`; everything is kept for the next query.  Threads may share a planner: it answers
    one at a time, each in the scene as it is then, and no time or limit counts the waiting.
    """

    def __init__(self, bundle: Bundle, source: str, method: Method | None = None) -> None:
        warmup.ensure()
        self._closed = False
        self.source, self.bundle = source, bundle
        scene = Scene(robot_from(bundle.robot), workcell_from(bundle.workcell))
        self.constraints = {
            name: constraint_from(c, scene.robot) for name, c in bundle.constraints.items()
        }
        self.method: Method = method or SearchMethod()
        settings = bundle.planner
        limits = limits_of(settings, bundle.judge, scene.robot)
        self._certifier = Certifier(scene, limits)
        try:
            self._answering = Answering(self.method, self._certifier)
            checks = self._certifier.collisions
            self._preparation = Preparation(scene, checks, settings, self.method.draw)
            bodies = checks.collider
            self.scene = PlanningScene(scene, self._follow, bodies.links, bodies.link_pose)
            roadmaps = bundle.roadmaps if self.method.roadmaps is None else self.method.roadmaps
            for name, roadmap in roadmaps.items():
                if roadmap.joints.shape[1] != scene.robot.dof:
                    line = f"the roadmap of {name} has {roadmap.joints.shape[1]} joints"
                    raise BundleError(f"{source}: {line}, the arm has {scene.robot.dof}")
            self._preparation.supply(self.constraints, roadmaps)
        except BaseException:
            self._certifier.close()
            raise
        self.band = self._preparation.band

    @classmethod
    def load(cls, source: str | Path | None = None, method: str = SearchMethod.name) -> Self:
        """From a folder, an MLflow address (models:/… or runs:/…), or by default from the
        pipeline's outputs in this checkout, else from the files that come with the package.
        `planner.source` says which it was.

        method: how curves are looked for.  "planner": straight line, roadmap and trees, refined;
        nothing in it is learned.  "learned": cubic curves that a trained policy proposes, in
        joint space as the package has it, in a learned chart where the paper searches;
        "learned+band": the same, refined by the planner's elastic band.
        Raises BundleError if files are missing or altered, PlannerError for another method.
        """
        if source is not None:
            checked_path(source, "source", PlannerError)
        if not isinstance(method, str):
            raise PlannerError(f"method = {shown(method)}: must be a name")
        bundle, where = open_bundle(source)
        return cls(bundle, where, open_method(method, source, bundle))

    @classmethod
    def from_urdf(
        cls,
        urdf: str | Path,
        tool_link: str,
        srdf: str | Path | None = None,
        tool: Pose | None = None,
        *,
        hold: Mapping[str, float] | None = None,
        workcell: Sequence[Shape] = (),
        settings: PlannerParams | None = None,
    ) -> Self:
        """For the arm of any URDF, a path or a name in pybullet_data; nothing is trained.  The
        names of its constraints are those of OWN_CONSTRAINTS.

        srdf: which links may touch; without it adjacent and rigid pairs, and those that always
        touch, found by sampling.  tool: the pose of the tool's own frame in its link.  hold: values
        of joints that are not to move [rad or m].  workcell: shapes around the arm.  settings:
        accelerations, clearance, roadmaps; by default those of PlannerParams, with no more
        clearance, unless they say clearance_share, than CLEARANCE_SHARE of what the arm typically
        keeps.
        Raises RobotError, one line with the mend, where no arm can be made of the files.
        """
        for name, given in (("urdf", urdf), *([] if srdf is None else [("srdf", srdf)])):
            checked_path(given, name, RobotError)
        if not (hold is None or isinstance(hold, Mapping)):
            raise RobotError(f"hold = {shown(hold)}: must be values by the names of joints")
        if not (settings is None or isinstance(settings, PlannerParams)):
            raise PlannerError(f"settings = {shown(settings)}: must be PlannerParams")
        own = None
        if tool is not None:
            _require_pose(tool, "tool")
            rpy = rpy_of(tool.rotation)
            own = PoseParams(position_m=tuple(tool.position.tolist()), rpy_rad=rpy)
        try:
            values = dict(hold or {})
            about = {
                "urdf": str(urdf),
                "tool_link": tool_link,
                "hold": {n: float(x) if is_number(x) else x for n, x in values.items()},
                "tool": own,
                "may_touch": FOUND if srdf is None else str(srdf),
            }
            robot = RobotParams.model_validate(about, strict=True)
        except ValidationError as error:
            raise RobotError(f"{urdf}: {one_line(error)}") from None
        around = WorkcellParams().including(*shapes_of(workcell, "workcell"))
        settings = settings or PlannerParams()
        if "clearance_share" not in settings.model_fields_set:
            settings = settings.model_copy(update={"clearance_share": CLEARANCE_SHARE})
        made = cls(Bundle(robot, around, {}, settings, JudgeParams(), {}), str(urdf))
        made.constraints |= OWN_CONSTRAINTS
        return made

    @property
    def robot(self) -> SerialRobot:
        """Limits, velocities, names of the joints and forward kinematics."""
        return self.scene.robot

    def __enter__(self) -> Self:
        self._require_open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @_in_turn
    def close(self) -> None:
        """Free the physics world; a closed planner answers no more."""
        self._closed = True
        self._certifier.close()

    def __getstate__(self) -> None:
        raise TypeError("a planner holds a physics world: make one in each process")

    def _require_open(self) -> None:
        if self._closed:
            raise PlannerError("this planner is closed: load another")

    def _follow(self, scene: Scene) -> None:
        self._require_open()
        with self._preparation.changing(scene):
            self._certifier.change(scene)

    @_in_turn
    def prepare(self, constraint: str | Constraint) -> None:
        """Make the constraint's roadmap now (seconds), and load the compiled code, so
        that no query waits.

        Raises PlannerError if it holds an axis but has no reference: its roadmap would be another
        for every start.
        """
        with saying_late("making the roadmap"):
            nodes = self.nodes(constraint)
            if len(nodes):
                self.plan(nodes[0], nodes[-1], constraint)

    @_in_turn
    def nodes(self, constraint: str | Constraint) -> Float[np.ndarray, "n D"]:
        """Configurations of the constraint's roadmap [rad], not to be written to; none where it has
        no roadmap.

        Raises PlannerError if it holds an axis but has no reference.
        """
        self._require_open()
        given, name = self._named(constraint)
        if not given.is_placed:
            raise PlannerError(f"{name} has no reference pose: use constraint.relative_to(pose)")
        roadmap = self._preparation.task(given).roadmap()
        nodes = np.empty((0, self.scene.robot.dof)) if roadmap is None else roadmap.joints.view()
        nodes.flags.writeable = False
        return nodes

    @_in_turn
    def ik(self, pose: Pose) -> Float[np.ndarray, "n D"]:
        """Configurations [rad] free of collision and within the limits whose tool has a pose in the
        base frame: of six joints every branch that is found, whole turns included, of a joint with
        room for more than three the three nearest to 0; of more joints some that are spread over
        all of them.
        """
        self._require_open()
        _require_pose(pose, "pose")
        robot, settings = self.robot, Search()
        if robot.dof > POSE_JOINTS:
            settings = settings._replace(seeds=MANY_SEEDS)
        found = solutions(robot, pose.position, pose.rotation, settings)
        free = found[self._certifier.collisions.free(found)]
        return spread(free, SPREAD) if robot.dof > POSE_JOINTS else free

    @_in_turn
    def project(self, q: ArrayLike, constraint: str | Constraint) -> Projection:
        """The nearest configuration that keeps a constraint and the joint limits, as far as the
        descent from q [rad] finds it; collisions are not looked at.

        Raises PlannerError if the constraint holds an axis but has no reference, or nothing near
        keeps it.
        """
        self._require_open()
        given, name = self._named(constraint)
        if not given.is_placed:
            raise PlannerError(f"{name} has no reference pose: use constraint.relative_to(pose)")
        given.compile()
        place = checked_configuration(q, self.robot.dof, "q")
        found = projection(ConstraintManifold(self.robot, given), place)
        if found is None:
            raise PlannerError(
                f"no configuration was found near {place.tolist()} that keeps {name}"
            )
        return found

    @_in_turn
    def plan(
        self,
        start: ArrayLike,
        goal: Wanted | Sequence[Wanted],
        constraint: str | Constraint,
        *,
        parts: Parts = ALL_PARTS,
        budget_s: float | None = None,
        snap: bool = False,
        velocity_scale: float = 1.0,
        acceleration_scale: float = 1.0,
        scene: Sequence[Shape] = (),
        start_velocity: ArrayLike | None = None,
    ) -> Trajectory:
        """A short path from a start [rad] under a constraint: a name from params.yaml, or a
        Constraint, which without a reference holds its axes where the start has them.

        goal: a configuration [rad], a tool Pose, a GoalRegion or any other Goal, or a list of
        them: the shortest path that is found to any is the answer.
        parts: of the planner to use, for comparisons.  budget_s: by default the first path that is
        certified is the answer; with a budget shorter ones, round the other side of something, are
        looked for while there is time for one more, by how long such a one took before, until so
        many seconds have passed since the call; where none is found at once, and the roadmap does
        not hold the ends to be unconnected, new, larger trees are grown for as long.
        Functions of a constraint's own are compiled before, a roadmap that is not made yet is made
        within.  snap: a start that violates the
        constraint or a limit is moved to the nearest configuration that keeps them, where that is
        at most SNAP_RAD away, and SNAP_M for prismatic joints, and nothing is touched on the way;
        else such a start is refused.  velocity_scale, acceleration_scale: the shares of the limits
        that the motion uses, from SLOWEST to 1.  scene: shapes for this query alone, beside
        what is in `planner.scene`.  start_velocity: of an arm that moves at the start [rad/s, m/s
        for prismatic joints]: the path begins in its direction, or stops straight on first; a
        velocity beyond the scaled limits, or one that leads off the constraint, is refused.
        Raises PlannerError if an end or the velocity has the wrong shape or is not finite, the name
        is unknown, or the budget or a scale is none, SceneError for shapes that the scene can't
        take.
        """
        self._require_open()
        given, name = self._named(constraint)
        given.compile()
        began = time.perf_counter()
        _require_seconds(budget_s, "budget_s")
        scales = velocity_scale, acceleration_scale
        for scale, which in zip(scales, ("velocity", "acceleration"), strict=True):
            if not (is_number(scale) and SLOWEST <= scale <= 1.0):
                line = f"must be at least {SLOWEST:g} and at most 1"
                raise PlannerError(f"{which}_scale = {shown(scale)}: {line}")
        if not isinstance(parts, Parts):
            raise PlannerError(f"parts = {shown(parts)}: must be Parts")
        if not isinstance(snap, bool | np.bool_):
            raise PlannerError(f"snap = {shown(snap)}: must be True or False")
        scene = shapes_of(scene, "scene")
        dof = self.scene.robot.dof
        q_start, goals = checked_configuration(start, dof, "start"), as_goals(goal, dof)
        moving = None
        if start_velocity is not None:
            moving = checked_configuration(start_velocity, dof, "start_velocity")
            moving = moving if np.linalg.norm(moving) > AT_REST else None
        is_long = budget_s is not None and budget_s > LINE_AFTER_S
        line = f"planning for {budget_s:g} s" if is_long and may_show() else ""
        with waiting(line), self.scene.including(scene):
            task, moved = self._preparation.task(self._held_at(given, q_start)), 0.0
            if snap:
                q_start, moved = self._snapped(q_start, task.manifold)
            query = Query(task, name, q_start, q_start, began, parts, scales, moved)
            query = replace(query, start_velocity=moving)
            return self._answering.answer(query, goals, budget_s)

    @_in_turn
    def replan(
        self, trajectory: Trajectory, at_s: float, *, limit_s: float | None = None
    ) -> Trajectory:
        """A certified trajectory for an arm that is under way: from its state at a time [s] of its
        trajectory on, in the scene as it is now, to the same last configuration.

        What is left of the trajectory where that is still clear, else a path round what is new, of
        status "solved".  Where none is found, the hardest stop on the path: "stopped" if that is
        certified, else its waypoints come with the certificate that names what it breaks, under the
        status "in_collision" where it meets something.  A trajectory that stopped may be replanned:
        it goes on to the configuration that was wanted.  limit_s: after so many seconds no other
        path is tried, and the arm stops; by default all are.  With it no roadmap is made that is
        not there: `prepare(trajectory.constraint)` makes it before.
        Raises PlannerError for a time beyond 0 and the duration, an answer without a path, or a
        trajectory of another robot.  Shapes of `plan(scene=[…])` are not in the scene.
        """
        self._require_open()
        if not isinstance(trajectory, Trajectory):
            raise PlannerError(f"replan takes a trajectory, not a {type(trajectory).__name__}")
        _require_seconds(limit_s, "limit_s")
        limit = np.inf if limit_s is None else limit_s
        return Replanning(self._answering, self._preparation).replan(trajectory, at_s, limit)

    def plan_batch(
        self,
        starts: Float[np.ndarray, "B D"],
        goals: Float[np.ndarray, "B D"],
        constraint: str | Constraint,
        *,
        progress: Callable[[int], None] | None = None,
    ) -> list[Trajectory]:
        """The paths of B queries of one constraint, one for each, in their order; progress is
        called with the number done, and without it a bar is shown where it takes more than two
        seconds; other threads have their turn between queries.

        Raises PlannerError, before anything is planned, if starts and goals have not the same shape
        (B, D), a row is not finite, or the constraint is unknown.
        """
        self._require_open()
        self._named(constraint)
        if not (progress is None or callable(progress)):
            raise PlannerError(f"progress = {shown(progress)}: must be a function")
        first, last = _batch(starts, goals, self.scene.robot.dof)
        answers: list[Trajectory] = []
        with ExitStack() as shown_bar:
            done = progress if progress is not None else _late_bar(shown_bar, len(first))
            for start, goal in zip(first, last, strict=True):
                answers.append(self.plan(start, goal, constraint))
                done(len(answers))
        return answers

    def check(
        self,
        file: str | Path,
        constraint: str | Constraint | None = None,
        *,
        start: ArrayLike | None = None,
        goal: ArrayLike | None = None,
    ) -> Certificate:
        """Certify a path from CSV (`read_trajectory`) under a constraint, by default the one its
        file names; without a reference it is held where the path begins.  start, goal: the ends
        [rad] that it must have, if any.  Warns of shapes that the path was planned among and the
        scene has not.

        Raises PlannerError if the file can't be read, or neither names a constraint that exists.
        """
        self._require_open()
        path = Path(checked_path(file, "file", PlannerError))
        read = read_trajectory(path, self.robot.joint_names, self.robot)  # before others wait
        return self.check_read(read, constraint, start=start, goal=goal)

    def check_read(
        self,
        path: Read,
        constraint: str | Constraint | None = None,
        *,
        start: ArrayLike | None = None,
        goal: ArrayLike | None = None,
    ) -> Certificate:
        """The same of a file that is read already."""
        with self.scene.lock:
            self._require_open()
            joints, times, own, moving, among, file = path
            there = self.scene.now.names
            if missing := [name for name in among if name not in there]:
                line = f"{file} was planned among {', '.join(missing)}, which are not in this scene"
                warnings.warn(line, stacklevel=3)
            if constraint is not None:
                own, _ = self._named(constraint)
            if own is None:
                raise PlannerError(f"{file} names no constraint: say which with --constraint")
            first, last = (
                None if q is None else checked_configuration(q, self.robot.dof, name)
                for q, name in ((start, "start"), (goal, "goal"))
            )
            # one that is not placed is held as the first row has it, if that is anywhere
            held = self._held_at(own, np.where(np.abs(joints[0]) <= LARGEST, joints[0], 0.0))
            return self._certifier.certify(joints, held, first, last, times, start_velocity=moving)

    def _named(self, constraint: str | Constraint) -> tuple[Constraint, str]:
        if isinstance(constraint, Constraint):
            return constraint, constraint.label
        if not isinstance(constraint, str) or constraint not in self.constraints:
            known = ", ".join(self.constraints)
            line = f"there is no constraint {shown(constraint)}: must be one of {known}"
            raise PlannerError(line)
        return self.constraints[constraint], constraint

    def _held_at(self, constraint: Constraint, start: Float[np.ndarray, "D"]) -> Constraint:
        if constraint.is_placed:
            return constraint
        return constraint.relative_to(Pose(*self.scene.robot.forward(start)))

    def _snapped(
        self, start: Float[np.ndarray, "D"], manifold: ConstraintManifold
    ) -> tuple[Float[np.ndarray, "D"], float]:
        """The start, moved where it keeps the constraint, and how far [rad]; as it is where that is
        too far away or leads through something.
        """
        broken = end_refused(manifold, start, "start")
        found = None if broken is None else projection(manifold, start)
        if found is None:
            return start, 0.0
        robot, away = self.robot, found.configuration - start
        turned, slid = (
            float(np.linalg.norm(away[own]))
            for own in (~robot.chain.prismatic, robot.chain.prismatic)
        )
        way = np.stack([np.clip(start, robot.lower, robot.upper), found.configuration])
        if turned > SNAP_RAD or slid > SNAP_M or not self._certifier.collisions.is_clear(way):
            return start, 0.0
        return found.configuration, found.distance_rad


def _require_seconds(value: Any, name: str) -> None:
    if value is not None and not (is_number(value) and 0.0 < value <= LARGEST):
        raise PlannerError(f"{name} = {shown(value)}: must be a positive number of seconds")


def _require_pose(value: object, name: str) -> None:
    if not isinstance(value, Pose):
        raise PlannerError(f"{name} = {shown(value)}: must be a Pose")


def _batch(
    starts: Float[np.ndarray, "B D"], goals: Float[np.ndarray, "B D"], dof: int
) -> tuple[Float[np.ndarray, "B D"], Float[np.ndarray, "B D"]]:
    first, last = numbers(starts), numbers(goals)
    if first is None or last is None:
        line = f"starts and goals must be (B, {dof}) numbers [rad]; other goals are `plan`'s"
        raise PlannerError(line)
    if first.ndim != 2 or first.shape != last.shape or first.shape[1] != dof:
        shapes = f"starts and goals have shapes {first.shape} and {last.shape}"
        raise PlannerError(f"{shapes}: both must be (B, {dof})")
    for name, ends in (("starts", first), ("goals", last)):
        wrong = np.flatnonzero(~(np.abs(ends) <= LARGEST).all(axis=1))
        if len(wrong):
            raise PlannerError(f"{name}[{wrong[0]}] = {ends[wrong[0]].tolist()}: must be finite")
    return first, last


def limits_of(settings: PlannerParams, judge: JudgeParams, robot: SerialRobot) -> Limits:
    """What a returned path is certified for."""
    turning, sliding = settings.acceleration_rad_s2, settings.acceleration_m_s2
    return Limits(
        end_tolerance_rad=judge.end_tolerance_rad,
        max_step_rad=judge.max_step_rad,
        violation_tolerance=judge.violation_tolerance,
        acceleration_rad_s2=tuple(sliding if own else turning for own in robot.chain.prismatic),
    )
