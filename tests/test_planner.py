"""What a user is promised of a planned path, of a refusal, and of the files a path is written
to.
"""

import hashlib
import json
import pickle
import re
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from io import StringIO
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
from rich.console import Console
from rich.live import Live

from constraint_geodesics import Constraint, GoalRegion, Planner, Pose, Trajectory, bundle
from constraint_geodesics.certification.certifier import Certifier, Limits
from constraint_geodesics.constraints.constraint import ConstraintError, ConstraintManifold
from constraint_geodesics.constraints.polynomial import PolynomialConstraint, Relation
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.methods import SearchMethod
from constraint_geodesics.planner import PlannerError
from constraint_geodesics.problem import SATISFIED, Status
from constraint_geodesics.progress import LINE_AFTER_S, waiting
from constraint_geodesics.recording.recording import read_recording
from constraint_geodesics.scene.cylinder import Cylinder
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.search.candidates import (
    Answer,
    Candidate,
    Parts,
    Task,
    candidates,
    refined,
    rows_of,
)
from constraint_geodesics.search.explanations import _same_pose
from constraint_geodesics.search.preparation import Query
from constraint_geodesics.trajectory import read_trajectory
from tests.planner_fixtures import (
    NAMES,
    manifold_of,
    nodes_of,
    packaged_bundle,
    packaged_planner,
    pairs_of,
)

ONLY_GRAPH = Parts(straight=False, tree=False)
OTHER_WAY_ROUND = np.array([0.0, 2.0, -0.2, 0.0, 0.3, 0.1])
"""A configuration in which the arm touches itself."""


@cache
def solved(name: str) -> tuple[Trajectory, ...]:
    """Paths of some queries of one constraint, those found over the graph among them."""
    planner = packaged_planner()
    paths = [planner.plan(*ends, name) for ends in pairs_of(name, 6, seed=1)]
    paths += [planner.plan(*ends, name, parts=ONLY_GRAPH) for ends in pairs_of(name, 3, seed=2)]
    found = tuple(path for path in paths if path.status == "solved")
    assert len(found) >= 7, [path.explanation for path in paths]
    return found


@pytest.fixture(scope="module")
def planner() -> Planner:
    return packaged_planner()


@pytest.fixture(scope="module")
def certifier(planner):
    """A judge of its own."""
    acceleration = packaged_bundle().planner.acceleration_rad_s2
    limits = Limits(acceleration_rad_s2=(acceleration,) * planner.scene.robot.dof)
    with Certifier(planner.scene.now, limits) as judge:
        yield judge


@pytest.fixture(scope="module")
def small() -> Iterator[Planner]:
    """The same planner with small graphs of constraints that it was not made for."""
    settings = packaged_bundle().planner.model_copy(update={"roadmap_nodes": 300})
    planner = Planner(replace(packaged_bundle(), planner=settings), "a bundle of its own")
    yield planner
    planner.close()


def one_line(text: str) -> bool:
    return 0 < len(text) < 1000 and "\n" not in text


def off_the_line(points: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Distance of points to the straight lines between rows [rad]."""
    sides = np.diff(rows, axis=0)
    share = ((points[:, None] - rows[:-1]) * sides).sum(-1) / np.square(sides).sum(-1)
    nearest = rows[:-1] + np.clip(share, 0.0, 1.0)[..., None] * sides
    return np.linalg.norm(points[:, None] - nearest, axis=-1).min(axis=1)


# paths


@pytest.mark.parametrize("name", NAMES)
def test_a_path_keeps_every_promise(planner, certifier, name) -> None:
    robot, judged = planner.scene.robot, packaged_bundle().judge
    manifold = manifold_of(planner, name)
    for path in solved(name):
        first, last = path.joints[0], path.joints[-1]
        assert path.constraint_name == name
        assert path.joints.shape == (len(path.times), robot.dof)
        assert one_line(path.explanation)
        assert f"{path.length_rad:.3f} rad" in path.explanation
        assert path.source in path.explanation
        certificate = certifier.certify(path.joints, manifold.constraint, first, last, path.times)
        assert certificate.valid, certificate.violation
        assert path.certificate is not None
        assert path.certificate.valid
        assert path.length_rad == pytest.approx(
            np.linalg.norm(np.diff(path.joints, axis=0), axis=1).sum(), rel=1e-12
        )
        assert path.length_rad >= np.linalg.norm(last - first) - 1e-12
        assert manifold.violation(path.joints).max() <= path.max_violation + 1e-6
        assert path.max_violation <= path.violation_bound <= judged.violation_tolerance == 1e-4
        assert path.planning_time_s > 0.0
        assert 0.0 <= path.collision_time_s <= path.planning_time_s


@pytest.mark.parametrize("name", NAMES)
def test_both_ends_are_the_querys_to_the_bit(planner, name) -> None:
    for parts in (Parts(), ONLY_GRAPH):
        for start, goal in pairs_of(name, 2, seed=3):
            path = planner.plan(start.tolist(), goal, name, parts=parts)
            assert path.status == "solved", path.explanation
            for end, wanted, share in ((path.joints[0], start, 0), (path.joints[-1], goal, 1)):
                assert end.tobytes() == wanted.tobytes()
                assert path.at(share).tobytes() == wanted.tobytes()
                assert path.at([share])[0].tobytes() == wanted.tobytes()


def test_the_caller_may_change_its_arrays_afterwards(planner) -> None:
    start, goal = (end.copy() for end in pairs_of("level_cup", 1, seed=4)[0])
    path = planner.plan(start, goal, "level_cup")
    before = path.joints.copy(), path.at(0.0), path.at(1.0)
    start[:], goal[:] = np.nan, np.nan
    for now, then in zip((path.joints, path.at(0.0), path.at(1.0)), before, strict=True):
        np.testing.assert_array_equal(now, then)


@pytest.mark.parametrize("name", NAMES)
def test_times_keep_velocity_and_acceleration(planner, name) -> None:
    acceleration = packaged_bundle().planner.acceleration_rad_s2
    for path in solved(name):
        assert path.times[0] == 0.0
        steps = np.diff(path.times)
        assert (steps > 0.0).all()
        velocity = np.diff(path.joints, axis=0) / steps[:, None]
        assert (np.abs(velocity) <= planner.scene.robot.velocity * (1.0 + 1e-9)).all()
        around = np.pad(steps, 1)
        changes = np.diff(np.pad(velocity, ((1, 1), (0, 0))), axis=0)
        at_rows = changes / (0.5 * (around[1:] + around[:-1]))[:, None]
        assert np.abs(at_rows).max() <= acceleration * (1.0 + 1e-6)
        # the limits are used, not merely kept
        used = np.abs(velocity) / planner.scene.robot.velocity
        assert max(used.max(), np.abs(at_rows).max() / acceleration) > 0.9


@pytest.mark.parametrize("name", NAMES)
def test_any_share_of_the_way_is_on_the_constraint(planner, name) -> None:
    manifold = manifold_of(planner, name)
    shares = np.random.default_rng(0).permutation(np.linspace(0.0, 1.0, 150))
    for path in solved(name):
        points = path.at(shares)
        assert points.shape == (150, 6)
        assert manifold.violation(points).max() <= 1e-6
        assert planner.scene.robot.limit_distance(points).min() >= -1e-9
        np.testing.assert_array_equal(path.at(shares.tolist()), points)
        np.testing.assert_array_equal(path.at(float(shares[3])), points[3])
        if name != "tool_down":
            assert off_the_line(points, path.joints).max() < 0.05
            steps = np.linalg.norm(np.diff(path.at(np.sort(shares)), axis=0), axis=1)
            assert steps.max() < 4.0 * path.length_rad / 149


def test_shares_next_to_each_other_lie_next_to_each_other(planner) -> None:
    """A way through the wrist's singular configuration."""
    start = [2.127567, 0.421243380, -0.421431173, 3.18069243, -0.000187936663, -0.336338073]
    goal = [2.40494227, -1.0116266, -0.29165983, -3.14159064, -1.30328643, -2.95154858]
    start, goal = retract(manifold_of(planner, "tool_down"), np.array([start, goal])).joints
    path = planner.plan(start, goal, "tool_down")
    assert path.status == "solved", path.explanation
    points = path.at(np.linspace(0.0, 1.0, 4001))
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert steps.max() < 10.0 * path.length_rad / 4000


def test_shares_outside_the_way_are_refused(planner) -> None:
    path = solved("level_cup")[0]
    for wrong in (-1e-9, 1.0 + 1e-9, np.nan, np.inf, [0.0, 0.5, 2.0], [np.nan], None):
        with pytest.raises(PlannerError, match="must be a number or a row"):
            path.at(wrong)
    assert path.at([]).shape == (0, 6)
    nothing = planner.plan(OTHER_WAY_ROUND, OTHER_WAY_ROUND, "free")
    with pytest.raises(PlannerError, match="there is no path"):
        nothing.at(0.5)


@pytest.mark.parametrize("wrong", ["half", [[0.1, 0.2]]])
def test_shares_that_are_no_row_of_numbers_are_refused(wrong) -> None:
    try:
        solved("level_cup")[0].at(wrong)
    except PlannerError:
        return
    pytest.fail("accepted")


def test_a_turn_from_limit_to_limit_is_planned(planner) -> None:
    """The first joint turns about the vertical, which a level cup does not mind."""
    robot = planner.scene.robot
    start, goal = nodes_of("level_cup")[0][0].copy(), nodes_of("level_cup")[0][0].copy()
    start[0], goal[0] = robot.lower[0], robot.upper[0]
    path = planner.plan(start, goal, "level_cup")
    assert path.status == "solved"
    assert path.length_rad == pytest.approx(robot.upper[0] - robot.lower[0], rel=1e-6)
    np.testing.assert_allclose(
        path.joints[:, 1:], np.tile(start[1:], (len(path.joints), 1)), atol=1e-6
    )


def test_ends_beside_the_constraint_within_its_tolerance_are_taken(planner) -> None:
    """An end may be off by what is allowed of the path itself."""
    manifold = manifold_of(planner, "level_cup")
    for start, goal in pairs_of("level_cup", 4, seed=5):
        row = manifold.jacobian(start)[3]
        beside = start + 5e-5 * row / (row @ row)
        assert 1e-5 < manifold.violation(beside) < 9e-5
        path = planner.plan(beside, goal, "level_cup")
        assert path.status == "solved", path.explanation
        assert path.violation_bound <= 1e-4
        assert path.joints[0].tobytes() == beside.tobytes()


@pytest.mark.parametrize("name", ["level_cup", "slide"])
def test_refinement_shortens_a_way_over_the_graph(planner, name) -> None:
    plain = Parts(straight=False, refinement=False, tree=False)
    ratios = []
    for ends in pairs_of(name, 6, seed=6):
        paths = [planner.plan(*ends, name, parts=parts) for parts in (ONLY_GRAPH, plain)]
        if all(path.status == "solved" for path in paths):
            assert paths[0].source == paths[1].source == "graph"
            ratios.append(paths[0].length_rad / paths[1].length_rad)
    assert len(ratios) >= 3
    assert np.median(ratios) < 0.95
    assert max(ratios) < 1.0 + 1e-3


def test_the_same_query_gives_the_same_bytes(planner) -> None:
    """In this process after many others, and in a fresh one."""
    queries = [
        (name, *ends)
        for name in ("level_cup", "slide", "free")
        for ends in pairs_of(name, 2, seed=7)
    ]
    script = (
        "import hashlib, json, sys\n"
        "from constraint_geodesics import Planner\n"
        "with Planner.load(sys.argv[1]) as planner:\n"
        "    for name, start, goal in json.loads(sys.stdin.read()):\n"
        "        path = planner.plan(start, goal, name)\n"
        "        print(hashlib.sha256(path.joints.tobytes() + path.times.tobytes()).hexdigest())\n"
    )
    as_json = json.dumps([(name, start.tolist(), goal.tolist()) for name, start, goal in queries])
    fresh = subprocess.run(
        [sys.executable, "-c", script, str(bundle.PACKAGED)],
        input=as_json,
        capture_output=True,
        text=True,
        check=True,
    )
    own = []
    for name, start, goal in reversed(queries):
        path = planner.plan(start, goal, name)
        assert path.status == "solved"
        own.append(hashlib.sha256(path.joints.tobytes() + path.times.tobytes()).hexdigest())
    assert fresh.stdout.split() == own[::-1]


def test_a_batch_is_planned_like_its_queries(planner) -> None:
    pairs = [*pairs_of("slide", 3, seed=8), *pairs_of("slide", 1, seed=8, joined=False)]
    starts, goals = (np.array(ends) for ends in zip(*pairs, strict=True))
    done: list[int] = []
    paths = planner.plan_batch(starts, goals, "slide", progress=done.append)
    assert done == [1, 2, 3, 4]
    assert paths[-1].status == "not_connected"
    for path, start, goal in zip(paths, starts, goals, strict=True):
        alone = planner.plan(start, goal, "slide")
        assert (path.status, path.explanation, path.source) == (
            alone.status,
            alone.explanation,
            alone.source,
        )
        assert path.joints.tobytes() == alone.joints.tobytes()
        assert path.times.tobytes() == alone.times.tobytes()
    assert planner.plan_batch(starts[:0], goals[:0], "slide") == []


def test_long_calls_say_so_on_the_main_thread_alone(planner, monkeypatch, capfd) -> None:
    (start, goal), *_ = pairs_of("slide", 1, seed=8)
    planner.plan(start, goal, "slide", budget_s=0.1)
    planner.plan_batch([start], [goal], "slide")
    assert capfd.readouterr().err == ""
    planner.plan(start, goal, "slide", budget_s=LINE_AFTER_S + 0.5)
    assert capfd.readouterr().err == "planning for 2.5 s …\n"
    monkeypatch.setattr("constraint_geodesics.planner.LINE_AFTER_S", 0.0)
    asked = [start] * 3, [goal] * 3, "slide"
    planner.plan_batch(*asked)
    said = capfd.readouterr().err
    assert re.search(r"planned, after the first 1: 2/2, took \d+ s\n", said), said
    thread = Thread(target=planner.plan_batch, args=asked)
    thread.start()
    thread.join()
    planner.plan_batch(*asked, progress=lambda done: None)
    with Live(console=Console(file=StringIO(), force_terminal=True)):
        planner.plan_batch(*asked)
    assert capfd.readouterr().err == ""


def test_a_plan_that_makes_a_roadmap_says_so_once(monkeypatch, capfd) -> None:
    own, ((start, goal), *_) = packaged_planner(), pairs_of("level_cup", 1, seed=8)
    tilt = Constraint([0, 0, 0, 1, 1, 0], [0, 0, 0, 0.4567, 0.4567, 0])
    monkeypatch.setattr("constraint_geodesics.progress.LINE_AFTER_S", 0.05)
    own.plan(start, goal, tilt, parts=Parts(straight=False))
    said = capfd.readouterr().err
    assert said.splitlines().count("making the roadmap …") == 1, said
    own.plan(start, goal, tilt, parts=Parts(straight=False))
    assert "roadmap" not in capfd.readouterr().err
    narrower = Constraint([0, 0, 0, 1, 1, 0], [0, 0, 0, 0.4321, 0.4321, 0])
    with waiting("a bar of the caller's"):  # which is all that is shown then
        own.plan(start, goal, narrower, parts=Parts(straight=False))
    assert capfd.readouterr().err == "a bar of the caller's …\n"


def test_a_batch_of_unequal_shapes_is_refused(planner) -> None:
    rows = nodes_of("free")[0]
    for starts, goals in ((rows[:2], rows[:3]), (rows[0], rows[1]), (rows[:2, :5], rows[:2, :5])):
        with pytest.raises(PlannerError, match=r"\(B, 6\)"):
            planner.plan_batch(starts, goals, "free")
    with pytest.raises(PlannerError, match="finite"):
        planner.plan_batch(rows[:2], np.full((2, 6), np.nan), "free")


# refusals


def refusals(planner: Planner) -> dict[str, tuple[np.ndarray, np.ndarray, str, str]]:
    """Queries that can't be answered: start, goal, constraint, and what the explanation must
    say.
    """
    good, other = pairs_of("level_cup", 1, seed=9)[0]
    tilted, beyond = good.copy(), good.copy()
    tilted[4] += 0.3
    beyond[0] = 4.0
    degrees = np.degrees(manifold_of(planner, "level_cup").violation(tilted))
    apart = pairs_of("tool_down", 1, seed=10, joined=False)[0]
    in_table = np.array([-0.42, 1.91, -1.87, -0.52, 1.31, 3.47])
    return {
        "start_violates": (tilted, other, "level_cup", rf"start.*level_cup.*{degrees:.3g}°"),
        "goal_violates": (other, tilted, "level_cup", rf"goal.*level_cup.*{degrees:.3g}°"),
        "out_of_limits": (other, beyond, "level_cup", r"joint1 of the goal is 4 rad.*-3\.5.*3\.5"),
        "in_collision": (in_table, nodes_of("free")[0][0], "free", "start touches the workcell"),
        "not_connected": (*apart, "tool_down", "different components of tool_down"),
        "not_found": (good, other, "level_cup", "level_cup"),
    }


@pytest.mark.parametrize(
    "status",
    [
        "start_violates",
        "goal_violates",
        "out_of_limits",
        "in_collision",
        "not_connected",
        "not_found",
    ],
)
def test_what_can_not_be_planned_is_said(planner, tmp_path, status) -> None:
    start, goal, name, expected = refusals(planner)[status]
    parts = Parts(False, False, tree=False) if status == "not_found" else Parts()
    path = planner.plan(start, goal, name, parts=parts)
    assert path.status == status, path.explanation
    assert re.search(expected, path.explanation), path.explanation
    assert one_line(path.explanation)
    assert path.joints.shape == (0, 6)
    assert path.times.shape == (0,)
    assert np.isnan([path.length_rad, path.max_violation, path.violation_bound]).all()
    assert path.planning_time_s > 0.0
    for use in (path.save, path.record, path.draw):
        with pytest.raises(PlannerError, match="there is no path"):
            use(tmp_path / "file")
    assert not list(tmp_path.iterdir())
    summary = json.loads(json.dumps(path.summary(), allow_nan=False))
    assert summary["status"] == status
    assert summary["length_rad"] is None


def test_a_collision_says_with_what(planner) -> None:
    free = nodes_of("free")[0][0]
    path = planner.plan(free, OTHER_WAY_ROUND, "free")
    assert path.status == "in_collision"
    assert "the goal touches the arm itself" in path.explanation


def alternative(explanation: str) -> np.ndarray:
    return np.array([float(x) for x in re.search(r"\[([^\]]*)\]", explanation)[1].split(",")])


@pytest.mark.parametrize("name", ["tool_down", "slide", "fixed_orientation"])
def test_an_alternative_goal_is_named_and_can_be_reached(planner, name) -> None:
    robot, same_pose = planner.scene.robot, 0
    for start, goal in pairs_of(name, 8, seed=11, joined=False):
        path = planner.plan(start, goal, name)
        if path.status != "not_connected":  # the graph may miss a way that the straight line finds
            assert path.status == "solved"
            continue
        named = alternative(path.explanation)
        if "tool pose" in path.explanation:
            same_pose += 1
            pose = Constraint((1,) * 6, reference=Pose(*robot.forward(goal)))
            exact = retract(ConstraintManifold(robot, pose), named).joints
            assert np.linalg.norm(exact - goal) > 0.1, "another configuration"
        else:
            exact = retract(manifold_of(planner, name), named).joints
            assert f"{np.linalg.norm(named - goal):.2f} rad away" in path.explanation
        # it is printed with four digits
        assert np.abs(exact - named).max() < 1e-3
        other = planner.plan(start, exact, name)
        assert other.status == "solved", other.explanation
    assert same_pose >= 2


def test_an_alternative_goal_keeps_what_is_asked_of_other_places_than_the_tool(planner) -> None:
    """The height of the wrist: other branches with the same tool pose have another one."""
    seeds = nodes_of("free")[0][:64]
    goal, place = seeds[0], planner.robot.skeleton(seeds[0])
    joint = 4
    height = Relation("height", "m", -float(place[joint + 1, 2]), np.eye(12)[2])
    own = PolynomialConstraint((height,), joint=joint)
    manifold = ConstraintManifold(planner.robot, own)
    assert manifold.violation(goal) <= SATISFIED
    query = Query(planner._preparation.task(own), "height", goal, goal, 0.0)
    loose = replace(query, task=planner._preparation.task(planner.constraints["free"]))
    named, all_of_them = _same_pose(query, seeds), _same_pose(loose, seeds)
    assert (manifold.violation(named) <= SATISFIED).all()
    assert 0 < len(named) < len(all_of_them)


def test_an_alternative_goal_can_be_reached_as_it_is_printed(planner) -> None:
    told = 0
    for start, goal in pairs_of("tool_down", 25, seed=12, joined=False):
        path = planner.plan(start, goal, "tool_down")
        if path.status == "not_connected":
            again = planner.plan(start, alternative(path.explanation), "tool_down")
            assert again.status not in ("goal_violates", "out_of_limits"), again.explanation
            told += 1
    assert told >= 5


@pytest.mark.parametrize(
    ("end", "said"),
    [
        ([np.nan] + [0.0] * 5, r"\[0\] is not finite"),
        ([0.0] * 5 + [np.inf], r"\[5\] is not finite"),
        ([0.0] * 5, r"\(5,\).*\(6,\)"),
        ([], r"\(0,\)"),
        ([[0.0] * 5], r"\(5,\)|\(1, 5\)"),
        (0.5, r"\(\)"),
        (None, r"\(\)|None"),
        ("abc", "abc"),
        (["a"] * 6, "6 numbers"),
        ([0.0, [0.0], 0.0, 0.0, 0.0, 0.0], "6 numbers"),
        ({}, "6 numbers"),
    ],
    ids=str,
)
def test_ends_that_can_not_be_meant_are_misuse(planner, end, said) -> None:
    good = nodes_of("free")[0][0]
    for which, query in (("start", (end, good)), ("goal", (good, end))):
        with pytest.raises(PlannerError, match=f"{which}.*{said}") as error:
            planner.plan(*query, "free")
        assert one_line(str(error.value))


@pytest.mark.parametrize("name", ["levelcup", "", None, 3, (0, 0, 0, 1, 1, 0)])
def test_names_that_do_not_exist_are_misuse(planner, name) -> None:
    good = nodes_of("free")[0][0]
    for ask in (
        lambda: planner.plan(good, good, name),
        lambda: planner.prepare(name),
        lambda: planner.nodes(name),
    ):
        with pytest.raises(PlannerError, match="must be one of.*level_cup") as error:
            ask()
        assert one_line(str(error.value))


@pytest.mark.parametrize("name", ["free", "level_cup", "slide"])
def test_a_goal_that_is_the_start_is_a_path_that_stands(planner, tmp_path, name) -> None:
    for q in nodes_of("slide")[0][:3]:
        path = planner.plan(q, q, name)
        assert path.status == "solved", path.explanation
        assert path.length_rad == 0.0
        np.testing.assert_array_equal(path.joints, np.tile(q, (len(path.joints), 1)))
        np.testing.assert_allclose(path.at([0.0, 0.3, 1.0]), np.tile(q, (3, 1)), atol=1e-8)
        assert path.times[0] == 0.0
        assert (np.diff(path.times) > 0.0).all()
        assert path.violation_bound <= 1e-4
        path.save(tmp_path / "path.csv")
        assert packaged_planner().check(tmp_path / "path.csv").valid


@pytest.mark.parametrize("distance", [1e-9, 1e-6, 1e-3])
def test_a_goal_next_to_the_start_is_reached_directly(planner, distance) -> None:
    for start in nodes_of("slide")[0][:4]:
        goal = start.copy()
        goal[0] += distance
        for name in ("free", "level_cup", "slide"):
            path = planner.plan(start, goal, name)
            assert path.status == "solved"
            assert path.length_rad == pytest.approx(distance, rel=1e-3)


def test_a_goal_a_rounding_away_from_the_start_is_no_detour(planner) -> None:
    for start in nodes_of("level_cup")[0][:10]:
        goal = start.copy()
        goal[0] += 1e-13
        path = planner.plan(start, goal, "free")
        assert path.status == "solved"
        assert path.length_rad < 1e-6


# constraints as objects


def test_a_constraint_and_its_name_are_the_same(planner) -> None:
    start, goal = pairs_of("level_cup", 1, seed=13)[0]
    named = planner.plan(start, goal, "level_cup")
    given = planner.plan(start, goal, planner.constraints["level_cup"])
    assert given.joints.tobytes() == named.joints.tobytes()
    assert "roll pitch" in given.constraint_name


def test_without_a_reference_the_axes_are_held_where_the_start_has_them(planner) -> None:
    robot, found = planner.scene.robot, 0
    height = Constraint((0, 0, 1, 0, 0, 0))
    start = np.array([0.3, -0.4, -0.9, 0.2, 0.8, 0.1])
    position, rotation = robot.forward(start)
    held = ConstraintManifold(robot, height.relative_to(Pose(position, rotation)))
    goals = retract(held, start + np.random.default_rng(1).uniform(-0.6, 0.6, (8, 6))).joints
    for goal in goals:
        path = planner.plan(start, goal, height, parts=Parts(graph=False, tree=False))
        if path.status != "solved":
            continue
        found += 1
        np.testing.assert_array_equal(path.constraint.reference.position, position)
        np.testing.assert_array_equal(path.constraint.reference.rotation, rotation)
        assert np.abs(robot.forward(path.joints)[0][:, 2] - position[2]).max() <= 1e-4
        assert (
            np.abs(robot.forward(path.at(np.linspace(0, 1, 50)))[0][:, 2] - position[2]).max()
            <= 1e-6
        )
        assert path.constraint_name == "the constraint on z"
    assert found >= 4
    away = goals[0].copy()
    away[1] += 0.3
    path = planner.plan(start, away, height)
    assert path.status == "goal_violates"
    metres = abs(robot.forward(away)[0][2] - position[2])
    assert f"{1e3 * metres:.3g} mm" in path.explanation


def test_a_constraint_never_seen_gets_its_graph_when_it_is_needed(small) -> None:
    reference = Pose(*small.scene.robot.forward(np.array([0.3, -0.4, -0.9, 0.2, 0.8, 0.1])))
    never = Constraint((0, 0, 0, 1, 0, 0), (0, 0, 0, 0.1, 0, 0), reference)
    nodes = small.nodes(never)
    assert 200 < len(nodes) <= 300
    manifold = ConstraintManifold(small.scene.robot, never)
    assert manifold.violation(nodes).max() <= 1e-8
    assert small.scene.robot.limit_distance(nodes).min() >= 0.0
    with small.scene.world() as world:
        assert world.free(nodes).all()
    small.prepare(never)
    assert np.shares_memory(small.nodes(never), nodes), "kept"
    paths = [small.plan(nodes[k], nodes[k + 1], never, parts=ONLY_GRAPH) for k in range(40)]
    found = [path for path in paths if path.status == "solved"]
    assert len(found) >= 10
    for path in found:
        assert path.source == "graph"
        assert path.violation_bound <= 1e-4
        assert manifold.violation(path.at(np.linspace(0.0, 1.0, 60))).max() <= 1e-6


def test_the_answer_does_not_depend_on_earlier_queries() -> None:
    """Not even under a constraint whose graph is made by the way."""
    settings = packaged_bundle().planner.model_copy(update={"roadmap_nodes": 300})
    near = nodes_of("level_cup")[0][0]
    with Planner(replace(packaged_bundle(), planner=settings), "a bundle of its own") as own:
        never = Constraint((0, 0, 0, 1, 1, 0), reference=Pose(*own.scene.robot.forward(near)))
        drawn = retract(
            ConstraintManifold(own.scene.robot, never), near + np.linspace(-0.6, 0.6, 5)[:, None]
        )
        goals = [q for q in drawn.joints if np.linalg.norm(q - near) > 0.1]
        no_line = Parts(straight=False)
        first = [own.plan(near, goal, never, parts=no_line) for goal in goals]
        own.nodes(never)
        again = [own.plan(near, goal, never, parts=no_line) for goal in goals]
    assert any(path.status == "solved" for path in first)
    assert [path.joints.tobytes() for path in first] == [path.joints.tobytes() for path in again]


def test_many_constraints_may_come_and_go(small) -> None:
    """What is remembered of them changes no answer."""
    start, goal = pairs_of("free", 1, seed=15)[0]
    straight = Parts(graph=False, tree=False)
    wide = Constraint((0, 0, 1, 0, 0, 0), (0, 0, 5.0, 0, 0, 0))
    first = small.plan(start, goal, wide, parts=straight)
    assert first.status == "solved"
    for k in range(80):
        pose = Pose(np.array([0.0, 0.0, 0.01 * k]), np.eye(3))
        assert small.plan(start, goal, wide.relative_to(pose), parts=straight).status == "solved"
    again = small.plan(start, goal, wide, parts=straight)
    assert again.joints.tobytes() == first.joints.tobytes()
    assert small.plan(start, goal, "free", parts=straight).status == "solved"


def test_a_pose_out_of_reach_has_no_graph(small) -> None:
    far = Constraint((1, 1, 1, 0, 0, 0), reference=Pose(np.array([3.0, 0.0, 0.5]), np.eye(3)))
    assert small.nodes(far).shape == (0, 6)
    q = nodes_of("free")[0][0]
    path = small.plan(q, q, far)
    assert path.status == "start_violates"
    assert re.search(r"\d mm", path.explanation)
    with pytest.raises(PlannerError, match="no reference"):
        small.nodes(Constraint((1, 1, 1, 0, 0, 0)))


NO_POSITION = r"^position = .*: must be 3 finite numbers \[m\]$"
NO_ROTATION = r"^rotation = .*: must be orthonormal and right-handed$"


@pytest.mark.parametrize(
    ("position", "rotation", "said"),
    [
        (np.zeros(2), np.eye(3), NO_POSITION),
        (np.zeros(3), np.zeros((3, 3)), NO_ROTATION),
        (np.full(3, np.nan), np.eye(3), NO_POSITION),
        (np.zeros(3), -np.eye(3), NO_ROTATION),
    ],
    ids=("position of two", "rotation of zeros", "not finite", "mirrored"),
)
def test_a_reference_that_is_no_pose_is_refused(position, rotation, said) -> None:
    with pytest.raises(ConstraintError, match=said):
        Pose(position, rotation)


def test_a_reference_may_be_given_as_lists(planner) -> None:
    start, goal = pairs_of("free", 1, seed=14)[0]
    wide = Constraint(
        (1, 0, 1, 0, 0, 0), (10.0, 0, 10.0, 0, 0, 0), Pose([0.0, 0.0, 0.0], np.eye(3).tolist())
    )
    assert planner.plan(start, goal, wide).status == "solved"


# files


def test_a_saved_path_is_read_to_the_last_bit(tmp_path) -> None:
    for name in NAMES:
        path = solved(name)[0]
        path.save(tmp_path / "new" / f"{name}.csv")
        joints, times, constraint, *_ = read_trajectory(tmp_path / "new" / f"{name}.csv")
        assert joints.tobytes() == path.joints.tobytes()
        assert times.tobytes() == path.times.tobytes()
        assert (constraint.axes, constraint.tolerance) == (
            path.constraint.axes,
            path.constraint.tolerance,
        )
        if name == "free":
            assert constraint.reference is None
        else:
            assert (
                constraint.reference.position.tobytes()
                == path.constraint.reference.position.tobytes()
            )
            assert (
                constraint.reference.rotation.tobytes()
                == path.constraint.reference.rotation.tobytes()
            )


def test_a_saved_path_is_certified_by_itself(planner, tmp_path) -> None:
    for name in ("level_cup", "level_cup_relaxed", "slide"):
        path = solved(name)[0]
        path.save(tmp_path / "path.csv")
        certificate = packaged_planner().check(tmp_path / "path.csv")
        assert certificate.valid
        assert certificate.length_rad == path.length_rad
        assert certificate.violation_bound == path.violation_bound
    assert packaged_planner().check(tmp_path / "path.csv", "level_cup").valid, (
        "what slides is level"
    )
    other = packaged_planner().check(tmp_path / "path.csv", "tool_down")
    assert other.violation.kind == "constraint"
    with pytest.raises(PlannerError, match="there is no constraint 'cup'"):
        packaged_planner().check(tmp_path / "path.csv", "cup")


@pytest.mark.parametrize(
    ("first", "kind"), [("inf", "not_finite"), ("nan", "not_finite"), ("1e200", "joint_limits")]
)
def test_a_path_that_begins_nowhere_is_judged(planner, tmp_path, first, kind) -> None:
    """Under a constraint that is held where it begins, too."""
    names = ",".join(planner.robot.joint_names)
    (tmp_path / "path.csv").write_text(f"{names}\n{first},0,0,0,0,0\n0,0,0,0,0,0\n")
    certificate = planner.check(tmp_path / "path.csv", Constraint((1,) * 6))
    assert certificate.violation.kind == kind


def test_a_path_names_the_shapes_it_was_planned_among(tmp_path) -> None:
    ball = Sphere("ball", (0.0, 0.0, 3.0), 0.1)
    cup = Cylinder("cup", Pose([0, 0, 0.1], np.eye(3)), length_m=0.1, radius_m=0.03)
    file = tmp_path / "path.csv"
    start, goal = pairs_of("free", 1, seed=14)[0]
    with Planner.load(bundle.PACKAGED) as planner:
        planner.scene.attach(cup, link=planner.robot.tool_link)
        planner.plan(start, goal, "free", scene=[ball]).save(file)
        assert {"ball", "cup"} < set(read_trajectory(file).shapes)
        with pytest.warns(UserWarning, match=r"path\.csv was planned among ball, which") as told:
            assert planner.check(file).valid
        assert told[0].filename == __file__
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            planner.scene.add(ball)
            assert planner.check(file).valid


def lines_of(tmp_path: Path) -> list[str]:
    solved("level_cup")[0].save(tmp_path / "path.csv")
    return (tmp_path / "path.csv").read_text().splitlines()


def test_a_path_of_somebody_else_may_lack_times_and_constraint(tmp_path) -> None:
    path, lines = solved("level_cup")[0], lines_of(tmp_path)
    bare = tmp_path / "bare.csv"
    table = [line.split(",", 1)[1] for line in lines if not line.startswith("#")]
    bare.write_text("\r\n".join(table) + "\r\n\r\n")
    joints, times, constraint, *_ = read_trajectory(bare)
    assert joints.tobytes() == path.joints.tobytes()
    assert times is None
    assert constraint is None
    with pytest.raises(PlannerError, match=r"bare\.csv names no constraint.*--constraint"):
        packaged_planner().check(bare)
    certificate = packaged_planner().check(bare, "level_cup")
    assert certificate.valid
    assert np.isnan(certificate.duration_s)


@pytest.mark.parametrize(
    ("line", "text", "said"),
    [
        (1, "# constraint: {", "line 1: not a constraint"),
        (1, "# constraint: [1]", "line 1: not a constraint"),
        (1, '# constraint: {"axes": [0, 0, 0, 0, 0, 0]}', "line 1: not a constraint"),
        (
            1,
            '# constraint: {"axes": [2], "tolerance": [0], "reference": null}',
            "line 1: not a constraint",
        ),
        (2, "# shapes: [1]", r"line 2: not a list of names: \[1\]"),
        (2, "# shapes: [", "line 2: not a list of names"),
        (5, "0,0,0,zero,0,0,0", "line 5: not a row of numbers"),
        (5, "0,0,0,,0,0,0", "line 5: not a row of numbers"),
        (7, "0,0,0,0,0,0", "line 7: 6 numbers under 7 names"),
        (7, "0;0;0;0;0;0;0", "line 7: not a row of numbers"),
    ],
)
def test_a_corrupted_line_is_named(tmp_path, line, text, said) -> None:
    lines = lines_of(tmp_path)
    lines[line - 1] = text
    (tmp_path / "path.csv").write_text("\n".join(lines))
    with pytest.raises(PlannerError, match=rf"path\.csv, {said}") as error:
        packaged_planner().check(tmp_path / "path.csv")
    assert one_line(str(error.value))


def test_a_file_must_have_the_ends_that_it_is_asked_for(planner, tmp_path) -> None:
    path = solved("level_cup")[0]
    path.save(tmp_path / "path.csv")
    start, goal = path.joints[[0, -1]]
    assert planner.check(tmp_path / "path.csv", start=start, goal=goal).valid
    for wrong in (1e-3, -1e-3):
        for end, q in (("start", start), ("goal", goal)):
            ends = {"start": start, "goal": goal, end: q + wrong * np.eye(len(q))[3]}
            certificate = planner.check(tmp_path / "path.csv", **ends)
            assert not certificate.valid
            assert certificate.violation.kind == f"{end}_missed"
    with pytest.raises(PlannerError, match="start has shape"):
        planner.check(tmp_path / "path.csv", start=start[:5])


def test_a_planner_is_not_pickled(planner) -> None:
    with pytest.raises(TypeError, match="holds a physics world: make one in each process"):
        pickle.dumps(planner)


def test_files_that_hold_no_path_are_refused(tmp_path) -> None:
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "header.csv").write_text("time_s,joint1\n")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00\x00")
    for name in ("empty.csv", "header.csv", "bytes.csv", "nowhere.csv", "."):
        with pytest.raises(PlannerError, match=str(tmp_path)):
            read_trajectory(tmp_path / name)


@pytest.mark.parametrize("change", ["reversed", "foreign", "none"])
def test_columns_are_the_joints_that_their_names_say(planner, tmp_path, change) -> None:
    path = solved("free")[0]
    path.save(tmp_path / "path.csv")
    about, _, _, header, *rows = (tmp_path / "path.csv").read_text().splitlines()
    names = header.split(",")
    headers = {
        "reversed": (
            [",".join([names[0], *names[:0:-1]])],
            "columns are time_s, joint6.*must be joint1",
        ),
        "foreign": (["time_s,a,b,c,d,e,f"], "columns are time_s, a, b.*must be joint1"),
        "none": ([], "a header line with the joints' names is needed"),
    }
    header, said = headers[change]
    (tmp_path / "path.csv").write_text("\n".join([about, *header, *rows]))
    with pytest.raises(PlannerError, match=said):
        read_trajectory(tmp_path / "path.csv", planner.scene.robot.joint_names)


def test_a_recording_holds_the_path(tmp_path) -> None:
    path = solved("level_cup")[0]
    path.record(tmp_path / "path.rrd", frames=5)
    recording = read_recording(tmp_path / "path.rrd")
    assert recording.joints.shape == (5, 6)
    np.testing.assert_allclose(recording.joints[[0, -1]], path.joints[[0, -1]], atol=1e-6)
    np.testing.assert_allclose(
        recording.tool_ends, path.scene.robot.forward(path.joints[[0, -1]])[0], atol=1e-6
    )
    assert recording.has_blueprint


def test_a_picture_is_drawn(tmp_path) -> None:
    solved("slide")[0].draw(tmp_path / "new" / "path.png")
    content = (tmp_path / "new" / "path.png").read_bytes()
    assert content.startswith(b"\x89PNG\r\n\x1a\n")
    width, height = (int.from_bytes(content[k : k + 4], "big") for k in (16, 20))
    assert width > 600
    assert height > 300


def test_a_summary_is_strict_json() -> None:
    path = solved("level_cup")[0]
    summary = json.loads(json.dumps(path.summary(), allow_nan=False))
    assert summary["status"] == "solved"
    assert summary["rows"] == len(path.joints)
    assert summary["length_rad"] == path.length_rad
    assert summary["duration_s"] == path.times[-1]
    assert summary["source"] == path.source
    assert summary["violation_bound"] == path.violation_bound


def test_a_planner_says_where_it_came_from_and_can_be_closed() -> None:
    with Planner.load(str(bundle.PACKAGED)) as own:
        assert own.source == str(bundle.PACKAGED)
        assert set(own.constraints) == set(packaged_bundle().constraints)
        own.prepare("free")
    own.close()
    nobody = np.empty((0, 6))
    for question in (
        lambda: own.plan([0.0] * 6, [0.1] * 6, "free"),
        lambda: own.plan_batch(nobody, nobody, "free"),
        lambda: own.nodes("free"),
        lambda: own.prepare("free"),
        own.__enter__,
    ):
        with pytest.raises(PlannerError, match="closed"):
            question()


def test_a_batch_is_refused_as_a_whole_before_anything_is_planned(planner) -> None:
    starts = np.zeros((3, 6))
    goals = starts.copy()
    goals[1, 2] = np.nan
    planned = []
    with pytest.raises(PlannerError, match=r"goals\[1\].*finite"):
        planner.plan_batch(starts, goals, "free", progress=planned.append)
    with pytest.raises(PlannerError, match="nowhere"):
        planner.plan_batch(starts[:0], goals[:0], "nowhere")
    assert not planned
    assert planner.plan_batch(starts[:0], goals[:0], "free") == []


def test_a_graphs_configurations_cannot_be_written_to(planner) -> None:
    with pytest.raises(ValueError, match="read-only"):
        planner.nodes("level_cup")[0] = 0.0


def test_a_graph_needs_a_reference(planner) -> None:
    with pytest.raises(PlannerError, match="reference"):
        planner.prepare(Constraint([0, 0, 0, 1, 1, 0]))


def test_standing_still_is_certified_too() -> None:
    """An end that satisfies the planner, but not a stricter judge, gives no path."""
    given = packaged_bundle()
    strict = replace(given, judge=given.judge.model_copy(update={"violation_tolerance": 1e-6}))
    start = pairs_of("level_cup", 1, seed=4)[0][0]
    axis = manifold_of(packaged_planner(), "level_cup").jacobian(start)[3:5]
    off = start + 5e-5 * axis[0] / np.square(axis[0]).sum()
    with Planner(strict, "a strict judge") as own:
        path = own.plan(off, off, "level_cup")
        assert path.status == "not_found"
        assert own.plan(start, start, "level_cup").status == "solved"


@pytest.mark.parametrize("scale", ["velocity_scale", "acceleration_scale"])
def test_what_only_rounding_tells_apart_keeps_the_pace_as_well(planner, scale) -> None:
    start = pairs_of("free", 1, seed=3)[0][0]
    path = planner.plan(start, start + 3e-8, "free", **{scale: 1e-6})
    assert path.status == "solved", path.explanation
    pace, (step,), duration = path.asked.pace, np.diff(path.joints, axis=0), path.times[-1]
    assert (np.abs(step) / duration <= pace.velocity).all()
    assert (2.0 * np.abs(step) / duration**2 <= pace.acceleration).all()
    assert planner.plan(start, start + 3e-8, "free").times[-1] == 0.001


def test_a_goal_a_little_beyond_a_limit_is_refused_as_any_other_is(planner) -> None:
    """Right at the start, too; and another goal is taken then."""
    start, goal = pairs_of("free", 1, seed=3)[0]
    start[0] = planner.robot.upper[0]
    beyond = start + 5e-8 * np.eye(6)[0]
    path = planner.plan(start, beyond, "free")
    assert path.status == "out_of_limits", path.explanation
    assert "joint1 of the goal is 3.50000005 rad" in path.explanation
    other = planner.plan(start, [beyond, goal], "free")
    assert other.status == "solved", other.explanation
    np.testing.assert_array_equal(other.goal, goal)


def test_paths_are_equal_as_objects_only() -> None:
    first, second = solved("level_cup")[:2]
    assert first == first
    assert first != second
    assert len({first, second}) == 2


# candidates


def task_of(planner: Planner, name: str) -> Task:
    return planner._preparation.task(planner.constraints[name])


def test_rows_are_so_close_that_lines_between_them_keep_the_constraint(planner) -> None:
    task = task_of(planner, "level_cup")
    counts = []
    start, goal = pairs_of("level_cup", 1, seed=1)[0]
    line = np.linspace(0.0, 1.0, 17)[:, None] * (goal - start) + start
    candidate = refined(task, "straight", line)
    for allowed in (1e-3, 1e-4, 1e-5):
        rows = rows_of(candidate, allowed)
        assert rows[0].tobytes() == candidate.points[0].tobytes()
        assert rows[-1].tobytes() == candidate.points[-1].tobytes()
        # they go along the curve, never back
        steps = np.diff(rows, axis=0)
        cosines = (steps[1:] * steps[:-1]).sum(axis=1)
        cosines /= np.linalg.norm(steps[1:], axis=1) * np.linalg.norm(steps[:-1], axis=1)
        assert cosines.min() > 0.9
        between = np.linspace(0.0, 1.0, 9)[:, None, None] * np.diff(rows, axis=0) + rows[:-1]
        assert task.manifold.violation(between).max() <= allowed
        counts.append(len(rows))
    assert counts[0] <= counts[1] < counts[2]


def test_curves_of_any_source_are_candidates_and_broken_ones_are_not(planner) -> None:
    task = task_of(planner, "level_cup")
    share = np.linspace(0.0, 1.0, task.settings.segments + 1)[:, None]
    lines = ((1.0 - share) * q + share * other for q, other in pairs_of("level_cup", 9, seed=1))
    line = next(q for q in lines if refined(task, "policy", q, refine=False) is not None)
    way_round = line + np.array([2.0, 0, 0, 0, 0, 0]) * np.sin(np.pi * share)
    jumps = line + np.array([0, 0, 0, 0, 0, 4.0]) * (share > 0.5) * (share < 1.0)
    for broken in (jumps, np.full_like(line, np.nan)):
        assert refined(task, "policy", broken, refine=False) is None
    best, worst = (refined(task, "policy", nodes, refine=False) for nodes in (line, way_round))
    assert best.source == worst.source == "policy"
    assert best.length < 1.1 * np.linalg.norm(np.diff(best.points, axis=0), axis=1).sum()
    assert worst.length > best.length + 0.5


def test_without_parts_that_propose_curves_none_is_found(planner) -> None:
    only = Parts(straight=False, graph=False, refinement=False, tree=False)
    ends = pairs_of("level_cup", 1, seed=1)[0]
    proposed = candidates(task_of(planner, "level_cup"), *ends, only)
    (found,) = (own for own in proposed if own is not None)
    assert isinstance(found, Answer)
    assert found.status == "not_found"


# budgets and obstacles


def around(planner: Planner, name: str, seed: int) -> tuple[Planner, np.ndarray, np.ndarray]:
    """The same planner with a sphere on the way of a query that its graphs know nothing of."""
    for start, goal in pairs_of(name, 8, seed=seed):
        free = planner.plan(start, goal, name)
        if free.status != "solved" or free.length_rad < 3.0:
            continue
        middle = free.at(0.5)
        x, y, z = map(float, planner.scene.robot.forward(middle)[0])
        workcell = planner.bundle.workcell.including(Sphere("ball", (x, y, z), 0.1))
        other = Planner(replace(planner.bundle, workcell=workcell), "with a sphere")
        with other.scene.world() as world:
            if (
                world.is_free(start)
                and world.is_free(goal)
                and world.first_collision(free.joints) is not None
            ):
                return other, start, goal
        other.close()
    raise AssertionError("no query leaves room for a sphere")


@pytest.mark.parametrize("name", ["free", "level_cup", "slide"])
def test_a_sphere_that_no_graph_knows_is_gone_round(planner, name) -> None:
    other, start, goal = around(planner, name, seed=11)
    with other:
        path = other.plan(start, goal, name)
        assert path.status == "solved", path.explanation
        assert path.certificate is not None
        assert path.certificate.valid
        alone = other.plan(start, goal, name, parts=Parts(straight=False, graph=False))
        assert (alone.status, alone.source) == ("solved", "tree"), alone.explanation


def test_a_budget_makes_paths_no_longer_and_is_kept_roughly(planner) -> None:
    for start, goal in pairs_of("tool_down", 3, seed=12):
        first = planner.plan(start, goal, "tool_down")
        better = planner.plan(start, goal, "tool_down", budget_s=0.2)
        assert first.status == better.status == "solved"
        assert better.length_rad <= first.length_rad
        # no curve is begun that may end too late, going by how long one took before
        assert better.planning_time_s >= 0.1
        assert better.certificate is not None
        assert better.certificate.valid


def test_no_curve_is_begun_that_would_end_after_the_budget() -> None:
    """Curves that all take 0.1 s: two fit into 0.28 s."""
    begun = []

    class Slow(SearchMethod):
        def improvements(self, *_: object) -> Iterator[None]:
            while True:
                begun.append(time.perf_counter())
                time.sleep(0.1)
                yield None

    start, goal = pairs_of("free", 1, seed=1)[0]
    with Planner(packaged_planner().bundle, "slow improvements", Slow()) as slow:
        slow.plan(start, goal, "free")
        path = slow.plan(start, goal, "free", budget_s=0.28)
    assert path.status == "solved"
    assert 1 <= len(begun) <= 2
    assert path.planning_time_s >= 0.1


def test_without_parts_that_propose_curves_a_budget_is_not_waited_for(planner) -> None:
    start, goal = pairs_of("free", 1, seed=1)[0]
    only = Parts(graph=False, tree=False)
    assert planner.plan(start, goal, "free", parts=only, budget_s=1000.0).status == "solved"


class Nothing(SearchMethod):
    """Whose first candidates come to nothing."""

    status: Status = "not_found"

    def candidates(self, *_: object) -> Iterator[Answer]:
        yield Answer(self.status)


def answering(method: SearchMethod) -> Planner:
    return Planner(packaged_planner().bundle, "a planner of tests", method)


def test_what_is_not_found_at_once_is_looked_for_while_the_budget_lasts() -> None:
    """A budget that were waited for would be longer than a test may take."""
    start, goal = pairs_of("level_cup", 1, seed=1)[0]
    others = [far for far, _ in pairs_of("level_cup", 3, seed=2)]
    with answering(Nothing()) as patient:
        assert patient.plan(start, goal, "level_cup").status == "not_found"
        path = patient.plan(start, goal, "level_cup", budget_s=2.0)
        assert (path.status, path.source) == ("solved", "tree"), path.explanation
        assert path.certificate is not None
        assert path.certificate.valid
        path = patient.plan(start, [goal, *others], "level_cup", budget_s=2.0)
        assert path.status == "solved", path.explanation
        assert "found to one of" in path.explanation
        above = GoalRegion(Pose(*patient.robot.forward(goal)), free=["yaw"])
        path = patient.plan(start, above, "level_cup", budget_s=2.0)
        assert path.status == "solved", path.explanation
        few = patient.plan(start, goal, "level_cup", parts=Parts(tree=False), budget_s=1000.0)
        assert few.status == "not_found"
    apart = Nothing()
    apart.status = "not_connected"
    with answering(apart) as patient:
        assert patient.plan(start, goal, "level_cup", budget_s=1000.0).status == "not_connected"


def test_no_try_is_begun_that_would_end_after_the_budget() -> None:
    """Tries that all take 0.1 s, of curves that are no paths: two fit into 0.28 s."""
    begun = []

    class Vain(Nothing):
        def further(self, *_: object) -> Iterator[Iterator[Candidate]]:
            while True:
                begun.append(time.perf_counter())
                yield self.astray()

        def astray(self) -> Iterator[Candidate]:
            for _ in range(2):
                time.sleep(0.05)
                yield replace(own, points=own.points + 0.1, nodes=own.nodes + 0.1)

    start, goal = pairs_of("free", 1, seed=1)[0]
    with answering(Vain()) as vain:
        task = vain._preparation.task(vain.constraints["free"])
        own = refined(task, "straight", np.linspace(start, goal, task.settings.segments + 1))
        path = vain.plan(start, goal, "free", budget_s=0.28)
    assert path.status == "not_found"
    assert "the straight curve fails" in path.explanation
    assert 1 <= len(begun) <= 2


@pytest.mark.parametrize("budget", [0.0, -1.0, float("nan"), float("inf")])
def test_a_budget_is_a_positive_number(planner, budget) -> None:
    start, goal = pairs_of("free", 1, seed=1)[0]
    with pytest.raises(PlannerError, match="budget_s"):
        planner.plan(start, goal, "free", budget_s=budget)
