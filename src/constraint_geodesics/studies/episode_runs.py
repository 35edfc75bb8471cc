"""Episodes among unknown obstacles, many of them, with `replan` and beside planning from scratch
with BiRRT; and what they show.
"""

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from constraint_geodesics.benchmark.judge import problem_of
from constraint_geodesics.bundle import read_bundle
from constraint_geodesics.certification.certifier import Certifier, Limits
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.geometry.braking import ahead
from constraint_geodesics.learning.dataset import draw_queries
from constraint_geodesics.peers.birrt import BirrtSettings
from constraint_geodesics.peers.making import until_sound
from constraint_geodesics.peers.wrappers import BandAfter
from constraint_geodesics.planner import Planner, limits_of
from constraint_geodesics.problem import PathPlanner
from constraint_geodesics.scene.clearance import Clearances
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.shape import Shape
from constraint_geodesics.studies import episodes as study
from constraint_geodesics.studies.episodes import Answered, Controller, Episode, Replanner, Report
from constraint_geodesics.studies.problem_runs import quantiles
from constraint_geodesics.text_files import kept_json, write_text
from constraint_geodesics.trajectory import Statistics, Trajectory

REPLAN, SCRATCH = "replan", "BiRRT + band from scratch"
"""The controllers."""
SOUND_S = 5.0
"""BiRRT is asked again for so long until its path is certified."""
ENDS = 200
"""Pairs of ends that a constraint's episodes are drawn from."""


@dataclass(frozen=True)
class Task:
    """One episode for a worker.  code: a digest of what its rows hang on; rows: their folder."""

    planner: Path
    constraint: str
    number: int
    seed: int
    code: str
    rows: Path

    @property
    def file(self) -> Path:
        """Where its rows are kept."""
        return self.rows / f"{self.constraint}-{self.number}.json"


class FromScratch(AbstractContextManager["FromScratch"]):
    """The classical answer: where the rest of the path touches what was seen the arm stops on it,
    and BiRRT with a band after it plans from where it will rest, until its path is certified, from
    the second attempt on with half its steps.

    It asks compiled distances, what is left of a path is looked at by the planner's own proof, and
    the scene's changes are as incremental as the planner's; limits: what paths are certified for.
    """

    def __init__(self, scene: Scene, limits: Limits, row_spacing_rad: float, seed: int) -> None:
        from constraint_geodesics.peers.ompl import SamplingPlanner

        self.scene, self.seed, self._opened = scene, seed, ExitStack()
        self._certifier = self._opened.enter_context(Certifier(scene, limits))
        self._clearances = Clearances(scene, self._certifier.collisions.apart)

        def banded(own: BirrtSettings) -> PathPlanner:
            return BandAfter(SamplingPlanner(own.search, own, row_spacing_rad))

        self._planner = until_sound(banded, BirrtSettings(band=True).bare, SOUND_S)

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def see(self, obstacles: Sequence[Shape]) -> None:
        """Into the scene of search and proof."""
        self.scene = self.scene.adding(*obstacles)
        self._certifier.change(self.scene)
        self._clearances.change(self.scene)

    def moving(self, path: Trajectory, at_s: float) -> Trajectory | None:
        """On along the path where it is clear, else the stop on it."""
        rest = ahead(path.joints, path.state(at_s))
        if len(rest) < 2 or self._certifier.collisions.is_clear(rest):
            return None
        return study.stop_on(path, at_s)

    def resting(self, path: Trajectory) -> Trajectory:
        """A path of BiRRT's, timed within the limits of the first one."""
        began, manifold = time.perf_counter(), ConstraintManifold(self.scene.robot, path.constraint)
        clearance = self._clearances.model(self._certifier.collisions.apart)
        ends = path.joints[-1], path.wanted
        problem = problem_of(*ends, manifold, self._certifier, clearance)
        self.seed += 1
        found = self._planner.plan(problem, self.seed)
        times = path.asked.pace.times(found.joints, None) if found.status == "solved" else None
        about = Statistics(time.perf_counter() - began, "birrt", "birrt")
        asked = replace(path.asked, scene=self.scene, wanted=path.wanted)
        if times is None:
            nothing = np.empty((0, self.scene.robot.dof)), np.empty(0)
            return Trajectory(found.status, *nothing, found.explanation, asked, about)
        return Trajectory("solved", found.joints, times, "by BiRRT", asked, about)


# One episode


def kept(task: Task) -> dict[str, Any]:
    """The rows of an episode: those that are kept where the code is the same, else run now, and
    kept.
    """
    before: dict[str, Any] | None = kept_json(task.file)
    if before is not None and before["code"] == task.code:
        return before
    found = {
        "code": task.code,
        **ran(opened(task.planner), task.constraint, task.number, task.seed),
    }
    write_text(task.file, json.dumps(found))
    return found


@cache
def opened(folder: Path) -> Planner:
    """One planner a process."""
    return Planner(read_bundle(folder), str(folder))


def ran(planner: Planner, constraint: str, number: int, seed: int) -> dict[str, Any]:
    """One episode with each controller: `runs`, a row each, their `answers`, and the `motions`, to
    be recorded.
    """
    found = dict[str, Any](runs=[], answers=[], motions={})
    with study.carrying(planner, constraint):
        _prepare(planner, constraint)
        episode = study.drawn(planner, constraint, number, seed, ends(planner, constraint, seed))
        start = episode.first.joints[0]
        known = planner.scene.now
        whole = planner.plan(start, episode.goal, constraint, scene=episode.obstacles)
        about = {"constraint": constraint, "episode": number}
        for name, report in _reports(planner, episode, seed):
            planner.scene.become(known)
            solved = whole.status == "solved" or report.outcome == "reached"
            row = about | {"controller": name, "solved": solved}
            found["runs"].append(row | run_row(episode, report))
            rows = answer_rows(report)
            found["answers"] += [about | {"controller": name} | one for one in rows]
            found["motions"][name] = motions(report)
    return found


@cache
def ends(planner: Planner, constraint: str, seed: int) -> Float[np.ndarray, "n D"]:
    """Free configurations, none of the roadmap's, that a constraint's episodes go between; in the
    scene as it is.
    """
    scene = planner.scene.now
    manifold = ConstraintManifold(planner.robot, planner.constraints[constraint])
    queries = draw_queries(scene, manifold, constraint, ENDS, seed)
    return np.concatenate([queries.starts, queries.goals])


@cache
def _prepare(planner: Planner, constraint: str) -> None:
    """Roadmap and compiled code, that of a replan and of BiRRT too, so that no clock pays for
    them.
    """
    nodes = planner.nodes(constraint)
    path = planner.plan(nodes[0], nodes[-1], constraint)
    if path.status == "solved":
        planner.replan(path, 0.5 * float(path.times[-1]))
        half = study.stop_on(path, 0.5 * float(path.times[-1]))
        with _from_scratch(planner, path.scene, 0) as controller:
            if half is not None:
                controller.resting(half)


def _from_scratch(planner: Planner, scene: Scene, seed: int) -> FromScratch:
    """For the planner's own promises."""
    bundle = planner.bundle
    limits = limits_of(bundle.planner, bundle.judge, planner.robot)
    return FromScratch(scene, limits, bundle.judge.row_spacing_rad, seed)


def _reports(planner: Planner, episode: Episode, seed: int) -> Iterator[tuple[str, Report]]:
    controller: Controller = Replanner(planner)
    yield REPLAN, study.report(episode, list(study.run(episode, controller)))
    with _from_scratch(planner, episode.first.scene, seed + episode.number) as controller:
        yield SCRATCH, study.report(episode, list(study.run(episode, controller)))


def run_row(episode: Episode, report: Report) -> dict[str, Any]:
    """An episode with one controller; of the contact nan where there was none, and whether the arm
    was braking or at rest then.
    """
    contact = report.contact
    braking = contact is not None and (
        report.leg(contact.at_s).path.source == "stop" or contact.joint_speed_rad_s == 0.0
    )
    return {
        "obstacles": len(episode.obstacles),
        "sensing_m": episode.sensing_m,
        "seen": len(report.seen),
        "beyond": report.beyond,
        "outcome": report.outcome,
        "braking_at_contact": braking,
        "duration_s": report.duration_s,
        "first_duration_s": float(episode.first.times[-1]),
        "joint_speed_rad_s": np.nan if contact is None else contact.joint_speed_rad_s,
        "tool_speed_m_s": np.nan if contact is None else contact.tool_speed_m_s,
    }


def answer_rows(report: Report) -> Iterator[dict[str, Any]]:
    """A row for each answer of an episode.  waited_s: of one that was asked because something new
    blocks the motion, until the arm is on a path to its goal again; nan where it never is.
    """
    for k, one in enumerate(report.answers):
        after = (other.begins_s for other in report.answers[k:] if _leads_on(other))
        blocked = one.moving and not (one.path is None or one.path.source == "rest")
        yield {
            "asked_s": one.asked_s,
            "ms": 1e3 * one.spent_s,
            "moving": one.moving,
            "late": one.late,
            "can_stop": one.can_stop,
            "status": "none" if one.path is None else one.path.status,
            "source": "" if one.path is None else one.path.source,
            "blocked": blocked,
            "waited_s": next(after, np.nan) - one.asked_s if blocked else np.nan,
        }


def _leads_on(answer: Answered) -> bool:
    return answer.path is not None and answer.path.status == "solved"


def motions(report: Report) -> dict[str, Any]:
    """What a recording takes: when obstacles were seen, the motions, and when it was over."""
    legs = [
        {
            "begins_s": leg.begins_s,
            "times": leg.path.times.tolist(),
            "joints": leg.path.joints.tolist(),
        }
        for leg in report.legs
    ]
    seen = {one.obstacle.name: one.at_s for one in report.seen}
    return {"seen": seen, "legs": legs, "over_s": report.duration_s, "outcome": report.outcome}


# All of them


def figures(runs: pd.DataFrame, answers: pd.DataFrame) -> dict[str, Any]:
    """By controller, of all episodes, of each constraint and sensing radius: what became of them,
    of those whose obstacles appear beyond the braking distance, of the others, the times of the
    answers, and the durations of episodes in which both controllers reach the goal.

    The goal counts as reached or not where the episode can be solved at all: by a plan in the scene
    of all obstacles, or by one of the controllers.  Which obstacles appear beyond the distance
    depends on the motion, so that those episodes are not the same for both.  Answers are those that
    an arm asks for which can stop; of the others, `inside` has the times.
    """
    each = ["constraint", "episode"]
    runs = runs.assign(
        solvable=runs.groupby(each).solved.transform("any"),
        both=runs.groupby(each).outcome.transform(lambda own: (own == "reached").all()),
    )
    runs = runs.assign(near=runs.sensing_m.map("{:g} m".format))
    answers = answers.merge(runs[[*each, "controller", "near"]], on=[*each, "controller"])
    found = dict[str, Any]()
    for name, own in runs.groupby("controller", sort=False):
        asked = answers[answers.controller == name]
        found[str(name)] = {"all": _of_runs(own, asked)} | {
            str(which): _of_runs(part, asked[asked[by] == which])
            for by, in_order in (("constraint", False), ("near", True))
            for which, part in own.groupby(by, sort=in_order)
        }
    return found


def _of_runs(runs: pd.DataFrame, answers: pd.DataFrame) -> dict[str, Any]:
    beyond, inside = runs[runs.beyond], runs[~runs.beyond]
    hit = inside[inside.outcome == "contact"]
    moving, both = answers[answers.moving & answers.can_stop], runs[runs.both]
    blocked, too_near = moving[moving.blocked], answers[answers.moving & ~answers.can_stop]
    return {
        "episodes": len(runs),
        "unsolvable": int((~runs.solvable).sum()),
        "reached": int((runs.outcome == "reached").sum()),
        "contacts": int((runs.outcome == "contact").sum()),
        "beyond": {
            "episodes": len(beyond),
            "contacts": int((beyond.outcome == "contact").sum()),
            "solvable": int(beyond.solvable.sum()),
            "reached": int((beyond.outcome == "reached").sum()),
        },
        "inside": {
            "episodes": len(inside),
            "without_contact": len(inside) - len(hit),
            "braking_at_contact": int(hit.braking_at_contact.sum()),
            "reached": int((inside.outcome == "reached").sum()),
            **quantiles("joint_speed_rad_s", hit.joint_speed_rad_s),
            **quantiles("tool_speed_m_s", hit.tool_speed_m_s),
            "answers": len(too_near),
            "late": int(too_near.late.sum()),
            **quantiles("answer_ms", too_near.ms),
        },
        "answers": {
            "moving": len(moving),
            "late": int(moving.late.sum()),
            **quantiles("ms", moving.ms),
            "blocked": len(blocked),
            "never_on": int(blocked.waited_s.isna().sum()),
            **quantiles("waited_s", blocked.waited_s.dropna()),
        },
        "both_reach": {"episodes": len(both), **quantiles("duration_s", both.duration_s)},
    }


def tables(kept_rows: Sequence[Mapping[str, Any]]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Runs and answers of many episodes."""
    runs, answers = (
        pd.DataFrame([row for one in kept_rows for row in one[which]])
        for which in ("runs", "answers")
    )
    return runs, answers
