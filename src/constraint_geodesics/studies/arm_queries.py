"""Queries between configurations and to tool poses, a row each: the planner's first path beside
BiRRT's, and beside the best of what a pose or a region could mean.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from constraint_geodesics.benchmark.judge import problem_of
from constraint_geodesics.benchmark.queries import Query
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.goals.region import GoalRegion
from constraint_geodesics.peers.birrt import BirrtSettings
from constraint_geodesics.peers.making import until_sound
from constraint_geodesics.peers.ompl import SamplingPlanner
from constraint_geodesics.peers.wrappers import band_after
from constraint_geodesics.planner import Planner, limits_of
from constraint_geodesics.problem import PlanningProblem, Solution
from constraint_geodesics.robot.inverse_kinematics import Search, solutions, spread, turned_towards
from constraint_geodesics.robot.kinematics import SerialRobot, rotation_from_rpy
from constraint_geodesics.scene.clearance import ClearanceModel, clearance_model
from constraint_geodesics.search.preparation import free_configurations
from constraint_geodesics.trajectory import Trajectory

BIRRT_S, LONGER_S = 10.0, 1.0
"""What BiRRT is given for a query, and the planner for the length that its first path is compared
with.
"""
YAWS = 120
"""Tool poses of a grid over a free yaw."""
REPRESENTATIVES, SEEDS = 512, 2048
"""Configurations spread over the family that reaches a pose, and what they are found from."""
REFERENCES = 5
"""Poses that a constraint is held at, each for a part of the queries."""
NEAREST = 3
"""Of these, how many BiRRT is asked to go to, where nothing else finds a path."""
AXES = {
    "free": (0, 0, 0, 0, 0, 0),
    "level": (0, 0, 0, 1, 1, 0),
    "roll": (0, 0, 0, 1, 0, 0),
    "pitch": (0, 0, 0, 0, 1, 0),
    "yaw": (0, 0, 0, 0, 0, 1),
}
"""Constraints that hold their axes where the tool is at random configurations."""
DRAWN = 400
"""Configurations that are drawn for one that touches nothing."""

Pair = tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D"]]


@dataclass(frozen=True)
class Row:
    """One query.  best_known_rad: the shortest certified path to what was asked that anything here
    found, the planner's own among them; nan where nothing found one.

    source: the proposal that the path came from.  birrt_status: "" where it was not asked.
    given_…: to the query's own configuration instead of its tool pose.  prepared_s: of the
    constraint's roadmap, before.
    """

    query: int
    status: str
    length_rad: float
    time_ms: float
    best_known_rad: float = np.nan
    source: str = ""
    birrt_status: str = ""
    birrt_length_rad: float = np.nan
    birrt_time_ms: float = np.nan
    given_status: str = ""
    given_length_rad: float = np.nan
    prepared_s: float = np.nan


@dataclass(frozen=True)
class Found:
    """What BiRRT found: "solved" is the certificate's word."""

    status: str
    length_rad: float
    time_ms: float


@dataclass(frozen=True)
class BiRRT:
    """OMPL's RRTConnect in the projected space, which of its spaces solves most of the benchmark's
    queries, on one constraint of a planner's scene; each path as it is and with a band after it.
    """

    planner: Planner
    certifier: Certifier
    manifold: ConstraintManifold
    clearance: ClearanceModel
    warm: list[bool] = field(default_factory=list)

    def ask(self, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"]) -> Found:
        """The shorter of both paths, where one is certified; the time is without the band's.

        A path that is not certified before its band (it jumped from one part of the constraint to
        another) is followed by another attempt with half the steps, until BIRRT_S have passed.  The
        first query is asked twice: that loads its code.
        """
        spacing = self.planner.bundle.judge.row_spacing_rad
        known = problem_of(start, goal, self.manifold, self.certifier, self.clearance)
        own = until_sound(
            lambda settings: SamplingPlanner(settings.search, settings, spacing),
            BirrtSettings(budget_s=BIRRT_S),
            BIRRT_S,
        )
        if not self.warm:
            own.plan(replace(known), 0)
            self.warm.append(True)
        found = own.plan(known, 0)
        lengths = self._certified(known, found) if found.status == "solved" else []
        if not lengths:
            status = "not_certified" if found.status == "solved" else found.status
            return Found(status, np.nan, 1e3 * found.time_s)
        return Found("solved", min(lengths), 1e3 * found.time_s)

    def _certified(self, problem: PlanningProblem, found: Solution) -> list[float]:
        """Lengths [rad] of a path and of the same with a band, of each that is certified."""
        constraint, ends = self.manifold.constraint, (problem.start, problem.goal)
        both = found, band_after(problem, found, self.planner.band)
        certificates = (self.certifier.certify(own.joints, constraint, *ends) for own in both)
        return [own.length_rad for own in certificates if own.valid]


@contextmanager
def birrt_beside(planner: Planner, constraint: Constraint) -> Iterator[BiRRT]:
    """BiRRT in the planner's scene, with a certifier of its own for the planner's promises."""
    scene, bundle = planner.scene.now, planner.bundle
    limits = limits_of(bundle.planner, bundle.judge, scene.robot)
    with Certifier(scene, limits) as certifier:
        clearance = clearance_model(scene, certifier.collisions.apart)
        manifold = ConstraintManifold(scene.robot, constraint)
        yield BiRRT(planner, certifier, manifold, clearance)


def drawn_constraint(planner: Planner, name: str, seed: int) -> Constraint:
    """One of AXES, held where the tool is at the first random configuration that touches
    nothing.
    """
    with birrt_beside(planner, Constraint(AXES["free"])) as free:
        rng = np.random.default_rng((seed, 1))  # not that of the ends
        drawn = planner.robot.sample(DRAWN, rng)
        q = drawn[free.certifier.collisions.free(drawn)][0]
    return Constraint(AXES[name], reference=tool_pose(planner, q))


def tool_pose(planner: Planner, q: Float[np.ndarray, "D"]) -> Pose:
    """Where the tool is."""
    return Pose(*planner.robot.forward(q))


def drawn_pairs(birrt: BiRRT, count: int, seed: int) -> list[Pair]:
    """Ends that keep the constraint and touch nothing; fewer where there are few."""
    checks, robot = birrt.certifier.collisions, birrt.planner.robot
    rng = np.random.default_rng(seed)
    q = free_configurations(birrt.manifold, checks, robot.sample, 2 * count, rng)
    pairs = zip(q[:-1:2], q[1::2], strict=False)
    return [(start, _nearest_turn(robot, goal, start)) for start, goal in pairs]


def _nearest_turn(
    robot: SerialRobot, q: Float[np.ndarray, "D"], other: Float[np.ndarray, "D"]
) -> Float[np.ndarray, "D"]:
    """The same angles of continuous joints as near to another configuration as can be: what the
    planner takes for one goal, and what BiRRT is asked for.
    """
    turned = turned_towards(robot, q[None], other)[0]
    continuous = np.array([name in robot.continuous for name in robot.joint_names])
    return np.where(continuous, turned, q)


def between_configurations(
    planner: Planner, name: str, count: int, seed: int, *, ask_all: bool = True
) -> list[Row]:
    """Random pairs under one of AXES, held at REFERENCES poses one after another.  ask_all: BiRRT
    is asked all of them, else those that the planner does not solve.
    """
    rows = list[Row]()
    for k, some in enumerate(np.array_split(np.arange(count), REFERENCES if name != "free" else 1)):
        if not len(some):
            continue
        constraint = drawn_constraint(planner, name, seed + k)
        began = time.perf_counter()
        planner.prepare(constraint)
        prepared_s = time.perf_counter() - began
        with birrt_beside(planner, constraint) as birrt:
            for start, goal in drawn_pairs(birrt, len(some), seed + k):
                row = _between(planner, birrt, (start, goal), ask_all)
                rows.append(replace(row, query=len(rows), prepared_s=prepared_s))
    return rows


def _between(planner: Planner, birrt: BiRRT, ends: Pair, ask_all: bool) -> Row:
    """One query, still without its number."""
    constraint = birrt.manifold.constraint
    answer, time_ms = _timed(planner, *ends, constraint)
    solved = answer.status == "solved"
    theirs = birrt.ask(*ends) if ask_all or not solved else Found("", np.nan, np.nan)
    longer = np.nan
    if ask_all and solved:
        longer = planner.plan(*ends, constraint, budget_s=LONGER_S).length_rad
    best = _least(answer.length_rad, longer, theirs.length_rad)
    ours = 0, answer.status, answer.length_rad, time_ms, best, answer.source
    return Row(*ours, *_of(theirs))


def to_poses(planner: Planner, queries: Sequence[Query]) -> list[Row]:
    """To the tool pose of each query's goal, beside every branch of its inverse kinematics as a
    goal of its own.
    """
    rows = []
    _warm(planner, queries)
    for query in queries:
        name, pose = query.constraint, tool_pose(planner, query.goal)
        answer, time_ms = _timed(planner, query.start, pose, name)
        best = answer.length_rad
        for branch in planner.ik(pose):
            # no path is shorter than the straight line
            if not np.linalg.norm(branch - query.start) >= best:
                best = _least(best, planner.plan(query.start, branch, name).length_rad)
        given = planner.plan(query.start, query.goal, name)
        ours = query.number, answer.status, answer.length_rad, time_ms, best, answer.source
        rows.append(Row(*ours, given_status=given.status, given_length_rad=given.length_rad))
    return rows


def to_free_yaw(planner: Planner, queries: Sequence[Query]) -> list[Row]:
    """To the tool pose of each query's goal with any yaw, beside a grid of yaws."""
    turns = [rotation_from_rpy(np.array([0.0, 0.0, yaw])) for yaw in _grid(YAWS)]
    rows = []
    _warm(planner, queries)
    for query in queries:
        name, pose = query.constraint, tool_pose(planner, query.goal)
        answer, time_ms = _timed(planner, query.start, GoalRegion(pose, free=("yaw",)), name)
        turned = (Pose(pose.position, turn @ pose.rotation) for turn in turns)
        lengths = [planner.plan(query.start, other, name).length_rad for other in turned]
        best = _least(answer.length_rad, *lengths)
        ours = query.number, answer.status, answer.length_rad, time_ms, best, answer.source
        rows.append(Row(*ours))
    return rows


def to_redundant_poses(planner: Planner, count: int, seed: int) -> list[Row]:
    """To tool poses of an arm with more than six joints, beside configurations spread over each
    pose's family as a list of goals.
    """
    free, robot, rows = Constraint(AXES["free"]), planner.robot, []
    planner.prepare(free)
    with birrt_beside(planner, free) as birrt:
        pairs = drawn_pairs(birrt, count, seed)
        planner.plan(pairs[-1][0], tool_pose(planner, pairs[-1][1]), free)
        for query, (start, other) in enumerate(pairs):
            pose = tool_pose(planner, other)
            answer, time_ms = _timed(planner, start, pose, free)
            found = solutions(robot, pose.position, pose.rotation, Search(seeds=SEEDS))
            clear = found[birrt.certifier.collisions.free(found)]
            family = spread(np.concatenate([other[None], clear]), REPRESENTATIVES)
            listed = planner.plan(start, family, free).length_rad
            theirs = Found("", np.nan, np.nan)
            if np.isnan(_least(answer.length_rad, listed)):
                away = np.linalg.norm(family - start, axis=1)
                for goal in family[np.argsort(away)[:NEAREST]]:
                    theirs = birrt.ask(start, goal)
                    if theirs.status == "solved":
                        break
            best = _least(answer.length_rad, listed, theirs.length_rad)
            ours = query, answer.status, answer.length_rad, time_ms, best, answer.source
            rows.append(Row(*ours, *_of(theirs)))
    return rows


def _timed(
    planner: Planner, start: Float[np.ndarray, "D"], goal: object, constraint: str | Constraint
) -> tuple[Trajectory, float]:
    """The first certified path, and the milliseconds that it took."""
    began = time.perf_counter()
    answer = planner.plan(start, goal, constraint)  # type: ignore[arg-type]
    return answer, 1e3 * (time.perf_counter() - began)


def _warm(planner: Planner, queries: Sequence[Query]) -> None:
    """Load the compiled code, so that the first query does not wait for it."""
    last = queries[-1]
    planner.plan(last.start, tool_pose(planner, last.goal), last.constraint)


def _of(found: Found) -> tuple[str, float, float]:
    return found.status, found.length_rad, found.time_ms


def _least(*lengths: float) -> float:
    """Of those that there are; nan of none."""
    return min((length for length in lengths if not np.isnan(length)), default=np.nan)


def _grid(count: int) -> Float[np.ndarray, "n"]:
    return np.linspace(-np.pi, np.pi, count, endpoint=False)
