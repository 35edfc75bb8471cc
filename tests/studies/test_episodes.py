"""Episodes of a moving arm among unknown obstacles, on the real planner; and the study's figures on
known rows.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import pandas as pd
import pytest
from tests.planner_fixtures import packaged_planner

from constraint_geodesics import bundle
from constraint_geodesics.planner import PlannerError
from constraint_geodesics.report.episodes_page import episodes_markdown
from constraint_geodesics.scene.shape import Shape
from constraint_geodesics.studies import episode_runs as runs
from constraint_geodesics.studies import episodes as study
from constraint_geodesics.studies.episodes import Answered, Episode, Moved, Replanner, Report, Seen
from constraint_geodesics.trajectory import Trajectory

CUP = "level_cup"


@dataclass(frozen=True)
class Blind:
    """Goes on whatever it sees, after some seconds of thought."""

    thinks_s: float = 0.0

    def see(self, obstacles: Sequence[Shape]) -> None:
        """It does not look."""

    def moving(self, path: Trajectory, at_s: float) -> Trajectory | None:
        time.sleep(self.thinks_s)
        return None

    def resting(self, path: Trajectory) -> Trajectory:
        return path.stop(float(path.times[-1]))


@dataclass(frozen=True)
class Stopping(Blind):
    """Stops whenever it sees something, and never gets on."""

    def moving(self, path: Trajectory, at_s: float) -> Trajectory | None:
        return study.stop_on(path, at_s)

    def resting(self, path: Trajectory) -> Trajectory:
        time.sleep(self.thinks_s)
        return path.stop(float(path.times[-1]))


@cache
def episodes(count: int) -> tuple[Episode, ...]:
    planner = packaged_planner()
    with study.carrying(planner, CUP):
        return tuple(study.drawn(planner, CUP, k, 0) for k in range(count))


@cache
def answered(count: int) -> tuple[Report, ...]:
    planner, found = packaged_planner(), []
    for episode in episodes(count):
        with study.carrying(planner, CUP):
            happenings = list(study.run(episode, Replanner(planner)))
        found.append(study.report(episode, happenings))
    return tuple(found)


def test_no_contact_where_the_arm_could_have_stopped() -> None:
    before = packaged_planner().scene.now
    reports = answered(5)
    assert packaged_planner().scene.now == before
    assert any(report.beyond for report in reports)
    for report in reports:
        assert report.contact is None or not report.beyond
        assert (report.outcome == "contact") == (report.contact is not None)


def test_every_motion_begins_where_the_arm_is_and_as_fast() -> None:
    changed = 0
    for report in answered(5):
        for before, leg in zip(report.legs, report.legs[1:], strict=False):
            at_s = min(leg.begins_s - before.begins_s, float(before.path.times[-1]))
            state, begin = before.path.state(at_s), leg.path.state(0.0)
            np.testing.assert_array_equal(begin.configuration, state.configuration)
            np.testing.assert_array_equal(begin.velocity, state.velocity)
            changed += 1
    assert changed > 0


def test_an_obstacle_is_seen_within_the_radius_and_answered_after_the_latency() -> None:
    seen = moving = 0
    for episode, report in zip(episodes(5), answered(5), strict=True):
        assert all(0.0 < one.distance_m <= episode.sensing_m for one in report.seen)
        seen += len(report.seen)
        for answer in report.answers:
            if answer.moving:
                assert answer.begins_s == pytest.approx(answer.asked_s + study.LATENCY_S)
                assert answer.late == (answer.spent_s > study.LATENCY_S)
                moving += 1
    assert seen > 0
    assert moving > 0


def test_an_arm_that_goes_on_touches_what_is_on_its_path() -> None:
    episode = episodes(1)[0]
    happenings = list(study.run(episode, Blind()))
    report = study.report(episode, happenings)
    assert report.outcome == "contact"
    assert report.contact is not None
    assert report.contact.joint_speed_rad_s > 0.0
    assert report.contact.tool_speed_m_s > 0.0
    q = report.state(report.contact.at_s).configuration
    with episode.everything.world() as world:
        assert not world.is_free(q)
    times = [one.at_s for one in happenings if isinstance(one, Moved)]
    np.testing.assert_allclose(np.diff(times), study.TICK_S)


def test_an_arm_whose_answer_is_late_stops() -> None:
    happenings = list(study.run(episodes(1)[0], Blind(thinks_s=1.1 * study.LATENCY_S)))
    first = next(one for one in happenings if isinstance(one, Answered))
    assert first.late
    assert first.path is not None
    assert first.path.status == "stopped"
    assert first.words.startswith("stops, as the answer came in")
    sights = [one for one in happenings if isinstance(one, Seen)]
    assert sights[0].at_s == first.asked_s


def test_nothing_is_looked_at_until_a_late_answer_is_there() -> None:
    happenings = list(study.run(episodes(1)[0], Blind(thinks_s=5.0 * study.LATENCY_S)))
    answers = [k for k, one in enumerate(happenings) if isinstance(one, Answered)]
    answer, after = happenings[answers[0]], happenings[answers[0] + 1 : answers[1]]
    assert isinstance(answer, Answered)
    busy_s = answer.asked_s + answer.spent_s
    times = [one.at_s for one in after if isinstance(one, Moved)]
    assert times[0] == answer.begins_s < busy_s - study.TICK_S
    np.testing.assert_allclose(np.diff(times), study.TICK_S)
    for one in after:
        assert isinstance(one, Moved) or one.at_s >= busy_s


def test_an_arm_that_stops_plans_while_it_brakes_and_brakes_where_it_touches_something() -> None:
    thinks_s, contacts, rests = 0.03, 0, 0
    for episode in episodes(13)[::3]:
        happenings = list(study.run(episode, Stopping(thinks_s)))
        report = study.report(episode, happenings)
        row = runs.run_row(episode, report)
        assert row["braking_at_contact"] == (report.contact is not None)
        contacts += report.contact is not None
        answers = [one for one in happenings if isinstance(one, Answered)]
        resting = [one for one in answers if not one.moving]
        if report.contact is None and len(resting) == study.TRIES:
            first, second = resting[:2]
            assert first.spent_s > thinks_s
            assert first.begins_s == first.asked_s  # it has braked for longer
            assert second.begins_s >= first.begins_s + thinks_s
            rests += 1
    assert contacts > 0
    assert rests > 0


def test_a_constraint_without_queries_is_refused() -> None:
    with pytest.raises(PlannerError, match="no constraint 'level'"):
        study.drawn(packaged_planner(), "level", 0, 0)


def test_both_controllers_get_an_episode_and_rows_are_kept(tmp_path) -> None:
    task = runs.Task(bundle.PACKAGED, CUP, 1, 0, "code", tmp_path / "rows")
    row = runs.kept(task)
    assert runs.opened(bundle.PACKAGED).scene.now.attached == ()
    assert [own["controller"] for own in row["runs"]] == [runs.REPLAN, runs.SCRATCH]
    assert set(row["motions"]) == {runs.REPLAN, runs.SCRATCH}
    assert all(own["seen"] for own in row["runs"])
    written = task.file.stat().st_mtime_ns
    assert json.dumps(runs.kept(task)) == json.dumps(row)
    assert task.file.stat().st_mtime_ns == written
    task.file.write_text(json.dumps(row | {"code": "older"}))
    assert runs.kept(task)["code"] == "code"


def rows_of(outcomes: dict[tuple[int, str], tuple[bool, str]]) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "constraint": "free",
            "episode": number,
            "controller": controller,
            "solved": outcome == "reached",
            "sensing_m": 0.2,
            "beyond": beyond,
            "outcome": outcome,
            "duration_s": 2.0 + number,
            "joint_speed_rad_s": 1.5 if outcome == "contact" else np.nan,
            "braking_at_contact": outcome == "contact",
            "tool_speed_m_s": 0.5 if outcome == "contact" else np.nan,
        }
        for (number, controller), (beyond, outcome) in outcomes.items()
    )


def test_figures_are_of_the_solvable_and_the_page_has_them() -> None:
    table = rows_of(
        {
            (0, "a"): (True, "reached"),
            (0, "b"): (True, "reached"),
            (1, "a"): (False, "contact"),
            (1, "b"): (True, "reached"),
            (2, "a"): (True, "no path"),
            (2, "b"): (True, "no path"),
            (3, "a"): (True, "no path"),
            (3, "b"): (True, "reached"),
        }
    )
    answers = pd.DataFrame(
        {
            "constraint": "free",
            "episode": [0, 1, 3, 0],
            "controller": ["a", "a", "a", "b"],
            "ms": [10.0, 500.0, 70.0, 5.0],
            "moving": True,
            "late": [False, True, True, False],
            "can_stop": [True, False, True, True],
            "blocked": True,
            "waited_s": [0.06, np.nan, np.nan, 1.0],
        }
    )
    found = runs.figures(table, answers)
    first = found["a"]["all"]
    assert (first["episodes"], first["unsolvable"]) == (4, 1)
    assert first["beyond"] == {"episodes": 3, "contacts": 0, "solvable": 2, "reached": 1}
    assert first["inside"]["without_contact"] == 0
    assert (first["reached"], first["contacts"]) == (1, 1)
    assert first["inside"]["braking_at_contact"] == 1
    assert (first["inside"]["answers"], first["inside"]["late"]) == (1, 1)
    assert first["answers"]["never_on"] == 1
    assert first["inside"]["tool_speed_m_s_median"] == 0.5
    assert first["answers"]["moving"] == 2
    assert first["answers"]["late"] == 1
    assert first["both_reach"] == {"episodes": 1, "duration_s_median": 2.0, "duration_s_p95": 2.0}
    assert found["a"]["free"] == found["a"]["0.2 m"] == first
    page = episodes_markdown(found, {"processor": "a processor"})
    assert "Rows, one thread of a processor." in page
    (line,) = [own for own in page.splitlines() if own.startswith("| all") and "1 of 2" in own]
    assert "50%" in line
    assert "0.2" in page.split("## By the sensing radius")[1]
