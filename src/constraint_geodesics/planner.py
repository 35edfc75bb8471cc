"""What a user imports: start, goal and constraint in; a certified trajectory out, or a status that
says why not.

planner = Planner.load()
trajectory = planner.plan(start, goal, "level_cup")
"""

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from jaxtyping import Float

from constraint_geodesics import warmup
from constraint_geodesics.bundle import Bundle, open_bundle
from constraint_geodesics.certification.certifier import Certificate, Certifier, Limits
from constraint_geodesics.constraints.constraint import (
    Constraint,
    ConstraintManifold,
    Pose,
    constraint_from,
)
from constraint_geodesics.geometry.errors import GeometryError
from constraint_geodesics.geometry.timing import time_parametrisation
from constraint_geodesics.goals.goal import ArrayLike, Goal, Wanted, checked_configuration
from constraint_geodesics.goals.pose import POSE_JOINTS
from constraint_geodesics.goals.wanted import as_goals
from constraint_geodesics.methods import Method, SearchMethod, open_method
from constraint_geodesics.params import (
    JudgeParams,
    PlannerParams,
    PoseParams,
    RobotParams,
    WorkcellParams,
)
from constraint_geodesics.problem import PlannerError as PlannerError
from constraint_geodesics.problem import Status
from constraint_geodesics.robot.inverse_kinematics import Search, solutions, spread
from constraint_geodesics.robot.kinematics import SerialRobot, rpy_of
from constraint_geodesics.scene.arm import FOUND
from constraint_geodesics.scene.scene import Scene, robot_from, workcell_from
from constraint_geodesics.scene.shape import Shape
from constraint_geodesics.search.candidates import (
    ALL_PARTS,
    BENDS,
    Answer,
    Candidate,
    Parts,
    rows_of,
)
from constraint_geodesics.search.explanations import not_connected, refused_end
from constraint_geodesics.search.nearest import nearest_on
from constraint_geodesics.search.preparation import Preparation, Query
from constraint_geodesics.search.pursuit import Pursued, shortest
from constraint_geodesics.trajectory import Asked, Statistics, Trajectory, read_trajectory

COINCIDENT_RAD = 1e-7
"""Ends that differ by less in every joint are one configuration."""
STANDING_S = 0.001
"""Duration of a path from a configuration to itself."""
_NO_MORE = "no more curves"
_WORTHWHILE = 1e-4
"""Share by which a curve must be shorter than the path so far to be certified."""
_ROUND = BENDS + 1
"""Curves after which the kinds that are tried come round again."""
_TIGHTENED = (1.0, 0.7, 0.4)
"""Shares of the allowed violation that a path's waypoints are drawn for, should the certificate ask
for closer ones.
"""
_CLOSER = ("constraint_between_rows", "step")
"""What a certificate finds where waypoints lie too far apart."""
SNAP_RAD = 0.01
"""Distance by which a start is moved on request, at most."""
REPRESENTATIVES, _MANY_SEEDS = 64, 1024
"""Of the configurations that reach a pose, where there is no end of them; what they are found
from.
"""
OWN_CONSTRAINTS = {"free": Constraint((0,) * 6), "level": Constraint((0, 0, 0, 1, 1, 0))}
"""By name, of a planner that is made from a URDF: nothing held, and the tilt that the start has."""


@dataclass(frozen=True, eq=False)
class Projection:
    """The nearest configuration that keeps a constraint (D,) [rad], how far away it is [rad], and
    by how much the one asked for violates it [rad or m].
    """

    configuration: Float[np.ndarray, "D"]
    distance_rad: float
    violation_before: float


class Planner:
    """Plans paths of one robot in its workcell under any constraint.  Close it, or use it as a
    context manager.

    The roadmap of a constraint that has none yet is made the first time that a query needs it, or
    by `prepare`; everything is kept for the next query.
    """

    def __init__(self, bundle: Bundle, source: str, method: Method | None = None) -> None:
        warmup.ensure()
        self._closed = False
        self.source, self.bundle = source, bundle
        self.scene = Scene(robot_from(bundle.robot), workcell_from(bundle.workcell))
        self.constraints = {
            name: constraint_from(c, self.scene.robot) for name, c in bundle.constraints.items()
        }
        self.method: Method = method or SearchMethod()
        dof, settings = self.scene.robot.dof, bundle.planner
        self._acceleration = np.full(dof, settings.acceleration_rad_s2)
        self._certifier = Certifier(self.scene, limits_of(settings, bundle.judge, dof))
        checks = self._certifier.collisions
        self._preparation = Preparation(self.scene, checks, settings, self.method.draw)
        roadmaps = bundle.roadmaps if self.method.roadmaps is None else self.method.roadmaps
        self._preparation.supply(self.constraints, roadmaps)
        self.band = self._preparation.band

    @classmethod
    def load(cls, source: str | Path | None = None, method: str = SearchMethod.name) -> Self:
        """From a folder, an MLflow address (models:/… or runs:/…), or by default from the
        pipeline's outputs in this checkout, else from the files that come with the package.
        `planner.source` says which it was.

        method: how curves are looked for.  "planner": straight line, roadmap and trees, refined;
        nothing in it is learned.  "learned": by policies on the learned manifold alone, as the
        paper does; "learned+band": the same, refined by the planner's elastic band.
        Raises BundleError if files are missing or altered, PlannerError for another method.
        """
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
    ) -> Self:
        """For the arm of any URDF, a path or a name in pybullet_data; nothing is trained.  The
        names of its constraints are those of OWN_CONSTRAINTS.

        srdf: which links may touch; without it adjacent and rigid pairs, and those that always
        touch, found by sampling.  tool: the pose of the tool's own frame in its link.  hold: values
        of joints that are not to move [rad or m].  workcell: shapes around the arm.
        Raises RobotError, one line with the mend, where no arm can be made of the files.
        """
        own = None
        if tool is not None:
            rpy = rpy_of(tool.rotation)
            own = PoseParams(position_m=tuple(tool.position.tolist()), rpy_rad=rpy)
        robot = RobotParams(
            urdf=str(urdf),
            tool_link=tool_link,
            hold=dict(hold or {}),
            tool=own,
            may_touch=FOUND if srdf is None else str(srdf),
        )
        around = WorkcellParams().including(*workcell)
        made = cls(Bundle(robot, around, {}, PlannerParams(), JudgeParams(), {}), str(urdf))
        made.constraints |= OWN_CONSTRAINTS
        made._preparation.keep_clear_as_it_can()
        made.band = made._preparation.band
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

    def close(self) -> None:
        """Free the physics world; a closed planner answers no more."""
        self._closed = True
        self._certifier.close()

    def _require_open(self) -> None:
        if self._closed:
            raise PlannerError("this planner is closed: load another")

    def prepare(self, constraint: str | Constraint) -> None:
        """Make the constraint's roadmap now (about a second), and load the compiled code, so that
        no query waits.

        Raises PlannerError if it holds an axis but has no reference: its roadmap would be another
        for every start.
        """
        nodes = self.nodes(constraint)
        if len(nodes):
            self.plan(nodes[0], nodes[-1], constraint)

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

    def ik(self, pose: Pose) -> Float[np.ndarray, "n D"]:
        """Configurations [rad] free of collision and within the limits whose tool has a pose in the
        base frame: of six joints every one, whole turns included; of more some that are spread over
        all of them.
        """
        self._require_open()
        robot, settings = self.robot, Search()
        if robot.dof > POSE_JOINTS:
            settings = settings._replace(seeds=_MANY_SEEDS)
        found = solutions(robot, pose.position, pose.rotation, settings)
        free = found[self._certifier.collisions.free(found)]
        return spread(free, REPRESENTATIVES) if robot.dof > POSE_JOINTS else free

    def project(self, q: ArrayLike, constraint: str | Constraint) -> Projection:
        """The nearest configuration that keeps a constraint and the joint limits, as far as the
        descent from q [rad] finds it; collisions are not looked at.

        Raises PlannerError if the constraint holds an axis but has no reference, or nothing near
        keeps it.
        """
        given, name = self._named(constraint)
        if not given.is_placed:
            raise PlannerError(f"{name} has no reference pose: use constraint.relative_to(pose)")
        return self._projected(checked_configuration(q, self.robot.dof, "q"), given, name)

    def _projected(
        self, q: Float[np.ndarray, "D"], constraint: Constraint, name: str
    ) -> Projection:
        manifold = ConstraintManifold(self.robot, constraint)
        found = nearest_on(manifold, q, q[None])
        if not len(found):
            raise PlannerError(f"no configuration was found near {q.tolist()} that keeps {name}")
        away = float(np.linalg.norm(found[0] - q))
        return Projection(found[0], away, float(manifold.violation(q)))

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
    ) -> Trajectory:
        """A short path from a start [rad] under a constraint: a name from params.yaml, or a
        Constraint, which without a reference holds its axes where the start has them.

        goal: a configuration [rad], a tool Pose, a GoalRegion or any other Goal, or a list of
        them: the shortest path that is found to any is the answer.
        parts: of the planner to use, for comparisons.  budget_s: by default the first path that is
        certified is the answer; with a budget shorter ones, round the other side of something, are
        looked for while there is time for one more, by how long such a one took before, until so
        many seconds have passed since the call; functions of a constraint's own are compiled
        before, a roadmap that is not made yet is made within.  snap: a start that violates the
        constraint or a limit is moved to the nearest configuration that keeps them, where that is
        at most SNAP_RAD away; else such a start is refused.  velocity_scale, acceleration_scale:
        the shares of the limits that the motion uses, above 0 and at most 1.
        Raises PlannerError if an end has the wrong shape or is not finite, the name is unknown, or
        the budget or a scale is none.
        """
        self._require_open()
        given, name = self._named(constraint)
        given.compile()
        began = time.perf_counter()
        if budget_s is not None and not (np.isfinite(budget_s) and budget_s > 0.0):
            raise PlannerError(f"budget_s = {budget_s}: must be a positive number of seconds")
        scales = velocity_scale, acceleration_scale
        for scale, which in zip(scales, ("velocity", "acceleration"), strict=True):
            if not 0.0 < scale <= 1.0:
                raise PlannerError(f"{which}_scale = {scale}: must be above 0 and at most 1")
        dof = self.scene.robot.dof
        q_start, goals = checked_configuration(start, dof, "start"), as_goals(goal, dof)
        held = self._held_at(given, q_start)
        if snap:
            q_start = self._snapped(q_start, held, name)
        task = self._preparation.task(held)
        query = Query(task, name, q_start, q_start, began, parts, scales)
        refused = refused_end(query, "start", self._certifier.collisions)
        if refused is not None:
            return self._nothing(query, *refused)
        pursued = list(self._pursued(query, goals))
        if not pursued:
            wanted = " or ".join(one.description for one in goals)
            return self._nothing(query, "not_found", f"no configuration is {wanted}")
        pursued.sort(key=lambda one: one.distance)
        return self._answer(query, pursued, budget_s)

    def plan_batch(
        self,
        starts: Float[np.ndarray, "B D"],
        goals: Float[np.ndarray, "B D"],
        constraint: str | Constraint,
        *,
        progress: Callable[[int], None] | None = None,
    ) -> list[Trajectory]:
        """The paths of B queries of one constraint, one for each, in their order; progress is
        called with the number done.  Raises PlannerError, before anything is planned, if starts and
        goals have not the same shape (B, D), a row is not finite, or the constraint is unknown.
        """
        self._require_open()
        self._named(constraint)
        first, last = _batch(starts, goals, self.scene.robot.dof)
        answers = []
        for row, (start, goal) in enumerate(zip(first, last, strict=True)):
            answers.append(self.plan(start, goal, constraint))
            if progress is not None:
                progress(row + 1)
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
        [rad] that it must have, if any.

        Raises PlannerError if the file can't be read, or neither names a constraint that exists.
        """
        self._require_open()
        joints, times, own = read_trajectory(Path(file), self.robot.joint_names, self.robot)
        if constraint is not None:
            own, _ = self._named(constraint)
        if own is None:
            raise PlannerError(f"{file} names no constraint: say which with --constraint")
        first, last = (
            None if q is None else checked_configuration(q, self.robot.dof, name)
            for q, name in ((start, "start"), (goal, "goal"))
        )
        return self._certifier.certify(joints, self._held_at(own, joints[0]), first, last, times)

    def _named(self, constraint: str | Constraint) -> tuple[Constraint, str]:
        if isinstance(constraint, Constraint):
            return constraint, constraint.label
        if not isinstance(constraint, str) or constraint not in self.constraints:
            known = ", ".join(self.constraints)
            raise PlannerError(f"there is no constraint {constraint!r}: must be one of {known}")
        return self.constraints[constraint], constraint

    def _held_at(self, constraint: Constraint, start: Float[np.ndarray, "D"]) -> Constraint:
        if constraint.is_placed:
            return constraint
        return constraint.relative_to(Pose(*self.scene.robot.forward(start)))

    def _snapped(
        self, start: Float[np.ndarray, "D"], constraint: Constraint, name: str
    ) -> Float[np.ndarray, "D"]:
        """The start, moved where it keeps the constraint; as it is where that is too far away."""
        try:
            found = self._projected(start, constraint, name)
        except PlannerError:
            return start
        return found.configuration if found.distance_rad <= SNAP_RAD else start

    def _pursued(self, query: Query, goals: Sequence[Goal]) -> Iterator[Pursued]:
        """The goals' configurations."""
        for goal in goals:
            region = None
            if goal.region is not None:
                region = ConstraintManifold(self.scene.robot, goal.region)
            for q in goal.configurations(query.task.manifold, query.start):
                away = float(np.linalg.norm(q - query.start))
                yield Pursued(q, away, self._curves(replace(query, goal=q)), region)

    def _curves(self, query: Query) -> Iterator[Candidate | Answer | None]:
        """The method's, unless the goal is refused."""
        refused = refused_end(query, "goal", self._certifier.collisions)
        if refused is not None:
            status, line = refused
            yield Answer(status, explanation=line)
            return
        yield from self.method.candidates(query.task, query.start, query.goal, query.parts)

    def _answer(
        self, query: Query, pursued: Sequence[Pursued], budget_s: float | None
    ) -> Trajectory:
        """The answer for some configurations as the goal, the nearest first."""
        if pursued[0].distance <= COINCIDENT_RAD:
            return self._standing(replace(query, goal=pursued[0].goal))

        def certify(candidate: Candidate) -> tuple[Trajectory, float] | str:
            found = self._certified(replace(query, goal=candidate.points[-1]), candidate)
            return found if isinstance(found, str) else (found, found.length_rad)

        path, count = shortest(pursued, query.task, certify), len(pursued)
        if path is None:
            return self._failed(query, pursued)
        if budget_s is not None:
            path = self._improved(replace(query, goal=path.joints[-1]), path, budget_s)
        if count == 1:
            return path
        line = f"{path.explanation}, the shortest to any of {count} configurations"
        return replace(path, explanation=line, statistics=self._statistics(query, path.source))

    def _failed(self, query: Query, pursued: Sequence[Pursued]) -> Trajectory:
        """Why there is no path to any goal: what is said of the nearest one that could end one."""
        answers = [(one, one.answer or Answer("not_found")) for one in pursued]
        one, end = next((own for own in answers if not own[1].explanation), answers[0])
        query = replace(query, goal=one.goal)
        line = end.explanation
        if end.status == "not_connected":
            line = not_connected(query, end, self._certifier.collisions)
        elif not line:
            line = f"no curve tried is a path under {query.name}{one.failed}"
        if len(pursued) > 1:
            line += f"; so it is with all {len(pursued)} configurations of the goal"
        return self._nothing(query, end.status, line)

    def _improved(self, query: Query, path: Trajectory, budget_s: float) -> Trajectory:
        """The shortest certified path that is found before the time is over; `path` if it remains
        that.  No curve is begun that would end too late, going by the last of its kind, and for the
        first ones by the longest.
        """
        curves = self.method.improvements(query.task, query.start, query.goal, query.parts)
        spent = time.perf_counter() - query.began
        lasted = deque[float](maxlen=_ROUND)
        while spent + (lasted[0] if len(lasted) == _ROUND else max(lasted, default=0.0)) < budget_s:
            candidate = next(curves, _NO_MORE)
            if isinstance(candidate, str):
                break
            if candidate is not None and candidate.length < (1.0 - _WORTHWHILE) * path.length_rad:
                found = self._certified(query, candidate)
                if isinstance(found, Trajectory) and found.length_rad < path.length_rad:
                    path = found
            before, spent = spent, time.perf_counter() - query.began
            lasted.append(spent - before)
        return replace(path, statistics=self._statistics(query, path.source))

    def _certified(self, query: Query, candidate: Candidate) -> Trajectory | str:
        """The candidate as a trajectory if it is certified, otherwise why it is not."""
        robot, constraint = self.scene.robot, query.task.manifold.constraint
        allowed = self._certifier.limits.violation_tolerance
        for share in _TIGHTENED:
            joints = rows_of(candidate, share * allowed)
            try:
                limits = robot.velocity * query.scales[0], self._acceleration * query.scales[1]
                times = time_parametrisation(joints, *limits)
            except GeometryError as error:
                return str(error)
            certificate = self._certifier.certify(
                joints, constraint, query.start, query.goal, times
            )
            if certificate.violation is None or certificate.violation.kind not in _CLOSER:
                break
        if certificate.violation is not None:
            return certificate.violation.message
        line = (
            f"{certificate.length_rad:.3f} rad in {times[-1]:.2f} s from the {candidate.source} "
            f"proposal, at most {certificate.violation_bound:.1e} off {query.name}"
        )
        about = self._asked(query), self._statistics(query, candidate.source)
        return Trajectory("solved", joints, times, line, *about, certificate)

    def _standing(self, query: Query) -> Trajectory:
        """The path between ends that only rounding tells apart."""
        joints, times = np.stack([query.start, query.goal]), np.array([0.0, STANDING_S])
        constraint = query.task.manifold.constraint
        certificate = self._certifier.certify(joints, constraint, query.start, query.goal, times)
        line = "the start is the goal"
        if certificate.violation is not None:
            line = f"{line}, and no path: {certificate.violation.message}"
            return self._nothing(query, "not_found", line)
        about = self._asked(query), self._statistics(query, "straight")
        return Trajectory("solved", joints, times, line, *about, certificate)

    def _nothing(self, query: Query, status: Status, explanation: str) -> Trajectory:
        empty, about = np.empty((0, self.scene.robot.dof)), self._asked(query)
        statistics = self._statistics(query, "")
        return Trajectory(status, empty, np.empty(0), explanation, about, statistics)

    def _asked(self, query: Query) -> Asked:
        return Asked(query.task.manifold.constraint, query.name, self.scene)

    def _statistics(self, query: Query, source: str) -> Statistics:
        return Statistics(time.perf_counter() - query.began, self.method.name, source)


def _batch(
    starts: Float[np.ndarray, "B D"], goals: Float[np.ndarray, "B D"], dof: int
) -> tuple[Float[np.ndarray, "B D"], Float[np.ndarray, "B D"]]:
    try:
        first, last = np.asarray(starts, float), np.asarray(goals, float)
    except (TypeError, ValueError):
        raise PlannerError(f"starts and goals must be (B, {dof}) numbers [rad]") from None
    if first.ndim != 2 or first.shape != last.shape or first.shape[1] != dof:
        shapes = f"starts and goals have shapes {first.shape} and {last.shape}"
        raise PlannerError(f"{shapes}: both must be (B, {dof})")
    for name, ends in (("starts", first), ("goals", last)):
        wrong = np.flatnonzero(~np.isfinite(ends).all(axis=1))
        if len(wrong):
            raise PlannerError(f"{name}[{wrong[0]}] = {ends[wrong[0]].tolist()}: must be finite")
    return first, last


def limits_of(settings: PlannerParams, judge: JudgeParams, dof: int) -> Limits:
    """What a returned path is certified for."""
    return Limits(
        end_tolerance_rad=judge.end_tolerance_rad,
        max_step_rad=judge.max_step_rad,
        violation_tolerance=judge.violation_tolerance,
        acceleration_rad_s2=(settings.acceleration_rad_s2,) * dof,
    )
