"""What a user imports: start, goal and constraint in; a certified joint path out, or a status that
says why not.

planner = Planner.load()
path = planner.plan(start, goal, "level_cup")
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path as FilePath
from typing import Literal, Self

import numpy as np
from jaxtyping import Float

from constraint_geodesics.bundle import Bundle, open_bundle
from constraint_geodesics.certification.certifier import Certificate, Certifier, Limits
from constraint_geodesics.constraints.constraint import (
    Constraint,
    ConstraintManifold,
    Pose,
    constraint_from,
    constraint_from_json,
)
from constraint_geodesics.constraints.projection import Retraction, retract
from constraint_geodesics.geometry.errors import GeometryError
from constraint_geodesics.geometry.timing import time_parametrisation
from constraint_geodesics.learning.inference import FrozenManifold
from constraint_geodesics.params import JudgeParams, PlannerParams
from constraint_geodesics.problem import ends_refused
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.scene import Scene, robot_from, workcell_from
from constraint_geodesics.search.band import BandSettings, project
from constraint_geodesics.search.candidates import (
    ALL_PARTS,
    Answer,
    Candidate,
    Parts,
    Proposals,
    Task,
    candidates,
    improvements,
    rows_of,
)
from constraint_geodesics.search.roadmap import Joined, Roadmap, build_roadmap, join
from constraint_geodesics.search.space import Space

Status = Literal[
    "solved",
    "not_connected",
    "start_violates",
    "goal_violates",
    "out_of_limits",
    "in_collision",
    "not_found",
]
ALTERNATIVES = 64
"""Configurations from which another goal with the same tool pose is looked for."""
COINCIDENT_RAD = 1e-7
"""Ends that differ by less in every joint are one configuration."""
STANDING_S = 0.001
"""Duration of a path from a configuration to itself."""
KEPT_TASKS = 64
"""Constraints without a name that are remembered, with their graphs."""
_ROUNDS = 20
_NO_MORE = "no more curves"
_WORTHWHILE = 1e-4
"""Share by which a curve must be shorter than the path so far to be certified."""
_TIGHTENED = (1.0, 0.7, 0.4)
"""Shares of the allowed violation that a path's rows are drawn for, should the certificate ask for
closer ones.
"""


class PlannerError(ValueError):
    """A question that can't be meant; the message names the value and what is allowed."""


@dataclass(frozen=True, eq=False)
class Path:
    """A planner's answer; two of them are equal only if they are the same object.

    status: "solved", or why there is no path.  joints (T, D) [rad]: both ends exact, straight lines
    between the rows keep the constraint to within `violation_bound_rad`; (0, D) without a path.
    times (T,) [s]: within the velocity and acceleration limits, at rest at both ends.  source: the
    proposal it came from.
    length_rad: in joint space.  max_violation_rad, violation_bound_rad: excess over the tolerance
    where it was looked at, and its bound on the whole path; rad, or m where a held position is
    worse.  nan without a path.
    planning_time_s: everything, PyBullet's check included, which took collision_time_s of it.
    explanation: one line for people.
    """

    status: Status
    joints: Float[np.ndarray, "T D"]
    times: Float[np.ndarray, "T"]
    explanation: str
    length_rad: float
    max_violation_rad: float
    violation_bound_rad: float
    planning_time_s: float
    collision_time_s: float
    source: str
    constraint: Constraint
    constraint_name: str
    scene: Scene = field(repr=False)
    certificate: Certificate | None = field(default=None, repr=False)
    _space: Space | None = field(default=None, repr=False)

    def at(self, s: float | Sequence[float] | Float[np.ndarray, "n"]) -> Float[np.ndarray, "*n D"]:
        """Configurations [rad] at shares s in [0, 1] of the way, each on the constraint: points of
        the straight lines between the rows, projected.

        What is certified are the rows and those lines.  The projected points keep the constraint
        itself, but nothing was asked of their collisions, and near a singular configuration they
        lie further from the lines than the violation's bound says, since that is no distance of
        joints.

        Raises PlannerError without a path, or if a share lies outside [0, 1].
        """
        if self._space is None:
            raise PlannerError(f"there is no path: {self.explanation}")
        try:
            shares = np.atleast_1d(np.asarray(s, float))
        except (TypeError, ValueError):
            raise PlannerError(f"s = {s}: must be a number or a row of numbers in [0, 1]") from None
        if shares.ndim != 1 or not ((shares >= 0.0) & (shares <= 1.0)).all():
            raise PlannerError(f"s = {s}: must be a number or a row of numbers in [0, 1]")
        way = np.concatenate(
            [[0.0], np.cumsum(np.linalg.norm(np.diff(self.joints, axis=0), axis=1))]
        )
        at = shares * way[-1]
        points = np.ascontiguousarray(
            np.stack([np.interp(at, way, joint) for joint in self.joints.T], axis=1)
        )
        between = ~np.isin(at, way)
        moved = points[between]
        project(self._space, moved)
        points[between] = moved
        points[shares == 0.0], points[shares == 1.0] = self.joints[0], self.joints[-1]
        return points[0] if np.ndim(s) == 0 else points

    def save(self, file: str | FilePath) -> None:
        """Write the path as CSV: a comment line with the constraint, then time_s and the joints
        [rad], one row a row.

        Raises PlannerError without a path.
        """
        if self.status != "solved":
            raise PlannerError(f"there is no path to save: {self.explanation}")
        write_path(
            FilePath(file), self.joints, self.times, self.constraint, self.scene.robot.joint_names
        )

    def record(self, file: str | FilePath, frames: int = 100) -> None:
        """Write a Rerun recording of the path.  Raises PlannerError without a path."""
        from constraint_geodesics.recording.recording import PathRecord, record_path

        if self.status != "solved":
            raise PlannerError(f"there is no path to record: {self.explanation}")
        record = PathRecord("planner", self.constraint_name, 0, 0, self.joints, self._markdown())
        manifold = ConstraintManifold(self.scene.robot, self.constraint)
        record_path(FilePath(file), record, manifold, self.scene.workcell, frames=frames)

    def draw(self, file: str | FilePath) -> None:
        """Draw joints and violation over time as PNG.  Raises PlannerError without a path."""
        from constraint_geodesics.recording.path_figure import path_figure
        from constraint_geodesics.report.figures import save_png

        if self.status != "solved":
            raise PlannerError(f"there is no path to draw: {self.explanation}")
        robot = self.scene.robot
        violation = ConstraintManifold(robot, self.constraint).violation(self.joints)
        figure = path_figure(
            self.times,
            self.joints,
            robot.skeleton(self.joints),
            violation,
            self.violation_bound_rad,
            robot.joint_names,
            f"{self.constraint_name}: {self.explanation}",
        )
        save_png(figure, FilePath(file))

    def summary(self) -> dict[str, str | float | int | None]:
        """The answer without its arrays, as JSON takes it; figures that do not exist are None."""
        numbers = {
            "length_rad": self.length_rad,
            "duration_s": float(self.times[-1]) if len(self.times) else np.nan,
            "max_violation_rad": self.max_violation_rad,
            "violation_bound_rad": self.violation_bound_rad,
            "planning_time_s": self.planning_time_s,
            "collision_time_s": self.collision_time_s,
        }
        finite = {
            name: float(value) if np.isfinite(value) else None for name, value in numbers.items()
        }
        about = {
            "status": self.status,
            "constraint": self.constraint_name,
            "explanation": self.explanation,
        }
        return {**about, "source": self.source or None, "rows": len(self.joints), **finite}

    def _markdown(self) -> str:
        return "\n".join(
            (
                f"**planned path**, constraint `{self.constraint_name}`",
                "",
                f"- {self.explanation}",
                f"- duration {self.times[-1]:.2f} s",
                f"- proposal: {self.source}",
            )
        )


class Planner:
    """Plans paths of one robot in its workcell under any constraint.  Close it, or use it as a
    context manager.

    The graph of a constraint that the pipeline did not see is made the first time that a query
    needs it, or by `prepare`; everything is kept for the next query.
    """

    def __init__(self, bundle: Bundle, source: str) -> None:
        self._closed = False
        self.source = source
        self.bundle = bundle
        self.scene = Scene(robot_from(bundle.robot), workcell_from(bundle.workcell))
        self.constraints = {
            name: constraint_from(params, self.scene.robot)
            for name, params in bundle.constraints.items()
        }
        self.chart = FrozenManifold(bundle.manifold)
        settings, judge = bundle.planner, bundle.judge
        self.band = BandSettings(
            settings.segments,
            settings.iterations,
            settings.accuracy,
            settings.largest_step_rad,
            settings.clearance_m,
        )
        self._acceleration = np.full(self.scene.robot.dof, settings.acceleration_rad_s2)
        self._certifier = Certifier(self.scene, limits_of(settings, judge, self.scene.robot.dof))
        self._world = self.scene.world()
        self._clearance = clearance_model(self.scene.robot, self.scene.workcell)
        self._tasks: dict[tuple, Task] = {}
        self._roadmaps: dict[tuple, Roadmap | None] = {}
        for name, roadmap in bundle.roadmaps.items():
            # the nodes are written in single precision, which may lie beyond a limit
            inside = np.clip(roadmap.joints, self.scene.robot.lower, self.scene.robot.upper)
            inside.setflags(write=False)
            self._roadmaps[self.constraints[name].key] = replace(roadmap, joints=inside)
        self._supplied = frozenset(self._roadmaps)

    @classmethod
    def load(cls, source: str | FilePath | None = None) -> Self:
        """From a folder, an MLflow address (models:/… or runs:/…), or by default from the
        pipeline's outputs in this checkout, else from the files that come with the package.
        `planner.source` says which it was.

        Raises BundleError if the files are missing or altered.
        """
        return cls(*open_bundle(source))

    def __enter__(self) -> Self:
        self._require_open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the physics worlds; a closed planner answers no more."""
        self._closed = True
        self._certifier.close()
        self._world.close()

    def _require_open(self) -> None:
        if self._closed:
            raise PlannerError("this planner is closed: load another")

    def prepare(self, constraint: str | Constraint) -> None:
        """Make the constraint's graph now (about a second), and load the compiled code, so that no
        query waits.

        Raises PlannerError if it holds an axis but has no reference: its graph would be another for
        every start.
        """
        nodes = self.nodes(constraint)
        if len(nodes):
            self.plan(nodes[0], nodes[-1], constraint)

    @cached_property
    def _proposals(self) -> Proposals | None:
        """Loaded where a query asks for them: the training library takes seconds to import."""
        if not self.bundle.policies:
            return None
        from constraint_geodesics.geodesics.policy_proposals import PolicyProposals

        return PolicyProposals.from_arrays(
            self.bundle.manifold, self.bundle.policies, self.bundle.policy
        )

    def nodes(self, constraint: str | Constraint) -> Float[np.ndarray, "n D"]:
        """Configurations of the constraint's graph [rad], not to be written to; none where it has
        no graph.

        Raises PlannerError if it holds an axis but has no reference.
        """
        self._require_open()
        meant, name = self._named(constraint)
        if not meant.is_placed:
            raise PlannerError(f"{name} has no reference pose: use constraint.relative_to(pose)")
        roadmap = self._task(meant).roadmap()
        return np.empty((0, self.scene.robot.dof)) if roadmap is None else roadmap.joints

    def plan(
        self,
        start: Float[np.ndarray, "D"] | Sequence[float],
        goal: Float[np.ndarray, "D"] | Sequence[float],
        constraint: str | Constraint,
        *,
        parts: Parts = ALL_PARTS,
        budget_s: float | None = None,
    ) -> Path:
        """A short path from start to goal [rad] under a constraint: a name from params.yaml, or a
        Constraint, which without a reference holds its axes where the start has them.

        parts: of the planner to use, for comparisons.  budget_s: by default the first path that is
        certified is the answer; with a budget shorter ones, round the other side of something, are
        looked for until so many seconds have passed since the call.
        Raises PlannerError if an end has the wrong shape or is not finite, the name is unknown, or
        the budget is no positive number.
        """
        began = time.perf_counter()
        self._require_open()
        if budget_s is not None and not (np.isfinite(budget_s) and budget_s > 0.0):
            raise PlannerError(f"budget_s = {budget_s}: must be a positive number of seconds")
        q_start, q_goal = self._configuration(start, "start"), self._configuration(goal, "goal")
        meant, name = self._named(constraint)
        held = self._held_at(meant, q_start)
        refused = self._refusal(held, name, q_start, q_goal)
        task = self._task(held)
        if refused is not None:
            return self._nothing(*refused, held, name, began)
        if np.abs(q_start - q_goal).max() <= COINCIDENT_RAD:
            return self._standing(task, np.stack([q_start, q_goal]), name, began)
        problem = ""
        answer = Answer("not_found")
        for candidate in candidates(task, q_start, q_goal, lambda: self._proposals, parts):
            if isinstance(candidate, Answer):
                answer = candidate
                break
            found = self._certified(task, candidate, q_start, q_goal, name, began)
            if isinstance(found, Path):
                return (
                    found
                    if budget_s is None
                    else self._improved(task, found, parts, began, budget_s)
                )
            problem = f"; the {candidate.source} curve fails: {found}"
        if answer.status == "not_connected":
            return self._nothing(
                "not_connected", self._apart(task, answer, q_goal, name), held, name, began
            )
        return self._nothing(
            "not_found", f"no curve tried is a path under {name}{problem}", held, name, began
        )

    def plan_batch(
        self,
        starts: Float[np.ndarray, "B D"],
        goals: Float[np.ndarray, "B D"],
        constraint: str | Constraint,
        *,
        progress: Callable[[int], None] | None = None,
    ) -> list[Path]:
        """The paths of B queries of one constraint, one for each, in their order; progress is
        called with the number done.  Raises PlannerError, before anything is planned, if starts and
        goals have not the same shape (B, D), a row is not finite, or the constraint is unknown.
        """
        self._require_open()
        self._named(constraint)
        try:
            first, last = np.asarray(starts, float), np.asarray(goals, float)
        except (TypeError, ValueError):
            raise PlannerError(
                f"starts and goals must be (B, {self.scene.robot.dof}) numbers [rad]"
            ) from None
        if first.ndim != 2 or first.shape != last.shape or first.shape[1] != self.scene.robot.dof:
            wanted = f"both must be (B, {self.scene.robot.dof})"
            raise PlannerError(
                f"starts and goals have shapes {first.shape} and {last.shape}: {wanted}"
            )
        for name, ends in (("starts", first), ("goals", last)):
            wrong = np.flatnonzero(~np.isfinite(ends).all(axis=1))
            if len(wrong):
                raise PlannerError(
                    f"{name}[{wrong[0]}] = {ends[wrong[0]].tolist()}: must be finite"
                )
        paths = []
        for row, (start, goal) in enumerate(zip(first, last, strict=True)):
            paths.append(self.plan(start, goal, constraint))
            if progress is not None:
                progress(row + 1)
        return paths

    def _configuration(
        self, q: Float[np.ndarray, "D"] | Sequence[float], name: str
    ) -> Float[np.ndarray, "D"]:
        try:
            if np.iscomplexobj(q):
                raise TypeError("complex")
            values = np.array(q, dtype=np.float64)
        except (TypeError, ValueError):
            raise PlannerError(
                f"{name} = {q}: must be {self.scene.robot.dof} numbers [rad]"
            ) from None
        if values.shape != (self.scene.robot.dof,):
            raise PlannerError(
                f"{name} has shape {values.shape}: must be ({self.scene.robot.dof},) [rad]"
            )
        if not np.isfinite(values).all():
            raise PlannerError(f"{name}[{int(np.argmin(np.isfinite(values)))}] is not finite")
        return values

    def _named(self, constraint: str | Constraint) -> tuple[Constraint, str]:
        if isinstance(constraint, Constraint):
            return constraint, constraint.label
        if not isinstance(constraint, str) or constraint not in self.constraints:
            raise PlannerError(
                f"there is no constraint {constraint!r}: must be one of "
                f"{', '.join(self.constraints)}"
            )
        return self.constraints[constraint], constraint

    def _held_at(self, constraint: Constraint, start: Float[np.ndarray, "D"]) -> Constraint:
        if constraint.is_placed:
            return constraint
        position, rotation = self.scene.robot.forward(start)
        return constraint.relative_to(Pose(position, rotation))

    def _task(self, constraint: Constraint) -> Task:
        key = constraint.key
        if key not in self._tasks:
            if len(self._tasks) >= KEPT_TASKS + len(
                self.constraints
            ):  # the oldest one that has no name goes
                named = {own.key for own in self.constraints.values()}
                oldest = next(other for other in self._tasks if other not in named)
                del self._tasks[oldest]
                self._roadmaps.pop(oldest, None)
            manifold = ConstraintManifold(self.scene.robot, constraint)
            self._tasks[key] = Task(
                manifold,
                self._clearance,
                partial(self._roadmap, key, manifold),
                key in self._supplied,
                self.band,
            )
        return self._tasks[key]

    def _roadmap(self, key: tuple, manifold: ConstraintManifold) -> Roadmap | None:
        """The constraint's graph, made from samples of the learned manifold where the bundle has
        none.
        """
        if key not in self._roadmaps:
            settings = self.bundle.planner
            nodes = self._nodes(
                manifold, settings.roadmap_nodes, np.random.default_rng(settings.seed)
            )
            space = self._tasks[key].clear
            self._roadmaps[key] = (
                build_roadmap(space, nodes, settings.roadmap_neighbours) if len(nodes) > 1 else None
            )
        return self._roadmaps[key]

    def _nodes(
        self, manifold: ConstraintManifold, count: int, rng: np.random.Generator
    ) -> Float[np.ndarray, "n D"]:
        """Free configurations on the constraint: samples of the learned manifold, retracted; fewer
        if there are few.
        """
        robot, kept, found = self.scene.robot, [np.empty((0, self.scene.robot.dof))], 0
        for _ in range(_ROUNDS):
            drawn = self.chart.decode(self.chart.sample(2 * count, rng))
            share = rng.uniform(size=len(drawn)) ** (1.0 / max(manifold.rows.held.sum(), 1))
            result = retract(manifold, drawn, Retraction(), band=share)
            good = result.joints[result.converged & (robot.limit_distance(result.joints) >= 0.0)][
                : count - found
            ]
            kept.append(good[self._world.free(good)])
            found += len(kept[-1])
            if found >= count:
                break
        return np.concatenate(kept)

    def _refusal(
        self,
        constraint: Constraint,
        name: str,
        start: Float[np.ndarray, "D"],
        goal: Float[np.ndarray, "D"],
    ) -> tuple[Status, str] | None:
        """Why these ends can't be those of a path, as a status and a line for people."""
        task = self._task(constraint)
        status = ends_refused(task.manifold, start, goal)
        if status in ("start_violates", "goal_violates"):
            end, q = ("start", start) if status == "start_violates" else ("goal", goal)
            return status, f"the {end} violates {name} by {task.manifold.amount(q)}"
        if status == "out_of_limits":
            for end, q in (("start", start), ("goal", goal)):
                for joint, value, low, high in zip(
                    self.scene.robot.joint_names,
                    q,
                    self.scene.robot.lower,
                    self.scene.robot.upper,
                    strict=True,
                ):
                    if not low <= value <= high:
                        limits = f"its limits are {low:.4g} and {high:.4g} rad"
                        return status, f"{joint} of the {end} is {value:.4g} rad: {limits}"
        for end, q in (("start", start), ("goal", goal)):
            if not self._world.is_free(q):
                own = bool(self._world.label(q[None]).self_collision[0])
                return (
                    "in_collision",
                    f"the {end} touches {'the arm itself' if own else 'the workcell'}",
                )
        return None

    def _improved(
        self, task: Task, path: Path, parts: Parts, began: float, budget_s: float
    ) -> Path:
        """The shortest certified path that is found until the time is over; `path` if it remains
        that.
        """
        start, goal = path.joints[0], path.joints[-1]
        curves = improvements(task, start, goal, parts)
        while time.perf_counter() - began < budget_s:
            candidate = next(curves, _NO_MORE)
            if isinstance(candidate, str):
                break
            if candidate is not None and candidate.length < (1.0 - _WORTHWHILE) * path.length_rad:
                found = self._certified(task, candidate, start, goal, path.constraint_name, began)
                if isinstance(found, Path) and found.length_rad < path.length_rad:
                    path = found
        return replace(path, planning_time_s=time.perf_counter() - began)

    def _certified(
        self,
        task: Task,
        candidate: Candidate,
        start: Float[np.ndarray, "D"],
        goal: Float[np.ndarray, "D"],
        name: str,
        began: float,
    ) -> "Path | str":
        """The candidate as a path if it is certified, otherwise why it is not."""
        constraint, robot = task.manifold.constraint, self.scene.robot
        allowed = self._certifier.limits.violation_tolerance
        certificate = None
        for share in _TIGHTENED:
            _, rows = rows_of(task, candidate, share * allowed)
            try:
                times = time_parametrisation(rows, robot.velocity, self._acceleration)
            except GeometryError as error:
                return str(error)
            certificate = self._certifier.certify(rows, constraint, start, goal, times)
            if certificate.violation is None or certificate.violation.kind not in (
                "constraint_between_rows",
                "step",
            ):
                break
        assert certificate is not None
        if certificate.violation is not None:
            return certificate.violation.message
        bound, attained = certificate.violation_bound, certificate.max_violation
        line = (
            f"{certificate.length_rad:.3f} rad in {times[-1]:.2f} s from the "
            f"{candidate.source} proposal, "
            f"at most {bound:.1e} off {name}"
        )
        return Path(
            "solved",
            rows,
            times,
            line,
            certificate.length_rad,
            attained,
            bound,
            time.perf_counter() - began,
            certificate.collision_time_s,
            candidate.source,
            constraint,
            name,
            self.scene,
            certificate,
            task.open,
        )

    def _standing(
        self, task: Task, rows: Float[np.ndarray, "2 D"], name: str, began: float
    ) -> Path:
        """The path between ends that only rounding tells apart."""
        times = np.array([0.0, STANDING_S])
        certificate = self._certifier.certify(
            rows, task.manifold.constraint, rows[0], rows[1], times
        )
        if certificate.violation is not None:
            explanation = f"the start is the goal, and no path: {certificate.violation.message}"
            return self._nothing("not_found", explanation, task.manifold.constraint, name, began)
        return Path(
            "solved",
            rows,
            times,
            "the start is the goal",
            certificate.length_rad,
            certificate.max_violation,
            certificate.violation_bound,
            time.perf_counter() - began,
            certificate.collision_time_s,
            "straight",
            task.manifold.constraint,
            name,
            self.scene,
            certificate,
            task.open,
        )

    def _nothing(
        self, status: Status, explanation: str, constraint: Constraint, name: str, began: float
    ) -> Path:
        nan = float("nan")
        return Path(
            status,
            np.empty((0, self.scene.robot.dof)),
            np.empty(0),
            explanation,
            nan,
            nan,
            nan,
            time.perf_counter() - began,
            nan,
            "",
            constraint,
            name,
            self.scene,
        )

    def _apart(self, task: Task, answer: Answer, goal: Float[np.ndarray, "D"], name: str) -> str:
        """That start and goal are not joined, and the nearest goal that the start can reach
        instead.
        """
        line = f"start and goal lie in different components of {name}'s graph"
        roadmap = task.roadmap()
        if roadmap is None or answer.at_start is None:
            return line
        reached = np.isin(roadmap.labels, list(answer.at_start.components(roadmap)))
        nodes = roadmap.joints[reached]
        nodes = nodes[np.argsort(np.linalg.norm(nodes - goal, axis=1))]
        other = self._same_pose(
            task, roadmap, answer.at_start, nodes[:: max(len(nodes) // ALTERNATIVES, 1)], goal
        )
        if other is not None:
            return (
                f"{line}; the goal's tool pose can be reached from the start as "
                f"{_listed(other)} rad"
            )
        away = float(np.linalg.norm(nodes[0] - goal))
        return (
            f"{line}; the nearest configuration that the start can reach, {away:.2f} rad "
            f"away, is {_listed(nodes[0])}"
        )

    def _same_pose(
        self,
        task: Task,
        roadmap: Roadmap,
        at_start: Joined,
        seeds: Float[np.ndarray, "n D"],
        goal: Float[np.ndarray, "D"],
    ) -> Float[np.ndarray, "D"] | None:
        """The nearest other configuration with the goal's tool pose in the start's component, or
        None.
        """
        robot = self.scene.robot
        pose = Constraint((1,) * 6, reference=Pose(*robot.forward(goal)))
        result = retract(ConstraintManifold(robot, pose), seeds)
        found = result.joints[result.converged & (robot.limit_distance(result.joints) >= 0.0)]
        found = found[np.argsort(np.linalg.norm(found - goal, axis=1), kind="stable")]
        reached = at_start.components(roadmap)
        for q in found:
            if (
                self._world.is_free(q)
                and join(roadmap, task.clear, q).components(roadmap) & reached
            ):
                return q
        return None


def limits_of(settings: PlannerParams, judge: JudgeParams, dof: int) -> Limits:
    """What a returned path is certified for."""
    return Limits(
        end_tolerance_rad=judge.end_tolerance_rad,
        max_step_rad=judge.max_step_rad,
        violation_tolerance=judge.violation_tolerance,
        collision_spacing_rad=settings.collision_spacing_rad,
        acceleration_rad_s2=(settings.acceleration_rad_s2,) * dof,
    )


def check_path(
    file: str | FilePath, constraint: str | None = None, source: str | FilePath | None = None
) -> Certificate:
    """Certify a path from CSV (`read_path`) under a named constraint, by default the one its file
    names.

    Raises PlannerError if the file can't be read, or neither names a constraint that exists.
    """
    bundle, _ = open_bundle(source)
    scene = Scene(robot_from(bundle.robot), workcell_from(bundle.workcell))
    joints, times, own = read_path(FilePath(file), scene.robot.joint_names, scene.robot)
    if constraint is not None:
        if constraint not in bundle.constraints:
            known = ", ".join(bundle.constraints)
            raise PlannerError(f"there is no constraint {constraint!r}: must be one of {known}")
        own = constraint_from(bundle.constraints[constraint], scene.robot)
    if own is None:
        raise PlannerError(f"{file} names no constraint: say which with --constraint")
    with Certifier(scene, limits_of(bundle.planner, bundle.judge, scene.robot.dof)) as certifier:
        return certifier.certify(joints, own, times=times)


def write_path(
    file: FilePath,
    joints: Float[np.ndarray, "T D"],
    times: Float[np.ndarray, "T"],
    constraint: Constraint,
    names: Sequence[str],
) -> None:
    """Write a path as CSV, its constraint in a comment line before the header; numbers to the last
    bit.
    """
    lines = [f"# constraint: {json.dumps(constraint.to_json())}", ",".join(("time_s", *names))]
    lines += [
        ",".join(repr(float(x)) for x in (t, *row)) for t, row in zip(times, joints, strict=True)
    ]
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("\n".join(lines) + "\n")


def read_path(
    file: FilePath, names: Sequence[str] | None = None, robot: SerialRobot | None = None
) -> tuple[Float[np.ndarray, "T D"], Float[np.ndarray, "T"] | None, Constraint | None]:
    """A path from CSV: rows of joints [rad] under their names, with a column time_s and a
    constraint's comment line if there are any.  names: of the joints, which the columns must have
    in this order.  robot: for the kinds of constraints that need one.
    Raises PlannerError naming the file and the line that can't be read.
    """
    try:
        text = file.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise PlannerError(f"{file}: can't be read: {error}") from None
    lines = [
        (number, line.strip()) for number, line in enumerate(text.splitlines(), 1) if line.strip()
    ]
    constraint = None
    for number, line in lines:
        if line.startswith("# constraint: "):
            constraint = _constraint_of(file, number, line.removeprefix("# constraint: "), robot)
    table = [(number, line.split(",")) for number, line in lines if not line.startswith("#")]
    if len(table) < 2:
        raise PlannerError(f"{file}: a header line and at least one row are needed")
    (_, header), rows = table[0], table[1:]
    header = [name.strip() for name in header]
    timed = header[0] == "time_s"
    if any(_is_number(name) for name in header):
        raise PlannerError(
            f"{file}: a header line with the joints' names is needed before the rows"
        )
    if names is not None and header[int(timed) :] != list(names):
        raise PlannerError(
            f"{file}: its columns are {', '.join(header)}: must be {', '.join(names)}, after "
            f"time_s if any"
        )
    values = []
    for number, cells in rows:
        try:
            numbers = [float(cell) for cell in cells]
        except ValueError:
            raise PlannerError(f"{file}, line {number}: not a row of numbers") from None
        if len(numbers) != len(header):
            raise PlannerError(
                f"{file}, line {number}: {len(numbers)} numbers under {len(header)} names"
            )
        values.append(numbers)
    array = np.array(values)
    return array[:, int(timed) :], array[:, 0] if timed else None, constraint


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _constraint_of(file: FilePath, number: int, text: str, robot: SerialRobot | None) -> Constraint:
    try:
        return constraint_from_json(json.loads(text), robot)
    except (json.JSONDecodeError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise PlannerError(f"{file}, line {number}: not a constraint: {error}") from None


def _listed(q: Float[np.ndarray, "D"]) -> str:
    return "[" + ", ".join(f"{x:.9f}" for x in q) + "]"
