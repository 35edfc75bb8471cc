"""How a query is answered once its ends are known: curves to every configuration of the goal, the
shortest of which is timed and certified, or why there is none.
"""

import heapq
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float

from constraint_geodesics.certification.certifier import Certificate, Certifier
from constraint_geodesics.constraints.both import both
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold
from constraint_geodesics.geometry.braking import Pace, going_on, shortest_stop
from constraint_geodesics.geometry.errors import GeometryError
from constraint_geodesics.goals.goal import Goal
from constraint_geodesics.methods import Method
from constraint_geodesics.problem import PlannerError, Status
from constraint_geodesics.robot.inverse_kinematics import spread
from constraint_geodesics.search.candidates import BENDS, Answer, Candidate, connection, rows_of
from constraint_geodesics.search.explanations import not_connected, refused_end
from constraint_geodesics.search.preparation import Query
from constraint_geodesics.search.pursuit import Pursued, shortest, slid
from constraint_geodesics.search.run_out import refused_velocity, rows_from, run_out, run_outs
from constraint_geodesics.trajectory import STANDING_S, TOUCHES, Asked, Statistics, Trajectory, Way

COINCIDENT_RAD = 1e-7
"""Ends that differ by less in every joint are one configuration."""
_WORTHWHILE = 1e-4
"""Share by which a curve must be shorter than the path so far to be certified."""
_ROUND = BENDS + 1
"""Curves after which the kinds that are tried come round again."""
_TIGHTENED = (1.0, 0.7, 0.4)
"""Shares of the allowed violation that a path's waypoints are drawn for, should the certificate ask
for closer ones.
"""
TIMES = "times"
"""What is refused where a motion can't go on along its waypoints."""
TURNING = "on its lines (it may leave it by 1e-3 while it turns into the first)"
"""Where the bound of a motion that begins with a velocity holds."""
_CLOSER = ("constraint_between_rows", "step")
"""What a certificate finds where waypoints lie too far apart."""
_CONTINUED = 0.9
"""The same for a path that is begun from a velocity: where it begins it may be off already."""
_MEMBERS, _NEAREST, _SPREAD = 512, 8, 24
"""Of further configurations of a goal, the nearest: how many are looked at for collisions, of the
free ones how many have curves led to them as the nearest, and how many of the others.
"""
_IMPROVED = 3
"""Configurations of a goal beside the one that was reached, the nearest, to which shorter paths are
looked for.
"""
Item = TypeVar("Item")


class _Further(NamedTuple):
    """What more configurations a goal has, its region and the room that an end has in it."""

    configurations: Iterator[Float[np.ndarray, "D"] | None]
    region: Constraint | None
    room: ConstraintManifold | None


class End(NamedTuple):
    """Where a path must end: at a configuration, or in a region, or anywhere."""

    goal: Float[np.ndarray, "D"] | None = None
    region: Constraint | None = None


class Refused(NamedTuple):
    """Why waypoints are no path: the kind of it, a line, and the certificate if there is one."""

    kind: str
    why: str
    certificate: Certificate | None = None


@dataclass(frozen=True)
class Answering:
    """Whom the curves come from, and who certifies them."""

    method: Method
    certifier: Certifier

    def answer(self, query: Query, goals: Sequence[Goal], budget_s: float | None) -> Trajectory:
        """The path of a query to the nearest of some goals, or why there is none."""
        refused = refused_end(query, "start", self.certifier.collisions)
        refused = refused or refused_velocity(query, self.pace(query))
        if refused is not None:
            return self.nothing(query, *refused)
        if query.start_velocity is None:
            return self.found(query, goals, budget_s)
        return self._from_velocity(query, goals, budget_s)

    def _from_velocity(
        self, query: Query, goals: Sequence[Goal], budget_s: float | None
    ) -> Trajectory:
        """A path that begins in the direction of the query's velocity; where none of the straight
        line and the graph can, a stop straight on and a path from there.  Trees come last, and are
        grown from one place alone: from where the arm stops, if it can.
        """
        few = replace(query, parts=replace(query.parts, tree=False))
        found = self.found(few, goals, budget_s)
        if found.status == "solved":
            return found
        tail = self._stop_straight_on(query)
        for own in (few, query) if query.parts.tree else (few,):
            if tail is not None:
                found = self._joined(own, tail, goals, budget_s) or found
            elif own.parts.tree:
                found = self.found(query, goals, budget_s)
            if found.status == "solved":
                break
        return found

    def _stop_straight_on(self, query: Query) -> Float[np.ndarray, "n D"] | None:
        """Waypoints of a stop straight on along the query's velocity; None where that touches
        something or leaves the constraint.
        """
        assert query.start_velocity is not None
        pace, velocity = self.pace(query), query.start_velocity
        straight = run_out(query.task.open, query.start, velocity, pace)
        if straight is None:
            return None
        allowed = _CONTINUED * self.certifier.limits.violation_tolerance
        rows = rows_from(straight, query.start, velocity, pace, allowed)
        stop = shortest_stop(rows, velocity, pace)
        if stop is None or not self.certifier.collisions.is_clear(stop.joints):
            return None
        return stop.joints

    def _joined(
        self,
        query: Query,
        tail: Float[np.ndarray, "n D"],
        goals: Sequence[Goal],
        budget_s: float | None = None,
    ) -> Trajectory | None:
        """The waypoints of a stop from the query's velocity and a path from their end to a goal, as
        one trajectory; None where that is not certified.
        """
        resting = replace(query, start=tail[-1], start_velocity=None)
        onward, region = self._reached(resting, goals, budget_s)
        if onward.status != "solved":
            return None
        whole, looked_at = going_on(tail, onward.joints), onward.statistics.looked_at
        query = replace(query, regions=onward.asked.regions, looked_at=looked_at)
        found = self.judged(query, whole, onward.source, End(onward.joints[-1], region))
        return found if isinstance(found, Trajectory) else None

    def found(self, query: Query, goals: Sequence[Goal], budget_s: float | None) -> Trajectory:
        """The path to the nearest of some goals, or why there is none; the start is a sound one."""
        return self._reached(query, goals, budget_s)[0]

    def _reached(
        self, query: Query, goals: Sequence[Goal], budget_s: float | None
    ) -> tuple[Trajectory, Constraint | None]:
        """The same, and the region of the goal that is reached, if it has one."""
        pursued, rest = self._pursued(query, goals)
        if not pursued:
            wanted = " or ".join(one.description for one in goals)
            line = f"no configuration was found for {wanted}"
            return self.nothing(query, "not_found", line), None
        regions = tuple(goal.region for goal in goals if goal.region is not None)
        query = replace(query, regions=regions)
        if pursued[0].distance <= COINCIDENT_RAD and query.start_velocity is None:
            own, region = replace(query, goal=pursued[0].goal), pursued[0].region
            if refused_end(own, "goal", self.certifier.collisions) is None:
                return self.standing(own, region), region

        def certify(one: Pursued, candidate: Candidate) -> tuple[Trajectory, float] | str:
            found = self._certified(query, candidate, one)
            return found if isinstance(found, str) else (found, found.length_rad)

        def more() -> list[Pursued]:
            further = self._more(query, rest)
            pursued.extend(further)
            return further

        def is_connected(one: Pursued) -> bool:
            return connection(query.task, query.start, one.goal).status != "not_connected"

        found = shortest(pursued, query.task, certify, more, is_connected)
        query = replace(query, looked_at=np.array([one.goal for one in pursued]))
        how = "the shortest found to any"
        if found is None and budget_s is not None:
            left = (one for one in pursued if _is_open(query, one, is_connected))
            near = heapq.nsmallest(1 + _IMPROVED, left, key=lambda one: one.distance)
            found, how = self._searched_on(query, near, budget_s), "found to one"
        if found is None:
            return self._failed(query, pursued), None
        path, reached = found
        if budget_s is not None:
            others = [one for one in pursued if one is not reached and one.answer is None]
            worth = [reached, *others[:_IMPROVED]]
            path, reached = self._improved(query, path, worth, budget_s)
        line = path.explanation
        if len(pursued) > 1:
            line += f", {how} of {len(pursued)} configurations"
        if query.snapped_rad:
            line += f", from a start moved by {query.snapped_rad:.2g} rad"
        statistics = self._statistics(query, path.source)
        statistics = replace(statistics, ways=path.statistics.ways)
        return replace(path, explanation=line, statistics=statistics), reached.region

    def _pursued(self, query: Query, goals: Iterable[Goal]) -> tuple[list[Pursued], list[_Further]]:
        """The goals' configurations, the nearest first, and what more there are."""
        manifold = query.task.manifold
        found, rest = list[Pursued](), list[_Further]()
        for goal in goals:
            room = None
            if goal.region is not None:
                if not goal.region.is_placed:
                    raise PlannerError(f"goal: the region of {goal.description} has no reference")
                room = ConstraintManifold(manifold.robot, both(goal.region, manifold.constraint))
                if room.codim >= manifold.robot.dof:
                    room = None
            configurations = iter(goal.configurations(manifold, query.start))
            for q in configurations:
                if q is None:
                    rest.append(_Further(configurations, goal.region, room))
                    break
                found.append(self._one(query, q, goal.region, room))
        return sorted(found, key=lambda one: one.distance), rest

    def _one(
        self,
        query: Query,
        q: Float[np.ndarray, "D"],
        region: Constraint | None,
        room: ConstraintManifold | None,
    ) -> Pursued:
        away = float(np.linalg.norm(q - query.start))
        return Pursued(q, away, self._curves(query, q), region, room)

    def _more(self, query: Query, rest: Sequence[_Further]) -> list[Pursued]:
        """Of what more configurations there are the nearest free ones, and some that are spread
        over all.
        """
        found = list[Pursued]()
        for configurations, region, room in rest:
            members = np.array([q for q in configurations if q is not None])
            members = members.reshape(-1, len(query.start))
            members = members[np.argsort(np.linalg.norm(members - query.start, axis=1))][:_MEMBERS]
            free = members[self.certifier.collisions.free(members)]
            others = spread(free[_NEAREST:], _SPREAD)
            for q in (*free[:_NEAREST], *others):
                found.append(self._one(query, q, region, room))
        return sorted(found, key=lambda one: one.distance)

    def _curves(
        self, query: Query, goal: Float[np.ndarray, "D"]
    ) -> Iterator[Candidate | Answer | None]:
        """The method's, unless the goal is refused."""
        query = replace(query, goal=goal)
        refused = refused_end(query, "goal", self.certifier.collisions)
        if refused is not None:
            status, line = refused
            yield Answer(status, explanation=line)
            return
        yield from self.method.candidates(query.task, query.start, goal, query.parts)

    def _failed(self, query: Query, pursued: Sequence[Pursued]) -> Trajectory:
        """Why there is no path to any goal: what is said of the nearest one that could end one, and
        how many of the others ended how.
        """
        answers = [(one, one.answer or Answer("not_found")) for one in pursued]
        one, end = next((own for own in answers if not own[1].explanation), answers[0])
        query = replace(query, goal=one.goal)
        line = end.explanation
        if end.status == "not_connected":
            line = not_connected(query, end, self.certifier.collisions)
        elif not line:
            line = f"no curve tried is a path under {query.name}{one.failed}"
        if len(pursued) > 1:
            ends = Counter(
                "too far for trees" if one.answer is None else one.answer.status for one in pursued
            )
            told = ", ".join(f"{count} {status}" for status, count in ends.most_common())
            line += f"; of {len(pursued)} configurations of the goal: {told}"
        return self.nothing(query, end.status, line)

    def _improved(
        self, query: Query, path: Trajectory, pursued: Sequence[Pursued], budget_s: float
    ) -> tuple[Trajectory, Pursued]:
        """The shortest certified path that is found before the time is over, and where it leads:
        `path`, to the first of those that are pursued, if it remains that.
        """
        first, reached = path, pursued[0]
        worth = [one for one in pursued if one.distance < path.length_rad]
        worth = worth or [reached]
        curves = _by_turns([self._improvements(query, one) for one in worth])
        for one, candidate in _in_time(curves, query.began, budget_s, _ROUND * len(worth)):
            if candidate is not None and candidate.length < (1.0 - _WORTHWHILE) * path.length_rad:
                found = self._certified(query, candidate, one)
                if isinstance(found, Trajectory) and found.length_rad < path.length_rad:
                    path, reached = found, one
        if path is not first:
            known = Way(first.source, first.length_rad, first.joints), *first.statistics.ways
            path = _with_ways(path, known, "shorter than what was found first ({} rad)")
        return path, reached

    def _improvements(
        self, query: Query, one: Pursued
    ) -> Iterator[tuple[Pursued, Candidate | None]]:
        if refused_end(replace(query, goal=one.goal), "goal", self.certifier.collisions):
            return
        for found in self.method.improvements(query.task, query.start, one.goal, query.parts):
            if found is not None and one.room is not None:
                found = slid(query.task, found, one.room)
            yield one, found

    def _searched_on(
        self, query: Query, pursued: Sequence[Pursued], budget_s: float
    ) -> tuple[Trajectory, Pursued] | None:
        """The first path that is certified where none was found at once, and where it leads; None
        where the time is over before.
        """
        tries = _by_turns([self._tries(query, one) for one in pursued])
        for one, curves in _in_time(tries, query.began, budget_s, 2 * len(pursued)):
            for candidate in curves:
                if one.room is not None:
                    candidate = slid(query.task, candidate, one.room)
                found = self._certified(query, candidate, one)
                if isinstance(found, Trajectory):
                    return found, one
                one.failed = f"; the {candidate.source} curve fails: {found}"
            one.answer = Answer("not_found")
        return None

    def _tries(self, query: Query, one: Pursued) -> Iterator[tuple[Pursued, Iterator[Candidate]]]:
        if refused_end(replace(query, goal=one.goal), "goal", self.certifier.collisions):
            return
        for curves in self.method.further(query.task, query.start, one.goal, query.parts):
            yield one, curves

    def _certified(self, query: Query, candidate: Candidate, one: Pursued) -> Trajectory | str:
        """The candidate as a trajectory if it is certified, otherwise why it is not: its end is the
        configuration that was asked for, or any in the region.
        """
        return self.begun(query, candidate, End(one.goal if one.room is None else None, one.region))

    def begun(self, query: Query, candidate: Candidate, end: "End") -> Trajectory | str:
        """The candidate as a trajectory if it is certified, otherwise why it is not."""
        if query.start_velocity is not None:
            return self._continued(query, candidate, end)
        for share in _TIGHTENED:
            joints = rows_of(candidate, share * self.certifier.limits.violation_tolerance)
            found = self.judged(query, joints, candidate.source, end)
            if not (isinstance(found, Refused) and found.kind in _CLOSER):
                break
        if isinstance(found, Refused):
            return found.why
        others = tuple(Way(one.source, one.length, one.points) for one in candidate.others)
        what = f"the shortest certified of {len(others) + 1} ways round (others: {{}} rad)"
        return _with_ways(found, others, what) if others else found

    def _continued(self, query: Query, candidate: Candidate, end: "End") -> Trajectory | str:
        """The candidate, begun from the query's velocity: the first beginning that is certified."""
        assert query.start_velocity is not None
        pace, velocity = self.pace(query), query.start_velocity
        allowed = _CONTINUED * self.certifier.limits.violation_tolerance
        why = "no beginning goes on from the start's velocity"
        for own in run_outs(query.task.open, candidate, velocity, pace):
            joints = rows_from(own, query.start, velocity, pace, allowed)
            found = self.judged(query, joints, candidate.source, end)
            if isinstance(found, Trajectory):
                return found
            why = found.why if found.kind != TIMES else why
        return why

    def pace(self, query: Query) -> Pace:
        """The limits that a query's motion uses."""
        robot, limits = self.certifier.scene.robot, self.certifier.limits
        assert limits.acceleration_rad_s2 is not None
        velocity = robot.velocity * query.scales[0]
        return Pace(velocity, np.array(limits.acceleration_rad_s2) * query.scales[1])

    def judged(
        self,
        query: Query,
        joints: Float[np.ndarray, "T D"],
        source: str,
        end: "End",
        times: Float[np.ndarray, "T"] | None = None,
    ) -> "Trajectory | Refused":
        """Waypoints as a trajectory if they are certified, otherwise why they are not.  times: that
        they have already.
        """
        constraint, velocity = query.task.manifold.constraint, query.start_velocity
        if times is None:
            try:
                times = self.pace(query).times(joints, velocity)
            except GeometryError as error:
                return Refused(TIMES, str(error))
        certificate = self.certifier.certify(
            joints,
            constraint,
            query.start,
            end.goal,
            times,
            region=end.region,
            start_velocity=velocity,
            scales=query.scales,
        )
        if certificate.violation is not None:
            return Refused(certificate.violation.kind, certificate.violation.message, certificate)
        line = (
            f"{certificate.length_rad:.3f} rad, motion {times[-1]:.2f} s, from the {source} "
            f"proposal, at most {certificate.violation_bound:.1e} (rad, m) off {query.name}"
        )
        if constraint.caveat:
            line += f", {constraint.caveat}"
        if certificate.start_velocity is not None:
            line += f" {TURNING}"
        about = self.asked(query), self._statistics(query, source)
        return Trajectory("solved", joints, times, line, *about, certificate, velocity)

    def standing(self, query: Query, region: Constraint | None = None) -> Trajectory:
        """The path between ends that only rounding tells apart."""
        joints, times = np.stack([query.start, query.goal]), np.array([0.0, STANDING_S])
        if np.linalg.norm(query.goal - query.start) > 0.0:
            times = np.maximum(times, self.pace(query).times(joints, None))
        constraint = query.task.manifold.constraint
        certificate = self.certifier.certify(
            joints, constraint, query.start, query.goal, times, region=region, scales=query.scales
        )
        line = "the start is the goal"
        if certificate.violation is not None:
            line = f"{line}, and no path: {certificate.violation.message}"
            touched = certificate.violation.kind in TOUCHES
            return self.nothing(query, "in_collision" if touched else "not_found", line)
        about = self.asked(query), self._statistics(query, "straight")
        return Trajectory("solved", joints, times, line, *about, certificate)

    def nothing(self, query: Query, status: Status, explanation: str) -> Trajectory:
        """That there is no path, and why."""
        empty, about = np.empty((0, len(query.start))), self.asked(query)
        statistics = self._statistics(query, "")
        return Trajectory(status, empty, np.empty(0), explanation, about, statistics)

    def asked(self, query: Query) -> Asked:
        """What a query was asked under."""
        constraint, scene = query.task.manifold.constraint, self.certifier.scene
        return Asked(constraint, query.name, scene, self.pace(query), query.regions, query.scales)

    def _statistics(self, query: Query, source: str) -> Statistics:
        spent = time.perf_counter() - query.began
        return Statistics(spent, self.method.name, source, query.snapped_rad, query.looked_at)


def _with_ways(path: Trajectory, ways: tuple[Way, ...], what: str) -> Trajectory:
    """The path with other ways.  what: is said of them, with a place for their lengths."""
    told = ", ".join(f"{way.source} {way.length_rad:.3f}" for way in ways)
    line = f"{path.explanation}, {what.format(told)}"
    return replace(path, explanation=line, statistics=replace(path.statistics, ways=ways))


def _is_open(query: Query, one: Pursued, is_connected: Callable[[Pursued], bool]) -> bool:
    """Whether further tries may find a path to a configuration to which none was found: it is not
    refused, and the graph does not hold it to be apart.
    """
    if one.answer is not None:
        return one.answer.is_open
    return not query.parts.graph or is_connected(one)


def _in_time(items: Iterator[Item], began: float, budget_s: float, kinds: int) -> Iterator[Item]:
    """Items until the time is over: none is begun that would end too late, going by the last of its
    kind, and for the first ones by the longest.  kinds: items after which they come round again.
    """
    spent = time.perf_counter() - began
    lasted = deque[float](maxlen=max(kinds, 1))
    while (
        spent + (lasted[0] if len(lasted) == lasted.maxlen else max(lasted, default=0.0)) < budget_s
    ):
        try:
            item = next(items)
        except StopIteration:
            return
        yield item
        before, spent = spent, time.perf_counter() - began
        lasted.append(spent - before)


def _by_turns(several: Sequence[Iterator[Item]]) -> Iterator[Item]:
    """One of each, again and again, until all are at their end."""
    waiting = deque(several)
    while waiting:
        own = waiting.popleft()
        for item in own:
            yield item
            waiting.append(own)
            break
