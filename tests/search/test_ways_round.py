"""Lines bent round a sphere, and answers that name the ways that were found round it."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice, takewhile
from pathlib import Path

import numpy as np
import pytest
from tests.planner_fixtures import nodes_of, packaged_planner
from tests.recording.files import column

from constraint_geodesics import answering
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.search.band import PROJECTION, project
from constraint_geodesics.search.candidates import (
    ALMOST,
    FEW,
    Candidate,
    Task,
    _relaxed,
    along,
    candidates,
    round_it,
)
from constraint_geodesics.search.roadmap import Roadmap, nearest, points_along, shortest_way
from constraint_geodesics.search.ways_round import SIDES, bent_round
from constraint_geodesics.trajectory import Trajectory


def queries(name: str, count: int) -> list[tuple[np.ndarray, np.ndarray, Sphere, Trajectory]]:
    """Ends, a sphere that the shortest path without it runs into, and that path."""
    planner, rng = packaged_planner(), np.random.default_rng(2)
    nodes, _ = nodes_of(name)
    found = list[tuple[np.ndarray, np.ndarray, Sphere, Trajectory]]()
    while len(found) < count:
        start, goal = nodes[rng.integers(len(nodes), size=2)]
        path = planner.plan(start, goal, name)
        if path.status != "solved" or path.source != "straight" or path.length_rad < 1.0:
            continue
        tool = planner.robot.forward(path.at(rng.uniform(0.3, 0.7)))[0]
        ball = Sphere("ball", tuple(tool.tolist()), 0.06)
        with planner.scene.including([ball]):
            free = planner._certifier.collisions
            if free.free(np.stack([start, goal])).all() and not free.is_clear(path.joints):
                found.append((start, goal, ball, path))
    return found


def lines_through_spheres(name: str) -> Iterator[tuple[Task, np.ndarray]]:
    """Lines of nodes, projected, each with the task in whose scene the sphere is meanwhile."""
    planner = packaged_planner()
    for start, goal, ball, _ in queries(name, 12):
        share = np.linspace(0.0, 1.0, 17)[:, None]
        line = (1.0 - share) * start + share * goal
        with planner.scene.including([ball]):
            task = planner._preparation.task(planner.constraints[name])
            project(task.open, line[1:-1])
            yield task, line


@pytest.mark.parametrize("name", ["free", "level_cup"])
def test_a_line_is_bent_out_of_a_sphere_to_either_side(name: str) -> None:
    planner, sides = packaged_planner(), 0
    for task, line in lines_through_spheres(name):
        if task.clearance.clearance(planner.robot, line).min() > 0.0:
            continue  # under a constraint the line itself may lead elsewhere
        deepest = int(task.clearance.clearance(planner.robot, line[1:-1]).argmin()) + 1
        bent = [bent_round(task.open, task.clear, line, side, PROJECTION) for side in SIDES]
        for nodes in bent:
            if nodes is None:
                continue
            sides += 1
            np.testing.assert_array_equal(nodes[[0, -1]], line[[0, -1]])
            margin = task.settings.clearance_m - 1e-6
            assert task.clearance.clearance(planner.robot, nodes[deepest]) >= margin
            assert task.manifold.violation(nodes[deepest]) <= 1e-8
        if all(nodes is not None for nodes in bent):
            moved = [nodes[deepest] - line[deepest] for nodes in bent]
            assert moved[0] @ moved[1] < 0.0
    assert sides >= 8


def test_nothing_is_bent_where_nothing_is_near() -> None:
    planner = packaged_planner()
    task = planner._preparation.task(planner.constraints["free"])
    start, _, _, path = queries("free", 1)[0]
    line = np.ascontiguousarray(path.joints[:9])
    for side in SIDES:
        assert bent_round(task.open, task.clear, line, side, PROJECTION) is None
    assert start.tobytes() == line[0].tobytes()


@pytest.mark.parametrize("name", ["free", "level_cup"])
def test_ways_round_a_sphere_are_clear_and_those_seldom_sound_come_last(name: str) -> None:
    planner, found = packaged_planner(), 0
    for task, line in lines_through_spheres(name):
        ways = list(round_it(task, "straight", line))
        assert ways.count(None) == 1
        sound = [way for way in ways if way is not None]
        found += len(sound)
        for way in sound:
            np.testing.assert_array_equal(way.points[[0, -1]], line[[0, -1]])
            assert task.clearance.clearance(planner.robot, way.points).min() > 0.0
            assert task.manifold.violation(way.points).max() <= 1e-6
    assert found >= 12


def test_the_roadmap_is_asked_only_where_the_ways_round_are_long() -> None:
    planner, without, asked = packaged_planner(), 0, 0
    for start, goal, ball, _ in queries("level_cup", 12):
        with planner.scene.including([ball]):
            task, calls = planner._preparation.task(planner.constraints["level_cup"]), list[int]()
            share = np.linspace(0.0, 1.0, task.settings.segments + 1)[:, None]
            line = _relaxed(task, "straight", (1.0 - share) * start + share * goal, task.settings)
            assert line is not None
            around = takewhile(lambda way: way is not None, round_it(task, "straight", line.nodes))
            shortest = min((way.length for way in around if way is not None), default=np.inf)

            def counted(task: Task = task, calls: list[int] = calls) -> Roadmap | None:
                calls.append(1)
                return task.roadmap()

            first = next(
                one
                for one in candidates(replace(task, roadmap=counted), start, goal)
                if one is not None
            )
        if shortest <= ALMOST * line.length:
            assert isinstance(first, Candidate)
            assert first.length <= ALMOST * line.length
            assert not calls
            without += 1
        else:
            assert calls
            asked += 1
    assert without >= 6
    assert asked >= 1


def test_ways_over_a_graph_come_from_few_points_first() -> None:
    """Then, should that one be refused, from all at which the edges were looked at."""
    planner, found = packaged_planner(), 0
    for start, goal, ball, _ in queries("level_cup", 12):
        with planner.scene.including([ball]):
            task = planner._preparation.task(planner.constraints["level_cup"])
            roadmap = task.roadmap()
            assert roadmap is not None
            ends = nearest(roadmap, start), nearest(roadmap, goal)
            corners = shortest_way(roadmap, start, goal, *ends, task.clear)
            if corners is None:
                continue
            ways = list(along(task, "graph", corners, refine=True, clear=True))
            every = len(points_along(task.clear, corners))
            for way in ways:
                assert task.clearance.clearance(planner.robot, way.points).min() > 0.0
            counts = [len(way.nodes) for way in ways]
        if every > FEW * task.settings.segments and counts[0] < every:
            assert counts[0] < 2 * FEW * task.settings.segments
            assert any(count >= every for count in counts[1:])
            found += 1
    assert found >= 6


def test_an_answer_names_the_other_ways_and_a_recording_draws_them(tmp_path: Path) -> None:
    planner, named = packaged_planner(), 0
    # where the first way is short no other is looked for
    for start, goal, ball, _ in queries("level_cup", 24):
        path = planner.plan(start, goal, "level_cup", scene=[ball])
        if path.status != "solved":
            continue
        lengths = [way.length_rad for way in path.statistics.ways]
        assert lengths == sorted(lengths)
        assert ("ways round" in path.explanation) == bool(lengths)
        for way in path.statistics.ways:
            assert way.length_rad > path.length_rad * (1.0 - 1e-3)
            np.testing.assert_allclose(way.points[[0, -1]], [start, goal], atol=1e-12)
            assert f"{way.source} {way.length_rad:.3f}" in path.explanation
        if lengths:
            path.record(tmp_path / "path.rrd", frames=5)
            strips = column(tmp_path / "path.rrd", "/tool/ways", "LineStrips3D:strips")[0]
            assert len(strips) == len(lengths)
            named += 1
    assert named >= 3


def test_a_shorter_path_that_a_budget_finds_names_what_was_found_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    planner, shorter = packaged_planner(), 0
    # so many further curves, whatever the machine
    monkeypatch.setattr(answering, "_in_time", lambda items, *_: islice(items, 12))
    for start, goal, ball, _ in queries("level_cup", 8):
        first = planner.plan(start, goal, "level_cup", scene=[ball])
        best = planner.plan(start, goal, "level_cup", scene=[ball], budget_s=60.0)
        if best.length_rad == first.length_rad:
            assert best.explanation == first.explanation
            continue
        known, *others = best.statistics.ways
        assert (known.source, known.length_rad) == (first.source, first.length_rad)
        np.testing.assert_array_equal(known.points, first.joints)
        assert [way.length_rad for way in others] == [
            way.length_rad for way in first.statistics.ways
        ]
        told = ", ".join(f"{way.source} {way.length_rad:.3f}" for way in (known, *others))
        assert best.explanation.endswith(f"shorter than what was found first ({told} rad)")
        shorter += 1
    assert shorter >= 1
