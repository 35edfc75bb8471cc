"""The planner of an arm that moves: from a velocity, to a stop, and round what is new."""

import json
from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.interpolate import BPoly, CubicHermiteSpline

from constraint_geodesics import Constraint, GoalRegion, Planner, Pose, Sphere, Trajectory, bundle
from constraint_geodesics.answering import TURNING
from constraint_geodesics.certification import certifier
from constraint_geodesics.geometry.braking import State, going_on
from constraint_geodesics.planner import PlannerError
from constraint_geodesics.trajectory import read_trajectory
from tests.planner_fixtures import packaged_planner, pairs_of, turning

NAME = "level_cup"
DENSE_S = 0.002


@cache
def planned(count: int) -> list[Trajectory]:
    paths = [packaged_planner().plan(a, b, NAME) for a, b in pairs_of(NAME, count, 11)]
    return [path for path in paths if path.status == "solved"]


def assert_goes_on(answer: Trajectory, path: Trajectory, at_s: float) -> None:
    """Certified anew from the state of the path at a time, its velocities and accelerations within
    the limits as they are written down here.
    """
    planner, state = packaged_planner(), path.state(at_s)
    np.testing.assert_array_equal(answer.joints[0], state.configuration)
    moving = answer.start_velocity
    np.testing.assert_array_equal(np.zeros(6) if moving is None else moving, state.velocity)
    goal = path.joints[-1] if answer.status == "solved" else None
    about = (answer.joints, path.constraint, state.configuration, goal, answer.times)
    certificate = planner._certifier.certify(*about, start_velocity=moving)
    assert certificate.valid, certificate.violation
    assert answer.certificate is not None
    assert answer.certificate.valid
    dt = np.diff(answer.times)[:, None]
    lines = np.diff(answer.joints, axis=0) / dt
    lasting = np.concatenate([[[0.0]], dt, [[0.0]]])
    speeds = np.vstack([state.velocity, lines, np.zeros(6)])
    accelerations = np.diff(speeds, axis=0) / (0.5 * (lasting[1:] + lasting[:-1]))
    assert (np.abs(lines) <= planner.robot.velocity * (1 + 1e-9)).all()
    assert (
        np.abs(accelerations)
        <= np.array(planner._certifier.limits.acceleration_rad_s2) * (1 + 1e-6)
    ).all()


def on_the_way(path: Trajectory, at_s: float, rng: np.random.Generator) -> Sphere | None:
    """A sphere that the rest of a path runs into after the arm could stop, clear of its goal."""
    planner, stop = packaged_planner(), path.stop(at_s)
    checks, earliest = planner._certifier.collisions, at_s + 1.05 * stop.times[-1]
    for _ in range(20 if earliest < path.times[-1] else 0):
        place = path.state(rng.uniform(earliest, path.times[-1])).configuration
        middle = planner.robot.skeleton(place)[3:][rng.integers(5)]
        ball = Sphere("sudden", tuple(middle), rng.uniform(0.05, 0.08))
        planner.scene.add(ball)
        try:
            clear = checks.is_free(path.joints[-1]) and checks.is_clear(stop.joints)
            if clear and not checks.is_clear(path.joints):
                return ball
        finally:
            planner.scene.remove("sudden")
    return None


def blocked() -> Iterator[tuple[Trajectory, float, Sphere]]:
    """Paths, each with a time and what comes then into its way."""
    for path in planned(20):
        at = 0.25 * path.times[-1]
        ball = on_the_way(path, at, np.random.default_rng(1))
        if ball is not None:
            yield path, at, ball


def touched(answer: Trajectory, planner: Planner) -> int:
    """Configurations of the motion, every few ms and in its turn into the first line, that a fresh
    world finds in touch.
    """
    at = np.arange(0.0, answer.times[-1], DENSE_S)
    rows = np.stack([np.interp(at, answer.times, q) for q in answer.joints.T], axis=1)
    turn = turning(answer.joints, answer.times, answer.start_velocity)
    with planner.scene.world() as world:
        return int((~world.free(np.vstack([rows, answer.joints, turn]))).sum())


# From a velocity


@pytest.mark.parametrize("name", ["level_cup", "free", "slide", "level_cup_relaxed"])
def test_a_path_goes_on_from_where_another_one_is(name):
    """To its own goal it takes no longer than the rest of the path, and to others it gets, too."""
    planner, rng, longer = packaged_planner(), np.random.default_rng(0), []
    pairs = pairs_of(name, 8, 5)
    for k, (start, goal) in enumerate(pairs):
        path = planner.plan(start, goal, name)
        if path.status != "solved":
            continue
        at = rng.uniform(0.1, 0.9) * path.times[-1]
        state = path.state(at)
        same = planner.plan(state.configuration, goal, name, start_velocity=state.velocity)
        assert same.status == "solved", same.explanation
        longer.append(same.times[-1] / (path.times[-1] - at))
        other = pairs[k - 1][1]
        turned = planner.plan(state.configuration, other, name, start_velocity=state.velocity)
        for answer, end in ((same, goal), (turned, other)):
            if answer.status == "solved":
                np.testing.assert_array_equal(answer.start_velocity, state.velocity)
                certificate = planner._certifier.certify(
                    answer.joints,
                    answer.constraint,
                    state.configuration,
                    end,
                    answer.times,
                    start_velocity=state.velocity,
                )
                assert certificate.valid, certificate.violation
    assert len(longer) >= 5
    assert np.median(longer) < 1.02


def beside_its_lines(path: Trajectory) -> float:
    """How far a controller that follows the message by cubics gets from the waypoints' lines."""
    points = path.to_joint_trajectory()["points"]
    places, velocities = (np.array([p[k] for p in points]) for k in ("positions", "velocities"))
    spline, worst = CubicHermiteSpline(path.times, places, velocities), 0.0
    for first, last in zip(path.times[:-1], path.times[1:], strict=True):
        at = spline(np.linspace(first, last, 20))
        away = np.full(len(at), np.inf)
        near = np.flatnonzero(np.abs(path.times[:-1] - first) < 0.1)
        for place, line in zip(places[near], np.diff(places, axis=0)[near], strict=True):
            share = np.clip((at - place) @ line / (line @ line), 0.0, 1.0)
            away = np.minimum(away, np.linalg.norm(at - place - share[:, None] * line, axis=1))
        worst = max(worst, float(away.max()))
    return worst


@pytest.mark.parametrize("name", ["level_cup", "free"])
def test_an_arm_that_turns_back_comes_to_rest_first(name):
    """No spline through the message leads beyond the corner."""
    planner, seen = packaged_planner(), 0
    for start, goal in pairs_of(name, 4, 5):
        path = planner.plan(start, goal, name)
        state = path.state(0.3 * path.times[-1])
        back = planner.plan(state.configuration, start, name, start_velocity=state.velocity)
        if back.status != "solved":
            continue
        seen += 1
        lines = np.diff(back.joints, axis=0)
        lines /= np.linalg.norm(lines, axis=1)[:, None]
        corner = 1 + int(np.argmin((lines[1:] * lines[:-1]).sum(axis=1)))
        assert lines[corner] @ lines[corner - 1] < -0.5
        assert np.linalg.norm(back.state(back.times[corner]).velocity) < 0.02
        assert beside_its_lines(back) < 1e-3
        for soon in np.linspace(-0.02, 0.08, 30):
            stop = back.stop(back.times[corner] + soon)
            assert stop.status == "stopped"
            assert stop.certificate is None or stop.certificate.valid
    assert seen >= 3


def test_of_several_goals_an_arm_that_must_stop_first_reaches_the_nearest():
    """The end of its path is in no region where it is a configuration that was asked for."""
    planner, (start, goal) = packaged_planner(), pairs_of("free", 1, 5)[0]
    path = planner.plan(start, goal, "free")
    at = 0.3 * path.times[-1]
    state, behind = path.state(at), path.state(at - 0.15).configuration
    region = GoalRegion(Pose(*planner.robot.forward(start)), tolerance=(0.01,) * 3 + (0.0,) * 3)
    wanted = [behind, region]
    back = planner.plan(state.configuration, wanted, "free", start_velocity=state.velocity)
    assert back.status == "solved", back.explanation
    np.testing.assert_array_equal(back.joints[-1], behind)
    assert back.asked.regions == (region.region,)
    assert len(back.statistics.looked_at) > 1


def test_rows_are_added_on_the_lines_beside_a_corner_alone():
    """And none where a line is short, or there is none to go on."""
    stop, onward = np.array([[0.0, 0.0], [0.1, 0.0]]), np.array([[0.1, 0.0], [0.1, 0.2]])
    whole = going_on(stop, onward)
    added = [[0.1 - 1e-5, 0.0], [0.1, 0.0], [0.1, 1e-5], [0.1, 0.1]]
    np.testing.assert_allclose(whole, [stop[0], *added, onward[1]], atol=1e-15)
    np.testing.assert_array_equal(going_on(stop, stop[[1, 1]])[-2:], stop[[1, 1]])
    short = np.array([[0.1, 0.0], [0.1, 1e-5]])
    np.testing.assert_array_equal(going_on(stop, short)[2:], short)


def test_a_start_at_rest_is_planned_as_without_a_velocity():
    planner = packaged_planner()
    for start, goal in pairs_of(NAME, 5, 2):
        path = planner.plan(start, goal, NAME)
        resting = planner.plan(start, goal, NAME, start_velocity=np.zeros(6))
        np.testing.assert_array_equal(resting.joints, path.joints)
        np.testing.assert_array_equal(resting.times, path.times)
        assert resting.start_velocity is None
        assert path.start_velocity is None


def test_velocities_that_no_path_begins_with_are_refused():
    planner, path = packaged_planner(), planned(10)[0]
    state, goal = path.state(0.5 * path.times[-1]), path.joints[-1]

    def asked(velocity, scale=1.0, start=state.configuration):
        return planner.plan(start, goal, NAME, start_velocity=velocity, velocity_scale=scale)

    fast = asked(state.velocity, scale=0.01)
    assert fast.status == "out_of_limits"
    assert "is its limit" in fast.explanation
    normal = planner.plan(state.configuration, goal, NAME)
    jacobian = (
        packaged_planner()
        ._preparation.task(normal.constraint)
        .manifold.jacobian(state.configuration)
    )
    off = asked(0.5 * state.velocity + 0.1 * jacobian[3])
    assert off.status == "start_violates"
    assert "leads off level_cup at" in off.explanation
    free = planner.constraints["free"]
    close = np.clip(state.configuration, planner.robot.lower, planner.robot.upper)
    close[0] = planner.robot.upper[0] - 0.01
    out = planner.plan(close, goal, free, start_velocity=[1.0, 0, 0, 0, 0, 0])
    assert out.status == "out_of_limits", out.explanation
    assert "can't stop within 0.01" in out.explanation
    most = packaged_planner()._certifier.limits.acceleration_rad_s2[0]
    just = np.sqrt(2.0 * most * (0.01 + 1e-7))  # the certificate allows no more than rounding
    out = planner.plan(close, goal, free, start_velocity=[just, 0, 0, 0, 0, 0])
    assert out.status == "out_of_limits", out.explanation
    for wrong, message in (([1.0] * 5, "start_velocity has shape"), ([np.nan] * 6, "not finite")):
        with pytest.raises(PlannerError, match=message):
            asked(wrong)


# State and stop


def test_a_state_is_that_of_the_trajectory_as_it_is_sent():
    """At a waypoint the velocity is that of the ROS message, and between them it changes evenly."""
    path = planned(10)[0]
    points = path.to_joint_trajectory()["points"]
    for k in range(0, len(points), 7):
        state = path.state(path.times[k])
        np.testing.assert_array_equal(state.configuration, path.joints[k])
        np.testing.assert_allclose(state.velocity, points[k]["velocities"], atol=1e-9)
    at = np.linspace(0.0, path.times[-1], 4000)
    velocities = np.array([path.state(t).velocity for t in at])
    most = np.abs(np.diff(velocities, axis=0)).max() / (at[1] - at[0])
    assert most <= max(packaged_planner()._certifier.limits.acceleration_rad_s2) * (1 + 1e-6)
    # a controller that follows the message by splines, as ROS's does, is there as well
    given = [[p[k] for p in points] for k in ("positions", "velocities", "accelerations")]
    spline = BPoly.from_derivatives(path.times, np.array(given).transpose(1, 0, 2))
    places = np.array([path.state(t).configuration for t in at])
    assert np.abs(spline(at) - places).max() < 1e-3
    for wrong in (-1e-9, path.times[-1] + 1e-9, np.nan, "soon"):
        with pytest.raises(PlannerError, match="at_s = .*must be a time from 0 to"):
            path.state(wrong)


def test_who_alters_a_state_leaves_the_path_as_it_was_certified():
    path = planned(10)[0]
    joints = path.joints.copy()
    for handed in (
        *(path.state(at).configuration for at in (0.0, path.times[3], path.times[-1])),
        path.goal,
        path.wanted,
    ):
        handed += 0.1
    np.testing.assert_array_equal(path.joints, joints)


def test_a_stop_is_on_the_path_and_as_short_as_the_limits_allow():
    planner, rng, proven = packaged_planner(), np.random.default_rng(0), 0
    for path in planned(10):
        for share in rng.uniform(0.02, 0.98, 6):
            at = share * path.times[-1]
            stop, state = path.stop(at), path.state(at)
            assert stop.status == "stopped"
            assert_goes_on(stop if stop.certificate else certified(stop), path, at)
            if stop.certificate is None:
                assert stop.explanation.endswith("drawn anew, is not certified")
                continue
            assert stop.explanation.endswith("s on the path")
            proven += 1
            assert (stop.joints[1:-1] == path.joints[state.row :][: len(stop.joints) - 2]).all()
            assert too_short(stop, path, state)
    assert proven >= 30
    ended = planned(10)[0]
    still = ended.stop(ended.times[-1])
    assert still.certificate is not None
    np.testing.assert_array_equal(still.joints, ended.joints[[-1, -1]])
    assert planner.replan(ended, ended.times[-1]).status == "solved"


HARD_TO_STOP = (
    (
        "level_cup",
        [2.781109095, 1.764213681, -3.157669067, -0.888130009, -0.27680096, -0.701730013],
        [2.953006506, -1.397238016, -3.160125494, 0.764315724, -0.213207021, 0.817911446],
        0.44948411054649784,
    ),
    (
        "slide",
        [-1.073732018, 0.05979722, -0.519874692, -3.44701314, 1.129300594, 1.704719663],
        [-2.84348917, 0.606778204, -0.553711057, -1.025242805, -1.598357797, -1.616154313],
        0.49743746729331023,
    ),
)
"""Moments of motions whose waypoints, drawn anew from there, leave no stop: a joint is next to its
limit, or the velocity turns off the line.
"""


@pytest.mark.parametrize(("name", "start", "goal", "share"), HARD_TO_STOP)
def test_it_can_stop_where_no_line_of_the_path_lets_it(name, start, goal, share):
    planner = packaged_planner()
    start, goal = (planner.project(end, name).configuration for end in (start, goal))
    path = planner.plan(start, goal, name)
    assert path.status == "solved"
    stop = path.stop(share * path.times[-1])
    assert 0.0 < stop.times[-1] < 0.5
    violation = certified(stop).certificate.violation
    assert violation is None or violation.kind == "constraint_between_rows"


def too_short(stop: Trajectory, path: Trajectory, state: State) -> bool:
    """Whether no stop ends on a line of the path a little earlier."""
    if not state.velocity.any():
        return True
    row = state.row + len(stop.joints) - 2
    before = path.joints[row - 1] if row > state.row else state.configuration
    line, used = path.joints[row] - before, stop.joints[-1] - stop.joints[-2]
    share = np.linalg.norm(used) / np.linalg.norm(line) - 0.02
    ends = [] if share <= 0.0 else [before + share * line]
    rows = np.vstack([stop.joints[:-1], *ends])
    return len(rows) < 2 or path.asked.pace.hardest(rows, state.velocity) is None


def certified(stop: Trajectory) -> Trajectory:
    """With a certificate of the scene as it is, in place of none."""
    found = packaged_planner()._certifier.certify(
        stop.joints, stop.constraint, times=stop.times, start_velocity=stop.start_velocity
    )
    return replace(stop, certificate=found)


def test_files_and_messages_say_how_a_motion_begins(tmp_path):
    planner, path = packaged_planner(), planned(10)[0]
    rest = planner.replan(path, 0.4 * path.times[-1])
    rest.save(tmp_path / "rest.csv")
    read = read_trajectory(tmp_path / "rest.csv")
    np.testing.assert_array_equal(read.start_velocity, rest.start_velocity)
    certificate = planner.check(tmp_path / "rest.csv")
    assert certificate.valid, certificate.violation
    np.testing.assert_array_equal(certificate.start_velocity, rest.start_velocity)
    text = (tmp_path / "rest.csv").read_text()
    resting = "".join(line for line in text.splitlines(True) if "start_velocity" not in line)
    (tmp_path / "resting.csv").write_text(resting)
    assert planner.check(tmp_path / "resting.csv").violation.kind == "acceleration"
    (velocity,) = (line for line in text.splitlines() if "start_velocity" in line)
    wrong = "not a velocity of 6 joints"
    for line, said in (
        ("# start_velocity: [1, 2]", wrong),
        ("# start_velocity: [true, 0, 0, 0, 0, 0]", wrong),
        ('# start_velocity: ["1", 0, 0, 0, 0, 0]', wrong),
        (f"# start_velocity: [1{'0' * 400}, 0, 0, 0, 0, 0]", wrong),
        (f"# start_velocity: {'[' * 100_000}", wrong),
        (
            f"{velocity}\n#start_velocity:{velocity.split(':')[1]}",
            "line 2: a second start_velocity",
        ),
    ):
        (tmp_path / "wrong.csv").write_text(f"{line}\n{resting}")
        with pytest.raises(PlannerError, match=said):
            planner.check(tmp_path / "wrong.csv")
    (tmp_path / "close.csv").write_text(
        f"{velocity.replace('# ', '#').replace(': ', ':')}\n{resting}"
    )
    assert planner.check(tmp_path / "close.csv").start_velocity == certificate.start_velocity
    rows = [line.partition(",")[2] for line in resting.splitlines() if line[0] != "#"]
    (tmp_path / "untimed.csv").write_text("\n".join([velocity, *rows]))
    with pytest.raises(PlannerError, match="goes with times"):
        planner.check(tmp_path / "untimed.csv", "level_cup")
    point = rest.to_joint_trajectory()["points"][0]
    np.testing.assert_allclose(point["velocities"], rest.start_velocity)
    json.dumps(rest.certificate.summary())


# Replanning


def test_what_is_left_is_the_answer_where_nothing_changed():
    planner, rng = packaged_planner(), np.random.default_rng(1)
    for path in planned(10):
        for share in rng.uniform(0.0, 1.0, 4):
            at = share * path.times[-1]
            rest = planner.replan(path, at)
            assert rest.status == "solved", rest.explanation
            assert_goes_on(rest, path, at)
            left, line = path.times[-1] - at, np.diff(path.times).max()
            assert rest.times[-1] <= 1.02 * left + line


def test_it_goes_round_what_appears_or_stops():
    """Every answer is certified from the state of the arm; a fresh world finds no touch on some."""
    planner, rng, ends, looked_at = packaged_planner(), np.random.default_rng(3), [], 0
    for path in planned(40):
        at = 0.25 * path.times[-1]
        ball = on_the_way(path, at, rng)
        if ball is None:
            continue
        planner.scene.add(ball)
        try:
            answer = planner.replan(path, at)
            assert answer.status in ("solved", "stopped"), answer.explanation
            assert answer.scene == planner.scene.now
            assert_goes_on(answer, path, at)
            ends.append(answer.status)
            if looked_at < 6:
                assert touched(answer, planner) == 0
                looked_at += 1
        finally:
            planner.scene.remove("sudden")
        if answer.status == "stopped":  # what was wanted is reached once the way is free
            onward = planner.replan(answer, answer.times[-1])
            assert onward.status == "solved", onward.explanation
            np.testing.assert_array_equal(onward.joints[-1], path.joints[-1])
    assert len(ends) >= 15
    assert np.mean([end == "solved" for end in ends]) > 0.8


def test_a_stop_that_touches_something_says_so_and_is_there():
    """A sphere right ahead: the hardest stop comes with what it breaks, and can be sent."""
    planner, seen = packaged_planner(), 0
    for path in planned(40):
        at = 0.5 * path.times[-1]
        stop = path.stop(at)
        if len(stop.joints) < 6:
            continue
        middle = planner.robot.skeleton(stop.joints[-1])[-1]
        planner.scene.add(Sphere("sudden", tuple(middle), 0.05))
        try:
            free = planner._certifier.collisions.is_free(path.state(at).configuration)
            answer = planner.replan(path, at) if free else None
        finally:
            planner.scene.remove("sudden")
        if answer is None or answer.status in ("solved", "stopped"):
            continue
        seen += 1
        assert answer.status == "in_collision"
        assert answer.certificate is not None
        assert answer.certificate.violation.kind in ("workcell_collision", "clearance")
        assert answer.certificate.violation.message in answer.explanation
        np.testing.assert_array_equal(answer.start_velocity, path.state(at).velocity)
        assert len(answer.to_joint_trajectory()["points"]) == len(answer.joints) > 2
        again = answer.stop(0.5 * answer.times[-1])  # on what touches nothing was proven
        if again.certificate is not None:
            assert again.certificate.violation.kind == answer.certificate.violation.kind
            assert again.certificate.violation.row is None
            assert again.status == "in_collision"
            assert answer.certificate.violation.message in again.explanation
        if seen == 3:
            break
    assert seen == 3


def test_a_goal_that_is_touched_stops_the_arm_at_once_and_is_named():
    planner, path = packaged_planner(), planned(10)[0]
    hand = Sphere("hand", tuple(planner.robot.skeleton(path.joints[-1])[-1]), 0.05)
    planner.scene.add(hand)
    try:
        answer = planner.replan(path, 0.3 * path.times[-1])
        assert answer.status == "stopped"
        assert "no path to the goal: the goal touches" in answer.explanation
        standing = planner.replan(path, path.times[-1])
        assert standing.status == "in_collision"
        assert standing.certificate is not None
        assert standing.certificate.violation is not None
        assert "hand" in standing.certificate.violation.message
        assert len(standing.joints) == 2
    finally:
        planner.scene.remove("hand")


def test_after_its_time_no_other_path_is_tried():
    planner = packaged_planner()
    path, at, ball = next(blocked())
    planner.scene.add(ball)
    try:
        answer = planner.replan(path, at, limit_s=1e-9)
    finally:
        planner.scene.remove("sudden")
    assert answer.status == "stopped"
    assert "1e-09 s are over" in answer.explanation
    for wrong in (0.0, -1.0, np.inf, "soon"):
        with pytest.raises(PlannerError, match="limit_s = .*positive number of seconds"):
            planner.replan(path, at, limit_s=wrong)
    with pytest.raises(PlannerError, match="replan takes a trajectory, not a list"):
        planner.replan([0.0] * 6, 0.0)


def test_a_roadmap_that_has_to_be_made_is_not_waited_for():
    """Where a shape of the first ones is gone there is none."""
    with Planner.load(bundle.PACKAGED) as planner:
        planner.scene.remove("table")
        for path, at, ball in blocked():
            planner.scene.add(ball)
            planner.replan(path, at, limit_s=60.0)
            assert not planner._preparation._roadmaps
            planner.replan(path, at)
            planner.scene.remove("sudden")
            if planner._preparation._roadmaps:
                break
        else:
            pytest.fail("the roadmap was of no use")


def test_scales_stay_and_other_robots_are_refused():
    planner = packaged_planner()
    start, goal = pairs_of(NAME, 1, 11)[0]
    slow = planner.plan(start, goal, NAME, velocity_scale=0.3, acceleration_scale=0.4)
    rest = planner.replan(slow, 0.5 * slow.times[-1])
    assert rest.status == "solved"
    lines = np.diff(rest.joints, axis=0) / np.diff(rest.times)[:, None]
    assert (np.abs(lines) <= 0.3 * planner.robot.velocity * (1 + 1e-9)).all()
    for wrong in (-0.1, slow.times[-1] + 0.1, np.inf):
        with pytest.raises(PlannerError, match="at_s = .*must be a time from 0 to"):
            planner.replan(slow, wrong)
    with (
        Planner.from_urdf("kuka_iiwa/model.urdf", "lbr_iiwa_link_7") as other,
        pytest.raises(PlannerError, match="of another robot"),
    ):
        other.replan(slow, 0.0)


def test_a_moment_before_the_end_is_answered_too() -> None:
    """However a clock rounds it."""
    planner = packaged_planner()
    for path in planned(6):
        end = float(path.times[-1])
        for before in (1e-9, 1e-6, 1e-4, 1e-3):
            stop = path.stop(end - before)
            np.testing.assert_allclose(stop.joints[-1], path.joints[-1], atol=1e-4)
            answer = planner.replan(path, end - before)
            assert answer.status in ("solved", "stopped")
            np.testing.assert_allclose(answer.joints[-1], path.joints[-1], atol=1e-4)


def test_a_velocity_in_the_middle_of_a_narrow_tolerance_leads_off() -> None:
    """Where the constraint is held as the start has it, nothing is off yet."""
    start, goal = pairs_of("free", 1, seed=3)[0]
    level = Constraint((0, 0, 1, 0, 0, 0), tolerance=(0, 0, 1e-4, 0, 0, 0))
    answer = packaged_planner().plan(start, goal, level, start_velocity=[0, 0.3, 0, 0, 0, 0])
    assert answer.status == "start_violates"
    assert "leads off" in answer.explanation


def test_words_say_by_how_much_the_certifier_lets_a_turn_leave_the_constraint() -> None:
    assert f"leave it by {certifier._LEFT:.0e} ".replace("e-0", "e-") in TURNING
