"""Planners of somebody's URDF, and what a user asks a planner besides a path: configurations of a
pose, the nearest on a constraint, a start that is off, slower motions, ROS's messages.
"""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.goals.region import GoalRegion
from constraint_geodesics.methods import SearchMethod
from constraint_geodesics.planner import SNAP_RAD, Planner, PlannerError
from constraint_geodesics.robot.inverse_kinematics import solutions
from constraint_geodesics.robot.kinematics import RobotError
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.search.preparation import free_configurations
from tests.planner_fixtures import packaged_planner, pairs_of

IIWA = ("kuka_iiwa/model.urdf", "lbr_iiwa_link_7")


@cache
def panda() -> Planner:
    return Planner.from_urdf("franka_panda/panda.urdf", "panda_grasptarget")


def free_pairs(planner: Planner, count: int, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    drawn = planner.robot.sample(8 * count, np.random.default_rng(seed))
    free = drawn[planner._certifier.collisions.free(drawn)][: 2 * count]
    return list(zip(free[::2], free[1::2], strict=True))


def test_paths_of_an_untrained_arm_are_certified_and_pybullet_agrees() -> None:
    planner = panda()
    with planner.scene.world() as world:
        for start, goal in free_pairs(planner, 6, seed=1):
            for wanted in (goal, Pose(*planner.robot.forward(goal))):
                path = planner.plan(start, wanted, "free")
                assert path.status == "solved", path.explanation
                rows = np.linspace(path.joints[:-1], path.joints[1:], 8)
                assert world.free(rows.reshape(-1, 7)).all()


def test_a_level_tool_stays_as_it_starts() -> None:
    planner, solved = panda(), 0
    for start, goal in free_pairs(planner, 8, seed=2):
        pose = Pose(*planner.robot.forward(start))
        level = Constraint((0, 0, 0, 1, 1, 0), reference=pose)
        end = planner.project(goal, level).configuration
        if not planner._certifier.collisions.is_free(end):
            continue
        path = planner.plan(start, end, "level")
        assert path.constraint.key == level.key
        assert path.status == "solved", path.explanation
        tilts = planner.robot.forward(path.joints)[1][:, 2]
        np.testing.assert_allclose(tilts, np.tile(pose.rotation[2], (len(tilts), 1)), atol=1e-4)
        solved += 1
    assert solved >= 3


def test_the_end_of_seven_joints_slides_to_where_the_path_is_shortest() -> None:
    """Against paths to each of many configurations that have the pose."""
    planner = panda()
    for start, goal in free_pairs(planner, 4, seed=3):
        pose = Pose(*planner.robot.forward(goal))
        path = planner.plan(start, pose, "free")
        assert path.status == "solved", path.explanation
        others = planner.ik(pose)
        assert 16 <= len(others) <= 64
        lengths = [planner.plan(start, q, "free").length_rad for q in others]
        assert path.length_rad <= 1.02 * np.nanmin(lengths)


def test_a_pose_is_reached_where_all_the_nearest_configurations_touch_something() -> None:
    """A ball stands where the elbow would be: others of the family go round it."""
    solved = 0
    with Planner.from_urdf(*IIWA) as alone:
        for start, goal in free_pairs(alone, 6, seed=9):
            pose = Pose(*alone.robot.forward(goal))
            nearest = alone.plan(start, pose, "free")
            elbow = alone.robot.skeleton(nearest.goal)[4]
            ball = Sphere("ball", tuple(elbow.tolist()), 0.1)
            with Planner.from_urdf(*IIWA, workcell=[ball]) as planner:
                if not planner._certifier.collisions.is_free(start) or not len(planner.ik(pose)):
                    continue
                path = planner.plan(start, pose, "free")
                assert path.status == "solved", path.explanation
                assert np.abs(path.goal - nearest.goal).max() > 0.05
                solved += 1
    assert solved >= 3


def test_the_workcell_of_an_untrained_arm_is_kept_clear() -> None:
    table = Box("table", (0.5, 0.0, 0.0), (0.6, 1.0, 0.2))
    with Planner.from_urdf(*IIWA) as alone, Planner.from_urdf(*IIWA, workcell=[table]) as planner:
        drawn = alone.robot.sample(200, np.random.default_rng(0))
        drawn = drawn[alone._certifier.collisions.free(drawn)]
        free = planner._certifier.collisions.free(drawn)
        assert 0.3 < free.mean() < 1.0
        (start, _), touching = drawn[free][:2], drawn[~free][0]
        path = planner.plan(start, touching, "free")
        assert path.status == "in_collision"
        assert "the goal touches the workcell" in path.explanation
        assert alone.plan(start, touching, "free").status == "solved"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("franka_panda/panda.urdf", "hand"), "there is no link 'hand'.*panda_grasptarget"),
        (("no.urdf", "hand"), r"no\.urdf: no such URDF"),
    ],
)
def test_what_is_no_arm_is_refused_in_one_line(words, said) -> None:
    with pytest.raises(RobotError, match=said) as error:
        Planner.from_urdf(*words)
    assert "\n" not in str(error.value)


class Elsewhere(SearchMethod):
    """Curves to a configuration beside the goal."""

    def candidates(self, task, start, goal, parts):
        yield from super().candidates(task, start, goal + 0.1, parts)


def test_a_path_to_another_configuration_than_was_asked_is_no_answer() -> None:
    planner = packaged_planner()
    start, goal = pairs_of("free", 1, seed=3)[0]
    with Planner(planner.bundle, "packaged", Elsewhere()) as wrong:
        for wanted in (goal, Pose(*planner.robot.forward(goal))):
            path = wrong.plan(start, wanted, "free")
            assert path.status == "not_found"
            assert "away from the goal" in path.explanation


# configurations of a pose


def test_ik_gives_free_configurations_of_the_pose_the_one_it_was_made_of_among_them() -> None:
    """Freedom by PyBullet's word; what was left out touches something by it."""
    planner = packaged_planner()
    with planner.scene.world() as world:
        for _, goal in pairs_of("free", 8, seed=40):
            pose = Pose(*planner.robot.forward(goal))
            found = planner.ik(pose)
            assert np.abs(found - goal).max(axis=1).min() < 1e-6
            assert world.free(found).all()
            assert (planner.robot.limit_distance(found) >= 0.0).all()
            positions, rotations = planner.robot.forward(found)
            np.testing.assert_allclose(
                positions, np.tile(pose.position, (len(found), 1)), atol=1e-8
            )
            np.testing.assert_allclose(rotations - pose.rotation, 0.0, atol=1e-8)
            every = solutions(planner.robot, pose.position, pose.rotation)
            assert world.free(every).sum() == len(found)


# projections


def test_a_projection_says_what_it_changed() -> None:
    planner, (start, _) = packaged_planner(), pairs_of("slide", 1, seed=41)[0]
    off = start + np.array([0.01, -0.02, 0.01, 0.0, 0.02, 0.0])
    found = planner.project(off, "slide")
    manifold = ConstraintManifold(planner.robot, planner.constraints["slide"])
    assert manifold.violation(found.configuration) < 1e-8
    assert found.distance_rad == pytest.approx(np.linalg.norm(found.configuration - off))
    assert found.distance_rad <= np.linalg.norm(start - off)
    assert found.violation_before == manifold.violation(off) > 1e-3
    with pytest.raises(PlannerError, match="no reference pose"):
        planner.project(off, Constraint((0, 0, 0, 1, 1, 0)))


def test_a_start_that_is_off_is_refused_with_the_nearest_or_moved_on_request() -> None:
    planner, (start, goal) = packaged_planner(), pairs_of("level_cup", 1, seed=1)[0]
    off = start + 0.002
    refused = planner.plan(off, goal, "level_cup")
    nearest = planner.project(off, "level_cup")
    assert refused.status == "start_violates"
    assert f"{nearest.distance_rad:.2g} rad away, keeps it" in refused.explanation
    path = planner.plan(off, goal, "level_cup", snap=True)
    assert path.status == "solved", path.explanation
    np.testing.assert_array_equal(path.joints[0], nearest.configuration)
    assert path.explanation.endswith(f"from a start moved by {nearest.distance_rad:.2g} rad")
    assert path.summary()["snapped_rad"] == nearest.distance_rad
    assert planner.plan(start, goal, "level_cup", snap=True).summary()["snapped_rad"] == 0.0
    assert np.linalg.norm(path.joints[0] - off) <= SNAP_RAD
    far = start + 0.05
    assert planner.project(far, "level_cup").distance_rad > SNAP_RAD
    assert planner.plan(far, goal, "level_cup", snap=True).status == "start_violates"


# motions


def test_slower_motions_use_a_share_of_the_limits() -> None:
    planner, (start, goal) = packaged_planner(), pairs_of("level_cup", 1, seed=1)[0]
    whole = planner.plan(start, goal, "level_cup")
    slow = planner.plan(start, goal, "level_cup", velocity_scale=0.1, acceleration_scale=0.5)
    np.testing.assert_array_equal(slow.joints, whole.joints)
    speed = np.abs(np.diff(slow.joints, axis=0)) / np.diff(slow.times)[:, None]
    share = (speed / planner.robot.velocity).max()
    assert share == pytest.approx(0.1, rel=1e-3)
    assert slow.times[-1] > 2.0 * whole.times[-1]
    for name in ("velocity_scale", "acceleration_scale"):
        for value in (0.0, -0.1, 1.1, np.nan):
            with pytest.raises(PlannerError, match=f"{name} = .*at least 1e-06 and at most 1"):
                planner.plan(start, goal, "level_cup", **{name: value})


def test_a_joint_trajectory_is_what_a_controller_takes() -> None:
    planner, (start, goal) = packaged_planner(), pairs_of("level_cup", 1, seed=1)[0]
    path = planner.plan(start, goal, "level_cup")
    message = path.to_joint_trajectory()
    assert message["joint_names"] == list(planner.robot.joint_names)
    points = message["points"]
    rows = {name: np.array([point[name] for point in points]) for name in points[0]}
    np.testing.assert_array_equal(rows["positions"], path.joints)
    times = [t["sec"] + 1e-9 * t["nanosec"] for t in rows["time_from_start"]]
    np.testing.assert_allclose(times, path.times, atol=1e-9)
    assert all(0 <= t["nanosec"] < 10**9 for t in rows["time_from_start"])
    assert not rows["velocities"][[0, -1]].any(), "at rest at both ends"
    assert (np.abs(rows["velocities"]) <= planner.robot.velocity * (1.0 + 1e-9)).all()
    limit = planner.bundle.planner.acceleration_rad_s2
    assert (np.abs(rows["accelerations"]) <= limit * (1.0 + 1e-9)).all()
    assert np.abs(rows["accelerations"]).max() > 0.5 * limit
    # the accelerations lead from line to line
    middle = 0.5 * (path.times[1:] + path.times[:-1])
    gained = rows["accelerations"][1:-1] * np.diff(middle)[:, None]
    lines = np.diff(path.joints, axis=0) / np.diff(path.times)[:, None]
    np.testing.assert_allclose(np.diff(lines, axis=0), gained, atol=1e-9)
    with pytest.raises(PlannerError, match="no path"):
        planner.plan(start + 0.3, goal, "level_cup").to_joint_trajectory()


# prismatic and continuous joints


@cache
def gantry() -> Planner:
    return Planner.from_urdf(Path(__file__).parent / "robots" / "gantry.urdf", "hand")


def test_an_arm_with_prismatic_and_continuous_joints_keeps_a_level_tool() -> None:
    planner, solved = gantry(), 0
    robot = planner.robot
    assert robot.continuous == {"turn", "spin"}
    assert robot.chain.prismatic.tolist() == [True, True, True, False, False, False]
    limit = np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])  # m/s² and rad/s²
    with planner.scene.world() as world:
        for start, goal in free_pairs(planner, 6, seed=4):
            end = goal.copy()
            end[4:] = start[4:]  # what tilts the hand, and where to
            if not planner._certifier.collisions.is_free(end):
                continue
            pose = Pose(*robot.forward(end))
            for wanted in (end, pose, GoalRegion(pose, free=("yaw",))):
                path = planner.plan(start, wanted, "level")
                assert path.status == "solved", path.explanation
                assert path.certificate.goal_violation < 1e-6 or wanted is end
                message = path.to_joint_trajectory()["points"]
                assert (abs(np.array([p["accelerations"] for p in message])) <= limit + 1e-6).all()
                rows = np.linspace(path.joints[:-1], path.joints[1:], 4).reshape(-1, 6)
                assert world.free(rows).all()
                solved += 1
    assert solved >= 9


def test_angles_of_continuous_joints_are_reached_the_shorter_way_round() -> None:
    planner = gantry()
    start = np.array([0.0, 0.0, 0.3, 3.0, 0.3, -3.0])
    goal = np.array([0.1, 0.0, 0.3, -3.0, 0.3, 3.0])
    path = planner.plan(start, goal, "free")
    assert path.status == "solved", path.explanation
    assert path.length_rad < 1.0
    np.testing.assert_allclose(np.sin(path.goal - goal), 0.0, atol=1e-9)
    beyond = start + np.array([0, 0, 0, 7.0, 0, 0])
    refused = planner.plan(beyond, goal, "free")
    assert refused.status == "out_of_limits"
    assert "whole turns" in refused.explanation
    assert planner.plan(start, beyond, "free").status == "solved"


def test_the_certificate_names_the_pairs_that_are_not_looked_at() -> None:
    planner = panda()
    (start, goal), *_ = free_pairs(planner, 1, seed=1)
    rests_on = planner.plan(start, goal, "free").certificate.rests_on
    assert planner.robot.allowed
    for pair in planner.robot.allowed:
        assert " with ".join(sorted(pair)) in rests_on
    assert "panda_link0 with the shapes around the arm" not in rests_on
    planner.scene.add(Sphere("far", (2.0, 0.0, 1.0), 0.1))
    rests_on = planner.plan(start, goal, "free").certificate.rests_on
    assert "panda_link0 with the shapes around the arm" in rests_on


def test_a_closed_planner_answers_nothing() -> None:
    planner = Planner.from_urdf(*IIWA)
    planner.close()
    for ask in (
        lambda: planner.project(np.zeros(7), "free"),
        lambda: planner.ik(Pose(np.zeros(3), np.eye(3))),
        lambda: planner.plan(np.zeros(7), np.ones(7), "free"),
    ):
        with pytest.raises(PlannerError, match="closed"):
            ask()


def test_a_path_to_a_pose_ends_with_the_tool_there() -> None:
    """The tool's own frame, not its link's."""
    tool = Pose.from_rpy((0.01, 0.02, 0.1), (0.1, -0.4, 2.0))
    with Planner.from_urdf(*IIWA) as bare, Planner.from_urdf(*IIWA, tool=tool) as planner:
        for start, q in free_pairs(planner, 3, seed=4):
            goal = Pose(*planner.robot.forward(q))
            path = planner.plan(start, goal, "free")
            assert path.status == "solved", path.explanation
            position, rotation = bare.robot.forward(path.joints[-1])
            np.testing.assert_allclose(
                position + rotation @ tool.position, goal.position, atol=1e-4
            )
            np.testing.assert_allclose(rotation @ tool.rotation, goal.rotation, atol=1e-4)
            link = planner.scene.link_pose(path.joints[-1], IIWA[1])
            np.testing.assert_allclose(link[:3, 3], position, atol=1e-9)
            np.testing.assert_allclose(link[:3, :3], rotation, atol=1e-9)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_joint_is_held_at_a_number(value) -> None:
    with pytest.raises(RobotError, match="panda.urdf: hold.panda_finger_joint1=.*finite number"):
        Planner.from_urdf(
            "franka_panda/panda.urdf", "panda_grasptarget", hold={"panda_finger_joint1": value}
        )


# single held angles


@pytest.mark.parametrize("axis", [3, 4, 5])
def test_a_single_held_angle_is_planned_for_on_its_sheet(axis) -> None:
    """Where the tool is upside down to the reference the turn is undefined: configurations fall
    into two parts there, and all queries within one are solved.
    """
    planner = packaged_planner()
    axes = tuple(int(k == axis) for k in range(6))
    held = Constraint(axes, reference=Pose(np.zeros(3), np.eye(3)))
    task = planner._preparation.task(held)
    rng = np.random.default_rng(1)
    drawn = free_configurations(
        task.manifold, planner._certifier.collisions, planner.robot.sample, 40, rng
    )
    sizes = np.sort(np.bincount(task.roadmap().labels))[::-1]
    assert sizes[1] > 0.3 * sizes[0]
    assert sizes[:2].sum() > 0.99 * sizes.sum()
    statuses = [
        planner.plan(start, goal, held).status
        for start, goal in zip(drawn[::2], drawn[1::2], strict=True)
    ]
    assert set(statuses) == {"solved", "not_connected"}
    assert 0.25 < np.mean(np.array(statuses) == "solved") < 0.75


def test_a_region_leaves_an_end_free_under_a_constraint() -> None:
    planner, (start, goal) = packaged_planner(), pairs_of("level_cup", 1, seed=5)[0]
    pose = Pose(*planner.robot.forward(goal))
    path = planner.plan(start, GoalRegion(pose, free=("x", "y", "yaw")), "level_cup")
    assert path.status == "solved", path.explanation
    assert planner.robot.forward(path.goal)[0][2] == pytest.approx(pose.position[2], abs=1e-7)
    assert path.length_rad < planner.plan(start, pose, "level_cup").length_rad


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (lambda p: p.ik([0.4, 0.0, 0.4]), r"pose = .*: must be a Pose"),
        (lambda p: p.plan(np.zeros(7), [], "free"), "there is no goal"),
        (lambda p: p.plan(np.zeros(7), None, "free"), "there is no goal"),
        (lambda p: p.plan(np.zeros(7), np.ones(7), "free", budget_s="1"), "budget_s = '1'"),
        (lambda p: p.plan(np.zeros(7), np.ones(7), "free", velocity_scale="1"), "velocity_scale"),
        (lambda p: GoalRegion([0.0] * 7, free="yaw"), "pose = .*: must be a Pose"),
        (lambda p: GoalRegion(Pose(np.zeros(3), np.eye(3)), tolerance=0.1), "must be six numbers"),
    ],
)
def test_what_is_of_another_type_is_refused_by_its_name(asked, said) -> None:
    with pytest.raises(PlannerError, match=said):
        asked(panda())


def test_a_region_is_no_further_than_its_own_pose() -> None:
    planner = panda()
    for start, goal in free_pairs(planner, 6, seed=12):
        pose = Pose(*planner.robot.forward(goal))
        own = planner.plan(start, pose, "free").length_rad
        assert planner.plan(start, GoalRegion(pose, free="yaw"), "free").length_rad <= 1.01 * own
