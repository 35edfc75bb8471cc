"""Two constraints at once: what both keep is kept, and what one of them breaks is broken."""

import numpy as np
import pytest

from constraint_geodesics.constraints.both import Both, both
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.constraints.functions import tip_on_sphere
from constraint_geodesics.robot.kinematics import SerialRobot, load_robot, rotation_from_rpy
from constraint_geodesics.scene.urdf import find_urdf
from constraint_geodesics.search.nearest import nearest_on

LOOSE = (0.0, 0.0, 0.0, 0.1, 0.1, 0.0)


@pytest.fixture(scope="module")
def robot() -> SerialRobot:
    return load_robot(find_urdf("kuka_iiwa/model.urdf"), "lbr_iiwa_link_7")


def held(axes: tuple[int, ...], tolerance: tuple[float, ...] = (0.0,) * 6) -> Constraint:
    turn = rotation_from_rpy(np.array([0.2, -0.1, 0.4]))
    return Constraint(axes, tolerance, Pose(np.array([0.4, 0.1, 0.5]), turn))


def pairs(robot: SerialRobot) -> dict[str, tuple[Constraint, Constraint]]:
    cup = held((0, 0, 0, 1, 1, 0))
    return {
        "place and tilt": (held((1, 1, 1, 0, 0, 0)), cup),
        "yaw and tilt": (held((1, 0, 0, 0, 0, 1)), cup),
        "two cones": (held((0, 0, 1, 1, 1, 0), LOOSE), held((0, 1, 0, 1, 1, 0), LOOSE)),
        "functions": (cup, tip_on_sphere(robot, [0.3, 0.0, 0.4], 0.2)),
    }


@pytest.mark.parametrize("name", ["place and tilt", "yaw and tilt", "two cones", "functions"])
def test_residuals_and_slopes_are_those_of_the_two(robot, name) -> None:
    one, other = pairs(robot)[name]
    together = both(one, other)
    assert isinstance(together, Both)
    q = robot.sample(40, np.random.default_rng(0))  # more than one round of lanes
    values, slopes = ConstraintManifold(robot, together).linearise(q)
    first = ConstraintManifold(robot, together.first).linearise(q)
    second = ConstraintManifold(robot, together.second).linearise(q)
    np.testing.assert_array_equal(values, np.concatenate([first[0], second[0]], axis=1))
    np.testing.assert_array_equal(slopes, np.concatenate([first[1], second[1]], axis=1))


@pytest.mark.parametrize("name", ["place and tilt", "yaw and tilt", "two cones", "functions"])
def test_what_is_near_both_keeps_each(robot, name) -> None:
    one, other = pairs(robot)[name]
    together = ConstraintManifold(robot, both(one, other))
    seeds = robot.sample(60, np.random.default_rng(1))
    found = nearest_on(together, seeds[0], seeds)
    assert len(found)
    for own in (one, other):
        assert ConstraintManifold(robot, own).violation(found).max() < 1e-7


def test_what_has_no_reference_is_held_where_the_path_starts(robot) -> None:
    placed, floating = held((0, 0, 1, 0, 0, 0)), Constraint((0, 0, 0, 1, 1, 0))
    made = Both(placed, floating)
    assert not made.is_placed
    pose = Pose(*robot.forward(robot.sample(1, np.random.default_rng(0))[0]))
    at = made.relative_to(pose)
    assert isinstance(at, Both)
    assert at.is_placed
    assert (at.first, at.second) == (placed, floating.relative_to(pose))


def test_what_one_holds_already_is_not_held_twice() -> None:
    pose, cup = held((1,) * 6), held((0, 0, 0, 1, 1, 0))
    free = Constraint((0,) * 6)
    assert both(pose, cup) is not pose
    assert both(pose, cup).key == pose.key
    assert both(cup, pose).key == pose.key
    assert both(free, cup) is cup
    assert both(cup, free) is cup
    # one held angle is no part of two: the twist about an axis is another residual
    assert both(held((0, 0, 0, 0, 0, 1)), cup).codim == 3
    assert both(held((1, 1, 0, 1, 1, 0)), cup).codim == 4
