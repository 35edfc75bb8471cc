"""A new path for an arm that moves, in the scene as it is now.

In order, until one is certified or the time is over: what is left of the trajectory; the same as a
band pushed clear of what is new; the planner's own search, begun from the state of the arm, and
from where it comes to rest on its path.  Where none is, the arm stops on its path, and that stop is
certified, too.  Trees are grown for an arm that rests alone: they take seconds where there is no
way.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from constraint_geodesics.answering import TIMES, Answering, End, Refused
from constraint_geodesics.geometry.braking import Motion, State, ahead, going_on
from constraint_geodesics.goals.goal import ConfigurationGoal
from constraint_geodesics.problem import PlannerError, Status
from constraint_geodesics.search.candidates import Candidate, rows_of
from constraint_geodesics.search.explanations import refused_end
from constraint_geodesics.search.preparation import Preparation, Query
from constraint_geodesics.search.repair import onward, over_graph, repaired
from constraint_geodesics.search.run_out import left_over, rows_from
from constraint_geodesics.trajectory import REDRAWN, TOUCHES, Trajectory, stopping

_TIGHTENED = (0.7, 0.4)
"""Shares of the allowed violation that waypoints after a stop are drawn for: it ends off the
constraint.
"""
_NO_MORE = "no more tries"


@dataclass(frozen=True)
class Replanning:
    """Whom curves are asked of and by whom they are certified, and the tasks of the scene."""

    answering: Answering
    preparation: Preparation

    def replan(self, trajectory: Trajectory, at_s: float, limit_s: float) -> Trajectory:
        """The rest of a trajectory from a time [s] on, in the scene as it is now; `Planner.replan`
        says more.
        """
        began = time.perf_counter()
        state = trajectory.state(at_s)
        robot = self.answering.certifier.scene.robot
        if not robot.moves_like(trajectory.scene.robot):
            raise PlannerError(f"the trajectory is of another robot than {robot.name}")
        query = self._query(trajectory, state, began, np.isfinite(limit_s))
        rest = _Rest(trajectory, state)
        collisions = self.answering.certifier.collisions
        if (end := refused_end(query, "goal", collisions)) is not None:
            return self._timed(query, self._stopped(query, self._stop(query, rest), end[1]))
        if query.start_velocity is None and np.array_equal(query.start, query.goal):
            return self._timed(query, self.answering.standing(query))
        why = "the motion can't go on along its path"
        for found in self._left(query, rest):
            if isinstance(found, Trajectory):
                return self._timed(query, found)
            why = found.why
        why = f"what is left of the motion fails: {why}"
        stop = self._stop(query, rest)
        others = self._others(query, rest, stop)
        while time.perf_counter() - began < limit_s:
            other = next(others, _NO_MORE)
            if isinstance(other, str):
                break
            if other is not None and other.status == "solved":
                return self._timed(query, other)
            if other is not None:
                why = f"{why}; no other: {other.explanation}"
        else:
            why = f"{why}; {limit_s:g} s are over"
        return self._timed(query, self._stopped(query, stop, why))

    def _query(self, trajectory: Trajectory, state: State, began: float, in_haste: bool) -> Query:
        asked, prepared = trajectory.asked, self.preparation
        return Query(
            (prepared.task_without_delay if in_haste else prepared.task)(asked.constraint),
            asked.name,
            state.configuration,
            trajectory.wanted,
            began,
            scales=asked.scales,
            regions=asked.regions,
            start_velocity=state.velocity if state.velocity.any() else None,
        )

    def _timed(self, query: Query, found: Trajectory) -> Trajectory:
        """With the time since the call, and the configuration that is wanted."""
        spent = time.perf_counter() - query.began
        about = replace(found.statistics, planning_time_s=spent)
        return replace(found, statistics=about, asked=replace(found.asked, wanted=query.goal))

    def _left(self, query: Query, rest: "_Rest") -> Iterator[Trajectory | Refused]:
        """What is left of the trajectory, on its waypoints and on others of the same curve."""
        if not np.array_equal(rest.trajectory.joints[-1], query.goal):
            return  # it stops on the way
        for joints in rest.rows(query):
            found = self.answering.judged(query, joints, "rest", End(query.goal))
            if isinstance(found, Refused) and found.kind == TIMES:
                continue
            yield found
            if isinstance(found, Refused) and found.kind in TOUCHES:
                return

    def _stop(self, query: Query, rest: "_Rest") -> Motion | None:
        """The hardest stop on the way."""
        pace, manifold = self.answering.pace(query), query.task.manifold
        found = stopping(rest.trajectory.motion, rest.state, pace, manifold)
        return None if found is None else found[0]

    def _others(
        self, query: Query, rest: "_Rest", stop: Motion | None
    ) -> Iterator[Trajectory | None]:
        """Other paths to the goal, from those that take the least time to find; None for a try that
        came to nothing.
        """
        end, moving = End(query.goal), query.start_velocity is not None
        joints = np.concatenate([query.start[None], rest.trajectory.joints[rest.state.row :]])
        if len(joints) > 1 and np.array_equal(joints[-1], query.goal):
            for candidate in repaired(query.task, joints):
                yield self._begun(query, candidate, end)
        yield self._begun(query, over_graph(query.task, query.start, query.goal), end)
        stops = stop is not None and self._is_clear(stop)
        if moving and stop is not None and stops:
            yield from self._after(query, stop)
        if not (moving and stops):  # an arm that can stop plans again when it stands
            parts = replace(query.parts, tree=query.parts.tree and not moving)
            own = replace(query, parts=parts)
            goal = ConfigurationGoal(query.goal, exactly=True)
            yield self.answering.answer(own, (goal,), None)

    def _begun(self, query: Query, candidate: Candidate | None, end: End) -> Trajectory | None:
        found = None if candidate is None else self.answering.begun(query, candidate, end)
        return found if isinstance(found, Trajectory) else None

    def _after(self, query: Query, stop: Motion) -> Iterator[Trajectory | None]:
        """The stop, and other paths from there, as one trajectory."""
        for candidate in onward(query.task, stop.joints[-1], query.goal):
            if candidate is None:
                yield None
                continue
            for share in _TIGHTENED:
                rows = rows_of(
                    candidate, share * self.answering.certifier.limits.violation_tolerance
                )
                joined = going_on(stop.joints, rows)
                found = self.answering.judged(query, joined, candidate.source, End(query.goal))
                yield found if isinstance(found, Trajectory) else None

    def _is_clear(self, stop: Motion) -> bool:
        return self.answering.certifier.collisions.is_clear(stop.joints)

    def _stopped(self, query: Query, stop: Motion | None, why: str) -> Trajectory:
        """The stop, certified, or as it is where it can't be, with what it breaks.  why: no path to
        the goal is there.
        """
        why = f"no path to the goal: {why}"
        if stop is None:
            return self.answering.nothing(query, "not_found", f"{why}; nor can it stop")
        query = query if stop.start_velocity.any() else replace(query, start_velocity=None)
        found = self.answering.judged(query, stop.joints, "stop", End(), stop.times)
        line = f"stops after {stop.times[-1]:.2f} s; {why}"
        if isinstance(found, Trajectory):
            return replace(found, status="stopped", explanation=line)
        assert found.certificate is not None
        status: Status = "in_collision" if found.kind in TOUCHES else "not_found"
        line = f"not even a stop is certified: {found.why}; {why}"
        nothing = self.answering.nothing(query, status, line)
        return replace(
            nothing,
            joints=stop.joints,
            times=stop.times,
            certificate=found.certificate,
            statistics=replace(nothing.statistics, source="stop"),
            start_velocity=query.start_velocity,
        )


@dataclass(frozen=True)
class _Rest:
    """What is left of a trajectory from a state on."""

    trajectory: Trajectory
    state: State

    def rows(self, query: Query) -> Iterator[Float[np.ndarray, "n D"]]:
        """Its waypoints, and others on the same curve."""
        rows = ahead(self.trajectory.joints, self.state)
        if len(rows) < 2:
            return
        yield rows
        curve = left_over(query.task.open, rows)
        if curve is not None:
            pace = self.trajectory.asked.pace
            yield rows_from(curve, self.state.configuration, self.state.velocity, pace, REDRAWN)
